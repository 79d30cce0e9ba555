"""Training sets: windows and recordings to learn from, and figures that estimators share."""

import hashlib
from collections.abc import Callable, Hashable, Sequence
from functools import cached_property
from typing import Any

import numpy as np
import pandas as pd
import xarray as xr
from cachetools import LRUCache
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
    fit_axes,
)
from gyro_pipeline.physics.bias import fill_masked

_CACHE_BYTES = 512 << 20
"""Bytes of recordings from files that each process caches."""

Imu = tuple[str, int]
"""Origin and number of an IMU."""


class TrainingSet:
    """Windows of real and virtual recordings to learn from, and the device to be estimated.

    Samples are read when they are needed. In a pickle, file-backed recordings are references.

    Args:
        real: ``angular_rate``, ``samples`` and ``recording_mean`` (imu, recording, axis), as in
            :mod:`gyro_pipeline.conventions`, all of one length; may be backed by a file; must not
            be changed afterwards.
        virtual: Recordings of virtual IMUs, if there are windows of them.
        windows: Rows ``role`` (train or validation), ``origin, imu, recording, start``.
        size: Samples of a window.
        device: The IMU whose windows will be estimated. It is unseen if it is UNSEEN or none of
            its windows trains; then estimators learn about devices from the others.
        side_by_side: IMUs whose windows are one input (method 1), the device first.

    Attributes:
        windows: Rows sorted by origin, real first, by IMU, the device first, by recording and
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
        """The state without cached values."""
        cached = ("imus", "noise_figures", "key")
        return {name: value for name, value in vars(self).items() if name not in cached}

    def part(self, uses: str) -> "TrainingSet":
        """The part that an estimator uses.

        Args:
            uses: NOTHING; OWN, the windows of the device, or of all real IMUs if it is unseen;
                REAL, the windows of all real IMUs; or ALL. The rows of a study are reduced alike,
                by :func:`gyro_pipeline.studies.run_spec`.
        """
        if uses not in (NOTHING, OWN, REAL, ALL):
            raise InputError(f"uses: expected {NOTHING}, {OWN}, {REAL} or {ALL}, got {uses!r}")
        real = (self.windows.origin == ORIGIN_REAL).to_numpy()
        device = (self.windows.imu == self.device).to_numpy() if self.seen else True
        rows = {NOTHING: real & False, OWN: real & device, REAL: real}.get(uses)
        if rows is None or rows.all():
            return self
        settings = self.windows[rows], self.size, self.device, self.side_by_side
        return TrainingSet(self.real, None, *settings)

    @cached_property
    def key(self) -> str:
        """A key that is equal for the same windows of the same datasets in this process."""
        rows = pd.util.hash_pandas_object(self.windows, index=False).to_numpy()
        data = id(self.real), id(self.virtual), self.size, self.device, self.side_by_side
        return hashlib.sha256(rows.tobytes() + repr(data).encode()).hexdigest()

    @property
    def recordings_key(self) -> tuple[Hashable, ...]:
        """A key that is equal for the same recordings, whatever their windows."""
        recordings = self.windows[["origin", "imu", "recording"]].drop_duplicates()
        return (id(self.real), id(self.virtual), *recordings.itertuples(index=False, name=None))

    @property
    def seen(self) -> bool:
        """Whether the device has windows in the training set."""
        rows = (self.windows.imu == self.device) & (self.windows.origin == ORIGIN_REAL)
        return bool(rows.any())

    @cached_property
    def imus(self) -> dict[Imu, "ImuRecordings"]:
        """All IMUs that train or validate, the device first, then real before virtual ones."""
        imus = {}
        for origin, imu in self.windows[["origin", "imu"]].drop_duplicates().to_numpy().tolist():
            recordings = self.real if origin == ORIGIN_REAL else self.virtual
            assert recordings is not None
            rows = self.windows[(self.windows.origin == origin) & (self.windows.imu == imu)]
            imus[origin, imu] = ImuRecordings(recordings, imu, rows)
        return imus

    @property
    def known_imus(self) -> list["ImuRecordings"]:
        """IMUs to learn about the device from: itself, or all real ones if it is unseen."""
        if self.seen:
            return [self.imus[ORIGIN_REAL, self.device]]
        return [imu for (origin, _), imu in self.imus.items() if origin == ORIGIN_REAL]

    def recordings(self) -> int:
        """Number of recordings of the known IMUs."""
        real = self.windows.origin == ORIGIN_REAL
        device = self.windows.imu == self.device if self.seen else True
        return len(self.windows.loc[real & device, ["imu", "recording"]].drop_duplicates())

    @property
    def samples(self) -> int:
        """Number of samples, of three gyroscopes, in all recordings."""
        recordings = self.windows[["origin", "imu", "recording"]].drop_duplicates()
        return len(recordings) * self.real.sizes["sample"]

    @property
    def rates(self) -> NDArray[np.floating]:
        """Samples of all recordings of the known IMUs, (recordings, axes, samples), deg/s.

        A masked sample is the mean of the recording.
        """
        rates = [imu.rates for imu in self.known_imus]
        return rates[0] if len(rates) == 1 else np.concatenate(rates)

    @property
    def starts(self) -> list[NDArray[np.integer]]:
        """First samples of the windows of each recording of the known IMUs."""
        return [starts for imu in self.known_imus for starts in imu.starts]

    @property
    def labels(self) -> tuple[NDArray[np.integer], NDArray[np.float64]]:
        """Numbers (n,) and means (n, axes), deg/s, of the recordings of the known IMUs in order."""
        numbers = np.concatenate([imu.numbers for imu in self.known_imus])
        return numbers, np.concatenate([imu.means for imu in self.known_imus])

    @cached_property
    def noise_figures(self) -> list[NoiseFigures]:
        """N, B and K of each axis, from the Allan variances of all recordings."""
        return fitted_noise(self.known_imus)

    @property
    def white_noise(self) -> NDArray[np.float64]:
        """N of each axis, (axes,), deg/s sqrt(s)."""
        return np.array([figures.white for figures in self.noise_figures])


class ImuRecordings:
    """Recordings of an IMU that has windows in a training set.

    Samples from files and figures of single recordings are cached in this process, so that the
    windows and folds of a study share them.

    Args:
        recordings: Recordings of all IMUs.
        imu: Number of the IMU.
        windows: Rows of the IMU in the windows table, sorted.

    Attributes:
        numbers: Numbers of the recordings, (n,), increasing.
        starts: First samples of the windows of each recording.
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
        self._cache = _FILE_CACHE if self._from_file else _array_cache()

    @property
    def rates(self) -> NDArray[np.floating]:
        """Samples, (recordings, axes, samples), deg/s; a masked one is the recording's mean."""
        return fill_masked(np.stack(self._read()))

    @property
    def means(self) -> NDArray[np.float64]:
        """Means of the recordings, (n, axes), deg/s."""
        return np.stack(self._cached("means", _mean))

    @property
    def variances(self) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
        """Allan variances and their counts of differences, (recordings, axes, times)."""
        figures = np.stack(self._cached("variances", self._allan))
        return figures[:, 0], figures[:, 1].astype(np.int64)

    @property
    def times_s(self) -> NDArray[np.float64]:
        """Averaging times of the Allan variances, (times,), seconds."""
        times = averaging_times_s(self.sample_count, self.rate_hz)
        return times[times * self.rate_hz >= SHORTEST_FIT_SAMPLES * (1 - 1e-9)]

    def _allan(self, samples: NDArray[np.floating]) -> NDArray[np.float64]:
        """Allan variances and counts of a recording, (2, axes, times)."""
        rows = [allan_variance(row, self.rate_hz, self.times_s) for row in samples]
        return np.array(rows, np.float64).swapaxes(0, 1)

    def _cached(
        self, name: str, compute: Callable[[NDArray[np.floating]], NDArray[np.float64]]
    ) -> list[NDArray[np.float64]]:
        """A figure of each recording, from the cache or computed now."""
        keys = [(name, *self._key(number)) for number in self.numbers.tolist()]
        if all(key in self._cache for key in keys):
            return [self._cache[key] for key in keys]
        arrays = [compute(samples) for samples in self._read()]
        self._cache.update(zip(keys, arrays, strict=True))
        return arrays

    def _read(self) -> list[NDArray[np.floating]]:
        """The samples of each recording, (axes, samples), NaN where masked."""
        keys = [("samples", *self._key(number)) for number in self.numbers.tolist()]
        if all(key in self._cache for key in keys):
            return [self._cache[key] for key in keys]
        rates = self._recordings.angular_rate.sel(imu=self._imu)
        rows = rates.get_index("recording").get_indexer(pd.Index(self.numbers))
        # reading a range is far faster than reading single recordings
        part = rates.isel(recording=slice(int(rows.min()), int(rows.max()) + 1))
        samples = part.transpose("recording", "axis", "sample").to_numpy()
        arrays = [samples[row] for row in rows - rows.min()]
        if self._from_file and samples[0].nbytes <= _CACHE_BYTES:
            self._cache.update((key, array.copy()) for key, array in zip(keys, arrays, strict=True))
        return arrays

    def _key(self, number: int) -> tuple[Hashable, ...]:
        data = self._recordings.attrs.get("data_hash"), self.sample_count, self.rate_hz
        return (*data, self._imu, number)


def fitted_noise(imus: Sequence[ImuRecordings]) -> list[NoiseFigures]:
    """N, B and K of each axis, fitted to the mean Allan variances of several IMUs."""
    parts = zip(*(imu.variances for imu in imus), strict=True)
    variances, counts = (np.concatenate(part) for part in parts)
    first = imus[0]
    recording_s = first.sample_count / first.rate_hz
    return fit_axes(first.times_s, variances, counts, recording_s, first.rate_hz)


def _sorted(windows: pd.DataFrame, device: int) -> pd.DataFrame:
    """Rows in order: real before virtual windows, the device first."""
    others = (windows.imu != device) | (windows.origin != ORIGIN_REAL)
    order = {"virtual": windows.origin == ORIGIN_VIRTUAL, "others": others}
    by = ["virtual", "others", "imu", "recording", "start"]
    columns = ["role", "origin", "imu", "recording", "start"]
    ordered = windows[columns].assign(**order).sort_values(by, kind="stable")
    return ordered[columns].reset_index(drop=True)


def _mean(samples: NDArray[np.floating]) -> NDArray[np.float64]:
    return np.asarray(fill_masked(samples).mean(axis=-1, dtype=np.float64))


def _array_cache() -> LRUCache[Hashable, NDArray[Any]]:
    return LRUCache(_CACHE_BYTES, getsizeof=lambda array: array.nbytes)


_FILE_CACHE = _array_cache()
