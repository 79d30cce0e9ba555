"""Inspection of a recording, which is read once; it runs in worker processes."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from gyro_pipeline.conventions import InputError
from gyro_pipeline.fingerprints import data_hash
from gyro_pipeline.logs import REJECTED, Finding, Log, LogEntry, Recording, printable
from gyro_pipeline.parameters import Quality
from gyro_pipeline.quality import inspect

_NO_RATE = (
    "no times that can be read, and no stated rate; name the time column and its unit, time_column "
    "and time_units, in `reader:` of the catalog entry in catalog.yml, or give rate_hz, samples a "
    "second, in the sensor's entry in globals.yml"
)


@dataclass(frozen=True)
class Inspection:
    """A recording to read and judge."""

    entry: LogEntry  # entry of the recording in its source
    rate_hz: float | None  # expected sample rate; None if it is unknown
    quality: Quality  # settings of quality control
    key: str  # hash of everything that the result depends on

    @property
    def work(self) -> float:
        """Estimated cost, in bytes."""
        return float(self.entry.size)

    def recording(self, *findings: Finding, **attributes: Any) -> Recording:
        """The recording with its attributes, rejected unless they say otherwise."""
        labels = {name: getattr(self.entry, name) for name in ("imu", "recording", "where")}
        values = {"key": self.key, "outcome": REJECTED} | attributes
        return Recording(**labels, **values, findings=findings)


def judge(job: Inspection) -> Recording:
    """Read a recording and judge its samples as they are stored, in float32.

    Args:
        job: The recording.

    Returns:
        The recording with its outcome and findings. An unusable file is a rejected recording; if
        the system failed rather than the file, the result has no key.
    """
    try:
        log = job.entry.read()
    except InputError as error:
        key = "" if _is_system_error(error.__cause__) else job.key
        return job.recording(Finding("file", REJECTED, printable(str(error))), key=key)
    return _judged(log, job)


def _is_system_error(cause: BaseException | None) -> bool:
    """Whether an error, or its cause, is due to the system rather than the file.

    Libraries also raise OSError for a damaged file, but without an error number.
    """
    if cause is None:
        return False
    numbered = isinstance(cause, OSError) and cause.errno is not None
    return numbered or isinstance(cause, MemoryError) or _is_system_error(cause.__cause__)


def _judged(log: Log, job: Inspection) -> Recording:
    rate_hz = log.rate_hz or job.rate_hz
    if rate_hz is None:
        return job.recording(*log.findings, Finding("sample rate", REJECTED, _NO_RATE))
    with np.errstate(over="ignore"):  # values become infinite and are rejected
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
    used, masked = slice(inspected.start, inspected.start + length), inspected.masked[:length]
    stored[:, used][:, masked] = np.nan
    variables = {"angular_rate": np.ascontiguousarray(stored[:, used])}
    for name in ("temperature_c", "acceleration_g"):
        values = getattr(log, name)
        if values is not None:
            variables[name] = np.ascontiguousarray(values[used].T, np.float32)
    return job.recording(
        *inspected.findings,
        **measured,
        outcome=inspected.outcome,
        start=used.start,
        stop=used.stop,
        masked=int(masked.sum()),
        content=data_hash(variables["angular_rate"], None),
        variables=variables,
    )
