"""Any file as a table: named columns, of numbers or texts."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gyro_pipeline.conventions import InputError
from gyro_pipeline.logs import Finding
from gyro_pipeline.parameters import ReaderOptions

IN_READER = "in `reader:` of the catalog entry in catalog.yml"


@dataclass(frozen=True)
class Table:
    """A file as named columns, all of them read."""

    where: str
    names: tuple[str, ...]
    columns: tuple[NDArray[Any], ...]
    preamble: str = ""
    findings: tuple[Finding, ...] = ()

    def listed(self) -> str:
        """The names for a message, the first thirty."""
        shown = ", ".join(repr(name[:40]) for name in self.names[:30])
        more = ", …" if len(self.names) > 30 else ""  # noqa: PLR2004
        return shown + more if any(self.names) else "no header"

    def numbers(self, column: int) -> NDArray[np.float64]:
        """The values of a column, (n,), for whoever needs numbers."""
        if self.columns[column].dtype != np.float64:
            name = repr(self.names[column] or f"column {column}")
            raise InputError(f"{self.where}: expected numbers in {name}, got texts")
        return self.columns[column]


def read_table(path: Path, options: ReaderOptions) -> Table:
    """Read a file, whichever way it is stored."""
    raise NotImplementedError
