"""Quality control of one recording: was it at rest, and which of its rows hold a measurement?

One principle: a smooth drift is fitted to the means of blocks; what is left of a gyroscope at rest
neither changes its mean nor gets noisier (:mod:`.rest`). What is brief is masked and does not end
the recording; a gap in time does. Limits know how many samples or blocks are compared with them.

| check | what | how it ends |
|---|---|---|
| zero rows | first or last rows, zero on every axis | cut, kept |
| gaps | the longest stretch between two is the recording | repaired |
| non-finite, stuck values | no numbers; an axis that holds a value too long | masked, repaired |
| spikes, shocks | rows beyond the noise; bursts with a block about | masked, repaired |
| start | a burst in the first rows, or what settles within two blocks | cut, repaired |
| motion | a changed mean, raised noise, a burst too long, a drift too large | rejected |
| bias taken off | a level that goes to zero on all axes | rejected |
| warm-up, drift | the bias settles; or does not within the recording | kept |
| too short | too few rows, or too small a share of the stretch, can be used | rejected |
| others | values that no gyroscope at rest gives (:mod:`.values`) | kept or rejected |

Motion rejects all of a recording: rates alone do not tell which part was at rest, and after a turn
the Earth's rate falls differently on the axes. A rotation as steady as a bias cannot be seen.
"""

from dataclasses import dataclass

import numpy as np

from gyro_pipeline.conventions import AXES, MDPS, InputError
from gyro_pipeline.logs import KEPT, REJECTED, REPAIRED, Finding, Log
from gyro_pipeline.parameters import LEAST_BLOCKS, Quality
from gyro_pipeline.quality import values
from gyro_pipeline.quality.blocks import (
    Array,
    Blocks,
    Mask,
    cut_blocks,
    excursions,
    fill,
    longest_stretch,
    runs,
    stuck,
)
from gyro_pipeline.quality.drift import fit_drift, goes_to_zero, time_constant
from gyro_pipeline.quality.rest import RestDetector

LARGEST_NUMBER = 1e12
"""Garbage bytes read as a number can be as large as 1e308, which overflows when it is squared."""

LEAST_BLOCK = 5
"""Samples. The noise of shorter blocks is known too badly for a median of them."""


@dataclass(frozen=True)
class Inspected:
    """What quality control says about a recording.

    Attributes:
        outcome: KEPT, REPAIRED or REJECTED, the worst that a finding ends in.
        start: First row of the log that makes the recording, 0-based.
        stop: The row after its last; equal to ``start`` if there is none.
        masked: (stop - start,), rows in it that hold no measurement.
        findings: Of the reading, then of the checks.
    """

    outcome: str
    start: int
    stop: int
    masked: Mask
    findings: tuple[Finding, ...]


def inspect(log: Log, rate_hz: float, quality: Quality) -> Inspected:
    """Judge a recording, and say which of its rows can be used.

    Args:
        log: One recording.
        rate_hz: Samples per second.
        quality: Lengths, limits and the false-alarm probability.

    Raises:
        InputError: If the samples are not three columns.
    """
    if log.samples.ndim != 2 or log.samples.shape[1] != len(AXES):  # noqa: PLR2004 - a table
        raise InputError(
            f"expected samples of {len(AXES)} axes, (n, {len(AXES)}), got shape {log.samples.shape}"
        )
    rates = np.ascontiguousarray(log.samples.T, dtype=np.float64)  # an axis at a time is 20x faster
    recording = _Recording(rates, log, rate_hz, quality)
    checks = (
        recording.mask_values,
        recording.check_length,
        recording.check_values,
        recording.mask_bursts,
        recording.check_length,
        recording.check_noise,
        recording.check_rest,
    )
    findings = list(log.findings)
    for check in checks:
        findings += check()
        if any(finding.outcome == REJECTED for finding in findings):
            break
    used = np.flatnonzero(~recording.masked)  # what is masked at the ends is cut
    first, last = (int(used[0]), int(used[-1]) + 1) if used.size else (0, 0)
    outcome = max((f.outcome for f in findings), key=(KEPT, REPAIRED, REJECTED).index, default=KEPT)
    rows = recording.start + first, recording.start + last
    return Inspected(outcome, *rows, recording.masked[first:last], tuple(findings))


class _Recording:
    """The rows of a log that are being judged: checks mask some and return their findings."""

    def __init__(self, rates: Array, log: Log, rate_hz: float, quality: Quality) -> None:
        self.rates, self.masked = rates, np.zeros(rates.shape[1], bool)
        self.start, self.total, self.log = 0, rates.shape[1], log
        self.cut: Mask | None = None  # what was masked when blocks were cut
        self.rate_hz, self.quality = rate_hz, quality
        self.size = max(round(quality.block_s * rate_hz), LEAST_BLOCK)

    def mask_values(self) -> list[Finding]:
        """Rows of no measurement: zeros at the ends, no numbers, values held; gaps, lastly."""
        zeros, all_so_far = ~np.any(self.rates, axis=0), np.logical_and.accumulate
        zeros = all_so_far(zeros) | all_so_far(zeros[::-1])[::-1]
        finite = np.abs(self.rates) < LARGEST_NUMBER  # neither NaN nor infinity is
        least = max(round(self.quality.stuck_s * self.rate_hz), 2)
        held = stuck(self.rates, least, self.quality.false_alarm) & finite
        findings = self._mask("zero rows", zeros, "", KEPT)
        for check, samples in (("non-finite values", ~finite), ("stuck values", held)):
            rows = samples.any(axis=0) & ~self.masked
            axes = ", ".join(np.array(AXES)[samples[:, rows].any(axis=1)])
            findings += self._mask(check, rows, f"{'axes' if ',' in axes else 'axis'} {axes}, ")
        start, stop = longest_stretch(self.masked, self.log.gap_rows)
        self.rates, self.masked = self.rates[:, start:stop], self.masked[start:stop]
        self.start = start
        if self.log.gap_rows.size and start < stop:
            detail = f"rows {start} to {stop - 1}, of {self.total}, are the longest stretch"
            findings.append(Finding("gaps", REPAIRED, detail))
        return findings

    def check_length(self) -> list[Finding]:
        """Whether enough rows can be used, and enough of all between two gaps."""
        used, q = int(np.count_nonzero(~self.masked)), self.quality
        least = max(q.least_s * self.rate_hz, LEAST_BLOCKS * self.size)
        if used >= max(least, q.least_share * self.masked.size):
            if self.cut is self.masked:  # nothing was masked since
                return []
            self.cut, self.used = self.masked, self.rates
            self.rates = fill(self.rates, self.masked)
            self.blocks = cut_blocks(self.rates, self.masked, self.size)
            if used < self.masked.size:
                self.used = self.rates.compress(~self.masked, axis=1)
            if self.blocks.starts.size >= LEAST_BLOCKS:
                return []
        detail = (
            f"{used} of {self.total} rows can be used, {used / self.rate_hz:.4g} s; expected at "
            f"least {least / self.rate_hz:.4g} s (quality.least_s) and {q.least_share:.0%} of the "
            "rows between two gaps (quality.least_share)"
        )
        return [Finding("too short", REJECTED, detail)]

    def check_values(self) -> list[Finding]:
        """What the values say by themselves, as they are."""
        rates, sigma = self.used, self.blocks.sigma
        steps = values.check_steps(rates, sigma, self.quality.largest_step)
        turns = values.check_turns(rates, sigma)
        return values.check_axes(rates) + values.check_repeats(rates) + turns + steps

    def mask_bursts(self, few: int = 3) -> list[Finding]:
        """Spikes of fewer than ``few`` rows; shocks, with a block about where it may still ring."""
        beyond = excursions(self.rates, self.blocks, self.quality.false_alarm)
        spikes, about, start, self.moved = np.zeros((4, beyond.size), bool)
        for first, last in runs(beyond):
            if last - first < few:
                spikes[first:last] = True
            else:
                about[max(first - self.size, 0) : last + self.size] = True
        if about.mean() > 1 - self.quality.least_share:  # knocks throughout are a motion
            self.moved, about = about, self.moved
        for first, last in runs(about):
            if last - first >= self.quality.shock_s * self.rate_hz + 2 * self.size:
                self.moved[first:last], about[first:last] = True, False
            elif first == 0:
                start[:last], about[:last] = True, False
        findings = []
        level = np.median(self.blocks.means, axis=1, keepdims=True)
        for check, rows in (("start", start), ("shocks", about), ("spikes", spikes)):
            if rows.any():
                far = np.abs(self.rates[:, rows] - level).max(axis=1)
                what = f"up to {far.max():.3g} deg/s from the level, axis {AXES[far.argmax()]}, "
                findings += self._mask(check, rows & ~self.masked, what)
        return findings

    def check_noise(self) -> list[Finding]:
        """What the values say once what is brief is masked."""
        rates, seconds = self.used, np.array([[1], [self.size]]) / self.rate_hz
        noise = np.array([self.blocks.sigma, self.blocks.noise])  # a filter leaves N to the means
        density = (noise * np.sqrt(seconds)).max(axis=0)
        level = values.check_noise(rates, density, self.quality.largest_noise_dps)
        return values.check_zeros(rates) + values.check_tops(rates) + level

    def check_rest(self) -> list[Finding]:
        """Motion, a bias that is taken off, and a drift."""
        blocks, q = self.blocks, self.quality
        times = blocks.starts / self.size + 0.5
        drift, fast = fit_drift(blocks.means, times, blocks.noise, q.false_alarm)
        # a smaller start harms nothing
        large = np.abs(fast).max(axis=1) > q.least_change_dps + 6 * blocks.noise
        first = int(np.argmax((np.abs(fast) <= blocks.noise[:, None])[large].all(axis=0)))
        changed, noisier = self._alarms(blocks.where(slice(first, None)), drift[:, first:])
        if not changed.any() and not noisier[2:].any():  # a start that is only noisier
            first += int(np.append(-1, np.flatnonzero(noisier))[-1]) + 1
            noisier[:] = False
        rest, drift = blocks.where(slice(first, None)), drift[:, first:]
        size = len(rest.starts)
        motion = self._motion(rest, drift, changed[-size:], noisier[-size:])
        if motion or first or drift.any():
            whole = cut_blocks(self.rates, np.zeros_like(self.masked), self.size)
            if goes_to_zero(whole.means, blocks.noise):
                detail = "the sensor takes its level to zero on all axes; log its raw rates"
                return [Finding("bias taken off", REJECTED, detail)]
        if motion:
            return [Finding("motion", REJECTED, motion)]
        start = np.arange(self.masked.size) < rest.starts[0]
        findings = self._mask("start", start, "settles at once, ") if first else []
        findings += self.check_length() if first else []
        return findings + self._drifts(rest, drift, times[first:] * self.size / self.rate_hz)

    def _drifts(self, blocks: Blocks, drift: Array, times_s: Array) -> list[Finding]:
        """Drifts that settle or not, and what moves from twentieth to twentieth beside them."""
        findings, least = [], self.quality.drift_mdps * MDPS
        edges = np.linspace(0, times_s.size, 21).astype(np.intp)
        lengths = np.maximum(np.diff(edges), 1)
        parts = np.add.reduceat(blocks.means - drift, edges[:-1], axis=1) / lengths
        wander = np.ptp(parts, axis=1)
        chance = 8 * blocks.noise / np.sqrt(lengths.min())  # the range of so many, at most
        for axis, name in enumerate(AXES):
            change = drift[axis, -1] - drift[axis, 0]
            if abs(change) > least:
                constant_s = time_constant(drift[axis], times_s)
                check, end = "warm-up", f"time constant about {constant_s:.2g} s"
                if np.isinf(constant_s):
                    check, end = "drift", "not settled at the end"
                detail = f"axis {name} by {change / MDPS:+.3g} mdps, {end}"
                findings.append(Finding(check, KEPT, detail))
            if wander[axis] > max(least, self.quality.least_change_dps, chance[axis]):
                detail = f"axis {name} wanders by {wander[axis] / MDPS:.3g} mdps"
                findings.append(Finding("drift", KEPT, detail))
        return findings

    def _alarms(self, blocks: Blocks, drift: Array) -> tuple[Mask, Mask]:
        """Blocks whose mean changes, and whose noise rises, once the drift is taken off."""
        detector = RestDetector(self.size, self.quality.false_alarm, self.quality.least_change_dps)
        # forwards and backwards: its first blocks have little before them to be compared with
        series = (np.hstack([x.T, x.T[::-1]]) for x in (blocks.means - drift, blocks.variances))
        axes = len(AXES)
        changed, noisier = (x[:, :axes] | x[::-1, axes:] for x in detector.update(*series))
        return np.any(changed, axis=1), np.any(noisier, axis=1)

    def _motion(self, blocks: Blocks, drift: Array, changed: Mask, noisier: Mask) -> str:
        """What shows that the gyroscope moved; empty at rest."""
        q, drifts, left = self.quality, np.ptp(drift, axis=1), blocks.means - drift
        if drifts.max() > q.largest_drift_dps:
            return (
                f"the rate drifts by {drifts.max():.2g} deg/s, axis {AXES[drifts.argmax()]}; a "
                f"bias by at most {q.largest_drift_dps:g} (quality.largest_drift_dps)"
            )
        if changed.any() or self.moved.any():
            apart = np.abs(left - np.median(left, axis=1, keepdims=True))
            axis = int(np.argmax(apart.max(axis=1) / blocks.noise))
            far = (apart > q.least_change_dps + 6 * blocks.noise[:, None]).any(axis=0)
            text = f"the rate changes by up to {apart[axis].max():.2g} deg/s, axis {AXES[axis]}"
        else:
            rise = np.sqrt(blocks.variances) / blocks.sigma[:, None]
            far = noisier & (rise > 1).any(axis=0)
            text = f"the noise rises up to {rise.max():.2g}-fold"
        rows, far = self.moved.copy(), far if far.any() else changed | noisier
        rows[blocks.starts[far, None] + np.arange(self.size)] = True
        return f"{text}, {self._where(rows)}" * int(rows.any())

    def _mask(self, check: str, rows: Mask, what: str, outcome: str = REPAIRED) -> list[Finding]:
        """Mask rows, and say so if there are any."""
        if not rows.any():
            return []
        self.masked = self.masked | rows
        done = "cut" if check in {"zero rows", "start"} else "masked"
        return [Finding(check, outcome, f"{what}{self._where(rows)}, {done}")]

    def _where(self, rows: Mask, most: int = 5) -> str:
        """Rows of the file, for a person; long runs with their times."""
        spans, texts = self.start + runs(rows) - [0, 1], []
        for first, last in spans[:most]:
            a, b = (first, last) if self.log.rows is None else self.log.rows[[first, last]]
            text = f"row {a}" if a == b else f"rows {a} to {b}"
            times = f" ({first / self.rate_hz:.4g} to {last / self.rate_hz:.4g} s)"
            texts.append(text + times * int(last - first >= self.size))
        return ", ".join(texts) + f" and {len(spans) - most} more" * (len(spans) > most)
