"""The truths that estimates are compared with, and the running mean's error against each."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike, NDArray

from gyro_pipeline.conventions import ALL, AXES, DISJOINT, FIRST, PAPER, TRUE
from gyro_pipeline.physics.allan import NoiseFigures
from gyro_pipeline.physics.recording_model import outside_noise
from gyro_pipeline.windows import usable_starts

CURVE_STEP_S = 0.25
"""Resolution of the running-mean curve; the equivalent time is interpolated between points."""

LAST_DISJOINT_FRACTION = 0.75
"""The disjoint curve ends at this fraction of a recording; the rest would be too short a truth."""


@dataclass(frozen=True)
class TestRecording:
    """A recording of a tested IMU, with its truths.

    Attributes:
        number: Recording number.
        samples: Shape (3, n), deg/s; NaN where masked.
        rate_hz: Sample rate, Hz.
        noise: N, B and K of each axis from training recordings, or the simulated values.
        true_bias: Simulated bias, shape (3,), deg/s; None for measured data.
        imu: Number of the IMU.
        starts: First samples of the test windows, in order.
    """

    number: int
    samples: np.ndarray
    rate_hz: float
    noise: tuple[NoiseFigures, ...]
    true_bias: np.ndarray | None
    imu: int
    starts: np.ndarray

    @cached_property
    def running_sums(self) -> np.ndarray:
        """Sum of the unmasked ones among the first i samples, float64, shape (3, n + 1)."""
        sums = np.cumsum(np.where(self.masked, 0, self.samples), axis=-1, dtype=np.float64)
        return np.concatenate([np.zeros((len(AXES), 1)), sums], axis=-1)

    @cached_property
    def running_counts(self) -> np.ndarray:
        """Number of unmasked ones among the first i samples, shape (n + 1,)."""
        return np.concatenate([[0], np.cumsum(~self.masked)])

    @cached_property
    def masked(self) -> np.ndarray:
        """Whether each sample is masked, shape (n,)."""
        return np.isnan(self.samples).any(axis=0)

    @property
    def mean(self) -> np.ndarray:
        """Mean of the whole recording, shape (3,), deg/s."""
        return self.running_sums[:, -1] / self.running_counts[-1]

    def window_sums(self, starts: np.ndarray, size: int) -> tuple[np.ndarray, np.ndarray]:
        """Sums of windows, (windows, 3), and counts of their unmasked samples, (windows, 1)."""
        sums, counts = (
            running[..., starts + size] - running[..., starts]
            for running in (self.running_sums, self.running_counts)
        )
        return sums.T, counts[:, None]

    def window_means(self, starts: np.ndarray, size: int) -> np.ndarray:
        """Means of windows, shape (windows, 3), deg/s."""
        sums, counts = self.window_sums(starts, size)
        return sums / counts

    def truths(self, starts: np.ndarray, size: int) -> dict[str, tuple[np.ndarray, np.ndarray]]:
        """The truths for every window, with the variance of each truth.

        ``PAPER``, the mean of the whole recording, counts as exact (the paper's definition).
        ``DISJOINT``, the mean of the samples outside the window, has averaging noise of variance
        N^2 / (T - T0) if the noise is white. This variance is to be subtracted from the squared
        error, which still contains the covariance of window and truth if the noise is coloured.
        ``TRUE`` is the bias of simulated data.

        Args:
            starts: First samples of the windows.
            size: Samples per window.

        Returns:
            For each truth its value in deg/s and its variance in (deg/s)^2, both (windows, 3).
        """
        n = self.samples.shape[-1]
        sums, counts = self.window_sums(starts, size)
        exact = np.zeros(sums.shape)
        truths = {PAPER: (np.broadcast_to(self.mean, sums.shape), exact)}
        if size < n:
            white = not any(axis.instability or axis.random_walk for axis in self.noise)
            variance = [
                [outside_noise(axis, n, self.rate_hz, start, size) for axis in self.noise]
                for start in (starts[:1] if white else starts).tolist()  # if white, all are equal
            ] or exact
            outside = (self.running_sums[:, -1] - sums) / (self.running_counts[-1] - counts)
            truths[DISJOINT] = (outside, np.broadcast_to(variance, sums.shape))
        if self.true_bias is not None:
            truths[TRUE] = (np.broadcast_to(self.true_bias, sums.shape), exact)
        return truths


Columns = Mapping[str, NDArray[Any]]
"""Arrays of equal length, by column name."""


def error_columns(
    recording: TestRecording,
    truth: str,
    value_and_variance: tuple[np.ndarray, np.ndarray],
    estimates: np.ndarray,
    sigma: ArrayLike,
) -> Columns:
    """Errors of the estimates on one recording against one truth, a row per window and axis.

    Args:
        recording: The recording.
        truth: Name of the truth.
        value_and_variance: From :meth:`TestRecording.truths`.
        estimates: Estimates for all test windows, shape (windows, 3), deg/s.
        sigma: The standard deviations that the estimator states, same shape, or NaN
            for none.

    Returns:
        Columns ``imu, recording, window, start, axis, truth, error_dps, truth_variance,
        sigma_dps``; :func:`stack_columns` concatenates several such results.
    """
    value, variance = value_and_variance
    n = len(estimates)
    rows = n * len(AXES)
    return {
        "imu": np.full(rows, recording.imu),
        "recording": np.full(rows, recording.number),
        "window": np.repeat(np.arange(n), len(AXES)),
        "start": np.repeat(recording.starts, len(AXES)),
        "axis": np.tile(AXES, n),
        "truth": np.full(rows, truth),
        "error_dps": (estimates - value).ravel(),
        "truth_variance": variance.ravel(),
        "sigma_dps": np.ravel(np.broadcast_to(sigma, estimates.shape)),
    }


def stack_columns(parts: Sequence[Columns]) -> pd.DataFrame:
    """Concatenate columns to a table; much faster than concatenating tables."""
    return pd.DataFrame({name: np.concatenate([part[name] for part in parts]) for name in parts[0]})


def running_mean_curve(recording: TestRecording, size: int) -> pd.DataFrame:
    """Squared error of the running mean against its length, for one recording.

    Args:
        recording: The recording that is averaged.
        size: Samples of the study's window; the curve has a point at exactly this length.

    Returns:
        Columns ``imu, recording, truth, windows`` (``first`` or ``all``), ``time_s``, ``sum_sq``
        in (deg/s)^2 less the variance of the truth, and ``count``, the number of squares.
    """
    n = recording.samples.shape[-1]
    step = max(1, round(CURVE_STEP_S * recording.rate_hz))
    rows = []
    for length in np.unique([*range(step, n, step), size, n]).tolist():
        starts = usable_starts(recording.masked, length)
        estimates = recording.window_means(starts, length)
        time_s = length / recording.rate_hz
        for truth, (value, variance) in recording.truths(starts, length).items():
            if truth == DISJOINT and length > LAST_DISJOINT_FRACTION * n:
                continue
            squares = (estimates - value) ** 2 - variance
            for windows, part in ((FIRST, squares[:1]), (ALL, squares)):
                labels = recording.imu, recording.number, truth, windows
                rows.append((*labels, time_s, part.sum(), part.size))
    columns = ["imu", "recording", "truth", "windows", "time_s", "sum_sq", "count"]
    return pd.DataFrame(rows, columns=columns)
