"""Text files that were read once, kept in a form that is read in a hundredth of the time."""

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from gyro_pipeline.datasets.atomic import replacing
from gyro_pipeline.logs import Finding, Log
from gyro_pipeline.parameters import ReaderOptions
from gyro_pipeline.readers import read_log


@dataclass(frozen=True)
class Reading:
    """Reads a file of a logger, or what was kept of it when it was read before.

    Samples are kept in float32, as recordings are stored.

    Attributes:
        path: The file.
        options: How it is read.
        rate_hz: Expected.
        kept_as: The file in which its reading is kept; None: it is not.
    """

    path: Path
    options: ReaderOptions
    rate_hz: float
    kept_as: Path | None

    def __call__(self) -> Log:
        """Read it.

        Raises:
            InputError: The file cannot be used.
        """
        kept = None if self.kept_as is None else _load(self.kept_as)
        if kept is not None:
            return kept
        log = read_log(self.path, self.options, self.rate_hz)
        if self.kept_as is not None:
            _save(log, self.kept_as)
        return log


def _save(log: Log, path: Path) -> None:
    """Arrays one after the other, which takes half the time of an archive of them."""
    findings = [[finding.check, finding.outcome, finding.detail] for finding in log.findings]
    known = json.dumps([log.rate_hz, log.gap_rows.tolist(), findings])
    with np.errstate(over="ignore"):
        arrays = [np.array(known), log.samples.astype(np.float32)]
    if log.temperature_c is not None:
        arrays.append(log.temperature_c.astype(np.float32))
    with replacing(path) as temporary, temporary.open("wb") as file:
        for array in arrays:
            np.save(file, array)


def _load(path: Path) -> Log | None:
    """None where there is none that can be read."""
    try:
        with path.open("rb") as file:
            known, samples = np.load(file), np.load(file)  # never unpickles
            warmth = np.load(file) if file.peek(1) else None
        rate_hz, gap_rows, findings = json.loads(str(known))
        found = tuple(Finding(*finding) for finding in findings)
        return Log(samples, rate_hz, np.array(gap_rows, np.intp), warmth, found)
    except Exception:  # a damaged file fails in many ways, and is read anew in all of them
        return None
