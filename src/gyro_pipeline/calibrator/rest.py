"""At rest or not, block by block: limits that hold at any time, however many blocks come.

Three tests. The detector of quality control sees the innovations of the filter, so a warm-up or
flicker is no motion, and the noise within blocks. The squares of the innovations are compared with
the noise known beforehand: a device that moved from the start differs in nothing from what came
before. The slope of the direction of gravity bounds a rotation about horizontal axes, which no
threshold on the gyroscope can see.
"""

from typing import NamedTuple

import numpy as np

from gyro_pipeline.calibrator.state import Array
from gyro_pipeline.conventions import MDPS
from gyro_pipeline.quality.rest import RestDetector, spent_limits

MOTION, ATTITUDE, NOISE, ROTATION = "motion", "attitude", "noise", "rotation"
"""Alarms: a brief motion, a turn during one, and what says that the stretch never was at rest."""

_FALSE_ALARM = 3e-4  # of each of the first two tests, ever
_FALSE_ROTATION = 1e-3  # of the third
_LEAST_RISE = 1.5  # of the noise over the known one
_LEAST_ROTATION = 0.5 * MDPS  # an accelerometer that warms up seems to turn by less
_FEWEST = 4  # blocks that a slope is told from


class Block(NamedTuple):
    """Means and variances of the samples of a block, in deg/s, g and degrees Celsius."""

    mean: Array  # (3,)
    variance: Array  # (3,)
    gravity: Array  # (3,), NaN where it is not measured
    gravity_variance: float  # the mean over axes
    temperature: float  # NaN where it is not measured


class Alarm(NamedTuple):
    """What was seen: a rate in deg/s and its standard deviation, or the factor on the noise."""

    code: str
    value: float = np.nan
    sigma: float = np.nan


class RestMonitor:
    """The three tests over one stretch.

    Args:
        size: Samples in a block.
        block_s: Its length, seconds.
        least_dps: Smaller changes of the rate are the bias's own.
        freedom: (3,), degrees of freedom of the noise known beforehand; 0: unknown.
        noise_dps: (3,), standard deviation of a sample at rest, if it was just seen.
    """

    def __init__(
        self, size: int, block_s: float, least_dps: float, freedom: Array,
        noise_dps: Array | None = None,
    ) -> None:  # fmt: skip
        self.size, self.block_s, self.freedom = size, block_s, freedom
        self.detector = RestDetector(
            size, _FALSE_ALARM, least_dps, least_rise=_LEAST_RISE, noise_dps=noise_dps
        )
        self.blocks = 0
        self._squares = np.zeros(3)
        self._sums = np.zeros(10)  # that the slope of gravity is told from
        self._gravity: Array | None = None  # of the last block

    def update(self, innovation: Array, white_dps: Array, block: Block) -> Alarm | None:
        """Take a block.

        Args:
            innovation: (3,), in units of the standard deviation known beforehand.
            white_dps: (3,), deg/s, standard deviation of the white noise of a block's mean.
            block: The block itself.
        """
        self.blocks += 1
        changes = self.detector.update((innovation * white_dps)[None], block.variance[None])
        if np.any(changes):
            return Alarm(MOTION)
        return self._noise(innovation) or self._rotation(block)

    def _noise(self, innovation: Array) -> Alarm | None:
        """The mean square of the innovations over 1, by its cube root (Wilson and Hilferty)."""
        self._squares = self._squares + innovation**2
        known, ratio = self.freedom > 2, self._squares / self.blocks  # noqa: PLR2004 - of the limit
        if self.blocks < _FEWEST or not known.any():
            return None
        limit = spent_limits(_FALSE_ALARM / 6)[self.blocks.bit_length() - 1]
        spread = np.sqrt(2 / 9 * (1 / self.blocks + 1 / np.maximum(self.freedom, 1)))
        high = np.cbrt(ratio) > np.cbrt(_LEAST_RISE**2) + limit * spread
        return Alarm(NOISE, float(np.sqrt(ratio[known].max()))) if (high & known).any() else None

    def _rotation(self, block: Block) -> Alarm | None:
        """A rate by the slope of gravity that noise does not make; until gravity is missing.

        Two normal components exceed z sigma with probability exp(-z^2 / 2), of which a share of
        1 / (k (k + 1)) is spent on block k.
        """
        g, n = block.gravity, self.blocks
        if not np.isfinite(g).all() or (self._gravity is None and n > 1):
            self._gravity = None
            return None
        t, change = (n - 0.5) * self.block_s, 0.0 if self._gravity is None else g - self._gravity
        noise = block.gravity_variance / self.size
        self._sums = self._sums + np.hstack([t, t * t, g, g * t, noise, np.sum(np.square(change))])
        self._gravity = g
        rate, sigma = _rotation(self._sums, n)
        limit = np.sqrt(-2 * np.log(_FALSE_ROTATION / (n * (n + 1))))
        seen = n >= _FEWEST and rate > max(limit * sigma, _LEAST_ROTATION)
        return Alarm(ROTATION, rate, sigma) if seen else None


def _rotation(sums: Array, n: int) -> tuple[float, float]:
    """Rate about horizontal axes and its standard deviation, deg/s, by least squares.

    Gravity turns in the axes of the device by -w x g, so w = g x slope / g^2 but for its part along
    g. The noise of a block is that of its samples, or more where neighbours differ by more.

    Args:
        sums: (10,), over n blocks, of t, t^2, g, g t, the variance of a block's mean and the
            squared difference from the block before.
        n: Blocks so far.
    """
    of_time = max(sums[1] - sums[0] ** 2 / n, 1e-12)
    mean, slope = sums[2:5] / n, (sums[5:8] - sums[0] * sums[2:5] / n) / of_time
    size = np.linalg.norm(mean)
    rate = np.linalg.norm(np.cross(mean, slope)) / size**2
    shown = sums[9] / 6 / max(n - 1, 1) / (1 + 2 * np.sqrt(3 / n))
    variance = max(sums[8] / n, shown) / of_time
    return float(np.degrees(rate)), float(np.degrees(np.sqrt(variance) / size))
