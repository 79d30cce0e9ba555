"""Ceilings: the least expected errors on a device, and their premises."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from gyro_pipeline.conventions import DISJOINT, FIRST, PAPER
from gyro_pipeline.physics.ceiling import (
    best_gain,
    best_saving,
    ceiling_rmse,
    pooled,
    running_mean_rmse,
)
from gyro_pipeline.physics.recording_model import RecordingModel, joint_squares, mean_squares
from gyro_pipeline.pipelines.evaluation.device import TestDevice
from gyro_pipeline.scoring.scores import CONFIDENCE_PCT, Estimate, WeightedCurve

PREMISE = "linear, axis by axis, recordings exchangeable, no history"
"""Premise of the ceiling on measured data; where it does not hold, estimators can be better."""

_CURVE_POINTS = 30  # of the expected running mean, to interpolate between


@dataclass(frozen=True)
class Ceilings:
    """Least expected errors on a device, for windows of one length."""

    device: TestDevice  # the tested device
    # distinct models by axis and time constant, unless noise is white without warm-up
    distinct_models: Sequence[tuple[int, RecordingModel]]
    size: int  # samples of a window
    samples: int  # samples of a recording
    rate_hz: float  # samples per second

    @property
    def basis(self) -> str:
        """The basis of the ceilings, in words."""
        if self.device.unit_bias is None:
            noise = "white noise" if self.device.models is None else "fitted N, B and K"
            return f"estimated from recordings, {noise}; {PREMISE}"
        if self.device.models is not None and len(self.distinct_models) > len(self.device.models):
            return (
                "drawn values, the time constant of each warm-up among them: an estimator that "
                "must learn it from the window cannot be as good"
            )
        return "drawn values"

    def of(self, truth: str, windows: str) -> dict[str, Estimate]:
        """RMSE, A and, for the paper's truth, S of the best; also joint over axes and with history.

        On measured data intervals follow from the uncertainty of the turn-on spread. For the mean
        outside the window the result is empty if noise is coloured or a bias warms up: estimators
        estimate the bias, from which that mean then differs.

        Args:
            truth: PAPER, DISJOINT or TRUE.
            windows: ``first`` or ``all``.
        """
        if truth == DISJOINT and self.device.models is not None:
            return {}
        if (truth, windows) not in self._cache:
            self._cache[truth, windows] = self._of(truth, windows)
        return self._cache[truth, windows]

    @cached_property
    def _cache(self) -> dict[tuple[str, str], dict[str, Estimate]]:
        return {}

    def _of(self, truth: str, windows: str) -> dict[str, Estimate]:
        device = self.device
        best, mean = self._expected(truth, windows, self.size, device.spread**2)
        if mean.min() <= 0:
            return {}
        ratio = np.sqrt(best / mean)
        limits = {
            "ceiling_rmse_dps": with_draws(np.sqrt(best)),
            "ceiling_accuracy_gain_pct": with_draws(100 * best_gain(ratio)),
        }
        if truth == PAPER:
            saving = 100 * self._saving(windows, ratio, np.sqrt(best))
            limits["ceiling_time_saving_pct"] = with_draws(saving)
        others = {}
        if device.joint is not None:
            assert device.models is not None
            starts = self._starts(windows, self.size)
            squares = [
                joint_squares(device.models, start, self.size, truth, device.joint)
                for start in starts
            ]
            others["joint"] = np.mean(squares, axis=0), mean[0]
        if device.given_earlier is not None:
            others["history"] = self._expected(truth, windows, self.size, device.given_earlier)
        for name, (square, mean_square) in others.items():
            limits[f"ceiling_{name}_rmse_dps"] = with_draws(np.sqrt(square))
            gain = 100 * best_gain(np.sqrt(square / mean_square))
            limits[f"ceiling_{name}_accuracy_gain_pct"] = with_draws(gain)
        return limits

    def _starts(self, windows: str, size: int) -> range:
        starts = range(0, self.samples - size + 1, size)
        return starts[:1] if windows == FIRST else starts

    def _expected(
        self, truth: str, windows: str, size: int, variances: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Mean squares of the best estimate and the running mean over axes and windows.

        Args:
            truth: PAPER, DISJOINT or TRUE.
            windows: ``first`` or ``all``.
            size: Samples of the window.
            variances: Prior variances of the bias, (n, axes), (deg/s)^2.

        Returns:
            Two arrays (n,), (deg/s)^2.
        """
        device = self.device
        if device.models is None:
            times = size / self.rate_hz, self.samples / self.rate_hz
            best = pooled(ceiling_rmse(device.noise, np.sqrt(variances), *times, truth)) ** 2
            mean = pooled(running_mean_rmse(device.noise, *times, truth)) ** 2
            return best, np.full(best.shape, mean)
        squares = [
            mean_squares(model, start, size, truth, covariances=_priors(model, variances[:, axis]))
            for axis, model in self.distinct_models
            for start in self._starts(windows, size)
        ]
        best, mean = np.mean(squares, axis=0)
        return best, mean

    def _saving(self, windows: str, ratio: np.ndarray, limit: np.ndarray) -> np.ndarray:
        """1 - T0 / t*, where the running mean of t* has the expected error ``limit``."""
        if self.device.models is None:
            return best_saving(ratio, self.size / self.samples)
        sizes = np.unique(np.geomspace(self.size, self.samples, _CURVE_POINTS).astype(int))
        first = self.device.spread[:1] ** 2
        # 0 for the whole recording, except rounding
        curve = [max(self._expected(PAPER, windows, int(n), first)[1][0], 0.0) for n in sizes]
        falling = WeightedCurve(sizes.astype(float), np.sqrt([curve]), np.ones(sizes.size)).falling
        reached = np.interp(-limit, -falling, sizes)
        return 1 - self.size / reached


def _priors(model: RecordingModel, variances: np.ndarray) -> np.ndarray:
    """Prior covariances of a model for several variances of the bias, (n, k, k)."""
    covariances = np.repeat(model.covariance[None], len(variances), axis=0)
    covariances[:, 0, 0] = variances
    return covariances


def with_draws(values: np.ndarray) -> Estimate:
    """The first value, with the central 95 % of any others as its interval."""
    if len(values) == 1:
        return Estimate(float(values[0]))
    tails = 50 + np.array([-CONFIDENCE_PCT, CONFIDENCE_PCT]) / 2
    return Estimate(float(values[0]), *map(float, np.percentile(values[1:], tails)))
