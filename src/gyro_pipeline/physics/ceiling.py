"""The ceiling: the least RMSE of any estimator that sees only the window, under white noise.

The bias b of a power-on is Normal(mu, tau^2), with the prior mean mu and the turn-on spread tau.
The mean of t seconds scatters about it by N / sqrt(t). The window has T0 of the recording's T
seconds, m is its mean, and n is the mean of the other T - T0 seconds. With

    r = T0 / T,    q = tau^2 T0 / N^2,    beta = q / (1 + q)

the window has information about b only through m, and the posterior of b has mean
mu + beta (m - mu) and variance tau^2 (1 - beta) = beta N^2 / T0.

Truth (a), PAPER, is the mean of the whole recording, GT = r m + (1 - r) n. The error of the running
mean is m - GT = (1 - r) (m - n), whose variance is (1 - r)^2 N^2 (1 / T0 + 1 / (T - T0)), that is
N^2 (1 / T0 - 1 / T). The best estimate is E[GT | window] = r m + (1 - r) (mu + beta (m - mu)). Its
error is (1 - r) times the sum of the posterior error of b and the averaging noise of n, whose
variance is N^2 / (T - T0). The ratio of the two variances is

    rho^2 = r + (1 - r) q / (1 + q)

Truth (b), DISJOINT, is n, with its averaging noise N^2 / (T - T0) subtracted from the squared
error, and truth (c), TRUE, is b itself. For both, the running mean's squared error is N^2 / T0, the
best estimate is the posterior mean, and rho^2 = q / (1 + q).

For truth (a), the time t at which the running mean alone reaches the best RMSE solves
N^2 (1 / t - 1 / T) = rho^2 N^2 (1 / T0 - 1 / T), so the saving is S = 1 - T0 / t =
(1 - rho^2) (1 - r). The gain in accuracy is A = 1 - rho. With tau = 0: A = 1 - sqrt(r),
S = (1 - r)^2.

For several axes, the squared errors of both add up, so the same formulas hold for the ratio of
the pooled values.
"""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gyro_pipeline.conventions import DISJOINT, PAPER, TRUE, InputError


def running_mean_rmse(
    noise: ArrayLike, window_s: ArrayLike, recording_s: ArrayLike, truth: str
) -> NDArray[np.float64]:
    """RMSE of the window mean.

    Args:
        noise: N, deg/s * sqrt(s).
        window_s: T0.
        recording_s: T.
        truth: PAPER, DISJOINT (with its averaging noise subtracted) or TRUE.

    Returns:
        RMSE, deg/s, of the arguments' common shape.

    Raises:
        InputError: Unknown truth.
    """
    window, recording = np.asarray(window_s, np.float64), np.asarray(recording_s, np.float64)
    rest = 1 / recording if _includes_window(truth) else np.zeros_like(recording)
    return np.asarray(noise, np.float64) * np.sqrt(1 / window - rest)


def ceiling_rmse(
    noise: ArrayLike,
    turn_on_spread: ArrayLike,
    window_s: ArrayLike,
    recording_s: ArrayLike,
    truth: str,
) -> NDArray[np.float64]:
    """The least RMSE of any estimator that sees only the window.

    Args:
        noise: N, deg/s * sqrt(s).
        turn_on_spread: tau, deg/s.
        window_s: T0.
        recording_s: T.
        truth: PAPER, DISJOINT or TRUE.

    Returns:
        RMSE, deg/s, of the arguments' common shape.

    Raises:
        InputError: Unknown truth.
    """
    beta = _posterior_weight(noise, turn_on_spread, window_s)
    window, recording = np.asarray(window_s, np.float64), np.asarray(recording_s, np.float64)
    r = window / recording if _includes_window(truth) else np.zeros_like(window)
    return running_mean_rmse(noise, window_s, recording_s, truth) * np.sqrt(r + (1 - r) * beta)


def best_gain(rho: ArrayLike) -> NDArray[np.float64]:
    """Accuracy gain A at the ceiling.

    Args:
        rho: Ceiling RMSE over running-mean RMSE.

    Returns:
        A, a fraction.
    """
    return 1 - np.asarray(rho, np.float64)


def best_saving(rho: ArrayLike, r: ArrayLike) -> NDArray[np.float64]:
    """Time saving S at the ceiling, for the truth PAPER.

    Args:
        rho: Ceiling RMSE over running-mean RMSE.
        r: T0 / T.

    Returns:
        S, a fraction.
    """
    return (1 - np.asarray(rho, np.float64) ** 2) * (1 - np.asarray(r, np.float64))


def oracle(
    window_mean: ArrayLike,
    prior_mean: ArrayLike,
    turn_on_spread: ArrayLike,
    noise: ArrayLike,
    window_s: float,
    recording_s: float,
    truth: str,
) -> NDArray[np.float64]:
    """Best estimate with known mu, tau and N; its RMSE is ``ceiling_rmse``.

    Args:
        window_mean: m, deg/s.
        prior_mean: mu, deg/s.
        turn_on_spread: tau, deg/s.
        noise: N, deg/s * sqrt(s).
        window_s: T0.
        recording_s: T.
        truth: PAPER, DISJOINT or TRUE; the best estimate for PAPER is not that of the bias.

    Returns:
        Estimate, deg/s, of the arguments' common shape.

    Raises:
        InputError: Unknown truth.
    """
    m, mu = np.asarray(window_mean, np.float64), np.asarray(prior_mean, np.float64)
    posterior_mean = mu + _posterior_weight(noise, turn_on_spread, window_s) * (m - mu)
    r = window_s / recording_s if _includes_window(truth) else 0.0
    return r * m + (1 - r) * posterior_mean


def pooled(rmse_per_axis: ArrayLike) -> NDArray[np.float64]:
    """Pool the RMSE of axes: the root of the mean of their squares.

    Args:
        rmse_per_axis: (..., axis), deg/s.

    Returns:
        (...), deg/s.
    """
    return np.asarray(np.sqrt(np.mean(np.asarray(rmse_per_axis, np.float64) ** 2, axis=-1)))


def _posterior_weight(
    noise: ArrayLike, turn_on_spread: ArrayLike, window_s: ArrayLike
) -> NDArray[np.float64]:
    """The weight beta = q / (1 + q) of the window mean, in a form that is valid for tau = 0."""
    prior = np.asarray(turn_on_spread, np.float64) ** 2
    averaging = np.asarray(noise, np.float64) ** 2 / np.asarray(window_s, np.float64)
    return prior / (prior + averaging)


def _includes_window(truth: str) -> bool:
    """Whether the truth is an average that includes the window."""
    if truth not in (PAPER, DISJOINT, TRUE):
        raise InputError(f"truth: expected {PAPER!r}, {DISJOINT!r} or {TRUE!r}, got {truth!r}")
    return truth == PAPER
