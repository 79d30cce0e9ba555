"""One recording, read and judged; what a worker process does."""

import hashlib
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from gyro_pipeline.conventions import InputError
from gyro_pipeline.logs import REJECTED, Finding, Log, LogEntry
from gyro_pipeline.parameters import Quality
from gyro_pipeline.protocol.quality import inspect


@dataclass(frozen=True)
class Inspection:
    """A recording to read and judge.

    Attributes:
        entry: Where it comes from.
        rate_hz: Expected.
        quality: How it is judged.
    """

    entry: LogEntry
    rate_hz: float
    quality: Quality

    @property
    def work(self) -> float:
        """Estimated cost, in bytes."""
        return float(self.entry.size)

    @property
    def samples(self) -> int | None:
        """That ``quality.length_s`` asks for, at the expected rate."""
        asked = self.quality.length_s
        return None if asked is None else round(asked * self.rate_hz)


@dataclass(frozen=True)
class Judged:
    """What is known of a recording after it was read, and what is kept of it.

    Attributes:
        outcome: KEPT, REPAIRED or REJECTED.
        findings: Why.
        rows: It has.
        start: First row that is used.
        stop: The row after the last one that can be used.
        rate_hz: Measured from timestamps; None where there are none, or it cannot be read.
        content: Hash of all its samples; two recordings of one hash are one.
        samples: The rows that can be used, (3, n), float32, deg/s; None of a rejected recording.
        temperature_c: Of the same rows, (1, n), float32; None where the file has none.
    """

    outcome: str
    findings: tuple[Finding, ...]
    rows: int = 0
    start: int = 0
    stop: int = 0
    rate_hz: float | None = None
    content: str = ""
    samples: NDArray[np.float32] | None = None
    temperature_c: NDArray[np.float32] | None = None

    def rejected(self, finding: Finding) -> "Judged":
        """The same recording with one more finding, for which it cannot be used."""
        return replace(self, outcome=REJECTED, findings=(*self.findings, finding))


def judge(job: Inspection, report: Callable[[float], None]) -> Judged:
    """Read a recording and judge it by its samples as they are stored, in float32.

    Args:
        job: The recording.
        report: Called with the work done.

    Returns:
        What is kept of it. A file that cannot be used is a rejected recording.
    """
    try:
        log = job.entry.read()
    except InputError as error:
        judged = Judged(REJECTED, (Finding("file", REJECTED, str(error)),))
    else:
        judged = _judged(log, job)
    report(job.work)
    return judged


def _judged(log: Log, job: Inspection) -> Judged:
    with np.errstate(over="ignore"):  # becomes infinite, and is found as such
        stored = np.ascontiguousarray(log.samples.T, dtype=np.float32)
    rounded = replace(log, samples=stored.T.astype(np.float64))
    found = inspect(rounded, log.rate_hz or job.rate_hz, job.quality)
    usable = found.stop - found.start
    used = slice(found.start, found.start + min(usable, job.samples or usable))
    judged = Judged(
        found.outcome,
        found.findings,
        *(len(log.samples), used.start, used.stop, log.rate_hz),
        content=hashlib.sha256(stored.data).hexdigest(),
    )
    if found.outcome == REJECTED:
        return judged
    if job.samples is not None and usable < job.samples:
        problem = f"{usable} rows can be used, quality.length_s asks for {job.samples}"
        return judged.rejected(Finding("too short", REJECTED, problem))
    warmth = log.temperature_c
    return replace(
        judged,
        samples=np.ascontiguousarray(stored[:, used]),
        temperature_c=None if warmth is None else warmth[None, used].astype(np.float32),
    )
