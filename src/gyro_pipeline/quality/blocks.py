"""The rows of a recording: which hold a measurement, and what blocks of them average to."""

from dataclasses import dataclass
from statistics import NormalDist

import numpy as np
from numpy.typing import NDArray
from scipy import special

Rows = NDArray[np.bool_]
"""(n,), true where a row holds no measurement."""


@dataclass(frozen=True)
class Blocks:
    """Means and variances of blocks of equal length, those left out of which too much is masked.

    Attributes:
        size: Rows of a block.
        starts: (block,), their first rows.
        means: (axis, block), deg/s.
        variances: (axis, block), (deg/s)^2, about the mean of the block.
        highest: (axis, block), deg/s, the largest sample.
        lowest: (axis, block), deg/s, the smallest.
    """

    size: int
    starts: NDArray[np.integer]
    means: NDArray[np.float64]
    variances: NDArray[np.float64]
    highest: NDArray[np.float64]
    lowest: NDArray[np.float64]

    def where(self, chosen: NDArray[np.bool_] | slice) -> "Blocks":
        """Some of them."""
        arrays = (self.starts, self.means, self.variances, self.highest, self.lowest)
        return Blocks(self.size, *(array[..., chosen] for array in arrays))

    @property
    def sigma(self) -> NDArray[np.float64]:
        """(axis,), deg/s, standard deviation of a sample; nearly half of the blocks may be odd."""
        median_of_one = special.chdtri(self.size - 1, 0.5) / (self.size - 1)
        return np.sqrt(np.median(self.variances, axis=1) / median_of_one)

    @property
    def noise(self) -> NDArray[np.float64]:
        """(axis,), deg/s, of a block mean, from the differences of neighbours, or as in white noise."""
        usual = np.median(np.abs(np.diff(self.means, axis=1)), axis=1) / (0.6745 * np.sqrt(2))
        return np.maximum(usual, self.sigma / np.sqrt(self.size))


def fill(rates: NDArray[np.float64], masked: Rows) -> NDArray[np.float64]:
    """Samples with a straight line in place of masked rows: (axis, n)."""
    if not masked.any():
        return rates
    rows, used = np.arange(masked.size), np.flatnonzero(~masked)
    return np.array([np.interp(rows, used, axis[used]) for axis in rates])


def cut_blocks(rates: NDArray[np.float64], masked: Rows, size: int) -> Blocks:
    """Average blocks; the last one ends with the recording, and may share rows with its neighbour.

    Args:
        rates: (axis, n), deg/s, filled, of at least ``size`` rows.
        masked: (n,); a block of which more than a quarter is masked is left out.
        size: Rows of a block.
    """
    starts = np.arange(0, masked.size - size + 1, size)
    samples = rates[:, : starts.size * size].reshape(len(rates), -1, size)
    if masked.size % size:
        starts = np.append(starts, masked.size - size)
        samples = np.concatenate([samples, rates[:, None, -size:]], axis=1)
    means = samples.mean(axis=-1)
    apart = samples - means[..., None]
    extremes = samples.max(axis=-1), samples.min(axis=-1)
    squares = np.einsum("abs,abs->ab", apart, apart)
    if not masked.any():
        return Blocks(size, starts, means, squares / (size - 1), *extremes)
    lost = np.concatenate([[0], np.cumsum(masked)])
    used = size - (lost[starts + size] - lost[starts])
    blocks = Blocks(size, starts, means, squares / np.maximum(used - 1, 1), *extremes)
    return blocks.where(used >= 0.75 * size)


def rows_between_zeros(rates: NDArray[np.float64]) -> tuple[int, int]:
    """First row that is not zero on every axis, and the row after the last; equal if all are."""
    n = rates.shape[1]
    if rates[:, 0].any() and rates[:, -1].any():
        return 0, n
    rows = np.flatnonzero(rates.any(axis=0))
    return (int(rows[0]), int(rows[-1]) + 1) if rows.size else (n, n)


def longest_stretch(masked: Rows, gap_rows: NDArray[np.integer]) -> tuple[int, int]:
    """Of the rows between two gaps of which most can be used: the first such, and after the last."""
    edges = np.unique(np.concatenate([[0], gap_rows, [masked.size]])).astype(np.intp)
    used = np.concatenate([[0], np.cumsum(~masked)])
    if not used[-1]:
        return 0, 0
    longest = int(np.argmax(np.diff(used[edges])))
    rows = edges[longest] + np.flatnonzero(~masked[edges[longest] : edges[longest + 1]])
    return int(rows[0]), int(rows[-1]) + 1


def stuck(rates: NDArray[np.float64], least: int, false_alarm: float) -> NDArray[np.bool_]:
    """Samples in a run of equal ones that is longer than chance allows.

    Where a sample equals the one before with probability p, n samples hold a run of more than k
    with a probability of at most n p^k. p is the axis's own, from its samples outside the longest
    run, so a coarse quantisation allows longer runs.

    Args:
        rates: (axis, n), deg/s; NaN equals nothing.
        least: Shorter runs are let pass: a packet that is sent twice harms no mean.
        false_alarm: Probability that an axis has any such run at rest.

    Returns:
        (axis, n).
    """
    held = np.zeros(rates.shape, bool)
    same = rates[:, 1:] == rates[:, :-1]
    for axis in np.flatnonzero(np.count_nonzero(same, axis=1) + 1 >= least):
        edges = np.concatenate([[0], np.flatnonzero(~same[axis]) + 1, [rates.shape[1]]])
        lengths = np.diff(edges)
        others = lengths.sum() - lengths.max()
        p = (others - lengths.size + 2) / (others + 2)  # Laplace's: never 0 or 1
        allowed = max(least - 1, np.ceil(np.log(false_alarm / rates.shape[1]) / np.log(p)))
        held[axis] = np.repeat(lengths > allowed, lengths)
    return held


def excursions(
    rates: NDArray[np.float64], blocks: Blocks, false_alarm: float, apart: int = 2
) -> NDArray[np.integer]:
    """Bursts of rows farther from the level about them than noise explains.

    The level is the median of the means of nine blocks, so a movement of up to four does not hide
    itself. The limit knows how many samples it is compared with, and that the level scatters.

    Args:
        rates: (axis, n), deg/s, filled.
        blocks: Of these, ten at least.
        false_alarm: Probability that white Gaussian noise has any.
        apart: Rows; such are one burst if no farther apart.

    Returns:
        (burst, 2): first and last row of each.
    """
    padded = np.pad(blocks.means, ((0, 0), (4, 4)), "reflect", reflect_type="odd")  # keeps a slope
    levels = np.median(np.lib.stride_tricks.sliding_window_view(padded, 9, axis=1), axis=2)
    normal = -NormalDist().inv_cdf(false_alarm / (2 * rates.size))
    limits = normal * np.sqrt(1 + np.pi / (18 * blocks.size)) * _usual(rates, blocks)
    most = np.maximum(blocks.highest - levels, levels - blocks.lowest)
    wide = np.flatnonzero((most > limits[:, None]).any(axis=0))
    if not wide.size:
        return np.empty((0, 2), np.intp)
    rows = blocks.starts[wide, None] + np.arange(blocks.size)
    beyond = np.abs(rates[:, rows] - levels[:, wide, None]) > limits[:, None, None]
    rows = np.unique(rows[beyond.any(axis=0)])
    ends = np.flatnonzero(np.diff(rows) > apart)
    return np.stack([rows[np.r_[0, ends + 1]], rows[np.r_[ends, rows.size - 1]]], axis=1)


def _usual(rates: NDArray[np.float64], blocks: Blocks) -> NDArray[np.float64]:
    """(axis,), deg/s: sigma, from the median of some samples where rare large ones swell it."""
    sigma = blocks.sigma
    some = np.linspace(0, len(blocks.starts) - 1, min(len(blocks.starts), 1 + 4000 // blocks.size))
    some = some.astype(np.intp)
    samples = rates[:, (blocks.starts[some, None] + np.arange(blocks.size)).ravel()]
    apart = np.abs(samples - np.repeat(blocks.means[:, some], blocks.size, axis=1))
    calm = np.median(apart, axis=1) / 0.6745
    return np.where((calm > 0) & (calm < sigma / 2), calm, sigma)
