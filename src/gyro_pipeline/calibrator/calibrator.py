"""Samples in, the bias with its standard deviation out, from the first moment on.

Samples are cut into blocks of 0.5 s by their number, and a stretch in one attitude takes the blocks
(:mod:`.stretch`). Nothing here reads a clock, starts a thread or knows of files.
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
from gyro_pipeline.calibrator.reasons import Reason, reason, reasons_of, unit_reason
from gyro_pipeline.calibrator.rest import ATTITUDE, MOTION, NOISE, Alarm, Blocks
from gyro_pipeline.calibrator.stretch import BLOCK_S, Mask, Setup, Stretch
from gyro_pipeline.conventions import AXES, MDPS, InputError

LEAST_S, LEAST_UNKNOWN_S = 1.0, 10.0
"""Seconds at rest before a target counts as reached: where the noise is known, and where not."""

LONGEST_S = 3600.0
"""How far ahead seconds left are looked for."""

_JUMP_S = 3600.0  # a clock that moves by more has jumped
_DEAD_BLOCKS = 4  # in a row in which an axis holds one value
_COLUMNS = 8  # time, rates, accelerations, temperature
_REFERENCE = 6  # blocks at rest that say what rest is like after a motion
_PATIENCE = 20  # blocks of motion after which rest is looked for anew
_TURN_DEG = 1.0  # the attitude is the same after a motion that turned the device by less


@dataclass(frozen=True, eq=False)
class State:
    """The answer so far; NaN and infinity stand where there is no number. Arrays are (3,)."""

    stretch: Stretch  # that the answer is from
    counts: Counter[str]  # of samples, gaps and what else was noticed
    ended: dict[str, Reason]  # why stretches ended, the last of each; dead axes
    rest: str  # STILL, MOVING or UNSURE
    time_s: float  # since the first sample
    least_s: float  # at rest, for a target to count as reached
    target_dps: float | None

    @property
    def bias_dps(self) -> Array:
        """The bias now; what it settles to, where the device warms up."""
        return self.stretch.bias

    @cached_property
    def sigma_dps(self) -> Array:
        """Its standard deviation: the bias is within 1.96 of it in 95 % of cases."""
        return np.sqrt(self.stretch.variance)

    @property
    def seconds_at_rest(self) -> float:
        """Of the stretch that the answer is from."""
        return self.stretch.seconds

    @property
    def history(self) -> tuple[str, str, str]:
        """What became of the history on each axis: USED, DROPPED or NONE."""
        return self.stretch.outcome

    @property
    def reached(self) -> bool:
        """Whether all axes are at the target, where one is given, after the least time."""
        target_dps = np.inf if self.target_dps is None else self.target_dps
        long = self.seconds_at_rest >= self.least_s
        return long and bool(self.stretch.reached(target_dps).all())

    @property
    def done(self) -> bool:
        """Whether the target is reached, at rest."""
        return self.rest == STILL and self.reached

    @cached_property
    def seconds_left(self) -> Array:
        """Seconds at rest until the target; infinite where never, NaN without a target."""
        if self.target_dps is None:
            return np.full(3, np.nan)
        left = self.stretch.seconds_left(self.target_dps, LONGEST_S)
        return np.maximum(left, self.least_s - self.seconds_at_rest)

    @cached_property
    def reasons(self) -> tuple[Reason, ...]:
        """What should be known about the answer, the most important first."""
        return tuple(reasons_of(self.counts, self.ended, self.stretch, self.target_dps))


class Calibrator:
    """Calibrates one gyroscope of three axes; see :meth:`open`.

    Args:
        device_type: Its noise, and how its bias changes.
        rate_hz: Samples per second.
        history: Its calibrations, the oldest first.
        now: What is known of this calibration beforehand.
        target_dps: Standard deviation to reach; None: none.
    """

    def __init__(
        self, device_type: DeviceType, rate_hz: float, history: Sequence[Calibration] = (),
        now: Circumstances | None = None, target_dps: float | None = None,
    ) -> None:  # fmt: skip
        if not (np.isfinite(rate_hz) and rate_hz >= 2):  # noqa: PLR2004
            raise InputError(f"rate_hz: expected at least 2 samples a second, got {rate_hz}")
        now = now or Circumstances()
        self.setup = Setup(device_type, float(rate_hz), tuple(history), now)
        self.target_dps, self.counts = target_dps, Counter[str]()
        self.ended = dict[str, Reason]()
        self._constant = np.zeros(3)  # blocks in a row of one value
        self.least_s = LEAST_S if np.all(self.setup.known[1] > 0) else LEAST_UNKNOWN_S
        self._pending = np.empty((_COLUMNS, 0))  # samples of a block that is not full
        self._last_time: float | None = None
        self._end: float | None = None  # of the last block, on the clock of the samples
        self._proof_s = 0.0  # how long a rest must last, after one that was none
        self._taken, self._skipped_s = 0, 0.0  # blocks, and seconds of gaps
        self._rest_s = 0.0  # at rest in stretches that ended
        self._kept: Stretch | None = None
        self.stretch = Stretch.start(self.setup, 0.0)
        # The stretch before its last blocks, and those.
        self._before: tuple[Stretch, Blocks] | None = None
        self._moving, self._turned = 0, np.zeros(3)  # blocks of motion that just came, degrees

    @classmethod
    def open(  # noqa: PLR0913 - what can be known beforehand
        cls, device: str | None = None, *, rate_hz: float, target_mdps: float | None = None,
        registry: str | Path | None = None, started_at: float | None = None,
        since_power_on_s: float | None = None, device_type: str | None = None,
        same_heading: bool | None = None, latitude_deg: float | None = None,
        known_still: bool = False, without: str | None = None,
    ) -> "Calibrator":  # fmt: skip
        """A calibrator of a device of the registry, or of an unknown one.

        Args:
            device: Its name in the registry; None: no history.
            rate_hz: Samples per second.
            target_mdps: Standard deviation to reach.
            registry: Folder; None: the environment's, or the user's own.
            started_at: Of the first sample, POSIX seconds; None: one day after the last one.
            since_power_on_s: Of the first sample; None: a warm-up's amplitude is left free.
            device_type: Its type; None, here and below: what ``device.toml`` says.
            same_heading: Whether the heading repeats.
            latitude_deg: Of the place.
            known_still: The device is declared to be at rest: nothing is cut.
            without: Hash of a log whose own stored calibration is not to count.

        Raises:
            InputError: The registry holds something that is not as it should be.
        """
        from gyro_pipeline.calibrator.registry import Device, registry_folder  # noqa: PLC0415

        folder = registry_folder(registry)
        stored = None if device is None else Device(folder, device)
        settings = stored.settings() if stored else {}
        now = Circumstances(
            started_at,
            since_power_on_s,
            bool(settings.get("mounted") if same_heading is None else same_heading),
            settings.get("latitude") if latitude_deg is None else latitude_deg,
            known_still,
            stored.attempt(without) if stored else 1,
        )
        kind = read_type(device_type or settings.get("type"), folder)
        history = stored.history(without) if stored else ()
        return cls(kind, rate_hz, history, now, target_mdps and target_mdps * MDPS)

    def update(
        self, time_s: ArrayLike | None, gyro_dps: ArrayLike, accel_g: ArrayLike | None = None,
        temperature_c: ArrayLike | None = None,
    ) -> State:  # fmt: skip
        """Take one sample or a chunk; how a recording is cut into chunks changes no bit.

        Args:
            time_s: (n,) or one, of the samples, on any clock; None: one period after another.
            gyro_dps: (n, 3) or (3,), deg/s.
            accel_g: (n, 3) or (3,), g.
            temperature_c: (n,) or one, degrees Celsius.

        Raises:
            InputError: The samples are not of three axes.
        """
        rows = self._rows(time_s, gyro_dps, accel_g, temperature_c)
        if rows.size:
            rows = np.concatenate([self._pending, rows], axis=1)
            gaps = np.diff(rows[0])
            edges = np.flatnonzero((gaps > BLOCK_S / 2) | (gaps < -1 / self.setup.rate_hz)) + 1
            for first, last in pairwise([0, *edges, rows.shape[1]]):
                self._pending = self._take_whole_blocks(rows[:, first:last])
        return self.state()

    @property
    def time_s(self) -> float:
        """Since the first sample, up to the last block."""
        return self._taken * self.setup.block_s + self._skipped_s

    def finish(self) -> State:
        """The answer from the stretch that knows most; the history's if none was at rest."""
        return self.state(finished=True)

    def state(self, finished: bool = False) -> State:
        """The answer so far."""
        stretch = self.best if finished else self.stretch
        rest = self._rest(stretch, finished)
        if finished and rest == MOVING:
            stretch = Stretch.start(self.setup, self.time_s)
        noticed = self.counts.copy(), self.ended
        return State(stretch, *noticed, rest, self.time_s, self.least_s, self.target_dps)

    @property
    def best(self) -> Stretch:
        """Of the stretches that were at rest, the one that knows most."""
        kept, last = self._kept, self.stretch
        if kept and not np.sum(last.estimate.variance - kept.estimate.variance) < 0:
            return kept
        return last

    def calibration(self) -> Calibration:
        """What is stored: evidence from its own data, never from the history."""
        state, stretch, now = self.finish(), self.best, self.setup.now
        own, (noise, freedom), seen = stretch.estimate, stretch.log_noise(), stretch.temperature
        usable = state.rest == STILL and bool(np.isfinite(own.variance).all())
        gravity = stretch.gravity[:3] / max(stretch.gravity[3], 1)
        return Calibration(
            mean_dps=tuple(own.bias.tolist()) if usable else None,
            variance_dps2=tuple(own.variance.tolist()) if usable else None,
            time=now.time,
            since_power_on_s=now.since_power_on_s,
            temperature_c=(seen.mean, seen.least, seen.most) if seen.blocks else None,
            gravity=tuple(gravity.tolist()) if gravity.any() else None,
            seconds=stretch.seconds,
            rest=state.rest,  # type: ignore[arg-type]
            outcome=stretch.outcome,
            noise_mdps_rts=None if noise is None else tuple((noise / MDPS).tolist()),
            noise_freedom=freedom,
            same_heading=now.same_heading,
            known_still=now.known_still,
            reached=state.done,
            attempt=now.attempt,
            reasons=tuple(reason.sentence for reason in state.reasons),
        )

    def _rows(
        self, time_s: ArrayLike | None, gyro_dps: ArrayLike, accel_g: ArrayLike | None,
        temperature_c: ArrayLike | None,
    ) -> Array:  # fmt: skip
        """Samples that hold a measurement, (8, n)."""
        rates = np.atleast_2d(np.asarray(gyro_dps, np.float64))
        if rates.ndim != 2 or rates.shape[1] != 3:  # noqa: PLR2004
            raise InputError(f"gyro_dps: expected (n, 3) or (3,) deg/s, got {np.shape(gyro_dps)}")
        rows, rate_hz = np.full((_COLUMNS, len(rates)), np.nan), self.setup.rate_hz
        if time_s is None:
            first = -1 if self._last_time is None else round(self._last_time * rate_hz)
            time_s = (first + 1 + np.arange(len(rates))) / rate_hz
        rows[0], rows[1:4] = time_s, rates.T
        if accel_g is not None:
            rows[4:7] = np.atleast_2d(accel_g).T
        if temperature_c is not None:
            rows[7] = temperature_c
        finite, zero = np.isfinite(rows[:4].sum(axis=0)), ~rows[1:4].any(axis=0)
        bad = {"not_finite": int(np.sum(~finite)), "zero": int(np.sum(zero))}
        self.counts.update(samples=len(rates), **bad)
        if len(rates) and np.isfinite(rows[0, -1]):
            self._last_time = float(rows[0, -1])
        good = finite & ~zero
        return rows if good.all() else rows[:, good]

    def _take_whole_blocks(self, rows: Array) -> Array:
        """Take the blocks of rows without a gap; returns the rows that are left."""
        size = self.setup.size
        used = rows.shape[1] // size * size
        self._cross_gap(rows[0, 0])
        if used:
            blocks = _blocks(rows[:, :used].reshape(_COLUMNS, -1, size))
            self._look_for_dead_axes(blocks.variance == 0)
            while len(blocks.mean):
                blocks = blocks.part(self._take(blocks))
            self._end = rows[0, used - 1] + 1 / self.setup.rate_hz
        return rows[:, used:]

    def _look_for_dead_axes(self, constant: Mask) -> None:
        for axes in constant if constant.any() or self._constant.any() else ():
            self._constant = np.where(axes, self._constant + 1, 0)
            for axis in np.flatnonzero(self._constant >= _DEAD_BLOCKS):
                self.ended = {**self.ended, AXES[axis]: reason("dead", axis=axis)}

    def _cross_gap(self, start: float) -> None:
        """Move on to where rows start, if that is not where the last block ended."""
        gap = 0.0 if self._end is None else start - self._end
        if gap < -1 / self.setup.rate_hz or gap > _JUMP_S:
            self.counts["jumps"] += 1
            gap = self.setup.block_s
        elif gap > BLOCK_S / 2:
            self.counts["gaps"] += 1
            self.counts["gap_ms"] += round(gap * 1e3)
        else:
            return
        self._skipped_s += gap
        self.stretch, self._before = self.stretch.cut(gap, None), None
        self._end = start

    def _take(self, blocks: Blocks) -> int:
        """Take some blocks; a motion is cut, another alarm begins a new stretch. Returns how many.

        After a motion the attitude must be the same.
        """
        if self._moving:
            blocks = blocks.part(0, 1)
        after, count, alarm = self.stretch.take(blocks)
        if alarm is None and self._moving and self.stretch.blocks:
            if self.stretch.turned_deg(self._turned, blocks.gravity[0]) > _TURN_DEG:
                self._end_stretch(Alarm(ATTITUDE))
                return 0
        self._taken += max(count, 1)
        if alarm is None:
            self._before, self.stretch = (self.stretch, blocks.part(0, count)), after
            self._moving, self._turned = 0, np.zeros(3)
        elif (
            alarm.code == MOTION and self.stretch.blocks >= _REFERENCE and self._moving < _PATIENCE
        ):
            self._cut(blocks.mean[0])
        else:
            self._end_stretch(alarm)
        return max(count, 1)

    def _cut(self, mean: Array) -> None:
        """Leave out a block of motion and the one before it."""
        motion, told = [mean], None
        if not self._moving:
            if self._before is not None:
                motion.append(self.stretch.last_mean)
                self.stretch, blocks = self._before
                while len(blocks.mean) > 1:
                    self.stretch, count, _ = self.stretch.take(blocks.part(0, -1))
                    blocks = blocks.part(count)
            told = reason("cut", self.stretch.start_s + self.stretch.filter.time_s)
        turned = np.sum(np.array(motion) - self.stretch.unscaled.bias, axis=0)
        self._turned = self._turned + turned * self.setup.block_s
        self._moving, self._before = self._moving + len(motion), None
        self.stretch = self.stretch.cut(len(motion) * self.setup.block_s, told)

    def _end_stretch(self, alarm: Alarm) -> None:
        """Keep why a stretch ended, for people, and begin the next."""
        told, name = None, self.setup.device_type.type
        if alarm.code == NOISE:
            told = unit_reason(alarm.value, name)
        words: dict[str, Any] = {"name": name, "factor": alarm.value, "rate": alarm.value / MDPS}
        told = told or reason(alarm.code, self.time_s, sigma=alarm.sigma / MDPS, **words)
        self.ended = {**self.ended, alarm.code: told}
        shown = alarm.code == MOTION and self.stretch.blocks >= _REFERENCE
        if shown or alarm.code == ATTITUDE:  # what came before it was at rest
            self._rest_s += self.stretch.seconds
            self._kept = self.best
        else:
            self._proof_s = max(self._proof_s, self.time_s - self.stretch.start_s)
        self.stretch, self._before = Stretch.start(self.setup, self.time_s), None
        self._moving, self._turned = 0, np.zeros(3)

    def _rest(self, stretch: Stretch, finished: bool) -> str:
        """Whether it is at rest now; or, once finished, whether half of it, and enough, was."""
        if self.setup.now.known_still:
            return STILL if stretch.blocks else UNSURE
        enough = stretch.seconds >= max(min(self.least_s, 2 * LEAST_S), self._proof_s)
        ended = bool(self.ended.keys() - {ATTITUDE, *AXES})
        if finished:
            half = self._rest_s + self.stretch.seconds >= self.time_s / 2
            cut = any(note.code == "cut" for note in stretch.notes)
            return STILL if enough and half else MOVING if ended or cut else UNSURE
        if self._moving or (ended and not enough):
            return MOVING
        return STILL if enough else UNSURE


def _blocks(samples: Array) -> Blocks:
    """Means and variances of whole blocks, (8, block, sample)."""
    means, variances = samples.mean(axis=2), samples[1:4].var(axis=2, ddof=1)
    gravity_variances = np.full(samples.shape[1], np.nan)
    if np.isfinite(means[4:7]).any():
        gravity_variances = samples[4:7].var(axis=2, ddof=1).mean(axis=0)
    return Blocks(means[1:4].T, variances.T, means[4:7].T, gravity_variances, means[7])
