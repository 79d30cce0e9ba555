"""Estimators that use the window alone."""

from typing import ClassVar

import numpy as np
import scipy
from numpy.typing import ArrayLike, NDArray

from gyro_pipeline.conventions import NOTHING, RECORDING_MEAN
from gyro_pipeline.estimators.base import Estimator, Windows
from gyro_pipeline.estimators.training_set import TrainingSet


class RunningMean(Estimator):
    """Zero-order calibration: the mean of the window (paper, section II), the running mean.

    Sums are in float64. It can be used without ``fit``, which only sets sigma: N / sqrt(T0) for the
    bias and N sqrt(1 / T0 - 1 / T) for the mean of the recording, if the noise is white.
    """

    _noise: NDArray[np.float64] | float = np.nan

    def _fit(self, training: TrainingSet) -> None:
        self._noise = training.white_noise

    def _estimate(self, windows: Windows) -> tuple[ArrayLike, ArrayLike]:
        window_s = windows.samples.shape[-1] / self._rate_hz
        rest = 1 / self._recording_s if windows.target == RECORDING_MEAN else 0.0
        sigma = self._noise * np.sqrt(np.maximum(1 / window_s - rest, 0.0))
        return windows.samples.mean(axis=-1, dtype=np.float64), sigma


class Median(Estimator):
    """The median of the window, which single outliers do not move. Its sigma is unknown."""

    uses = NOTHING
    fewest_recordings = 0

    def _estimate(self, windows: Windows) -> tuple[ArrayLike, ArrayLike]:
        return np.median(windows.samples.astype(np.float64), axis=-1), np.nan


class TrimmedMean(Estimator):
    """The mean of the window without its lowest and its highest 10 % of samples; no sigma."""

    uses = NOTHING
    fewest_recordings = 0
    cut: ClassVar[float] = 0.1

    def _estimate(self, windows: Windows) -> tuple[ArrayLike, ArrayLike]:
        return scipy.stats.trim_mean(windows.samples.astype(np.float64), self.cut, axis=-1), np.nan
