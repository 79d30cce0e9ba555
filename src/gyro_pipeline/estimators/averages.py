"""Estimators that know nothing but the window."""

from typing import ClassVar, Self

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike, NDArray
from scipy import stats

from gyro_pipeline.conventions import BIAS, RECORDING_MEAN, TEST_IMU
from gyro_pipeline.estimators.base import Estimates, check_target, duration_s
from gyro_pipeline.estimators.noise import white_noise


class RunningMean:
    """Zero-order calibration: the mean of the window (paper, section II), the running mean.

    Usable without ``fit``, which only gives it sigma: N / sqrt(T0) for the bias and
    N sqrt(1 / T0 - 1 / T) for the mean of the recording, if the noise is white.
    """

    recommended: ClassVar[bool] = False
    uses_prior: ClassVar[bool] = False

    def __init__(self) -> None:
        self._noise: NDArray[np.float64] | None = None
        self._rate_hz = self._recording_s = np.nan

    def fit(self, recordings: xr.Dataset, imu: int = TEST_IMU) -> Self:
        """Learn N; see :class:`~gyro_pipeline.estimators.FittedEstimator`."""
        self._noise = white_noise(recordings, imu)
        self._rate_hz, self._recording_s = recordings.attrs["rate_hz"], duration_s(recordings)
        return self

    def estimate(
        self,
        windows: NDArray[np.floating],
        target: str = BIAS,
        start_s: ArrayLike = 0.0,
        recording: int | None = None,
    ) -> Estimates:
        """See :class:`~gyro_pipeline.estimators.Estimator`; sums are in float64."""
        check_target(target)
        biases = windows.mean(axis=-1, dtype=np.float64)
        if self._noise is None:
            return biases, np.full(biases.shape, np.nan)
        window_s = windows.shape[-1] / self._rate_hz
        rest = 1 / self._recording_s if target == RECORDING_MEAN else 0.0
        sigma = self._noise * np.sqrt(max(1 / window_s - rest, 0.0))
        return biases, np.broadcast_to(sigma, biases.shape)


class _RobustMean:
    """An average that single samples far off do not move; its sigma is not known."""

    recommended: ClassVar[bool] = False
    uses_prior: ClassVar[bool] = False

    def fit(self, recordings: xr.Dataset, imu: int = TEST_IMU) -> Self:
        """There is nothing to learn."""
        return self

    def estimate(
        self,
        windows: NDArray[np.floating],
        target: str = BIAS,
        start_s: ArrayLike = 0.0,
        recording: int | None = None,
    ) -> Estimates:
        """See :class:`~gyro_pipeline.estimators.Estimator`; sigma is NaN."""
        check_target(target)
        biases = self.average(windows.astype(np.float64))
        return biases, np.full(biases.shape, np.nan)

    def average(self, windows: NDArray[np.float64]) -> NDArray[np.float64]:
        """(n, gyroscopes, samples) to (n, gyroscopes)."""
        raise NotImplementedError


class Median(_RobustMean):
    """The median of the window."""

    def average(self, windows: NDArray[np.float64]) -> NDArray[np.float64]:
        """See the class."""
        return np.asarray(np.median(windows, axis=-1))


class TrimmedMean(_RobustMean):
    """The mean of the window without its lowest and its highest 10 % of samples."""

    cut: ClassVar[float] = 0.1

    def average(self, windows: NDArray[np.float64]) -> NDArray[np.float64]:
        """See the class."""
        return np.asarray(stats.trim_mean(windows, self.cut, axis=-1))
