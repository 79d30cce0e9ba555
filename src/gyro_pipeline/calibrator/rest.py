"""At rest or not, block by block: limits that hold at any time, however many blocks come.

Three tests. The detector of quality control sees the innovations of the filter, so that what a
warm-up or flicker does is no motion, and the noise within blocks. The squares of the innovations
are compared with the noise that is known beforehand: a device that moved from the start differs in
nothing from what came before. And the slope of the direction of gravity bounds a rotation about
horizontal axes, which no threshold on the gyroscope can see.
"""

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from gyro_pipeline.calibrator.state import Array
from gyro_pipeline.conventions import MDPS
from gyro_pipeline.quality.rest import RestDetector, spent_limits

if TYPE_CHECKING:
    from gyro_pipeline.calibrator.stretch import Blocks

BRIEF, WHOLE = 1, 2
"""The block and the one before it are left out; or the stretch was never at rest."""

_FALSE_ALARM = 3e-4  # of each of the first two tests, ever
_FALSE_ROTATION = 1e-3  # of the third
_LEAST_RISE = 1.5  # of the noise over the known one
_LEAST_ROTATION = 0.5 * MDPS  # an accelerometer that warms up seems to turn by less
_FEWEST = 4  # blocks that a slope is told from


@dataclass(frozen=True)
class Alarm:
    """The first alarm of some blocks.

    Attributes:
        row: Of the block.
        kind: BRIEF or WHOLE.
        code: ``motion``, ``noise`` or ``rotation``.
        value: Of a rotation its rate in deg/s; of noise the factor over the known one.
        sigma: Standard deviation of the rotation's rate, deg/s.
    """

    row: int
    kind: int
    code: str
    value: float = np.nan
    sigma: float = np.nan


class RestMonitor:
    """The three tests over one stretch.

    Args:
        size: Samples of a block.
        block_s: Its length, seconds.
        least_dps: Smaller changes of the rate are the bias's own.
        freedom: (3,), degrees of freedom of the noise that is known beforehand; 0: none is.
        noise_dps: (3,), standard deviation of a sample at rest, where it was just seen.
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
        self._measured = True  # so far gravity was, in every block
        self._slopes = np.zeros(10)  # sums that the slope is told from
        self._last: Array | None = None

    def update(self, innovations: Array, scales: Array, blocks: "Blocks") -> Alarm | None:
        """Take blocks, and tell the first alarm.

        Args:
            innovations: (block, 3), in units of the standard deviation that is known beforehand.
            scales: (3,), deg/s, standard deviation of the white noise of a block's mean.
            blocks: The blocks themselves.
        """
        moved, noisier = self.detector.update(innovations * scales, blocks.variances)
        brief = np.flatnonzero((moved | noisier).any(axis=1))
        alarms = [Alarm(int(brief[0]), BRIEF, "motion")] if brief.size else []
        alarms += self._noise(innovations)
        alarms += self._rotation(blocks.gravity, blocks.gravity_variances)
        self.blocks += len(innovations)
        return min(alarms, key=lambda alarm: (alarm.row, alarm.kind), default=None)

    def _noise(self, innovations: Array) -> list[Alarm]:
        """The mean square of the innovations over 1, by its cube root (Wilson and Hilferty)."""
        sums = np.add.accumulate(np.vstack([self._squares, innovations**2]))[1:]
        count = self.blocks + 1 + np.arange(len(sums))
        self._squares = sums[-1]
        known = self.freedom > 2  # noqa: PLR2004 - of less there is nothing to compare with
        if not known.any():
            return []
        limits = spent_limits(_FALSE_ALARM / 6)[np.frexp(count)[1] - 1][:, None]
        spread = np.sqrt(2 / 9 * (1 / count[:, None] + 1 / np.maximum(self.freedom, 1)))
        high = np.cbrt(sums / count[:, None]) > np.cbrt(_LEAST_RISE**2) + limits * spread
        rows = np.flatnonzero((high & known).any(axis=1) & (count >= _FEWEST))
        if not rows.size:
            return []
        factor = float(np.sqrt(sums[rows[0]] / count[rows[0]])[known].max())
        return [Alarm(int(rows[0]), WHOLE, "noise", factor)]

    def _rotation(self, gravity: Array, variances: Array) -> list[Alarm]:
        """A rate by the slope of gravity that noise does not make; until gravity is missing.

        Two normal components exceed z sigma with probability exp(-z^2 / 2), of which a share of
        1 / (k (k + 1)) is spent on block k.
        """
        missing = np.flatnonzero(~np.isfinite(gravity).all(axis=1))
        rows = int(missing[0]) if missing.size else len(gravity)
        rows, self._measured = rows * self._measured, self._measured and not missing.size
        if not rows:
            return []
        gravity, count = gravity[:rows], self.blocks + 1.0 + np.arange(rows)
        t = (count - 0.5)[:, None] * self.block_s
        steps = np.diff(gravity, axis=0, prepend=gravity[:1] if self._last is None else self._last)
        squares = np.sum(steps**2, axis=1, keepdims=True)
        terms = [t, t**2, gravity, gravity * t, variances[:rows, None] / self.size, squares]
        sums = np.add.accumulate(np.vstack([self._slopes, np.hstack(terms)]))[1:]
        self._slopes, self._last = sums[-1], gravity[-1:]
        rate, sigma = _rotations(sums, count)
        limit = np.sqrt(-2 * np.log(_FALSE_ROTATION / (count * (count + 1))))
        alarm = (rate > np.maximum(limit * sigma, _LEAST_ROTATION)) & (count >= _FEWEST)
        first = np.flatnonzero(alarm)[:1]
        return [Alarm(int(i), WHOLE, "rotation", float(rate[i]), float(sigma[i])) for i in first]


def _rotations(sums: Array, count: NDArray[np.floating]) -> tuple[Array, Array]:
    """Rates about horizontal axes and their standard deviation, (n,), deg/s, by least squares.

    Gravity turns in the axes of the device by -w x g, so w = g x slope / g^2 but for its part along
    g. The noise of a block is that of its samples, or more where neighbours differ by more.

    Args:
        sums: (n, 10), over the blocks so far, of t, t^2, g, g t, the variance of a block's mean
            and the squared difference from the block before.
        count: (n,), blocks so far.
    """
    n = count[:, None]
    of_time = np.maximum(sums[:, 1:2] - sums[:, :1] ** 2 / n, 1e-12)
    slope = (sums[:, 5:8] - sums[:, :1] * sums[:, 2:5] / n) / of_time
    mean = sums[:, 2:5] / n
    size = np.linalg.norm(mean, axis=1)
    rate = np.linalg.norm(np.cross(mean, slope), axis=1) / size**2
    shown = sums[:, 9] / 6 / np.maximum(count - 1, 1) / (1 + 2 * np.sqrt(3 / count))
    variance = np.maximum(sums[:, 8] / count, shown) / of_time[:, 0]
    return np.degrees(rate), np.degrees(np.sqrt(variance) / size)
