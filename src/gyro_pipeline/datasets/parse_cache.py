"""Files that were read once, kept in a form that is read in a hundredth of the time of a text."""

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from gyro_pipeline.conventions import InputError
from gyro_pipeline.datasets.atomic import replacing
from gyro_pipeline.logs import Finding, Log
from gyro_pipeline.parameters import ReaderOptions
from gyro_pipeline.readers import read_log


@dataclass(frozen=True)
class Reading:
    """Reads a file of a logger, or what was kept of it when it was read before.

    Samples are kept in float32, as recordings are stored; of a file that is refused, why.

    Attributes:
        path: The file.
        options: How it is read.
        rate_hz: Expected.
        kept_as: The file in which its reading is kept.
    """

    path: Path
    options: ReaderOptions
    rate_hz: float
    kept_as: Path

    def __call__(self) -> Log:
        """Read it.

        Raises:
            InputError: The file cannot be used.
        """
        known = _load(self.kept_as)
        if known is None:
            known = self._read()
            _save(known, self.kept_as)
        if isinstance(known, InputError):
            raise known
        return known

    def _read(self) -> Log | InputError:
        """The recording, or why the file is refused, for good."""
        try:
            return read_log(self.path, self.options, self.rate_hz)
        except InputError as error:
            if _passes(error.__cause__):
                raise
            return error


def _passes(cause: BaseException | None) -> bool:
    """Whether it, or what it comes from, says nothing of the file.

    Of a damaged file libraries raise OSError as well, but only the system's has a number.
    """
    if cause is None:
        return False
    of_system = isinstance(cause, OSError) and cause.errno is not None
    return of_system or isinstance(cause, MemoryError) or _passes(cause.__cause__)


def _save(known: Log | InputError, path: Path) -> None:
    """Arrays one after the other, which takes half the time of an archive of them."""
    if isinstance(known, InputError):
        arrays = [np.array(json.dumps(str(known)))]
    else:
        findings = [[finding.check, finding.outcome, finding.detail] for finding in known.findings]
        said = json.dumps([known.rate_hz, known.gap_rows.tolist(), findings])
        with np.errstate(over="ignore"):
            arrays = [np.array(said), known.samples.astype(np.float32)]
        if known.temperature_c is not None:
            arrays.append(known.temperature_c.astype(np.float32))
    with replacing(path) as temporary, temporary.open("wb") as file:
        for array in arrays:
            np.save(file, array)


def _load(path: Path) -> Log | InputError | None:
    """None where there is nothing that can be read."""
    try:
        with path.open("rb") as file:
            said = json.loads(str(np.load(file)))  # never unpickles
            if isinstance(said, str):
                return InputError(said)
            samples = np.load(file)
            warmth = np.load(file) if file.peek(1) else None
        rate_hz, gap_rows, findings = said
        found = tuple(Finding(*finding) for finding in findings)
        return Log(samples, rate_hz, np.array(gap_rows, np.intp), warmth, found)
    except Exception:  # a damaged file fails in many ways, and is read anew in all of them
        return None
