"""Sample rate and gaps, from timestamps and packet counters."""

from dataclasses import dataclass, field
from math import floor, log10
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import minimum_filter1d

from gyro_pipeline.logs import KEPT, REJECTED, REPAIRED, Finding

_DAY_S = 86_400.0
_PERIODS = (2.0**16, 2.0**24, 2.0**32)  # of counters of microseconds, milliseconds or ticks

_SHORT = 0.1
"""A larger share of steps is far below the median: stamps come in bursts."""

_LONG, _LONG_TIME = 0.005, 0.5
"""The same, if a larger share is far above it, and makes up more of the time than this."""

_REGULAR, _MOST = 0.25, 0.75
"""Rounding lengthens steps at intervals of which most differ by less than this; losses come at
random ones."""

_FEW, _MANY = 3, 10
"""Long steps that it takes to tell: of stamps as coarse as the step, and of others."""

_BLOCKS, _ADVANCES = 20, 5
"""Parts of a recording whose median is taken, at most: one stall, gap or jump is in few of them;
and steps forward in each of them, at least."""

_ALIKE = 3.0
"""Parts are alike that differ from the median by so many times what they differ in the median."""

_FAR = 10
"""So many steps beside both of its neighbours, a stamp is no measured time."""

_AHEAD = 4000
"""Rows within which a stamp that was written late is followed by one in time."""

_LAST, _LATE = 10, 3.0
"""Rows after which it is known whether stamps stay late; the last are judged by how far the middle
60 % of the steps are apart, so many times."""

_HOLE = 3.0
"""A step so many times longer than those from burst to burst is none of them."""

_ROUNDED = 1e-6
"""Differences of rounded stamps vary by so much of themselves."""

_ROUNDS = 4
"""How often gaps are found from the step between samples, and that without the gaps."""

_LEAST, _LARGEST = 1e-100, 1e100
"""No clock's step, and no clock's time: garbage bytes may be read as such."""

_STEADY, _PARTS = 0.02, 5
"""A rate that differs by more from part to part of a recording is no rate; and so many parts."""

_JITTER = 0.1
"""Scatter of the steps, relative to their mean, that is worth a word."""

Rows = NDArray[np.intp]
Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class Timing:
    """What stamps or a counter say: sample rate in Hz, rows behind gaps, and what was noticed."""

    rate_hz: float | None = None
    gap_rows: Rows = field(default_factory=lambda: np.empty(0, np.intp))
    findings: tuple[Finding, ...] = ()


@dataclass(frozen=True)
class _Steps:
    """From one stamp to the next, in the stamps' unit.

    Attributes:
        rows: (k,), of the later stamp.
        counts: (k,), rows from the earlier one to it: 1, or more where rows have no stamp.
        steps: (k,), wraps of a counter undone.
        wraps: (k,), where.
    """

    rows: Rows
    counts: Rows
    steps: Floats
    wraps: Mask

    @classmethod
    def between(cls, stamps: Floats, unit_s: float | None) -> "_Steps":
        rows = np.flatnonzero(np.isfinite(stamps))
        steps, wraps = _unwrapped(np.diff(stamps[rows]), unit_s)
        rounded = 4 * np.spacing(np.abs(stamps[rows]).max(initial=0.0))
        steps[np.abs(steps) <= max(rounded, _LEAST)] = 0.0
        return cls(rows[1:], np.diff(rows), steps, wraps)

    def per_row(self, where: Mask) -> float:
        """Mean of those steps, for each row; 0 without any."""
        return float(self.steps[where].sum() / max(self.counts[where].sum(), 1))

    def by_block(self, values: NDArray[Any]) -> Floats:
        """Sums of (k,) values in parts of the recording that hold some steps forward each."""
        blocks = max(min(int(np.count_nonzero(self.steps > 0)) // _ADVANCES, _BLOCKS), 1)
        starts = np.linspace(0, len(values), blocks, endpoint=False, dtype=np.intp)
        return np.add.reduceat(values, starts, dtype=np.float64)

    def usual_per_row(self, where: Mask, coarseness: float) -> float:
        """The same, of parts of the recording that agree with most others."""
        rows = self.by_block(where * self.counts)
        slopes = self.by_block(where * self.steps) / np.maximum(rows, 1)
        known = rows > 0
        if not known.any():
            return 0.0
        rows, slopes = rows[known], slopes[known]
        apart = np.abs(slopes - np.quantile(slopes, 0.5, method="lower"))
        alike = apart <= np.maximum(_ALIKE * np.median(apart), 2 * coarseness / rows)
        return float(np.average(slopes[alike], weights=rows[alike]))

    def delays(self, step: float) -> Floats:
        """How much later than the stamp before one lets expect it and all that follow are.

        A missing sample makes all later stamps late. One that was written late is followed by
        others in time, and a burst ends in time.
        """
        late = np.where(self.steps < 0, 0.0, self.steps - step * self.counts)
        total = np.cumsum(late)
        return _least_ahead(total) - (total - late)


def from_stamps(stamps: Floats, unit_s: float | None) -> Timing:
    """Sample rate and gaps from timestamps.

    Stamps may be rounded, and written late, one by one or in bursts. The rate is the count of
    samples over the duration, without the gaps.

    Args:
        stamps: (n,), one a row; NaN where a row has none.
        unit_s: Seconds in one unit of them; None: not known, and no rate.

    Returns:
        Rows behind missing samples, which make all later stamps late, and those at which time goes
        back are gaps. What is missing within a burst, or the resolution of stamps, is not seen.
    """
    stamps, strays = _without_strays(np.where(np.abs(stamps) < _LARGEST, stamps, np.nan))
    every = np.diff(stamps)
    if len(every) and every.min() > _LEAST and np.ptp(every) <= _JITTER * every.mean():
        # as most are: there is no more to find
        uneven = _uneven(np.arange(len(stamps)), stamps, _STEADY * every.mean())
        return Timing(_rate(every.mean(), unit_s), findings=tuple(uneven))
    found = _Steps.between(stamps, unit_s)
    steps, back = found.steps, found.steps < 0
    findings = [
        *_at("timestamps", strays, "a timestamp is far from those beside it, and ignored"),
        *_at("wrap-around", found.rows[found.wraps], "the counter of the timestamps starts anew"),
        *_at("time order", found.rows[back], "time goes back", REPAIRED),
    ]
    if not steps.max(initial=0.0) > 0:
        text = "timestamps do not advance: the rate is not measured"
        findings.append(Finding("timestamps", KEPT, text))
        return Timing(gap_rows=found.rows[back], findings=tuple(findings))
    clock = _Clock.of(found, stamps[np.isfinite(stamps)])
    step, gaps, counted, missing = _gaps(found, clock)
    what = f"samples are missing, about {missing}"
    findings += _at("gaps", found.rows[gaps], what, REPAIRED)
    findings += _irregular(found, step, clock, gaps | back)
    late = np.cumsum((steps - step * found.counts)[counted])
    passed = np.cumsum(found.counts[counted])
    allowed = _STEADY * step + 2 * _PARTS * clock.coarseness / max(len(passed), 1)
    findings += _uneven(passed, _least_ahead(late) + step * passed, allowed)
    return Timing(_rate(step, unit_s), found.rows[back | gaps], tuple(findings))


@dataclass(frozen=True)
class _Clock:
    """How stamps are written.

    Attributes:
        step: From sample to sample, about.
        coarseness: Delays up to this are rounding, or within a burst.
        in_bursts: Whether stamps come in bursts, as those do that are rounded to several steps.
        counted: (k,), steps whose mean is taken: between two ends of bursts, or those from row to
            row and ordinary ones over a row without a stamp, which may be no sample.
    """

    step: float
    coarseness: float
    in_bursts: bool
    counted: Mask

    @classmethod
    def of(cls, found: _Steps, stamps: Floats) -> "_Clock":
        forward = np.maximum(found.steps, 0.0)
        median = float(np.quantile(forward / found.counts, 0.5, method="lower"))
        resolution, regular = _rounding(found, stamps, median)
        in_bursts = regular or _come_in_bursts(found, median, resolution)
        if in_bursts or resolution >= median / 2:
            return cls._of_blocks(found, in_bursts)
        ordinary = (
            np.abs(found.steps - median * found.counts) <= median * found.counts / 2 + resolution
        )
        ordinary &= found.steps >= 0
        return cls(found.per_row(ordinary), resolution, False, ordinary | (found.counts == 1))

    @classmethod
    def _of_blocks(cls, found: _Steps, in_bursts: bool) -> "_Clock":
        """Of stamps that do not tell steps from row to row, but those of whole blocks."""
        steps, forward = found.steps, found.steps >= 0
        between = steps >= found.usual_per_row(forward, 0.0) * (1 - _ROUNDED)
        burst = float(np.quantile(steps[between & forward], 0.95))
        counted = np.ones(len(steps), bool)
        ends = np.flatnonzero(between)
        if in_bursts and len(ends) > 1:
            counted[: ends[0] + 1] = counted[ends[-1] + 1 :] = False
        ordinary = counted & forward & (steps <= _HOLE * burst)
        return cls(found.usual_per_row(ordinary, burst), burst, in_bursts, counted)


def _rounding(found: _Steps, stamps: Floats, median: float) -> tuple[float, bool]:
    """Resolution of stamps, 0 of an exact clock; and whether rounding lengthens steps regularly.

    A clock whose unit is the step from sample to sample is exact if some steps are of two units, or
    of none, at random: these are losses, or doubled rows.
    """
    steps, usual = found.steps, median * found.counts
    long, late = steps > 1.5 * usual, found.delays(median) > median / 2
    resolution = _resolution(stamps, median)
    coarse = resolution >= median / 2
    double = found.rows[long & (steps < 2.01 * usual) & late]
    off = np.abs(steps - median * np.rint(steps / max(median, _LEAST)))
    ticks = coarse or bool((off <= resolution + _ROUNDED * np.abs(steps)).all())
    regular = ticks and _all_along(double, _FEW if coarse else _MANY, found.rows)
    none = found.rows[(steps == 0) & (median > 0)]
    catches_up = (long & ~late).any()
    doubled = len(none) >= _FEW and not catches_up and not _all_along(none, _FEW, found.rows)
    exact = coarse and (doubled or (len(double) >= _FEW and not regular))
    return 0.0 if exact else resolution, regular


def _come_in_bursts(found: _Steps, median: float, resolution: float) -> bool:
    """Whether most parts have many steps far below the median, or their time in long ones."""
    steps, usual = found.steps, median * found.counts
    long = steps > 1.5 * usual
    time = found.by_block(np.maximum(steps, 0.0))
    short = found.by_block((steps >= 0) & (steps < usual / 2 - resolution))
    in_long = found.by_block(np.where(long, steps, 0.0)) / np.where(time > 0, time, np.inf)
    many = median == 0 or long.mean() > _LONG
    lasts = many and np.median(in_long) > _LONG_TIME
    return bool(np.median(short / found.by_block(found.counts)) > _SHORT or lasts)


def _gaps(found: _Steps, clock: _Clock) -> tuple[float, Mask, Mask, int]:
    """The step from sample to sample, behind which steps samples are missing, and how many.

    In the third place, the steps whose mean it is.
    """
    steps, step = found.steps, clock.step or found.per_row(found.steps > 0)
    gaps, delays, counted = steps < 0, steps, steps > 0
    least_late = np.zeros(len(steps))
    least_late[-_LAST:] = _LATE * np.ptp(np.quantile(steps / found.counts, [0.2, 0.8]))
    for _ in range(_ROUNDS):
        delays = found.delays(step)
        gaps = delays > np.maximum(least_late, max(step / 2, clock.coarseness * (1 + _ROUNDED)))
        counted = clock.counted & (steps >= 0) & ~gaps
        if clock.coarseness < step / 2 and not ((steps > 1.5 * step) & ~gaps).any():
            counted &= steps > 0  # nothing catches up: a row of a repeated stamp is one too many
        step = found.usual_per_row(counted, clock.coarseness) or step
    step = found.per_row(counted) or step
    return step, gaps, counted, max(round(delays[gaps].sum() / step), 1)


def _all_along(some: Rows, least: int, rows: Rows) -> bool:
    """Whether some rows are at regular intervals and over most of the recording."""
    if len(some) < least or 2 * np.ptp(some) < np.ptp(rows):
        return False
    intervals = np.diff(some)
    median = np.median(intervals)
    return bool((np.abs(intervals - median) <= 1 + _REGULAR * median).mean() >= _MOST)


def _irregular(found: _Steps, step: float, clock: _Clock, apart: Mask) -> list[Finding]:
    """What is worth a word about steps other than those that are gaps or go back."""
    if clock.in_bursts:
        text = "timestamps are coarse or come in bursts: the rate is the count over the duration"
        return [Finding("timestamps", KEPT, text)]
    steps, rows = found.steps, found.rows
    if clock.coarseness > step / 2:
        longer = ~apart & (steps > (np.median(steps) + clock.coarseness / 2) * found.counts)
        text = "a step is longer, for a lost sample or the rounding of timestamps"
        repeats = rows[steps == 0]
        doubled = repeats if len(repeats) < _FEW else rows[:0]
        return [
            *_at("timestamps", rows[longer], text),
            *_at("duplicated timestamps", doubled, "a timestamp repeats"),
        ]
    findings = _at("duplicated timestamps", rows[steps == 0], "a timestamp repeats")
    even = steps[(steps > 0) & ~apart & (found.counts == 1)]
    scatter = np.std(even) / step if len(even) else 0.0
    if scatter > max(_JITTER, clock.coarseness / step):
        text = f"steps scatter by {scatter:.0%} of their mean"
        findings.append(Finding("jitter", KEPT, text))
    return findings


def _uneven(rows: Rows, times: Floats, allowed: float) -> list[Finding]:
    """Whether the step from row to row changes along a recording, by more than allowed."""
    ends = np.linspace(0, len(rows) - 1, _PARTS + 1).astype(np.intp)
    if len(set(ends)) <= _PARTS:
        return []
    slopes = np.diff(times[ends]) / np.diff(rows[ends])
    if np.ptp(slopes) <= allowed:
        return []
    change = np.ptp(slopes) / slopes.mean()
    text = (
        f"the step between timestamps changes by {change:.0%} along the recording: split the file"
    )
    return [Finding("sample rate", REJECTED, text)]


def _least_ahead(values: Floats) -> Floats:
    """Least of each value and those behind it in which a late stamp is made up for."""
    return minimum_filter1d(values, _AHEAD, mode="nearest", origin=-(_AHEAD // 2))


def _rate(step: float, unit_s: float | None) -> float | None:
    return None if unit_s is None else float(1 / (step * unit_s))


def from_counter(counts: Floats, bits: int) -> Timing:
    """Gaps from a packet counter.

    Args:
        counts: (n,), one a row, each one more than the last; NaN where a row has none.
        bits: It starts anew after ``2**bits``.

    Returns:
        Rows at which it does not go on by one are gaps; there is no rate.
    """
    if (np.diff(counts) == 1).all():  # as most are
        return Timing()
    counts, strays = _without_strays(counts)
    there = np.flatnonzero(np.isfinite(counts))
    rows, steps = there[1:], np.diff(counts[there])
    broken = np.mod(steps - np.diff(there), 2.0**bits) != 0
    wraps = ~broken & (steps < 0)
    what = "the packet counter does not go on by one"
    return Timing(
        gap_rows=rows[broken],
        findings=(
            *_at("packet counter", strays, "a number is far from those beside it, and ignored"),
            *_at("wrap-around", rows[wraps], f"the {bits}-bit packet counter starts anew"),
            *_at("packet counter", rows[broken], what, REPAIRED),
        ),
    )


def check_rate(rate_hz: float, expected_hz: float, tolerance_pct: float) -> tuple[Finding, ...]:
    """Compare a measured sample rate with the expected one; beyond the tolerance: REJECTED."""

    def is_off_by(factor: float) -> bool:
        return abs(rate_hz / expected_hz / factor - 1) <= tolerance_pct / 100

    if is_off_by(1):
        return ()
    powers = [power for power in (-6, -3, 3, 6) if is_off_by(10.0**power)]
    advice = "check the file's time, and samples and recording_s of the sensor"
    if powers:
        advice = f"it is off by 10^{powers[0]}: check time_units"
    text = f"expected {expected_hz:g} Hz within {tolerance_pct:g} %, got {rate_hz:.6g} Hz; {advice}"
    return (Finding("sample rate", REJECTED, text),)


def _unwrapped(steps: Floats, unit_s: float | None) -> tuple[Floats, Mask]:
    """Steps without wraps, and where those are: a step back that a period makes an ordinary one.

    Periods are those of counters of 16, 24 and 32 bits, and a day.
    """
    wraps = np.zeros(len(steps), bool)
    if not (steps < 0).any():
        return steps, wraps
    ordinary = np.median(steps)
    day = [] if unit_s is None else [_DAY_S / unit_s]
    for period in [*_PERIODS, *day]:
        found = (steps < 0) & (np.abs(steps + period - ordinary) <= ordinary)
        steps = np.where(found, steps + period, steps)
        wraps |= found
    return steps, wraps


def _without_strays(stamps: Floats) -> tuple[Floats, Rows]:
    """Stamps, NaN where one is far from both beside it, which are near each other; and where.

    Of these the time is not known, but the samples may be whole.
    """
    rows = np.flatnonzero(np.isfinite(stamps))
    before, here, after = (stamps[rows[n : len(rows) - 2 + n]] for n in range(3))
    away = np.maximum(before - here, here - after)
    if not (away > 0).any():  # as most are
        return stamps, rows[:0]
    near = np.maximum(after - before, np.median(after - before) / 2)
    strays = rows[1:-1][(after >= before) & (away > _FAR * near)]
    known = stamps.copy()
    known[strays] = np.nan
    return known, strays


def _resolution(stamps: Floats, step: float) -> float:
    """Decimal unit that all stamps are multiples of, but for how floats are rounded.

    It is looked for from the step, in whichever unit that is, to a hundredth of it.
    """
    if step <= 0:
        return 0.0
    rounded = 4 * np.spacing(np.abs(stamps).max())
    largest = floor(log10(step) + _ROUNDED)
    for unit in (10.0**power for power in range(largest, largest - 3, -1)):
        if (np.abs(stamps - unit * np.rint(stamps / unit)) <= rounded).all():
            return unit
    return 0.0


def _at(check: str, rows: Rows, what: str, outcome: str = KEPT) -> list[Finding]:
    """How often something is so, and where first; no finding if it never is."""
    if not len(rows):
        return []
    shown = ", ".join(map(str, rows[:3])) + (", …" if len(rows) > len(rows[:3]) else "")
    times = "once, at row" if len(rows) == 1 else f"{len(rows)} times, at rows"
    cut = ", cut there" if outcome == REPAIRED else ""
    return [Finding(check, outcome, f"{what}: {times} {shown}{cut}")]
