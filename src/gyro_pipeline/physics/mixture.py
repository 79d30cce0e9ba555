"""A normal prior of several axes that may be wrong: narrow, and wide on some set of the axes.

With probability 0.95 the prior of every axis is narrow; what remains is shared evenly by the sets
of axes on which it is wide instead, about the same mean. An estimate m of variance v is normal with
mean mu and variance s^2 + v under a prior N(mu, s^2), whose posterior is

    mean mu + g (m - mu),    variance g v,    g = s^2 / (s^2 + v)

and each set weighs as its prior probability times the likelihood of its axes. On one axis this is
the usual mixture of two.
"""

from dataclasses import dataclass
from functools import lru_cache
from itertools import combinations

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]

NARROW = 0.95
"""Probability that the prior is narrow on all axes."""


@dataclass(frozen=True)
class Posterior:
    """Of a quantity of some axes, (..., axis).

    Attributes:
        mean: Of the quantity.
        variance: Of its error, over the whole mixture.
        charged: The same with the wide prior's probability counted only as far as the data raised
            it: the variance that holds where the narrow prior does, and that grows as soon as
            something speaks against it.
        wide: Probability that the axis's prior is the wide one.
        log_ratio: Logarithm of the wide prior's likelihood over the narrow one's.
        log_e: (...), of its mean over the sets. That mean is an e-process while data come in:
            where the narrow prior holds, it ever exceeds 1 / p with a probability of at most p
            (Ville 1939).
    """

    mean: Array
    variance: Array
    charged: Array
    wide: Array
    log_ratio: Array
    log_e: Array


def mixture_posterior(
    estimate: ArrayLike,
    variance: ArrayLike,
    mean: ArrayLike,
    narrow: ArrayLike,
    wide: ArrayLike,
    share: float = NARROW,
) -> Posterior:
    """The posterior of a quantity; all arguments are (..., axis), or broadcast to that.

    Args:
        estimate: Of it, by data alone; any value where its variance is infinite.
        variance: Of the estimate.
        mean: Of the prior.
        narrow: Variance of the narrow prior.
        wide: Variance of the wide prior.
        share: Probability that all are narrow, from 0 to 1.
    """
    given = np.broadcast_arrays(estimate, variance, mean, narrow, wide)
    estimates, own, centre, small, large = (np.asarray(x, np.float64) for x in given)
    unseen = np.isinf(own)
    own = np.where(unseen, 1.0, own)
    off = np.where(unseen, 0.0, estimates - centre)
    gains = [np.where(unseen, 0.0, prior / (prior + own)) for prior in (small, large)]
    left = [
        np.where(unseen, prior, gain * own)
        for prior, gain in zip((small, large), gains, strict=True)
    ]
    squares = off**2 * (1 / (small + own) - 1 / (large + own))
    log_ratio = np.where(unseen, 0.0, (squares - np.log((large + own) / (small + own))) / 2)
    sets = _sets(off.shape[-1])
    of_sets = log_ratio @ sets.T
    most = np.maximum(of_sets.max(axis=-1), 0.0)
    ratios = np.exp(of_sets - most[..., None])
    log_e = np.log(np.mean(ratios, axis=-1)) + most
    weights = (1 - share) / len(sets) * ratios
    weights = weights / (weights.sum(axis=-1) + share * np.exp(-most))[..., None]
    of_wide = weights @ sets
    before = (1 - share) * sets.mean(axis=0)
    counted = np.maximum(of_wide - before, 0) / (1 - before)
    means = [gain * off for gain in gains]
    result = (1 - of_wide) * means[0] + of_wide * means[1]
    spreads = [v + (m - result) ** 2 for v, m in zip(left, means, strict=True)]
    total, charged = ((1 - w) * spreads[0] + w * spreads[1] for w in (of_wide, counted))
    return Posterior(centre + result, total, charged, of_wide, log_ratio, np.asarray(log_e))


@lru_cache
def _sets(axes: int) -> Array:
    """All sets of one axis or more, (set, axis), 1 where an axis is in it."""
    sizes = range(1, axes + 1)
    sets = [chosen for size in sizes for chosen in combinations(range(axes), size)]
    return np.array([[axis in chosen for axis in range(axes)] for chosen in sets], np.float64)
