"""A recording as far as it is judged: its rows, those that hold no measurement, and its findings.

Rates are (axis, n), deg/s; a mask is (n,), true where a row holds no measurement.
"""

from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from gyro_pipeline.logs import REJECTED, REPAIRED, Finding, Log
from gyro_pipeline.parameters import Quality
from gyro_pipeline.quality.rest import Array, Mask


class Blocks(NamedTuple):
    """Averages of blocks; medians of them, so that nearly half may be odd."""

    starts: NDArray[np.integer]  # (block,), first rows
    means: Array  # (axis, block), deg/s
    variances: Array  # (axis, block), (deg/s)^2, of a sample about the mean
    sigma: Array  # (axis,), deg/s, noise of a sample
    noise: Array  # (axis,), deg/s, of a mean: of white noise, or more if neighbours differ by more


class Recording:
    """The rows of a log that are being judged: steps mask some and add findings."""

    def __init__(self, log: Log, rate_hz: float, quality: Quality) -> None:
        self.log, self.rate_hz, self.quality = log, rate_hz, quality
        self.rates: Array = np.ascontiguousarray(log.samples.T, np.float64)  # by axis: 20x faster
        self.start, self.masked = 0, np.zeros(self.rates.shape[1], bool)
        self.findings = list(log.findings)
        self.size = max(round(quality.block_s * rate_hz), 5)  # of a block; less tells no noise

    @property
    def rejected(self) -> bool:
        """Whether a finding rejects it."""
        return any(finding.outcome == REJECTED for finding in self.findings)

    @cached_property
    def used(self) -> Array:
        """(axis, unmasked row), deg/s."""
        return self.rates.compress(~self.masked, axis=1) if self.masked.any() else self.rates

    @cached_property
    def changes(self) -> Array:
        """(axis, unmasked row), deg/s, from each to the next."""
        return np.diff(self.used, axis=1)

    @cached_property
    def steps(self) -> Array:
        """(axis,), deg/s, in which values are written; 0 where they are well below the noise."""
        sizes = np.abs(self.changes)
        steps = np.zeros(len(sizes))
        # white noise repeats a tenth of its samples at a step of 0.36 sigma
        for axis in np.flatnonzero(np.count_nonzero(sizes == 0, axis=1) > 0.1 * sizes.shape[1]):
            # a few values that lie off the grid, as interpolated ones do, are below the quantile
            steps[axis] = np.quantile(sizes[axis][sizes[axis] > 0], 0.01, method="lower")
        return steps

    @cached_property
    def filled(self) -> Array:
        """(axis, row), deg/s, with a straight line in place of masked rows."""
        if not self.masked.any():
            return self.rates
        rows, used = np.arange(self.masked.size), np.flatnonzero(~self.masked)
        return np.array([np.interp(rows, used, axis) for axis in self.used])

    @cached_property
    def blocks(self) -> Blocks:
        """Averages of blocks of filled rows, but for those with more than a quarter masked."""
        size, count = self.size, self.masked.size // self.size
        samples = self.filled[:, : count * size].reshape(len(self.rates), count, size)
        used = np.count_nonzero(~self.masked[: count * size].reshape(count, size), axis=1)
        chosen = used >= 0.75 * size
        means = samples.mean(axis=-1)
        apart = samples - means[..., None]
        variances = np.einsum("abs,abs->ab", apart, apart) / np.maximum(used - 1, 1)
        # distances, as squares would let frequent spikes hide themselves
        distances = np.abs(apart, out=apart).mean(axis=-1)
        means, variances, distances = (x[:, chosen] for x in (means, variances, distances))
        median_of_unit = np.sqrt(2 / np.pi * (1 - 1 / size)) * (1 - 1 / (7 * size))
        sigma = np.median(distances, axis=1) / median_of_unit
        noise = np.median(np.abs(np.diff(means, axis=1)), axis=1) / (0.6745 * np.sqrt(2))
        noise = np.maximum(noise, sigma / np.sqrt(size))
        return Blocks(np.flatnonzero(chosen) * size, means, variances, sigma, noise)

    def trim(self) -> None:
        """Leave out what is masked at the ends."""
        used = np.flatnonzero(~self.masked)
        rows = slice(int(used[0]), int(used[-1]) + 1) if used.size else slice(0, 0)
        self.start += rows.start
        self.rates, self.masked = self.rates[:, rows], self.masked[rows]
        self._forget()

    def mask(self, check: str, rows: Mask, detail: str, outcome: str = REPAIRED) -> None:
        """Mask rows, and say so, if there are any."""
        if rows.any():
            self.masked = self.masked | rows
            self._forget()
            done = "cut" if check in {"zero rows", "start"} else "masked"
            self.add(check, outcome, f"{detail}{self.where(rows)}, {done}")

    def _forget(self) -> None:
        for name in ("used", "changes", "steps", "filled", "blocks"):
            self.__dict__.pop(name, None)

    def add(self, check: str, outcome: str, detail: str) -> None:
        """Add a finding."""
        self.findings.append(Finding(check, outcome, detail))

    def where(self, rows: Mask, most: int = 5) -> str:
        """Rows by their numbers in the file; those of runs longer than a block with their times."""
        spans, texts = self.start + runs(rows) - [0, 1], []
        for first, last in spans[:most]:
            a, b = (first, last) if self.log.rows is None else self.log.rows[[first, last]]
            text = f"row {a}" if a == b else f"rows {a} to {b}"
            times = f" ({first / self.rate_hz:.4g} to {last / self.rate_hz:.4g} s)"
            texts.append(text + times * int(last - first >= self.size))
        return ", ".join(texts) + f" and {len(spans) - most} more" * (len(spans) > most)


def runs(chosen: Mask) -> NDArray[np.integer]:
    """First row of each run of true values, and the row after its last: (run, 2)."""
    edges = np.concatenate([[False], chosen, [False]])
    return np.flatnonzero(edges[1:] != edges[:-1]).reshape(-1, 2)
