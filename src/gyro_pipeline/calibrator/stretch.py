"""A stretch of rest in one attitude: filter, tests of rest, history, and conflict with it."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from statistics import NormalDist
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

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
from gyro_pipeline.physics.mixture import Posterior, log_e, log_ratios, mixture_posterior
from gyro_pipeline.quality.rest import Mask, student_limits

BLOCK_S = 0.5
LEAST_S = 1.0  # seconds at rest before a target counts as reached, where the noise is known
_LEAST_UNKNOWN_S = 10.0  # the same where the noise is unknown
_LONGEST_S = 3600.0  # the longest time at rest that is predicted as seconds left
# The e-value at which the history is dropped. A right history is dropped in at most one of this
# many calibrations (Ville's inequality); half as often in simulations.
_CONFLICT = 120.0
_MIN_BLOCK_SAMPLES = 5  # fewer do not show the noise
_TEMPERATURE_STEP_C = 0.5  # after which the prior is computed again
_LOOKAHEAD_BLOCKS = 64  # that are predicted at a time
_TWO_SIDED = 1.959964


@dataclass
class Setup:
    """Everything that is known before the first sample."""

    device_type: DeviceType
    rate_hz: float
    history: Sequence[Calibration]  # the oldest first
    now: Circumstances
    target_dps: float = np.inf  # infinite without a target

    def __post_init__(self) -> None:
        size = max(round(BLOCK_S * self.rate_hz), _MIN_BLOCK_SAMPLES)  # samples in a block
        self.size, self.block_s, self.noise = size, size / self.rate_hz, self.device_type.noise
        # N^2 relative to the type, (3,), and its degrees of freedom: infinite where N is known, 0
        # where it is not.
        self.noise_prior = noise_of(self.history, self.device_type)
        self.noise_known = bool(np.all(self.noise_prior[1] > 0))
        self.least_s = LEAST_S if self.noise_known else _LEAST_UNKNOWN_S
        self.noise_factor = np.sqrt(self.noise_prior[0])
        # standard deviation of a block mean
        self.white = self.noise_factor * self.noise.white / np.sqrt(self.block_s)
        # for an unknown attitude and temperature
        self.unseen_prior = prior_of(self.history, self.device_type, self.now)


class Temperature(NamedTuple):
    """Temperature of the blocks of a stretch, degrees Celsius; NaN where it is unknown."""

    blocks: int = 0
    mean: float = np.nan
    least: float = np.inf
    most: float = -np.inf
    last: float = np.nan
    step: float = np.nan  # from the last block but one to the last
    bends: float = 0.0  # sum of the squared changes of the step

    def add(self, value: float) -> "Temperature":
        """The temperature after one more block."""
        if np.isnan(value):
            return self._replace(last=value, step=value)
        mean = value if not self.blocks else self.mean + (value - self.mean) / (self.blocks + 1)
        least, most = min(self.least, value), max(self.most, value)
        step = value - self.last
        bends = self.bends + _temperature_rise(self.step, step) ** 2
        return Temperature(self.blocks + 1, mean, least, most, value, step, bends)

    @property
    def rise(self) -> tuple[float, float, float]:
        """The last block minus the mean, as far as it exceeds chance, its square, and chance's.

        Chance shows where steps from block to block differ, as by a thermometer of whole degrees.
        """
        rise = _temperature_rise(self.mean, self.last)
        chance = min(self.bends / 6 / max(self.blocks - 2, 1), rise**2)
        return rise - chance / rise if rise else 0.0, rise**2 - chance, chance


@dataclass(frozen=True, eq=False)
class Stretch:
    """The immutable state after blocks at rest in one attitude."""

    setup: Setup
    start_s: float  # seconds since the first sample
    filter: Filter
    monitor: RestMonitor
    prior: Prior
    prior_c: float = np.nan  # temperature of the prior
    trust_heading: bool = True  # whether a declared heading is believed to repeat
    dropped: Mask = field(default_factory=lambda: np.zeros(3, bool))
    notes: tuple[Reason, ...] = ()  # motions that were cut, conflicts
    gravity: Array = field(default_factory=lambda: np.zeros(4))  # sum over blocks, and their number
    temperature: Temperature = Temperature()

    @classmethod
    def start(cls, setup: Setup, start_s: float) -> "Stretch":
        """The stretch before the first block, when attitude and temperature are unknown."""
        power_on_s = setup.now.since_power_on_s
        age_s = None if power_on_s is None else power_on_s + start_s
        least_dps = setup.device_type.least_change_mdps * MDPS
        monitor = RestMonitor(setup.size, setup.block_s, least_dps, setup.noise_prior[1])
        start = Filter.start(setup.noise, setup.block_s, age_s)
        return cls(setup, start_s, start, monitor, setup.unseen_prior)

    @property
    def blocks(self) -> int:
        """Number of blocks at rest that the estimate is from."""
        return int(self.filter.blocks)

    @property
    def seconds(self) -> float:
        """Seconds at rest that the estimate is from."""
        return self.blocks * self.setup.block_s

    @cached_property
    def up(self) -> Array | None:
        """Direction of the mean acceleration, (3,); None where it is not measured."""
        return unit(self.gravity[:3]) if self.gravity[3] else None

    @cached_property
    def usable(self) -> Mask:
        """Whether an axis has a history that was not dropped, (3,)."""
        return np.isfinite(self.prior.narrow) & ~self.dropped

    @property
    def outcome(self) -> tuple[str, str, str]:
        """How the history was treated on each axis."""
        outcome = np.where(self.dropped, DROPPED, USED)
        x, y, z = np.where(np.isfinite(self.prior.narrow), outcome, NONE).tolist()
        return x, y, z

    def update(self, blocks: Blocks) -> tuple["Stretch", int, Alarm | None]:
        """The stretch after the first blocks, their number, and the alarm if that is 0.

        The result does not depend, bit for bit, on how blocks are divided among calls.
        """
        before, blocks = self._with_current_prior(blocks)
        filters, innovations, temperatures = [before.filter], [], [before.temperature]
        for mean, celsius in zip(blocks.mean, blocks.temperature.tolist(), strict=True):
            following, innovation = filters[-1].update(mean)
            filters.append(following)
            innovations.append(innovation)
            temperatures.append(temperatures[-1].add(celsius))
        monitor, count, alarm = before.monitor, len(innovations), None
        if not self.setup.now.known_still:
            units = np.array(innovations) / self.setup.noise_factor
            monitor, count, alarm = monitor.update(units, self.setup.white, blocks)
        if count == 0:
            return self, 0, alarm
        conflict = before._first_conflict(filters[1 : count + 1], temperatures[1:])
        if conflict is None and alarm is None or conflict == len(innovations) - 1:
            after = replace(
                before,
                filter=filters[-1],
                monitor=monitor,
                gravity=_gravity_sum(before.gravity, blocks.gravity),
                temperature=temperatures[-1],
            )
            return (after if conflict is None else after._drop_history()), len(innovations), None
        return self.update(blocks.part(0, count if conflict is None else conflict + 1))

    def _with_current_prior(self, blocks: Blocks) -> tuple["Stretch", Blocks]:
        """The stretch with the prior of the first block, and the blocks for which it holds.

        The prior is computed at the first block of a stretch, and where the temperature has moved.
        """
        before, celsius = self, blocks.temperature
        if not self.blocks or _temperature_moved(celsius[0], self.prior_c):
            up = self.up
            if up is None and np.isfinite(blocks.gravity[0]).all():
                up = unit(blocks.gravity[0])
            before = self._with_prior(up, float(celsius[0]), self.trust_heading)
        moved = _temperature_moved(celsius, before.prior_c)
        return before, blocks.part(0, int(moved.argmax()) if moved.any() else None)

    def cut(self, seconds: float, motion: Reason | None) -> "Stretch":
        """The stretch after seconds without data, or after a motion."""
        if not self.blocks:
            return Stretch.start(self.setup, self.start_s + seconds)
        moved = replace(self, filter=self.filter.skip(seconds))
        if motion is None:
            return moved
        return replace(moved, notes=(*self.notes, motion), monitor=self.monitor.restart_slope())

    def turned_deg(self, rotation: Array, gravity: Array) -> float:
        """The angle of a turn during a motion, from the integrated rates (3,) or from gravity."""
        turn = float(np.linalg.norm(rotation))
        if self.up is None or not np.isfinite(gravity).all():
            return turn
        return max(turn, angle_deg(gravity, self.up))

    def _with_prior(self, up: Array | None, celsius: float, trust_heading: bool) -> "Stretch":
        """The stretch with the prior at an attitude and a temperature."""
        setup, prior = self.setup, self.setup.unseen_prior
        if up is not None or not np.isnan(celsius) or not trust_heading:
            temperature_c = celsius if np.isfinite(celsius) else None
            same_heading = setup.now.same_heading and trust_heading
            now = replace(setup.now, up=up, temperature_c=temperature_c, same_heading=same_heading)
            prior = prior_of(setup.history, setup.device_type, now)
        return replace(self, prior=prior, prior_c=celsius, trust_heading=trust_heading)

    def _first_conflict(
        self, filters: Sequence[Filter], temperatures: list[Temperature]
    ) -> int | None:
        """Number of the first filter whose e-value says that the history is wrong."""
        if not self.usable.any():
            return None
        estimate = self.filter.stack(filters).estimate()
        estimate = self._scaled(estimate, self._noise_with(estimate))
        rise = [_temperature_rise(self.prior_c, t.mean) for t in temperatures[: len(filters)]]
        off = estimate.start - self.prior.mean - self.prior.slope * np.array(rise)[:, None]
        high = log_e(self._log_ratios(off, estimate.start_variance)) > np.log(_CONFLICT)
        return int(high.argmax()) if high.any() else None

    def _log_ratios(self, off: Array, variance: Array) -> Array:
        ratios = log_ratios(off, variance, self.prior.narrow, self.prior.wide)
        return np.where(self.usable, ratios, 0.0)

    def _drop_history(self) -> "Stretch":
        """The stretch without the history on the axes that contradict it.

        A heading that one of them contradicts is no longer trusted.
        """
        estimate = self.estimate
        off = estimate.start - self._prior_mean
        axes = self.usable & (self._log_ratios(off, estimate.start_variance) > 0)
        sigmas = np.abs(off / np.sqrt(self.prior.narrow + estimate.start_variance))
        notes = []
        for axis in np.flatnonzero(axes):
            away, chance = float(off[axis] / MDPS), max(2 * NormalDist().cdf(-sigmas[axis]), 1e-12)
            words = {"away": abs(away), "chance": 1 / chance}
            notes.append(reason("conflict", away, float(sigmas[axis]), axis, **words))
        after = replace(self, dropped=self.dropped | axes, notes=(*self.notes, *notes))
        horizontal = axes if self.up is None else axes & (np.abs(self.up) < VERTICAL)
        return after._with_prior(self.up, self.prior_c, False) if horizontal.any() else after

    @cached_property
    def unscaled(self) -> Estimate:
        """The estimate from the data alone, with the noise of the type."""
        return self.filter.estimate()

    @cached_property
    def noise_scale(self) -> tuple[Array, Array]:
        """N^2 relative to the type, and its degrees of freedom, with the blocks of this log."""
        return self._noise_with(self.unscaled)

    def _noise_with(self, estimate: Estimate) -> tuple[Array, Array]:
        scale, freedom = self.setup.noise_prior
        if np.isinf(freedom).all():
            return scale, freedom
        total = freedom + estimate.freedom
        return (freedom * scale + estimate.squares) / np.maximum(total, 1e-9), total

    @cached_property
    def estimate(self) -> Estimate:
        """The estimate from the data alone; 1.96 sigma are its 95 % limits."""
        return self._scaled(self.unscaled, self.noise_scale)

    def _scaled(self, estimate: Estimate, noise: tuple[Array, Array]) -> Estimate:
        """Scale variances to Student's limits, over all attempts if only this log tells N."""
        factor, freedom = noise
        if not np.isinf(freedom).all():
            attempts = self.setup.now.attempt if not self.setup.noise_prior[1].any() else 1
            z = -NormalDist().inv_cdf(0.025 / attempts)
            student = student_limits(z, np.clip(freedom, 1e-3, 1e9))
            factor = np.where(freedom > 0, factor * (student / _TWO_SIDED) ** 2, np.inf)
        variance, start = estimate.variance * factor, estimate.start_variance * factor
        return estimate._replace(variance=variance, start_variance=start)

    @cached_property
    def result(self) -> tuple[Array, Array]:
        """The bias in the last block and its variance, (3,), deg/s; settled, if warming up."""
        bias, variance = self._posterior(self.estimate)
        return bias + self.prior.slope * self.temperature.rise[0], variance + self._warmth

    @property
    def _warmth(self) -> Array:
        """Variance of the bias in the last block due to its temperature, (3,), (deg/s)^2."""
        _, square, chance = self.temperature.rise
        return self.prior.slope_sigma**2 * square + self.prior.slope**2 * chance

    @property
    def _prior_mean(self) -> Array:
        """Mean of the prior, moved to the mean temperature of the blocks."""
        rise = _temperature_rise(self.prior_c, self.temperature.mean)
        return np.asarray(self.prior.mean + self.prior.slope * rise)

    def _posterior(self, estimate: Estimate) -> tuple[Array, Array]:
        """The current bias and its variance, with the history where it is usable."""
        usable, transfer = self.usable, estimate.transfer
        if not usable.any():
            return estimate.bias, estimate.variance
        start = self._start_posterior(estimate)
        unknown = np.isinf(estimate.variance)
        with np.errstate(invalid="ignore"):
            moved = estimate.bias + transfer * (start.mean - estimate.start)
            added = estimate.variance - transfer**2 * estimate.start_variance
        bias = np.where(usable, np.where(unknown, start.mean, moved), estimate.bias)
        variance = np.where(unknown, 0.0, added) + transfer**2 * start.charged
        return bias, np.where(usable, variance, estimate.variance)

    def _start_posterior(self, estimate: Estimate) -> Posterior:
        """The posterior of the bias at the start, where the history is usable."""
        prior = self._prior_mean, self.prior.narrow, self.prior.wide
        mean, narrow, wide = (np.where(self.usable, x, 1.0) for x in prior)
        data = np.where(self.usable, estimate.start_variance, np.inf)
        return mixture_posterior(estimate.start, data, mean, narrow, wide)

    def log_noise(self) -> tuple[Array | None, float]:
        """N from this stretch alone, (3,), deg/s * sqrt(s), and its degrees of freedom."""
        freedom = float(self.unscaled.freedom[0])
        if freedom < 1:
            return None, 0.0
        return self.setup.noise.white * np.sqrt(self.unscaled.squares / freedom), freedom

    @property
    def floor_dps(self) -> Array:
        """Floor of the standard deviation of any average of the sensor, (3,), deg/s."""
        return np.asarray(self.setup.noise.floor_dps * np.sqrt(self.noise_scale[0]))

    @property
    def below_floor(self) -> Mask:
        """Whether the target is below the floor of an axis without a history, (3,)."""
        return np.asarray((self.floor_dps > self.setup.target_dps) & ~self.usable)

    @property
    def reached(self) -> Mask:
        """Whether an axis is at the target, (3,)."""
        return np.asarray((self.result[1] <= self.setup.target_dps**2) & ~self.below_floor)

    @cached_property
    def seconds_left(self) -> Array:
        """Seconds at rest until the target, (3,); infinite beyond an hour, NaN without a target.

        The variances of future blocks do not depend on the data. The distance from the history does
        and is the expected one. Temperature and unknown noise are assumed to stay as they are now.
        """
        setup, seconds = self.setup, np.where(self.reached, 0.0, np.inf)
        if np.isinf(setup.target_dps):
            return np.full(3, np.nan)
        (scale, freedom), following, count = self.noise_scale, self.filter, 0
        measured = self.temperature.blocks
        open_axes = ~self.below_floor
        while np.any(np.isinf(seconds) & open_axes) and count * setup.block_s < _LONGEST_S:
            following, stack = following.ahead(_LOOKAHEAD_BLOCKS)
            number = count + 1 + np.arange(_LOOKAHEAD_BLOCKS)[:, None]
            later = self._scaled(stack.estimate(), (scale, freedom + number))
            later = later._replace(start=self._expected_start(later.start_variance))
            warmth = self._warmth * (measured / (measured + number)) ** 2
            reached = self._posterior(later)[1] + warmth <= setup.target_dps**2
            first = np.where(reached.any(axis=0), count + 1 + reached.argmax(axis=0), np.inf)
            seconds = np.minimum(seconds, first * setup.block_s)
            count += _LOOKAHEAD_BLOCKS
        seconds = np.maximum(seconds, setup.least_s - self.seconds)
        return np.where(open_axes, seconds, np.inf)

    def _expected_start(self, variance: Array) -> Array:
        """The expected estimate of the bias at the start once it has a variance, (n, 3)."""
        now, expected = self.estimate, self._start_posterior(self.estimate).mean
        away = np.nan_to_num(now.start - expected)  # NaN before the first block
        return expected + variance / now.start_variance * away


def _gravity_sum(before: Array, gravity: Array) -> Array:
    """The sum of gravity over blocks, and their number, after more blocks."""
    measured = gravity[np.isfinite(gravity).all(axis=1)]
    return np.add.accumulate(np.vstack([before, np.c_[measured, np.ones(len(measured))]]))[-1]


def _temperature_rise(start: float, end: float) -> float:
    """Change of temperature; 0 where one of the two is unknown."""
    return 0.0 if np.isnan(end - start) else end - start


def _temperature_moved(now: ArrayLike, before: float) -> Mask:
    """Whether the temperature has moved by a step, or has become known."""
    return np.isfinite(now) & ~(np.abs(np.subtract(now, before)) <= _TEMPERATURE_STEP_C)
