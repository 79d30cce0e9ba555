"""A gyroscope's recording as a Gaussian process, and the best linear estimates under this model.

A sample at time t after power-on is

    b + a exp(-t / time constant) + white noise N + flicker noise B + random walk K

The bias b and, if the sensor warms up, the amplitude a are drawn at each power-on from a normal
distribution, the prior. The noise is that of :mod:`gyro_pipeline.physics.noise`: flicker of
one-sided density B^2 / (pi f) down to one cycle in two recordings, and a random walk from 0 at
power-on. Means over blocks of samples, the mean of the whole recording and the bias are then
jointly normal, with covariances that are exact for blocks of any length. So the best estimate of
each from the blocks of a window is linear: the conditional mean.

Only the window needs short blocks; the samples before and after it are one block each. Block means
lose no relevant information if a block is much shorter than the time at which flicker equals white
noise, 2 pi N^2 / B^2 (20 s for N = 5.4, B = 3 mdps).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np
import scipy
from numpy.typing import NDArray

from gyro_pipeline.conventions import DISJOINT, PAPER, TRUE, InputError
from gyro_pipeline.physics.allan import NoiseFigures

BLOCK_S = 0.5
"""Length of a block of a window."""

_MOST_BLOCKS = 200


@dataclass(frozen=True)
class RecordingModel:
    """The prior knowledge of a gyroscope.

    Attributes:
        samples: Samples of a whole recording.
        rate_hz: Samples per second.
        noise: N, B and K.
        mean: Mean of the prior: bias and, if the sensor warms up, amplitude; (1,) or (2,), deg/s.
        covariance: Covariance of the prior, with the uncertainty of a fitted ``mean``; (1, 1) or
            (2, 2), (deg/s)^2.
        time_constant_s: Time constant of the warm-up; not used without one.
    """

    samples: int
    rate_hz: float
    noise: NoiseFigures
    mean: NDArray[np.float64]
    covariance: NDArray[np.float64]
    time_constant_s: float = np.inf

    def noise_covariance(self, edges: NDArray[np.integer]) -> NDArray[np.float64]:
        """Covariance of the noise of block means.

        Args:
            edges: (m + 1,), sample numbers, increasing; block i is ``edges[i]:edges[i + 1]``.

        Returns:
            (m, m), (deg/s)^2.
        """
        figures = self.noise.white, self.noise.instability, self.noise.random_walk
        unit = noise_covariances(edges, self.samples, self.rate_hz)
        return np.tensordot(np.square(figures), unit, axes=1)

    def averaging_variance(self) -> float:
        """Variance of the mean of a whole recording about the bias, (deg/s)^2."""
        edges = np.array([0, self.samples])
        of_noise = self.noise_covariance(edges)[0, 0]
        decay = self.profiles(edges)[0, 1:]
        return float(of_noise + decay @ self.covariance[1:, 1:] @ decay)

    def profiles(self, edges: NDArray[np.integer]) -> NDArray[np.float64]:
        """Block means of the factors of the bias and the amplitude, (m, 1) or (m, 2)."""
        return profiles(edges, self.rate_hz, self.time_constant_s)[:, : self.mean.size]


@dataclass(frozen=True)
class LinearEstimate:
    """An estimate that is a weighted sum of a window's block means.

    Attributes:
        edges: Edges of the blocks within the window, (m + 1,), samples.
        weights: (m,); (axes m,) if it uses the windows of several axes.
        constant: deg/s.
        variance: Variance of the error, (deg/s)^2.
    """

    edges: NDArray[np.integer]
    weights: NDArray[np.float64]
    constant: float
    variance: float

    def __call__(self, windows: NDArray[np.floating]) -> NDArray[np.float64]:
        """Estimates from windows, (n, samples) to (n,), deg/s."""
        return self.constant + block_means(windows, self.edges) @ self.weights


def innovations(
    model: RecordingModel,
    start: int,
    windows: NDArray[np.floating],
    block_s: float = BLOCK_S,
) -> NDArray[np.float64]:
    """Normalised innovations: the prediction error of each block of a window from earlier blocks.

    If the model holds, these are independent and normal, with mean 0 and variance 1, and
    independent of the error of :func:`best_linear`, so they contain no further information.

    Args:
        model: The model of a recording.
        start: First sample of the windows, counted from power-on.
        windows: (n, samples), deg/s.
        block_s: See :func:`best_linear`.

    Returns:
        (n, m).
    """
    window = WindowModel.of(model, start, windows.shape[-1], PAPER, block_s)
    deviations = block_means(windows, window.edges) - window.design @ model.mean
    prior = window.design @ model.covariance @ window.design.T
    root = np.linalg.cholesky(window.covariance + prior)
    return np.asarray(scipy.linalg.solve_triangular(root, deviations.T, lower=True).T)


def best_linear(
    model: RecordingModel, start: int, size: int, truth: str, block_s: float = BLOCK_S
) -> LinearEstimate:
    """The best linear estimate of a truth from a window, optimal for Gaussian noise and priors.

    Args:
        model: The model of a recording.
        start: First sample of the window, counted from power-on.
        size: Samples of the window.
        truth: PAPER (mean of the whole recording), DISJOINT (mean outside the window) or TRUE
            (the bias).
        block_s: The window is cut into blocks of about this length, 200 at most.

    Returns:
        Weights, constant and error variance. For DISJOINT the variance includes the averaging
        noise of the truth.

    Raises:
        InputError: The window is not inside the recording, or the truth is unknown.
    """
    return WindowModel.of(model, start, size, truth, block_s).best(model.mean, model.covariance)


def mean_squares(  # noqa: PLR0917 - the arguments of best_linear, and other priors
    model: RecordingModel,
    start: int,
    size: int,
    truth: str,
    block_s: float = BLOCK_S,
    covariances: NDArray[np.float64] | None = None,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Expected squared errors of the best linear estimate and of the running mean.

    The first is the ceiling for this noise: its root is the least RMSE of any function of the
    window, if everything is Gaussian and the model is known.

    Args:
        model: The true model, or a fitted one.
        start: First sample of the window, counted from power-on.
        size: Samples of the window.
        truth: PAPER, DISJOINT (its averaging noise is subtracted, which may give a negative square
            if noise is correlated) or TRUE.
        block_s: See :func:`best_linear`.
        covariances: Covariances of n priors, used instead of the model's, (n, 1, 1) or (n, 2, 2),
            (deg/s)^2.

    Returns:
        Two squares, (deg/s)^2; with ``covariances`` two arrays (n,).

    Raises:
        InputError: The window is not inside the recording, or the truth is unknown.
    """
    window = WindowModel.of(model, start, size, truth, block_s)
    priors = model.covariance if covariances is None else covariances
    weights = np.diff(window.edges) / size
    factors = weights @ window.design - window.coefficients
    of_noise = window.truth_noise + weights @ (window.covariance @ weights - 2 * window.shared)
    mean = priors @ factors @ factors + (factors @ model.mean) ** 2 + of_noise
    averaging = window.truth_noise if truth == DISJOINT else 0.0
    return window.variance(priors) - averaging, np.asarray(mean - averaging)


def joint_squares(
    models: Sequence[RecordingModel],
    start: int,
    size: int,
    truth: str,
    covariances: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Expected squared error, mean over axes, of the best estimate from the windows of all axes.

    It is smaller than that of separate estimates if biases are correlated between axes.

    Args:
        models: Models of the axes.
        start: First sample of the window, counted from power-on.
        size: Samples of the window.
        truth: PAPER or TRUE.
        covariances: Priors of the biases of all axes, (n, axes, axes), (deg/s)^2.

    Returns:
        (n,), (deg/s)^2.
    """
    windows = [WindowModel.of(model, start, size, truth) for model in models]
    priors = np.stack([joint_prior(models, biases) for biases in covariances])
    of_axes = [WindowModel.joint(windows, axis).variance(priors) for axis in range(len(models))]
    return np.asarray(np.mean(of_axes, axis=0))


def fitted_biases(
    models: Sequence[RecordingModel], recordings: NDArray[np.floating]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """The bias of each whole recording by generalised least squares, apart from a warm-up.

    Args:
        models: Models of the axes.
        recordings: (axes, n, samples), deg/s; no NaN.

    Returns:
        Biases (n, axes), deg/s, and the variances of their errors, (axes,), (deg/s)^2.
    """
    windows = [WindowModel.of(model, 0, model.samples, TRUE) for model in models]
    fits = [
        window.constants(block_means(rates, window.edges))
        for window, rates in zip(windows, recordings, strict=True)
    ]
    biases = np.stack([constants[:, 0] for constants, _ in fits], axis=1)
    return biases, np.array([covariance[0, 0] for _, covariance in fits])


def joint_prior(
    models: Sequence[RecordingModel], covariance: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Prior covariance of the constants c of all axes, for :meth:`WindowModel.joint`.

    Args:
        models: Models of the axes.
        covariance: Covariance of their biases, (axes, axes), (deg/s)^2.
    """
    roots = [np.linalg.cholesky(model.covariance) for model in models]
    firsts = np.cumsum([0, *map(len, roots[:-1])])
    root, scales = scipy.linalg.block_diag(*roots), [root[0, 0] for root in roots]
    inner = np.eye(len(root))
    inner[np.ix_(firsts, firsts)] = covariance / np.outer(scales, scales)
    return np.asarray(root @ inner @ root.T)


@lru_cache(maxsize=1 << 16)  # curves of all recordings need the same values
def outside_noise(
    noise: NoiseFigures, samples: int, rate_hz: float, start: int, size: int
) -> float:
    """Averaging noise of the mean of the samples outside a window, about the bias.

    Args:
        noise: N, B and K.
        samples: Samples of the whole recording, more than ``size``.
        rate_hz: Samples per second.
        start: First sample of the window, counted from power-on.
        size: Samples of the window.

    Returns:
        Variance, (deg/s)^2; N^2 / (T - T0) if the noise is white.
    """
    if noise.instability == 0 and noise.random_walk == 0:
        return noise.white**2 * rate_hz / (samples - size)
    edges = np.unique([0, start, start + size, samples])
    lengths = np.where(edges[:-1] == start, 0, np.diff(edges))
    figures = noise.white, noise.instability, noise.random_walk
    covariance = np.tensordot(
        np.square(figures), noise_covariances(edges, samples, rate_hz), axes=1
    )
    return float(lengths @ covariance @ lengths) / (samples - size) ** 2


@dataclass(frozen=True, eq=False)
class WindowModel:
    """Joint model of a window's block means y and a truth, for any prior of c.

    With c the bias and, if any, the amplitude, y = X c + e and the truth is g c + f; e and f are
    noise.

    Attributes:
        edges: Edges of the blocks within the window, (m + 1,), samples.
        design: X, (m, 1) or (m, 2).
        coefficients: g, (1,) or (2,).
        covariance: Covariance of e, (m, m), (deg/s)^2.
        shared: Covariance of e and f, (m,).
        truth_noise: Variance of f.
    """

    edges: NDArray[np.integer]
    design: NDArray[np.float64]
    coefficients: NDArray[np.float64]
    covariance: NDArray[np.float64]
    shared: NDArray[np.float64]
    truth_noise: float

    @classmethod
    def of(
        cls, model: RecordingModel, start: int, size: int, truth: str, block_s: float = BLOCK_S
    ) -> "WindowModel":
        """The model of a window, which does not depend on the prior; see :func:`best_linear`."""
        stop = start + size
        if not 0 <= start < stop <= model.samples:
            raise InputError(
                f"window: expected it inside a recording of {model.samples} samples, got samples "
                f"{start} to {stop}; start_s counts from power-on"
            )
        inner = start + block_edges(size, round(block_s * model.rate_hz))
        edges = np.unique([0, *inner, model.samples])
        inside = (edges[:-1] >= start) & (edges[1:] <= stop)
        profile, noise = model.profiles(edges), model.noise_covariance(edges)
        averaging = _averaging(np.diff(edges), inside, truth)
        return cls(
            inner - start,
            profile[inside],
            np.eye(model.mean.size)[0] if truth == TRUE else averaging @ profile,
            noise[np.ix_(inside, inside)],
            (noise @ averaging)[inside],
            float(averaging @ noise @ averaging),
        )

    @classmethod
    def joint(cls, windows: Sequence["WindowModel"], axis: int) -> "WindowModel":
        """The model of the block means of all axes and the truth of one, for a prior of all axes.

        Noise is independent between axes. The block means of the axes follow one another.
        """
        chosen = windows[axis]
        return cls(
            chosen.edges,
            scipy.linalg.block_diag(*(window.design for window in windows)),
            np.concatenate([(i == axis) * w.coefficients for i, w in enumerate(windows)]),
            scipy.linalg.block_diag(*(window.covariance for window in windows)),
            np.concatenate([(i == axis) * w.shared for i, w in enumerate(windows)]),
            chosen.truth_noise,
        )

    def constants(
        self, means: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Generalised least squares estimates of c from block means y, without a prior.

        Args:
            means: (n, m), deg/s.

        Returns:
            Estimates (n, 1) or (n, 2), deg/s, and the covariance of their errors.
        """
        covariance = np.linalg.inv(self._information)
        return means @ self._solved[1] @ covariance, np.asarray(covariance)

    @cached_property
    def _solved(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """The inverse of the covariance of e times ``shared``, (m,), and times X."""
        right = np.column_stack([self.shared, self.design])
        solved = scipy.linalg.solve(self.covariance, right, assume_a="pos")
        return solved[:, 0], solved[:, 1:]

    @cached_property
    def _information(self) -> NDArray[np.float64]:
        """Fisher information of y about c."""
        return np.asarray(self.design.T @ self._solved[1])

    @cached_property
    def _sensitivity(self) -> NDArray[np.float64]:
        """Coefficients of c in the truth, given y."""
        return np.asarray(self.coefficients - self.design.T @ self._solved[0])

    def _posterior(self, covariance: NDArray[np.float64]) -> NDArray[np.float64]:
        """Covariance of c given y, for prior covariances (..., k, k)."""
        shrinking = np.eye(self._sensitivity.size) + covariance @ self._information
        return np.asarray(np.linalg.solve(shrinking, covariance))

    def variance(self, covariance: NDArray[np.float64]) -> NDArray[np.float64]:
        """Variance of the error of :meth:`best`, (...), for prior covariances (..., k, k)."""
        return self._error_variance(self._posterior(covariance))

    def _error_variance(self, posterior: NDArray[np.float64]) -> NDArray[np.float64]:
        """Variance of the error, (...), for posterior covariances of c (..., k, k)."""
        explained = self._solved[0] @ self.shared
        of_c = posterior @ self._sensitivity @ self._sensitivity
        return np.asarray(self.truth_noise - explained + of_c)

    def best(self, mean: NDArray[np.float64], covariance: NDArray[np.float64]) -> LinearEstimate:
        """The conditional mean of the truth given y, under a normal prior of c.

        Args:
            mean: Mean of the prior, (1,) or (2,), deg/s.
            covariance: Covariance of the prior, (deg/s)^2; may be singular.
        """
        of_noise, of_design = self._solved
        posterior, sensitivity = self._posterior(covariance), self._sensitivity
        weights = of_noise + of_design @ (posterior @ sensitivity)
        constant = sensitivity @ (mean - posterior @ self._information @ mean)
        variance = self._error_variance(posterior)
        return LinearEstimate(self.edges, weights, float(constant), float(variance))


def _averaging(
    lengths: NDArray[np.integer], inside: NDArray[np.bool_], truth: str
) -> NDArray[np.float64]:
    """Weights of the noise of all blocks, (m,), in a truth."""
    if truth == PAPER:
        return lengths / lengths.sum()
    if truth == DISJOINT and not inside.all():
        outside = np.where(inside, 0, lengths)
        return outside / outside.sum()
    if truth == TRUE:
        return np.zeros(lengths.size)
    raise InputError(
        f"truth: expected {PAPER!r}, {DISJOINT!r} (for a window shorter than the recording) or "
        f"{TRUE!r}, got {truth!r}"
    )


def block_edges(size: int, block: int) -> NDArray[np.integer]:
    """Cut ``size`` samples into blocks of about ``block``, 200 at most, of nearly equal lengths.

    Returns:
        (m + 1,), sample numbers from 0 to ``size``.
    """
    count = int(np.clip(round(size / max(block, 1)), 1, min(_MOST_BLOCKS, size)))
    return np.rint(np.linspace(0, size, count + 1)).astype(int)


def block_means(samples: NDArray[np.floating], edges: NDArray[np.integer]) -> NDArray[np.float64]:
    """Means of blocks, (..., n) to (..., m), computed in float64."""
    sums = np.add.reduceat(samples, edges[:-1], axis=-1, dtype=np.float64)
    return np.asarray(sums / np.diff(edges))


def profiles(
    edges: NDArray[np.integer], rate_hz: float, time_constant_s: float
) -> NDArray[np.float64]:
    """Block means of 1 and of exp(-t / time constant), (m, 2); sample i is at (i + 1/2) / rate."""
    period = 1 / (rate_hz * time_constant_s)
    powers = np.exp(-edges * period)
    # a geometric sum; its limit is 1 without a time constant
    scale = np.exp(-period / 2) / -np.expm1(-period) if period > 0 else 0.0
    decay = scale * -np.diff(powers) / np.diff(edges) if period > 0 else np.ones(edges.size - 1)
    return np.stack([np.ones(edges.size - 1), decay], axis=1)


def noise_covariances(
    edges: NDArray[np.integer], samples: int, rate_hz: float
) -> NDArray[np.float64]:
    """Covariances of block means of white noise, flicker and random walk of N = B = K = 1.

    Args:
        edges: (m + 1,), sample numbers, increasing.
        samples: Samples of the whole recording, which determines the lowest frequency of flicker.
        rate_hz: Samples per second.

    Returns:
        (3, m, m).
    """
    lengths = np.diff(edges).astype(np.float64)
    white = np.diag(rate_hz / lengths)
    # the covariance of sums over [a, b) and [c, d) is half of
    # V(d - a) + V(c - b) - V(c - a) - V(d - b)
    v = _flicker_sum_variance(samples)[np.abs(edges[:, None] - edges[None, :])]
    flicker = (v[:-1, 1:] + v[1:, :-1] - v[:-1, :-1] - v[1:, 1:]) / 2
    middle = (edges[:-1] + edges[1:] + 1) / 2  # mean number of steps until a sample of the block
    walk = np.minimum(middle[:, None], middle[None, :]) / rate_hz
    # within a block: the mean of min(i, j) + 1 over all pairs of its samples
    shared = edges[:-1] + 1 + (lengths - 1) * (2 * lengths - 1) / (6 * lengths)
    np.fill_diagonal(walk, shared / rate_hz)
    return np.stack([white, flicker / np.outer(lengths, lengths), walk])


@lru_cache(maxsize=8)
def _flicker_sum_variance(samples: int) -> NDArray[np.float64]:
    """Variance V(m) of the sum of m successive samples of flicker noise with B = 1, (samples + 1,).

    The autocovariance is that of ``physics.noise``: (1 / pi) sum of cos(2 pi k lag / length) / k.
    """
    length = scipy.fft.next_fast_len(2 * samples, real=True)
    spectrum = np.zeros(length // 2 + 1)
    spectrum[1:] = 1 / (2 * np.pi * np.arange(1, length // 2 + 1))
    autocovariance = scipy.fft.irfft(spectrum, length, norm="forward")[:samples]
    steps = 2 * np.cumsum(autocovariance) - autocovariance[0]
    return np.concatenate([[0.0], np.cumsum(steps)])


def constant_bias(
    samples: int, rate_hz: float, noise: NoiseFigures, prior_mean: float, turn_on_spread: float
) -> RecordingModel:
    """A model without warm-up.

    Args:
        samples: Samples of a whole recording.
        rate_hz: Samples per second.
        noise: N, B and K.
        prior_mean: mu, deg/s.
        turn_on_spread: tau, deg/s.
    """
    variance = np.array([[turn_on_spread**2]])
    return RecordingModel(samples, rate_hz, noise, np.array([prior_mean]), variance)
