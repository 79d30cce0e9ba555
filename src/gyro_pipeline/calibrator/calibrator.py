"""Samples in, the bias with its standard deviation out, from the first moment on.

Samples are cut into blocks of 0.5 s by their number, and a stretch in one attitude takes the blocks
(:mod:`.stretch`). Nothing here reads a clock, starts a thread or knows of files.
"""

from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from gyro_pipeline.calibrator.device_types import DeviceType, read_type
from gyro_pipeline.calibrator.history import (
    DAY_S,
    Calibration,
    Circumstances,
    Prior,
    noise_of,
    prior_of,
)
from gyro_pipeline.calibrator.reasons import Reason, reason, reasons_of, unit_reason
from gyro_pipeline.calibrator.rest import ATTITUDE, MOTION, NOISE, Alarm, Block
from gyro_pipeline.calibrator.state import MOVING, STILL, UNSURE, Array, Mask, State
from gyro_pipeline.calibrator.stretch import Stretch
from gyro_pipeline.conventions import MDPS, InputError

BLOCK_S = 0.5
LEAST_S, LEAST_UNKNOWN_S = 1.0, 10.0
"""Seconds at rest before a target counts as reached: where the noise is known, and where not."""

LONGEST_S = 3600.0
"""How far ahead seconds left are looked for."""

_LEAST_SAMPLES = 5  # in a block: fewer do not tell the noise
_JUMP_S = 3600.0  # a clock that moves by more has jumped
_DEAD_BLOCKS = 4  # in a row in which an axis holds one value
_COLUMNS = 8  # time, rates, accelerations, temperature


@dataclass
class Counts:
    """What was noticed of the samples, counted while they come in."""

    samples: int = 0
    not_finite: int = 0
    zero: int = 0
    gaps: int = 0
    gap_s: float = 0.0
    jumps: int = 0
    constant: Array = field(default_factory=lambda: np.zeros(3))  # blocks in a row of one value
    dead: Mask = field(default_factory=lambda: np.zeros(3, bool))
    ended: dict[str, Reason] = field(default_factory=dict)  # why stretches ended, the last of each


class Calibrator:
    """Calibrates one gyroscope of three axes; see :meth:`open`.

    Args:
        device_type: Its noise, and how its bias changes.
        rate_hz: Samples per second.
        history: Its calibrations, the oldest first.
        now: What is known of this calibration beforehand.
        target_dps: Standard deviation to reach; None: none.
        since_power_on_s: Of the first sample; None: a warm-up's amplitude is left free.
        known_still: The device is declared to be at rest: nothing is cut.
    """

    def __init__(
        self, device_type: DeviceType, rate_hz: float, history: Sequence[Calibration] = (),
        now: Circumstances | None = None, target_dps: float | None = None,
        since_power_on_s: float | None = None, known_still: bool = False,
    ) -> None:  # fmt: skip
        if not (np.isfinite(rate_hz) and rate_hz >= 2):  # noqa: PLR2004
            raise InputError(f"rate_hz: expected at least 2 samples a second, got {rate_hz}")
        self.device_type, self.rate_hz, self.history = device_type, float(rate_hz), tuple(history)
        self.now, self.target_dps = now or Circumstances(), target_dps
        self.since_power_on_s, self.known_still = since_power_on_s, known_still
        self.size = max(round(BLOCK_S * self.rate_hz), _LEAST_SAMPLES)
        self.block_s = self.size / self.rate_hz
        self.scale, self.freedom = noise_of(self.history, device_type)
        self.least_s = LEAST_S if np.all(self.freedom > 0) else LEAST_UNKNOWN_S
        self.time_s, self.counts = 0.0, Counts()
        self._pending = np.empty((0, _COLUMNS))  # samples of a block that is not full
        self._last_time: float | None = None
        self._end: float | None = None  # of the last block, on the clock of the samples
        self._proof_s = 0.0  # how long a rest must last, after one that was none
        self._rest_s = 0.0  # at rest in stretches that ended
        self._stretch_at = partial(
            Stretch, device_type, self._prior_of, self.scale, self.freedom, self.size,
            self.block_s, known_still,
        )  # fmt: skip
        self.stretch = self._new_stretch()
        self._kept: Stretch | None = None

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
            since_power_on_s: Of the first sample.
            device_type: Its type; None, here and below: what ``device.toml`` says.
            same_heading: Whether the heading repeats.
            latitude_deg: Of the place.
            known_still: The device is declared to be at rest.
            without: Hash of a log whose own stored calibration is not to count.

        Raises:
            InputError: The registry holds something that is not as it should be.
        """
        from gyro_pipeline.calibrator.registry import Device, registry_folder  # noqa: PLC0415

        folder = registry_folder(registry)
        stored = None if device is None else Device(folder, device)
        settings = stored.settings() if stored else {}
        heading = settings.get("mounted", False) if same_heading is None else same_heading
        latitude = settings.get("latitude") if latitude_deg is None else latitude_deg
        day = None if started_at is None else started_at / DAY_S
        return cls(
            read_type(device_type or settings.get("type"), folder),
            rate_hz,
            stored.history(without) if stored else (),
            Circumstances(day, same_heading=bool(heading), latitude_deg=latitude),
            None if target_mdps is None else target_mdps * MDPS,
            since_power_on_s,
            known_still,
        )

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
        if len(rows):
            rows = np.vstack([self._pending, rows])
            gaps = np.diff(rows[:, 0])
            edges = np.flatnonzero((gaps > BLOCK_S / 2) | (gaps < -1 / self.rate_hz)) + 1
            for first, last in pairwise([0, *edges, len(rows)]):
                self._pending = self._take_whole_blocks(rows[first:last])
        return self.state()

    def finish(self) -> State:
        """The answer, from the stretch that knows most."""
        return self.state(finished=True)

    def state(self, finished: bool = False) -> State:
        """The answer so far."""
        stretch = copy(self.best if finished else self.stretch)
        own, prior, target = stretch.estimate, stretch.prior, self.target_dps
        left_s = max(self.least_s - stretch.seconds, 0.0)

        def look_ahead() -> Array:
            if target is None:
                return np.full(3, np.nan)
            return np.maximum(stretch.seconds_left(target, LONGEST_S), left_s)

        reached = target is None or bool(stretch.reached(target).all())
        return State(
            stretch.bias, np.sqrt(stretch.variance), own.bias, np.sqrt(own.variance), prior.mean,
            np.sqrt(prior.narrow), self._rest(stretch, finished), self.time_s, stretch.seconds,
            stretch.outcome, reached and left_s == 0, look_ahead,
            partial(reasons_of, copy(self.counts), stretch, target),
        )  # fmt: skip

    def evidence(self) -> Calibration:
        """What is stored of this calibration: from its own data, never from the history."""
        stretch = self.best
        (noise, freedom), temperature = stretch.log_noise(), stretch.current.temperature
        return Calibration(
            stretch.estimate.bias, stretch.estimate.variance, self.now.day,
            temperature.mean if temperature.blocks else None, stretch.up, stretch.outcome, noise,
            freedom,
        )  # fmt: skip

    @property
    def best(self) -> Stretch:
        """Of the stretches that were at rest, the one that knows most."""
        kept, last = self._kept, self.stretch
        if kept and not np.sum(last.estimate.variance - kept.estimate.variance) < 0:
            return kept
        return last

    def _rows(
        self, time_s: ArrayLike | None, gyro_dps: ArrayLike, accel_g: ArrayLike | None,
        temperature_c: ArrayLike | None,
    ) -> Array:  # fmt: skip
        """Samples that hold a measurement, (n, 8)."""
        rates = np.atleast_2d(np.asarray(gyro_dps, np.float64))
        if rates.ndim != 2 or rates.shape[1] != 3:  # noqa: PLR2004
            raise InputError(f"gyro_dps: expected (n, 3) or (3,) deg/s, got {np.shape(gyro_dps)}")
        rows = np.full((len(rates), _COLUMNS), np.nan)
        if time_s is None:
            first = -1 if self._last_time is None else round(self._last_time * self.rate_hz)
            time_s = (first + 1 + np.arange(len(rows))) / self.rate_hz
        rows[:, 0], rows[:, 1:4] = time_s, rates
        if accel_g is not None:
            rows[:, 4:7] = accel_g
        if temperature_c is not None:
            rows[:, 7] = temperature_c
        finite, zero = np.isfinite(rows[:, :4]).all(axis=1), ~rates.any(axis=1)
        self.counts.samples += len(rows)
        self.counts.not_finite += int(np.sum(~finite))
        self.counts.zero += int(np.sum(zero))
        if len(rows) and np.isfinite(rows[-1, 0]):
            self._last_time = float(rows[-1, 0])
        good = finite & ~zero
        return rows if good.all() else rows[good]

    def _take_whole_blocks(self, rows: Array) -> Array:
        """Take the blocks of rows without a gap; returns the rows that are left."""
        used = len(rows) // self.size * self.size
        self._cross_gap(rows[0, 0])
        if used:
            for block in _blocks(rows[:used].reshape(-1, self.size, _COLUMNS)):
                self.counts.constant = np.where(block.variance == 0, self.counts.constant + 1, 0)
                self.counts.dead = self.counts.dead | (self.counts.constant >= _DEAD_BLOCKS)
                self._take(block)
            self._end = rows[used - 1, 0] + 1 / self.rate_hz
        return rows[used:]

    def _cross_gap(self, start: float) -> None:
        """Move on to where rows start, if that is not where the last block ended."""
        gap = 0.0 if self._end is None else start - self._end
        if gap < -1 / self.rate_hz or gap > _JUMP_S:
            self.counts.jumps += 1
            gap = self.block_s
        elif gap > BLOCK_S / 2:
            self.counts.gaps += 1
            self.counts.gap_s += gap
        else:
            return
        self.time_s += gap
        self.stretch.skip(gap)
        self._end = start

    def _take(self, block: Block) -> None:
        """Take a block; an alarm ends a stretch and starts the next."""
        alarm = self.stretch.take(block)
        if alarm is None or alarm.code != ATTITUDE:
            self.time_s += self.block_s
        if alarm is None:
            return
        self._note(alarm)
        if alarm.code in (MOTION, ATTITUDE):  # what came before it was at rest
            self._rest_s += self.stretch.seconds
            self._kept = self.best
        else:
            self._proof_s = max(self._proof_s, self.time_s - self.stretch.start_s)
        self.stretch = self._new_stretch()
        if alarm.code == ATTITUDE:
            self._take(block)

    def _note(self, alarm: Alarm) -> None:
        """Keep why a stretch ended, for people."""
        told, name = None, self.device_type.name
        if alarm.code == NOISE:
            told = unit_reason(alarm.value, name)
        words: dict[str, Any] = {"name": name, "factor": alarm.value, "rate": alarm.value / MDPS}
        told = told or reason(alarm.code, self.time_s, sigma=alarm.sigma / MDPS, **words)
        self.counts.ended = {**self.counts.ended, alarm.code: told}

    def _new_stretch(self) -> Stretch:
        age = None if self.since_power_on_s is None else self.since_power_on_s + self.time_s
        return self._stretch_at(self.time_s, age)

    def _prior_of(self, up: Array | None, temperature_c: float | None, believed: bool) -> Prior:
        same = self.now.same_heading and believed
        now = replace(self.now, up=up, temperature_c=temperature_c, same_heading=same)
        return prior_of(self.history, self.device_type, now)

    def _rest(self, stretch: Stretch, finished: bool) -> str:
        """Whether it is at rest now; or, once finished, whether half of it, and enough, was."""
        if self.known_still:
            return STILL if stretch.blocks else UNSURE
        enough = stretch.seconds >= max(min(self.least_s, 2 * LEAST_S), self._proof_s)
        ended = bool(self.counts.ended.keys() - {ATTITUDE})
        if finished:
            half = self._rest_s + self.stretch.seconds >= self.time_s / 2
            return STILL if enough and half else MOVING if ended or stretch.motions else UNSURE
        if stretch.moving or (ended and not enough):
            return MOVING
        return STILL if enough else UNSURE


def _blocks(samples: Array) -> list[Block]:
    """Means and variances of whole blocks, (block, sample, 8)."""
    means, variances = samples.mean(axis=1), samples[..., 1:4].var(axis=1, ddof=1)
    gravity_variances = np.full(len(samples), np.nan)
    if np.isfinite(means[:, 4:7]).any():
        gravity_variances = samples[..., 4:7].var(axis=1, ddof=1).mean(axis=1)
    columns = means[:, 1:4], variances, means[:, 4:7], gravity_variances, means[:, 7].tolist()
    return [Block(*row) for row in zip(*columns, strict=True)]
