"""Sample rate and gaps, from timestamps and packet counters.

One principle: a missing sample makes *all* later stamps late. A stamp that is written late, a stall
that catches up, a burst and rounding do not. So the least of ``stamp - row * step`` among the
stamps that follow rises only where samples are missing. Rows with one stamp are taken as one that
counts them all: the last of them is the one in time.

Not seen is what is lost within the resolution of the stamps or their scatter: a sample beside
jitter of half a step, or some of a burst. Nor are a sample in whose place a row is repeated, and
losses so regular that they look like a slower clock. Of a clock that ticks as fast as samples come,
fewer than ten longer steps may be rounding, and are no gaps.
"""

from dataclasses import dataclass, field
from math import ceil, log10

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import minimum_filter1d

from gyro_pipeline.logs import KEPT, REJECTED, REPAIRED, Finding

Rows = NDArray[np.intp]
Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class Timing:
    """What stamps or a counter say: sample rate in Hz, rows behind gaps, and what was noticed."""

    rate_hz: float | None = None
    gap_rows: Rows = field(default_factory=lambda: np.empty(0, np.intp))
    findings: tuple[Finding, ...] = ()


def from_stamps(stamps: Floats, unit_s: float | None) -> Timing:
    """Sample rate and gaps from timestamps.

    Args:
        stamps: (n,), one a row, in any unit; NaN where a row has none.
        unit_s: Seconds in one unit of them; None: not known, and no rate.

    Returns:
        Rows behind missing samples, and those at which time goes back, are gaps. The rate is that
        between them; a finding is REJECTED where it changes along the recording.
    """
    stamps, strays = _without_strays(stamps)
    rows = np.flatnonzero(np.isfinite(stamps))
    steps, wraps = _unwrapped(np.diff(stamps[rows]), unit_s)
    steps[np.abs(steps) <= 4 * np.spacing(np.abs(stamps[rows]).max(initial=1e-90))] = 0.0
    back, repeats = rows[1:][steps < 0], rows[1:][steps == 0]
    findings = [
        *_at("timestamps", strays, "a timestamp is far from those beside it, and ignored"),
        *_at("wrap-around", rows[1:][wraps], "the counter of the timestamps starts anew"),
        *_at("time order", back, "time goes back", REPAIRED),
    ]
    usual = _slope(np.cumsum(np.maximum(steps, 0.0)), rows[1:], len(rows) // 20)
    if not usual > 0:
        text = "timestamps do not advance: the rate is not measured"
        return Timing(None, back, (*findings, Finding("timestamps", KEPT, text)))
    times = np.r_[0.0, np.cumsum(np.where(steps < 0, usual, steps))]
    first = np.r_[True, np.diff(times) > usual / 10]  # of the rows with one stamp
    last = np.r_[first[1:], True]
    step, lost, even = _follow(times[last], rows[last].astype(float), stamps[rows])
    gaps = rows[first][lost > 0]
    findings += _at("gaps", gaps, f"samples are missing, about {lost.sum():.0f}", REPAIRED)
    if len(rows) > 1.5 * first.sum():
        text = "timestamps are coarse or come in bursts: the rate is the count over the duration"
        findings.append(Finding("timestamps", KEPT, text))
    else:
        findings += _at("duplicated timestamps", repeats, "a timestamp repeats")
    rate_hz = None if unit_s is None else 1 / (step * unit_s)
    return Timing(rate_hz, np.union1d(gaps, back), (*findings, *even))


def _follow(
    times: Floats, rows: Floats, stamps: Floats, pause: int = 100
) -> tuple[float, Floats, list[Finding]]:
    """The step from sample to sample, samples missing before each of k stamps, whether it is even.

    Args:
        times: (k,), of the stamps that differ.
        rows: (k,), the last row with each.
        stamps: (n,), as written.
        pause: A gap of so many samples need not last a whole number of steps.
    """
    step, lag = _usual_step(times, rows)
    tick = _tick(times, rows, step, _resolution(stamps, np.diff(times)))
    if tick:
        step = _slope(times, rows, min(200, len(rows) // 10))
    else:
        rows = _without_doubled(times, rows, step)
    lost = np.zeros(len(rows))
    for _ in range(4):
        late = times - step * rows
        scatter = np.ptp(np.quantile(late[lag:] - late[:-lag], [0.2, 0.8]))
        least = max(step / 2, 1.4 * scatter, 1.25 * tick)
        # of the last stamps, it is not known whether all that follow are late
        at_the_end = 2 * scatter / np.arange(len(late), 0, -1)
        lost = _rises(late, least + at_the_end, step * np.diff(rows).mean()) / step
        lost = np.where(lost < pause, np.rint(lost), lost)
        step = _slope(times - step * np.cumsum(lost), rows, 9 * len(rows) // 10) or step
    ordinary = (lost[1:] == 0) & (np.diff(rows) == 1)
    return step, lost, _uneven(times - step * np.cumsum(lost), rows, ordinary)


def _usual_step(times: Floats, rows: Floats) -> tuple[float, int]:
    """The step from row to row, and over how many stamps it is told.

    These are as few as let it scatter by less than a quarter: one, but for bursts, rounded stamps
    and steps at random. Over one stamp, it is the mean without the steps that are far longer.
    """
    lag = 1
    while True:
        each = (times[lag:] - times[:-lag]) / (rows[lag:] - rows[:-lag])
        low, step, high = np.quantile(each, [0.2, 0.5, 0.8], method="lower")
        if high - low <= step / 4 or 4 * lag > len(times):
            break
        lag *= 2
    if lag == 1:
        alike = np.abs(each - step) < step / 2
        step = np.average(each[alike], weights=np.diff(rows)[alike])
    return float(step), lag


def _tick(times: Floats, rows: Floats, step: float, resolution: float, few: int = 10) -> float:
    """The resolution if it makes some steps longer; 0 if those are for missing samples.

    Rounding makes as many steps longer everywhere, or others shorter; losses come at random.
    """
    steps = np.diff(times)
    multiples = steps / step
    if resolution < step / 2 and (resolution or not np.allclose(multiples, np.rint(multiples))):
        return 0.0
    tick = resolution or step
    late, odd = steps - step * np.diff(rows), min(tick, step) / 4
    short, long = np.sum(late < -odd), np.sum((late > odd) & (late < 1.5 * tick))
    if short + long < few:
        return resolution
    many = max(min(ceil(5 * len(steps) / (short + long)), len(steps) // 4), 1)
    passed = times[many:] - times[:-many]
    passed -= _slope(times, rows, min(200, len(rows) // 10)) * (rows[many:] - rows[:-many])
    regular = np.ptp(np.quantile(passed, [0.1, 0.9])) <= 2.5 * max(tick, step)
    return tick if regular or min(short, long) > 0.1 * (short + long) else 0.0


def _without_doubled(times: Floats, rows: Floats, step: float) -> Floats:
    """Numbers of rows (k,) that do not count doubled ones, behind which all stamps are early."""
    late = np.pad(times - step * rows, 5, mode="edge")
    middle = np.median(np.lib.stride_tricks.sliding_window_view(late, 5), axis=1)
    counts, steps = np.diff(rows), np.diff(times)
    early = middle[6 : len(rows) + 5] - middle[1 : len(rows)] < -step / 2
    doubled = (counts > 1) & (np.abs(steps - step) < step / 2) & early
    return np.cumsum(np.r_[rows[0], np.where(doubled, 1.0, counts)])


def _rises(late: Floats, least: Floats, each: float) -> Floats:
    """By how much the least of all that follow is above the delays before it, (k,); else 0.

    Args:
        late: (k,), delays of stamps.
        least: (k,), smaller rises are none.
        each: Time from stamp to stamp: a delay is waited for to end for ten times as long.
    """
    excess = np.diff(late, prepend=late[0])
    waited = np.flatnonzero(excess[:-1] > least[:-1])  # the last may be in time later
    rises, size = np.zeros(len(late)), 64
    while len(waited):
        here = waited[(10 * excess[waited] <= (size - 50) * each) | (size > 2 * len(late))]
        ahead = minimum_filter1d(late, size, mode="nearest", origin=-(size // 2))[here]
        before = np.median([late[np.maximum(here - n, 0)] for n in range(1, 6)], axis=0)
        rises[here] = np.minimum(ahead - before, excess[here])
        waited, size = np.setdiff1d(waited, here), 4 * size
    return np.where(rises > least, rises, 0.0)


def _uneven(times: Floats, rows: Floats, ordinary: Mask, jitter: float = 0.1) -> list[Finding]:
    """Whether the step changes along a recording, by 2 % and more than it scatters; or scatters.

    Its mean in five parts is compared with what its ten blocks in each differ by.
    """
    steps = np.diff(times)[ordinary]
    scatter = np.std(steps) / steps.mean() if len(steps) > len(rows) / 2 else 0.0
    text = f"steps scatter by {scatter:.0%} of their mean"
    findings = [Finding("jitter", KEPT, text)] if scatter > jitter else []
    ends = np.linspace(0, len(rows) - 1, 51).astype(np.intp)
    if len(rows) >= len(ends):
        blocks = (np.diff(times[ends]) / np.diff(rows[ends])).reshape(5, 10)
        change = np.ptp(blocks.mean(axis=1)) / blocks.mean()
        error = np.sqrt(blocks.var(axis=1, ddof=1).mean() / 10) / blocks.mean()
        if change > max(0.02, 6 * error):
            text = f"the step between timestamps changes by {change:.0%} along the recording"
            findings.append(Finding("sample rate", REJECTED, f"{text}: split the file"))
    return findings


def _slope(times: Floats, rows: NDArray, lag: int) -> float:
    """Median of the step from row to row over a lag, which few gaps do not change."""
    lag = min(max(lag, 1), len(rows) - 1)
    if lag < 1:
        return 0.0
    each = (times[lag:] - times[:-lag]) / (rows[lag:] - rows[:-lag])
    return float(np.quantile(each, 0.5, method="lower"))


def from_counter(counts: Floats, bits: int) -> Timing:
    """Gaps from a packet counter.

    Args:
        counts: (n,), one a row, each one more than the last; NaN where a row has none.
        bits: It starts anew after ``2**bits``.

    Returns:
        Rows at which it does not go on by one are gaps; there is no rate.
    """
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
    day = [] if unit_s is None else [86_400 / unit_s]
    for period in [2.0**16, 2.0**24, 2.0**32, *day]:
        found = (steps < 0) & (np.abs(steps + period - ordinary) <= ordinary)
        steps = np.where(found, steps + period, steps)
        wraps |= found
    return steps, wraps


def _without_strays(
    stamps: Floats, far: float = 10.0, largest: float = 1e100
) -> tuple[Floats, Rows]:
    """Stamps, NaN where one is so many steps from those beside it, which are near; and where.

    Of these the time is not known, but the samples may be whole.
    """
    stamps = np.where(np.abs(stamps) < largest, stamps, np.nan)
    rows = np.flatnonzero(np.isfinite(stamps))
    before, here, after = (stamps[rows[n : len(rows) - 2 + n]] for n in range(3))
    away = np.maximum(before - here, here - after)
    if not (away > 0).any():  # as most are
        return stamps, rows[:0]
    near = np.maximum(after - before, np.median(after - before) / 2)
    strays = rows[1:-1][(after >= before) & (away > far * near)]
    stamps[strays] = np.nan
    return stamps, strays


def _resolution(stamps: Floats, steps: Floats) -> float:
    """Decimal unit, down to a thousandth of the step, that all stamps are multiples of; or 0."""
    rounded = 4 * np.spacing(np.abs(stamps).max())
    largest = ceil(log10(np.median(steps)) - 1e-6)
    for unit in (10.0**power for power in range(largest, largest - 4, -1)):
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
