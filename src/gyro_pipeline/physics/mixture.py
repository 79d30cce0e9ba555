"""A normal prior of several axes that may be wrong: narrow, and wide on some set of the axes.

With probability 0.95 the prior of every axis is narrow; what remains is shared evenly by the sets
of axes on which it is wide instead, about the same mean. An estimate m of variance v is normal with
mean mu and variance s^2 + v under a prior N(mu, s^2), whose posterior is

    mean mu + g (m - mu),    variance g v,    g = s^2 / (s^2 + v)

and each set weighs as its prior probability times the likelihood of its axes. On one axis this is
the usual mixture of two.
"""

from functools import lru_cache
from itertools import product
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]

NARROW = 0.95
"""Probability that the prior is narrow on all axes."""


class Posterior(NamedTuple):
    """Of a quantity of some axes, (..., axis)."""

    mean: Array
    variance: Array  # of its error, over the whole mixture
    # The same with the wide prior's probability counted only as far as the data raised it: it
    # holds where the narrow prior does, and grows as soon as something speaks against it.
    charged: Array
    wide: Array  # probability that the axis's prior is the wide one


def log_ratios(off: ArrayLike, variance: ArrayLike, narrow: ArrayLike, wide: ArrayLike) -> Array:
    """Logarithm of the wide prior's likelihood over the narrow one's, (..., axis).

    Args:
        off: An estimate less the mean of the prior, (..., axis).
        variance: Of the estimate; infinite: no data.
        narrow: Variance of the narrow prior.
        wide: Variance of the wide prior.
    """
    own = np.asarray(variance, np.float64)
    small, large = np.add(narrow, own), np.add(wide, own)
    with np.errstate(invalid="ignore"):
        squares = np.square(off) * (1 / small - 1 / large)
        return np.where(np.isinf(own), 0.0, (squares - np.log(large / small)) / 2)


def log_e(ratios: Array) -> Array:
    """Logarithm of the mean likelihood ratio over the sets of axes, (...), from (..., axis).

    While data come in, it is an e-process: where the narrow prior holds, the mean ever exceeds
    1 / p with a probability of at most p (Ville 1939).
    """
    of_sets = np.sum(ratios[..., None, :] * _sets(ratios.shape[-1]), axis=-1)
    most = np.maximum(of_sets.max(axis=-1), 0.0)
    return np.asarray(np.log(np.mean(np.exp(of_sets - most[..., None]), axis=-1)) + most)


def mixture_posterior(
    estimate: ArrayLike, variance: ArrayLike, mean: ArrayLike, narrow: ArrayLike, wide: ArrayLike,
    share: float = NARROW,
) -> Posterior:  # fmt: skip
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
    estimates, own, centre, *priors = (np.asarray(x, np.float64) for x in given)
    unseen = np.isinf(own)
    off, own = np.where(unseen, 0.0, estimates - centre), np.where(unseen, 1.0, own)
    gains = [np.where(unseen, 0.0, prior / (prior + own)) for prior in priors]
    left = [np.where(unseen, p, gain * own) for p, gain in zip(priors, gains, strict=True)]
    sets = _sets(off.shape[-1])
    of_sets = np.where(unseen, 0.0, log_ratios(off, own, *priors)) @ sets.T
    most = np.maximum(of_sets.max(axis=-1), 0.0)
    weights = (1 - share) / len(sets) * np.exp(of_sets - most[..., None])
    weights = weights / (weights.sum(axis=-1) + share * np.exp(-most))[..., None]
    of_wide = weights @ sets
    before = (1 - share) * sets.mean(axis=0)
    counted = np.maximum(of_wide - before, 0) / (1 - before)
    means = [gain * off for gain in gains]
    result = (1 - of_wide) * means[0] + of_wide * means[1]
    spreads = [v + (m - result) ** 2 for v, m in zip(left, means, strict=True)]
    total, charged = ((1 - w) * spreads[0] + w * spreads[1] for w in (of_wide, counted))
    return Posterior(centre + result, total, charged, of_wide)


@lru_cache
def _sets(axes: int) -> Array:
    """All sets of one axis or more, (set, axis), 1 where an axis is in it."""
    return np.array(list(product([0.0, 1.0], repeat=axes))[1:])
