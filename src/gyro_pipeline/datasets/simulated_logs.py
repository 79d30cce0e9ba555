"""The stand-in for sensors whose logs are not at hand."""

import logging
import math
import zlib
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from pydantic import ValidationError

from gyro_pipeline.conventions import AXES, MDPS, InputError
from gyro_pipeline.datasets.array_logs import LAYOUT, ArrayLogs
from gyro_pipeline.datasets.atomic import replacing, require_room
from gyro_pipeline.datasets.recordings import Recordings, open_recordings
from gyro_pipeline.datasets.stored import digest_of
from gyro_pipeline.fingerprints import fingerprint
from gyro_pipeline.logs import Logs
from gyro_pipeline.parameters import Sensor, SimulatedSensor
from gyro_pipeline.physics.noise import simulate_noise, warm_up

_LOG = logging.getLogger(__name__)


class SimulatedLogs(ArrayLogs):
    """Writes simulated logs once, in the published layout, and reads them as any such files.

    Each gyroscope has a unit bias, uniform in plus or minus ``unit_bias_dps``; each power-on adds
    a normal deviation with the turn-on spread; samples are that bias plus noise. What was drawn
    is kept beside the logs and read with them.

    Args:
        sensor, sensors, source, path, metadata: As :class:`~.log_source.LogSource` takes them.
        seed: Of all draws, together with the sensor's name; 0 or more.

    Raises:
        InputError: An unknown sensor, or an entry that lacks what simulating it takes.
    """

    def __init__(
        self,
        sensor: str,
        sensors: Mapping[str, Mapping[str, Any]],
        source: str,
        path: str,
        seed: int,
        metadata: dict[str, Any] | None = None,
    ) -> None:
        files = {split: f"{sensor}_{split}.npy" for split in ("train", "test")}
        super().__init__(sensor, sensors, source, path, files, LAYOUT, metadata)
        self._stand_in = _to_simulate(sensor, self.entry)
        self._seed = seed
        self._train, self._test = (self._path / name for name in files.values())
        self._truth = self._path / f"{sensor}_truth.nc"

    def load(self) -> Logs:
        """List the recordings, writing them first where they are missing or of other settings.

        Returns:
            The recordings, and what was drawn, in deg/s: ``true_bias`` (imu, recording, axis),
            ``true_unit_bias`` (imu, axis), ``true_turn_on_spread`` (axis), and ``true_noise``
            (axis), N in deg/s * sqrt(s). Also ``true_flicker``, B, and ``true_random_walk``, K in
            deg/s / sqrt(s). With a warm-up its ``true_amplitude`` and ``true_time_constant``, in
            seconds, (imu, recording, axis), and what amplitudes were drawn with:
            ``true_amplitude_mean``, ``true_amplitude_spread``.

        Raises:
            InputError: As the cause of Kedro's ``DatasetError``, files that cannot be written, or
                that were damaged since.
        """
        truth = self._truth_on_disk()
        if truth is None or truth.attrs.get("settings") != self._settings():
            why = "" if truth is None else " again, since their settings have changed"
            _LOG.info("writing simulated %s logs%s: %s", self._sensor, why, self._path)
            self._write()
            truth = open_recordings(self._truth).load()
        if truth.attrs["files_hash"] != self._files_hash():
            raise InputError(
                f"simulated {self._sensor}: {self._train.name} or {self._test.name} has changed "
                f"since it was written, so {self._truth} is not its truth; delete that file and "
                "run again. Logs of your own belong to another source"
            )
        return replace(super().load(), simulated=True, drawn=truth.drop_attrs())

    def _exists(self) -> bool:
        return self._truth.is_file() and super()._exists()

    def _describe(self) -> dict[str, Any]:
        return super()._describe() | {"seed": self._seed}

    def _settings(self) -> str:
        """A hash of all that the files depend on."""
        return fingerprint([self._stand_in.model_dump(mode="json"), self._seed])

    def _truth_on_disk(self) -> xr.Dataset | None:
        """What was drawn for the files that are there; None where they are not complete."""
        if not self._exists():
            return None
        try:
            with open_recordings(self._truth) as truth:
                return truth.load()
        except InputError:  # damaged: as good as not written
            return None

    def _write(self) -> None:
        """Write the logs, then what was drawn, which marks them as complete."""
        name = zlib.crc32(self._sensor.encode())  # sensors with one seed get different draws
        generator = np.random.default_rng(np.random.SeedSequence([self._seed, name]))
        truth = draw_biases(generator, self._stand_in)
        with replacing(self._train) as train, replacing(self._test) as test:
            write_logs(generator, self._stand_in, truth, train, test)
            # from here on the old mark would vouch for the new arrays
            self._truth.unlink(missing_ok=True)
        truth.attrs = {"settings": self._settings(), "files_hash": self._files_hash()}
        Recordings(str(self._truth)).save(truth)

    def _files_hash(self) -> str:
        """Of the arrays' bytes."""
        return " ".join(map(digest_of, (self._train, self._test)))


def _to_simulate(sensor: str, entry: Sensor) -> SimulatedSensor:
    """A sensor's entry, with all that simulating it takes."""
    needed = [name for name in SimulatedSensor.model_fields if name != "rate_hz"]
    missing = [name for name in needed if getattr(entry, name) is None]
    if missing:
        raise InputError(
            f"{sensor} has no files: an entry {sensor}.raw_logs.files in conf/<env>/catalog.yml "
            "says where they are. To simulate it instead, write to its entry under sensors in "
            f"conf/<env>/globals.yml: {', '.join(missing)}"
        )
    try:
        return SimulatedSensor.model_validate(entry.model_dump())
    except ValidationError as error:
        raise InputError(f"sensor {sensor} in globals.yml: {error}") from error


def draw_biases(generator: np.random.Generator, entry: SimulatedSensor) -> xr.Dataset:
    """Draw the bias of every gyroscope at every power-on.

    Args:
        generator: Source of randomness.
        entry: The sensor.

    Returns:
        ``true_bias``, ``true_unit_bias``, ``true_turn_on_spread`` and ``true_noise``, as
        :meth:`SimulatedLogs.load` describes them.
    """
    model = entry.simulated
    spread, limit = np.array(model.turn_on_spread_mdps) * MDPS, model.unit_bias_dps
    unit_bias = generator.uniform(-limit, limit, (entry.imus, len(AXES)))
    turn_on = generator.normal(0, spread, (entry.imus, entry.recordings, len(AXES)))
    power_ons = "imu", "recording", "axis"
    drawn: dict[str, Any] = {
        "true_bias": (power_ons, unit_bias[:, None] + turn_on),
        "true_unit_bias": (("imu", "axis"), unit_bias),
        "true_turn_on_spread": ("axis", spread),
        "true_noise": ("axis", np.array(model.noise_mdps_rts) * MDPS),
        "true_flicker": model.flicker_mdps * MDPS,
        "true_random_walk": model.random_walk_mdps_per_rts * MDPS,
    }
    if model.warm_up is not None:
        figures = model.warm_up.amplitude_mdps * MDPS, model.warm_up.spread_mdps * MDPS
        drawn["true_amplitude"] = power_ons, generator.normal(*figures, turn_on.shape)
        constants_s = generator.uniform(*model.warm_up.time_constant_s, turn_on.shape)
        drawn["true_time_constant"] = power_ons, constants_s
        drawn["true_amplitude_mean"], drawn["true_amplitude_spread"] = figures
    counts = {"imu": entry.imus, "recording": entry.recordings}
    numbers = {name: np.arange(1, count + 1) for name, count in counts.items()}
    return xr.Dataset(drawn, numbers | {"axis": list(AXES)})


def write_logs(
    generator: np.random.Generator,
    entry: SimulatedSensor,
    truth: xr.Dataset,
    train: Path,
    test: Path,
) -> None:
    """Write the samples of all gyroscopes, one gyroscope in memory at a time.

    Args:
        generator: Source of randomness.
        entry: The sensor.
        truth: From :func:`draw_biases`.
        train: File for the first ``entry.train_recordings`` recordings.
        test: File for the other recordings.
    """
    cut, model = entry.train_recordings, entry.simulated
    arrays = _new_array(train, cut, entry), _new_array(test, entry.recordings - cut, entry)
    for gyroscope in range(entry.imus * len(AXES)):
        imu, axis = divmod(gyroscope, len(AXES))
        noise = simulate_noise(
            generator,
            (entry.recordings, entry.samples),
            entry.rate_hz,
            model.noise_mdps_rts[axis] * MDPS,
            lag1_correlation=model.lag1_correlation,
            flicker_dps=model.flicker_mdps * MDPS,
            random_walk_dps_rts=model.random_walk_mdps_per_rts * MDPS,
        )
        rates = truth.true_bias.to_numpy()[imu, :, axis, None] + noise
        if model.warm_up is not None:
            amplitude, constant_s = truth.true_amplitude, truth.true_time_constant
            drawn = amplitude.to_numpy()[imu, :, axis], constant_s.to_numpy()[imu, :, axis]
            rates += warm_up(*drawn, entry.samples, entry.rate_hz)
        arrays[0][:, gyroscope], arrays[1][:, gyroscope] = rates[:cut], rates[cut:]
    for array in arrays:
        array.flush()


def _new_array(
    path: Path, recordings: int, entry: SimulatedSensor
) -> np.memmap[Any, np.dtype[Any]]:
    shape = (recordings, entry.imus * len(AXES), entry.samples)
    require_room(path, 4 * math.prod(shape))  # a mapped file that outgrows the disk is a crash
    return np.lib.format.open_memmap(path, mode="w+", dtype=np.float32, shape=shape)
