"""Files that were read once, kept in a form that is read in a hundredth of the time of a text."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gyro_pipeline.conventions import AXES, InputError
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
    rate_hz: float | None
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
    """A line of JSON, then the values of each axis, and of the temperature: read at disk speed."""
    said: dict[str, Any]
    values: list[NDArray[np.float64]] = []
    if isinstance(known, InputError):
        said = {"refused": str(known)}
    else:
        warmth = [] if known.temperature_c is None else [known.temperature_c]
        values = [*known.samples.T, *warmth]
        said = {
            "rows": len(known.samples),
            "rate_hz": known.rate_hz,
            "gap_rows": known.gap_rows.tolist(),
            "findings": [[one.check, one.outcome, one.detail] for one in known.findings],
        }
    with replacing(path) as temporary, temporary.open("wb") as file:
        file.write(json.dumps(said).encode() + b"\n")
        with np.errstate(over="ignore"):
            file.write(np.array(values, np.float32).data)


def _load(path: Path) -> Log | InputError | None:
    """None where there is nothing that can be read."""
    try:
        line, values = path.read_bytes().split(b"\n", 1)
        said = json.loads(line)
        if "refused" in said:
            return InputError(said["refused"])
        columns = np.frombuffer(values, np.float32).reshape(-1, said["rows"])
        axes, warmth = columns[: len(AXES)], columns[len(AXES) :]
        if len(axes) < len(AXES):
            return None
        return Log(
            samples=axes.T,
            rate_hz=said["rate_hz"],
            gap_rows=np.array(said["gap_rows"], np.intp),
            temperature_c=warmth[0] if len(warmth) else None,
            findings=tuple(Finding(*one) for one in said["findings"]),
        )
    except Exception:  # a damaged file fails in many ways, and is read anew in all of them
        return None
