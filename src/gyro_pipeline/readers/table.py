"""A file as named columns."""

from dataclasses import dataclass

from numpy.typing import NDArray

from gyro_pipeline.logs import Finding


@dataclass(frozen=True)
class Table:
    """A file as named columns, all of them read.

    Attributes:
        where: The path, for messages.
        names: The header; ``""`` where it says nothing.
        columns: (n,) each: float64, object (str, None: missing), datetime64 or timedelta64.
        preamble: Lines above the header.
        findings: Of the reading.
    """

    where: str
    names: tuple[str, ...]
    columns: tuple[NDArray, ...]
    preamble: str = ""
    findings: tuple[Finding, ...] = ()
