"""Whether gyroscopes were at rest: a likelihood-ratio test on the means of short blocks.

Skog, Händel, Nilsson and Rantakokko (Zero-velocity detection: an algorithm evaluation, IEEE
Transactions on Biomedical Engineering 57, 2010) compare the rate in a window with the noise of a
sensor at rest. Here the noise is the recording's own, in deg/s, and what the rate is compared with
is not zero but a bias that may drift: a gyroscope that warms up is at rest.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy import special

_TIME_CONSTANTS = (1 / 16, 1 / 8, 1 / 4, 1 / 2, 1)
"""Tried for a warm-up, in durations of the recording; the fit hardly differs between neighbours."""


@dataclass(frozen=True)
class Blocks:
    """The gyroscopes of one recording in blocks of equal length.

    Attributes:
        rates: (axis, block, sample), deg/s.
        starts: (block,), the first row of each. The last block ends with the recording, so that
            nothing is left out, and may share rows with the one before.
    """

    rates: NDArray[np.float64]
    starts: NDArray[np.integer]

    @classmethod
    def of(cls, rates: NDArray[np.float64], size: int) -> "Blocks":
        """Cut rates, (axis, n) with n at least ``size``, into blocks of so many samples."""
        n = rates.shape[-1]
        starts = np.arange(0, n - size + 1, size)
        blocks = rates[:, : starts.size * size].reshape(len(rates), -1, size)
        if n % size:
            starts = np.append(starts, n - size)
            blocks = np.concatenate([blocks, rates[:, None, -size:]], axis=1)
        return cls(blocks, starts)

    @property
    def size(self) -> int:
        """Samples per block."""
        return self.rates.shape[-1]

    @cached_property
    def means(self) -> NDArray[np.float64]:
        """(axis, block), deg/s."""
        return self.rates.mean(axis=-1)

    @cached_property
    def variances(self) -> NDArray[np.float64]:
        """(axis, block), (deg/s)^2: of the samples about the mean of their block."""
        return self.rates.var(axis=-1, ddof=1)

    @cached_property
    def noise(self) -> NDArray[np.float64]:
        """(axis,), deg/s: standard deviation of a sample; just under half the blocks may be odd."""
        freedom = self.size - 1
        median_of_one = special.chdtri(freedom, 0.5) / freedom  # of the variance of white noise
        return np.sqrt(np.median(self.variances, axis=-1) / median_of_one)

    def noisier_than(self, factor: float) -> NDArray[np.bool_]:
        """Blocks whose noise, as the root mean square over axes, exceeds the recording's: (block,).

        An axis without noise counts as steady.
        """
        own = self.noise[:, None] ** 2
        relative = np.divide(self.variances, own, out=np.ones_like(self.variances), where=own > 0)
        return relative.mean(axis=0) > factor**2

    def apart_from(self, bursts: NDArray[np.integer]) -> NDArray[np.bool_]:
        """Blocks at least a block away from all (first, last) rows, (bursts, 2): (block,)."""
        after, before = self.starts[:, None] - bursts[:, 1], bursts[:, 0] - self.starts[:, None]
        return np.all((after > self.size) | (before >= 2 * self.size), axis=1)

    def span(self, chosen: NDArray[np.bool_]) -> NDArray[np.integer]:
        """First and last row of the chosen blocks, of which there is one at least."""
        starts = self.starts[chosen]
        return np.array([starts[0], starts[-1] + self.size - 1])


def excursions(blocks: Blocks, false_alarm: float) -> NDArray[np.integer]:
    """Rows where an axis is farther from the median of its block than noise explains.

    Args:
        blocks: Of a recording.
        false_alarm: Probability that white Gaussian noise has any.

    Returns:
        (m,), increasing.
    """
    limits = -special.ndtri(false_alarm / (2 * blocks.rates.size)) * blocks.noise
    middle = blocks.size // 2
    wide = np.flatnonzero((np.ptp(blocks.rates, axis=-1) > limits[:, None]).any(axis=0))
    rates = blocks.rates[:, wide]  # in all others no two samples are so far apart
    medians = np.partition(rates, middle, axis=-1)[..., middle, None]
    beyond = np.abs(rates - medians) > limits[:, None, None]
    block, sample = np.nonzero(beyond.any(axis=0))
    return np.unique(blocks.starts[wide[block]] + sample)


def bursts(rows: NDArray[np.integer], apart: int) -> NDArray[np.integer]:
    """First and last row of each group of rows that are no more than ``apart`` from the next.

    Args:
        rows: (m,), increasing.
        apart: Rows.

    Returns:
        (groups, 2).
    """
    ends = np.flatnonzero(np.diff(rows) > apart)
    firsts, lasts = np.insert(ends + 1, 0, 0), np.append(ends, rows.size - 1)
    return np.stack([rows[firsts], rows[lasts]], axis=1) if rows.size else np.empty((0, 2), int)


def mean_noise(blocks: Blocks, calm: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Standard deviation of the mean of a block, from the differences of neighbours.

    Differences leave a drift out, and their median leaves out what a few blocks do. It is at least
    that of white noise: the median of a few differences is now and then far too small.

    Args:
        blocks: Of a recording.
        calm: (block,), the ones to use.

    Returns:
        (axis,), deg/s.
    """
    white = blocks.noise / np.sqrt(blocks.size)
    differences = np.abs(np.diff(blocks.means, axis=-1))[:, calm[1:] & calm[:-1]]
    if not differences.size:
        return white
    # of |d|, d normal with variance 2 s^2, the median is 0.6745 sqrt(2) s
    return np.maximum(np.median(differences, axis=-1) / (special.ndtri(0.75) * np.sqrt(2)), white)


def changes(
    blocks: Blocks, calm: NDArray[np.bool_], lags: Sequence[int], false_alarm: float
) -> NDArray[np.bool_]:
    """Blocks about which the rate departs from a steady or steadily drifting one.

    For blocks k - L, k and k + L, the generalised likelihood ratio of any three rates against three
    on a straight line is, twice its logarithm, the sum over axes of
    (m[k - L] - 2 m[k] + m[k + L])^2 / (6 s^2), chi-squared with a degree of freedom per axis at
    rest, where s is the standard deviation of a block's mean m. Neither white nor flicker noise
    has more of it at longer averaging times, so the s of blocks serves for all lags.

    Args:
        blocks: Of a recording.
        calm: (block,), the ones to use.
        lags: L, in blocks; a short one for quick movements, a long one for slow onsets.
        false_alarm: Probability that white noise has any change.

    Returns:
        (block,), true for a middle block k.
    """
    count = calm.size
    found = np.zeros(count, bool)
    scale = 6 * mean_noise(blocks, calm)[:, None] ** 2
    limit = special.chdtri(len(blocks.means), false_alarm / (len(lags) * count))
    for lag in (lag for lag in lags if 2 * lag < count):
        left, middle, right = (slice(i * lag, count - (2 - i) * lag) for i in range(3))
        bend = blocks.means[:, left] - 2 * blocks.means[:, middle] + blocks.means[:, right]
        ratio = (bend**2 / scale).sum(axis=0)
        found[middle] |= (ratio > limit) & calm[left] & calm[middle] & calm[right]
    return found


@dataclass(frozen=True)
class Drift:
    """How one gyroscope's bias settles: by ``size_dps`` from the first sample to the last."""

    axis: int
    size_dps: float
    time_constant_s: float


def drifts(
    blocks: Blocks,
    calm: NDArray[np.bool_],
    rate_hz: float,
    false_alarm: float,
    least_dps: float,
) -> list[Drift]:
    """The warm-up of each axis that has one: exponentials fitted to the means of blocks.

    Args:
        blocks: Of a recording.
        calm: (block,), the ones to use; at least three.
        rate_hz: Samples per second.
        false_alarm: Probability that white noise has any drift.
        least_dps: Smaller ones are left out: flicker noise wanders as well.

    Returns:
        By axis, those whose likelihood ratio against a constant bias is significant.
    """
    duration_s = (blocks.starts[-1] + blocks.size) / rate_hz
    constants_s = duration_s * np.array(_TIME_CONSTANTS)
    time_s = (blocks.starts[calm] + blocks.size / 2) / rate_hz
    shapes = np.exp(-time_s / constants_s[:, None])
    shapes -= shapes.mean(axis=-1, keepdims=True)
    means = blocks.means[:, calm]
    means = means - means.mean(axis=-1, keepdims=True)
    products, energies = means @ shapes.T, (shapes**2).sum(axis=-1)
    ratios = products**2 / energies / mean_noise(blocks, calm)[:, None] ** 2
    best = ratios.argmax(axis=-1)
    limit = special.chdtri(1, false_alarm / ratios.size)
    sizes = products / energies * np.expm1(-duration_s / constants_s)
    return [
        Drift(axis, float(sizes[axis, k]), float(constants_s[k]))
        for axis, k in enumerate(best)
        if ratios[axis, k] > limit and abs(sizes[axis, k]) >= least_dps
    ]
