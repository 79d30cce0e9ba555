"""Sample rate and gaps, from timestamps and packet counters."""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from gyro_pipeline.logs import KEPT, REJECTED, Finding

_DAY_S = 86_400.0
_PERIODS = (2.0**16, 2.0**24, 2.0**32)  # of counters of microseconds, milliseconds or ticks

_SHORT = 0.05
"""A larger share of steps far below the median: the stamps are a host's, and come in bursts."""

_LONG, _LONG_TIME = 0.005, 0.5
"""The same, if a larger share is far above it, and makes up more of the time than this."""

_BURST = 3.0
"""From burst to burst, a step longer than so many times the 95th percentile is a gap."""

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
        lost: (k,), rows without a stamp in between.
        steps: (k,), wraps of a counter undone.
        wraps: (k,), where.
        median: Of the steps; NaN if there are none.
        resolution: Decimal unit that all stamps are multiples of; 0 if small beside the steps.
    """

    rows: Rows
    lost: Rows
    steps: Floats
    wraps: Mask
    median: float
    resolution: float

    @classmethod
    def between(cls, stamps: Floats, unit_s: float) -> "_Steps":
        rows = np.flatnonzero(np.isfinite(stamps))
        steps, wraps = _unwrapped(np.diff(stamps[rows]), unit_s)
        median = float(np.median(steps)) if len(steps) else np.nan
        resolution = _resolution(stamps[rows], median) if len(steps) else 0.0
        return cls(rows[1:], np.diff(rows) - 1, steps, wraps, median, resolution)

    def near_median(self) -> Mask:
        """Steps within half of the median step, and the resolution, of it."""
        away = np.abs(self.steps - self.median * (1 + self.lost))
        return away <= self.median / 2 + self.resolution

    def are_bursts(self, far: Mask) -> bool:
        """Whether many steps are far from the median: within bursts short, between them long."""
        if not far.any():
            return False
        forward = np.maximum(self.steps, 0)
        far = far & (self.steps >= 0)
        long = far & (forward > self.median)
        lasts = forward[long].sum() > _LONG_TIME * forward.sum()
        return bool((far & ~long).mean() > _SHORT or (lasts and long.mean() > _LONG))

    def within_bursts(self) -> Mask:
        """Steps within bursts, and between them unless they are too long."""
        forward = self.steps[self.steps >= 0]
        between = forward[forward > forward.mean()]
        limit = _BURST * np.quantile(between, 0.95) if len(between) else forward.max()
        return (self.steps >= 0) & (self.steps <= limit)


def from_stamps(stamps: Floats, unit_s: float) -> Timing:
    """Sample rate and gaps from timestamps.

    The rate is one over the mean of the ordinary steps. Even stamps: those within half of the
    median step, so that gaps do not count. Stamps of a host come in bursts; ordinary are then all
    steps that are not too long, which makes the rate the count over the duration.

    Args:
        stamps: (n,), one a row; NaN where a row has none.
        unit_s: Seconds in one unit of them.

    Returns:
        Rows behind a missing sample or a step back in time are gaps.
    """
    every = np.diff(stamps)
    if len(every) and every.min() > 0 and np.ptp(every) <= _JITTER * every.mean():
        return Timing(float(1 / (every.mean() * unit_s)))  # as most are: there is nothing to find
    found = _Steps.between(stamps, unit_s)
    steps = found.steps
    if not (steps > 0).any():
        text = "timestamps do not advance: the rate is not measured"
        return Timing(findings=(Finding("timestamps", KEPT, text),))
    ordinary = found.near_median()
    if bursty := found.are_bursts(~ordinary):
        ordinary = found.within_bursts()
    step = steps[ordinary].sum() / (1 + found.lost[ordinary]).sum()
    back, gaps = steps < 0, (steps > step) & ~ordinary
    scatter = np.std(steps[ordinary & (found.lost == 0)])
    findings = [
        *_at("wrap-around", found, found.wraps, "the counter of the timestamps starts anew"),
        *_at("time order", found, back, "time goes back"),
        *_at("gaps", found, gaps, f"samples are missing, {steps[gaps].sum() * unit_s:.4g} s"),
    ]
    if bursty or found.resolution > 1.5 * step:
        text = "timestamps are coarse or come in bursts: the rate is the count over the duration"
        findings.append(Finding("timestamps", KEPT, text))
    elif found.resolution < step / 2:
        findings += _at("duplicated timestamps", found, steps == 0, "a timestamp repeats")
    if not bursty and scatter > max(_JITTER * step, found.resolution):
        text = f"steps of {step * unit_s * 1e3:.4g} ms scatter by {scatter * unit_s * 1e3:.4g} ms"
        findings.append(Finding("jitter", KEPT, text))
    return Timing(float(1 / (step * unit_s)), found.rows[back | gaps], tuple(findings))


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
    found = _Steps.between(counts, 1.0)
    raw = np.diff(counts[np.isfinite(counts)])
    broken = np.mod(raw - 1 - found.lost, 2.0**bits) != 0
    wraps = ~broken & (raw < 0)
    return Timing(
        gap_rows=found.rows[broken],
        findings=(
            *_at("wrap-around", found, wraps, f"the {bits}-bit packet counter starts anew"),
            *_at("packet counter", found, broken, "the packet counter does not go on by one"),
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


def _unwrapped(steps: Floats, unit_s: float) -> tuple[Floats, Mask]:
    """Steps without wraps, and where those are: a step back that a period makes an ordinary one.

    Periods are those of counters of 16, 24 and 32 bits, and a day.
    """
    wraps = np.zeros(len(steps), bool)
    if not (steps < 0).any():
        return steps, wraps
    ordinary = np.median(steps)
    for period in (*_PERIODS, _DAY_S / unit_s):
        found = (steps < 0) & (np.abs(steps + period - ordinary) <= ordinary)
        steps = np.where(found, steps + period, steps)
        wraps |= found
    return steps, wraps


def _resolution(stamps: Floats, step: float) -> float:
    """Decimal unit that all stamps are multiples of, but for how floats are rounded."""
    rounded = 4 * np.spacing(np.abs(stamps).max())
    for unit in (1.0, 0.1, 0.01, 1e-3, 1e-4):
        if unit < step / 100:
            break
        if (np.abs(stamps - unit * np.rint(stamps / unit)) <= rounded).all():
            return unit
    return 0.0


def _at(check: str, found: _Steps, where: Mask, what: str) -> list[Finding]:
    """A KEPT finding of how often something is so, and where first; none if it never is."""
    rows = found.rows[where]
    if not len(rows):
        return []
    shown = ", ".join(map(str, rows[:3])) + (", …" if len(rows) > len(rows[:3]) else "")
    times = "once, at row" if len(rows) == 1 else f"{len(rows)} times, at rows"
    return [Finding(check, KEPT, f"{what}: {times} {shown}")]
