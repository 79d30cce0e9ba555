"""What estimators learn from: training recordings, and what several of them learn alike."""

from functools import cached_property

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from gyro_pipeline.conventions import TEST_IMU
from gyro_pipeline.physics.allan import (
    SHORTEST_FIT_SAMPLES,
    NoiseFigures,
    allan_variance,
    averaging_times_s,
    fit_noise,
    mean_variance,
)
from gyro_pipeline.physics.bias import fill_masked


class TrainingRecordings:
    """Recordings to learn about one device from. What several estimators need is worked out once.

    Args:
        recordings: As in :mod:`gyro_pipeline.conventions`, all of one length; not to be changed
            afterwards.
        imu: The device. If it is not among the recordings it is an unseen one, and the others tell
            what devices are like.

    Attributes:
        rate_hz: Samples per second.
        recording_s: T, seconds.
        seen: Whether the device is among the recordings.
        known: IMUs to learn from: the device itself, or all others if it is an unseen one.
    """

    def __init__(self, recordings: xr.Dataset, imu: int = TEST_IMU) -> None:
        self.recordings, self.imu = recordings, imu
        self.rate_hz = float(recordings.attrs["rate_hz"])
        self.recording_s = float(recordings.sizes["sample"] / self.rate_hz)
        self.imus = [int(number) for number in recordings.imu]
        self.seen = imu in self.imus
        self.known = [imu] if self.seen else self.imus
        self._others: dict[int, TrainingRecordings] = {}

    def unseen(self, imu: int) -> "TrainingRecordings":
        """What the other IMUs tell of one, as if it were not among the recordings."""
        others = [one for one in self.imus if one != imu]
        training = TrainingRecordings(self.recordings.sel(imu=others), imu)
        training._others = {one: self.of(one) for one in others}
        return training

    def of(self, imu: int) -> "TrainingRecordings":
        """The same about another of the IMUs."""
        if self.seen and imu == self.imu:
            return self
        if imu not in self._others:
            self._others[imu] = TrainingRecordings(self.recordings, imu)
        return self._others[imu]

    @property
    def rates(self) -> NDArray[np.floating]:
        """Samples of all recordings of the known IMUs, (recordings, axes, samples), deg/s.

        Masked ones are the mean of the recording.
        """
        if self.seen:
            return fill_masked(self._own)
        return np.concatenate([self.of(imu).rates for imu in self.known])

    @cached_property
    def _own(self) -> NDArray[np.floating]:
        rates = self.recordings.angular_rate.sel(imu=self.imu)
        return rates.transpose("recording", "axis", "sample").to_numpy()[self._present]

    @cached_property
    def labels(self) -> tuple[NDArray[np.integer], NDArray[np.float64]]:
        """Numbers (n,), of each known IMU in order, and means (n, axes), deg/s, of recordings."""
        if not self.seen:
            known = [self.of(imu).labels for imu in self.known]
            return np.concatenate([n for n, _ in known]), np.concatenate([m for _, m in known])
        numbers = self.recordings.recording.to_numpy()[self._present]
        order = np.argsort(numbers)
        return numbers[order], self.rates.mean(axis=-1, dtype=np.float64)[order]

    @cached_property
    def noise_figures(self) -> list[NoiseFigures]:
        """N, B and K of each axis, from the Allan variance of all recordings."""
        fitted = self.recording_s, SHORTEST_FIT_SAMPLES / self.rate_hz
        return [fit_noise(self._times_s, one, *fitted) for one in mean_variance(*self._variances)]

    @property
    def _times_s(self) -> NDArray[np.float64]:
        """Averaging times that the fit uses."""
        times = averaging_times_s(self.recordings.sizes["sample"], self.rate_hz)
        return times[times * self.rate_hz >= SHORTEST_FIT_SAMPLES * (1 - 1e-9)]

    @cached_property
    def _variances(self) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
        """Allan variances and their counts of differences, (recordings, axes, times)."""
        if not self.seen:
            known = zip(*(self.of(imu)._variances for imu in self.known), strict=True)
            variances, counts = (np.concatenate(part) for part in known)
            return variances, counts
        rows = self._own.reshape(-1, self._own.shape[-1])
        both = zip(*(allan_variance(row, self.rate_hz, self._times_s) for row in rows), strict=True)
        variances, counts = (np.reshape(part, (*self._own.shape[:2], -1)) for part in both)
        return variances, counts

    @property
    def white_noise(self) -> NDArray[np.float64]:
        """N of each axis, (axes,), deg/s sqrt(s)."""
        return np.array([figures.white for figures in self.noise_figures])

    @property
    def _present(self) -> NDArray[np.bool_]:
        """Which recordings the device has."""
        return np.asarray(self.recordings["samples"].sel(imu=self.imu).to_numpy() > 0)
