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
)


class TrainingRecordings:
    """Recordings to learn about one device from. What several estimators need is worked out once.

    Args:
        recordings: As in :mod:`gyro_pipeline.conventions`; not to be changed afterwards.
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

    def of(self, imu: int) -> "TrainingRecordings":
        """The same about another of the IMUs."""
        if self.seen and imu == self.imu:
            return self
        if imu not in self._others:
            self._others[imu] = TrainingRecordings(self.recordings, imu)
        return self._others[imu]

    @cached_property
    def rates(self) -> NDArray[np.floating]:
        """Samples of all recordings of the known IMUs, (recordings, axes, samples), deg/s."""
        if not self.seen:
            return np.concatenate([self.of(imu).rates for imu in self.known])
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
        """N, B and K of each axis, from the Allan variance averaged over recordings."""
        times = averaging_times_s(self.rates.shape[-1], self.rate_hz)
        shortest_s = SHORTEST_FIT_SAMPLES / self.rate_hz
        times = times[times >= shortest_s * (1 - 1e-9)]
        variances = [
            np.mean([allan_variance(row, self.rate_hz, times) for row in rows], axis=0)
            for rows in self.rates.swapaxes(0, 1)
        ]
        return [fit_noise(times, one, self.recording_s, shortest_s) for one in variances]

    @property
    def white_noise(self) -> NDArray[np.float64]:
        """N of each axis, (axes,), deg/s sqrt(s)."""
        return np.array([figures.white for figures in self.noise_figures])

    @property
    def _present(self) -> NDArray[np.bool_]:
        """Which recordings the device has; one that it lacks is NaN as a whole."""
        first = self.recordings.angular_rate.sel(imu=self.imu).isel(sample=0)
        return np.asarray(first.transpose("recording", "axis").notnull().all("axis").to_numpy())
