"""Linear estimators on block means: the best linear predictor, and ridge regression."""

from dataclasses import replace

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike, NDArray

from gyro_pipeline.conventions import BIAS, PAPER, RECORDING_MEAN, TRUE, InputError
from gyro_pipeline.estimators.base import (
    FittedEstimator,
    Windows,
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

_PENALTIES, _FOLDS = 41, 10


class BestLinear(FittedEstimator):
    """The best linear predictor under the fitted noise and prior, axis by axis.

    White noise, bias instability, rate random walk, the turn-on spread and, if asked for, a
    warm-up of random amplitude are fitted to whole training recordings
    (:mod:`gyro_pipeline.physics.reml`). The estimate of either target is its conditional mean
    given the block means of the window (:mod:`gyro_pipeline.physics.recording_model`), with the
    uncertainty of what was learned of the prior mean in it. On white noise this is empirical
    Bayes; sigma holds on coloured noise as well. ``start_s`` matters: give it.

    The bias is the settled one, without the warm-up and the random walk since power-on.

    For an unseen device the model is fitted to the recordings of all known ones, whose spread is
    then that from unit to unit. Where fewer than three devices are known, the prior is flat.

    Args:
        warm_up: Whether the sensor warms up; None: if its recordings say so.
        noise: ``"reml"``: N, B and K fitted together with the prior; ``"allan"``: from the Allan
            fit, which does not know of warm-up.
        history: Whether the prior of a recording follows from the device's calibrations before
            it, in their order (:mod:`gyro_pipeline.physics.history`). For a bias that drifts from
            one recording to the next.

    Fitting needs three training recordings at least.
    """

    uses_prior = True

    def __init__(
        self, warm_up: bool | None = False, noise: str = "reml", history: bool = False
    ) -> None:
        if noise not in ("reml", "allan"):
            raise InputError(f"noise: expected 'reml' or 'allan', got {noise!r}")
        self.recommended = noise == "reml"  # the Allan fit knows nothing of warm-up
        self._warm_up, self._noise, self._history = warm_up, noise, history

    def _fit(self, recordings: xr.Dataset, imu: int) -> None:
        known, rate_hz = known_imus(recordings, imu), self._rate_hz
        seen = known == [imu]
        rates = np.concatenate([samples_of(recordings, one) for one in known])
        axes = range(rates.shape[1])
        figures: list[NoiseFigures | None] = [None for _ in axes]
        if self._noise == "allan":
            figures = [*allan_fit(recordings, imu)]
        fits = [fit_recording_model(rates[:, a], rate_hz, self._warm_up, figures[a]) for a in axes]
        self._axes = fits if seen else [_of_unseen(model, len(known)) for model in fits]
        self._histories: list[BiasHistory] | None = None
        if self._history and seen:
            numbers, labels = labels_of(recordings, imu)
            self._histories = [
                BiasHistory.fit(numbers, labels[:, a], model) for a, model in enumerate(fits)
            ]
        self._estimates: dict[tuple[int, int, int, str, int | None], LinearEstimate] = {}

    @property
    def models(self) -> list[RecordingModel]:
        """What was fitted, one for each axis."""
        return self._axes

    def _estimate(self, windows: Windows) -> tuple[ArrayLike, ArrayLike]:
        rates, starts = windows.samples, np.rint(windows.start_s * self._rate_hz).astype(int)
        biases = np.empty(rates.shape[:2])
        sigma = np.empty(rates.shape[:2])
        for start in np.unique(starts):
            chosen = starts == start
            place = int(start), rates.shape[-1], windows.target, windows.recording
            for axis in range(rates.shape[1]):
                best = self._best(axis, *place)
                biases[chosen, axis] = best(rates[chosen, axis])
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


def _of_unseen(model: RecordingModel, devices: int) -> RecordingModel:
    """The model of a new device, from one fitted to the recordings of so many others."""
    covariance = model.covariance * (1 + 1 / devices)
    if devices < FEWEST_RECORDINGS:
        covariance[0, 0] = _FLAT**2 * model.noise_covariance(np.array([0, model.samples]))[0, 0]
    return replace(model, covariance=covariance)


class Ridge(FittedEstimator):
    """Ridge regression of the target on the block means of the window.

    It knows no model: one regression per axis, from all non-overlapping training windows, towards
    the training mean. The penalty is the one with the least error on left-out training recordings.
    The bias is learned from the mean of the samples outside the window. It has no sigma.

    Args:
        same_time: One regression for each place of the window, from training windows of the same
            time after power-on, which a sensor that warms up needs.
    """

    uses_prior = True

    def __init__(self, same_time: bool = False) -> None:
        self._same_time = same_time

    def _fit(self, recordings: xr.Dataset, imu: int) -> None:
        known = [samples_of(recordings, one) for one in known_imus(recordings, imu)]
        self._rates = np.concatenate(known)
        self._means = self._rates.mean(axis=-1, dtype=np.float64)
        self._lines: dict[tuple[int, int, int, str], LinearEstimate] = {}

    def _estimate(self, windows: Windows) -> tuple[ArrayLike, ArrayLike]:
        rates = windows.samples
        starts = np.rint(windows.start_s * self._rate_hz * self._same_time).astype(int)
        biases = np.empty(rates.shape[:2])
        for start in np.unique(starts):
            chosen = starts == start
            for axis in range(rates.shape[1]):
                line = self._line(axis, int(start), rates.shape[-1], windows.target)
                biases[chosen, axis] = line(rates[chosen, axis])
        return biases, np.nan

    def _line(self, axis: int, start: int, size: int, target: str) -> LinearEstimate:
        key = axis, start, size, target
        if key not in self._lines:
            edges = block_edges(size, round(BLOCK_S * self._rate_hz))
            rates, samples = self._rates[:, axis], self._rates.shape[-1]
            count = 1 if self._same_time else samples // size
            windows = rates[:, start : start + count * size].reshape(len(rates), count, size)
            blocks = block_means(windows, edges)
            aims = np.repeat(self._means[:, axis, None], count, axis=1)
            if target == BIAS:
                aims = (aims * samples - blocks @ np.diff(edges)) / (samples - size)
            weights, constant = ridge_regression(blocks, aims)
            self._lines[key] = LinearEstimate(edges, weights, constant, np.nan)
        return self._lines[key]


def ridge_regression(
    inputs: NDArray[np.float64], aims: NDArray[np.float64]
) -> tuple[NDArray[np.float64], float]:
    """Ridge regression with the penalty that does best on left-out groups.

    Args:
        inputs: (groups, windows, m); the windows of a group are left out together.
        aims: (groups, windows).

    Returns:
        Weights (m,), and the constant.
    """
    scale = inputs.var(axis=(0, 1)).sum() * aims.size
    penalties = scale * np.geomspace(1e-4, 1e4, _PENALTIES)
    parts = np.arange(len(inputs)) % min(len(inputs), _FOLDS)
    errors = np.zeros(_PENALTIES)
    for part in np.unique(parts):
        left, rest = parts == part, parts != part
        weights, constants = _ridges(inputs[rest], aims[rest], penalties)
        off = inputs[left] @ weights.T + constants - aims[left][..., None]
        errors += np.sum(off**2, axis=(0, 1))
    weights, constants = _ridges(inputs, aims, penalties[[np.argmin(errors)]])
    return weights[0], float(constants[0])


def _ridges(
    inputs: NDArray[np.float64], aims: NDArray[np.float64], penalties: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Weights (penalties, m) and constants (penalties,)."""
    x, y = inputs.reshape(-1, inputs.shape[-1]), aims.ravel()
    middle, level = x.mean(axis=0), y.mean()
    squares, axes = np.linalg.eigh((x - middle).T @ (x - middle))
    along = axes.T @ (x - middle).T @ (y - level)
    weights = along / (squares + penalties[:, None]) @ axes.T
    return weights, level - weights @ middle
