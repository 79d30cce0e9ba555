"""Prediction of a device's next bias from its past calibrations.

From one recording to the next the bias walks, and each power-on adds its turn-on deviation:

    bias of recording i = level_i + deviation_i,    level_(i + 1) = level_i + step

with a step of standard deviation D per recording number and a deviation of standard deviation tau
(a local-level model). A calibration, the mean of a recording, adds its averaging noise. The prior
of a recording is the conditional distribution of its bias given the calibrations before it, with an
unknown first level (kriging). With D = 0 its mean is that of the calibrations, and its spread tau.
"""

from dataclasses import dataclass, replace
from typing import Self

import numpy as np
import scipy
from numpy.typing import NDArray

from gyro_pipeline.physics.recording_model import RecordingModel

_FEWEST_PAST = 3  # a recording after fewer calibrations has the prior of all recordings


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
        step: D, deg/s.
        deviation: tau, deg/s.
    """

    numbers: NDArray[np.integer]
    labels: NDArray[np.float64]
    averaging: float
    step: float
    deviation: float

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
        scale = np.log(labels.std(ddof=1))

        def deviance(x: NDArray[np.float64]) -> float:
            history = cls(numbers, labels, averaging, *np.exp(x))
            whitening = np.linalg.inv(np.linalg.cholesky(history._covariance(numbers)))
            ones, y = whitening.sum(axis=1), whitening @ (labels - labels.mean())
            information = ones @ ones
            squares = y @ y - (ones @ y) ** 2 / information
            logs = -2 * np.log(np.diag(whitening)).sum() + np.log(information)
            return float(logs + squares - 2 * x[1])

        starts = [scale + np.array(start) for start in ((-1.0, -0.5), (-4.0, 0.0))]
        bounds = [(scale - 9, scale + 3)] * 2
        fits = [
            scipy.optimize.minimize(deviance, x, bounds=bounds, method="L-BFGS-B") for x in starts
        ]
        best = min(fits, key=lambda fit: fit.fun)
        return cls(numbers, labels, averaging, *map(float, np.exp(best.x)))

    def extended(self, numbers: NDArray[np.integer], labels: NDArray[np.float64]) -> Self:
        """The history with further calibrations, (n,) each, and unchanged D and tau."""
        merged = merged_calibrations(self.numbers, self.labels, numbers, labels)
        return replace(self, numbers=merged[0], labels=merged[1])

    def _covariance(self, numbers: NDArray[np.integer]) -> NDArray[np.float64]:
        """Covariance of labels about the unknown level of the first recording."""
        since = numbers - self.numbers[0]
        walk = self.step**2 * np.minimum(since[:, None], since[None, :])
        return walk + (self.deviation**2 + self.averaging) * np.eye(numbers.size)

    def prior(self, model: RecordingModel, recording: int | None) -> RecordingModel:
        """The model with the prior of a certain recording.

        Args:
            model: Model with the prior of any recording, which is kept if fewer than three
                calibrations precede the recording.
            recording: Number of the recording; None for the next one.
        """
        next_number = int(self.numbers[-1]) + 1 if recording is None else recording
        past = self.numbers < next_number
        if past.sum() < _FEWEST_PAST:
            return model
        # the warm-up's contribution to a label is the same for all, apart from its scatter
        offset = model.profiles(np.array([0, model.samples]))[0, 1:] @ model.mean[1:]
        numbers, labels = self.numbers[past], self.labels[past] - offset
        covariance = self._covariance(np.append(numbers, next_number))
        of_past, with_next = covariance[:-1, :-1], covariance[:-1, -1]
        solved = np.linalg.solve(of_past, np.column_stack([np.ones(numbers.size), with_next]))
        information = solved[:, 0].sum()
        level = solved[:, 0] @ labels / information
        mean = level + solved[:, 1] @ (labels - level)
        missing = 1 - solved[:, 1].sum()
        variance = covariance[-1, -1] - self.averaging - solved[:, 1] @ with_next
        variance += missing**2 / information
        prior_mean, prior_covariance = model.mean.copy(), np.diag(np.diag(model.covariance))
        prior_mean[0], prior_covariance[0, 0] = mean, variance
        return replace(model, mean=prior_mean, covariance=prior_covariance)
