"""The calibrator: it takes samples and returns the bias with its standard deviation at any time.

Samples are cut into blocks of 0.5 s by their number, and blocks are processed by a stretch of rest
in one attitude (:mod:`.stretch`). No clock is read, no thread started, no file opened.
"""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from gyro_pipeline.calibrator.device_types import DeviceType, read_type
from gyro_pipeline.calibrator.filter import Array
from gyro_pipeline.calibrator.history import MOVING, STILL, UNSURE, Calibration, Circumstances
from gyro_pipeline.calibrator.reasons import (
    MIN_FREEDOM,
    UNIT_FACTOR,
    UNUSABLE_CODES,
    Reason,
    reason,
    reasons_of,
    unit_reason,
)
from gyro_pipeline.calibrator.rest import ATTITUDE, MOTION, NOISE, Alarm, Blocks
from gyro_pipeline.calibrator.stretch import BLOCK_S, LEAST_S, Setup, Stretch
from gyro_pipeline.conventions import MDPS, InputError
from gyro_pipeline.quality.rest import Mask

_JUMP_S = 3600.0  # a clock that moves by more has jumped
_DEAD_BLOCKS = 4  # in a row without any change on an axis
_COLUMNS = 8  # time, rates, accelerations, temperature
_MIN_REFERENCE = 6  # blocks at rest, to recognise rest after a motion
_MAX_MOTION = 20  # blocks of motion, after which a new stretch starts
_MAX_TURN_DEG = 1.0  # the attitude counts as the same after a smaller turn


@dataclass(frozen=True, eq=False)
class State:
    """The result so far; NaN and infinity stand where there is no number. Arrays are (3,)."""

    stretch: Stretch  # that the result is from
    counts: Counter[str]  # samples, gaps, jumps of the clock, samples left out
    ended: dict[str, Reason]  # why stretches ended, the last reason of each code
    constant: Mask  # whether an axis did not change in the last block, (3,)
    scatter: Array  # N by the samples of the last block, deg/s * sqrt(s); NaN before
    dead: Mask  # whether an axis did not change for a while, (3,)
    rest: str  # STILL, MOVING or UNSURE
    time_s: float  # since the first sample

    @property
    def bias_dps(self) -> Array:
        """The current bias, deg/s; the settled one where the device warms up."""
        return self.stretch.result[0]

    @cached_property
    def sigma_dps(self) -> Array:
        """Standard deviation of the bias: 1.96 of it are the 95 % limits."""
        return np.sqrt(self.stretch.result[1])

    @property
    def seconds_at_rest(self) -> float:
        """Seconds at rest that the result is from."""
        return self.stretch.seconds

    @property
    def history(self) -> tuple[str, str, str]:
        """How the history was treated on each axis: USED, DROPPED or NONE."""
        return self.stretch.outcome

    @property
    def reached(self) -> bool:
        """Whether all axes are at the target, if there is one, after the least time."""
        long_enough = self.seconds_at_rest >= self.stretch.setup.least_s
        return long_enough and bool(self.stretch.reached.all())

    @property
    def done(self) -> bool:
        """Whether the device is at rest, the target is reached, and the data can be used."""
        at_target = self.rest == STILL and self.reached and not self.constant.any()
        return at_target and not self.unusable and self._unit_is_plausible

    @property
    def unusable(self) -> bool:
        """Whether the data cannot be used: a dead sensor, or a wrong unit."""
        return any(reason.code in UNUSABLE_CODES for reason in self.reasons)

    @property
    def _unit_is_plausible(self) -> bool:
        """Whether the last samples scatter as in the right unit, until block means can tell."""
        setup, (_, freedom) = self.stretch.setup, self.stretch.log_noise()
        if freedom >= MIN_FREEDOM or not setup.noise_known:
            return True
        factor = np.median(self.scatter / (setup.noise_factor * setup.noise.white))
        return bool(1 / UNIT_FACTOR < factor < UNIT_FACTOR)

    @property
    def seconds_left(self) -> Array:
        """Seconds at rest until the target; infinite where never, NaN without a target."""
        return self.stretch.seconds_left

    @cached_property
    def reasons(self) -> tuple[Reason, ...]:
        """Remarks on the result, the most important first."""
        return tuple(reasons_of(self))


class Calibrator:
    """Calibrates one gyroscope of three axes; see :meth:`open`.

    Args:
        device_type: The noise of the device, and how its bias changes.
        rate_hz: Samples per second.
        history: Past calibrations of the device, the oldest first.
        now: The conditions of this calibration.
        target_dps: Standard deviation to reach; None without a target.
    """

    def __init__(
        self, device_type: DeviceType, rate_hz: float, history: Sequence[Calibration] = (),
        now: Circumstances | None = None, target_dps: float | None = None,
    ) -> None:  # fmt: skip
        if not (np.isfinite(rate_hz) and rate_hz >= 2):  # noqa: PLR2004
            raise InputError(f"rate_hz: expected at least 2 samples a second, got {rate_hz}")
        if target_dps is not None and not 0 < target_dps < np.inf:
            got = f"{target_dps / MDPS:g}"
            raise InputError(f"target: expected more than 0 mdps, such as 0.5, got {got}")
        target_dps, now = np.inf if target_dps is None else target_dps, now or Circumstances()
        if now.latitude_deg is not None and not abs(now.latitude_deg) <= 90:  # noqa: PLR2004
            raise InputError(f"latitude: expected -90 to 90 degrees, got {now.latitude_deg:g}")
        if now.since_power_on_s is not None and not 0 <= now.since_power_on_s < np.inf:
            got = f"{now.since_power_on_s:g}"
            raise InputError(f"since_power_on: expected 0 s or more, got {got}")
        self.setup = Setup(device_type, float(rate_hz), tuple(history), now, target_dps)
        self.counts, self.ended = Counter[str](), dict[str, Reason]()
        self._constant, self._dead = np.zeros(3), np.zeros(3, bool)  # blocks without any change
        self._scatter = np.full(3, np.nan)  # of the last block
        self._pending = np.empty((_COLUMNS, 0))  # samples of an incomplete block
        self._last_time = -1 / rate_hz
        self._end: float | None = None  # end of the last block, on the clock of the samples
        self._min_rest_s = 0.0  # longer than any stretch that turned out not to be at rest
        self._block_count, self._gaps_s = 0, 0.0
        self._ended_rest_s = 0.0  # at rest in stretches that ended
        self._ended_best: Stretch | None = None
        self._start_stretch()

    def _start_stretch(self) -> None:
        self.stretch, self._first_block = Stretch.start(self.setup, self.time_s), self._block_count
        # the stretch before its last update, and the blocks of this update
        self._previous: tuple[Stretch, Blocks] | None = None
        self._motion_blocks = 0  # of the motion that is going on
        self._rotation = np.zeros(3)  # during this motion, degrees

    @classmethod
    def open(  # noqa: PLR0913 - the conditions of a calibration
        cls, device: str | None = None, *, rate_hz: float, target_mdps: float | None = None,
        registry: str | Path | None = None, started_at: float | None = None,
        since_power_on_s: float | None = None, device_type: str | None = None,
        same_heading: bool | None = None, latitude_deg: float | None = None,
        known_still: bool = False, without: str | None = None,
    ) -> "Calibrator":  # fmt: skip
        """Open a calibrator for a device in the registry, or for an unknown device.

        Args:
            device: Name in the registry; None: no history.
            rate_hz: Samples per second.
            target_mdps: Standard deviation to reach.
            registry: Folder of the registry; None: that of the environment or of the user.
            started_at: POSIX time of the first sample; None: a day after the last calibration.
            since_power_on_s: Age of the first sample; None: the warm-up amplitude is free.
            device_type: Name of the type; None, here and below: the value in ``device.toml``.
            same_heading: Whether the heading repeats.
            latitude_deg: Latitude.
            known_still: The device is declared to be at rest: nothing is cut.
            without: Hash of a log whose stored calibration is left out of the history.

        Raises:
            InputError: A file in the registry is invalid.
        """
        from gyro_pipeline.calibrator.registry import Device, Settings, registry_folder  # noqa: PLC0415

        folder = registry_folder(registry)
        stored = None if device is None else Device(folder, device)
        settings = stored.settings() if stored else Settings()
        now = Circumstances(
            started_at,
            since_power_on_s,
            settings.mounted if same_heading is None else same_heading,
            settings.latitude if latitude_deg is None else latitude_deg,
            known_still,
            stored.attempt(without) if stored else 1,
            stored.knocks() if stored else 0,
        )
        resolved = read_type(device_type or settings.type, folder)
        history = stored.history(without) if stored else ()
        return cls(resolved, rate_hz, history, now, target_mdps and target_mdps * MDPS)

    def update(
        self, time_s: ArrayLike | None, gyro_dps: ArrayLike, accel_g: ArrayLike | None = None,
        temperature_c: ArrayLike | None = None,
    ) -> State:  # fmt: skip
        """Process a sample or a chunk; how a recording is cut into chunks changes no bit.

        Args:
            time_s: Times of the samples on any clock, (n,) or a number; None: at the sample rate.
            gyro_dps: Rates, (n, 3) or (3,), deg/s.
            accel_g: Accelerations, (n, 3) or (3,), g.
            temperature_c: Temperatures, (n,) or a number, degrees Celsius.

        Raises:
            InputError: The samples do not have three axes, or there is not one time for each.
        """
        rows = self._rows(time_s, gyro_dps, accel_g, temperature_c)
        if rows.size:
            rows = np.concatenate([self._pending, rows], axis=1)
            gaps = np.diff(rows[0])
            edges = np.flatnonzero((gaps > BLOCK_S / 2) | (gaps < -1 / self.setup.rate_hz)) + 1
            for first, last in pairwise([0, *edges, rows.shape[1]]):
                self._pending = self._process_blocks(rows[:, first:last])
        return self.state()

    @property
    def time_s(self) -> float:
        """Seconds from the first sample to the end of the last block."""
        return self._block_count * self.setup.block_s + self._gaps_s

    def finish(self) -> State:
        """The result of the most accurate stretch; the prior if the device was never at rest."""
        return self.state(finished=True)

    def state(self, finished: bool = False) -> State:
        """The result so far."""
        stretch = self.best if finished else self.stretch
        rest = self._rest(stretch, finished)
        if finished and rest == MOVING:
            stretch = Stretch.start(self.setup, self.time_s)
        last = self._constant > 0, self._scatter
        return State(stretch, self.counts.copy(), self.ended, *last, self._dead, rest, self.time_s)

    @property
    def best(self) -> Stretch:
        """The most accurate stretch of those at rest."""
        ended, last = self._ended_best, self.stretch
        if ended and not np.sum(last.estimate.variance - ended.estimate.variance) < 0:
            return ended
        return last

    def calibration(self) -> Calibration:
        """The calibration to store: evidence from its own data alone, without the history."""
        state, now = self.finish(), self.setup.now
        stretch, temperature = state.stretch, state.stretch.temperature
        estimate = stretch.estimate
        temperature_c = temperature.mean, temperature.least, temperature.most
        noise, freedom = stretch.log_noise()
        usable = state.rest == STILL and bool(np.isfinite(estimate.variance).all())
        usable = usable and not state.unusable
        gravity = stretch.gravity[:3] / max(stretch.gravity[3], 1)
        return Calibration(
            mean_dps=tuple(estimate.bias.tolist()) if usable else None,
            variance_dps2=tuple(estimate.variance.tolist()) if usable else None,
            time=now.time,
            since_power_on_s=now.since_power_on_s,
            temperature_c=temperature_c if temperature.blocks else None,
            gravity=tuple(gravity.tolist()) if gravity.any() else None,
            seconds=stretch.seconds,
            rest=state.rest,  # type: ignore[arg-type]
            outcome=stretch.outcome,
            noise_mdps_rts=None if noise is None else tuple((noise / MDPS).tolist()),
            noise_freedom=freedom,
            same_heading=now.same_heading,
            known_still=now.known_still,
            knocks=now.knocks,
            reached=usable and state.reached,
            attempt=now.attempt,
            reasons=tuple(reason.sentence for reason in state.reasons),
        )

    def _rows(
        self, time_s: ArrayLike | None, gyro_dps: ArrayLike, accel_g: ArrayLike | None,
        temperature_c: ArrayLike | None,
    ) -> Array:  # fmt: skip
        """Times, rates, accelerations and temperatures of valid samples, (8, n)."""
        rates = np.atleast_2d(np.asarray(gyro_dps, np.float64))
        if rates.ndim != 2 or rates.shape[1] != 3:  # noqa: PLR2004
            raise InputError(f"gyro_dps: expected (n, 3) or (3,) deg/s, got {np.shape(gyro_dps)}")
        count, rate_hz = len(rates), self.setup.rate_hz
        if time_s is None:
            time_s = (round(self._last_time * rate_hz) + 1 + np.arange(count)) / rate_hz
        accel = np.full((1, 3), np.nan) if accel_g is None else np.atleast_2d(accel_g)
        if np.size(time_s) != count or accel.shape not in (rates.shape, (1, 3)):
            text = "gyro_dps, time_s and accel_g: expected as many samples of each"
            raise InputError(f"{text}, got {count}, {np.size(time_s)} and the shape {accel.shape}")
        rows = np.empty((_COLUMNS, count))
        rows[0], rows[1:4], rows[4:7] = np.ravel(time_s), rates.T, accel.T
        rows[7] = np.nan if temperature_c is None else temperature_c
        finite, zero = np.isfinite(rows[:4]).all(axis=0), ~rows[1:4].any(axis=0)
        self.counts.update(samples=count, not_finite=int(np.sum(~finite)), zero=int(np.sum(zero)))
        if count and np.isfinite(rows[0, -1]):
            self._last_time = float(rows[0, -1])
        good = finite & ~zero
        # an index would return another memory layout, and sums would then differ in the last bit
        return rows if good.all() else np.compress(good, rows, axis=1)

    def _process_blocks(self, rows: Array) -> Array:
        """Process whole blocks of rows without a gap; returns the remaining rows."""
        size = self.setup.size
        used = rows.shape[1] // size * size
        self._cross_gap(rows[0, 0])
        if used:
            blocks = _blocks(rows[:, :used].reshape(_COLUMNS, -1, size))
            self._scatter = np.sqrt(blocks.variance[-1] / self.setup.rate_hz)
            self._find_dead_axes(np.ptp(rows[1:4, :used].reshape(3, -1, size), axis=2).T == 0)
            while len(blocks.mean):
                blocks = blocks.part(self._process(blocks))
            self._end = rows[0, used - 1] + 1 / self.setup.rate_hz
        return rows[:, used:]

    def _find_dead_axes(self, constant: Mask) -> None:
        for axes in constant if constant.any() or self._constant.any() else ():
            self._constant = np.where(axes, self._constant + 1, 0)
            self._dead = self._dead | (self._constant >= _DEAD_BLOCKS)

    def _cross_gap(self, start: float) -> None:
        """Move on to the time at which rows start, if the last block ended at another one."""
        gap = 0.0 if self._end is None else start - self._end
        if gap < -1 / self.setup.rate_hz or gap > _JUMP_S:
            self.counts["jumps"] += 1
            gap = self.setup.block_s
        elif gap > BLOCK_S / 2:
            self.counts["gaps"] += 1
            self.counts["gap_ms"] += round(gap * 1e3)
        else:
            return
        self._gaps_s += gap
        self.stretch, self._previous = self.stretch.cut(gap, None), None
        self._end = start

    def _process(self, blocks: Blocks) -> int:
        """Process the first blocks and return their number.

        A motion is cut, unless the attitude differs after it; any other alarm starts a new stretch.
        """
        if self._motion_blocks:
            blocks = blocks.part(0, 1)
        after, count, alarm = self.stretch.update(blocks)
        if alarm is None and self._motion_blocks and self.stretch.blocks:
            if self.stretch.turned_deg(self._rotation, blocks.gravity[0]) > _MAX_TURN_DEG:
                self._end_stretch(Alarm(ATTITUDE))
                return 0
        self._block_count += max(count, 1)
        if alarm is None:
            self._previous, self.stretch = (self.stretch, blocks.part(0, count)), after
            self._motion_blocks, self._rotation = 0, np.zeros(3)
        elif self._rest_known(alarm) and self._motion_blocks < _MAX_MOTION:
            self._cut(blocks.mean[0])
        else:
            self._end_stretch(alarm)
        return max(count, 1)

    def _rest_known(self, alarm: Alarm) -> bool:
        """Whether an alarm is a motion after enough rest, so that the rest before it counts."""
        return alarm.code == MOTION and self.stretch.blocks >= _MIN_REFERENCE

    def _cut(self, mean: Array) -> None:
        """Leave out a block of motion and the one before it."""
        motion, note = [mean], None
        if not self._motion_blocks:
            if self._previous is not None:
                self.stretch, blocks = self._previous
                motion.append(blocks.mean[-1])
                while len(blocks.mean) > 1:
                    self.stretch, count, _ = self.stretch.update(blocks.part(0, -1))
                    blocks = blocks.part(count)
            note = reason("cut", self.stretch.start_s + self.stretch.filter.time_s)
        rates = np.sum(np.array(motion) - self.stretch.unscaled.bias, axis=0)
        self._rotation = self._rotation + rates * self.setup.block_s
        self._motion_blocks, self._previous = self._motion_blocks + len(motion), None
        self.stretch = self.stretch.cut(len(motion) * self.setup.block_s, note)

    def _end_stretch(self, alarm: Alarm) -> None:
        """Note why a stretch ended, and start the next one."""
        name = self.setup.device_type.type
        cause = unit_reason(alarm.value, name, alarm.sigma) if alarm.code == NOISE else None
        words: dict[str, Any] = {"name": name, "factor": alarm.value, "rate": alarm.value / MDPS}
        cause = cause or reason(alarm.code, self.time_s, sigma=alarm.sigma / MDPS, **words)
        self.ended = {**self.ended, alarm.code: cause}
        if self._rest_known(alarm) or alarm.code == ATTITUDE:  # the device was at rest before
            self._ended_rest_s += self.stretch.seconds
            self._ended_best = self.best
        else:
            blocks = self._block_count - self._first_block
            self._min_rest_s = max(self._min_rest_s, blocks * self.setup.block_s)
        self._start_stretch()

    def _rest(self, stretch: Stretch, finished: bool) -> str:
        """Whether the device is at rest; when finished, whether it was for half of the time."""
        if self.setup.now.known_still:
            return STILL if stretch.blocks else UNSURE
        enough = stretch.seconds >= max(min(self.setup.least_s, 2 * LEAST_S), self._min_rest_s)
        ended = bool(self.ended.keys() - {ATTITUDE})
        if finished:
            half = self._ended_rest_s + self.stretch.seconds >= (self.time_s - self._gaps_s) / 2
            cut = any(note.code == "cut" for note in stretch.notes)
            return STILL if enough and half else MOVING if ended or cut else UNSURE
        if self._motion_blocks or (ended and not enough):
            return MOVING
        return STILL if enough else UNSURE


def _blocks(samples: Array) -> Blocks:
    """Means and variances of whole blocks, (8, block, sample)."""
    means, variances = samples.mean(axis=2), samples[1:4].var(axis=2, ddof=1)
    gravity_variances = np.full(samples.shape[1], np.nan)
    if np.isfinite(means[4:7]).any():
        gravity_variances = samples[4:7].var(axis=2, ddof=1).mean(axis=0)
    celsius = np.where(np.isfinite(means[7]), means[7], np.nan)
    return Blocks(means[1:4].T, variances.T, means[4:7].T, gravity_variances, celsius)
