"""At rest or not, told from the means and variances of blocks as they come.

One rule for two series, the means and the cube roots of the variances (nearly normal: Wilson and
Hilferty 1931): the last blocks may differ from those before by the least change that matters and
by what chance allows. The error probability is spent over all blocks that may ever come, so the
limits hold at any time. Beside it, the means may not scatter more than those of coloured noise.
Quality control feeds it a file at once, a live stream block by block; NumPy is all it needs.
"""

from functools import cache
from statistics import NormalDist

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]


class RestDetector:
    """A changed mean or raised noise of gyroscopes, block by block.

    The noise is that of the blocks before the tested ones, with its degrees of freedom. The scatter
    of block means is at least that of white noise; colour adds what their differences show, up to
    the least change that matters and to a block worth eight samples, as behind a low-pass filter.

    Args:
        size: Samples in a block.
        false_alarm: Probability of any alarm at rest, ever.
        least_dps: Smaller changes of the mean are the bias's own.
        least_rise: Smaller factors on the noise are no alarm.
        noise_dps: (axis,), standard deviation of a sample at rest, where it is known.
    """

    lags, reference = (1, 4, 16), 40  # blocks, the last ones and those before them

    def __init__(
        self, size: int, false_alarm: float, least_dps: float, *, least_rise: float = 1.5,
        noise_dps: ArrayLike | None = None,
    ) -> None:  # fmt: skip
        self.size, self.false_alarm, self.least_dps = size, false_alarm, least_dps
        self.growth = least_rise ** (2 / 3)  # of the cube root of the variance
        self.known = 0.0 if noise_dps is None else 1e9  # blocks that a known noise is worth
        self.known_variance = np.square(np.c_[0.0 if noise_dps is None else noise_dps])
        self.blocks, self._last, self._sums = 0, np.empty((0, 0)), np.empty((0, 0))

    def update(self, means: Array, variances: Array) -> tuple[Mask, Mask]:
        """Take the next blocks; how they are dealt to calls changes no bit.

        All are (block, axis): the means in deg/s, finite; the variances of the samples about the
        mean of their block; whether the mean changes; and whether the noise rises.
        """
        axes, sums = means.shape[1], self._add(means.T, variances.T)
        count = self.blocks - sums.shape[1] + 1 + np.arange(sums.shape[1])  # blocks up to each
        chance, noise, worth, sways = self._limits(sums, count)
        first = count.size - len(means)
        moved, noisier = sways[:, first:], np.zeros((axes, len(means)), bool)
        for lag in self.lags:
            edge = max(first, lag + (count[0] == 0))  # of the blocks that others come before
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
        """Sums up to each block of both series, of half their squared differences, of variances."""
        series = np.vstack([means, np.cbrt(variances)])
        steps = np.diff(series, prepend=self._last if self.blocks else series[:, :1])
        new = np.vstack([series, steps**2 / 2, variances])
        sums = self._sums if self.blocks else np.zeros((len(new), 1))
        self.blocks, self._last = self.blocks + series.shape[1], series[:, -1:]
        added = np.add.accumulate(np.hstack([sums[:, -1:], new]), axis=1)
        return np.hstack([sums[:, :-1], added])

    def _limits(self, sums: Array, count: NDArray[np.integer]) -> tuple[Array, Array, Array, Mask]:
        """After each block: what chance allows one of both series, noise, its worth, sways."""
        axes, known = len(sums) // 5, self.known
        worth = np.maximum(count, 1) + known
        variance = (sums[4 * axes :] + known * self.known_variance) / worth
        relative = 2 / (9 * (self.size - 1))  # variance of the cube root, and what its mean lacks
        noise = sums[axes : 2 * axes] + known * np.cbrt(self.known_variance) * (1 - relative)
        noise /= worth
        white = np.vstack([variance / self.size, noise**2 * relative])
        coloured = variance / min(self.size, 8) + self.least_dps**2
        largest = np.vstack([coloured, white[axes:] + ((self.growth - 1) * noise) ** 2])
        shown = (sums[2 * axes : 4 * axes] + known * white) / np.maximum(worth - 1, 1)
        freedom = np.maximum(worth - 1, 1e-3) * 2 / 3  # of differences between neighbours
        tests = 8 * axes * len(self.lags)  # two sides of the mean, noise, sways; two limits each
        z = spent_limits(self.false_alarm / tests)[np.frexp(np.maximum(count, 1))[1] - 1]
        chance = np.minimum(
            student_limits(z, freedom) * np.sqrt(np.maximum(shown, white)),
            student_limits(z, worth * (self.size - 1)) * np.sqrt(largest),
        )
        scatter = 2 / (9 * freedom)  # of the cube root of what is shown
        swaying = shown[:axes] > coloured * (1 - scatter + z * np.sqrt(scatter)) ** 3
        return chance, noise, worth, swaying & (freedom > 1)


@cache
def spent_limits(probability: float) -> Array:
    """Normal limits for 1, 2-3, 4-7, ... blocks, which are given 1/(1*2), 1/(2*3), ... of it."""
    epochs = [e * (e + 1) * 2 ** (e - 1) for e in range(1, 40)]
    return np.array([-NormalDist().inv_cdf(probability / blocks) for blocks in epochs])


def student_limits(normal: ArrayLike, freedom: ArrayLike) -> Array:
    """Student's t that is exceeded as seldom as a normal limit (Wallace 1959)."""
    freedom = np.asarray(freedom)
    power = (np.asarray(normal) * (8 * freedom + 3) / (8 * freedom + 1)) ** 2 / freedom
    return np.sqrt(freedom * np.expm1(np.minimum(power, 600)))
