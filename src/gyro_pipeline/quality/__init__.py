"""Quality control of one recording: is it at rest, which rows hold no measurement, what is odd.

One principle: a smooth drift is fitted to the means of blocks; what is left of a gyroscope at rest
neither changes its mean nor gets noisier (:mod:`.rest`). What is brief is masked and does not end
the recording; a gap in time does. Limits know how many samples or blocks they are compared with.

| check | what | how it ends |
|---|---|---|
| zero rows | first or last rows, zero on every axis | cut, kept |
| gaps | the longest stretch between them is kept | repaired |
| non-finite, stuck | no numbers, or an axis that repeats a value for too long | masked, repaired |
| spikes, shocks | a sample, or a burst with a block about it, beyond the noise | masked, repaired |
| start | what settles within two blocks | cut, repaired |
| motion | a changed mean, raised noise, a long burst, too large a drift | rejected |
| freed of bias | a level that goes to zero on all axes | rejected |
| warm-up, drift | the bias settles; does not settle within the recording | kept |
| too short | what is not masked is too short, or too small a share | rejected |
| values | see :mod:`.values` | kept or rejected |

Motion rejects all of a recording: rates alone do not tell which part was at rest, and after a turn
the Earth's rate falls differently on the axes. A rotation as steady as a bias cannot be seen.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gyro_pipeline.conventions import AXES, MDPS, InputError
from gyro_pipeline.logs import KEPT, REJECTED, REPAIRED, Finding, Log
from gyro_pipeline.parameters import LEAST_BLOCKS, Quality
from gyro_pipeline.quality import values
from gyro_pipeline.quality.blocks import (
    Blocks,
    Rows,
    cut_blocks,
    excursions,
    fill,
    longest_stretch,
    rows_between_zeros,
    stuck,
)
from gyro_pipeline.quality.drift import SHORTEST, describe_drift, fit_drift, is_freed_of_bias
from gyro_pipeline.quality.rest import RestDetector

LARGEST_NUMBER = 1e12
"""Garbage bytes read as a number can be as large as 1e308, which overflows when it is squared."""

LEAST_BLOCK = 5
"""Samples. The noise of shorter blocks is known too badly for a median of them."""

LEAST_RISE = 1.5
"""Of the noise, for motion. On the public files, partly coloured, a block has up to 1.4 at rest."""


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
    masked: NDArray[np.bool_]
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
    masked, findings = _mask_values(rates, rate_hz, quality)
    start, stop = longest_stretch(masked, log.gap_rows)
    stretch = _Stretch(rates[:, start:stop], masked[start:stop], start, rate_hz, quality)
    checks = (stretch.check_length, stretch.check_values, stretch.check_rest, stretch.check_length)
    for check in checks:
        findings += check()
        if any(finding.outcome == REJECTED for finding in findings):
            break
    used = np.flatnonzero(~stretch.masked)  # what is masked at the ends is cut
    first, last = (used[0], used[-1] + 1) if used.size else (0, 0)
    every = (*log.findings, *findings)
    outcome = max((f.outcome for f in every), key=(KEPT, REPAIRED, REJECTED).index, default=KEPT)
    return Inspected(outcome, start + first, start + last, stretch.masked[first:last], every)


def _mask_values(
    rates: NDArray[np.float64], rate_hz: float, quality: Quality
) -> tuple[Rows, list[Finding]]:
    """Rows whose values are no measurement: zeros at the ends, no numbers, values that are held."""
    first, last = rows_between_zeros(rates)
    masked = np.ones(rates.shape[1], bool)
    masked[first:last] = False
    findings = []
    if masked.any():
        findings.append(Finding("zero rows", KEPT, f"{_rows(np.flatnonzero(masked))}, cut"))
    finite = np.abs(rates) < LARGEST_NUMBER  # neither NaN nor infinity is
    held = stuck(rates, max(round(quality.stuck_s * rate_hz), 2), quality.false_alarm) & finite
    for check, samples in (("non-finite values", ~finite), ("stuck values", held)):
        lost = samples.any(axis=0) & ~masked
        if lost.any():
            axes = ", ".join(np.array(AXES)[samples[:, lost].any(axis=1)])
            detail = f"{'axes' if ',' in axes else 'axis'} {axes}, {_rows(np.flatnonzero(lost))}"
            findings.append(Finding(check, REPAIRED, f"{detail}, masked"))
            masked |= lost
    return masked, findings


@dataclass
class _Stretch:
    """Rows of a log between two gaps; each check returns its findings, some mask rows.

    Attributes:
        rates: (axis, n), deg/s.
        masked: (n,).
        row: The row of the log that is its first.
        rate_hz: Samples per second.
        quality: Lengths, limits and the false-alarm probability.
    """

    rates: NDArray[np.float64]
    masked: Rows
    row: int
    rate_hz: float
    quality: Quality

    @property
    def size(self) -> int:
        """Rows of a block."""
        return max(round(self.quality.block_s * self.rate_hz), LEAST_BLOCK)

    def check_length(self) -> list[Finding]:
        """Whether enough rows can be used, and enough of all."""
        used, q = int(np.count_nonzero(~self.masked)), self.quality
        least = max(q.least_s * self.rate_hz, LEAST_BLOCKS * self.size)
        if used >= max(least, q.least_share * self.masked.size):
            return []
        detail = (
            f"{used} of {self.masked.size} rows can be used, {used / self.rate_hz:.4g} s; expected at "
            f"least {least / self.rate_hz:.4g} s (quality.least_s) and {q.least_share:.0%} of the rows "
            "between gaps (quality.least_share)"
        )
        return [Finding("too short", REJECTED, detail)]

    def check_values(self) -> list[Finding]:
        """What the values say by themselves."""
        self.rates = fill(self.rates, self.masked)
        self.blocks = cut_blocks(self.rates, self.masked, self.size)
        used = self.rates[:, ~self.masked] if self.masked.any() else self.rates
        sigma = self.blocks.sigma
        seconds = (
            np.array([[1], [self.size]]) / self.rate_hz
        )  # N of a low-passed sensor is in means
        density = (np.array([sigma, self.blocks.noise]) * np.sqrt(seconds)).max(axis=0)
        return [
            *values.check_axes(used),
            *values.check_repeats(used),
            *values.check_turns(used, sigma),
            *values.check_zeros(used),
            *values.check_top(used),
            *values.check_steps(used, sigma, self.quality.largest_step),
            *values.check_noise(used, density, self.quality.largest_noise_dps),
        ]

    def check_rest(self) -> list[Finding]:
        """Mask what is brief; tell a drift, a bias that is taken off, and motion."""
        before, quality = self.blocks, self.quality
        findings, moved = self._mask_bursts()
        if findings:
            self.rates = fill(self.rates, self.masked)
            self.blocks = cut_blocks(self.rates, self.masked, self.size)
        if len(self.blocks.starts) < LEAST_BLOCKS:
            return findings
        blocks, noise = self.blocks, self.blocks.noise
        times = blocks.starts / self.size + 0.5
        drift, transient = fit_drift(blocks.means, times, noise, quality.false_alarm)
        starting = np.abs(transient).max(axis=1) > quality.least_change_dps  # else it harms nothing
        first = int(np.argmax((np.abs(transient[starting]) <= noise[starting, None]).all(axis=0)))
        blocks, drift, times = blocks.where(slice(first, None)), drift[:, first:], times[first:]
        motion = self._movements(blocks, drift, moved)
        odd = motion or findings or first or drift.any()
        if odd and is_freed_of_bias(before.means, noise):
            detail = "the level goes to zero on all axes: the sensor takes the bias off by itself"
            return [Finding("freed of bias", REJECTED, f"{detail}; record its raw rates")]
        if motion:
            return [Finding("motion", REJECTED, "; ".join(motion))]
        if first:
            rows = blocks.starts[0]
            self.masked[:rows] = True
            detail = f"{_rows(self.row + np.arange(rows))}: settles within {SHORTEST} blocks, cut"
            findings.append(Finding("start", REPAIRED, detail))
        return findings + self._check_drift(drift, times * self.size / self.rate_hz)

    def _mask_bursts(self) -> tuple[list[Finding], NDArray[np.integer]]:
        """Mask spikes and shocks, and return the first and last rows of what is too long for one."""
        bursts = excursions(self.rates, self.blocks, self.quality.false_alarm)
        few = bursts[:, 1] - bursts[:, 0] < 2  # noqa: PLR2004 - rows; noise makes no more
        spikes, about = np.zeros((2, self.masked.size), bool)
        for first, last in bursts[few]:
            spikes[first : last + 1] = True
        for first, last in bursts[~few]:  # and a block on either side, where it may still ring
            about[max(first - self.size, 0) : last + 1 + self.size] = True
        spans = _runs(about)
        brief = np.diff(spans)[:, 0] < self.quality.shock_s * self.rate_hz + 2 * self.size
        findings, moved = [], spans[~brief]
        for first, last in moved:
            about[first : last + 1] = False
        shocks = about.copy()
        if spans.size and spans[0, 0] == 0:
            shocks[: spans[0, 1] + 1] = False
        kinds = {"spikes": spikes & ~about, "start": about & ~shocks, "shocks": shocks}
        level = np.median(self.blocks.means, axis=1, keepdims=True)
        for check, rows in kinds.items():
            if rows.any():
                apart = np.abs(self.rates[:, rows] - level).max(axis=1)
                axis = int(np.argmax(apart))
                detail = (
                    f"up to {apart[axis]:.3g} deg/s from the level, axis {AXES[axis]}, "
                    f"{_rows(self.row + np.flatnonzero(rows))}, masked"
                )
                findings.append(Finding(check, REPAIRED, detail))
        self.masked = self.masked | spikes | about
        return findings, moved

    def _movements(
        self, blocks: Blocks, drift: NDArray[np.float64], moved: NDArray[np.integer]
    ) -> list[str]:
        """What shows that the gyroscope moved; nothing at rest."""
        left, quality = blocks.means - drift, self.quality
        detector = RestDetector(
            self.size,
            false_alarm=quality.false_alarm,
            least_dps=quality.least_change_dps,
            least_rise=LEAST_RISE,
        )
        # forwards and backwards: its first blocks have little before them to be compared with
        series = [np.hstack([x.T, x.T[::-1]]) for x in (left, blocks.variances)]
        alarms = [(x[:, :3] | x[::-1, 3:]).any(axis=1) for x in detector.update(*series)]
        found = []
        if alarms[0].any() or len(moved):
            apart = np.abs(left - np.median(left, axis=1, keepdims=True))
            about = apart > quality.least_change_dps + 6 * blocks.noise[:, None]
            axis = int(np.argmax((apart / blocks.noise[:, None]).max(axis=1)))
            where = self._spans(blocks, about.any(axis=0), alarms[0], moved)
            found.append(
                f"the rate changes by up to {apart[axis].max():.2g} deg/s, axis {AXES[axis]}, {where}"
            )
        if alarms[1].any():
            rise = np.sqrt(blocks.variances) / blocks.sigma[:, None]
            where = self._spans(blocks, (rise > LEAST_RISE).any(axis=0), alarms[1], moved[:0])
            found.append(f"the noise rises up to {rise.max():.2g}-fold, {where}")
        size = np.ptp(drift, axis=1)
        if size.max() > quality.largest_drift_dps:
            axis = int(np.argmax(size))
            found.append(
                f"the rate drifts by {size[axis]:.2g} deg/s, axis {AXES[axis]}; expected at most "
                f"{quality.largest_drift_dps:g} of a bias (quality.largest_drift_dps)"
            )
        return found

    def _spans(
        self,
        blocks: Blocks,
        about: NDArray[np.bool_],
        alarms: NDArray[np.bool_],
        moved: NDArray[np.integer],
    ) -> str:
        """Where blocks are beyond, or else where the alarms were, and bursts, for a person."""
        starts = blocks.starts[about if about.any() else alarms]
        spans = np.concatenate([np.stack([starts, starts + self.size - 1], axis=1), moved])
        spans = spans[np.argsort(spans[:, 0])]
        new = np.flatnonzero(spans[1:, 0] > np.maximum.accumulate(spans[:-1, 1]) + self.size)
        firsts, lasts = spans[np.r_[0, new + 1], 0], spans[np.r_[new, len(spans) - 1], 1]
        texts = [
            f"rows {self.row + first} to {self.row + last} "
            f"({(self.row + first) / self.rate_hz:.4g} to {(self.row + last) / self.rate_hz:.4g} s)"
            for first, last in zip(firsts, lasts, strict=True)
        ]
        more = f" and {len(texts) - 5} more" if len(texts) > 5 else ""  # noqa: PLR2004 - to read
        return ", ".join(texts[:5]) + more

    def _check_drift(
        self, drift: NDArray[np.float64], times_s: NDArray[np.float64]
    ) -> list[Finding]:
        """Warm-ups and drifts of at least the size that is reported."""
        details: dict[str, list[str]] = {"warm-up": [], "drift": []}
        for name, axis in zip(AXES, drift, strict=True):
            if np.ptp(axis) < max(self.quality.drift_mdps * MDPS, 1e-12):
                continue
            change, constant_s = describe_drift(axis, times_s)
            text = f"axis {name} by {change / MDPS:+.3g} mdps"
            if np.isfinite(constant_s):
                details["warm-up"].append(f"{text}, time constant about {constant_s:.2g} s")
            else:
                details["drift"].append(f"{text}, and has not settled when the recording ends")
        return [Finding(check, KEPT, "; ".join(text)) for check, text in details.items() if text]


def _runs(chosen: Rows) -> NDArray[np.integer]:
    """First and last row of each run of true values: (run, 2)."""
    edges = np.flatnonzero(np.diff(chosen.astype(np.int8), prepend=0, append=0))
    return edges.reshape(-1, 2) - [0, 1]


def _rows(rows: NDArray[np.integer]) -> str:
    """Increasing rows, for a person."""
    if len(rows) == 1:
        return f"row {rows[0]}"
    if rows[-1] - rows[0] == len(rows) - 1:
        return f"rows {rows[0]} to {rows[-1]}"
    return f"{len(rows)} rows from {rows[0]} to {rows[-1]}"
