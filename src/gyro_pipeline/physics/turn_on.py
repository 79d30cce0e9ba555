"""Estimates of the turn-on spread from the means of recordings.

The mean of a recording is the bias of its power-on plus averaging noise, whose variance is known;
it is N^2 / T if the noise is white.
"""

import numpy as np
import scipy
from numpy.typing import ArrayLike, NDArray

from gyro_pipeline.conventions import InputError

_FEWEST_RECORDINGS = 2
_FEWEST_CORRELATED = 5
_CHANCE = 0.01  # probability of detecting a correlation where none exists


def turn_on_spread(
    recording_means: NDArray[np.floating], averaging: ArrayLike
) -> NDArray[np.float64]:
    """Turn-on spread tau: the scatter of the recordings' means beyond their averaging noise.

    Args:
        recording_means: (n, ...), deg/s; NaN where a recording is missing.
        averaging: Variance of the averaging noise, (deg/s)^2, broadcast against the trailing shape:
            N^2 / T if the noise is white.

    Returns:
        (...), deg/s; 0 where the means scatter less than their averaging noise.

    Raises:
        InputError: Fewer than two recordings.
    """
    present = np.isfinite(recording_means).sum(axis=0)
    if np.any(present < _FEWEST_RECORDINGS):
        raise InputError(
            f"turn-on spread: expected at least {_FEWEST_RECORDINGS} recordings of every "
            f"gyroscope, got {present}"
        )
    scatter = np.nanvar(recording_means, axis=0, ddof=1, dtype=np.float64)
    return np.asarray(np.sqrt(np.maximum(0.0, scatter - np.asarray(averaging, np.float64))))


def spread_draws(
    recording_means: NDArray[np.floating], averaging: ArrayLike, draws: int
) -> NDArray[np.float64]:
    """Draws of the turn-on spread, whose quantiles are intervals.

    For normal means, the scatter of n means is their variance times a chi-square variable of n - 1
    degrees of freedom over n - 1. So the scatter is divided by draws of this variable (a
    generalised pivot; Weerahandi 1993, Journal of the American Statistical Association 88), and the
    averaging noise is subtracted.

    Args:
        recording_means: As for :func:`turn_on_spread`.
        averaging: As for :func:`turn_on_spread`.
        draws: Number of draws, from a fixed seed.

    Returns:
        (draws, ...), deg/s.
    """
    freedom = np.isfinite(recording_means).sum(axis=0) - 1
    scatter = np.nanvar(recording_means, axis=0, ddof=1, dtype=np.float64)
    generator = np.random.default_rng(0)
    pivots = freedom / generator.chisquare(freedom, (draws, *scatter.shape))
    variances = scatter * pivots - np.asarray(averaging, np.float64)
    return np.asarray(np.sqrt(np.maximum(0.0, variances)))


def joint_draws(
    recording_means: NDArray[np.floating], averaging: ArrayLike, draws: int
) -> NDArray[np.float64]:
    """Covariance of the turn-on bias of all axes: the estimate, then draws.

    Args:
        recording_means: (n, axes), deg/s, of more recordings than axes; or fitted biases.
        averaging: Variance of their averaging noise or error, (axes,), (deg/s)^2.
        draws: Number of draws, as by :func:`spread_draws`, but from a Wishart distribution.

    Returns:
        (1 + draws, axes, axes), (deg/s)^2; positive semidefinite.
    """
    scatter, freedom = np.cov(recording_means.T), len(recording_means) - 1
    pivots = scipy.stats.wishart.rvs(freedom, np.eye(len(scatter)) / freedom, draws, random_state=0)
    root = np.linalg.cholesky(scatter)
    samples = root @ np.linalg.inv(pivots) @ root.T
    values, vectors = np.linalg.eigh(np.concatenate([scatter[None], samples]) - np.diag(averaging))
    return np.asarray((vectors * np.maximum(values, 0.0)[:, None, :]) @ vectors.swapaxes(1, 2))


def bias_correlation(
    biases: NDArray[np.floating], errors: ArrayLike
) -> tuple[float, float, float] | None:
    """Correlation of the turn-on bias of two axes, and the ends of its 95 % interval.

    The interval is that of the measured biases (Fisher 1915, Biometrika 10), divided like the
    correlation by the share of their standard deviations that is turn-on spread.

    Args:
        biases: Means or fitted biases of recordings, (n, 2), deg/s.
        errors: Variances of their errors, (2,), (deg/s)^2.

    Returns:
        None with fewer than five recordings, or if an axis does not scatter beyond its error.
    """
    spreads = turn_on_spread(biases, errors)
    if len(biases) < _FEWEST_CORRELATED or not spreads.all():
        return None
    measured = np.corrcoef(biases.T)[0, 1]
    half = scipy.stats.norm.ppf(0.975) / np.sqrt(len(biases) - 3)
    ends = np.tanh(np.arctanh(measured) + half * np.array([0, -1, 1]))
    shares = spreads / biases.std(axis=0, ddof=1)
    value, lo, hi = np.clip(ends / shares.prod(), -1, 1).tolist()
    return value, lo, hi


def guarded_spread(scatter: ArrayLike, freedom: ArrayLike, averaging: ArrayLike) -> float:
    """The turn-on spread tau with the weak prior of :mod:`gyro_pipeline.physics.reml`.

    The means of group g (a gyroscope) scatter about their group's mean with variance tau^2 + v_g,
    where v_g is the averaging noise of a mean. The result maximises the restricted likelihood times
    tau.

    Args:
        scatter: (groups,), sum of the squared deviations from the mean, (deg/s)^2.
        freedom: (groups,), number of means less one; the sum is at least 2.
        averaging: (groups,), v, (deg/s)^2, such as N^2 / T.

    Returns:
        A common tau of all groups, deg/s; 0 only if scatter and averaging noise are 0.
    """
    arguments = (scatter, freedom, averaging)
    squares, nu, v = (np.atleast_1d(np.asarray(value, np.float64)) for value in arguments)
    largest = squares.sum() + (nu * v).sum()
    if largest == 0:
        return 0.0

    def slope(log_variance: float) -> float:
        variance = np.exp(log_variance)
        share = variance / (variance + v)
        return float(np.sum(share * (nu - squares / (variance + v)))) - 1

    # the slope is negative at a negligible tau, and positive at one beyond all scatter
    limits = np.log(largest) + np.array([-60.0, 5.0])
    return float(np.exp(scipy.optimize.brentq(slope, *limits) / 2))


def axes_are_correlated(biases: NDArray[np.floating]) -> bool:
    """Whether the bias is correlated between axes: Bartlett's test at the 1 % level.

    The logarithm of the determinant of the correlations, multiplied by -(n - 1 - (2 k + 5) / 6),
    follows a chi-squared distribution of k (k - 1) / 2 degrees of freedom if k axes are independent
    (Bartlett 1951, Biometrika 38, 337). Recordings must be exchangeable: independent biases that
    drift from one recording to the next look correlated.

    Args:
        biases: Of each recording, (n, axes), deg/s.

    Returns:
        False if there are too few recordings for the test.
    """
    n, axes = biases.shape
    factor = n - 1 - (2 * axes + 5) / 6
    if n <= axes or axes == 1 or factor <= 0:
        return False
    _, log_determinant = np.linalg.slogdet(np.corrcoef(biases.T))
    p = scipy.stats.chi2.sf(-factor * log_determinant, axes * (axes - 1) / 2)
    return bool(p < _CHANCE)
