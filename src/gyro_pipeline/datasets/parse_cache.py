"""Text files that were read once, kept in a form that is read in a hundredth of the time."""

import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

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
    known = {"rate_hz": log.rate_hz, "findings": [asdict(finding) for finding in log.findings]}
    arrays: dict[str, Any] = {"gap_rows": log.gap_rows, "known": np.array(json.dumps(known))}
    with np.errstate(over="ignore"):
        arrays["samples"] = log.samples.astype(np.float32)
    if log.temperature_c is not None:
        arrays["temperature_c"] = log.temperature_c.astype(np.float32)
    with replacing(path) as temporary:
        np.savez(temporary, **arrays)


def _load(path: Path) -> Log | None:
    """None where there is none that can be read."""
    try:
        with np.load(path) as kept:  # never unpickles
            known = json.loads(str(kept["known"]))
            warmth = kept["temperature_c"].astype(np.float64) if "temperature_c" in kept else None
            return Log(
                kept["samples"].astype(np.float64),
                known["rate_hz"],
                kept["gap_rows"],
                warmth,
                tuple(Finding(**finding) for finding in known["findings"]),
            )
    except Exception:  # a damaged file fails in many ways, and is read anew in all of them
        return None
