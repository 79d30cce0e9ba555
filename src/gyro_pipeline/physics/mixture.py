"""A normal prior that may be wrong: a mixture of a narrow and a wide one of the same mean.

An estimate m of variance v is seen. Under a prior of mean mu and variance s_j^2 it is normal with
mean mu and variance s_j^2 + v; the posterior of each is mu + s_j^2 / (s_j^2 + v) (m - mu), and it
weighs as its share of the prior times that density.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]

NARROW = 0.95
"""Share of the narrow prior."""


@dataclass(frozen=True)
class Posterior:
    """Of a quantity under the mixture, elementwise.

    Attributes:
        mean: Of the quantity.
        variance: Of its error: within the two components and between them.
        log_ratio: Logarithm of the wide prior's likelihood over the narrow one's. Its exponential
            is an e-process while data come in: where the narrow prior holds, it ever exceeds 1 / p
            with a probability of at most p (Ville 1939).
    """

    mean: Array
    variance: Array
    log_ratio: Array


def mixture_posterior(
    estimate: ArrayLike,
    variance: ArrayLike,
    mean: ArrayLike,
    narrow: ArrayLike,
    wide: ArrayLike,
    share: float = NARROW,
) -> Posterior:
    """The posterior of a quantity.

    Args:
        estimate: Of it, by data alone; any value where its variance is infinite.
        variance: Of the estimate.
        mean: Of the prior.
        narrow: Variance of the narrow prior.
        wide: Variance of the wide prior.
        share: Of the narrow prior, from 0 to 1.
    """
    given = np.broadcast_arrays(estimate, variance, mean, narrow, wide)
    estimates, own, centre, *both = (np.asarray(x, np.float64) for x in given)
    priors = np.stack(both)
    shares = np.array([share, 1 - share]).reshape(2, *[1] * centre.ndim)
    unseen = np.isinf(own)
    total = priors + np.where(unseen, 1.0, own)
    off = np.where(unseen, 0.0, estimates - centre)
    gain = np.where(unseen, 0.0, priors / total)
    logs = np.where(unseen, 0.0, -0.5 * (np.log(total) + off**2 / total))
    logs_with_shares = logs + np.log(shares)
    weights = np.exp(logs_with_shares - logs_with_shares.max(axis=0))
    weights /= weights.sum(axis=0)
    posterior = np.sum(weights * gain, axis=0) * off
    spread = np.sum(weights * ((1 - gain) * priors + (gain * off) ** 2), axis=0)
    return Posterior(centre + posterior, spread - posterior**2, logs[1] - logs[0])
