"""Raw logs: the contract between the sources, the quality control and the raw-logs stage.

A source lists its recordings without reading them. Each is read once, in whichever process inspects
it, and what is kept of it is stored before others are read, so that few are in memory at a time.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    import xarray as xr

KEPT, REPAIRED, REJECTED = "kept", "repaired", "rejected"
"""How a finding, and a recording, can end."""


@dataclass(frozen=True)
class Finding:
    """Something that was noticed about a recording.

    Attributes:
        check: What looked, in two or three words, such as ``zero rows`` or ``sample rate``.
        outcome: KEPT, REPAIRED or REJECTED.
        detail: What was found, where (data rows of the file, from 0), and what was cut or why it
            cannot be used; a sentence without a full stop.
    """

    check: str
    outcome: str
    detail: str


@dataclass(frozen=True)
class Log:
    """One recording of one IMU, as its file has it.

    Attributes:
        samples: (n, 3), float64, or float32 where they were stored so; deg/s; may hold NaN and
            infinity.
        rate_hz: Measured from timestamps; None where there are none.
        gap_rows: Rows before which samples are missing or out of order, increasing; a stretch
            between two of them is gap-free. Findings say why.
        temperature_c: (n,), degrees Celsius; None where the file has none.
        acceleration_g: (n, 3), g; None where the file has none.
        rows: (n,), the row of the file that each sample is from, increasing; None where every row
            is a sample.
        findings: Of the reading.
    """

    samples: NDArray[np.floating]
    rate_hz: float | None = None
    gap_rows: NDArray[np.integer] = field(default_factory=lambda: np.empty(0, np.intp))
    temperature_c: NDArray[np.float64] | None = None
    acceleration_g: NDArray[np.float64] | None = None
    rows: NDArray[np.integer] | None = None
    findings: tuple[Finding, ...] = ()


@dataclass(frozen=True)
class LogEntry:
    """A recording that a source lists.

    Attributes:
        imu: From 1.
        recording: From 1.
        where: For messages: the file, and where in it.
        read: Reads it; can be pickled. Raises InputError where the file cannot be used.
        size: Bytes to read, about: what reading and inspecting it costs.
        key: Hash of all that ``read`` depends on: the file as it is now, and how it is read.
        split: ``train`` or ``test``, where the source came split.
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
    """What a source gives.

    Attributes:
        sensor: Its name.
        source: Where the logs come from, as stored paths name it.
        simulated: Whether they are.
        rate_hz: Expected; measured ones are compared with it. None where it is not known.
        entries: The recordings, by IMU and number.
        drawn: What was drawn for simulated recordings, to be stored with them.
    """

    sensor: str
    source: str
    simulated: bool
    rate_hz: float | None
    entries: Sequence[LogEntry]
    drawn: "xr.Dataset | None" = None


@dataclass(frozen=True)
class Listing:
    """The recordings that are about to be read.

    Attributes:
        keys: By IMU and recording, a hash of all that a :class:`Recording` depends on.
    """

    keys: Mapping[tuple[int, int], str]


@dataclass(frozen=True)
class Recording:
    """A recording that was read and judged.

    Attributes:
        imu: From 1.
        recording: From 1.
        where: For messages: the file, and where in it.
        key: As in :class:`Listing`; empty where reading it again may end otherwise.
        outcome: KEPT, REPAIRED or REJECTED.
        findings: Why.
        rows: Samples of its log: rows of the file, but for those that the reading left out.
        start: First of them that is kept, counted from 0.
        stop: The one after the last that is kept.
        masked: How many between them hold no measurement.
        rate_hz: Measured from timestamps; None where there are none, or it cannot be read.
        content: Hash of the samples that are kept (:func:`~gyro_pipeline.fingerprints.data_hash`);
            two recordings of one hash are one.
        variables: What is kept, float32, by its name in the recordings: ``angular_rate``
            (axis, sample), NaN where masked; ``temperature_c`` (sample) and ``acceleration_g``
            (axis, sample) where the file has them. Empty for a rejected recording.
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
    def place(self) -> tuple[int, int]:
        """IMU and recording."""
        return self.imu, self.recording


def printable(text: str) -> str:
    """A text that any terminal and file can show: bytes that are no UTF-8 and controls escaped."""
    return "".join(c if c.isprintable() else ascii(c)[1:-1] for c in text)


def with_recordings(recordings: "xr.Dataset") -> "xr.Dataset":
    """Leave out IMUs of which no recording can be used, and recordings of which no IMU's can.

    Args:
        recordings: With ``samples`` (imu, recording), how many samples each recording has.
    """
    there = recordings["samples"].load() > 0
    for dimension, other in (("imu", "recording"), ("recording", "imu")):
        used = there.any(other).to_numpy()
        if not used.all():  # an index of single places makes reading slow
            recordings = recordings.isel({dimension: np.flatnonzero(used)})
    return recordings
