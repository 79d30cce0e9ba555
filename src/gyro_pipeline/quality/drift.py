"""A bias that moves smoothly at rest: it settles after power-on, or drifts on."""

from statistics import NormalDist

import numpy as np
from numpy.typing import NDArray
from scipy import optimize

SHORTEST = 2
"""Blocks. What decays with a shorter time constant is no drift but the start of the recording."""


def fit_drift(
    means: NDArray[np.float64],
    times: NDArray[np.float64],
    noise: NDArray[np.float64],
    false_alarm: float,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Decays of one sign from the first block on, and a line, by least squares.

    An axis on which none of them is significant alone has none, nor has one that a step explains
    better: that is a movement.

    Args:
        means: (axis, block), deg/s.
        times: (block,), of their middles, in blocks.
        noise: (axis,), deg/s, standard deviation of a block mean.
        false_alarm: Probability that white noise has a drift.

    Returns:
        The drift and, apart from it, what decays faster than a drift does: (axis, block), deg/s.
    """
    duration = times[-1] - times[0]
    slow = SHORTEST * 2.0 ** np.arange(np.ceil(np.log2(2 * duration / SHORTEST)))
    constants = np.concatenate([[0.25, 1.0], slow])
    decays = np.exp(-(times - times[0]) / constants[:, None])
    shapes = np.vstack([decays, times / duration, -times / duration])
    centred = shapes - shapes.mean(axis=1, keepdims=True)
    rates = means - means.mean(axis=1, keepdims=True)
    alone = np.abs(rates @ centred.T) / np.sqrt((centred**2).sum(axis=1)) / noise[:, None]
    limit = -NormalDist().inv_cdf(false_alarm / (2 * alone.size))
    drift, transient = np.zeros(means.shape), np.zeros(means.shape)
    axes = np.flatnonzero(alone.max(axis=1) > limit)
    if axes.size:
        base, reduced = np.linalg.qr(centred.T)
    for axis in axes:
        target = rates[axis] @ base
        fits = [(sign, *optimize.nnls(reduced, sign * target)) for sign in (1, -1)]
        sign, weights, left = min(fits, key=lambda fit: fit[2])
        rest = rates[axis] - base @ (base.T @ rates[axis])
        if _left_by_step(rates[axis]) < left**2 + rest @ rest:
            continue
        drift[axis] = sign * weights[2:] @ shapes[2:]
        transient[axis] = sign * weights[:2] @ shapes[:2]
    return drift, transient


def _left_by_step(rates: NDArray[np.float64]) -> float:
    """Sum of squares, (deg/s)^2, about the best step of rates, (block,), whose mean is zero."""
    before = np.arange(1, rates.size)
    explained = np.cumsum(rates)[:-1] ** 2 * (1 / before + 1 / before[::-1])
    return float(rates @ rates - explained.max())


def describe_drift(drift: NDArray[np.float64], times_s: NDArray[np.float64]) -> tuple[float, float]:
    """How far one axis drifts, and the time constant; infinite where it does not settle.

    Args:
        drift: (block,), deg/s, fitted.
        times_s: (block,), seconds from the start of the recording.
    """
    change = float(drift[-1] - drift[0])
    done = np.abs(drift - drift[0])
    late = done[-1] - np.interp(times_s[0] + (times_s[-1] - times_s[0]) * 2 / 3, times_s, done)
    if late > 0.15 * done.max():  # an exponential of half the duration
        return change, np.inf
    return change, float(times_s[np.argmax(done >= (1 - np.exp(-1)) * done[-1])])


def is_freed_of_bias(
    means: NDArray[np.float64], noise: NDArray[np.float64], longest: int = 8
) -> bool:
    """Whether a level goes to zero on all axes at once: the sensor takes the bias off by itself.

    Args:
        means: (axis, block), deg/s, from the first row on.
        noise: (axis,), deg/s, standard deviation of a block mean.
        longest: Blocks in which it goes from 80 to 20 %: a warm-up takes longer.
    """
    late = means[:, -max(means.shape[1] // 4, 1) :]
    zero = np.maximum(4 * noise / np.sqrt(late.shape[1]), 3e-3)
    level = np.abs(means[:, 0])
    gone = (np.abs(late.mean(axis=1)) < zero).all()
    was = np.count_nonzero(level > np.maximum(10 * zero, 5 * noise)) > 1
    share = np.abs(means[np.argmax(level)]) / level.max()
    return bool(gone and was and np.count_nonzero((share > 0.2) & (share < 0.8)) <= longest)
