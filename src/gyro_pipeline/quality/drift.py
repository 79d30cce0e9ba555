"""A bias that moves smoothly at rest: it settles after power-on, or drifts on.

Means are (axis, block), noise is the standard deviation of one, (axis,), both in deg/s.
"""

from statistics import NormalDist

import numpy as np
from scipy import optimize

from gyro_pipeline.quality.blocks import Array


def fit_drift(
    means: Array, times: Array, noise: Array, false_alarm: float, shortest: float = 2.0
) -> tuple[Array, Array]:
    """Decays of one sign from the first block on, and a line, by least squares.

    An axis has no drift if none of them is significant by itself, which white noise is with a
    probability of ``false_alarm``, or if a single step explains more: that is a movement.

    Args:
        means: (axis, block).
        times: (block,), of their middles, in blocks.
        noise: (axis,).
        false_alarm: Probability.
        shortest: Time constant of a drift, in blocks; what is faster is the recording's start.

    Returns:
        The drift, and what decays faster: (axis, block), deg/s.
    """
    duration = times[-1] - times[0]
    slow = shortest * 2.0 ** np.arange(np.ceil(np.log2(2 * duration / shortest)))
    decays = np.exp((times[0] - times) / np.r_[shortest / 8, shortest / 2, slow][:, None])
    shapes = np.vstack([decays, times / duration, -times / duration])
    centred = shapes - shapes.mean(axis=1, keepdims=True)
    rates = means - means.mean(axis=1, keepdims=True)
    alone = np.abs(rates @ centred.T) / np.sqrt((centred**2).sum(axis=1)) / noise[:, None]
    limit = -NormalDist().inv_cdf(false_alarm / (2 * alone.size))
    before = np.arange(1, times.size)
    steps = np.cumsum(rates, axis=1)[:, :-1] ** 2 * (1 / before + 1 / before[::-1])
    drift, fast = np.zeros(means.shape), np.zeros(means.shape)
    for axis in np.flatnonzero(alone.max(axis=1) > limit):
        base, reduced = np.linalg.qr(centred.T)
        target = base.T @ rates[axis]
        fits = [(sign, *optimize.nnls(reduced, sign * target)) for sign in (1, -1)]
        sign, weights, left = min(fits, key=lambda fit: fit[2])
        if target @ target - left**2 > steps[axis].max():
            fast[axis], drift[axis] = (
                sign * weights[:2] @ shapes[:2],
                sign * weights[2:] @ shapes[2:],
            )
    return drift, fast


def time_constant(drift: Array, times_s: Array) -> float:
    """When 63 % of a drift, (block,), is done; infinite where it goes on in the last third."""
    done = np.abs(drift - drift[0])
    late = done[-1] - np.interp(times_s[0] / 3 + times_s[-1] * 2 / 3, times_s, done)
    if late > 0.15 * done.max():  # an exponential of half the duration
        return np.inf
    return float(times_s[np.argmax(done >= (1 - np.exp(-1)) * done[-1])])


def goes_to_zero(means: Array, noise: Array, least_dps: float = 3e-3, longest: int = 8) -> bool:
    """Whether a level goes to zero on all axes at once: the sensor takes its bias off by itself.

    Args:
        means: (axis, block), from the first row on.
        noise: (axis,).
        least_dps: Smaller means are zero.
        longest: Blocks in which it goes from 80 to 20 %: a warm-up takes longer.
    """
    late = means[:, -max(means.shape[1] // 4, 1) :]
    zero = np.clip(4 * noise / np.sqrt(late.shape[1]), least_dps, 4 * least_dps)
    level = np.abs(means[:, 0])
    was = np.count_nonzero(level > np.maximum(10 * zero, 5 * noise)) > 1
    if not was or (np.abs(late.mean(axis=1)) >= zero).any():
        return False
    middle = np.abs(np.abs(means[np.argmax(level)]) / level.max() - 0.5) < 0.3  # noqa: PLR2004
    return bool(np.count_nonzero(middle) <= longest)
