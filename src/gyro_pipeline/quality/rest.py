"""Detects motion from the means and variances of blocks, sequentially.

The same rule applies to two series, the means and the cube roots of the variances (nearly normal:
Wilson and Hilferty 1931): the latest blocks may differ from earlier ones by the least relevant
change plus the limit of chance. The error probability is spread over all future blocks, so the
limits hold at any time. In addition, the means may not scatter more than those of coloured noise.
Quality control passes a whole file at once, a live stream passes one block at a time. This module
needs NumPy only.
"""

from functools import cache
from statistics import NormalDist

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]


class RestDetector:
    """Detects a changed mean or a raised noise of gyroscopes, block by block.

    The noise is estimated from the blocks before the tested ones, with its degrees of freedom. The
    scatter of block means is at least that of white noise. Coloured noise may raise it, as shown by
    differences of neighbours, up to the least relevant change plus the scatter of blocks worth only
    eight independent samples, as after a low-pass filter.

    Args:
        size: Samples in a block.
        false_alarm: Probability of any alarm at rest, over all time.
        least_dps: Least change of the mean that is motion; the bias may change by less.
        least_rise: Least factor of the noise that is an alarm.
    """

    lags, reference = (1, 4, 16), 40  # numbers of tested blocks, and of blocks before them

    def __init__(
        self, size: int, false_alarm: float, least_dps: float, *, least_rise: float = 1.5
    ) -> None:
        self.size, self.false_alarm, self.least_dps = size, false_alarm, least_dps
        self.growth = least_rise ** (2 / 3)  # of the cube root of the variance
        self.blocks, self._last, self._sums = 0, np.empty((0, 0)), np.empty((0, 0))

    def update(self, means: Array, variances: Array) -> tuple[Mask, Mask]:
        """Test the next blocks; results do not depend on how blocks are divided among calls.

        Args:
            means: Means of blocks, (block, axis), deg/s, finite.
            variances: Variances of samples about their block's mean, (block, axis), (deg/s)^2.

        Returns:
            Whether the mean changes, and whether the noise rises, both (block, axis).
        """
        axes, sums = means.shape[1], self._add(means.T, variances.T)
        count = self.blocks - sums.shape[1] + 1 + np.arange(sums.shape[1])  # blocks up to each
        chance, noise, worth, sways = self._limits(sums, count)
        first = count.size - len(means)
        moved, noisier = sways[:, first:], np.zeros((axes, len(means)), bool)
        for lag in self.lags:
            edge = max(first, lag + (count[0] == 0))  # first block with enough earlier blocks
            if edge >= count.size:
                break
            now, before = slice(edge, None), slice(edge - lag, -lag)
            end = np.arange(edge - lag, count.size - lag)
            start = np.maximum(end - self.reference, 0)
            last = (sums[: 2 * axes, now] - sums[: 2 * axes, before]) / lag
            change = last[:axes] - (sums[:axes, before] - sums[:axes, start]) / (end - start)
            limit = self.least_dps + chance[:axes, before] * np.sqrt(1 / lag + 1 / (end - start))
            moved[:, edge - first :] |= np.abs(change) > limit
            limit = chance[axes:, before] * np.sqrt(1 / lag + 1 / worth[before])
            noisier[:, edge - first :] |= last[axes:] > self.growth * noise[:, before] + limit
        self._sums = sums[:, -(self.reference + max(self.lags)) - 1 :]
        return moved.T, noisier.T

    def _add(self, means: Array, variances: Array) -> Array:
        """Cumulative sums of both series, of half their squared differences, and of variances."""
        series = np.vstack([means, np.cbrt(variances)])
        steps = np.diff(series, prepend=self._last if self.blocks else series[:, :1])
        new = np.vstack([series, steps**2 / 2, variances])
        sums = self._sums if self.blocks else np.zeros((len(new), 1))
        self.blocks, self._last = self.blocks + series.shape[1], series[:, -1:]
        added = np.add.accumulate(np.hstack([sums[:, -1:], new]), axis=1)
        return np.hstack([sums[:, :-1], added])

    def _limits(self, sums: Array, count: NDArray[np.integer]) -> tuple[Array, Array, Array, Mask]:
        """Limits of chance for both series, noise, its weight in blocks, and sways, per block."""
        axes, worth = len(sums) // 5, np.maximum(count, 1)
        variance = sums[4 * axes :] / worth
        relative = 2 / (9 * (self.size - 1))  # relative variance, and bias, of the cube root
        noise = sums[axes : 2 * axes] / worth
        white = np.vstack([variance / self.size, noise**2 * relative])
        coloured = variance / min(self.size, 8) + self.least_dps**2
        largest = np.vstack([coloured, white[axes:] + ((self.growth - 1) * noise) ** 2])
        observed = sums[2 * axes : 4 * axes] / np.maximum(worth - 1, 1)
        freedom = np.maximum(worth - 1, 1e-3) * 2 / 3  # of differences between neighbours
        tests = 8 * axes * len(self.lags)  # two sides of the mean, noise, sways; two limits each
        z = alpha_spending_limits(self.false_alarm / tests)[np.frexp(np.maximum(count, 1))[1] - 1]
        chance = np.minimum(
            student_limits(z, freedom) * np.sqrt(np.maximum(observed, white)),
            student_limits(z, worth * (self.size - 1)) * np.sqrt(largest),
        )
        scatter = 2 / (9 * freedom)  # relative variance of the cube root of the observed variance
        swaying = observed[:axes] > coloured * (1 - scatter + z * np.sqrt(scatter)) ** 3
        return chance, noise, worth, swaying & (freedom > 1)


@cache
def alpha_spending_limits(probability: float) -> Array:
    """Normal critical values for blocks 1, 2-3, 4-7, ..., so that all tests share a probability.

    The blocks of these epochs spend 1/(1*2), 1/(2*3), ... of the error probability.
    """
    epochs = [e * (e + 1) * 2 ** (e - 1) for e in range(1, 40)]
    return np.array([-NormalDist().inv_cdf(probability / blocks) for blocks in epochs])


def student_limits(normal: ArrayLike, freedom: ArrayLike) -> Array:
    """Quantile of Student's t with the same probability as a normal limit (Wallace 1959)."""
    freedom = np.asarray(freedom)
    power = (np.asarray(normal) * (8 * freedom + 3) / (8 * freedom + 1)) ** 2 / freedom
    return np.sqrt(freedom * np.expm1(np.minimum(power, 600)))
