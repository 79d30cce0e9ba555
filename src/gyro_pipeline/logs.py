"""Raw logs: the contract between the sources, the quality control and the raw-logs stage.

A source lists its recordings without reading them. Each recording is read once, by the process that
inspects it, and is stored before others are read, so that few recordings are in memory at a time.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    import xarray as xr

KEPT, REPAIRED, REJECTED = "kept", "repaired", "rejected"
"""Outcomes of a finding and of a recording."""


@dataclass(frozen=True)
class Finding:
    """A result of a check of a recording.

    Attributes:
        check: Name of the check in two or three words, such as ``zero rows`` or ``sample rate``.
        outcome: KEPT, REPAIRED or REJECTED.
        detail: What the check found, where (data rows of the file, from 0), and what was cut or why
            the recording is unusable; a sentence without a full stop.
    """

    check: str
    outcome: str
    detail: str


@dataclass(frozen=True)
class Log:
    """The contents of a file for one recording of one IMU.

    Attributes:
        samples: (n, 3), deg/s, float64, or float32 if stored as such; may contain NaN and infinity.
        rate_hz: Sample rate measured from timestamps; None without timestamps.
        gap_rows: Rows before which samples are missing or out of order, increasing; a stretch
            between two of them is gap-free. Findings give the reasons.
        lost: (n,), about how many samples are missing before each row; NaN where that is not known,
            as where time goes back. None without stamps.
        temperature_c: (n,), degrees Celsius; None if the file has none.
        acceleration_g: (n, 3), g; None if the file has none.
        rows: (n,), the row of the file of each sample, increasing; None if every row is a sample.
        findings: Findings of the reader.
    """

    samples: NDArray[np.floating]
    rate_hz: float | None = None
    gap_rows: NDArray[np.integer] = field(default_factory=lambda: np.empty(0, np.intp))
    temperature_c: NDArray[np.float64] | None = None
    acceleration_g: NDArray[np.float64] | None = None
    rows: NDArray[np.integer] | None = None
    findings: tuple[Finding, ...] = ()
    lost: NDArray[np.float64] | None = None


@dataclass(frozen=True)
class LogEntry:
    """A recording that a source lists.

    Attributes:
        imu: Number of the IMU, from 1.
        recording: Number of the recording, from 1.
        where: The file and the position in it, for messages.
        read: Reads the recording; picklable. Raises InputError if the file cannot be used.
        size: Approximate number of bytes, the cost of reading and inspecting the recording.
        key: Hash of everything that ``read`` depends on: the file's state and the options.
        split: ``train`` or ``test`` if the source comes split.
    """

    imu: int
    recording: int
    where: str
    read: Callable[[], Log]
    size: int
    key: str
    split: str | None = None


@dataclass(frozen=True)
class Logs:
    """The logs of a source.

    Attributes:
        sensor: Name of the sensor.
        source: Name of the source, as in stored paths.
        simulated: Whether the logs are simulated.
        rate_hz: Expected sample rate, which measured rates are compared with; None if unknown.
        entries: The recordings, ordered by IMU and number.
        truth: True biases and noise of simulated recordings, to be stored with them.
    """

    sensor: str
    source: str
    simulated: bool
    rate_hz: float | None
    entries: Sequence[LogEntry]
    truth: "xr.Dataset | None" = None


@dataclass(frozen=True)
class Listing:
    """The recordings that are about to be read.

    Attributes:
        keys: Hash of everything that a :class:`Recording` depends on, by IMU and recording.
    """

    keys: Mapping[tuple[int, int], str]


@dataclass(frozen=True)
class Recording:
    """A recording after reading and quality control.

    Attributes:
        imu: Number of the IMU, from 1.
        recording: Number of the recording, from 1.
        where: The file and the position in it, for messages.
        key: As in :class:`Listing`; empty if reading again may have another outcome.
        outcome: KEPT, REPAIRED or REJECTED.
        findings: The findings behind the outcome.
        rows: Number of samples of the log: rows of the file without those that the reader left out.
        start: First kept sample, from 0.
        stop: End of the kept samples, exclusive.
        masked: Number of masked samples between them.
        rate_hz: Sample rate measured from timestamps; None without timestamps, or if unreadable.
        content: Hash of the kept samples (:func:`~gyro_pipeline.fingerprints.data_hash`), by which
            copies of a recording are detected.
        variables: Kept values, float32, by their names in the recordings: ``angular_rate``
            (axis, sample), NaN where masked; ``temperature_c`` (sample) and ``acceleration_g``
            (axis, sample) if the file has them. Empty for a rejected recording.
    """

    imu: int
    recording: int
    where: str
    key: str
    outcome: str
    findings: tuple[Finding, ...]
    rows: int = 0
    start: int = 0
    stop: int = 0
    masked: int = 0
    rate_hz: float | None = None
    content: str = ""
    variables: Mapping[str, NDArray[np.float32]] = field(default_factory=dict)

    @property
    def labels(self) -> tuple[int, int]:
        """IMU and recording."""
        return self.imu, self.recording


def printable(text: str) -> str:
    """Escape control characters and bytes that are not UTF-8, so that any file can hold them."""
    return "".join(c if c.isprintable() else ascii(c)[1:-1] for c in text)


def with_recordings(recordings: "xr.Dataset") -> "xr.Dataset":
    """Leave out the IMUs and the recording numbers without any usable recording.

    Args:
        recordings: With ``samples`` (imu, recording), the number of samples of each recording.
    """
    usable = recordings["samples"].load() > 0
    for dimension, other in (("imu", "recording"), ("recording", "imu")):
        used = usable.any(other).to_numpy()
        if not used.all():  # an integer index makes reading slow
            recordings = recordings.isel({dimension: np.flatnonzero(used)})
    return recordings
