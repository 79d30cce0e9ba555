"""Linear estimators on block means: the best linear predictor, and ridge regression."""

import copy
from collections.abc import Sequence
from dataclasses import replace
from itertools import product
from typing import Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gyro_pipeline.conventions import BIAS, PAPER, RECORDING_MEAN, TRUE, InputError
from gyro_pipeline.estimators.base import Estimator, Windows
from gyro_pipeline.estimators.training_set import TrainingSet
from gyro_pipeline.physics.bias import windows_at
from gyro_pipeline.physics.history import BiasHistory
from gyro_pipeline.physics.mixture import mixture_posterior
from gyro_pipeline.physics.recording_model import (
    BLOCK_S,
    LinearEstimate,
    RecordingModel,
    WindowModel,
    block_edges,
    block_means,
    fitted_biases,
    joint_prior,
)
from gyro_pipeline.physics.reml import FEWEST_RECORDINGS, fit_recording_model
from gyro_pipeline.physics.turn_on import axes_are_correlated, joint_draws

_FLAT = 1e3
"""Standard deviation of a flat prior, deg/s."""

WIDE = 5e-3
"""Standard deviation of the wide prior of a fallback, deg/s: the Earth's rate and a margin."""

_PENALTIES, _FOLDS = 41, 10

_Key = tuple[int, int, int, str, int | None]
"""Axis, first sample, samples, target and number of the recording."""


class _Linear(Estimator):
    """Weighted sums of the block means of a window; weights depend on axis and start."""

    _by_start = True
    _by_recording = False
    """Whether the weights depend on when the window starts, and on which recording it is from."""
    _caches: ClassVar[tuple[str, ...]] = ("_lines",)

    def __getstate__(self) -> dict[str, Any]:
        """The state without cached weights."""
        return {name: {} if name in self._caches else v for name, v in vars(self).items()}

    def _fit(self, training: TrainingSet) -> None:
        self._lines: dict[_Key, LinearEstimate] = {}

    def _estimate(self, windows: Windows) -> tuple[ArrayLike, ArrayLike]:
        samples = windows.samples
        starts = np.rint(windows.start_s * self._rate_hz).astype(int) * self._by_start
        starts, which = np.unique(starts, return_inverse=True)
        shape = len(starts), samples.shape[1]
        number = windows.recording if self._by_recording else None
        lines = [
            self._cached_line(axis, start, samples.shape[-1], windows.target, number)
            for start in starts.tolist()
            for axis in range(shape[1])
        ]
        weights = np.stack([line.weights for line in lines]).reshape(*shape, -1)
        constants = np.reshape([line.constant for line in lines], shape)
        variance = np.reshape([line.variance for line in lines], shape)
        sigma = np.sqrt(np.maximum(variance, 0.0))  # 0 for a whole recording, except rounding
        means = block_means(samples, lines[0].edges)
        # a joint estimate has weights for the blocks of all axes
        means = means.reshape(len(means), -1, weights.shape[-1])
        return np.sum(means * weights[which], axis=-1) + constants[which], sigma[which]

    def _cached_line(self, *key: *_Key) -> LinearEstimate:
        if key not in self._lines:
            self._lines[key] = self._line(*key)
        return self._lines[key]

    def _line(
        self, axis: int, start: int, size: int, target: str, recording: int | None
    ) -> LinearEstimate:
        """The linear estimate of a window, by axis, start, size, target and recording."""
        raise NotImplementedError


class BestLinear(_Linear):
    """The best linear predictor under the fitted noise and prior.

    White noise, bias instability, rate random walk, the turn-on spread and, as an option, a warm-up
    of random amplitude are fitted to whole training recordings
    (:mod:`gyro_pipeline.physics.reml`). The estimate of either target is its conditional mean
    given the block means of the window (:mod:`gyro_pipeline.physics.recording_model`), including
    the uncertainty of the prior mean. On white noise this is empirical Bayes; sigma holds on
    coloured noise as well. The start of the window, ``start_s``, matters.

    The bias is the settled one, without the warm-up and the random walk since power-on.

    For an unseen device the model is fitted to the recordings of all known devices, whose spread is
    that from unit to unit. With fewer than three known devices the prior is flat.

    If the biases of the recordings are correlated between axes
    (:func:`gyro_pipeline.physics.turn_on.axes_are_correlated`), the estimate of an axis uses the
    windows of all axes. For an unseen device, with a history and with a fallback it does not.

    With a fallback, the prior is wrong with a probability of 5 %: it is then wide on some axes, as
    for a device that was turned or knocked (:mod:`gyro_pipeline.physics.mixture`). Each window
    weighs the estimates under both priors.

    Args:
        warm_up: Whether the sensor warms up; None: decided by its recordings.
        noise: ``"reml"``: N, B and K fitted together with the prior; ``"allan"``: from the Allan
            fit, which ignores a warm-up.
        history: Whether the prior of a recording follows from the earlier calibrations of the
            device, in their order (:mod:`gyro_pipeline.physics.history`), for a bias that drifts
            from one recording to the next.
        fallback: Whether the prior may be wrong; not together with ``history``.
    """

    uses_prior = True
    fewest_recordings = FEWEST_RECORDINGS
    _caches = ("_lines", "_priors", "_windows", "_widened_models")

    def __init__(
        self,
        warm_up: bool | None = False,
        noise: str = "reml",
        history: bool = False,
        fallback: bool = False,
    ) -> None:
        if history and fallback:
            raise InputError("fallback: expected no history; a prior that follows it is not tested")
        if noise not in ("reml", "allan"):
            raise InputError(f"noise: expected 'reml' or 'allan', got {noise!r}")
        self.recommended = noise == "reml"  # the Allan fit ignores a warm-up
        self._warm_up, self._allan, self._by_recording = warm_up, noise == "allan", history
        self._fallback = fallback

    def _fit(self, training: TrainingSet) -> None:
        super()._fit(training)
        axes = training.rates.swapaxes(0, 1)
        noise = training.noise_figures if self._allan else [None] * len(axes)
        self.models = [
            fit_recording_model(rates, training.rate_hz, self._warm_up, figures)
            for rates, figures in zip(axes, noise, strict=True)
        ]
        """The fitted model of each axis."""
        self._histories: list[BiasHistory] = []
        self._biases: NDArray[np.float64] | None = None  # their covariance, if it is joint
        if not training.seen:
            self.models = [_of_unseen(model, len(training.known_imus)) for model in self.models]
        elif self._by_recording:
            numbers, labels = training.labels
            self._histories = [
                BiasHistory.fit(numbers, means, model)
                for means, model in zip(labels.T, self.models, strict=True)
            ]
        elif not self._fallback:
            self._biases = _joint_covariance(self.models, axes)
        joint, history = self._biases is not None, bool(self._histories)
        self.own_ceiling = "joint" if joint else "history" if history else ""
        self._windows: dict[tuple[int, int, int, str], WindowModel] = {}
        self._forget()

    def _forget(self) -> None:
        """Clear what was computed from the priors."""
        self._lines = {}
        self._priors: dict[tuple[int, int | None], RecordingModel] = {}
        self._widened_models: dict[float, BestLinear] = {}

    def with_calibrations(
        self, numbers: NDArray[np.integer], labels: NDArray[np.float64]
    ) -> Estimator:
        """See :meth:`Estimator.with_calibrations`."""
        if not self._histories:
            return self
        updated = copy.copy(self)
        pairs = zip(self._histories, labels.T, strict=True)
        updated._histories = [history.extended(numbers, means) for history, means in pairs]
        updated._forget()
        return updated

    def _estimate(self, windows: Windows) -> tuple[ArrayLike, ArrayLike]:
        if not self._fallback:
            return super()._estimate(windows)
        narrow, wide, without_prior = (
            tuple(map(np.asarray, self._widened(spread)._estimate(replace(windows, target=target))))
            for spread, target in ((0.0, windows.target), (WIDE, windows.target), (_FLAT, BIAS))
        )
        means = np.array([model.mean[0] for model in self.models])
        variances = np.array([model.covariance[0, 0] for model in self.models])
        posterior = mixture_posterior(
            without_prior[0], without_prior[1] ** 2, means, variances, variances + WIDE**2
        )
        weight = posterior.wide
        biases = (1 - weight) * narrow[0] + weight * wide[0]
        squares = [sigma**2 + (bias - biases) ** 2 for bias, sigma in (narrow, wide)]
        return biases, np.sqrt((1 - weight) * squares[0] + weight * squares[1])

    def _widened(self, spread: float) -> "BestLinear":
        """The estimator without fallback, whose prior has an additional spread, deg/s."""
        if spread not in self._widened_models:
            other = copy.copy(self)
            other._fallback = False
            other.models = [_with_spread(model, spread) for model in self.models]
            other._windows = self._windows  # they do not depend on the prior
            other._forget()
            self._widened_models[spread] = other
        return self._widened_models[spread]

    def _line(
        self, axis: int, start: int, size: int, target: str, recording: int | None
    ) -> LinearEstimate:
        if self._biases is None:
            prior = self._prior(axis, recording)
            return self._window(axis, start, size, target).best(prior.mean, prior.covariance)
        windows = [self._window(i, start, size, target) for i in range(len(self.models))]
        mean = np.concatenate([model.mean for model in self.models])
        covariance = joint_prior(self.models, self._biases)
        return WindowModel.joint(windows, axis).best(mean, covariance)

    def _window(self, *key: *tuple[int, int, int, str]) -> WindowModel:
        axis, start, size, target = key
        if key not in self._windows:
            truth = PAPER if target == RECORDING_MEAN else TRUE
            self._windows[key] = WindowModel.of(self.models[axis], start, size, truth)
        return self._windows[key]

    def _prior(self, axis: int, recording: int | None) -> RecordingModel:
        """The prior of a recording, from the calibrations before it if there is a history."""
        if not self._histories:
            return self.models[axis]
        if (axis, recording) not in self._priors:
            prior = self._histories[axis].prior(self.models[axis], recording)
            self._priors[axis, recording] = prior
        return self._priors[axis, recording]


def _of_unseen(model: RecordingModel, devices: int) -> RecordingModel:
    """The model of a new device, from a model fitted to the recordings of several devices."""
    covariance = model.covariance * (1 + 1 / devices)
    if devices < FEWEST_RECORDINGS:
        covariance[0, 0] = _FLAT**2
    return replace(model, covariance=covariance)


def _joint_covariance(
    models: Sequence[RecordingModel], recordings: NDArray[np.floating]
) -> NDArray[np.float64] | None:
    """Covariance of the biases of all axes; None if they are not correlated.

    Its variances are at least those of the models.
    """
    biases, errors = fitted_biases(models, recordings)
    if not axes_are_correlated(biases):
        return None
    covariance = joint_draws(biases, errors, draws=0)[0]
    variances = np.array([model.covariance[0, 0] for model in models])
    missing = np.maximum(variances - np.diag(covariance), 0.0)
    return np.asarray(covariance + np.diag(missing))


def _with_spread(model: RecordingModel, spread: float) -> RecordingModel:
    """A model whose bias has an additional spread, deg/s."""
    covariance = model.covariance.copy()
    covariance[0, 0] += spread**2
    return replace(model, covariance=covariance)


class Ridge(_Linear):
    """Ridge regression of the target on the block means of the window.

    It has no noise model: there is a regression per axis on the training windows, which shrinks
    towards the training mean. The penalty has the least error on left-out training recordings. The
    bias is learned from the mean of the samples outside the window. There is no sigma.

    Args:
        same_time: Whether there is a regression for each start of a window, on training windows of
            the same time after power-on, which a sensor that warms up needs. A window with another
            start uses the nearest one.
    """

    uses_prior = True
    fewest_recordings = 2  # one is left out to choose the penalty

    def __init__(self, same_time: bool = False) -> None:
        self._by_start = same_time

    def _fit(self, training: TrainingSet) -> None:
        super()._fit(training)
        size, samples = training.size, training.real.sizes["sample"]
        edges = block_edges(size, round(BLOCK_S * self._rate_hz))
        pairs = zip(training.rates, training.starts, strict=True)
        blocks = [block_means(windows_at(rates, size, starts), edges) for rates, starts in pairs]
        inputs = np.concatenate(blocks, axis=1)  # (axes, windows, blocks)
        counts = list(map(len, training.starts))
        whole = np.repeat(training.labels[1], counts, axis=0).T  # (axes, windows)
        rest = (whole * samples - inputs @ np.diff(edges)) / max(samples - size, 1)
        targets = {RECORDING_MEAN: whole, BIAS: rest if size < samples else whole}
        groups, starts = np.repeat(np.arange(len(counts)), counts), np.concatenate(training.starts)
        self._size = size
        self._fitted: dict[tuple[int, str, int], LinearEstimate] = {}
        for start in np.unique(starts).tolist() if self._by_start else [0]:
            chosen = starts == start if self._by_start else starts >= 0
            if len(np.unique(groups[chosen])) < self.fewest_recordings:
                continue
            for axis, (target, values) in product(range(len(inputs)), targets.items()):
                weights, constant = ridge_regression(
                    inputs[axis, chosen], values[axis, chosen], groups[chosen]
                )
                line = LinearEstimate(edges, weights, constant, np.nan)
                self._fitted[axis, target, start] = line
        if not self._fitted:
            raise InputError("expected two training recordings with windows at the same time")

    def _line(
        self, axis: int, start: int, size: int, target: str, recording: int | None
    ) -> LinearEstimate:
        starts = [s for *key, s in self._fitted if key == [axis, target]]
        return self._fitted[axis, target, min(starts, key=lambda s: abs(s - start))]


def ridge_regression(
    inputs: NDArray[np.float64], targets: NDArray[np.float64], groups: NDArray[np.integer]
) -> tuple[NDArray[np.float64], float]:
    """Ridge regression with the penalty that has the least error on left-out groups.

    Args:
        inputs: (n, m).
        targets: (n,).
        groups: Group of each window, (n,); windows of a group are left out together.

    Returns:
        Weights (m,), and the constant.
    """
    scale = inputs.var(axis=0).sum() * targets.size
    penalties = scale * np.geomspace(1e-4, 1e4, _PENALTIES)
    distinct, numbers = np.unique(groups, return_inverse=True)
    parts = numbers % min(len(distinct), _FOLDS)
    errors = np.zeros(_PENALTIES)
    for part in np.unique(parts):
        left, rest = parts == part, parts != part
        weights, constants = _ridges(inputs[rest], targets[rest], penalties)
        off = inputs[left] @ weights.T + constants - targets[left][..., None]
        errors += np.sum(off**2, axis=0)
    weights, constants = _ridges(inputs, targets, penalties[[np.argmin(errors)]])
    return weights[0], float(constants[0])


def _ridges(
    x: NDArray[np.float64], y: NDArray[np.float64], penalties: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Ridge regressions: weights (penalties, m) and constants (penalties,)."""
    middle, level = x.mean(axis=0), y.mean()
    squares, axes = np.linalg.eigh((x - middle).T @ (x - middle))
    along = axes.T @ (x - middle).T @ (y - level)
    weights = along / (squares + penalties[:, None]) @ axes.T
    return weights, level - weights @ middle
