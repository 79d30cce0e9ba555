"""Whether gyroscopes were at rest: a likelihood-ratio test on the means of short blocks.

Skog, Händel, Nilsson and Rantakokko (Zero-velocity detection: an algorithm evaluation, IEEE
Transactions on Biomedical Engineering 57, 2010) compare the rate in a window with the noise of a
sensor at rest. Here the noise is the recording's own, in deg/s, and what the rate is compared with
is not zero but a bias that may drift: a gyroscope that warms up is at rest.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy import optimize, special

_TIME_CONSTANTS = (1 / 512, 1 / 256, 1 / 128, 1 / 64, 1 / 32, 1 / 16, 1 / 8, 1 / 4, 1 / 2, 1)
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
    def _squares(self) -> NDArray[np.float64]:
        """(axis, block, sample), (deg/s)^2: of the distance from the mean of the block."""
        apart = self.rates - self.means[..., None]
        return np.square(apart, out=apart)

    @cached_property
    def variances(self) -> NDArray[np.float64]:
        """(axis, block), (deg/s)^2: of the samples about the mean of their block."""
        return self._squares.sum(axis=-1) / (self.size - 1)

    def kurtosis(self, calm: NDArray[np.bool_]) -> NDArray[np.float64]:
        """(axis,): of the samples of calm blocks about their means; 3 in Gaussian noise."""
        fourth = np.einsum("abs,abs->ab", self._squares, self._squares)[:, calm].mean(axis=1)
        second = self.variances[:, calm].mean(axis=1) * (self.size - 1) / self.size
        gaussian = np.full_like(second, 3.0)  # what an axis without noise passes for
        return np.divide(fourth / self.size, second**2, out=gaussian, where=second > 0)

    @cached_property
    def noise(self) -> NDArray[np.float64]:
        """(axis,), deg/s: standard deviation of a sample; just under half the blocks may be odd."""
        freedom = self.size - 1
        median_of_one = special.chdtri(freedom, 0.5) / freedom  # of the variance of white noise
        return np.sqrt(np.median(self.variances, axis=-1) / median_of_one)

    @cached_property
    def relative_variances(self) -> NDArray[np.float64]:
        """(block,): over that of the recording, mean of the axes; one without noise is steady."""
        own = self.noise[:, None] ** 2
        relative = np.divide(self.variances, own, out=np.ones_like(self.variances), where=own > 0)
        return relative.mean(axis=0)

    def noise_range(self, calm: NDArray[np.bool_], count: int) -> float:
        """Largest over smallest noise of so many neighbouring blocks, all of them calm."""
        if count > calm.size:
            return 1.0
        ones = np.ones(count)
        all_calm = np.convolve(calm, ones, "valid") > count - 0.5
        sums = np.convolve(self.relative_variances, ones, "valid")[all_calm]
        return float(np.sqrt(sums.max() / sums.min())) if sums.size and sums.min() > 0 else 1.0

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


@dataclass(frozen=True)
class Means:
    """Means of the blocks of one recording.

    Attributes:
        rates: (axis, block), deg/s.
        calm: (block,), those to use.
        times: (block,), from the start of the recording to their middles, in durations of it.
        noise: (axis,), deg/s: standard deviation of the mean of a block at rest.
    """

    rates: NDArray[np.float64]
    calm: NDArray[np.bool_]
    times: NDArray[np.float64]
    noise: NDArray[np.float64]

    @classmethod
    def of(cls, blocks: Blocks, calm: NDArray[np.bool_]) -> "Means":
        """Take the noise from the differences of neighbours.

        Differences leave a drift out, and their median leaves out what a few blocks do. It is at
        least that of white noise: the median of a few differences is now and then far too small.
        """
        noise = blocks.noise / np.sqrt(blocks.size)
        differences = np.abs(np.diff(blocks.means, axis=-1))[:, calm[1:] & calm[:-1]]
        if differences.size:
            # of |d|, d normal with variance 2 s^2, the median is 0.6745 sqrt(2) s
            usual = np.median(differences, axis=-1) / (special.ndtri(0.75) * np.sqrt(2))
            noise = np.maximum(usual, noise)
        duration = blocks.starts[-1] + blocks.size
        return cls(blocks.means, calm, (blocks.starts + blocks.size / 2) / duration, noise)

    @property
    def spread(self) -> NDArray[np.float64]:
        """(axis,), deg/s: standard deviation of the calm ones."""
        return self.rates[:, self.calm].std(axis=1) if self.calm.any() else 0 * self.noise

    def without(self, rates: NDArray[np.float64]) -> "Means":
        """The same less rates, (axis, block), deg/s."""
        return replace(self, rates=self.rates - rates)

    @property
    def decays(self) -> NDArray[np.float64]:
        """Exponentials that begin with the recording: (time constant, block)."""
        return np.exp(-self.times / np.array(_TIME_CONSTANTS)[:, None])


def changes(means: Means, lags: Sequence[int], false_alarm: float) -> NDArray[np.bool_]:
    """Blocks about which the rate departs from a steady or steadily drifting one.

    For three neighbouring stretches of L blocks, the generalised likelihood ratio of any three
    rates against three on a straight line is, twice its logarithm, the sum over axes of
    (m[1] - 2 m[2] + m[3])^2 / (6 s^2), chi-squared with a degree of freedom per axis at rest, where
    s is the standard deviation of the mean m of a stretch. It is that of a block over the root of
    L, as in white noise, or what most stretches show, up to that of a block, as in flicker noise.
    At least half of a stretch is calm; its mean is that of its calm blocks.

    Args:
        means: Of the blocks of a recording.
        lags: L, in blocks; a short one for quick movements, a long one for slow or small ones.
        false_alarm: Probability that white noise has any change.

    Returns:
        (block,), true for a block in the middle.
    """
    count = means.calm.size
    found = np.zeros(count, bool)
    limit = special.chdtri(len(means.rates), false_alarm / (len(lags) * count))
    totals = np.zeros((1 + len(means.rates), count + 1))  # up to each block
    np.cumsum(np.vstack([means.calm, means.rates * means.calm]), axis=1, out=totals[:, 1:])
    for lag in (lag for lag in lags if 3 * lag <= count):
        sums = totals[:, lag:] - totals[:, :-lag]
        used, rates = sums[0], sums[1:] / np.maximum(sums[0], 1)
        first, last = used.size - 2 * lag, used.size - lag  # ends of the left and middle ones
        left, middle, right = rates[:, :first], rates[:, lag:last], rates[:, 2 * lag :]
        a, b, c = used[:first], used[lag:last], used[2 * lag :]
        usable = 2 * np.minimum(np.minimum(a, b), c) >= lag
        if not usable.any():
            continue
        variance = 1 / a[usable] + 4 / b[usable] + 1 / c[usable]
        bends = np.abs(left - 2 * middle + right)[:, usable] / np.sqrt(variance)
        most = np.partition(bends, bends.shape[1] // 2, axis=1)[:, bends.shape[1] // 2]
        usual = most / special.ndtri(0.75)
        noise = np.clip(usual, means.noise, means.noise * np.sqrt(lag))
        ratio = ((bends / noise[:, None]) ** 2).sum(axis=0)
        found[lag + lag // 2 + np.flatnonzero(usable)[ratio > limit]] = True
    return found


def settling(means: Means, line: bool = False) -> NDArray[np.float64]:
    """The drift of each axis, as exponentials of one sign that begin with the recording.

    Args:
        means: Of the blocks of a recording, two of them calm at least.
        line: Add one; with it, other smooth curves are fitted as well.

    Returns:
        (axis, block), deg/s, of least squares, but for a constant.
    """
    calm = means.calm
    lines = [means.times, -means.times] if line else []
    shapes = np.vstack([means.decays, *lines]).T
    shapes -= shapes[calm].mean(axis=0)
    rates = means.rates - means.rates[:, calm].mean(axis=-1, keepdims=True)
    fits = []
    for axis in rates:
        both = [(sign, *optimize.nnls(shapes[calm], sign * axis[calm])) for sign in (1, -1)]
        sign, weights, _ = min(both, key=lambda fit: fit[2])
        fits.append(sign * shapes @ weights)
    return np.array(fits)


@dataclass(frozen=True)
class Drift:
    """How one gyroscope's bias settles: by ``size_dps`` from the first sample to the last."""

    axis: int
    size_dps: float
    time_constant_s: float


def drifts(means: Means, duration_s: float, false_alarm: float, least_dps: float) -> list[Drift]:
    """The warm-up of each axis that has one: exponentials fitted to the means of blocks.

    Args:
        means: Of the blocks of a recording, three of them calm at least.
        duration_s: Of the recording.
        false_alarm: Probability that white noise has any drift.
        least_dps: Smaller ones are left out: flicker noise wanders as well.

    Returns:
        By axis, those whose likelihood ratio against a constant bias is significant.
    """
    constants_s = duration_s * np.array(_TIME_CONSTANTS)
    shapes = means.decays[:, means.calm]
    shapes -= shapes.mean(axis=-1, keepdims=True)
    rates = means.rates[:, means.calm]
    rates = rates - rates.mean(axis=-1, keepdims=True)
    products, energies = rates @ shapes.T, (shapes**2).sum(axis=-1)
    ratios = products**2 / energies / means.noise[:, None] ** 2
    best = ratios.argmax(axis=-1)
    limit = special.chdtri(1, false_alarm / ratios.size)
    sizes = products / energies * np.expm1(-duration_s / constants_s)
    return [
        Drift(axis, float(sizes[axis, k]), float(constants_s[k]))
        for axis, k in enumerate(best)
        if ratios[axis, k] > limit and abs(sizes[axis, k]) >= least_dps
    ]
