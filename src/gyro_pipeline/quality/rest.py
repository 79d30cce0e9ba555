"""At rest or not, told from the means and variances of blocks as they come.

Two tests, each of the last blocks against those before them: has the mean changed, has the noise
risen? Both series, the means and the cube roots of the variances (nearly normal: Wilson and
Hilferty 1931), are judged by one rule. A change counts where it exceeds the least size that matters
by more than chance allows. The error probability is spent over all blocks that may ever come, so
the limits hold at any time, however often and however long one looks.

Quality control feeds it a file at once, a live stream block by block; NumPy is all it needs.
"""

from collections.abc import Sequence
from functools import cache
from statistics import NormalDist

import numpy as np
from numpy.typing import ArrayLike, NDArray

KNOWN_BLOCKS = 1e9
"""Blocks that a stated noise is worth beside those that have come."""


class RestDetector:
    """A changed mean or raised noise of axes, block by block.

    The noise is that of the blocks before the tested ones, with its degrees of freedom. The scatter
    of block means is at least that of white noise. Coloured noise adds to it what their first
    differences show, but no more than the least change that matters: beyond, it is a movement.

    Args:
        size: Samples in a block.
        false_alarm: Probability of any alarm at rest, ever.
        least_dps: Smaller changes of the mean within ``reference`` blocks are the bias's own.
        least_rise: Smaller factors on the noise are no alarm.
        noise_dps: (axis,), standard deviation of a sample at rest, where it is known.
        lags: Numbers of last blocks whose mean is tested.
        reference: Blocks before them with whose mean they are compared.
    """

    def __init__(
        self,
        size: int,
        *,
        false_alarm: float,
        least_dps: float,
        least_rise: float = 1.5,
        noise_dps: ArrayLike | None = None,
        lags: Sequence[int] = (1, 4, 16),
        reference: int = 40,
    ) -> None:
        self.freedom, self.size = size - 1, size
        self.false_alarm, self.least_dps = false_alarm, least_dps
        self.least_growth = least_rise ** (2 / 3) - 1  # of the cube root of the variance
        self.lags, self.reference = tuple(lags), reference
        self.known = 0.0 if noise_dps is None else KNOWN_BLOCKS
        self.noise_dps = 0.0 if noise_dps is None else np.asarray(noise_dps, np.float64)
        self.blocks = 0
        self._last: NDArray[np.float64] | None = None
        self._sums = np.zeros((1, 0))  # (block, column): up to each of the last blocks

    def update(
        self, means: NDArray[np.float64], variances: NDArray[np.float64]
    ) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
        """Take the next blocks; how they are dealt to calls changes no bit.

        Args:
            means: (block, axis), deg/s.
            variances: (block, axis), (deg/s)^2, of the samples of a block about their mean.

        Returns:
            Whether the mean has changed, and whether the noise has risen: (block, axis).
        """
        sums = self._add(means, variances)
        count = self.blocks - len(sums) + 1 + np.arange(len(sums))  # blocks up to each row
        tests = 3 * means.shape[1] * len(self.lags)
        scatter, noise, sways = self._limits(sums, count, normal_limits(self.false_alarm, tests))
        axes, first = means.shape[1], len(sums) - len(means)
        moved, noisier = sways[first:].copy(), np.zeros(means.shape, bool)
        for lag in self.lags:
            rows = np.arange(max(first, lag + (count[0] == 0)), len(sums))
            if not rows.size:
                continue
            before = rows - lag
            start = np.maximum(before - self.reference, 0)
            recent = (sums[rows, : 2 * axes] - sums[before, : 2 * axes]) / lag
            length = (before - start)[:, None]
            level = (sums[before, :axes] - sums[start, :axes]) / length
            spread = np.sqrt(1 / lag + 1 / length)
            moved[rows - first] |= (
                np.abs(recent[:, :axes] - level) > self.least_dps + scatter[before, :axes] * spread
            )
            spread = np.sqrt(1 / lag + 1 / (count[before, None] + self.known))
            noisier[rows - first] |= recent[:, axes:] > (
                (1 + self.least_growth) * noise[before] + scatter[before, axes:] * spread
            )
        self._sums = sums[-(self.reference + max(self.lags)) - 1 :]
        return moved, noisier

    def _add(
        self, means: NDArray[np.float64], variances: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Sums up to each block, of the series, half their squared differences, and variances."""
        series = np.hstack([means, np.cbrt(variances)])
        before = series[:1] if self._last is None else self._last
        steps = np.diff(np.vstack([before, series]), axis=0)
        new = np.hstack([series, steps**2 / 2, variances])
        sums = self._sums if self.blocks else np.zeros((1, new.shape[1]))
        self.blocks, self._last = self.blocks + len(series), series[-1:]
        return np.vstack([sums[:-1], np.add.accumulate(np.vstack([sums[-1:], new]))])

    def _limits(
        self, sums: NDArray[np.float64], count: NDArray[np.integer], normal: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """What chance allows a block of either series, and the usual noise: (row, series), (row, axis)."""
        axes = sums.shape[1] // 5
        known, own = self.known, np.maximum(count - 1, 0)[:, None]
        worth = np.maximum(count, 1)[:, None] + known
        variance = (sums[:, 4 * axes :] + known * self.noise_dps**2) / worth
        per_variance = 2 / (9 * self.freedom)  # of the cube root, relative
        typical = np.cbrt(self.noise_dps**2) * (1 - per_variance)
        noise = (sums[:, axes : 2 * axes] + known * typical) / worth
        white = np.hstack([variance / self.size, noise**2 * per_variance])
        # behind a low-pass filter a block is worth a few samples
        coloured = variance / min(self.size, 8) + self.least_dps**2
        largest = np.hstack([coloured, white[:, axes:] + (self.least_growth * noise) ** 2])
        shown = (sums[:, 2 * axes : 4 * axes] + known * white) / np.maximum(own + known, 1)
        z = normal[np.frexp(np.maximum(count, 1))[1] - 1][:, None]
        # differences of neighbours are worth two thirds of their number
        scatter = np.minimum(
            student_limits(z, (own + known) * 2 / 3) * np.sqrt(np.maximum(shown, white)),
            student_limits(z, worth * self.freedom) * np.sqrt(largest),
        )
        freedom = np.maximum(own + known, 1) * 2 / 3
        wilson = 2 / (9 * freedom)
        sways = np.cbrt(shown[:, :axes] / coloured) > 1 - wilson + z * np.sqrt(wilson)
        return scatter, noise, sways & (own > 2)


@cache
def normal_limits(false_alarm: float, tests: int) -> NDArray[np.float64]:
    """Normal quantiles by which an error probability is spent: for 1, 2-3, 4-7, ... blocks.

    Each span of blocks is given 1 / (e (e + 1)) of it, e = 1, 2, ...; the sum of these is one.
    """
    epochs = range(1, 40)
    return np.array(
        [-NormalDist().inv_cdf(false_alarm / (tests * e * (e + 1) * 2 ** (e - 1))) for e in epochs]
    )


def student_limits(normal: ArrayLike, freedom: ArrayLike) -> NDArray[np.float64]:
    """Student's t that is exceeded as seldom as a normal quantile (Wallace 1959)."""
    freedom = np.maximum(freedom, 1e-3)
    power = (np.asarray(normal) * (8 * freedom + 3) / (8 * freedom + 1)) ** 2 / freedom
    return np.sqrt(freedom * np.expm1(np.minimum(power, 600)))
