"""One recording, read once and judged; what a worker process does."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from gyro_pipeline.conventions import InputError
from gyro_pipeline.fingerprints import data_hash
from gyro_pipeline.logs import REJECTED, Finding, Log, LogEntry, Recording, printable
from gyro_pipeline.parameters import Quality
from gyro_pipeline.quality import inspect

_NO_RATE = (
    "no times that can be read, and none stated; name the time column and its unit, time_column "
    "and time_units, in `reader:` of the catalog entry in catalog.yml, or give rate_hz, samples a "
    "second, in the sensor's entry in globals.yml"
)


@dataclass(frozen=True)
class Inspection:
    """A recording to read and judge.

    Attributes:
        entry: Where it comes from.
        rate_hz: Expected; None where it is not known.
        quality: How it is judged.
        key: Hash of all that the result depends on.
    """

    entry: LogEntry
    rate_hz: float | None
    quality: Quality
    key: str

    @property
    def work(self) -> float:
        """Estimated cost, in bytes."""
        return float(self.entry.size)

    def recording(self, *findings: Finding, **attributes: Any) -> Recording:
        """The recording as one that is rejected, unless its attributes say otherwise."""
        place = {name: getattr(self.entry, name) for name in ("imu", "recording", "where")}
        given = {"key": self.key, "outcome": REJECTED} | attributes
        return Recording(**place, **given, findings=findings)


def judge(job: Inspection) -> Recording:
    """Read a recording, judge it by its samples as they are stored, in float32, and keep them.

    Args:
        job: The recording.

    Returns:
        What is kept of it, and why. A file that cannot be used is a rejected recording; where the
        system failed rather than the file, the result has no key.
    """
    try:
        log = job.entry.read()
    except InputError as error:
        key = "" if _of_the_system(error.__cause__) else job.key
        return job.recording(Finding("file", REJECTED, printable(str(error))), key=key)
    return _judged(log, job)


def _of_the_system(cause: BaseException | None) -> bool:
    """Whether an error, or what it comes from, says nothing of the file.

    Of a damaged file libraries raise OSError as well, but only the system's has a number.
    """
    if cause is None:
        return False
    of_system = isinstance(cause, OSError) and cause.errno is not None
    return of_system or isinstance(cause, MemoryError) or _of_the_system(cause.__cause__)


def _judged(log: Log, job: Inspection) -> Recording:
    rate_hz = log.rate_hz or job.rate_hz
    if rate_hz is None:
        return job.recording(*log.findings, Finding("sample rate", REJECTED, _NO_RATE))
    with np.errstate(over="ignore"):  # becomes infinite, and is found as such
        stored = np.array(log.samples.T, np.float32, order="C")
    inspected = inspect(replace(log, samples=stored.T), rate_hz, job.quality)
    usable, length_s = inspected.stop - inspected.start, job.quality.length_s
    length = usable if length_s is None else round(length_s * rate_hz)
    measured = {"rows": len(log.samples), "rate_hz": log.rate_hz}
    if inspected.outcome == REJECTED:
        return job.recording(*inspected.findings, **measured)
    if usable < length:
        problem = f"{usable} rows can be used, quality.length_s asks for {length}"
        short = Finding("too short", REJECTED, problem)
        return job.recording(*inspected.findings, short, **measured)
    kept, masked = slice(inspected.start, inspected.start + length), inspected.masked[:length]
    stored[:, kept][:, masked] = np.nan
    variables = {"angular_rate": np.ascontiguousarray(stored[:, kept])}
    for name in ("temperature_c", "acceleration_g"):
        values = getattr(log, name)
        if values is not None:
            variables[name] = np.ascontiguousarray(values[kept].T, np.float32)
    return job.recording(
        *inspected.findings,
        **measured,
        outcome=inspected.outcome,
        start=kept.start,
        stop=kept.stop,
        masked=int(masked.sum()),
        content=data_hash(variables["angular_rate"], None),
        variables=variables,
    )
