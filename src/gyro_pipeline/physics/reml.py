"""Restricted maximum likelihood (REML) of a gyroscope's noise, prior and warm-up.

The recordings of one gyroscope are independent draws from one
:class:`~gyro_pipeline.physics.recording_model.RecordingModel`. Their block means y (m,) are normal
with mean X c and covariance

    C = N^2 V_white + B^2 V_flicker + K^2 V_walk + tau^2 x_1 x_1' + s^2 x_2 x_2'

where X = (x_1, x_2) holds the block means of 1 and of the warm-up's decay, c = (mean bias, mean
amplitude), tau is the turn-on spread and s the spread of the amplitude. REML is the likelihood of
the residuals after c has been fitted (Patterson & Thompson 1971, Biometrika 58), so that fitting c
does not bias the variances.

With a handful of recordings, a spread can be zero by chance, and an estimator would shrink
everything to the mean. Therefore log tau + log s is added, the weak prior of Chung et al. 2013
(Psychometrika 78, 685). It moves the maximum away from zero by about one standard error, and does
not matter with many recordings.
"""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import scipy
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from gyro_pipeline.conventions import InputError
from gyro_pipeline.physics.allan import NoiseFigures
from gyro_pipeline.physics.recording_model import (
    RecordingModel,
    block_edges,
    block_means,
    noise_covariances,
    profiles,
)

FEWEST_RECORDINGS = 3
"""Fewer recordings do not determine a spread, even with its weak prior."""

_BLOCK_S = 0.5
_RANGE = 1e4  # factor by which a standard deviation may differ from its first guess
_STEP = 1e-3  # step of the numerical gradient, in logarithms
_CHANCE = 0.05  # largest probability of detecting a warm-up where none exists
_TIME_CONSTANTS = (0.02, 0.1, 0.3, 1.0, 3.0)
"""Shares of the recording: the limits of the time constant, and between them starts of searches."""


@threadpool_limits.wrap(limits=1, user_api="blas")  # more threads do not help small matrices
def fit_recording_model(
    recordings: NDArray[np.floating],
    rate_hz: float,
    warm_up: bool | None = False,
    noise: NoiseFigures | None = None,
) -> RecordingModel:
    """Fit the model of one gyroscope to whole recordings.

    Args:
        recordings: (n, samples), deg/s, from power-on; no NaN.
        rate_hz: Samples per second.
        warm_up: Whether the bias has a warm-up; its time constant is the same in all recordings.
            None: a warm-up is included if a test at the 5 % level and the Bayesian information
            criterion (Schwarz 1978, Annals of Statistics 6) favour it, and its time constant is not
            longer than a recording, which would not show the bias that it settles to.
        noise: Known N, B and K; None: fitted with the other parameters.

    Returns:
        The model; its prior is that of the next recording: the spread between recordings plus
        the uncertainty of the mean.

    Raises:
        InputError: There are fewer than three recordings.
    """
    if len(recordings) < FEWEST_RECORDINGS:
        raise InputError(
            f"noise model: expected at least {FEWEST_RECORDINGS} recordings of a gyroscope, got "
            f"{len(recordings)}; with fewer, use an estimator without a prior"
        )
    samples = recordings.shape[-1]
    means = block_means(recordings, block_edges(samples, round(_BLOCK_S * rate_hz)))
    data = means.tobytes(), len(means), samples, rate_hz
    stationary = _fit(*data, bool(warm_up), noise)
    if warm_up is not None or not stationary.warms_up:
        return stationary.model
    warming = _fit(*data, True, noise)
    settles = warming.model.time_constant_s <= samples / rate_hz
    return (warming if settles and warming.criterion < stationary.criterion else stationary).model


@dataclass(frozen=True)
class _Fit:
    """A model, its information criterion, and whether its residuals look like a warm-up."""

    model: RecordingModel
    criterion: float
    warms_up: bool


@lru_cache(maxsize=256)  # several estimators need the same fit
def _fit(  # noqa: PLR0917 - the arguments are the key of the cache
    means: bytes,
    count: int,
    samples: int,
    rate_hz: float,
    warm_up: bool,
    noise: NoiseFigures | None,
) -> _Fit:
    """Fit the model to block means (count, m), float64."""
    table = np.frombuffer(means).reshape(count, -1)
    likelihood = _Likelihood(table, samples, rate_hz, warm_up, noise)
    starts_s = [np.inf]
    if warm_up:
        starts_s = [share * samples / rate_hz for share in _TIME_CONSTANTS[1:-1]]
    x = min(map(likelihood.maximise, starts_s), key=lambda result: result.fun).x
    figures, spreads, time_constant_s = likelihood.unpack(x)
    _, mean, uncertainty = likelihood.deviance(x)
    mean[0] += likelihood.offset
    covariance = np.diag(np.square(spreads)) + uncertainty
    noise = noise or NoiseFigures(*map(float, figures))
    model = RecordingModel(samples, rate_hz, noise, mean, covariance, time_constant_s)
    return _Fit(model, likelihood.criterion(x), not warm_up and likelihood.warms_up(x))


class _Likelihood:
    """Restricted likelihood of the block means of a gyroscope's recordings.

    The parameters x are logarithms of N, B and K, unless these are known, of tau, and, with a
    warm-up, of s and the time constant.
    """

    def __init__(  # noqa: PLR0917 - the data and the model
        self,
        means: NDArray[np.float64],
        samples: int,
        rate_hz: float,
        warm_up: bool,
        noise: NoiseFigures | None,
    ) -> None:
        self.edges = block_edges(samples, round(_BLOCK_S * rate_hz))
        self.offset = float(means.mean())
        self.means = means - self.offset
        self.levels = self.means.mean(axis=1)
        self.residuals = (self.means - self.levels[:, None]).T
        # the triangular factor has the same squares with at most as many columns as blocks
        self.scatter = scipy.linalg.qr(self.residuals.T, mode="economic")[1].T
        self.noise = lru_cache(maxsize=16)(self._noise)  # most steps of a gradient do not change it
        self.rate_hz, self.duration_s, self.warm_up = rate_hz, samples / rate_hz, warm_up
        self.unit = noise_covariances(self.edges, samples, rate_hz)
        self.fixed_noise: NDArray[np.float64] | None = None
        if noise is not None:
            self.fixed_noise = np.array([noise.white, noise.instability, noise.random_walk])

    def guess(self, time_constant_s: float) -> NDArray[np.float64]:
        """Start of a search: noise from differences of blocks, tau from means of recordings."""
        block_s = np.diff(self.edges).mean() / self.rate_hz
        jumps = np.diff(self.means, axis=1).std() / np.sqrt(2)
        white = max(jumps * np.sqrt(block_s), np.finfo(float).tiny)
        spread = self.means.mean(axis=1).std(ddof=1)
        figures = [white, white / 3, white / 50] if self.fixed_noise is None else []
        settling = [(self.means[:, 0] - self.means[:, -1]).std(), time_constant_s]
        return np.log(np.maximum([*figures, spread, *(settling if self.warm_up else [])], 1e-12))

    def unpack(
        self, x: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64], float]:
        """N, B and K; tau and s; the time constant in seconds."""
        values = np.exp(x)
        figures = self.fixed_noise
        if figures is None:
            figures, values = values[:3], values[3:]
        return figures, values[:2], values[2] if self.warm_up else np.inf

    def deviance(
        self, x: NDArray[np.float64]
    ) -> tuple[float, NDArray[np.float64], NDArray[np.float64]]:
        """-2 times the log of restricted likelihood times prior; the fitted c and its covariance.

        Each recording is fitted separately: this gives its c, with the covariance of the noise, and
        residuals that do not depend on the spreads. The c of all recordings then scatter with this
        covariance plus the spreads. So a spread may be any multiple of the noise, as it is between
        units.
        """
        figures, spreads, time_constant_s = self.unpack(x)
        root, log_determinant, squares = self.noise(*figures.tolist())
        design = profiles(self.edges, self.rate_hz, time_constant_s)[:, : spreads.size]
        white = scipy.linalg.solve_triangular(root, design, lower=True, check_finite=False)
        weighted = scipy.linalg.solve_triangular(
            root, white, lower=True, trans="T", check_finite=False
        )
        information = white.T @ white
        fits = np.linalg.solve(information, weighted.T @ self.residuals)
        squares = squares - np.sum(fits * (information @ fits))
        fits[0] += self.levels
        mean, scatter = fits.mean(axis=1), np.linalg.inv(information) + np.diag(spreads**2)
        deviations, n = fits - mean[:, None], self.levels.size
        deviance = n * (log_determinant + np.linalg.slogdet(information)[1])
        deviance += (n - 1) * np.linalg.slogdet(scatter)[1] + mean.size * np.log(n)
        deviance += squares + np.sum(deviations * np.linalg.solve(scatter, deviations))
        return float(deviance - 2 * np.log(spreads).sum()), mean, scatter / n

    def _noise(self, *figures: float) -> tuple[NDArray[np.float64], float, float]:
        """The root of the noise's covariance, its log determinant, and the sum of squares.

        The squares are those of the whitened block means about each recording's level.
        """
        root = np.linalg.cholesky(np.tensordot(np.square(figures), self.unit, axes=1))
        white = scipy.linalg.solve_triangular(root, self.scatter, lower=True, check_finite=False)
        return root, float(2 * np.log(np.diag(root)).sum()), float(np.sum(white**2))

    def criterion(self, x: NDArray[np.float64]) -> float:
        """The Bayesian information criterion: -2 log-likelihood, plus log n for each parameter."""
        deviance, mean, uncertainty = self.deviance(x)
        _, spreads, _ = self.unpack(x)
        # undo the restriction and the weak prior
        deviance += np.linalg.slogdet(uncertainty)[1] + 2 * np.log(spreads).sum()
        return float(deviance + (x.size + mean.size) * np.log(len(self.means)))

    def warms_up(self, x: NDArray[np.float64]) -> bool:
        """Whether a decay from power-on explains more of the recordings than by chance.

        Without a warm-up, the amplitudes of recordings, fitted by generalised least squares, are
        normal with known variance, so the square of their sum and the sum of their squares follow
        chi-squared distributions.
        """
        figures, spreads, _ = self.unpack(x)
        covariance = np.tensordot(np.square(figures), self.unit, axes=1) + spreads[0] ** 2
        _, mean, _ = self.deviance(x)
        root = np.linalg.cholesky(covariance)
        shares = _TIME_CONSTANTS[1:-1]
        decays = [
            profiles(self.edges, self.rate_hz, share * self.duration_s)[:, 1] for share in shares
        ]
        columns = np.column_stack([(self.means - mean[0]).T, *decays])
        white = scipy.linalg.solve_triangular(root, columns, lower=True, check_finite=False)
        y, decay = white[:, : len(self.means)], white[:, len(self.means) :]
        amplitudes = decay.T @ y / np.sqrt(np.sum(decay**2, axis=0))[:, None]  # over their sigma
        count, tests = len(self.means), 2 * len(shares)
        common = np.abs(amplitudes.sum(axis=1)).max() / np.sqrt(count)
        scatter = np.sum(amplitudes**2, axis=1).max()
        p_values = scipy.stats.chi2.sf([common**2, scatter], [1, count])
        return bool(p_values.min() < _CHANCE / tests)

    def maximise(self, time_constant_s: float) -> "scipy.optimize.OptimizeResult":
        """Maximise the likelihood, from the guess with this time constant."""
        start = self.guess(time_constant_s)
        reach = np.log(_RANGE)
        bounds = np.column_stack([start - reach, start + reach])
        if self.warm_up:
            shortest, *_, longest = _TIME_CONSTANTS
            bounds[-1] = np.log([shortest * self.duration_s, longest * self.duration_s])

        def gradient(x: NDArray[np.float64]) -> NDArray[np.float64]:
            steps = _STEP * np.eye(x.size)
            return np.array(
                [(self.deviance(x + h)[0] - self.deviance(x - h)[0]) / (2 * _STEP) for h in steps]
            )

        return scipy.optimize.minimize(
            lambda x: self.deviance(x)[0], start, jac=gradient, bounds=bounds, method="L-BFGS-B"
        )
