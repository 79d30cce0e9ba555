"""Simulated logs, for sensors without files."""

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
    """Writes simulated logs once, in the layout of the published files, and reads them.

    Each gyroscope has a unit bias, uniform within plus or minus ``unit_bias_dps``. Each power-on
    adds a normal deviation with the turn-on spread. Samples are this bias plus noise. The true
    values are stored beside the logs and loaded with them.

    Args:
        sensor, sensors, source, path, metadata: As for :class:`~.log_source.LogSource`.
        seed: Seed of the simulation, together with the sensor's name; 0 or more.

    Raises:
        InputError: The sensor is unknown, or its entry lacks values for the simulation.
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
        self._simulated = _simulated_sensor(sensor, self.entry)
        self._seed = seed
        self._train, self._test = (self._path / name for name in files.values())
        self._truth = self._path / f"{sensor}_truth.nc"

    def load(self) -> Logs:
        """List the recordings, after writing them if they are missing or have other settings.

        Returns:
            The recordings and the true values, in deg/s: ``true_bias`` (imu, recording, axis),
            ``true_unit_bias`` (imu, axis), ``true_turn_on_spread`` (axis), ``true_noise`` (axis), N
            in deg/s * sqrt(s), ``true_flicker``, B, and ``true_random_walk``, K in
            deg/s / sqrt(s). With a warm-up also ``true_amplitude`` and ``true_time_constant``, in
            seconds, (imu, recording, axis), and the mean and spread of amplitudes,
            ``true_amplitude_mean`` and ``true_amplitude_spread``.

        Raises:
            InputError: The files cannot be written, or were damaged; as the cause of Kedro's
                ``DatasetError``.
        """
        truth = self._stored_truth()
        if truth is None or truth.attrs.get("settings") != self._settings():
            reason = "" if truth is None else " again, since their settings have changed"
            _LOG.info("writing simulated %s logs%s: %s", self._sensor, reason, self._path)
            self._write()
            truth = open_recordings(self._truth).load()
        if truth.attrs["files_hash"] != self._files_hash():
            raise InputError(
                f"simulated {self._sensor}: {self._train.name} or {self._test.name} has changed "
                f"since it was written, so {self._truth} is not its truth; delete that file and "
                "type the same command again. For your own logs, use another source"
            )
        return replace(super().load(), simulated=True, truth=truth.drop_attrs())

    def _exists(self) -> bool:
        return self._truth.is_file() and super()._exists()

    def _describe(self) -> dict[str, Any]:
        return super()._describe() | {"seed": self._seed}

    def _settings(self) -> str:
        """A hash of everything that the files depend on."""
        return fingerprint([self._simulated.model_dump(mode="json"), self._seed])

    def _stored_truth(self) -> xr.Dataset | None:
        """The true values of the stored files; None if the files are incomplete or damaged."""
        if not self._exists():
            return None
        try:
            with open_recordings(self._truth) as truth:
                return truth.load()
        except InputError:  # damaged
            return None

    def _write(self) -> None:
        """Write the logs, then the true values, which mark the logs as complete."""
        name = zlib.crc32(self._sensor.encode())  # sensors with the same seed differ
        generator = np.random.default_rng(np.random.SeedSequence([self._seed, name]))
        truth = draw_biases(generator, self._simulated)
        with replacing(self._train) as train, replacing(self._test) as test:
            write_logs(generator, self._simulated, truth, train, test)
            # otherwise the old true values would mark the new arrays as complete
            self._truth.unlink(missing_ok=True)
        truth.attrs = {"settings": self._settings(), "files_hash": self._files_hash()}
        Recordings(str(self._truth)).save(truth)

    def _files_hash(self) -> str:
        """Digests of the array files."""
        return " ".join(map(digest_of, (self._train, self._test)))


def _simulated_sensor(sensor: str, entry: Sensor) -> SimulatedSensor:
    """Check that a sensor's entry has all values for a simulation."""
    needed = [name for name in SimulatedSensor.model_fields if name != "rate_hz"]
    missing = [name for name in needed if getattr(entry, name) is None]
    if missing:
        raise InputError(
            f"{sensor} has no files: an entry {sensor}.raw_logs.files in conf/<env>/catalog.yml "
            "says where they are. To simulate it instead, add to its entry under sensors in "
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
        The true values, as :meth:`SimulatedLogs.load` describes them.
    """
    model = entry.simulated
    spread, limit = np.array(model.turn_on_spread_mdps) * MDPS, model.unit_bias_dps
    unit_bias = generator.uniform(-limit, limit, (entry.imus, len(AXES)))
    turn_on = generator.normal(0, spread, (entry.imus, entry.recordings, len(AXES)))
    power_ons = "imu", "recording", "axis"
    values: dict[str, Any] = {
        "true_bias": (power_ons, unit_bias[:, None] + turn_on),
        "true_unit_bias": (("imu", "axis"), unit_bias),
        "true_turn_on_spread": ("axis", spread),
        "true_noise": ("axis", np.array(model.noise_mdps_rts) * MDPS),
        "true_flicker": model.flicker_mdps * MDPS,
        "true_random_walk": model.random_walk_mdps_per_rts * MDPS,
    }
    if model.warm_up is not None:
        mean, deviation = model.warm_up.amplitude_mdps * MDPS, model.warm_up.spread_mdps * MDPS
        values["true_amplitude"] = power_ons, generator.normal(mean, deviation, turn_on.shape)
        constants_s = generator.uniform(*model.warm_up.time_constant_s, turn_on.shape)
        values["true_time_constant"] = power_ons, constants_s
        values["true_amplitude_mean"], values["true_amplitude_spread"] = mean, deviation
    counts = {"imu": entry.imus, "recording": entry.recordings}
    numbers = {name: np.arange(1, count + 1) for name, count in counts.items()}
    return xr.Dataset(values, numbers | {"axis": list(AXES)})


def write_logs(
    generator: np.random.Generator,
    entry: SimulatedSensor,
    truth: xr.Dataset,
    train: Path,
    test: Path,
) -> None:
    """Write the samples of all gyroscopes, with one gyroscope in memory at a time.

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
            curve = amplitude.to_numpy()[imu, :, axis], constant_s.to_numpy()[imu, :, axis]
            rates += warm_up(*curve, entry.samples, entry.rate_hz)
        arrays[0][:, gyroscope], arrays[1][:, gyroscope] = rates[:cut], rates[cut:]
    for array in arrays:
        array.flush()


def _new_array(
    path: Path, recordings: int, entry: SimulatedSensor
) -> np.memmap[Any, np.dtype[Any]]:
    shape = (recordings, entry.imus * len(AXES), entry.samples)
    require_room(path, 4 * math.prod(shape))  # a mapped file larger than the disk would crash
    return np.lib.format.open_memmap(path, mode="w+", dtype=np.float32, shape=shape)
