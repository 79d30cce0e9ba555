"""Samples in, the bias with its standard deviation out, from the first moment on.

Samples are cut into blocks of 0.5 s by their number, and a stretch in one attitude takes the blocks
(:mod:`.stretch`). Nothing here reads a clock, starts a thread or knows of files.
"""

from collections.abc import Sequence
from copy import copy
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from gyro_pipeline.calibrator.device_types import DeviceType
from gyro_pipeline.calibrator.history import (
    Calibration,
    Circumstances,
    Prior,
    noise_of,
    prior_of,
)
from gyro_pipeline.calibrator.rest import BRIEF
from gyro_pipeline.calibrator.state import (
    DROPPED,
    MOVING,
    NONE,
    STILL,
    UNSURE,
    USED,
    Array,
    State,
)
from gyro_pipeline.calibrator.stretch import Blocks, Setting, Stretch
from gyro_pipeline.calibrator.words import Facts, reasons_of
from gyro_pipeline.conventions import MDPS, InputError

BLOCK_S = 0.5
LEAST_S, LEAST_UNKNOWN_S = 1.0, 10.0
"""Seconds at rest before a target counts as reached: where the noise is known, and where not."""

LONGEST_S = 3600.0
"""So far ahead seconds left are looked for."""

_JUMP_S = 3600.0  # a clock that moves by more has jumped
_COLUMNS = 8  # time, rates, accelerations, temperature


class Calibrator:
    """Calibrates one gyroscope of three axes; see :meth:`open`.

    Args:
        kind: Type of the device.
        rate_hz: Samples per second.
        history: Its calibrations, the oldest first.
        now: What is known of this one beforehand.
        target_dps: Standard deviation that is wanted; None: none.
        since_power_on_s: Of the first sample; None: a warm-up's amplitude is left free.
        known_still: The device is declared to be at rest: nothing is cut.
    """

    def __init__(
        self, kind: DeviceType, rate_hz: float, history: Sequence[Calibration] = (),
        now: Circumstances | None = None, target_dps: float | None = None,
        since_power_on_s: float | None = None, known_still: bool = False,
    ) -> None:  # fmt: skip
        self.kind, self.rate_hz, self.history = kind, _checked(rate_hz), tuple(history)
        self.now, self.target_dps = now or Circumstances(), target_dps
        self.since_power_on_s, self.known_still = since_power_on_s, known_still
        self.size = max(round(BLOCK_S * self.rate_hz), 5)  # fewer tell no noise
        self.block_s = self.size / self.rate_hz
        self.scale, self.freedom = noise_of(self.history, kind)
        self.time_s = 0.0
        self.facts, self._rest_s = Facts(), 0.0  # of stretches that ended
        self._rest_of_block = np.empty((0, _COLUMNS))
        self._last_time: float | None = None
        self._end: float | None = None  # of the last block, on the clock of the samples
        self._proof_s = 0.0  # at rest that a rest must last, after one that was none
        self.setting = Setting(
            kind, self._prior_of, self.scale, self.freedom, self.size, self.block_s, known_still
        )
        self.stretch = self._new_stretch()
        self.kept: Stretch | None = None

    @classmethod
    def open(  # noqa: PLR0913 - what can be known beforehand
        cls, device: str | None = None, *, rate_hz: float, target_mdps: float | None = None,
        registry: str | Path | None = None, started_at: float | None = None,
        since_power_on_s: float | None = None, device_type: str | None = None,
        same_heading: bool | None = None, latitude_deg: float | None = None,
    ) -> "Calibrator":  # fmt: skip
        """A calibrator of a device of the registry, or of an unknown one.

        Args:
            device: Its name in the registry; None: no history.
            rate_hz: Samples per second.
            target_mdps: Standard deviation that is wanted.
            registry: Folder; None: the environment's, or the user's own.
            started_at: Of the first sample, POSIX seconds; None: one day after the last one.
            since_power_on_s: Of the first sample.
            device_type: None: what ``device.toml`` says.
            same_heading: Whether the heading repeats; None: what ``device.toml`` says.
            latitude_deg: None: what ``device.toml`` says.

        Raises:
            InputError: The registry holds something that is not as it should be.
        """
        from gyro_pipeline.calibrator.registry import opened  # noqa: PLC0415 - files, not needed below

        given = opened(device, registry, device_type, same_heading, latitude_deg, started_at)
        target = None if target_mdps is None else target_mdps * MDPS
        return cls(given.kind, rate_hz, given.history, given.now, target, since_power_on_s)

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
            rows = np.vstack([self._rest_of_block, rows])
            gaps = np.diff(rows[:, 0])
            edges = np.flatnonzero((gaps > BLOCK_S / 2) | (gaps < -1 / self.rate_hz)) + 1
            for part in np.split(rows, edges)[:-1]:
                self._blocks(part)
            self._rest_of_block = self._blocks(rows[edges[-1] if len(edges) else 0 :])
        return self.state()

    def finish(self) -> State:
        """The answer, from the stretch that knows most."""
        return self.state(finished=True)

    def evidence(self) -> Calibration:
        """What is stored of this calibration: its own data's word, never the history's."""
        stretch = self._best()
        own, (noise, freedom) = stretch.own(), stretch.log_noise()
        return Calibration(
            own.bias, own.variance, self.now.day, stretch.temperature_c, stretch.up,
            _outcome(stretch), noise, freedom,
        )  # fmt: skip

    @property
    def prior(self) -> Prior:
        """What the history says of the answer's stretch."""
        return self._best().taken.prior

    @property
    def temperature_range(self) -> tuple[float, float]:
        """The least and the most temperature of the answer's stretch, degrees Celsius."""
        return self._best().taken.range_c

    def state(self, finished: bool = False) -> State:
        """The answer so far."""
        stretch = self._best() if finished else self.stretch
        bias, variance = stretch.answer()
        own, prior, target = stretch.own(), stretch.taken.prior, self.target_dps
        rest = self._rest(stretch, finished)
        snapshot, left_s = copy(stretch), max(self._least_s - stretch.seconds, 0.0)

        def look_ahead() -> Array:
            if target is None:
                return np.full(3, np.nan)
            return np.maximum(snapshot.seconds_left(target, LONGEST_S), left_s)

        reached = target is None or bool(stretch.reached(target).all())
        return State(
            bias, np.sqrt(variance), own.bias, np.sqrt(own.variance), prior.mean,
            np.sqrt(prior.narrow), rest, self.time_s, stretch.seconds, _outcome(stretch),
            reasons_of(self.facts, stretch, target), reached and left_s == 0, look_ahead,
        )  # fmt: skip

    def _rows(
        self, time_s: ArrayLike | None, gyro_dps: ArrayLike, accel_g: ArrayLike | None,
        temperature_c: ArrayLike | None,
    ) -> Array:  # fmt: skip
        """Samples that hold a measurement, (n, 8)."""
        rates = np.atleast_2d(np.asarray(gyro_dps, np.float64))
        if rates.ndim != 2 or rates.shape[1] != 3:  # noqa: PLR2004
            raise InputError(f"gyro_dps: expected (n, 3) or (3,) deg/s, got {np.shape(gyro_dps)}")
        rows = np.full((len(rates), _COLUMNS), np.nan)
        rows[:, 1:4] = rates
        if accel_g is not None:
            rows[:, 4:7] = accel_g
        if temperature_c is not None:
            rows[:, 7] = temperature_c
        if time_s is None:
            first = -1 if self._last_time is None else round(self._last_time * self.rate_hz)
            rows[:, 0] = (first + 1 + np.arange(len(rows))) / self.rate_hz
        else:
            rows[:, 0] = time_s
        finite = np.isfinite(rows[:, :4]).all(axis=1)
        zero = ~rows[:, 1:4].any(axis=1)
        self.facts.not_finite += int(len(finite) - finite.sum())
        self.facts.zero += int(zero.sum())
        self.facts.samples += len(rows)
        if len(rows) and np.isfinite(rows[-1, 0]):
            self._last_time = float(rows[-1, 0])
        return rows[finite & ~zero]

    def _blocks(self, rows: Array) -> Array:
        """Take the whole blocks of rows without a gap; returns the rows that are left."""
        count = len(rows) // self.size
        if len(rows):
            self._gap(rows[0, 0])
        if count:
            blocks = rows[: count * self.size].reshape(count, self.size, _COLUMNS)
            self._take(_means(blocks))
            self._end = rows[count * self.size - 1, 0] + 1 / self.rate_hz
        return rows[count * self.size :]

    def _gap(self, start: float) -> None:
        """Move on to where rows start, if that is not where the last block ended."""
        gap = 0.0 if self._end is None else start - self._end
        if gap < -1 / self.rate_hz or gap > _JUMP_S:
            self.facts.jumps += 1
            gap = self.block_s
        elif gap > BLOCK_S / 2:
            self.facts.gaps += 1
            self.facts.gap_s += gap
        else:
            return
        self.time_s += gap
        self.stretch.skip(gap)
        self._end = start

    def _take(self, blocks: Blocks) -> None:
        """Deal blocks to stretches; an alarm ends one and starts the next."""
        first, count = 0, len(blocks.means)
        self.facts.look(blocks.variances)
        while first < count:
            done, alarm = self.stretch.take(blocks.rows(first, count))
            first, self.time_s = first + done, self.time_s + done * self.block_s
            if alarm is None:
                continue
            self.facts.ended.append((self.time_s, alarm))
            if alarm.kind == BRIEF:  # what came before it was at rest
                self._rest_s += self.stretch.seconds
                self.kept = self._best()
            else:
                self._proof_s = max(self._proof_s, self.time_s - self.stretch.start_s)
            self.stretch = self._new_stretch()

    def _new_stretch(self) -> Stretch:
        age = None if self.since_power_on_s is None else self.since_power_on_s + self.time_s
        return Stretch(self.setting, self.time_s, age)

    def _prior_of(self, up: Array | None, temperature_c: float | None, believed: bool) -> Prior:
        same = self.now.same_heading and believed
        now = replace(self.now, up=up, temperature_c=temperature_c, same_heading=same)
        return prior_of(self.history, self.kind, now)

    def _best(self) -> Stretch:
        """Of the stretches that were at rest, the one that knows most."""
        if self.kept is None or np.sum(self.stretch.own().variance - self.kept.own().variance) < 0:
            return self.stretch
        return self.kept

    @property
    def _least_s(self) -> float:
        return LEAST_S if np.all(self.freedom > 0) else LEAST_UNKNOWN_S

    def _rest(self, stretch: Stretch, finished: bool) -> str:
        """Now; of a finished calibration, whether half of it, and enough, was at rest."""
        if self.known_still:
            return STILL if stretch.blocks else UNSURE
        enough = stretch.seconds >= max(min(self._least_s, 2 * LEAST_S), self._proof_s)
        ended = any(alarm.code != "attitude" for _, alarm in self.facts.ended)
        if finished:
            half = self._rest_s + self.stretch.seconds >= self.time_s / 2
            return STILL if enough and half else MOVING if ended or stretch.motions else UNSURE
        if stretch.moving or (ended and not enough):
            return MOVING
        return STILL if enough else UNSURE


def _means(rows: Array) -> Blocks:
    """Means and variances of whole blocks, (block, sample, 8)."""
    rates, gravity, temperature = rows[..., 1:4], rows[..., 4:7], rows[..., 7]
    count, size = rows.shape[:2]
    nothing = np.full(count, np.nan)
    measured = not np.isnan(gravity[:, 0, 0]).all()
    return Blocks(
        rates.mean(axis=1),
        rates.var(axis=1, ddof=1),
        gravity.mean(axis=1) if measured else np.full((count, 3), np.nan),
        gravity.var(axis=1, ddof=1).mean(axis=1) if measured else nothing,
        temperature.mean(axis=1),
    )


def _outcome(stretch: Stretch) -> tuple[str, ...]:
    """What became of the history on each axis."""
    known = np.isfinite(stretch.taken.prior.narrow)
    gone = stretch.taken.dropped
    return tuple(np.where(known, np.where(gone, DROPPED, USED), NONE).tolist())


def _checked(rate_hz: float) -> float:
    if not (np.isfinite(rate_hz) and rate_hz >= 2):  # noqa: PLR2004 - blocks of five samples
        raise InputError(f"rate_hz: expected at least 2 samples a second, got {rate_hz}")
    return float(rate_hz)
