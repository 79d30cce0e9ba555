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
    step, losses, regularity = _follow(times[last], rows[last].astype(float), stamps[rows])
    gaps = rows[first][losses > 0]
    findings += _at("gaps", gaps, f"samples are missing, about {losses.sum():.0f}", REPAIRED)
    if len(rows) > 1.5 * first.sum():
        text = "timestamps are coarse or come in bursts: the rate is the count over the duration"
        findings.append(Finding("timestamps", KEPT, text))
    else:
        findings += _at("duplicated timestamps", repeats, "a timestamp repeats")
    rate_hz = None if unit_s is None else 1 / (step * unit_s)
    return Timing(rate_hz, np.union1d(gaps, back), (*findings, *regularity))


def _follow(
    times: Floats, rows: Floats, stamps: Floats, pause: int = 100
) -> tuple[float, Floats, list[Finding]]:
    """The step from sample to sample, how many are missing before each of k stamps, and findings.

    Args:
        times: (k,), of the stamps that differ.
        rows: (k,), the last row with each.
        stamps: (n,), as written.
        pause: A gap of so many samples need not last a whole number of steps.
    """
    # the step tells the gaps, and these the step
    step, lag = _usual_step(times, rows)
    tick = _tick(times, rows, step, _resolution(stamps, np.diff(times)))
    if tick:
        step = _slope(times, rows, min(200, len(rows) // 10))
    else:
        rows = _without_doubled(times, rows, step)
    losses = np.zeros(len(rows))
    for _ in range(4):
        delays = times - step * rows
        scatter = np.ptp(np.quantile(delays[lag:] - delays[:-lag], [0.2, 0.8]))
        least = max(step / 2, 1.4 * scatter, 1.25 * tick)
        # at the end, too few stamps follow to show whether all are late
        at_the_end = 2 * scatter / np.arange(len(delays), 0, -1)
        losses = _rises(delays, least + at_the_end, step * np.diff(rows).mean()) / step
        losses = np.where(losses < pause, np.rint(losses), losses)
        step = _slope(times - step * np.cumsum(losses), rows, 9 * len(rows) // 10) or step
    ordinary = (losses[1:] == 0) & (np.diff(rows) == 1)
    return step, losses, _uneven(times - step * np.cumsum(losses), rows, ordinary)


def _usual_step(times: Floats, rows: Floats) -> tuple[float, int]:
    """The step from row to row, and over how many stamps it is told.

    These are as few as let it scatter by less than a quarter: one, but for bursts, rounded stamps
    and steps at random. Over one stamp, it is the mean without the steps that are far longer.
    """
    lag = 1
    while True:
        slopes = (times[lag:] - times[:-lag]) / (rows[lag:] - rows[:-lag])
        low, step, high = np.quantile(slopes, [0.2, 0.5, 0.8], method="lower")
        if high - low <= step / 4 or 4 * lag > len(times):
            break
        lag *= 2
    if lag == 1:
        alike = np.abs(slopes - step) < step / 2
        step = np.average(slopes[alike], weights=np.diff(rows)[alike])
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
    delays, least = steps - step * np.diff(rows), min(tick, step) / 4
    short, long = np.sum(delays < -least), np.sum((delays > least) & (delays < 1.5 * tick))
    if short + long < few:
        return resolution
    lag = max(min(ceil(5 * len(steps) / (short + long)), len(steps) // 4), 1)
    durations = times[lag:] - times[:-lag]
    durations -= _slope(times, rows, min(200, len(rows) // 10)) * (rows[lag:] - rows[:-lag])
    regular = np.ptp(np.quantile(durations, [0.1, 0.9])) <= 2.5 * max(tick, step)
    return tick if regular or min(short, long) > 0.1 * (short + long) else 0.0


def _without_doubled(times: Floats, rows: Floats, step: float) -> Floats:
    """Numbers of rows (k,) that do not count doubled ones, behind which all stamps are early."""
    delays = np.pad(times - step * rows, 5, mode="edge")
    medians = np.median(np.lib.stride_tricks.sliding_window_view(delays, 5), axis=1)
    counts, steps = np.diff(rows), np.diff(times)
    early = medians[6 : len(rows) + 5] - medians[1 : len(rows)] < -step / 2
    doubles = (counts > 1) & (np.abs(steps - step) < step / 2) & early
    return np.cumsum(np.r_[rows[0], np.where(doubles, 1.0, counts)])


def _rises(delays: Floats, least: Floats, interval: float) -> Floats:
    """How far the least of a stamp's delay and those that follow is above those before it, (k,).

    Args:
        delays: (k,), delays of stamps.
        least: (k,), smaller rises are 0.
        interval: Time from stamp to stamp; a delay may take ten times as long to end.
    """
    excess = np.diff(delays, prepend=delays[0])
    rows = np.flatnonzero(excess[:-1] > least[:-1])  # behind the last, nothing shows it
    rises, size = np.zeros(len(delays)), 64
    while len(rows):
        chosen = rows[(10 * excess[rows] <= (size - 50) * interval) | (size > 2 * len(delays))]
        ahead = minimum_filter1d(delays, size, mode="nearest", origin=-(size // 2))[chosen]
        before = np.median([delays[np.maximum(chosen - n, 0)] for n in range(1, 6)], axis=0)
        rises[chosen] = np.minimum(ahead - before, excess[chosen])
        rows, size = np.setdiff1d(rows, chosen), 4 * size
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
    slopes = (times[lag:] - times[:-lag]) / (rows[lag:] - rows[:-lag])
    return float(np.quantile(slopes, 0.5, method="lower"))


def from_counter(counts: Floats, bits: int) -> Timing:
    """Gaps from a packet counter.

    Args:
        counts: (n,), one a row, each one more than the last; NaN where a row has none.
        bits: It starts anew after ``2**bits``.

    Returns:
        Rows at which it does not go on by one are gaps; there is no rate.
    """
    counts, strays = _without_strays(counts)
    numbered = np.flatnonzero(np.isfinite(counts))
    rows, steps = numbered[1:], np.diff(counts[numbered])
    skips = np.mod(steps - np.diff(numbered), 2.0**bits) != 0
    wraps = ~skips & (steps < 0)
    text = "the packet counter does not go on by one"
    return Timing(
        gap_rows=rows[skips],
        findings=(
            *_at("packet counter", strays, "a number is far from those beside it, and ignored"),
            *_at("wrap-around", rows[wraps], f"the {bits}-bit packet counter starts anew"),
            *_at("packet counter", rows[skips], text, REPAIRED),
        ),
    )


def check_rate(rate_hz: float, expected_hz: float, tolerance_pct: float) -> tuple[Finding, ...]:
    """Compare a measured sample rate with the expected one; beyond the tolerance: REJECTED."""
    ratio = rate_hz / expected_hz
    powers = [n for n in (0, -6, -3, 3, 6) if abs(ratio / 10.0**n - 1) <= tolerance_pct / 100]
    if 0 in powers:
        return ()
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
    ordinary = np.median(steps[steps > 0]) if (steps > 0).any() else 0.0
    day = [] if unit_s is None else [86_400 / unit_s]
    for period in [2.0**16, 2.0**24, 2.0**32, *day]:
        ends = (steps < 0) & (np.abs(steps + period - ordinary) <= ordinary)
        steps = np.where(ends, steps + period, steps)
        wraps |= ends
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


def _at(check: str, rows: Rows, text: str, outcome: str = KEPT) -> list[Finding]:
    """How often something is so, and where first; no finding if it never is."""
    if not len(rows):
        return []
    listed = ", ".join(map(str, rows[:3])) + (", …" if len(rows) > len(rows[:3]) else "")
    count = "once, at row" if len(rows) == 1 else f"{len(rows)} times, at rows"
    cut = ", cut there" if outcome == REPAIRED else ""
    return [Finding(check, outcome, f"{text}: {count} {listed}{cut}")]
