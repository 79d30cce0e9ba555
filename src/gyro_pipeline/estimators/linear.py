"""Linear estimators on block means: the best linear predictor, and ridge regression."""

from dataclasses import replace
from typing import ClassVar, Self

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike, NDArray

from gyro_pipeline.conventions import BIAS, PAPER, RECORDING_MEAN, TEST_IMU, TRUE, InputError
from gyro_pipeline.estimators.base import (
    Estimates,
    check_target,
    known_imus,
    labels_of,
    samples_of,
)
from gyro_pipeline.estimators.noise import allan_fit
from gyro_pipeline.physics.allan import NoiseFigures
from gyro_pipeline.physics.history import BiasHistory
from gyro_pipeline.physics.recording_model import (
    BLOCK_S,
    LinearEstimate,
    RecordingModel,
    best_linear,
    block_edges,
    block_means,
)
from gyro_pipeline.physics.reml import FEWEST_RECORDINGS, fit_recording_model

_FLAT = 1e6
"""Prior standard deviation that tells nothing, in units of the noise of a whole recording."""


class BestLinear:
    """The best linear predictor under the fitted noise and prior, axis by axis.

    White noise, bias instability, rate random walk, the turn-on spread and, if asked for, a
    warm-up of random amplitude are fitted to whole training recordings
    (:mod:`gyro_pipeline.physics.reml`). The estimate of either target is its conditional mean
    given the block means of the window (:mod:`gyro_pipeline.physics.recording_model`), with the
    uncertainty of what was learned of the prior mean in it. On white noise this is empirical
    Bayes; sigma holds on coloured noise as well. ``start_s`` matters: give it.

    The bias is the settled one, without the warm-up and the random walk since power-on.

    An unseen device has the mean noise of the known ones, and their mean and spread as its prior.
    Where fewer than three are known, the prior is flat.

    Args:
        warm_up: Whether the sensor warms up.
        noise: ``"reml"``: N, B and K fitted together with the prior; ``"allan"``: from the Allan
            fit, which does not know of warm-up.
        history: Whether the prior of a recording follows from the device's calibrations before
            it, in their order (:mod:`gyro_pipeline.physics.history`). For a bias that drifts from
            one recording to the next.
    """

    recommended: ClassVar[bool] = True
    uses_prior: ClassVar[bool] = True

    def __init__(self, warm_up: bool = False, noise: str = "reml", history: bool = False) -> None:
        if noise not in ("reml", "allan"):
            raise InputError(f"noise: expected 'reml' or 'allan', got {noise!r}")
        self._warm_up, self._noise, self._history = warm_up, noise, history

    def fit(self, recordings: xr.Dataset, imu: int = TEST_IMU) -> Self:
        """See :class:`~gyro_pipeline.estimators.FittedEstimator`.

        Raises:
            InputError: Fewer than three training recordings of a device.
        """
        known = known_imus(recordings, imu)
        devices = [self._models(recordings, one) for one in known]
        seen = known == [imu]
        self._axes = (
            devices[0] if seen else [_unseen(models) for models in zip(*devices, strict=True)]
        )
        self._histories: list[BiasHistory] | None = None
        if self._history and seen:
            numbers, labels = labels_of(recordings, imu)
            self._histories = [
                BiasHistory.fit(numbers, labels[:, a], model) for a, model in enumerate(self._axes)
            ]
        self._estimates: dict[tuple[int, int, int, str, int | None], LinearEstimate] = {}
        return self

    def _models(self, recordings: xr.Dataset, imu: int) -> list[RecordingModel]:
        rates, rate_hz = samples_of(recordings, imu), float(recordings.attrs["rate_hz"])
        axes = range(rates.shape[1])
        known: list[NoiseFigures | None] = [None for _ in axes]
        if self._noise == "allan":
            known = [*allan_fit(recordings, imu)]
        return [fit_recording_model(rates[:, a], rate_hz, self._warm_up, known[a]) for a in axes]

    def estimate(
        self,
        windows: NDArray[np.floating],
        target: str = BIAS,
        start_s: ArrayLike = 0.0,
        recording: int | None = None,
    ) -> Estimates:
        """See :class:`~gyro_pipeline.estimators.Estimator`."""
        check_target(target)
        rate_hz, size = self._axes[0].rate_hz, windows.shape[-1]
        starts = np.broadcast_to(np.rint(np.asarray(start_s) * rate_hz).astype(int), len(windows))
        biases = np.empty(windows.shape[:2])
        sigma = np.empty(windows.shape[:2])
        for start in np.unique(starts):
            chosen = starts == start
            for axis in range(windows.shape[1]):
                best = self._best(axis, int(start), size, target, recording)
                biases[chosen, axis] = best(windows[chosen, axis])
                sigma[chosen, axis] = np.sqrt(best.variance)
        return biases, sigma

    def _best(
        self, axis: int, start: int, size: int, target: str, recording: int | None
    ) -> LinearEstimate:
        """Weights for one axis and place of the window, worked out once."""
        key = axis, start, size, target, recording if self._histories else None
        if key not in self._estimates:
            model = self._axes[axis]
            if self._histories:
                model = self._histories[axis].prior(model, recording)
            truth = PAPER if target == RECORDING_MEAN else TRUE
            self._estimates[key] = best_linear(model, start, size, truth)
        return self._estimates[key]


def _unseen(devices: tuple[RecordingModel, ...]) -> RecordingModel:
    """The model of a device of the same kind as some that are known, for one axis."""
    first = devices[0]
    figures = np.array([[d.noise.white, d.noise.instability, d.noise.random_walk] for d in devices])
    noise = NoiseFigures(*map(float, np.sqrt(np.mean(figures**2, axis=0))))
    means = np.stack([device.mean for device in devices])
    covariance = np.mean([device.covariance for device in devices], axis=0)
    if len(devices) < FEWEST_RECORDINGS:
        flat = _FLAT * noise.white * np.sqrt(first.rate_hz / first.samples)
        covariance = covariance + np.diag(flat**2 * np.eye(len(first.mean))[0])
    else:
        between = np.atleast_2d(np.cov(means, rowvar=False))
        covariance = covariance + between * (1 + 1 / len(devices))
    time_constant_s = float(np.mean([device.time_constant_s for device in devices]))
    return replace(
        first,
        noise=noise,
        mean=means.mean(axis=0),
        covariance=covariance,
        time_constant_s=time_constant_s,
    )


class Ridge:
    """Ridge regression of the target on the block means of the window.

    It knows no model: one regression per axis and place of the window, from training windows of
    the same time after power-on, towards the training mean. The penalty is the one with the least
    leave-one-recording-out error on the training recordings. The bias is learned from the mean of
    the samples outside the window. It has no sigma.
    """

    recommended: ClassVar[bool] = False
    uses_prior: ClassVar[bool] = True

    def fit(self, recordings: xr.Dataset, imu: int = TEST_IMU) -> Self:
        """See :class:`~gyro_pipeline.estimators.FittedEstimator`."""
        self._rate_hz = float(recordings.attrs["rate_hz"])
        known = [samples_of(recordings, one) for one in known_imus(recordings, imu)]
        self._rates = np.concatenate(known)
        self._means = self._rates.mean(axis=-1, dtype=np.float64)
        self._lines: dict[tuple[int, int, int, str], LinearEstimate] = {}
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
        size = windows.shape[-1]
        starts = np.broadcast_to(
            np.rint(np.asarray(start_s) * self._rate_hz).astype(int), len(windows)
        )
        biases = np.empty(windows.shape[:2])
        for start in np.unique(starts):
            chosen = starts == start
            for axis in range(windows.shape[1]):
                line = self._line(axis, int(start), size, target)
                biases[chosen, axis] = line(windows[chosen, axis])
        return biases, np.full(biases.shape, np.nan)

    def _line(self, axis: int, start: int, size: int, target: str) -> LinearEstimate:
        key = axis, start, size, target
        if key not in self._lines:
            edges = block_edges(size, round(BLOCK_S * self._rate_hz))
            blocks = block_means(self._rates[:, axis, start : start + size], edges)
            aim, samples = self._means[:, axis], self._rates.shape[-1]
            if target == BIAS:
                inside = blocks @ np.diff(edges)
                aim = (aim * samples - inside) / (samples - size)
            weights, constant = ridge_regression(blocks, aim)
            self._lines[key] = LinearEstimate(edges, weights, constant, np.nan)
        return self._lines[key]


def ridge_regression(
    inputs: NDArray[np.float64], aim: NDArray[np.float64]
) -> tuple[NDArray[np.float64], float]:
    """Ridge regression with the penalty of the least leave-one-out error.

    Args:
        inputs: (n, m).
        aim: (n,).

    Returns:
        Weights (m,) and the constant. The left-out errors are exact: residual / (1 - leverage)
        (Allen 1974, Technometrics 16).
    """
    middle, level = inputs.mean(axis=0), aim.mean()
    u, singular, vt = np.linalg.svd(inputs - middle, full_matrices=False)
    along = u.T @ (aim - level)
    penalties = singular.max() ** 2 * np.geomspace(1e-4, 1e4, 41)
    shrinkage = singular**2 / (singular**2 + penalties[:, None])  # (penalties, singular values)
    residuals = (aim - level) - shrinkage * along @ u.T
    leverage = shrinkage @ (u**2).T + 1 / len(aim)
    best = np.argmin(np.sum((residuals / (1 - leverage)) ** 2, axis=1))
    weights = vt.T @ (along * singular / (singular**2 + penalties[best]))
    return weights, float(level - weights @ middle)
