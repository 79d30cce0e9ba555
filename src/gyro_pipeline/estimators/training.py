"""What estimators learn from: windows and recordings, and what several of them learn alike."""

import hashlib
from collections import OrderedDict
from collections.abc import Callable, Hashable, Sequence
from functools import cached_property
from typing import Any

import numpy as np
import pandas as pd
import xarray as xr
from numpy.typing import NDArray

from gyro_pipeline.conventions import (
    ALL,
    NOTHING,
    ORIGIN_REAL,
    ORIGIN_VIRTUAL,
    OWN,
    REAL,
    InputError,
)
from gyro_pipeline.physics.allan import (
    SHORTEST_FIT_SAMPLES,
    NoiseFigures,
    allan_variance,
    averaging_times_s,
    fit_noise,
    mean_variance,
)
from gyro_pipeline.physics.bias import fill_masked

_REMEMBERED_BYTES = 512 << 20
"""Of recordings read from files, in each process."""

Imu = tuple[str, int]
"""Origin and number of an IMU."""


class TrainingSet:
    """Windows to learn from, of real and virtual recordings, and the device to be estimated.

    Nothing is read before it is asked for. Pickled, file-backed recordings are references.

    Args:
        real: ``angular_rate``, ``samples`` and ``recording_mean`` (imu, recording, axis), as in
            :mod:`gyro_pipeline.conventions`, all of one length; may be backed by a file; not to be
            changed afterwards.
        virtual: The same of virtual IMUs, where there are windows of them.
        windows: Rows ``role`` (train or validation), ``origin, imu, recording, start``.
        size: Samples of a window.
        device: The IMU whose windows will be seen. If none of its windows trains, or it is
            UNSEEN, it is an unseen one, and the others tell what devices are like.
        side_by_side: IMUs whose windows are seen together (method 1), the device first.

    Attributes:
        windows: Sorted: real before virtual ones, then by IMU, the device first, by recording and
            start.
        rate_hz: Samples per second.
        recording_s: T, seconds.
    """

    def __init__(
        self,
        real: xr.Dataset,
        virtual: xr.Dataset | None,
        windows: pd.DataFrame,
        size: int,
        device: int,
        side_by_side: Sequence[int] = (),
    ) -> None:
        self.real, self.virtual, self.windows = real, virtual, _sorted(windows, device)
        self.size, self.device, self.side_by_side = size, device, tuple(side_by_side)
        self.rate_hz = float(real.attrs["rate_hz"])
        self.recording_s = float(real.sizes["sample"] / self.rate_hz)
        if virtual is None and ORIGIN_VIRTUAL in windows.origin.to_numpy():
            raise InputError("windows: some are of virtual gyroscopes, but there are none")

    def __getstate__(self) -> dict[str, Any]:
        """Without what was read and worked out."""
        worked_out = ("imus", "noise_figures", "key")
        return {name: value for name, value in vars(self).items() if name not in worked_out}

    def part(self, uses: str) -> "TrainingSet":
        """The part that an estimator uses.

        Args:
            uses: NOTHING; OWN, the device's own windows, or those of all real IMUs where it is an
                unseen one; REAL, those of all real IMUs; or ALL.
        """
        if uses not in (NOTHING, OWN, REAL, ALL):
            raise InputError(f"uses: expected {NOTHING}, {OWN}, {REAL} or {ALL}, got {uses!r}")
        of_real = (self.windows.origin == ORIGIN_REAL).to_numpy()
        own = (self.windows.imu == self.device).to_numpy() if self.seen else True
        kept = {NOTHING: of_real & False, OWN: of_real & own, REAL: of_real}.get(uses)
        if kept is None or kept.all():
            return self
        virtual = self.virtual if uses == ALL else None
        given = self.windows[kept], self.size, self.device, self.side_by_side
        return TrainingSet(self.real, virtual, *given)

    @cached_property
    def key(self) -> str:
        """Equal for training sets of the same windows of the same datasets in this process."""
        rows = pd.util.hash_pandas_object(self.windows, index=False).to_numpy()
        data = id(self.real), id(self.virtual), self.size, self.device, self.side_by_side
        return hashlib.sha256(rows.tobytes() + repr(data).encode()).hexdigest()

    @property
    def recordings_key(self) -> tuple[Hashable, ...]:
        """Equal for training sets of the same recordings, whatever their windows."""
        places = self.windows[["origin", "imu", "recording"]].drop_duplicates()
        return (id(self.real), id(self.virtual), *places.itertuples(index=False, name=None))

    @property
    def seen(self) -> bool:
        """Whether the device is among those that train."""
        own = (self.windows.imu == self.device) & (self.windows.origin == ORIGIN_REAL)
        return bool(own.any())

    @cached_property
    def imus(self) -> dict[Imu, "ImuRecordings"]:
        """All that train or validate: real before virtual ones, the device first."""
        found = {}
        for origin, imu in self.windows[["origin", "imu"]].drop_duplicates().to_numpy().tolist():
            recordings = self.real if origin == ORIGIN_REAL else self.virtual
            assert recordings is not None
            rows = self.windows[(self.windows.origin == origin) & (self.windows.imu == imu)]
            found[origin, imu] = ImuRecordings(recordings, imu, rows)
        return found

    @property
    def known(self) -> list["ImuRecordings"]:
        """IMUs to learn about the device from: itself, or all real ones if it is unseen."""
        if self.seen:
            return [self.imus[ORIGIN_REAL, self.device]]
        return [one for (origin, _), one in self.imus.items() if origin == ORIGIN_REAL]

    def recordings(self, role: str | None = None) -> int:
        """How many recordings the known IMUs have: all, or those with windows of a role."""
        real = self.windows.origin == ORIGIN_REAL
        own = self.windows.imu == self.device if self.seen else True
        chosen = self.windows[real & own & (True if role is None else self.windows.role == role)]
        return len(chosen[["imu", "recording"]].drop_duplicates())

    @property
    def samples(self) -> int:
        """Samples of all recordings, of three gyroscopes."""
        places = self.windows[["origin", "imu", "recording"]].drop_duplicates()
        return len(places) * self.real.sizes["sample"]

    @property
    def rates(self) -> NDArray[np.floating]:
        """Samples of all recordings of the known IMUs, (recordings, axes, samples), deg/s.

        Masked ones are the mean of the recording.
        """
        rates = [one.rates for one in self.known]
        return rates[0] if len(rates) == 1 else np.concatenate(rates)

    @property
    def starts(self) -> list[NDArray[np.integer]]:
        """First samples of the windows of each of these recordings."""
        return [starts for one in self.known for starts in one.starts]

    @property
    def labels(self) -> tuple[NDArray[np.integer], NDArray[np.float64]]:
        """Numbers (n,), of each known IMU in order, and means (n, axes), deg/s, of recordings."""
        numbers = np.concatenate([one.numbers for one in self.known])
        return numbers, np.concatenate([one.means for one in self.known])

    @cached_property
    def noise_figures(self) -> list[NoiseFigures]:
        """N, B and K of each axis, from the Allan variance of all recordings."""
        return fitted_noise(self.known)

    @property
    def white_noise(self) -> NDArray[np.float64]:
        """N of each axis, (axes,), deg/s sqrt(s)."""
        return np.array([figures.white for figures in self.noise_figures])


class ImuRecordings:
    """Recordings of one IMU that has windows in a training set.

    What is read of a file, and what is worked out of single recordings, is remembered in this
    process, so that the windows and folds of a study share it.

    Args:
        recordings: Of all IMUs.
        imu: Which.
        windows: Its rows of the windows table, sorted.

    Attributes:
        numbers: Of its recordings, (n,), increasing.
        starts: First samples of the windows of each.
    """

    def __init__(self, recordings: xr.Dataset, imu: int, windows: pd.DataFrame) -> None:
        self._recordings, self._imu = recordings, imu
        numbers, firsts = np.unique(windows.recording.to_numpy(), return_index=True)
        self.numbers: NDArray[np.integer] = numbers
        self.starts: list[NDArray[np.integer]] = np.split(windows.start.to_numpy(), firsts[1:])
        self.rate_hz = float(recordings.attrs["rate_hz"])
        self.sample_count = int(recordings.sizes["sample"])
        in_file = not recordings.angular_rate.variable._in_memory
        self._from_file = in_file and "data_hash" in recordings.attrs
        self._memory = _OF_FILES if self._from_file else _Memory()

    @property
    def rates(self) -> NDArray[np.floating]:
        """Samples, (recordings, axes, samples), deg/s; masked ones are the recording's mean."""
        return fill_masked(np.stack(self._read()))

    @property
    def means(self) -> NDArray[np.float64]:
        """Of the recordings, (n, axes), deg/s."""
        return np.stack(self._worked_out("means", _mean))

    @property
    def variances(self) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
        """Allan variances and their counts of differences, (recordings, axes, times)."""
        both = np.stack(self._worked_out("variances", self._allan))
        return both[:, 0], both[:, 1].astype(np.int64)

    @property
    def times_s(self) -> NDArray[np.float64]:
        """Averaging times of the Allan variances."""
        times = averaging_times_s(self.sample_count, self.rate_hz)
        return times[times * self.rate_hz >= SHORTEST_FIT_SAMPLES * (1 - 1e-9)]

    def _allan(self, samples: NDArray[np.floating]) -> NDArray[np.float64]:
        """Variances and counts, (2, axes, times), of a recording."""
        rows = [allan_variance(row, self.rate_hz, self.times_s) for row in samples]
        return np.array(rows, np.float64).swapaxes(0, 1)

    def _worked_out(
        self, what: str, work_out: Callable[[NDArray[np.floating]], NDArray[np.float64]]
    ) -> list[NDArray[np.float64]]:
        """Of each recording: remembered, or worked out now."""
        keys = [(what, *self._key(number)) for number in self.numbers.tolist()]
        remembered = self._memory.get(keys)
        if remembered is None:
            remembered = [work_out(samples) for samples in self._read()]
            self._memory.put(keys, remembered)
        return remembered

    def _read(self) -> list[NDArray[np.floating]]:
        """Each recording, (axes, samples), NaN where masked."""
        keys = [("samples", *self._key(number)) for number in self.numbers.tolist()]
        remembered = self._memory.get(keys)
        if remembered is None:
            rates = self._recordings.angular_rate.sel(imu=self._imu)
            rows = rates.get_index("recording").get_indexer(pd.Index(self.numbers))
            # what lies between them as well, as single ones are found far more slowly
            part = rates.isel(recording=slice(int(rows.min()), int(rows.max()) + 1))
            read = part.transpose("recording", "axis", "sample").to_numpy()
            remembered = [read[row] for row in rows - rows.min()]
            if self._from_file:
                self._memory.put(keys, [one.copy() for one in remembered])
        return remembered

    def _key(self, number: int) -> tuple[Hashable, ...]:
        data = self._recordings.attrs.get("data_hash"), self.sample_count, self.rate_hz
        return (*data, self._imu, number)


def fitted_noise(imus: Sequence[ImuRecordings]) -> list[NoiseFigures]:
    """N, B and K of each axis of IMUs that are taken as one, from their Allan variances."""
    parts = zip(*(one.variances for one in imus), strict=True)
    variances, counts = (np.concatenate(part) for part in parts)
    one = imus[0]
    fitted = one.sample_count / one.rate_hz, SHORTEST_FIT_SAMPLES / one.rate_hz
    means = mean_variance(variances, counts)
    return [fit_noise(one.times_s, variance, *fitted) for variance in means]


def _sorted(windows: pd.DataFrame, device: int) -> pd.DataFrame:
    """Real before virtual ones, the device first."""
    others = (windows.imu != device) | (windows.origin != ORIGIN_REAL)
    order = {"virtual": windows.origin == ORIGIN_VIRTUAL, "others": others}
    by = ["virtual", "others", "imu", "recording", "start"]
    columns = ["role", "origin", "imu", "recording", "start"]
    ordered = windows[columns].assign(**order).sort_values(by, kind="stable")
    return ordered[columns].reset_index(drop=True)


def _mean(samples: NDArray[np.floating]) -> NDArray[np.float64]:
    return np.asarray(fill_masked(samples).mean(axis=-1, dtype=np.float64))


class _Memory:
    """Arrays by key; those that were not asked for longest are dropped where they get too many."""

    def __init__(self) -> None:
        self._arrays: OrderedDict[Hashable, NDArray[Any]] = OrderedDict()
        self._bytes = 0

    def get(self, keys: Sequence[Hashable]) -> list[NDArray[Any]] | None:
        """Arrays, if all of them are remembered."""
        if any(key not in self._arrays for key in keys):
            return None
        for key in keys:
            self._arrays.move_to_end(key)
        return [self._arrays[key] for key in keys]

    def put(self, keys: Sequence[Hashable], arrays: Sequence[NDArray[Any]]) -> None:
        """Remember arrays."""
        for key, array in zip(keys, arrays, strict=True):
            self._bytes += array.nbytes - (self._arrays[key].nbytes if key in self._arrays else 0)
            self._arrays[key] = array
        while self._bytes > _REMEMBERED_BYTES:
            _, dropped = self._arrays.popitem(last=False)
            self._bytes -= dropped.nbytes


_OF_FILES = _Memory()
