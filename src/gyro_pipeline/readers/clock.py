"""Sample rate and gaps, from timestamps and packet counters.

A missing sample makes all later stamps late. A sample that is written late, a stall, a burst and
rounding make only some stamps late. So the lower envelope of ``stamp - row * step``, its minimum
over the following stamps, rises only where samples are missing. In the same way, the upper envelope
falls only where a row is written twice.

This method cannot see losses within the resolution or the scatter of the stamps: single samples if
the clock ticks at the sample rate, a sample among jitter of a third of a step, some samples of a
burst. It cannot see a sample that is replaced by a repeated row, losses so regular that they look
like a slower clock, and losses within the last five stamps. If samples are written twice by a clock
that ticks at the sample rate, all of them count for the rate. A clock whose tick is slightly
shorter than a step, and not a decimal unit, skips a tick at times, which looks like a missing
sample.
"""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from gyro_pipeline.logs import KEPT, REJECTED, REPAIRED, Finding

Rows = NDArray[np.intp]
Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Timing:
    """Sample rate in Hz, the first rows after gaps, and findings, from stamps or a counter.

    ``lost`` (n,) is about how many samples are missing before each row, NaN where time goes back.
    """

    rate_hz: float | None = None
    gap_rows: Rows = field(default_factory=lambda: np.empty(0, np.intp))
    findings: tuple[Finding, ...] = ()
    lost: Floats | None = None


def from_stamps(stamps: Floats, unit_s: float | None, numbers: Rows | None = None) -> Timing:
    """Sample rate and gaps from timestamps.

    Args:
        stamps: (n,), one per row, in any unit; NaN where a row has none.
        unit_s: Seconds per unit; None if unknown, then no rate is measured.
        numbers: (n,), numbers of the rows in the file, for findings; None: from 0.

    Returns:
        Gaps are the first rows after missing samples, and rows at which time goes back. The rate is
        measured between gaps; if it changes along the recording, a finding is REJECTED.
    """
    numbers = np.arange(len(stamps)) if numbers is None else numbers
    rows, strays = _without_strays(stamps)
    steps = np.diff(stamps[rows])
    if len(rows) == len(stamps) > 1 and 5 * np.ptp(steps) + 1e-80 < (step := steps.mean()):
        return Timing(unit_s and 1 / (step * unit_s), findings=_change(stamps, rows))  # most files
    times, wraps, back = _increasing(stamps[rows], unit_s)
    findings = [
        *_at("timestamps", numbers[strays], "a timestamp is far from its neighbours, and ignored"),
        *_at("wrap-around", numbers[rows[wraps]], "the counter of the timestamps wraps around"),
        *_at("time order", numbers[rows[back]], "time goes back", REPAIRED),
    ]
    usual = _step_over(times, rows, len(rows) / 20) if len(rows) > 1 else 0.0
    if not usual > 0:
        text = "timestamps do not advance: the rate is not measured"
        return Timing(None, rows[back], (*findings, Finding("timestamps", KEPT, text)))
    # the last of the rows that share a stamp is on time
    first = np.diff(times, prepend=-np.inf) > usual / 10
    last = np.append(first[1:], True)
    step, losses, even = _fit(times[last], rows[last], stamps[rows])
    gaps = rows[first][losses > 0]
    text = "the timestamp of the previous row, as from a coarse clock, bursts or repeated rows"
    missing = f"samples are missing, about {losses.sum():.0f}"
    findings += [
        *_at("gaps", numbers[gaps], missing, REPAIRED, "before"),
        *_at("timestamps", numbers[rows[~first]], text),
        *_change(even, rows[last]),
    ]
    lost = np.zeros(len(stamps))
    lost[rows[back]], lost[gaps] = np.nan, losses[losses > 0]
    return Timing(unit_s and 1 / (step * unit_s), np.union1d(gaps, rows[back]), (*findings,), lost)


def _fit(
    times: Floats, rows: Rows, stamps: Floats, pause: int = 100
) -> tuple[float, Floats, Floats]:
    """The step between samples, numbers of samples missing before stamps, and times without gaps.

    Args:
        times: (k,), increasing, the different stamps.
        rows: (k,), the last row of each.
        stamps: (n,), all stamps.
        pause: Gaps of at least this many samples need not last a whole number of steps.
    """
    # the mean of the steps near the median: losses make others longer, repeated rows shorter
    slopes = np.diff(times) / np.diff(rows)
    middle = _step_over(times, rows, len(rows) / 20), np.quantile(slopes, 0.5, method="lower")
    usual = max((np.abs(slopes - step) < 0.45 * step for step in middle), key=np.count_nonzero)
    step = float(slopes[usual].mean())
    resolution = _resolution(stamps, np.median(np.diff(times)))
    several = np.diff(rows, prepend=rows[0]) > 1  # rows share a stamp
    for _ in range(4):  # gaps depend on the step, and the step on the gaps
        delays = times - step * rows
        scatter = np.ptp(np.quantile(np.diff(delays), [0.15, 0.85]))
        least = max(step / 2, 1.25 * resolution, 2 * scatter)
        losses = _rises(delays, least, step) / step
        losses = np.where(losses < pause, np.rint(losses), losses)
        repeats = several * np.rint(_rises(-delays, least, step) / step)
        even = times - step * np.cumsum(losses - repeats)
        step = _step_over(even, rows, 0.9 * len(rows)) or step
    return step, losses, even


def _rises(delays: Floats, least: float, step: float, near: int = 50, few: int = 5) -> Floats:
    """Rise of the lower envelope of delays (k,) at each stamp; 0 if it is below ``least``.

    Before a stamp, the envelope is the median of a few delays. After it, it is the least delay of
    near stamps, unless a later stamp has an even lower one, within ten stamps per step of delay.
    """
    jumps = np.diff(delays, prepend=delays[0])
    late = np.flatnonzero(jumps[: len(delays) - few] > least)
    rises = np.zeros(len(delays))
    if len(late):
        far_ends = np.minimum(late + near + 10 * jumps[late] / step, len(delays)).astype(np.intp)
        near_ends = np.minimum(late + near, far_ends - 1)
        before = np.median([delays[np.maximum(late - n, 0)] for n in range(1, few + 1)], axis=0)
        after = _lowest(delays, late, near_ends) - before
        lasting = np.minimum(after, _lowest(delays, near_ends, far_ends) - before) > least
        rises[late] = lasting * np.minimum(after, jumps[late])
    return rises


def _lowest(delays: Floats, starts: Rows, ends: Rows) -> Floats:
    """The least delay in each range from a start to before an end, (k,)."""
    ranges = np.stack([starts, ends], axis=1).ravel()
    return np.minimum.reduceat(np.append(delays, np.inf), ranges)[::2]


def _step_over(times: Floats, rows: Rows, stamps: float) -> float:
    """Median step per row, measured over a number of stamps, so that few gaps do not affect it."""
    lag = max(int(stamps), 1)
    return float(np.median((times[lag:] - times[:-lag]) / (rows[lag:] - rows[:-lag])))


def _resolution(stamps: Floats, step: np.floating) -> float:
    """The decimal unit to which all stamps (n,) are rounded; 0 if below a hundredth of a step."""
    units = 10.0 ** (np.ceil(np.log10(step) - 1e-6) - np.arange(3))[:, None]
    errors = np.abs(stamps - units * np.rint(stamps / units)).max(axis=1)
    return max(units[errors <= 4 * np.spacing(np.abs(stamps).max()), 0], default=0.0)


def _change(times: Floats, rows: Rows, least: float = 0.02) -> tuple[Finding, ...]:
    """A finding if the step between samples changes along times without gaps, (k,).

    The step changes if the means of five parts differ by more than a share ``least`` of the step,
    and by more than the ten blocks of each part explain.
    """
    ends = np.linspace(0, len(rows) - 1, 51).astype(np.intp)
    if len(rows) < len(ends):
        return ()
    blocks = (np.diff(times[ends]) / np.diff(rows[ends])).reshape(5, 10)
    change = np.ptp(blocks.mean(axis=1)) / blocks.mean()
    if (
        change < least
        or change < 6 * np.sqrt(blocks.var(axis=1, ddof=1).mean() / 10) / blocks.mean()
    ):
        return ()
    text = (
        f"the step between timestamps changes by {change:.0%} along the recording: split the file"
    )
    return (Finding("sample rate", REJECTED, text),)


def _increasing(stamps: Floats, unit_s: float | None) -> tuple[Floats, Rows, Rows]:
    """Times since the first stamp, the positions of wrap-arounds, and those of steps back.

    Counters have 16, 24 or 32 bits, or wrap at midnight; unwrapped, the step is an ordinary one.
    """
    steps = np.diff(stamps, prepend=stamps[:1])
    steps[np.abs(steps) <= 4 * np.spacing(np.abs(stamps).max(initial=1e-90))] = 0.0
    back = np.flatnonzero(steps < 0)
    usual = np.median(steps[steps > 0]) if (steps > 0).any() else 0.0
    periods = np.array([2.0**16, 2.0**24, 2.0**32, 86_400 / (unit_s or np.inf)])
    unwrapped = steps[back, None] + periods[periods > 10 * usual]
    ends = np.abs(unwrapped - usual) <= usual
    wraps = ends.any(axis=1)
    steps[back] = np.where(wraps, np.max(unwrapped * ends, axis=1, initial=0.0), usual)
    return np.cumsum(steps), back[wraps], back[~wraps]


def _without_strays(stamps: Floats, far: float = 10.0, largest: float = 1e100) -> tuple[Rows, Rows]:
    """Rows with a valid stamp, and rows whose stamp is far from two neighbours that agree.

    The time of the latter is unknown, but their samples may be valid. Infinity is not a stamp.
    """
    rows = np.flatnonzero(np.abs(stamps) < largest)
    if len(rows) < 3 or (np.diff(stamps[rows]) >= 0).all():  # noqa: PLR2004
        return rows, rows[:0]
    before, here, after = (stamps[rows[n : len(rows) - 2 + n]] for n in range(3))
    away = np.maximum(before - here, here - after)
    near = np.maximum(after - before, np.median(after - before) / 2)
    strays = rows[1:-1][(after >= before) & (away > far * near)]
    return np.setdiff1d(rows, strays), strays


def from_counter(counts: Floats, bits: int) -> Timing:
    """Gaps from a packet counter.

    Args:
        counts: (n,), one per row, increasing by 1; NaN where a row has none.
        bits: Width of the counter, which wraps at ``2**bits``.

    Returns:
        Gaps are the rows at which the counter does not increase by 1; no rate is measured.
    """
    rows, _ = _without_strays(counts)
    skips = rows[1:][np.mod(np.diff(counts[rows] - rows), 2.0**bits) != 0]
    text = "the packet counter does not increase by 1"
    return Timing(gap_rows=skips, findings=(*_at("packet counter", skips, text, REPAIRED),))


def _at(
    check: str, rows: Rows, text: str, outcome: str = KEPT, preposition: str = "at"
) -> list[Finding]:
    """A finding with the number of rows and the first three; none without rows."""
    if not len(rows):
        return []
    first = ", ".join(map(str, rows[:3])) + (", …" if len(rows[3:]) else "")
    count = (
        f"once, {preposition} row" if len(rows) == 1 else f"{len(rows)} times, {preposition} rows"
    )
    return [Finding(check, outcome, f"{text}: {count} {first}")]
