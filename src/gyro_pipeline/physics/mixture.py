"""A robust prior for several axes: a mixture of normal distributions, narrow or wide on each axis.

With probability 0.95 the prior is narrow on all axes. The remaining probability is shared equally
among all sets of axes on which the prior is wide instead, with the same mean. Under a prior
N(mu, s^2), an estimate m with variance v is normal with mean mu and variance s^2 + v, and the
posterior has

    mean mu + g (m - mu),    variance g v,    g = s^2 / (s^2 + v)

The weight of each set is its prior probability times the likelihood of its axes. For a single axis
this is the usual mixture of two components.
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
    """Posterior of a quantity for several axes, each field (..., axis)."""

    mean: Array
    variance: Array  # of the error, over the whole mixture
    # The variance with the wide prior's probability counted only as far as the data raised it. It
    # is calibrated if the narrow prior holds, and grows as soon as data contradict this prior.
    charged: Array
    wide: Array  # probability that the prior of the axis is wide


def log_ratios(off: ArrayLike, variance: ArrayLike, narrow: ArrayLike, wide: ArrayLike) -> Array:
    """Logarithm of the ratio of the wide to the narrow prior's likelihood, (..., axis).

    Args:
        off: An estimate minus the mean of the prior, (..., axis).
        variance: Variance of the estimate; infinite without data.
        narrow: Variance of the narrow prior.
        wide: Variance of the wide prior.
    """
    error = np.asarray(variance, np.float64)
    small, large = np.add(narrow, error), np.add(wide, error)
    with np.errstate(invalid="ignore"):
        squares = np.square(off) * (1 / small - 1 / large)
        return np.where(np.isinf(error), 0.0, (squares - np.log(large / small)) / 2)


def log_e(ratios: Array) -> Array:
    """Logarithm of the mean likelihood ratio over the sets of axes, (...), from (..., axis).

    As data arrive, this is an e-process: if the narrow prior holds, the mean ratio ever exceeds
    1 / p with probability p at most (Ville 1939).
    """
    set_ratios = np.sum(ratios[..., None, :] * _sets(ratios.shape[-1]), axis=-1)
    largest = np.maximum(set_ratios.max(axis=-1), 0.0)
    return np.asarray(np.log(np.mean(np.exp(set_ratios - largest[..., None]), axis=-1)) + largest)


def mixture_posterior(
    estimate: ArrayLike, variance: ArrayLike, mean: ArrayLike, narrow: ArrayLike, wide: ArrayLike,
    share: float = NARROW,
) -> Posterior:  # fmt: skip
    """The posterior of a quantity; all arguments are (..., axis), or broadcast to that.

    Args:
        estimate: Estimate by data alone; any value where its variance is infinite.
        variance: Variance of the estimate.
        mean: Mean of the prior.
        narrow: Variance of the narrow prior.
        wide: Variance of the wide prior.
        share: Probability that the prior is narrow on all axes, from 0 to 1.
    """
    arguments = np.broadcast_arrays(estimate, variance, mean, narrow, wide)
    estimates, error, centre, *priors = (np.asarray(x, np.float64) for x in arguments)
    unseen = np.isinf(error)
    off, error = np.where(unseen, 0.0, estimates - centre), np.where(unseen, 1.0, error)
    gains = [np.where(unseen, 0.0, prior / (prior + error)) for prior in priors]
    variances = [np.where(unseen, p, gain * error) for p, gain in zip(priors, gains, strict=True)]
    sets = _sets(off.shape[-1])
    set_ratios = np.where(unseen, 0.0, log_ratios(off, error, *priors)) @ sets.T
    largest = np.maximum(set_ratios.max(axis=-1), 0.0)
    weights = (1 - share) / len(sets) * np.exp(set_ratios - largest[..., None])
    weights = weights / (weights.sum(axis=-1) + share * np.exp(-largest))[..., None]
    p_wide = weights @ sets
    p_before = (1 - share) * sets.mean(axis=0)
    p_raised = np.maximum(p_wide - p_before, 0) / (1 - p_before)
    means = [gain * off for gain in gains]
    result = (1 - p_wide) * means[0] + p_wide * means[1]
    squares = [v + (m - result) ** 2 for v, m in zip(variances, means, strict=True)]
    total, charged = ((1 - p) * squares[0] + p * squares[1] for p in (p_wide, p_raised))
    return Posterior(centre + result, total, charged, p_wide)


@lru_cache
def _sets(axes: int) -> Array:
    """All nonempty sets of axes, (set, axis), 1 for the members of a set."""
    return np.array(list(product([0.0, 1.0], repeat=axes))[1:])
