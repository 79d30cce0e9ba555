"""A recording under quality control: its rows, their mask and the findings.

Rates are (axis, n), deg/s; a mask is (n,), true where a row holds no measurement.
"""

from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from gyro_pipeline.logs import REJECTED, REPAIRED, Finding, Log
from gyro_pipeline.parameters import Quality
from gyro_pipeline.physics.bias import runs
from gyro_pipeline.quality.rest import Array, Mask


class Blocks(NamedTuple):
    """Statistics of blocks; noise is a median over blocks, so nearly half may be outliers."""

    starts: NDArray[np.integer]  # (block,), first rows
    means: Array  # (axis, block), deg/s
    variances: Array  # (axis, block), (deg/s)^2, of samples about the mean
    sigma: Array  # (axis,), deg/s, noise of a sample
    noise: Array  # (axis,), deg/s, noise of a mean: at least that of white noise


class Recording:
    """The rows of a log under quality control; checks mask rows and add findings."""

    def __init__(self, log: Log, rate_hz: float, quality: Quality) -> None:
        self.log, self.rate_hz, self.quality = log, rate_hz, quality
        # contiguous axes are 20 times as fast
        self.rates: Array = np.ascontiguousarray(log.samples.T, np.float64)
        self.start, self.masked = 0, np.zeros(self.rates.shape[1], bool)
        self.findings = list(log.findings)
        self.size = max(round(quality.block_s * rate_hz), 5)  # samples of a block

    @property
    def rejected(self) -> bool:
        """Whether a check rejects the recording; a file may have more problems than its rate."""
        checked = self.findings[len(self.log.findings) :]
        return any(finding.outcome == REJECTED for finding in checked)

    @cached_property
    def used(self) -> Array:
        """Rates of unmasked rows, (axis, unmasked row), deg/s."""
        return self.rates.compress(~self.masked, axis=1) if self.masked.any() else self.rates

    @cached_property
    def changes(self) -> Array:
        """Changes from each unmasked row to the next, (axis, unmasked row - 1), deg/s."""
        return self.used[:, 1:] - self.used[:, :-1]

    @cached_property
    def squares(self) -> Array:
        """Mean square of the changes, (axis,), (deg/s)^2."""
        return np.einsum("as,as->a", self.changes, self.changes) / self.changes.shape[1]

    @cached_property
    def repeats(self) -> Array:
        """Share of the rows that repeat the previous row, (axis,)."""
        return 1 - np.count_nonzero(self.changes, axis=1) / self.changes.shape[1]

    @cached_property
    def steps(self) -> Array:
        """Quantisation steps, (axis,), deg/s; 0 where they are well below the noise."""
        steps = np.zeros(len(self.rates))
        # white noise repeats a tenth of its samples at a step of 0.36 sigma
        for axis in np.flatnonzero(self.repeats > 0.1):  # noqa: PLR2004
            sizes = np.abs(self.changes[axis])
            # the quantile ignores a few values off the grid, such as interpolated ones
            steps[axis] = np.quantile(sizes[sizes > 0], 0.01, method="lower")
        return steps

    @cached_property
    def filled(self) -> Array:
        """Rates with linear interpolation over masked rows, (axis, row), deg/s."""
        if not self.masked.any():
            return self.rates
        rows, used = np.arange(self.masked.size), np.flatnonzero(~self.masked)
        return np.array([np.interp(rows, used, axis) for axis in self.used])

    @cached_property
    def occupied(self) -> NDArray[np.integer]:
        """Number of unmasked rows of each block, (block,); 0 if less than three quarters."""
        count = self.masked.size // self.size
        used = self.size - self.masked[: count * self.size].reshape(count, self.size).sum(axis=1)
        return np.where(used >= 0.75 * self.size, used, 0)

    @cached_property
    def blocks(self) -> Blocks:
        """Statistics of the occupied blocks of filled rows."""
        size, occupied = self.size, np.flatnonzero(self.occupied)
        samples = self.filled[:, : self.occupied.size * size].reshape(len(self.rates), -1, size)
        samples = samples if occupied.size == self.occupied.size else samples[:, occupied]
        means = samples.mean(axis=-1)
        deviations = samples - means[..., None]
        squares = np.einsum("abs,abs->ab", deviations, deviations)
        variances = squares / (self.occupied[occupied] - 1)
        # absolute deviations, as frequent spikes would inflate squares and so hide themselves
        absolute = np.abs(deviations, out=deviations).mean(axis=-1)
        sigma = median(absolute) / np.sqrt(2 / np.pi * (1 - 1 / size)) / (1 - 1 / (7 * size))
        noise = median(np.abs(np.diff(means, axis=1))) / (0.6745 * np.sqrt(2))
        noise = np.maximum(noise, sigma / size**0.5)
        return Blocks(occupied * size, means, variances, sigma, noise)

    def mask(self, check: str, rows: Mask, detail: str = "", outcome: str = REPAIRED) -> None:
        """Mask rows, if any, and add a finding."""
        if rows.any():
            self.leave_out(rows)
            action = "cut" if check in {"zero rows", "start"} else "masked"
            self.add(check, outcome, f"{detail}{self.where(rows)}, {action}")

    def leave_out(self, rows: Mask) -> None:
        """Mask rows, and discard cached properties."""
        self.masked = self.masked | rows
        for name, attribute in vars(Recording).items():
            if isinstance(attribute, cached_property):
                self.__dict__.pop(name, None)

    def trim(self) -> None:
        """Remove masked rows at both ends."""
        if self.masked[:1].any() or self.masked[-1:].any():
            used = np.flatnonzero(~self.masked)
            rows = slice(int(used[0]), int(used[-1]) + 1) if used.size else slice(0, 0)
            self.start += rows.start
            self.rates, self.masked = self.rates[:, rows], self.masked[rows]
            self.leave_out(np.zeros_like(self.masked))

    def add(self, check: str, outcome: str, detail: str) -> None:
        """Add a finding."""
        self.findings.append(Finding(check, outcome, detail))

    def where(self, rows: Mask, most: int = 5) -> str:
        """Describe rows by their numbers in the file; runs of a block or more also by times."""
        spans, texts = self.start + runs(rows) - [0, 1], []
        for first, last in spans[:most]:
            a, b = (first, last) if self.log.rows is None else self.log.rows[[first, last]]
            text = f"row {a}" if a == b else f"rows {a} to {b}"
            times = f" ({first / self.rate_hz:.4g} to {last / self.rate_hz:.4g} s)"
            texts.append(text + times * int(last - first >= self.size))
        return ", ".join(texts) + f" and {len(spans) - most} more" * (len(spans) > most)


def median(values: Array) -> Array:
    """Median along the last axis; for few values, several times as fast as numpy.median."""
    ordered, middle = np.sort(values, axis=-1), values.shape[-1] // 2
    return (ordered[..., middle] + ordered[..., ~middle]) / 2
