"""Estimators with a prior from past recordings: constant, last calibration, empirical Bayes."""

import copy

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gyro_pipeline.conventions import BIAS, REAL, RECORDING_MEAN
from gyro_pipeline.estimators.base import Estimator, Windows
from gyro_pipeline.estimators.training_set import TrainingSet, fitted_noise
from gyro_pipeline.physics.history import merged_calibrations
from gyro_pipeline.physics.reml import FEWEST_RECORDINGS
from gyro_pipeline.physics.turn_on import guarded_spread


class TrainingMean(Estimator):
    """The mean of the training recordings' means: a constant that ignores the window.

    For an unseen device it is the mean of the other devices, which is useless, as it should be.
    """

    uses_prior = True

    def _fit(self, training: TrainingSet) -> None:
        self._noise = training.white_noise
        self._labels = training.labels[1]

    def _estimate(self, windows: Windows) -> tuple[ArrayLike, ArrayLike]:
        biases, share = self.constant(windows.recording)
        scatter = self._labels.var(axis=0, ddof=1) if len(self._labels) > 1 else np.nan
        averaging = self._noise**2 / self._recording_s if windows.target == BIAS else 0.0
        return biases, np.sqrt(np.maximum(scatter - averaging, 0.0) + share * scatter)

    def constant(self, recording: int | None) -> tuple[NDArray[np.float64], float]:
        """The estimate (3,), deg/s, and its variance in units of the scatter of the labels."""
        return self._labels.mean(axis=0), 1 / len(self._labels)


class LastCalibration(TrainingMean):
    """The mean of the device's preceding recording: its last stored calibration.

    Without an earlier recording, and for an unseen device, it is the training mean. Sigma assumes
    that power-ons are independent.
    """

    def _fit(self, training: TrainingSet) -> None:
        super()._fit(training)
        self._calibrations = training.labels if training.seen else None

    def with_calibrations(
        self, numbers: NDArray[np.integer], labels: NDArray[np.float64]
    ) -> Estimator:
        """See :meth:`Estimator.with_calibrations`."""
        updated = copy.copy(self)
        if self._calibrations is not None:
            updated._calibrations = merged_calibrations(*self._calibrations, numbers, labels)
        return updated

    def constant(self, recording: int | None) -> tuple[NDArray[np.float64], float]:
        """See :meth:`TrainingMean.constant`."""
        if self._calibrations is not None:
            numbers, labels = self._calibrations
            past = numbers < (np.inf if recording is None else recording)
            if past.any():
                return labels[past][-1], 1.0
        return super().constant(recording)


class EmpiricalBayes(Estimator):
    """The posterior mean of the bias under a prior learned from training recordings.

    The bias of a power-on is Normal(mu, tau^2) and the noise white. With N from the Allan fit, mu
    the mean of the n training labels and P = tau^2 + (tau^2 + N^2 / T) / n, the prior variance of
    the next bias including the uncertainty of mu,

        bias = mu + beta (m - mu),    beta = P / (P + N^2 / T0)

    and the mean of the recording is r m + (1 - r) times that, r = T0 / T (Efron & Morris 1973; see
    :mod:`gyro_pipeline.physics.ceiling`). With few recordings tau may be 0 by chance, and every
    estimate would be mu; therefore tau has a weak prior (:mod:`gyro_pipeline.physics.turn_on`).
    Sigma is too small where noise is not white.

    The prior of an unseen device is the mean and spread of the means of the known devices. With
    fewer than three labels the prior is flat, and the estimate is the running mean.
    """

    recommended = True
    uses_prior = True

    def _fit(self, training: TrainingSet) -> None:
        self._noise = training.white_noise
        labels, averaging = self._labels(training)
        self._mean = labels.mean(axis=0)
        scatter = self._spread(training, labels, averaging) ** 2
        self._prior = scatter + (scatter + averaging) / len(labels)

    def _labels(self, training: TrainingSet) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Labels of the prior (n, 3), recordings or devices, and their averaging variance (3,)."""
        if training.seen:
            return training.labels[1], self._noise**2 / self._recording_s
        means = np.stack([imu.means.mean(axis=0) for imu in training.known_imus])
        return means, np.zeros(len(self._noise))

    def _spread(
        self, training: TrainingSet, labels: NDArray[np.float64], averaging: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """The tau of each axis, (3,)."""
        if len(labels) < FEWEST_RECORDINGS:
            return np.full(averaging.shape, np.inf)
        scatter, freedom = labels.var(axis=0) * len(labels), len(labels) - 1
        groups = zip(scatter, averaging, strict=True)
        return np.array([guarded_spread(square, freedom, v) for square, v in groups])

    def _estimate(self, windows: Windows) -> tuple[ArrayLike, ArrayLike]:
        means = windows.samples.mean(axis=-1, dtype=np.float64)
        window_s = windows.samples.shape[-1] / self._rate_hz
        averaging = self._noise**2 / window_s
        beta = 1 / (1 + averaging / self._prior)
        r = window_s / self._recording_s if windows.target == RECORDING_MEAN else 0.0
        variance = (1 - r) ** 2 * beta * averaging
        if windows.target == RECORDING_MEAN:  # noise of the samples outside the window
            variance += (1 - r) * self._noise**2 / self._recording_s
        biases = r * means + (1 - r) * (self._mean + beta * (means - self._mean))
        return biases, np.sqrt(variance)


class PooledEmpiricalBayes(EmpiricalBayes):
    """Empirical Bayes with the same tau for all axes and IMUs; each axis has its mu.

    It is better where they are alike, and worse where they are not, as on the public Memsense
    recordings.
    """

    uses = REAL
    recommended = False

    def _spread(
        self, training: TrainingSet, labels: NDArray[np.float64], averaging: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        if not training.seen:
            return super()._spread(training, labels, averaging)
        scatter, freedom, noise = [], [], []
        for imu in training.imus.values():
            white = np.array([figures.white for figures in fitted_noise([imu])])
            scatter.append(imu.means.var(axis=0) * len(imu.means))
            freedom.append(np.full(len(white), len(imu.means) - 1))
            noise.append(white**2 / self._recording_s)
        if np.sum(freedom) < FEWEST_RECORDINGS - 1:
            return np.full(averaging.shape, np.inf)
        spread = guarded_spread(*map(np.concatenate, (scatter, freedom, noise)))
        return np.full(averaging.shape, spread)
