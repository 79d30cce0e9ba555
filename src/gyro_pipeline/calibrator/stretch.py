"""A stretch in one attitude: the filter, the test of rest, and the history with its conflict."""

from collections.abc import Callable
from itertools import combinations
from typing import NamedTuple

import numpy as np

from gyro_pipeline.calibrator.device_types import DeviceType
from gyro_pipeline.calibrator.filter import Filter, Own
from gyro_pipeline.calibrator.history import Prior, angle_deg
from gyro_pipeline.calibrator.rest import BRIEF, WHOLE, Alarm, RestMonitor
from gyro_pipeline.calibrator.state import Array
from gyro_pipeline.physics.mixture import mixture_posterior
from gyro_pipeline.quality.rest import student_limits

CONFLICT = 120.0
"""The mean e-value over sets of axes at which the history is dropped. Where it holds, that happens
in at most one of so many calibrations (Ville), in half of these as measured."""

PriorOf = Callable[[Array | None, float | None], Prior]
"""The prior, by the up direction and the temperature, None where they are not measured."""

_TURN_DEG = 1.0  # the attitude is the same after a motion that turned the device by less
_WARMER_C = 0.5  # by which the temperature moves until the prior is looked up again
_REFERENCE = 6  # blocks at rest that say what rest is like after a motion
_PATIENCE = 20  # blocks of motion after which rest is looked for anew
_TWO_SIDED = 1.959964
_SETS = np.array([[axis in s for axis in range(3)] for n in (1, 2, 3) for s in combinations(range(3), n)])


class Blocks(NamedTuple):
    """Means and variances of the samples of blocks, in deg/s, g and degrees Celsius."""

    means: Array  # (block, 3)
    variances: Array  # (block, 3)
    gravity: Array  # (block, 3), NaN where it is not measured
    gravity_variances: Array  # (block,), the mean over axes
    temperature: Array  # (block,), NaN where it is not measured

    def rows(self, first: int, last: int) -> "Blocks":
        """Some of them."""
        return Blocks(*(column[first:last] for column in self))


class Taken(NamedTuple):
    """What the blocks taken so far come to; a motion goes back to an earlier one."""

    filter: Filter
    prior: Prior
    warmth: float  # degrees Celsius that the prior is of, NaN where it is of none
    dropped: Array  # (3,), axes whose history was dropped
    log_ratio: Array  # (3,), wide over narrow prior
    variances: Array  # (3,), sum of those within blocks
    gravity: Array  # (4,), sum and count
    temperature: Array  # (4,), sum, count, least and most


class Stretch:
    """What is known from blocks at rest in one attitude.

    Args:
        kind: Type of the device.
        prior_of: The history's word.
        scale: (3,), N^2 over that of the type, as it is known beforehand.
        freedom: (3,), degrees of freedom of that; infinite where N is known, 0 where it is not.
        size: Samples of a block.
        block_s: Its length, seconds.
        start_s: When it starts, seconds since the first sample.
        age_s: Of the device then, seconds since power-on; None where it is not known.
        known_still: It is declared to be at rest: nothing is tested.
    """

    def __init__(
        self, kind: DeviceType, prior_of: PriorOf, scale: Array, freedom: Array, size: int,
        block_s: float, start_s: float = 0.0, age_s: float | None = None,
        known_still: bool = False,
    ) -> None:  # fmt: skip
        self.kind, self.prior_of, self.scale, self.freedom = kind, prior_of, scale, freedom
        self.size, self.block_s, self.start_s = size, block_s, start_s
        self.known_still = known_still
        empty = Filter.start(kind.noise, block_s, np.zeros(3), age_s)
        warmth = np.array([0.0, 0.0, np.inf, -np.inf])
        nothing = np.zeros(3), np.zeros(3), np.zeros(3), np.zeros(4), warmth
        self.taken = Taken(empty, prior_of(None, None), np.nan, *nothing)
        self._before: Taken | None = None  # the last block
        self.moving = 0  # blocks of motion that just came
        self._turned = np.zeros(3)  # deg, over them
        self.motions: list[float] = []  # when each started, seconds since the first sample
        self.monitor = self._monitor(None)

    def _monitor(self, noise_dps: Array | None) -> RestMonitor:
        least = self.kind.least_change
        return RestMonitor(self.size, self.block_s, least, self.freedom, noise_dps)

    @property
    def blocks(self) -> int:
        """Blocks at rest that the estimate is from."""
        return self.taken.filter.blocks

    @property
    def seconds(self) -> float:
        """Their length."""
        return self.blocks * self.block_s

    @property
    def up(self) -> Array | None:
        """(3,), direction of the mean acceleration."""
        length = np.linalg.norm(self.taken.gravity[:3])
        return self.taken.gravity[:3] / length if length > 0 else None

    @property
    def temperature_c(self) -> float | None:
        """Mean over the blocks."""
        total, count, *_ = self.taken.temperature
        return float(total / count) if count else None

    def take(self, blocks: Blocks) -> tuple[int, Alarm | None]:
        """Take blocks until an alarm ends the stretch.

        Returns:
            How many blocks are done with, and that alarm, if there is one.
        """
        first, count = 0, len(blocks.means)
        while first < count:
            part = blocks.rows(first, first + 1 if self.moving else count)
            filters, innovations = self._filtered(part.means)
            alarm = self._alarm(part, innovations)
            if alarm is None and self.moving and self._attitude_changed(part):
                return first, Alarm(0, BRIEF, "attitude")
            if alarm is None:
                self._accept(part, filters)
                first += len(part.means)
            elif alarm.kind == WHOLE:
                return first + alarm.row + 1, alarm
            else:
                self._leave_out(part, filters, alarm.row)
                first += alarm.row + 1
                if self.moving >= _PATIENCE:
                    return first, alarm
        return count, None

    def _filtered(self, means: Array) -> tuple[list[Filter], Array]:
        """The filter before the first block and after each, and the innovations (block, 3)."""
        current = self.taken.filter
        if not current.blocks:
            current = Filter.start(current.noise, self.block_s, means[0], current.age_s)
        filters, innovations = [current], np.empty(means.shape)
        for row, mean in enumerate(means):
            current, innovations[row] = current.update(mean)
            filters.append(current)
        return filters, innovations

    def _alarm(self, part: Blocks, innovations: Array) -> Alarm | None:
        """The first alarm; after a motion also a block that is far from the level before it."""
        if self.known_still:
            return None
        white = self.kind.noise.white / np.sqrt(self.block_s)
        alarm = self.monitor.update(innovations / np.sqrt(self.scale), white * np.sqrt(self.scale), part)
        if alarm is None and self.moving and self.blocks >= _REFERENCE:
            limit = self.kind.least_change + 6 * np.sqrt(self.noise()[0]) * white
            if np.any(np.abs(innovations[0]) * white > limit):
                return Alarm(0, BRIEF, "motion")
        return alarm

    def _accept(self, part: Blocks, filters: list[Filter]) -> None:
        """Take blocks at rest, with the filters before and after them."""
        for row, filter_ in enumerate(filters[1:]):
            gravity, before = np.append(part.gravity[row], 1.0), self.taken
            self._before = before
            self.taken = before._replace(
                filter=filter_,
                variances=before.variances + part.variances[row],
                gravity=before.gravity + (gravity if np.isfinite(gravity).all() else 0),
                temperature=_warmth(before.temperature, part.temperature[row]),
            )
            self._look_up(part.temperature[row])
            self._test_history()
            self.moving, self._turned = 0, np.zeros(3)

    def _look_up(self, temperature: float) -> None:
        """The prior with the first block's attitude, and anew when it gets warmer or colder."""
        warmer = abs(temperature - self.taken.warmth) > _WARMER_C
        if self.blocks == 1 or warmer or (np.isfinite(temperature) and np.isnan(self.taken.warmth)):
            known = float(temperature) if np.isfinite(temperature) else None
            prior = self.prior_of(self.up, known)
            self.taken = self.taken._replace(prior=prior, warmth=float(temperature))

    def _test_history(self) -> None:
        """Drop the history on the axes that speak against it, once all together say so."""
        usable = np.isfinite(self.taken.prior.narrow) & ~self.taken.dropped.astype(bool)
        if not usable.any():
            return
        log_ratio = np.where(usable, self._posterior(self.own(), usable)[2], 0.0)
        sums = _SETS @ log_ratio
        mean = np.log(np.mean(np.exp(sums - sums.max()))) + sums.max()
        against = usable & (log_ratio > 0) & (mean > np.log(CONFLICT))
        dropped = np.where(against, 1.0, self.taken.dropped)
        self.taken = self.taken._replace(dropped=dropped, log_ratio=log_ratio)

    def _leave_out(self, part: Blocks, filters: list[Filter], row: int) -> None:
        """Leave out a block of motion and the one before it."""
        moving, motion = self.moving, part.means[max(row - 1, 0) : row + 1]
        if row > 1:
            self._accept(part.rows(0, row - 1), filters[:row])
        elif row == 0 and not moving and self._before is not None:
            self.taken = self._before  # the block before came with an earlier call
        left_out = 1 if moving or not (self.blocks or row) else 2
        current = self.taken.filter
        if current.blocks:
            self._turned = self._turned + np.sum(motion - current.own().bias, axis=0) * self.block_s
            for _ in range(left_out):
                current = current.skip(self.block_s)
            self.taken = self.taken._replace(filter=current)
        if not moving:
            self.motions.append(self.start_s + current.time_s)
        self.moving, self._before = moving + left_out, None
        enough = self.blocks >= _REFERENCE
        self.monitor = self._monitor(np.sqrt(self.taken.variances / self.blocks) if enough else None)

    def _attitude_changed(self, part: Blocks) -> bool:
        """Whether the device was turned over a motion: by its rates, or by gravity."""
        up = self.up
        tilted = up is not None and np.isfinite(part.gravity[0]).all()
        tilt = angle_deg(part.gravity[0], up) if tilted else 0.0  # type: ignore[arg-type]
        return self.blocks > 0 and max(float(np.linalg.norm(self._turned)), tilt) > _TURN_DEG

    def skip(self, seconds: float) -> None:
        """Move on over a gap in the data."""
        if self.blocks:
            self.taken = self.taken._replace(filter=self.taken.filter.skip(seconds))
            self._before = None

    def noise(self) -> tuple[Array, Array]:
        """N^2 over that of the type, (3,), with this log's blocks, and its degrees of freedom."""
        if np.all(np.isinf(self.freedom)) or not self.blocks:
            return self.scale, self.freedom
        squares, freedom = self.taken.filter.chi_square()
        total = np.maximum(self.freedom + freedom, 1e-9)
        return (self.freedom * self.scale + squares) / total, self.freedom + freedom

    def log_noise(self) -> tuple[Array, float]:
        """N of this stretch alone, (3,), deg/s * sqrt(s), and its degrees of freedom."""
        squares, freedom = self.taken.filter.chi_square()
        if freedom <= 0:
            return np.full(3, np.nan), 0.0
        return self.kind.noise.white * np.sqrt(squares / freedom), float(freedom)

    def own(self) -> Own:
        """The estimate by this stretch alone, with the noise as known, and Student's interval."""
        scale, freedom = self.noise()
        return _scaled(self.taken.filter.own(), scale, freedom)

    def _posterior(self, own: Own, usable: Array) -> tuple[Array, Array, Array]:
        """Bias and variance with the history where it is usable, and the log of the ratio."""
        prior = self.taken.prior
        mean, narrow, wide = (np.where(usable, x, 1.0) for x in (prior.mean, prior.narrow, prior.wide))
        at_start = mixture_posterior(own.start, own.start_variance, mean, narrow, wide)
        unknown = np.isinf(own.variance)
        with np.errstate(invalid="ignore"):
            moved = own.bias + own.follows * (at_start.mean - own.start)
            rest = own.variance - own.follows**2 * own.start_variance
        bias = np.where(usable, np.where(unknown, at_start.mean, moved), own.bias)
        later = np.where(unknown, 0.0, rest) + own.follows**2 * at_start.variance
        return bias, np.where(usable, later, own.variance), at_start.log_ratio

    def answer(self) -> tuple[Array, Array]:
        """The bias and its variance, by the stretch and the history."""
        bias, variance, _ = self._posterior(self.own(), self.usable)
        return bias, variance

    @property
    def usable(self) -> Array:
        """(3,), axes with a history that was not dropped."""
        return np.isfinite(self.taken.prior.narrow) & ~self.taken.dropped.astype(bool)

    def seconds_left(self, target_dps: float, most_s: float) -> Array:
        """(3,), seconds at rest until the target; infinite where it is not within ``most_s``.

        The variances of blocks to come do not depend on the data. What does, the distance from the
        history and the noise where it is not known, is taken as it is now.
        """
        own, (scale, freedom) = self.own(), self.noise()
        left = np.where(self.answer()[1] <= target_dps**2, 0.0, np.inf)
        floor = self.kind.noise.floor_dps * np.sqrt(scale)
        hopeless = (floor > target_dps) & ~self.usable
        for number, following in self.taken.filter.ahead(most_s):
            if np.all(np.isfinite(left) | hopeless):
                break
            later = _scaled(following.own(), scale, freedom + number)
            later = later._replace(bias=own.bias, start=own.start)
            reached = self._posterior(later, self.usable)[1] <= target_dps**2
            left = np.where(np.isinf(left) & reached, number * self.block_s, left)
        return np.where(hopeless & (left > 0), np.inf, left)


def _warmth(before: Array, temperature: float) -> Array:
    """Sum, count, least and most, with one temperature more, if it is known."""
    if not np.isfinite(temperature):
        return before
    total, count, least, most = before
    return np.array([total + temperature, count + 1, min(least, temperature), max(most, temperature)])


def _scaled(own: Own, scale: Array, freedom: Array) -> Own:
    """Variances with the noise as known, so that 1.96 standard deviations are Student's limits."""
    safe = np.where(freedom > 0, freedom, np.nan)
    student = np.where(np.isinf(freedom), _TWO_SIDED, student_limits(_TWO_SIDED, safe))
    factor = scale * (student / _TWO_SIDED) ** 2
    factor = np.where(freedom > 0, factor, np.inf)
    return own._replace(
        variance=own.variance * factor, start_variance=own.start_variance * factor
    )
