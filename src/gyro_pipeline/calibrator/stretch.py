"""A stretch in one attitude: the filter, the test of rest, and the history with its conflict."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from statistics import NormalDist
from typing import NamedTuple, SupportsIndex

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gyro_pipeline.calibrator.device_types import DeviceType
from gyro_pipeline.calibrator.filter import Array, Estimate, Filter
from gyro_pipeline.calibrator.history import (
    DROPPED,
    NONE,
    USED,
    Calibration,
    Circumstances,
    Prior,
    angle_deg,
    noise_of,
    prior_of,
    unit,
)  # fmt: skip
from gyro_pipeline.calibrator.reasons import VERTICAL, Reason, reason
from gyro_pipeline.calibrator.rest import Alarm, Blocks, RestMonitor
from gyro_pipeline.conventions import MDPS
from gyro_pipeline.physics.mixture import log_e, log_ratios, mixture_posterior
from gyro_pipeline.quality.rest import student_limits

Mask = NDArray[np.bool_]

CONFLICT = 120.0
"""The e-value at which the history is dropped. Where it holds, that happens in at most one of as
many calibrations (Ville), and in half of that as measured."""

BLOCK_S = 0.5

_LEAST_SAMPLES = 5  # in a block: fewer do not tell the noise
_WARMER_C = 0.5  # by which the temperature moves until the prior is looked up again
_AHEAD = 64  # blocks that are looked ahead at a time
_TWO_SIDED = 1.959964


@dataclass
class Setup:
    """What is known before the first sample."""

    device_type: DeviceType
    rate_hz: float
    history: Sequence[Calibration]  # the oldest first
    now: Circumstances

    def __post_init__(self) -> None:
        size = max(round(BLOCK_S * self.rate_hz), _LEAST_SAMPLES)  # samples in a block
        self.size, self.block_s, self.noise = size, size / self.rate_hz, self.device_type.noise
        # N^2 over that of the type, (3,), and its degrees of freedom: infinite where it is known,
        # 0 where it is not.
        self.known = noise_of(self.history, self.device_type)
        self.factor = np.sqrt(self.known[0])
        self.white = self.factor * self.noise.white / np.sqrt(self.block_s)  # of a block's mean
        # Where neither attitude nor temperature is known.
        self.unseen_prior = prior_of(self.history, self.device_type, self.now)

    def prior(self, up: Array | None, celsius: float, believed: bool) -> Prior:
        """What the history says; ``believed``: that a declared heading repeats."""
        if up is None and np.isnan(celsius) and believed:
            return self.unseen_prior
        known = celsius if np.isfinite(celsius) else None
        same = self.now.same_heading and believed
        now = replace(self.now, up=up, temperature_c=known, same_heading=same)
        return prior_of(self.history, self.device_type, now)


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


@dataclass(frozen=True, eq=False)
class Stretch:
    """What is known from blocks at rest in one attitude; a block makes a new one."""

    setup: Setup
    start_s: float  # seconds since the first sample
    filter: Filter
    monitor: RestMonitor
    prior: Prior
    prior_c: float = np.nan  # temperature that the prior is of
    believed: bool = True  # that a declared heading repeats
    dropped: Mask = field(default_factory=lambda: np.zeros(3, bool))
    notes: tuple[Reason, ...] = ()  # motions that were cut, conflicts
    gravity: Array = field(default_factory=lambda: np.zeros(4))  # summed over blocks, and 1
    temperature: Temperature = Temperature()
    last_mean: Array = field(default_factory=lambda: np.zeros(3))  # of the last block

    @classmethod
    def start(cls, setup: Setup, start_s: float) -> "Stretch":
        """Before the first block; its history is as if attitude and temperature were not known."""
        power_on_s = setup.now.since_power_on_s
        age_s = None if power_on_s is None else power_on_s + start_s
        least = setup.device_type.least_change_mdps * MDPS
        monitor = RestMonitor(setup.size, setup.block_s, least, setup.known[1])
        start = Filter.start(setup.noise, setup.block_s, age_s)
        return cls(setup, start_s, start, monitor, setup.unseen_prior)

    @property
    def blocks(self) -> int:
        """Blocks at rest that the estimate is from."""
        return int(self.filter.blocks)

    @property
    def seconds(self) -> float:
        """Their length."""
        return self.blocks * self.setup.block_s

    @cached_property
    def up(self) -> Array | None:
        """(3,), direction of the mean acceleration; None where it is not measured."""
        return unit(self.gravity[:3]) if self.gravity[3] else None

    @cached_property
    def usable(self) -> Mask:
        """(3,), axes with a history that was not dropped."""
        return np.isfinite(self.prior.narrow) & ~self.dropped

    @property
    def outcome(self) -> tuple[str, str, str]:
        """What became of the history on each axis."""
        kept = np.where(self.dropped, DROPPED, USED)
        x, y, z = np.where(np.isfinite(self.prior.narrow), kept, NONE).tolist()
        return x, y, z

    def take(self, blocks: Blocks) -> tuple["Stretch", int, Alarm | None]:
        """The stretch after some of the blocks; how many; and if that is none, the alarm.

        How they are dealt to calls changes no bit.
        """
        before, blocks = self._prepared(blocks)
        filters, innovations, temperatures = [before.filter], [], [before.temperature]
        for mean, celsius in zip(blocks.mean, blocks.temperature.tolist(), strict=True):
            following, innovation = filters[-1].update(mean)
            filters.append(following)
            innovations.append(innovation)
            temperatures.append(temperatures[-1].add(celsius))
        monitor, count, alarm = before.monitor, len(innovations), None
        if not self.setup.now.known_still:
            units = np.array(innovations) / self.setup.factor
            monitor, count, alarm = monitor.update(units, self.setup.white, blocks)
        if count == 0:
            return self, 0, alarm
        conflict = before._conflicts(filters[1 : count + 1], temperatures[1:])
        if conflict is None and alarm is None or conflict == len(innovations) - 1:
            after = before._with(blocks, filters[-1], monitor, temperatures[-1])
            return (after if conflict is None else after._dropped()), len(innovations), None
        return self.take(blocks.part(0, count if conflict is None else conflict + 1))

    def _prepared(self, blocks: Blocks) -> tuple["Stretch", Blocks]:
        """With the prior at the attitude and temperature of the first block; the blocks it is of.

        It is looked up at the first block of all, and where the temperature has moved since.
        """
        before, celsius = self, blocks.temperature
        if not self.blocks or _far(celsius[0], self.prior_c):
            up = self.up
            if up is None and np.isfinite(blocks.gravity[0]).all():
                up = unit(blocks.gravity[0])
            before = self._with_prior(up, float(celsius[0]), self.believed)
        far = _far(celsius, before.prior_c)
        return before, blocks.part(0, int(far.argmax()) if far.any() else None)

    def _with(
        self, blocks: Blocks, after: Filter, monitor: RestMonitor, temperature: Temperature
    ) -> "Stretch":
        measured = blocks.gravity[np.isfinite(blocks.gravity).all(axis=1)]
        added = np.hstack([measured, np.ones((len(measured), 1))])
        return replace(
            self,
            filter=after,
            monitor=monitor,
            gravity=np.add.accumulate(np.vstack([self.gravity, added]))[-1],
            temperature=temperature,
            last_mean=blocks.mean[-1],
        )

    def cut(self, seconds: float, motion: Reason | None) -> "Stretch":
        """Move on over seconds without data, or over a motion."""
        if not self.blocks:
            return self
        moved = replace(self, filter=self.filter.skip(seconds))
        if motion is None:
            return moved
        return replace(moved, notes=(*self.notes, motion), monitor=self.monitor.level_anew())

    def turned_deg(self, turned: Array, gravity: Array) -> float:
        """By how much the device was turned over a motion: by its rates, or by gravity."""
        known = self.up is not None and np.isfinite(gravity).all()
        tilt = angle_deg(gravity, self.up) if known and self.up is not None else 0.0
        return max(float(np.linalg.norm(turned)), tilt)

    def _with_prior(self, up: Array | None, celsius: float, believed: bool) -> "Stretch":
        prior = self.setup.prior(up, celsius, believed)
        return replace(self, prior=prior, prior_c=celsius, believed=believed)

    def _conflicts(self, filters: Sequence[Filter], temperatures: list[Temperature]) -> int | None:
        """Number of the first filter at which the e-value says that the history is wrong."""
        if not self.usable.any():
            return None
        own = self.filter.stack(filters).estimate()
        own = self._scaled(own, *self._noise_with(own))
        warmer = [_degrees(self.prior_c, t.mean) for t in temperatures[: len(filters)]]
        off = own.start - self.prior.mean - self.prior.slope * np.array(warmer)[:, None]
        high = log_e(self._ratios(off, own.start_variance)) > np.log(CONFLICT)
        return int(high.argmax()) if high.any() else None

    def _ratios(self, off: Array, variance: Array) -> Array:
        ratios = log_ratios(off, variance, self.prior.narrow, self.prior.wide)
        return np.where(self.usable, ratios, 0.0)

    def _dropped(self) -> "Stretch":
        """Without the history on the axes that speak against it, for the rest of the stretch.

        A heading that one of them contradicts is no longer believed.
        """
        own = self.estimate
        off = own.start - self._prior_mean
        axes = self.usable & (self._ratios(off, own.start_variance) > 0)
        sigma = np.sqrt(self.prior.narrow + own.start_variance)
        notes = [_conflict(axis, off[axis], sigma[axis]) for axis in np.flatnonzero(axes)]
        after = replace(self, dropped=self.dropped | axes, notes=(*self.notes, *notes))
        horizontal = axes if self.up is None else axes & (np.abs(self.up) < VERTICAL)
        return after._with_prior(self.up, self.prior_c, False) if horizontal.any() else after

    @cached_property
    def unscaled(self) -> Estimate:
        """By the data alone, with the noise of the type."""
        return self.filter.estimate()

    @cached_property
    def noise_scale(self) -> tuple[Array, Array]:
        """N^2 over that of the type, and its degrees of freedom, this log's blocks included."""
        return self._noise_with(self.unscaled)

    def _noise_with(self, own: Estimate) -> tuple[Array, Array]:
        scale, freedom = self.setup.known
        if np.isinf(freedom).all():
            return scale, freedom
        total = freedom + own.freedom
        return (freedom * scale + own.squares) / np.maximum(total, 1e-9), total

    @cached_property
    def estimate(self) -> Estimate:
        """By the data alone, with the noise as known; the variances make limits of 1.96 sigma."""
        return self._scaled(self.unscaled, *self.noise_scale)

    def _scaled(self, estimate: Estimate, factor: Array, freedom: Array) -> Estimate:
        """With Student's limits; over all attempts, where only this log tells the noise."""
        if not np.isinf(freedom).all():
            attempts = self.setup.now.attempt if not self.setup.known[1].any() else 1
            z = -NormalDist().inv_cdf(0.025 / attempts)
            student = student_limits(z, np.clip(freedom, 1e-3, 1e9))
            factor = np.where(freedom > 0, factor * (student / _TWO_SIDED) ** 2, np.inf)
        own, start = estimate.variance * factor, estimate.start_variance * factor
        return estimate._replace(variance=own, start_variance=start)

    @cached_property
    def bias(self) -> Array:
        """(3,), deg/s, as in the last block; what it settles to, where the device warms up."""
        return self._posterior(self.estimate)[0] + self.prior.slope * self._warmer

    @cached_property
    def variance(self) -> Array:
        """(3,), of the bias."""
        return self._posterior(self.estimate)[1] + (self.prior.slope_sigma * self._warmer) ** 2

    @property
    def _warmer(self) -> float:
        """By how much the last block is warmer than the mean, where both are known."""
        return _degrees(self.temperature.mean, self.temperature.last)

    @property
    def _prior_mean(self) -> Array:
        """Mean of the prior at the mean temperature of the blocks, by its slope."""
        warmer = _degrees(self.prior_c, self.temperature.mean)
        return np.asarray(self.prior.mean + self.prior.slope * warmer)

    def _posterior(self, estimate: Estimate) -> tuple[Array, Array]:
        """Bias now and its variance, with the history where it is usable."""
        usable, transfer = self.usable, estimate.transfer
        if not usable.any():
            return estimate.bias, estimate.variance
        given = self._prior_mean, self.prior.narrow, self.prior.wide
        mean, narrow, wide = (np.where(usable, x, 1.0) for x in given)
        own = np.where(usable, estimate.start_variance, np.inf)
        seen = mixture_posterior(estimate.start, own, mean, narrow, wide)
        unknown = np.isinf(estimate.variance)
        with np.errstate(invalid="ignore"):
            moved = estimate.bias + transfer * (seen.mean - estimate.start)
            added = estimate.variance - transfer**2 * estimate.start_variance
        bias = np.where(usable, np.where(unknown, seen.mean, moved), estimate.bias)
        variance = np.where(unknown, 0.0, added) + transfer**2 * seen.charged
        return bias, np.where(usable, variance, estimate.variance)

    def log_noise(self) -> tuple[Array | None, float]:
        """N of this stretch alone, (3,), deg/s * sqrt(s), and its degrees of freedom."""
        freedom = float(self.unscaled.freedom[0])
        if freedom < 1:
            return None, 0.0
        return self.setup.noise.white * np.sqrt(self.unscaled.squares / freedom), freedom

    @property
    def floor_dps(self) -> Array:
        """(3,), below which no average of the sensor comes."""
        return np.asarray(self.setup.noise.floor_dps * np.sqrt(self.noise_scale[0]))

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
        following, done = self.filter, 0
        while np.any(np.isinf(left) & ~below) and done * self.setup.block_s < most_s:
            following, stack = following.ahead(_AHEAD)
            number = done + 1 + np.arange(_AHEAD)[:, None]
            later = self._scaled(
                stack.estimate(), self.noise_scale[0], self.noise_scale[1] + number
            )
            later = later._replace(start=np.broadcast_to(start, (_AHEAD, 3)))
            reached = self._posterior(later)[1] <= target_dps**2
            first = np.where(reached.any(axis=0), done + 1 + reached.argmax(axis=0), np.inf)
            left = np.minimum(left, first * self.setup.block_s)
            done += _AHEAD
        return np.where(below, np.inf, left)


def _degrees(then: float, now: float) -> float:
    """From one to the other; 0 where one of them is not known."""
    return 0.0 if np.isnan(now - then) else now - then


def _far(now: ArrayLike, then: float) -> NDArray[np.bool_]:
    """Where the temperature has moved, or is known at last."""
    return np.isfinite(now) & ~(np.abs(np.subtract(now, then)) <= _WARMER_C)


def _conflict(axis: SupportsIndex, away: float, sigma: float) -> Reason:
    chance = max(2 * NormalDist().cdf(-abs(away / sigma)), 1e-12)
    away, sigmas = float(away / MDPS), float(abs(away / sigma))
    return reason("conflict", away, sigmas, axis, away=abs(away), chance=1 / chance)
