"""A stretch in one attitude: the filter, the test of rest, and the history with its conflict."""

from collections.abc import Callable
from statistics import NormalDist
from typing import Any, NamedTuple, SupportsIndex

import numpy as np

from gyro_pipeline.calibrator.device_types import DeviceType
from gyro_pipeline.calibrator.filter import Estimate, Filter, estimates
from gyro_pipeline.calibrator.history import Prior, angle_deg
from gyro_pipeline.calibrator.reasons import VERTICAL, Reason, reason
from gyro_pipeline.calibrator.rest import ATTITUDE, MOTION, Alarm, Block, RestMonitor
from gyro_pipeline.calibrator.state import DROPPED, NONE, USED, Array, Mask
from gyro_pipeline.conventions import MDPS
from gyro_pipeline.physics.mixture import Posterior, mixture_posterior
from gyro_pipeline.quality.rest import student_limits

CONFLICT = 120.0
"""The e-value at which the history is dropped. Where it holds, that happens in at most one of as
many calibrations (Ville), and in half of that as measured."""

PriorOf = Callable[[Array | None, float | None, bool], Prior]
"""The prior by the up direction and the temperature, None where they are not measured, and by
whether a declared heading is believed."""

_TURN_DEG = 1.0  # the attitude is the same after a motion that turned the device by less
_WARMER_C = 0.5  # by which the temperature moves until the prior is looked up again
_REFERENCE = 6  # blocks at rest that say what rest is like after a motion
_PATIENCE = 20  # blocks of motion after which rest is looked for anew
_AHEAD = 64  # blocks that are looked ahead at a time
_TWO_SIDED = 1.959964


class Temperature(NamedTuple):
    """Of the blocks of a stretch, degrees Celsius; NaN where it is unknown."""

    blocks: int = 0
    mean: float = np.nan
    least: float = np.inf
    most: float = -np.inf
    last: float = np.nan

    def add(self, value: float) -> "Temperature":
        """One more block."""
        if np.isnan(value):
            return self._replace(last=value)
        mean = value if not self.blocks else self.mean + (value - self.mean) / (self.blocks + 1)
        least, most = min(self.least, value), max(self.most, value)
        return Temperature(self.blocks + 1, mean, least, most, value)


class Snapshot(NamedTuple):
    """What the blocks so far come to; a motion goes back to the snapshot before the last block."""

    filter: Filter
    prior: Prior
    prior_c: float = np.nan  # temperature that the prior is of
    believed: bool = True  # that a declared heading repeats
    dropped: Mask = np.zeros(3, bool)  # axes whose history was dropped
    conflicts: tuple[Reason, ...] = ()
    variances: Array = np.zeros(3)  # summed over blocks, within them
    gravity: Array = np.zeros(3)  # summed over blocks
    temperature: Temperature = Temperature()


class Stretch:
    """What is known from blocks at rest in one attitude.

    Args:
        device_type, known_still: Those of the calibrator.
        prior_of: What the history says.
        scale, freedom: (3,), N^2 over that of the type as known beforehand, and its degrees of
            freedom: infinite where N is known, 0 where it is not.
        size, block_s: Samples in a block, and its length in seconds.
        start_s: When it starts, seconds since the first sample.
        age_s: Seconds from power-on to the start; None where that is unknown.
    """

    def __init__(  # noqa: PLR0913, PLR0917 - what stretches share, and two that differ
        self, device_type: DeviceType, prior_of: PriorOf, scale: Array, freedom: Array, size: int,
        block_s: float, known_still: bool, start_s: float, age_s: float | None,
    ) -> None:  # fmt: skip
        self.device_type, self.noise, self.prior_of = device_type, device_type.noise, prior_of
        self.scale, self.freedom, self.size, self.block_s = scale, freedom, size, block_s
        self.known_still, self.start_s = known_still, start_s
        start = Filter.start(self.noise, block_s, age_s)
        self.current = Snapshot(start, prior_of(None, None, True))
        self.previous: tuple[Snapshot, Array] | None = None  # before the last block, and its mean
        self.moving = 0  # blocks of motion that just came
        self._turned = np.zeros(3)  # degrees, over them
        self.motions: tuple[float, ...] = ()  # when each started, seconds since the first sample
        self._renew_monitor()
        self._conclude()

    @property
    def blocks(self) -> int:
        """Blocks at rest that the estimate is from."""
        return self.current.filter.blocks

    @property
    def seconds(self) -> float:
        """Their length."""
        return self.blocks * self.block_s

    @property
    def prior(self) -> Prior:
        """What the history says at the attitude and temperature of the stretch."""
        return self.current.prior

    @property
    def up(self) -> Array | None:
        """(3,), direction of the mean acceleration; None where it is not measured."""
        length = np.linalg.norm(self.current.gravity)
        return np.asarray(self.current.gravity / length) if length > 0 else None

    @property
    def usable(self) -> Mask:
        """(3,), axes with a history that was not dropped."""
        return np.isfinite(self.prior.narrow) & ~self.current.dropped

    @property
    def outcome(self) -> tuple[str, ...]:
        """What became of the history on each axis."""
        known, dropped = np.isfinite(self.prior.narrow), self.current.dropped
        return tuple(np.where(known, np.where(dropped, DROPPED, USED), NONE).tolist())

    @property
    def floor_dps(self) -> Array:
        """(3,), below which no average of the sensor comes."""
        return np.asarray(self.noise.floor_dps * np.sqrt(self.noise_scale))

    def take(self, block: Block) -> Alarm | None:
        """Take a block; an alarm that is returned ends the stretch.

        After ATTITUDE the block is the first one of the next stretch, else it is left out.
        """
        following, innovation = self.current.filter.update(block.mean)
        alarm = None if self.known_still else self._alarm(block, innovation)
        if alarm is None and self.moving and self._attitude_changed(block):
            return Alarm(ATTITUDE)
        if alarm is None:
            self._accept(block, following)
        elif alarm.code == MOTION:
            self._leave_out(block)
            return alarm if self.moving >= _PATIENCE else None
        return alarm

    def skip(self, seconds: float) -> None:
        """Move on over a gap in the data."""
        if self.blocks:
            self.current = self.current._replace(filter=self.current.filter.skip(seconds))
            self.previous = None
            self._conclude()

    def _renew_monitor(self) -> None:
        enough, sums = self.blocks >= _REFERENCE, self.current.variances
        noise_dps = np.sqrt(sums / self.blocks) if enough else None
        least = self.device_type.least_change
        self._monitor = RestMonitor(self.size, self.block_s, least, self.freedom, noise_dps)

    def _alarm(self, block: Block, innovation: Array) -> Alarm | None:
        """An alarm; after a motion also where a block is far from the level before it."""
        white, known = self.noise.white / np.sqrt(self.block_s), np.sqrt(self.scale)
        alarm = self._monitor.update(innovation / known, white * known, block)
        if alarm is None and self.moving and self.blocks >= _REFERENCE:
            limit = self.device_type.least_change + 6 * np.sqrt(self.noise_scale) * white
            if np.any(np.abs(innovation) * white > limit):
                return Alarm(MOTION)
        return alarm

    def _accept(self, block: Block, following: Filter) -> None:
        """Take a block at rest."""
        before, gravity = self.current, block.gravity
        known, first = np.isfinite(gravity).all(), not self.blocks
        if first or not abs(block.temperature - before.prior_c) <= _WARMER_C:
            up = gravity / np.linalg.norm(gravity) if known and self.up is None else self.up
            if first or np.isfinite(block.temperature):
                self._set_prior(up, block.temperature)
        self.previous = before, block.mean
        self.current = self.current._replace(
            filter=following,
            variances=before.variances + block.variance,
            gravity=before.gravity + gravity if known else before.gravity,
            temperature=before.temperature.add(block.temperature),
        )
        self.moving, self._turned = 0, np.zeros(3)
        self._conclude()

    def _set_prior(self, up: Array | None, temperature_c: float) -> None:
        known = temperature_c if np.isfinite(temperature_c) else None
        prior = self.prior_of(up, known, self.current.believed)
        self.current = self.current._replace(prior=prior, prior_c=temperature_c)

    def _leave_out(self, block: Block) -> None:
        """Leave out a block of motion and the one before it."""
        motion, first = [block.mean], not self.moving
        if first and self.previous is not None:
            self.current, last_mean = self.previous
            motion.append(last_mean)
        if self.blocks:
            bias = estimates([self.current.filter]).bias[0]
            self._turned = self._turned + np.sum(motion - bias, axis=0) * self.block_s
            skipped = self.current.filter.skip(len(motion) * self.block_s)
            self.current = self.current._replace(filter=skipped)
        if first:
            self.motions = (*self.motions, self.start_s + self.current.filter.time_s)
        self.moving, self.previous = self.moving + len(motion), None
        self._renew_monitor()
        self._conclude()

    def _attitude_changed(self, block: Block) -> bool:
        """Whether the device was turned over a motion: by its rates, or by gravity."""
        up, known = self.up, np.isfinite(block.gravity).all()
        tilt = angle_deg(block.gravity, up) if up is not None and known else 0.0
        return self.blocks > 0 and max(float(np.linalg.norm(self._turned)), tilt) > _TURN_DEG

    def _conclude(self) -> None:
        """Work out the answer, and drop a history that the blocks so far contradict.

        The e-value says of all axes together that the history is wrong. It is then dropped on the
        axes that speak against it, for the rest of the stretch.
        """
        self.unscaled = Estimate(*(x[0] for x in estimates([self.current.filter])))
        self.noise_scale, self.noise_freedom = self.scale, self.freedom
        if not np.isinf(self.freedom).all():
            self.noise_freedom = self.freedom + self.unscaled.freedom
            total = self.freedom * self.scale + self.unscaled.squares
            self.noise_scale = total / np.maximum(self.noise_freedom, 1e-9)
        self.estimate = _scaled(self.unscaled, self.noise_scale, self.noise_freedom)
        seen, bias, variance = self._posterior(self.estimate)
        if seen is not None and seen.log_e > np.log(CONFLICT):
            self._drop(seen)
            _, bias, variance = self._posterior(self.estimate)
        warmer = _warmer(self.current.temperature.last, self.current.temperature.mean)
        self.bias = bias + self.prior.slope * warmer  # as in the last block
        self.variance = variance + (self.prior.slope_sigma * warmer) ** 2

    def _drop(self, seen: Posterior) -> None:
        """Drop the history on axes; a heading that one of them contradicts is not believed."""
        current, up = self.current, self.up
        axes = self.usable & np.greater(seen.log_ratio, 0)
        away = (self.estimate.start - self._prior_mean()) / MDPS
        sigma = np.sqrt(self.prior.narrow + self.estimate.start_variance) / MDPS
        reasons = [
            _conflict(axis, float(away[axis]), float(sigma[axis])) for axis in np.flatnonzero(axes)
        ]
        conflicts = (*current.conflicts, *reasons)
        self.current = current._replace(dropped=current.dropped | axes, conflicts=conflicts)
        horizontal = axes if up is None else axes & (np.abs(up) < VERTICAL)
        if current.believed and horizontal.any():
            self.current = self.current._replace(believed=False)
            self._set_prior(up, current.prior_c)

    def _prior_mean(self) -> Array:
        """Mean of the prior at the mean temperature of the blocks, by its slope."""
        warmer = _warmer(self.current.temperature.mean, self.current.prior_c)
        return np.asarray(self.prior.mean + self.prior.slope * warmer)

    def _posterior(self, estimate: Estimate) -> tuple[Posterior | None, Array, Array]:
        """With the history where it is usable: of the bias at the start, and bias and variance."""
        usable, transfer = self.usable, estimate.transfer
        if not usable.any():
            return None, estimate.bias, estimate.variance
        prior = self._prior_mean(), self.prior.narrow, self.prior.wide
        mean, narrow, wide = (np.where(usable, x, 1.0) for x in prior)
        own = np.where(usable, estimate.start_variance, np.inf)
        seen = mixture_posterior(estimate.start, own, mean, narrow, wide)
        unknown = np.isinf(estimate.variance)
        with np.errstate(invalid="ignore"):
            moved = estimate.bias + transfer * (seen.mean - estimate.start)
            added = estimate.variance - transfer**2 * estimate.start_variance
        bias = np.where(usable, np.where(unknown, seen.mean, moved), estimate.bias)
        variance = np.where(unknown, 0.0, added) + transfer**2 * seen.charged
        return seen, bias, np.where(usable, variance, estimate.variance)

    def log_noise(self) -> tuple[Array | None, float]:
        """N of this stretch alone, (3,), deg/s * sqrt(s), and its degrees of freedom."""
        freedom = float(self.unscaled.freedom[0])
        if freedom < 1:
            return None, 0.0
        return self.noise.white * np.sqrt(self.unscaled.squares / freedom), freedom

    def reached(self, target_dps: float) -> Mask:
        """(3,), axes at the target, which is not below the sensor's floor without a history."""
        below = (self.floor_dps > target_dps) & ~self.usable
        return np.asarray((self.variance <= target_dps**2) & ~below)

    def seconds_left(self, target_dps: float, most_s: float) -> Array:
        """(3,), seconds at rest until the target; infinite where it is not within ``most_s``.

        The variances of blocks to come do not depend on the data. What does, the distance from the
        history and the noise where it is unknown, is taken as it is now.
        """
        below = (self.floor_dps > target_dps) & ~self.usable
        left = np.where(self.reached(target_dps), 0.0, np.inf)
        start = self.estimate.start if self.blocks else np.where(self.usable, self.prior.mean, 0.0)
        following, done = self.current.filter, 0
        while np.any(np.isinf(left) & ~below) and done * self.block_s < most_s:
            filters = following.ahead(_AHEAD)
            following, number = filters[-1], done + 1 + np.arange(_AHEAD)[:, None]
            later = _scaled(estimates(filters), self.noise_scale, self.noise_freedom + number)
            later = later._replace(start=np.broadcast_to(start, (_AHEAD, 3)))
            reached = self._posterior(later)[2] <= target_dps**2
            first = np.where(reached.any(axis=0), done + 1 + reached.argmax(axis=0), np.inf)
            left = np.minimum(left, first * self.block_s)
            done += _AHEAD
        return np.where(below, np.inf, left)


def _warmer(now: float, then: float) -> float:
    """Degrees; 0 where one of them is not known."""
    return 0.0 if np.isnan(now - then) else now - then


def _conflict(axis: SupportsIndex, away: float, sigma: float) -> Reason:
    chance = max(2 * NormalDist().cdf(-abs(away / sigma)), 1e-12)
    words: dict[str, Any] = {"away": abs(away), "chance": 1 / chance}
    return reason("conflict", away, abs(away / sigma), axis, **words)


def _scaled(estimate: Estimate, scale: Array, freedom: Array) -> Estimate:
    """With the noise as known, and 1.96 sigma as Student's limits; infinite where it is unknown."""
    factor = scale
    if not np.isinf(freedom).all():
        student = student_limits(_TWO_SIDED, np.clip(freedom, 1e-3, 1e9))
        factor = np.where(freedom > 0, scale * (student / _TWO_SIDED) ** 2, np.inf)
    return estimate._replace(
        variance=estimate.variance * factor, start_variance=estimate.start_variance * factor
    )
