"""A stretch in one attitude: the filter, the test of rest, and the history with its conflict."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from gyro_pipeline.calibrator.device_types import DeviceType
from gyro_pipeline.calibrator.filter import Filter, Own, own
from gyro_pipeline.calibrator.history import Prior, angle_deg
from gyro_pipeline.calibrator.rest import BRIEF, WHOLE, Alarm, RestMonitor
from gyro_pipeline.calibrator.state import Array, Mask
from gyro_pipeline.physics.mixture import Posterior, mixture_posterior
from gyro_pipeline.quality.rest import student_limits

CONFLICT = 120.0
"""The e-value at which the history is dropped. Where it holds, that happens in at most one of so
many calibrations (Ville), and in half as many as measured."""

PriorOf = Callable[[Array | None, float | None, bool], Prior]
"""The prior, by the up direction and the temperature, None where they are not measured, and whether
a declared heading is believed."""

VERTICAL = 0.9
"""Cosine of the angle between an axis that counts as vertical and the vertical."""

_TURN_DEG = 1.0  # the attitude is the same after a motion that turned the device by less
_WARMER_C = 0.5  # by which the temperature moves until the prior is looked up again
_REFERENCE = 6  # blocks at rest that say what rest is like after a motion
_PATIENCE = 20  # blocks of motion after which rest is looked for anew
_AHEAD = 64  # blocks that are looked ahead at a time
_TWO_SIDED = 1.959964


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


class Conflict(NamedTuple):
    """Where data and history contradict each other so much that the history is dropped."""

    axes: Mask  # (3,)
    away: Array  # (3,), data less history, deg/s
    sigma: Array  # (3,), of that, if the history were right


class Taken(NamedTuple):
    """What the blocks taken so far come to; a motion goes back to an earlier one."""

    filter: Filter
    prior: Prior
    warmth: float  # degrees Celsius that the prior is of, NaN where it is of none
    believed: bool  # that a declared heading repeats
    dropped: Mask  # (3,), axes whose history was dropped
    conflicts: tuple[Conflict, ...]
    sums: Array  # (9,), of variances within blocks, gravity and its count, temperature and its
    range_c: tuple[float, float]  # of the temperature
    last_c: float  # temperature of the last block, NaN where it is not known


@dataclass(frozen=True)
class Setting:
    """What all stretches of a calibration share.

    Attributes:
        kind: Type of the device.
        prior_of: The history's word.
        scale: (3,), N^2 over that of the type, as it is known beforehand.
        freedom: (3,), degrees of freedom of that; infinite where N is known, 0 where it is not.
        size: Samples of a block.
        block_s: Its length, seconds.
        known_still: The device is declared to be at rest: nothing is tested.
    """

    kind: DeviceType
    prior_of: PriorOf
    scale: Array
    freedom: Array
    size: int
    block_s: float
    known_still: bool = False


class Known(NamedTuple):
    """What follows from the blocks taken so far, (3,) each."""

    alone: Own  # with N as of the type
    own: Own  # with N as known
    scale: Array  # N^2 over that of the type
    freedom: Array  # degrees of freedom of that
    bias: Array
    variance: Array


class Stretch:
    """What is known from blocks at rest in one attitude.

    Args:
        setting: What all stretches share.
        start_s: When it starts, seconds since the first sample.
        age_s: Of the device then, seconds since power-on; None where it is not known.
    """

    def __init__(self, setting: Setting, start_s: float = 0.0, age_s: float | None = None) -> None:
        self.setting, self.kind, self.start_s = setting, setting.kind, start_s
        self.scale, self.freedom, self.block_s = setting.scale, setting.freedom, setting.block_s
        empty = Filter.start(self.kind.noise, self.block_s, np.zeros(3), age_s)
        prior, none = setting.prior_of(None, None, True), np.zeros(3, bool)
        no_range = np.inf, -np.inf
        self.taken = Taken(empty, prior, np.nan, True, none, (), np.zeros(9), no_range, np.nan)
        self._before: Taken | None = None  # the last block
        self._last_mean = np.zeros(3)  # of that block
        self._worked_out: tuple[Taken, Known] | None = None
        self.moving = 0  # blocks of motion that just came
        self._turned = np.zeros(3)  # deg, over them
        self.motions: list[float] = []  # when each started, seconds since the first sample
        self.monitor = self._monitor(None)

    def _monitor(self, noise_dps: Array | None) -> RestMonitor:
        least = self.kind.least_change
        return RestMonitor(self.setting.size, self.block_s, least, self.freedom, noise_dps)

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
        gravity = self.taken.sums[3:6]
        length = np.linalg.norm(gravity)
        return np.asarray(gravity / length) if length > 0 else None

    @property
    def temperature_c(self) -> float | None:
        """Mean over the blocks."""
        total, count = self.taken.sums[7:]
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
        if self.setting.known_still:
            return None
        white = self.kind.noise.white / np.sqrt(self.block_s)
        alarm = self.monitor.update(
            innovations / np.sqrt(self.scale), white * np.sqrt(self.scale), part
        )
        if alarm is None and self.moving and self.blocks >= _REFERENCE:
            limit = self.kind.least_change + 6 * np.sqrt(self.noise_scale()) * white
            if np.any(np.abs(innovations[0]) * white > limit):
                return Alarm(0, BRIEF, "motion")
        return alarm

    def _accept(self, part: Blocks, filters: list[Filter]) -> None:
        """Take blocks at rest, with the filters before the first and after each."""
        first, count = 0, len(part.means)
        while first < count:
            self._look_up(part, first)
            moved = np.abs(part.temperature[first:] - self.taken.warmth) > _WARMER_C
            moved |= np.isnan(self.taken.warmth) & np.isfinite(part.temperature[first:])
            last = first + int(moved.argmax()) if moved.any() else count
            first += self._add(part.rows(first, last), filters[first + 1 : last + 1])
        self.moving, self._turned = 0, np.zeros(3)

    def _look_up(self, part: Blocks, row: int) -> None:
        """The prior at the attitude and the temperature of a block."""
        warmth, up = float(part.temperature[row]), self.up
        if up is None and np.isfinite(part.gravity[row]).all():
            up = part.gravity[row] / np.linalg.norm(part.gravity[row])
        if not self.blocks or np.isfinite(warmth):
            self._set_prior(up, warmth)

    def _set_prior(self, up: Array | None, warmth: float) -> None:
        known = warmth if np.isfinite(warmth) else None
        prior = self.setting.prior_of(up, known, self.taken.believed)
        self.taken = self.taken._replace(prior=prior, warmth=warmth)

    def _add(self, part: Blocks, filters: list[Filter]) -> int:
        """Take blocks of one prior, up to the first at which the history is dropped.

        Returns:
            How many; what was known one block before the last is kept as well.
        """
        known = np.isfinite(part.temperature)[:, None]
        felt = np.isfinite(part.gravity).all(axis=1, keepdims=True)
        warmth = np.where(known, part.temperature[:, None], 0)
        rows = np.hstack([part.variances, np.where(felt, part.gravity, 0), felt, warmth, known])
        sums = np.add.accumulate(np.vstack([self.taken.sums, rows]))
        least, most = np.where(known, warmth, np.inf), np.where(known, warmth, -np.inf)
        lows = np.minimum.accumulate(np.append(self.taken.range_c[0], least))
        highs = np.maximum.accumulate(np.append(self.taken.range_c[1], most))
        count, conflict = self._conflict(filters, sums[1:])
        part = part.rows(0, count)
        for row in range(max(count - 2, 0), count):
            self._before = self.taken
            self.taken = self.taken._replace(
                filter=filters[row], sums=sums[row + 1],
                range_c=(lows[row + 1], highs[row + 1]), last_c=float(part.temperature[row]),
            )  # fmt: skip
        self._last_mean = part.means[-1]
        if conflict is not None:
            self._drop(conflict)
        return count

    def _drop(self, conflict: Conflict) -> None:
        """Drop the history on axes; a heading that one of them contradicts is not believed."""
        dropped, conflicts = self.taken.dropped | conflict.axes, (*self.taken.conflicts, conflict)
        self.taken, up = self.taken._replace(dropped=dropped, conflicts=conflicts), self.up
        horizontal = conflict.axes if up is None else conflict.axes & (np.abs(up) < VERTICAL)
        if self.taken.believed and horizontal.any():
            self.taken = self.taken._replace(believed=False)
            self._set_prior(up, self.taken.warmth)

    def _conflict(self, filters: list[Filter], sums: Array) -> tuple[int, Conflict | None]:
        """How many blocks until the history is dropped, or all of them; and that conflict.

        The e-value says of all axes together that the history is wrong. It is then dropped on the
        axes that speak against it, for the rest of the stretch.
        """
        usable = self.usable
        if not usable.any():
            return len(filters), None
        alone, prior = own(filters), self._prior_at(sums)
        variance = alone.start_variance * _factor(*self._noise_of(alone))
        seen = _with_history(alone.start, variance, prior, usable)
        wrong = np.flatnonzero(seen.log_e > np.log(CONFLICT))
        if not wrong.size:
            return len(filters), None
        row = int(wrong[0])
        against = usable & np.greater(seen.log_ratio[row], 0)
        away = alone.start[row] - prior.mean[row]
        return row + 1, Conflict(against, away, np.sqrt(prior.narrow + variance[row]))

    def _leave_out(self, part: Blocks, filters: list[Filter], row: int) -> None:
        """Leave out a block of motion and the one before it."""
        moving, motion = self.moving, part.means[max(row - 1, 0) : row + 1]
        if row > 1:
            self._accept(part.rows(0, row - 1), filters[:row])
        elif row == 0 and not moving and self._before is not None:
            self.taken = self._before  # the block before came with an earlier call
            motion = np.vstack([self._last_mean, motion])
        if self.blocks:
            current = self.taken.filter
            turned = np.sum(motion - own([current]).bias, axis=0) * self.block_s
            for _ in motion:
                current = current.skip(self.block_s)
            self._turned, self.taken = self._turned + turned, self.taken._replace(filter=current)
        if not moving:
            self.motions.append(self.start_s + self.taken.filter.time_s)
        self.moving, self._before = moving + len(motion), None
        enough = self.blocks >= _REFERENCE
        self.monitor = self._monitor(np.sqrt(self.taken.sums[:3] / self.blocks) if enough else None)

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

    def _noise_of(self, alone: Own) -> tuple[Array, Array]:
        """N^2 over that of the type with these blocks, (n, 3), and its degrees of freedom."""
        if np.isinf(self.freedom).all():
            return self.scale, self.freedom
        freedom = self.freedom + alone.freedom
        return (self.freedom * self.scale + alone.squares) / np.maximum(freedom, 1e-9), freedom

    @property
    def _known(self) -> Known:
        """What follows from the blocks taken so far, worked out once."""
        if self._worked_out is None or self._worked_out[0] is not self.taken:
            alone = own([self.taken.filter])
            scale, freedom = (np.reshape(x, (-1, 3))[0] for x in self._noise_of(alone))
            alone = alone.row(0)
            scaled = _scaled(alone, scale, freedom)
            answer = self._warmed(*self._posterior(scaled, self.usable))
            self._worked_out = self.taken, Known(alone, scaled, scale, freedom, *answer)
        return self._worked_out[1]

    def _prior_at(self, sums: Array) -> Prior:
        """The prior at the mean temperature of blocks, by their sums (..., 9)."""
        total, count = sums[..., 7:8], sums[..., 8:]
        known = (count > 0) & np.isfinite(self.taken.warmth)
        warmer = np.where(known, total / np.maximum(count, 1) - self.taken.warmth, 0.0)
        prior = self.taken.prior
        return replace(prior, mean=prior.mean + prior.slope * warmer)

    def _warmed(self, bias: Array, variance: Array) -> tuple[Array, Array]:
        """A bias at the temperature of the last block, from one at the mean of the blocks'."""
        mean, prior = self.temperature_c, self.taken.prior
        if mean is None or np.isnan(self.taken.last_c):
            return bias, variance
        warmer = self.taken.last_c - mean
        return bias + prior.slope * warmer, variance + (prior.slope_sigma * warmer) ** 2

    def log_noise(self) -> tuple[Array, float]:
        """N of this stretch alone, (3,), deg/s * sqrt(s), and its degrees of freedom."""
        squares, freedom = self._known.alone.squares, float(self._known.alone.freedom[0])
        if freedom < 1:
            return np.full(3, np.nan), 0.0
        return self.kind.noise.white * np.sqrt(squares / freedom), freedom

    def noise_scale(self) -> Array:
        """N^2 over that of the type, (3,), as known beforehand and by these blocks."""
        return self._known.scale

    def own(self) -> Own:
        """The estimate by this stretch alone, with the noise as known, and Student's interval."""
        return self._known.own

    def answer(self) -> tuple[Array, Array]:
        """The bias and its variance, by the stretch and the history."""
        return self._known.bias, self._known.variance

    def _posterior(self, alone: Own, usable: Mask) -> tuple[Array, Array]:
        """Bias and variance with the history where it is usable."""
        if not usable.any():
            return alone.bias, alone.variance
        prior = self._prior_at(self.taken.sums)
        at_start = _with_history(alone.start, alone.start_variance, prior, usable)
        unknown = np.isinf(alone.variance)
        with np.errstate(invalid="ignore"):
            moved = alone.bias + alone.follows * (at_start.mean - alone.start)
            rest = alone.variance - alone.follows**2 * alone.start_variance
        bias = np.where(usable, np.where(unknown, at_start.mean, moved), alone.bias)
        later = np.where(unknown, 0.0, rest) + alone.follows**2 * at_start.charged
        return bias, np.where(usable, later, alone.variance)

    @property
    def usable(self) -> Mask:
        """(3,), axes with a history that was not dropped."""
        return np.isfinite(self.taken.prior.narrow) & ~self.taken.dropped

    def hopeless(self, target_dps: float) -> Mask:
        """(3,), axes whose target is below the floor of the sensor, and that have no history."""
        floor = self.kind.noise.floor_dps * np.sqrt(self.noise_scale())
        return np.asarray((floor > target_dps) & ~self.usable)

    def reached(self, target_dps: float) -> Mask:
        """(3,), axes whose standard deviation is at the target or below."""
        return np.asarray(self.answer()[1] <= target_dps**2) & ~self.hopeless(target_dps)

    def seconds_left(self, target_dps: float, most_s: float) -> Array:
        """(3,), seconds at rest until the target; infinite where it is not within ``most_s``.

        The variances of blocks to come do not depend on the data. What does, the distance from the
        history and the noise where it is not known, is taken as it is now.
        """
        known, usable = self._known, self.usable
        seen, hopeless = self.blocks > 0, self.hopeless(target_dps)
        left = np.where(self.reached(target_dps), 0.0, np.inf)
        following, done = self.taken.filter, 0
        while np.any(np.isinf(left) & ~hopeless) and done * self.block_s < most_s:
            filters = following.ahead(_AHEAD)
            following, number = filters[-1], done + 1 + np.arange(_AHEAD)[:, None]
            later = _scaled(own(filters), known.scale, known.freedom + number)
            start = known.own.start if seen else np.where(usable, self.taken.prior.mean, 0.0)
            later = later._replace(start=np.broadcast_to(start, (_AHEAD, 3)))
            reached = self._posterior(later, usable)[1] <= target_dps**2
            first = np.where(reached.any(axis=0), done + 1 + reached.argmax(axis=0), np.inf)
            left = np.minimum(left, first * self.block_s)
            done += _AHEAD
        return left


def _with_history(start: Array, variance: Array, prior: Prior, usable: Mask) -> Posterior:
    """The posterior of the bias at the start; meaningless on axes whose history is not usable."""
    mean, narrow, wide = (np.where(usable, x, 1.0) for x in (prior.mean, prior.narrow, prior.wide))
    return mixture_posterior(start, np.where(usable, variance, np.inf), mean, narrow, wide)


def _factor(scale: Array, freedom: Array) -> Array:
    """On variances of N as of the type: the noise as known, and 1.96 sigma as Student's limits."""
    if np.isinf(freedom).all():
        return scale
    known = np.where(freedom > 0, freedom, 1.0)
    with np.errstate(invalid="ignore"):
        student = np.where(np.isinf(known), _TWO_SIDED, student_limits(_TWO_SIDED, known))
    return np.where(freedom > 0, scale * (student / _TWO_SIDED) ** 2, np.inf)


def _scaled(alone: Own, scale: Array, freedom: Array) -> Own:
    factor = _factor(scale, freedom)
    return alone._replace(
        variance=alone.variance * factor, start_variance=alone.start_variance * factor
    )
