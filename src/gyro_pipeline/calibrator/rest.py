"""At rest or not, block by block: limits that hold at any time, however many blocks come.

Three tests. The detector of quality control sees the innovations of the filter, so a warm-up or
flicker is no motion, and the noise within blocks. The squares of the innovations are compared with
the noise known beforehand: a device that moved from the start differs in nothing from what came
before. The slope of the direction of gravity bounds a rotation about horizontal axes, which no
threshold on the gyroscope can see.
"""

from copy import copy
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from gyro_pipeline.calibrator.filter import Array
from gyro_pipeline.conventions import MDPS
from gyro_pipeline.quality.rest import RestDetector, spent_limits

MOTION, ATTITUDE, NOISE, ROTATION = "motion", "attitude", "noise", "rotation"
"""Alarms: a brief motion, a turn during one, and what says that the stretch never was at rest."""

_FALSE_ALARM = 3e-4  # of each of the first two tests, ever
_FALSE_ROTATION = 1e-3  # of the third
_LEAST_RISE = 1.5  # of the noise over the known one
_LEAST_ROTATION = 0.5 * MDPS  # an accelerometer that warms up seems to turn by less
_FEWEST = 4  # blocks that a slope is told from


class Blocks(NamedTuple):
    """Means and variances of the samples of n blocks, in deg/s, g and degrees Celsius."""

    mean: Array  # (n, 3)
    variance: Array  # (n, 3)
    gravity: Array  # (n, 3), NaN where it is not measured
    gravity_variance: Array  # (n,), the mean over axes
    temperature: Array  # (n,), NaN where it is not measured

    def part(self, first: int, last: int | None = None) -> Self:
        """Some of them."""
        return self.__class__(*(values[first:last] for values in self))


class Alarm(NamedTuple):
    """What was seen: a rate in deg/s and its standard deviation, or the factor on the noise."""

    code: str
    value: float = np.nan
    sigma: float = np.nan


class RestMonitor:
    """The three tests over one stretch; :meth:`update` returns a new one.

    A block has ``size`` samples, changes of the rate below ``least_dps`` are the bias's own, and
    ``freedom`` (3,) is that of the noise known beforehand, 0 where it is not known.
    """

    def __init__(self, size: int, block_s: float, least_dps: float, freedom: Array) -> None:
        self.block_s, self.blocks, self._squares = block_s, 0, np.zeros(3)
        self.freedom = freedom if np.any(freedom > 2) else None  # noqa: PLR2004 - of the limit
        self.detector = RestDetector(size, _FALSE_ALARM, least_dps, least_rise=_LEAST_RISE)
        self._count, self._sums, self._gravity = 0, np.zeros(10), np.full(3, np.nan)

    def level_anew(self) -> Self:
        """With a slope of gravity that begins with the next block."""
        after = copy(self)
        after._count, after._sums, after._gravity = 0, np.zeros(10), np.full(3, np.nan)
        return after

    def update(
        self, innovations: Array, white: Array, blocks: Blocks
    ) -> tuple[Self, int, Alarm | None]:
        """The monitor after n blocks, and the first alarm with the number of its block, or n.

        ``innovations`` (n, 3) are in units of the standard deviation known beforehand, ``white``
        (3,) is that of the white noise of a block's mean, deg/s.
        """
        after, n = copy(self), len(innovations)
        after.detector = copy(self.detector)
        moved, noisier = after.detector.update(innovations * white, blocks.variance)
        noise, (rate, sigma, turns) = after._noise(innovations), after._rotation(blocks)
        scattered = np.any(np.isfinite(noise), axis=1)
        alarms = (moved | noisier).any(axis=1) | scattered | turns
        if not alarms.any():
            return after, n, None
        k = int(alarms.argmax())
        if moved[k].any() or noisier[k].any():
            return after, k, Alarm(MOTION)
        if scattered[k]:
            return after, k, Alarm(NOISE, float(np.nanmax(noise[k])))
        return after, k, Alarm(ROTATION, float(rate[k]), float(sigma[k]))

    def _noise(self, innovations: Array) -> Array:
        """The noise over the known one where it is too high, else NaN, (n, 3).

        The cube root of the mean square of innovations is nearly normal (Wilson and Hilferty).
        """
        self._squares = _summed(self._squares, innovations**2)
        count = self.blocks + 1 + np.arange(len(innovations))
        self.blocks, squares, self._squares = int(count[-1]), self._squares, self._squares[-1]
        if self.freedom is None:
            return np.full(squares.shape, np.nan)
        ratio, limits = squares / count[:, None], spent_limits(_FALSE_ALARM / 6)
        spread = np.sqrt(2 / 9 * (1 / count[:, None] + 1 / self.freedom))
        limit = limits[np.frexp(count)[1] - 1][:, None] * spread
        high = (np.cbrt(ratio) > np.cbrt(_LEAST_RISE**2) + limit) & (count >= _FEWEST)[:, None]
        return np.where(high, np.sqrt(ratio), np.nan)

    def _rotation(self, blocks: Blocks) -> tuple[Array, Array, NDArray[np.bool_]]:
        """Rates by the slope of gravity, their sigma, and which noise does not make, (n,) each.

        Two normal components exceed z sigma with probability exp(-z^2 / 2), of which a share of
        1 / (k (k + 1)) is spent on block k. Where gravity is missing, the test ends.
        """
        g, none = blocks.gravity, np.full(len(blocks.gravity), np.nan)
        if self._count < 0 or np.isnan(g[0, 0]):
            self._count = -1
            return none, none, np.zeros(len(g), bool)
        count = self._count + 1 + np.arange(len(g))
        t = ((count - 0.5) * self.block_s)[:, None]
        change = np.sum(np.diff(g, axis=0, prepend=self._gravity[None]) ** 2, axis=1)
        change = np.where(count == 1, 0, change)
        noise = blocks.gravity_variance / self.detector.size
        sums = _summed(self._sums, np.hstack([t, t * t, g, g * t, np.c_[noise, change]]))
        measured = np.isfinite(sums).all(axis=1)
        self._count = int(count[-1]) if measured.all() else -1
        self._sums, self._gravity = sums[-1], g[-1]
        rate, sigma = _rotation(sums, count[:, None])
        limit = np.sqrt(-2 * np.log(_FALSE_ROTATION / (count * (count + 1))))
        above = rate > np.maximum(limit * sigma, _LEAST_ROTATION)
        return rate, sigma, above & measured & (count >= _FEWEST)


def _summed(before: Array, values: Array) -> Array:
    """Sums up to each row."""
    return np.add.accumulate(np.vstack([before, values]))[1:]


def _rotation(sums: Array, n: NDArray[np.integer]) -> tuple[Array, Array]:
    """Rates about horizontal axes and their standard deviations, deg/s, by least squares.

    Gravity turns in the axes of the device by -w x g, so w = g x slope / g^2 but for its part along
    g. The noise of a block is that of its samples, or more where neighbours differ by more.
    ``sums`` (m, 10) are over n (m, 1) blocks, of t, t^2, g, g t, the variance of a block's mean and
    the squared difference from the block before.
    """
    of_time = np.maximum(sums[:, 1:2] - sums[:, :1] ** 2 / n, 1e-12)
    mean, slope = sums[:, 2:5] / n, (sums[:, 5:8] - sums[:, :1] * sums[:, 2:5] / n) / of_time
    size = np.linalg.norm(mean, axis=1)
    rate = np.linalg.norm(np.cross(mean, slope), axis=1) / size**2
    shown = sums[:, 9:] / 6 / np.maximum(n - 1, 1) / (1 + 2 * np.sqrt(3 / n))
    variance = (np.maximum(sums[:, 8:9] / n, shown) / of_time)[:, 0]
    return np.degrees(rate), np.degrees(np.sqrt(variance) / size)
