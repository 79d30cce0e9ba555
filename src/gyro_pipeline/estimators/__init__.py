"""Estimators: a window in, a bias out."""

from typing import Protocol

import numpy as np


class Estimator(Protocol):
    """Anything that estimates biases from windows."""

    def estimate(self, windows: np.ndarray) -> np.ndarray:
        """Biases of the gyroscopes seen side by side.

        Args:
            windows: Shape (n, gyroscopes, samples), deg/s.

        Returns:
            Shape (n, gyroscopes), deg/s.
        """


class RunningMean:
    """Zero-order calibration: the mean of the window (paper, section II)."""

    def estimate(self, windows: np.ndarray) -> np.ndarray:
        """See :class:`Estimator`; sums are in float64."""
        return windows.mean(axis=-1, dtype=np.float64)
