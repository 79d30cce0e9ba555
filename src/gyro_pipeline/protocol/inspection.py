"""One recording, read and judged; what a worker process does."""

import hashlib
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from gyro_pipeline.conventions import InputError
from gyro_pipeline.logs import REJECTED, Finding, Log, LogEntry
from gyro_pipeline.parameters import Quality
from gyro_pipeline.quality import inspect


@dataclass(frozen=True)
class Inspection:
    """A recording to read and judge.

    Attributes:
        entry: Where it comes from.
        rate_hz: Expected.
        quality: How it is judged.
    """

    entry: LogEntry
    rate_hz: float | None
    quality: Quality

    @property
    def work(self) -> float:
        """Estimated cost, in bytes."""
        return float(self.entry.size)

    @property
    def samples(self) -> int | None:
        """That ``quality.length_s`` asks for, at the expected rate, if there is one."""
        asked = self.quality.length_s
        return None if asked is None or self.rate_hz is None else round(asked * self.rate_hz)


@dataclass(frozen=True)
class Judged:
    """What is known of a recording after it was read; its samples are read again where needed.

    Attributes:
        outcome: KEPT, REPAIRED or REJECTED.
        findings: Why.
        rows: It has.
        start: First row that is used.
        stop: The row after the last one that can be used, or that ``quality.length_s`` asks for.
        rate_hz: Measured from timestamps; None where there are none, or it cannot be read.
        content: Hash of all its samples; two recordings of one hash are one.
    """

    outcome: str
    findings: tuple[Finding, ...]
    rows: int = 0
    start: int = 0
    stop: int = 0
    rate_hz: float | None = None
    content: str = ""

    def rejected(self, finding: Finding) -> "Judged":
        """The same recording with one more finding, for which it cannot be used."""
        return replace(self, outcome=REJECTED, findings=(*self.findings, finding))


def judge(job: Inspection, report: Callable[[float], None]) -> Judged:
    """Read a recording and judge it by its samples as they are stored, in float32.

    Args:
        job: The recording.
        report: Called with the work done.

    Returns:
        What was found. A file that cannot be used is a rejected recording.
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
    rate_hz = log.rate_hz or job.rate_hz
    if rate_hz is None:
        problem = "no timestamps, and none is expected; write rate_hz to the sensor in globals.yml"
        return Judged(REJECTED, (*log.findings, Finding("sample rate", REJECTED, problem)))
    found = inspect(rounded, rate_hz, job.quality)
    usable = found.stop - found.start
    stop = found.start + min(usable, job.samples or usable)
    judged = Judged(
        found.outcome,
        found.findings,
        *(len(log.samples), found.start, stop, log.rate_hz),
        content=hashlib.sha256(stored.data).hexdigest(),
    )
    if found.outcome != REJECTED and job.samples is not None and usable < job.samples:
        problem = f"{usable} rows can be used, quality.length_s asks for {job.samples}"
        return judged.rejected(Finding("too short", REJECTED, problem))
    return judged
