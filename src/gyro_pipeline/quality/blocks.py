"""The rows of a recording: which of them hold no measurement, and what blocks of them average to.

Rates are (axis, n), deg/s; a mask is (n,), true where a row holds no measurement.
"""

from dataclasses import dataclass
from functools import cached_property
from statistics import NormalDist

import numpy as np
from numpy.typing import NDArray
from scipy import special

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class Blocks:
    """Blocks of ``size`` rows: first rows (block,), and (axis, block) in deg/s what they hold.

    ``variances`` are about the means, ``apart`` and ``reach`` mean and largest distance to them.
    """

    size: int
    starts: NDArray[np.integer]
    means: Array
    variances: Array
    apart: Array
    reach: Array

    def where(self, chosen: Mask | slice) -> "Blocks":
        """Some of them."""
        arrays = (self.means, self.variances, self.apart, self.reach)
        return Blocks(self.size, self.starts[chosen], *(array[:, chosen] for array in arrays))

    @cached_property
    def sigma(self) -> Array:
        """(axis,), deg/s, standard deviation of a sample; nearly half of the blocks may be odd."""
        median_of_one = special.chdtri(self.size - 1, 0.5) / (self.size - 1)
        return np.sqrt(np.median(self.variances, axis=1) / median_of_one)

    @cached_property
    def noise(self) -> Array:
        """(axis,), deg/s, of a block mean: as neighbours differ, or at least as in white noise."""
        usual = np.median(np.abs(np.diff(self.means, axis=1)), axis=1) / (0.6745 * np.sqrt(2))
        return np.maximum(usual, self.sigma / np.sqrt(self.size))


def fill(rates: Array, masked: Mask) -> Array:
    """Rates with a straight line in place of masked rows."""
    if not masked.any():
        return rates
    rows, used, filled = np.flatnonzero(masked), np.flatnonzero(~masked), rates.copy()
    filled[:, rows] = [np.interp(rows, used, axis[used]) for axis in rates]
    return filled


def cut_blocks(rates: Array, masked: Mask, size: int) -> Blocks:
    """Blocks of filled rates, but for those of which more than a quarter is masked.

    The last one ends with the recording, and may share rows with the one before.
    """
    starts = np.arange(0, masked.size - size + 1, size)
    samples = rates[:, : starts.size * size].reshape(len(rates), -1, size)
    if masked.size % size:
        starts = np.append(starts, masked.size - size)
        samples = np.concatenate([samples, rates[:, None, -size:]], axis=1)
    means = samples.mean(axis=-1)
    apart = samples - means[..., None]
    squares = np.einsum("abs,abs->ab", apart, apart)
    apart = np.abs(apart, out=apart)
    lost = np.concatenate([[0], np.cumsum(masked)])
    used = size - (lost[starts + size] - lost[starts])
    variances = squares / np.maximum(used - 1, 1)
    blocks = Blocks(size, starts, means, variances, apart.mean(axis=-1), apart.max(axis=-1))
    return blocks if used.min() == size else blocks.where(used >= 0.75 * size)


def longest_stretch(masked: Mask, gap_rows: NDArray[np.integer]) -> tuple[int, int]:
    """Of the rows between two gaps of which most can be used: the first such, and past the last."""
    edges = np.unique(np.concatenate([[0], gap_rows, [masked.size]])).astype(np.intp)
    used = np.concatenate([[0], np.cumsum(~masked)])
    if not used[-1]:
        return 0, 0
    longest = int(np.argmax(np.diff(used[edges])))
    rows = edges[longest] + np.flatnonzero(~masked[edges[longest] : edges[longest + 1]])
    return int(rows[0]), int(rows[-1]) + 1


def stuck(rates: Array, least: int, false_alarm: float) -> NDArray[np.bool_]:
    """Samples, (axis, n), in a run of ``least`` or more equal ones, longer than chance allows.

    Where a sample equals the one before with probability p, n samples hold a run of more than k
    with a probability of at most n p^k. p is the axis's own, from its samples outside the longest
    run, so a coarse quantisation allows longer runs.
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


def excursions(rates: Array, blocks: Blocks, false_alarm: float) -> Mask:
    """Rows farther from the level about them than noise explains.

    The level is the median of the means of nine blocks, so that a movement does not hide itself.
    White noise has any with a probability of ``false_alarm``, however many samples there are. At
    least seven blocks are needed.
    """
    normal = -NormalDist().inv_cdf(false_alarm / (2 * rates.size))
    # sigma from distances: squares would let frequent spikes hide themselves
    median_of_one = np.sqrt(2 / np.pi * (1 - 1 / blocks.size)) * (1 - 1 / (7 * blocks.size))
    sigma = np.median(blocks.apart, axis=1) / median_of_one
    limits = normal * np.sqrt(1 + np.pi / (18 * blocks.size)) * sigma[:, None]
    beyond = np.zeros(rates.shape[1], bool)
    if (blocks.reach < 0.8 * limits).all():  # one sample of five moves their mean by a fifth
        return beyond
    # a slope goes on beyond the ends, whatever the first and the last block hold
    before = 2 * np.median(blocks.means[:, :3], axis=1, keepdims=True) - blocks.means[:, 6:2:-1]
    after = 2 * np.median(blocks.means[:, -3:], axis=1, keepdims=True) - blocks.means[:, -4:-8:-1]
    padded = np.hstack([before, blocks.means, after])
    levels = np.median(np.lib.stride_tricks.sliding_window_view(padded, 9, axis=1), axis=2)
    wide = (blocks.reach + np.abs(blocks.means - levels) > limits).any(axis=0)
    rows = blocks.starts[wide, None] + np.arange(blocks.size)
    far = np.abs(rates[:, rows] - levels[:, wide, None]) > limits[..., None]
    beyond[rows[far.any(axis=0)]] = True
    return beyond


def runs(chosen: Mask) -> NDArray[np.integer]:
    """First row of each run of true values, and the row after its last: (run, 2)."""
    edges = np.concatenate([[False], chosen, [False]])
    return np.flatnonzero(edges[1:] != edges[:-1]).reshape(-1, 2)
