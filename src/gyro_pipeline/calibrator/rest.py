"""Tests of rest, block by block, with limits that hold however many blocks come.

There are three tests. The detector of quality control sees the innovations of the filter, so that a
warm-up or flicker is no motion, and the noise within blocks. The squares of the innovations are
compared with the noise known beforehand, since a device that moves from the start never changes.
The slope of the direction of gravity shows a rotation about horizontal axes, which no threshold on
the gyroscope can detect.
"""

from copy import copy
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from gyro_pipeline.calibrator.filter import Array
from gyro_pipeline.conventions import MDPS
from gyro_pipeline.quality.rest import Mask, RestDetector, alpha_spending_limits

MOTION, ATTITUDE, NOISE, ROTATION = "motion", "attitude", "noise", "rotation"
"""Alarms: a brief motion, a turn during a motion, and two signs that the device never rested."""

_FALSE_ALARM = 3e-4  # probability of each of the first two tests, over all time
_FALSE_ROTATION = 1e-3  # of the third test
_MIN_RISE = 1.5  # factor of the noise over the known noise
_MIN_ROTATION = 0.5 * MDPS  # an accelerometer that warms up seems to turn by less
_MIN_BLOCKS = 4  # for a slope or a noise estimate


class Blocks(NamedTuple):
    """Means and variances of the samples of n blocks, in deg/s, g and degrees Celsius."""

    mean: Array  # (n, 3)
    variance: Array  # (n, 3)
    gravity: Array  # (n, 3), NaN where it is not measured
    gravity_variance: Array  # (n,), the mean over axes
    temperature: Array  # (n,), NaN where it is not measured

    def part(self, first: int, last: int | None = None) -> Self:
        """The blocks from ``first`` to before ``last``."""
        return self.__class__(*(values[first:last] for values in self))


class Alarm(NamedTuple):
    """An alarm with a rate and its sigma, deg/s, or factors on the noise of means and samples."""

    code: str
    value: float = np.nan
    sigma: float = np.nan


class RestMonitor:
    """The three tests over a stretch, for blocks of ``size`` samples and ``block_s`` seconds.

    Changes of the rate below ``least_dps`` are changes of the bias. ``freedom`` (3,) are the
    degrees of freedom of the noise known beforehand, 0 where it is unknown.
    """

    def __init__(self, size: int, block_s: float, least_dps: float, freedom: Array) -> None:
        self.block_s, self._blocks, self._squares = block_s, 0, np.zeros(3)
        self.freedom = freedom if np.any(freedom > 2) else None  # noqa: PLR2004 - of the limit
        self.detector = RestDetector(size, _FALSE_ALARM, least_dps, least_rise=_MIN_RISE)
        # blocks, sums and last gravity of the slope
        self._slope_blocks, self._sums, self._gravity = 0, np.zeros(10), np.full(3, np.nan)

    def restart_slope(self) -> Self:
        """The monitor with a slope of gravity that begins with the next block."""
        after = copy(self)
        after._slope_blocks, after._sums = 0, np.zeros(10)
        return after

    def update(
        self, innovations: Array, white: Array, blocks: Blocks
    ) -> tuple[Self, int, Alarm | None]:
        """The monitor after n blocks, and the first alarm with the number of its block, or n.

        ``innovations`` (n, 3) are in units of the standard deviation known beforehand; ``white``
        (3,) is the standard deviation of the white noise of a block mean, deg/s.
        """
        after, n = copy(self), len(innovations)
        after.detector = copy(self.detector)
        moved, noisier = after.detector.update(innovations * white, blocks.variance)
        noise = after._excess_noise(innovations)
        rate, sigma, turns = after._rotation_rates(blocks)
        scattered = np.any(np.isfinite(noise), axis=1)
        alarms = (moved | noisier).any(axis=1) | scattered | turns
        if not alarms.any():
            return after, n, None
        k = int(alarms.argmax())
        if moved[k].any() or noisier[k].any():
            return after, k, Alarm(MOTION)
        if scattered[k]:
            axis = int(np.nanargmax(noise[k]))
            inside = np.sqrt(blocks.variance[k, axis] / self.detector.size) / white[axis]
            return after, k, Alarm(NOISE, float(noise[k, axis]), float(inside))
        return after, k, Alarm(ROTATION, float(rate[k]), float(sigma[k]))

    def _excess_noise(self, innovations: Array) -> Array:
        """The noise relative to the known noise where it is too high, else NaN, (n, 3).

        The cube root of the mean square of innovations is nearly normal (Wilson and Hilferty).
        """
        self._squares = _running_sums(self._squares, innovations**2)
        count = self._blocks + 1 + np.arange(len(innovations))
        self._blocks, squares, self._squares = int(count[-1]), self._squares, self._squares[-1]
        if self.freedom is None:
            return np.full(squares.shape, np.nan)
        ratio, limits = squares / count[:, None], alpha_spending_limits(_FALSE_ALARM / 6)
        spread = np.sqrt(2 / 9 * (1 / count[:, None] + 1 / self.freedom))
        limit = limits[np.frexp(count)[1] - 1][:, None] * spread
        high = (np.cbrt(ratio) > np.cbrt(_MIN_RISE**2) + limit) & (count >= _MIN_BLOCKS)[:, None]
        return np.where(high, np.sqrt(ratio), np.nan)

    def _rotation_rates(self, blocks: Blocks) -> tuple[Array, Array, Mask]:
        """Rates from the slope of gravity, their sigma and significance, (n,) each.

        Two normal components exceed z sigma with probability exp(-z^2 / 2); the share
        1 / (k (k + 1)) of it is spent on block k. Where gravity is missing, the test ends.
        """
        g, unknown = blocks.gravity, np.full(len(blocks.gravity), np.nan)
        if self._slope_blocks < 0 or np.isnan(g[0, 0]):
            self._slope_blocks = -1
            return unknown, unknown, np.zeros(len(g), bool)
        count = self._slope_blocks + 1 + np.arange(len(g))
        t = ((count - 0.5) * self.block_s)[:, None]
        change = np.sum(np.diff(g, axis=0, prepend=self._gravity[None]) ** 2, axis=1)
        change = np.where(count == 1, 0, change)
        noise = blocks.gravity_variance / self.detector.size
        sums = _running_sums(self._sums, np.hstack([t, t * t, g, g * t, np.c_[noise, change]]))
        measured = np.isfinite(sums).all(axis=1)
        self._slope_blocks = int(count[-1]) if measured.all() else -1
        self._sums, self._gravity = sums[-1], g[-1]
        rate, sigma = _slope_rates(sums, count[:, None])
        limit = np.sqrt(-2 * np.log(_FALSE_ROTATION / (count * (count + 1))))
        above = rate > np.maximum(limit * sigma, _MIN_ROTATION)
        return rate, sigma, above & measured & (count >= _MIN_BLOCKS)


def _running_sums(before: Array, values: Array) -> Array:
    """Cumulative sums of rows, continued from ``before``."""
    return np.add.accumulate(np.vstack([before, values]))[1:]


def _slope_rates(sums: Array, n: NDArray[np.integer]) -> tuple[Array, Array]:
    """Rates about horizontal axes and their standard deviations, deg/s, by least squares.

    Gravity turns in the axes of the device by -w x g, so w = g x slope / g^2 except for its part
    along g. The noise of a block is that of its samples, or more where neighbours differ by more.
    ``sums`` (m, 10) over n (m, 1) blocks are those of t, t^2, g, g t, the variance of a block mean
    and the squared difference from the previous block.
    """
    of_time = np.maximum(sums[:, 1:2] - sums[:, :1] ** 2 / n, 1e-12)
    mean, slope = sums[:, 2:5] / n, (sums[:, 5:8] - sums[:, :1] * sums[:, 2:5] / n) / of_time
    size = np.linalg.norm(mean, axis=1)
    rate = np.linalg.norm(np.cross(mean, slope), axis=1) / size**2
    scatter = sums[:, 9:] / 6 / np.maximum(n - 1, 1) / (1 + 2 * np.sqrt(3 / n))
    variance = (np.maximum(sums[:, 8:9] / n, scatter) / of_time)[:, 0]
    return np.degrees(rate), np.degrees(np.sqrt(variance) / size)
