"""Prediction of a device's next bias from its past calibrations.

From one recording to the next the bias walks, and each power-on adds its turn-on deviation:

    bias of recording i = level_i + deviation_i,    level_(i + 1) = level_i + step

with a step of standard deviation D per recording number and a deviation of standard deviation tau
(a local-level model). A calibration, the mean of a recording, adds its averaging noise. The prior
of a recording is the conditional distribution of its bias given the calibrations before it, by a
Kalman filter that starts with an unknown level. With D = 0 its mean is that of the calibrations,
and its spread tau.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any, NamedTuple, Self

import numpy as np
import scipy
from numpy.typing import NDArray

from gyro_pipeline.physics.recording_model import RecordingModel

_FEWEST_PAST = 3  # a recording after fewer calibrations has the prior of all recordings
_GRID = 41  # values of D and of tau in the grid of their posterior


def merged_calibrations(
    numbers: NDArray[np.integer],
    labels: NDArray[np.float64],
    more_numbers: NDArray[np.integer],
    more_labels: NDArray[np.float64],
) -> tuple[NDArray[np.integer], NDArray[np.float64]]:
    """Merge two sets of calibrations by recording number, each recording once.

    Args:
        numbers: Numbers of the recordings, (n,).
        labels: Their means, (n, ...), deg/s.
        more_numbers: Numbers of the second set, (m,).
        more_labels: Means of the second set, (m, ...), deg/s.
    """
    merged, first = np.unique(np.concatenate([numbers, more_numbers]), return_index=True)
    return merged, np.concatenate([labels, more_labels])[first]


@dataclass(frozen=True)
class BiasHistory:
    """Calibrations of a gyroscope, in order, and the parameters of its bias.

    Attributes:
        numbers: Numbers of the recordings, (n,), increasing.
        labels: Their means, (n,), deg/s.
        averaging: Averaging noise of a label, (deg/s)^2.
        step: D, deg/s; or an array of n values, as from :meth:`draws`.
        deviation: tau, deg/s; or an array of n values.
    """

    numbers: NDArray[np.integer]
    labels: NDArray[np.float64]
    averaging: float
    step: Any
    deviation: Any

    @classmethod
    def fit(
        cls, numbers: NDArray[np.integer], labels: NDArray[np.float64], model: RecordingModel
    ) -> Self:
        """Fit D and tau by restricted maximum likelihood, with tau's weak prior.

        Args:
            numbers: Numbers of the recordings, (n,), increasing.
            labels: Their means, (n,), deg/s.
            model: Model of a recording; its noise determines the averaging noise of a label.
        """
        edges = np.array([0, model.samples])
        averaging = float(model.noise_covariance(edges)[0, 0])
        if model.mean.size > 1:  # the label includes the warm-up, whose amplitude varies
            averaging += float(model.profiles(edges)[0, 1] ** 2 * model.covariance[1, 1])
        history = cls(numbers, labels, averaging, 0.0, 0.0)
        scale, bounds = np.log(labels.std(ddof=1)), history._bounds
        starts = [scale + np.array(start) for start in ((-1.0, -0.5), (-4.0, 0.0))]
        fits = [
            scipy.optimize.minimize(
                lambda x: history._with(*x)._deviance(), x, bounds=[bounds] * 2, method="L-BFGS-B"
            )
            for x in starts
        ]
        best = min(fits, key=lambda fit: fit.fun)
        return history._with(*map(float, best.x))

    def draws(self, count: int, seed: int) -> Self:
        """The history with draws of D and tau from their posterior given the labels.

        The prior is flat in tau and in the logarithm of D, within the bounds of :meth:`fit`.

        Args:
            count: Number of draws.
            seed: Seed of the draws.
        """
        grid = np.linspace(*self._bounds, _GRID)
        logs = np.array([axis.ravel() for axis in np.meshgrid(grid, grid)])
        deviance = self._with(*logs)._deviance()
        weights = np.exp((deviance.min() - deviance) / 2)
        generator = np.random.default_rng(seed)
        chosen = generator.choice(weights.size, count, p=weights / weights.sum())
        return self._with(*logs[:, chosen])

    @property
    def _bounds(self) -> tuple[float, float]:
        """Bounds of the logarithms of D and tau."""
        scale = float(np.log(self.labels.std(ddof=1)))
        return scale - 9, scale + 3

    def _with(self, log_step: Any, log_deviation: Any) -> Self:
        return replace(self, step=np.exp(log_step), deviation=np.exp(log_deviation))

    def extended(self, numbers: NDArray[np.integer], labels: NDArray[np.float64]) -> Self:
        """The history with further calibrations, (n,) each, and unchanged D and tau."""
        merged = merged_calibrations(self.numbers, self.labels, numbers, labels)
        return replace(self, numbers=merged[0], labels=merged[1])

    def _deviance(self) -> Any:
        """-2 log of the restricted likelihood, with tau's prior, up to a constant."""
        return sum(step.deviance for step in self._levels()) - 2 * np.log(self.deviation)

    def _levels(self) -> Iterator["_Level"]:
        """The level after each calibration, given this and the earlier ones."""
        scatter = self.deviation**2 + self.averaging
        level = _Level(self.labels[0], scatter, 0.0)
        yield level
        gaps = np.diff(self.numbers).tolist()
        for gap, label in zip(gaps, self.labels[1:].tolist(), strict=True):
            predicted = level.variance + gap * self.step**2
            total, off = predicted + scatter, label - level.mean
            level = _Level(
                mean=level.mean + predicted / total * off,
                variance=predicted / total * scatter,
                deviance=np.log(total) + off**2 / total,
            )
            yield level

    def next_bias(self, recording: int) -> tuple[Any, Any] | None:
        """Mean and variance of the bias of a recording given the calibrations before it.

        The means are those of labels, with the contribution of a warm-up.

        Args:
            recording: Number of the recording.

        Returns:
            deg/s and (deg/s)^2; None after fewer than three calibrations.
        """
        past = self.numbers < recording
        if past.sum() < _FEWEST_PAST:
            return None
        *_, level = replace(self, numbers=self.numbers[past], labels=self.labels[past])._levels()
        gap = recording - int(self.numbers[past][-1])
        return level.mean, level.variance + gap * self.step**2 + self.deviation**2

    def prior(self, model: RecordingModel, recording: int | None) -> RecordingModel:
        """The model with the prior of a certain recording.

        Args:
            model: Model with the prior of any recording, which is kept if fewer than three
                calibrations precede the recording.
            recording: Number of the recording; None for the next one.
        """
        bias = self.next_bias(int(self.numbers[-1]) + 1 if recording is None else recording)
        if bias is None:
            return model
        # the warm-up's contribution to a label is the same for all, apart from its scatter
        offset = model.profiles(np.array([0, model.samples]))[0, 1:] @ model.mean[1:]
        mean, covariance = model.mean.copy(), np.diag(np.diag(model.covariance))
        mean[0], covariance[0, 0] = bias[0] - offset, bias[1]
        return replace(model, mean=mean, covariance=covariance)


class _Level(NamedTuple):
    """The level given the calibrations up to one of them."""

    mean: Any  # deg/s
    variance: Any  # (deg/s)^2
    deviance: Any  # -2 log of the likelihood of the calibration given those before it
