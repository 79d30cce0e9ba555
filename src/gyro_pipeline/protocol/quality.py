"""Quality control of one recording: what is kept of it, what is cut, and what it is rejected for.

| check | what is found | how it ends |
|---|---|---|
| zero rows | first or last rows that are zero on every axis: the logger's start | cut, and kept |
| non-finite values | NaN, infinity, or too large a number for any sensor or counter | repaired |
| dropouts | a row beside a non-finite one, or of zeros, that is beyond the noise | repaired |
| stuck values | an axis that repeats a value for longer than chance allows | repaired |
| saturation | the largest or smallest value recurs as no tail of noise does | repaired |
| gaps, time order, packet counter | samples missing, or out of order (by the reader) | repaired |
| too short | what remains is too short, or too little of the recording | rejected |
| coarse quantisation | a step beside the noise; one too large to trust the mean | kept; rejected |
| noise level | more noise than a gyroscope at rest has | rejected |
| repeated rows | rows are there twice or more: written so, or read faster than measured | kept |
| equal axes | two axes have the same values: one column taken twice | rejected |
| alternating rows | every other row is at another level: two sensors in one file | rejected |
| spikes | values far out in most blocks, where these are the noise | rejected |
| motion | the rate, or the noise, changes as neither noise nor a drift does | rejected |
| shocks | a rate beyond the noise for an instant | repaired |
| warm-up drift | the bias settles after power-on | kept |

*Repaired* means that those rows go and the longest stretch without any such row or gap is kept;
where that is too short, the finding *too short* rejects the recording. A recording ends as its
worst finding does. A constant axis, and a log of zeros, leave no stretch.

Motion rejects all of a recording: rates alone do not tell which part was at rest, and after a turn
the Earth's rate falls differently on the axes. What cannot be seen at all is a rotation that is as
steady as a bias, from the first sample to the last.

Thresholds are multiples of the recording's own noise, so neither a bias nor a scale factor changes
how it ends. The exceptions are zeros, and the largest noise and drift of a sensor at rest.
"""

from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray
from scipy import special

from gyro_pipeline.conventions import AXES, MDPS, InputError
from gyro_pipeline.logs import KEPT, REJECTED, REPAIRED, Finding, Log
from gyro_pipeline.parameters import LEAST_BLOCKS, Quality
from gyro_pipeline.physics import damage, stationarity

_NO_NUMBER = 1e12
"""Garbage bytes read as a number can be as large as 1e308, which overflows when it is squared."""

_NOISE_RISE = 2
"""Of a block over the recording, for motion. At rest it is below 1.4 on the public files, whose
noise is partly coloured; in white noise 2 has a probability of 4e-6 per recording even at 7 samples
per block, and far less with more."""

_NOISE_RANGE = 1.7
"""The same of a few seconds over that of others, which is known better. At rest it is below 1.2 on
the public files, and below 1.5 behind a low-pass filter of 5 Hz."""

_WANDER, _SMOOTH = 5, 0.05
"""Scatter of block means about a drift, over their noise from one to the next; flicker noise has at
most 3, however strong it is. And over the largest drift: smooth ones need not be exponentials."""

_KURTOSIS = 6
"""Of Gaussian noise it is 3, and so it is on the public files; of rare large values far more."""

_SWAY = 1
"""Scatter of block means over that of samples within a block, for motion throughout. At rest it is
at most 0.2 on the public files, and 0.7 behind a low-pass filter of 5 Hz; of a sensor that is
carried about (benchmarks/quality.py), 1.4 to 2.1."""

_COLOUR, _FILTERED = 8, 0.5
"""The same over what white noise has, of samples that scatter from one to the next by more than the
second factor of white noise: behind a low-pass filter they do not. At rest it is 0.7 to 1.2 on the
public files; of a sensor that is carried about, 13 to 29."""

_LEAST_BLOCK = 5
"""Samples. The noise of shorter blocks is known too badly for a median of them."""

_REPEATED = 0.05
"""Share of rows that repeat the one before, beyond chance. A packet sent twice now and then harms
nothing."""

_TURNS = 0.5
"""Between even and odd rows, over the noise. At most 0.07 on the public files."""


@dataclass(frozen=True)
class Inspected:
    """What quality control says about a recording.

    Attributes:
        outcome: KEPT, REPAIRED or REJECTED, the worst that a finding ends in.
        start: First row of the longest usable stretch, 0-based.
        stop: The row after its last; equal to ``start`` if there is none.
        findings: Of the reading, then of the checks.
    """

    outcome: str
    start: int
    stop: int
    findings: tuple[Finding, ...]

    @property
    def masked(self) -> NDArray[np.bool_]:
        """Rows between them that hold no measurement; none."""
        return np.zeros(self.stop - self.start, np.bool_)


def inspect(log: Log, rate_hz: float, quality: Quality) -> Inspected:
    """Find what is wrong with a recording, and the longest stretch of it that can be used.

    The checks of values come first. Those of noise, motion, shocks and drift look at the longest
    stretch that these leave.

    Args:
        log: One recording.
        rate_hz: Samples per second.
        quality: Lengths and the false-alarm probability.

    Raises:
        InputError: If the samples are not three columns.
    """
    if log.samples.ndim != 2 or log.samples.shape[1] != len(AXES):  # noqa: PLR2004 - a table
        raise InputError(
            f"expected samples of {len(AXES)} axes, (n, {len(AXES)}), got shape {log.samples.shape}"
        )
    rates = np.ascontiguousarray(log.samples.T, dtype=np.float64)  # an axis at a time is 20x faster
    usable, findings = _check_values(rates, rate_hz, quality)
    start, stop = damage.longest_stretch(usable, log.gap_rows)
    findings += _check_length(start, stop, usable.size, rate_hz, quality)
    if not _rejects(findings):
        at_rest, more = _check_rest(rates[:, start:stop], start, rate_hz, quality)
        findings += more
        if not at_rest.all():
            first, last = damage.longest_stretch(at_rest, np.empty(0, np.intp))
            start, stop = start + first, start + last
            findings += _check_length(start, stop, usable.size, rate_hz, quality)
    every = (*log.findings, *findings)
    return Inspected(_worst(every), start, stop, every)


def _worst(findings: tuple[Finding, ...]) -> str:
    """The outcome that decides."""
    return max((f.outcome for f in findings), key=(KEPT, REPAIRED, REJECTED).index, default=KEPT)


def _rejects(findings: list[Finding]) -> bool:
    return any(finding.outcome == REJECTED for finding in findings)


def _check_values(
    rates: NDArray[np.float64], rate_hz: float, quality: Quality
) -> tuple[NDArray[np.bool_], list[Finding]]:
    """Which rows hold what was measured, (n,), and what the others hold."""
    first, last = damage.rows_between_zeros(rates)
    usable = np.zeros(rates.shape[1], bool)
    usable[first:last] = True
    findings = []
    if not usable.all():
        findings.append(Finding("zero rows", KEPT, f"{_rows(np.flatnonzero(~usable))}, cut"))
    for check, samples in _damaged(rates[:, first:last], rate_hz, quality).items():
        rows = samples.any(axis=0)
        if rows.any():
            where = f"{_axes(samples)}{_rows(first + np.flatnonzero(rows))}"
            findings.append(Finding(check, REPAIRED, f"{where}, cut"))
            usable[first:last] &= ~rows
    return usable, findings


def _damaged(
    rates: NDArray[np.float64], rate_hz: float, quality: Quality
) -> dict[str, NDArray[np.bool_]]:
    """Samples to cut, (axis, n) or (1, n), by what is wrong with them."""
    if not rates.size:
        return {}
    finite = np.abs(rates) < _NO_NUMBER  # neither NaN nor infinity is
    if not finite.all():
        rates = np.where(finite, rates, np.nan)
    least = max(round(quality.stuck_s * rate_hz), 2)
    return {
        "non-finite values": ~finite,
        "dropouts": damage.dropouts(rates, quality.false_alarm)[None],
        "stuck values": damage.stuck(rates, least, quality.false_alarm),
        "saturation": damage.saturated(rates),
    }


def _check_length(
    start: int, stop: int, rows: int, rate_hz: float, quality: Quality
) -> list[Finding]:
    """Whether a stretch of a log of so many rows is worth keeping."""
    for_blocks = LEAST_BLOCKS * _block_size(rate_hz, quality)
    share = quality.least_share if quality.length_s is None else 0.0
    needed = max(quality.least_s * rate_hz, share * rows, for_blocks)
    if stop - start >= needed:
        return []
    detail = (
        f"the longest usable stretch is {stop - start} of {rows} rows, "
        f"{(stop - start) / rate_hz:.4g} s; expected at least {needed / rate_hz:.4g} s "
        f"(quality.least_s, quality.least_share)"
    )
    return [Finding("too short", REJECTED, detail)]


def _block_size(rate_hz: float, quality: Quality) -> int:
    return max(round(quality.block_s * rate_hz), _LEAST_BLOCK)


def _check_rest(
    rates: NDArray[np.float64], first_row: int, rate_hz: float, quality: Quality
) -> tuple[NDArray[np.bool_], list[Finding]]:
    """Which rows of a stretch the gyroscope was at rest in, (n,), and what else its noise says."""
    at_rest = np.ones(rates.shape[1], bool)
    blocks = stationarity.Blocks.of(rates, _block_size(rate_hz, quality))
    findings = [
        *_check_steps(rates, blocks, quality),
        *_check_noise(blocks, quality),
        *_check_turns(blocks, quality),
        *_check_copies(rates),
    ]
    if _rejects(findings):
        return at_rest, findings
    rows = stationarity.excursions(blocks, quality.false_alarm)
    bursts = stationarity.bursts(rows, blocks.size)
    means = stationarity.Means.of(blocks, blocks.apart_from(bursts))
    findings += _check_tails(blocks, means)
    moved = _movements(blocks, means, bursts, first_row, rate_hz, quality)
    if moved:
        return at_rest, [*findings, Finding("motion", REJECTED, "; ".join(moved))]
    for first, last in bursts:  # and a block on either side, where it may still ring
        at_rest[max(first - blocks.size, 0) : last + 1 + blocks.size] = False
    if len(bursts):
        findings.append(_shocks(rates, rows, bursts, first_row))
    return at_rest, findings + _check_drift(means, rates.shape[1] / rate_hz, quality)


def _check_steps(
    rates: NDArray[np.float64], blocks: stationarity.Blocks, quality: Quality
) -> list[Finding]:
    """The coarsest axis, if its step is not small beside the noise."""
    steps = damage.quantisation_steps(rates)
    # rounding to a step adds step^2 / 12 to the variance (Sheppard)
    noise = np.sqrt(np.maximum(blocks.noise**2 - steps**2 / 12, 0))
    coarse = np.flatnonzero(steps > quality.coarse_step * noise)
    if not coarse.size:
        return []
    axis = coarse[np.argmax(steps[coarse] - quality.largest_step * noise[coarse])]
    detail = (
        f"axis {AXES[axis]} has a step of {steps[axis] / MDPS:.4g} mdps beside a noise of "
        f"{noise[axis] / MDPS:.4g} mdps"
    )
    if steps[axis] <= quality.largest_step * noise[axis]:
        return [Finding("coarse quantisation", KEPT, detail)]
    detail += f"; its mean can be trusted up to {quality.largest_step:g} times the noise"
    return [Finding("coarse quantisation", REJECTED, detail)]


def _check_noise(blocks: stationarity.Blocks, quality: Quality) -> list[Finding]:
    axis = int(np.argmax(blocks.noise))
    if blocks.noise[axis] <= quality.largest_noise_dps:
        return []
    detail = (
        f"axis {AXES[axis]} has a noise of {blocks.noise[axis]:.3g} deg/s; expected at most "
        f"{quality.largest_noise_dps:g} of a gyroscope at rest (check the unit; "
        "quality.largest_noise_dps)"
    )
    return [Finding("noise level", REJECTED, detail)]


def _check_turns(blocks: stationarity.Blocks, quality: Quality) -> list[Finding]:
    """Whether rows take turns between two levels, in most blocks: a shock is in few."""
    means = blocks.rates[..., ::2].mean(axis=-1), blocks.rates[..., 1::2].mean(axis=-1)
    signs = 1 - 2 * (blocks.starts % 2)  # a block may begin with an odd row
    apart = np.abs(np.median(signs * (means[0] - means[1]), axis=-1))
    axes, count, size = blocks.rates.shape
    # a median scatters sqrt(pi / 2) times as much as a mean
    spread = 2 / np.sqrt(count * size) * np.sqrt(np.pi / 2)
    chance = -special.ndtri(quality.false_alarm / (2 * axes)) * spread
    axis = int(np.argmax(apart / blocks.noise))
    if apart[axis] <= max(_TURNS, chance) * blocks.noise[axis]:
        return []
    detail = (
        f"every other row is {apart[axis]:.3g} deg/s off, axis {AXES[axis]}: two sensors in one "
        "file? Split it"
    )
    return [Finding("alternating rows", REJECTED, detail)]


def _check_copies(rates: NDArray[np.float64]) -> list[Finding]:
    """Whether rows or axes are there more than once."""
    for one, other in combinations(range(len(AXES)), 2):
        if np.array_equal(rates[one], rates[other]):
            detail = f"axes {AXES[one]} and {AXES[other]} have the same values: correct the columns"
            return [Finding("equal axes", REJECTED, detail)]
    share = damage.repeated_rows(rates)
    if share <= _REPEATED:
        return []
    detail = f"{share:.0%} of the rows repeat the one before: doubled, or read faster than measured"
    return [Finding("repeated rows", KEPT, detail)]


def _check_tails(blocks: stationarity.Blocks, means: stationarity.Means) -> list[Finding]:
    """Values so often far out that they pass for the noise."""
    if not means.calm.any():
        return []
    kurtosis = blocks.kurtosis(means.calm)
    axis = int(np.argmax(kurtosis))
    if kurtosis[axis] <= _KURTOSIS:
        return []
    detail = (
        f"the noise of axis {AXES[axis]} has a kurtosis of {kurtosis[axis]:.2g}; Gaussian has 3"
    )
    return [Finding("spikes", REJECTED, detail)]


def _movements(  # noqa: PLR0917 - a stretch, what was found in it, and where it is
    blocks: stationarity.Blocks,
    means: stationarity.Means,
    bursts: NDArray[np.integer],
    first_row: int,
    rate_hz: float,
    quality: Quality,
) -> list[str]:
    """What shows that the gyroscope moved; nothing at rest."""
    found = []
    long = bursts[np.diff(bursts)[:, 0] >= quality.shock_s * rate_hz]
    if len(long):
        found.append(f"the rate is beyond the noise {_span(first_row + long[0], rate_hz)}")
    scatter = means.noise / blocks.noise
    if scatter.max() > _SWAY or _sways(blocks):
        axis = int(np.argmax(scatter))
        found.append(f"means scatter {scatter[axis]:.2g} times the noise, axis {AXES[axis]}")
    lags = [max(round(lag_s / quality.block_s), 1) for lag_s in quality.lags_s]
    changed = stationarity.changes(means, lags, quality.false_alarm)
    least = np.maximum(_WANDER * means.noise, _SMOOTH * quality.largest_drift_dps)
    wanders = means.spread > least
    if changed.any() or wanders.any():  # a warm-up does so as well
        settled = means.without(stationarity.settling(means))
        changed = stationarity.changes(settled, lags, quality.false_alarm)
        drift = stationarity.settling(means, line=True)
        too_far = np.ptp(drift[:, means.calm], axis=1) > quality.largest_drift_dps
        wanders = (means.without(drift).spread > least) | too_far
        sizes = np.ptp(means.rates[:, means.calm], axis=1)
    if changed.any():
        axis = int(np.argmax(sizes / means.noise))
        about = _span(first_row + blocks.span(changed), rate_hz)
        found.append(f"the rate changes by {sizes[axis]:.2g} deg/s, axis {AXES[axis]}, {about}")
    elif wanders.any():
        axis = int(np.argmax(wanders * sizes / means.noise))
        found.append(f"the rate wanders by {sizes[axis]:.2g} deg/s, axis {AXES[axis]}")
    noisy = means.calm & (blocks.relative_variances > _NOISE_RISE**2)
    noise_range = blocks.noise_range(means.calm, max(lags))
    if noisy.any():
        found.append(f"the noise rises {_span(first_row + blocks.span(noisy), rate_hz)}")
    elif noise_range > _NOISE_RANGE:
        found.append(f"the noise changes {noise_range:.2g}-fold")
    return found


def _sways(blocks: stationarity.Blocks) -> bool:
    """Whether means scatter far more than those of noise that is white from sample to sample."""
    if len(blocks.starts) < LEAST_BLOCKS:
        return False
    # of second differences, which leave a drift out: their median is 0.6745 sqrt(6) s
    bends = np.median(np.abs(np.diff(blocks.means, 2, axis=1)), axis=1)
    scatter = bends / (special.ndtri(0.75) * np.sqrt(6)) / (blocks.noise / np.sqrt(blocks.size))
    suspect = scatter > _COLOUR
    if not suspect.any():
        return False
    apart = np.median(np.diff(blocks.rates[suspect], axis=-1).std(axis=-1), axis=-1) / np.sqrt(2)
    return bool((apart > _FILTERED * blocks.noise[suspect]).any())


def _shocks(
    rates: NDArray[np.float64],
    rows: NDArray[np.integer],
    bursts: NDArray[np.integer],
    first_row: int,
) -> Finding:
    """Rows beyond the noise in bursts too short for a movement."""
    peaks = np.abs(rates[:, rows] - np.median(rates, axis=1, keepdims=True)).max(axis=1)
    axis = int(np.argmax(peaks))
    times = f" in {len(bursts)} bursts" if len(bursts) > 1 else ""
    detail = (
        f"up to {peaks[axis]:.3g} deg/s from the median, axis {AXES[axis]}, "
        f"{_rows(first_row + rows)}{times}, cut with what is about them"
    )
    return Finding("shocks", REPAIRED, detail)


def _check_drift(means: stationarity.Means, duration_s: float, quality: Quality) -> list[Finding]:
    if np.count_nonzero(means.calm) < LEAST_BLOCKS:
        return []
    least_dps = quality.drift_mdps * MDPS
    drifts = stationarity.drifts(means, duration_s, quality.false_alarm, least_dps)
    details = [
        f"axis {AXES[one.axis]} by {one.size_dps / MDPS:+.3g} mdps"
        f" (time constant about {one.time_constant_s:.3g} s)"
        for one in drifts
    ]
    return [Finding("warm-up drift", KEPT, ", ".join(details))] if details else []


def _axes(samples: NDArray[np.bool_]) -> str:
    """Which axes a mask of (axis, n) names; nothing where it is of whole rows."""
    if len(samples) != len(AXES):
        return ""
    names = [AXES[axis] for axis in np.flatnonzero(samples.any(axis=1))]
    return f"{'axis' if len(names) == 1 else 'axes'} {', '.join(names)}, "


def _rows(rows: NDArray[np.integer]) -> str:
    """Increasing rows, for a person."""
    if len(rows) == 1:
        return f"row {rows[0]}"
    if rows[-1] - rows[0] == len(rows) - 1:
        return f"rows {rows[0]} to {rows[-1]}"
    return f"{len(rows)} rows from {rows[0]} to {rows[-1]}"


def _span(rows: NDArray[np.integer], rate_hz: float) -> str:
    """First and last row, for a person."""
    return (
        f"from row {rows[0]} to {rows[-1]} ({rows[0] / rate_hz:.4g} to {rows[-1] / rate_hz:.4g} s)"
    )
