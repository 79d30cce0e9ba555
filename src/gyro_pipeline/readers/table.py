"""Reads any file as a table of named columns of numbers or texts.

The first bytes of a file determine its type. Nothing here is specific to gyroscopes.
"""

import io
import re
from collections.abc import Callable, Iterator, Sequence
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray

from gyro_pipeline.conventions import IN_READER, InputError
from gyro_pipeline.logs import KEPT, Finding
from gyro_pipeline.parameters import ReaderOptions

_NUMBER = r"^[+-]?((\d+\.?\d*|\.\d+)([eE][+-]?\d+)?|(?i:inf|infinity|nan))$"


@dataclass(frozen=True)
class Table:
    """A file as named columns.

    Attributes:
        where: Path of the file, with a hint if its names may be misread, for messages.
        names: The header, with units in brackets if the file has a row of units; an empty text for
            each column without a name.
        columns: Each (n,): float64, with NaN where a value is missing or cannot be read; objects,
            str or None, for texts; or datetime64[ns] or timedelta64[ns]. The lengths of stored
            arrays can differ.
        preamble: Lines above the header.
        findings: Findings of the reader.
        position: Position of a row, for messages: ``row 5 (line 12)``, rows count from 0.
    """

    where: str
    names: tuple[str, ...]
    columns: tuple[NDArray[Any], ...]
    preamble: str = ""
    findings: tuple[Finding, ...] = ()
    position: Callable[[int], str] = "row {}".format

    def listed(self) -> str:
        """The first thirty names, for a message."""
        names = ", ".join(repr(name[:40]) for name in self.names[:30])
        more = ", …" * (len(self.names) > 30)  # noqa: PLR2004
        return names + more if any(self.names) else "no header"

    def numbers(self, column: int) -> NDArray[np.float64]:
        """The values of a column of numbers, (n,).

        Raises:
            InputError: The column holds texts or dates; the message says where the first is.
        """
        values = self.columns[column]
        if values.dtype == np.float64:
            return values
        expected = f"{self.where}: expected numbers in {self.names[column] or column!r}"
        if values.dtype != object:
            raise InputError(f"{expected}, got {values.dtype}")
        texts = {row: text for row, text in enumerate(values) if text is not None}
        # with decimal commas, numbers with a point are texts
        bad = {n: text for n, text in texts.items() if not re.match(_NUMBER, text)} or texts
        row, text = next(iter(bad.items()))
        raise InputError(
            f"{expected}, without thousands separators, got {text[:40]!r} in {self.position(row)}, "
            f"{len(bad)} of {len(values)} rows are like it; export the file again, or give other "
            f"columns, or `row:` {IN_READER}"
        )


def column(values: NDArray[Any]) -> NDArray[Any]:
    """Stored values, (n,), as a column of a table."""
    if values.dtype.kind in "biuf":
        return np.array(values, np.float64)
    if values.dtype.kind in "mM":
        return values.astype(f"{values.dtype.kind}8[ns]")
    texts = [v.decode("utf-8", "replace") if isinstance(v, bytes) else v for v in values.tolist()]
    return _to_numbers(pa.array([t if t is None else str(t) for t in texts], pa.string()))[0]


def columns_of(
    names: Sequence[str], texts: Sequence[Any], decimal_point: str = "."
) -> tuple[tuple[NDArray[Any], ...], dict[int, str]]:
    """Columns from Arrow strings or numbers, and the texts in columns of numbers, by row."""
    columns, damage = [], dict[int, str]()
    for number, (name, cells) in enumerate(zip(names, texts, strict=True)):
        values, unreadable_cells = _to_numbers(cells, decimal_point)
        columns.append(values)
        damage |= {
            row: f"{text[:40]!r} in {name or number!r}" for row, text in unreadable_cells.items()
        }
    return tuple(columns), damage


def unreadable(
    damage: dict[int, str], rows: int, position: Callable[[int], str]
) -> Iterator[Finding]:
    """A finding about the rows that cannot be read, wholly or in a cell, if any."""
    if damage:
        first = "; ".join(f"{position(row)}: {text}" for row, text in sorted(damage.items())[:3])
        detail = f"{len(damage)} of {rows} rows cannot be read and are NaN, or a cell of them: "
        yield Finding("unreadable rows", KEPT, detail + first + ", …" * (len(damage) > 3))  # noqa: PLR2004


def _to_numbers(texts: Any, decimal_point: str = ".") -> tuple[NDArray[Any], dict[int, str]]:
    """Convert Arrow strings to numbers if almost all are numbers, else to texts.

    Numbers with thousands separators, or with a point where commas are decimal, are texts.

    Returns:
        The column, and the texts, by row, that are NaN in a column of numbers.
    """
    if not pa.types.is_string(texts.type) or texts.null_count == len(texts):
        return texts.cast(pa.float64(), safe=False).to_numpy(zero_copy_only=False), {}
    texts = pc.utf8_trim_whitespace(texts)
    texts = points = pc.if_else(pc.equal(texts, ""), None, texts)
    if decimal_point != ".":
        points = pc.replace_substring(pc.replace_substring(texts, ".", "?"), decimal_point, ".")
    good = pc.fill_null(pc.match_substring_regex(points, _NUMBER), False)
    bad = np.flatnonzero(pc.and_(pc.invert(good), texts.is_valid()))
    if 2 * len(bad) >= len(texts) - texts.null_count > 0 or not few(len(bad), len(texts)):
        return texts.to_numpy(zero_copy_only=False), {}
    values = pc.if_else(good, points, None).cast(pa.float64())
    bad_texts = dict(zip(bad.tolist(), texts.take(pa.array(bad)).to_pylist(), strict=True))
    return values.to_numpy(zero_copy_only=False), bad_texts


def few(bad: int, rows: int, least: int = 3, share: float = 0.01) -> bool:
    """Whether the number of damaged rows is so small that the others are reliable."""
    return bad <= max(least, share * rows)


Reader = Callable[[Path, ReaderOptions], Table]

_ADVICE = {
    **dict.fromkeys(
        (b"BZh", b"\xfd7zXZ", b"\x28\xb5\x2f\xfd", b"7z\xbc\xaf", b"Rar!", b"\x1f\x8b"),
        "an archive; unpack it",
    ),
    b"\xd0\xcf\x11\xe0": "an Excel workbook; save it as CSV",
    **dict.fromkeys((b"<!DOCTYPE", b"<html"), "a web page; download the file itself"),
    b"version https://git-lfs": "a git LFS pointer; fetch the file by `git lfs pull`",
    b"RDX": "data of R; save its table in R by `write.csv(TABLE, 'log.csv', row.names = FALSE)`",
}


def read_table(path: Path, options: ReaderOptions) -> Table:
    """Read a file of any supported type.

    Raises:
        InputError: The file is unreadable, damaged, empty, not a table, or of an unsupported type;
            the message says what to do.
    """
    from gyro_pipeline.readers import stored, text, vehicles  # noqa: PLC0415 - import this module

    head, readers = _head(path), stored.READERS | vehicles.READERS
    read = next((read for magic, read in readers.items() if head.startswith(magic)), None)
    if read is None:
        return text.read_text(path, options)
    try:
        # libraries print what they skip
        with redirect_stdout(io.StringIO()), redirect_stderr(io.StringIO()):
            return read(path, options)
    except InputError:
        raise
    except ImportError as error:
        message = f"expected the library {error.name}, which is not installed; type"
        raise InputError(f"{path}: {message} pip install -e '.[logs]'") from error
    except Exception as error:  # libraries raise many exceptions for damaged bytes
        raise InputError(
            f"{path}: is damaged, cut or of an unknown version ({type(error).__name__}: "
            f"{str(error)[:200]}); copy the file again, a bag with its metadata.yaml, or save only "
            "its columns of numbers"
        ) from error


def _head(path: Path) -> bytes:
    """The first bytes of a file; for a folder that is a bag of ROS 2, those of a bag."""
    try:
        if (path / "metadata.yaml").exists():
            return b"#ROSBAG"
        if path.exists() and not (path.is_file() or path.is_dir()):  # reading a pipe may hang
            raise InputError(f"{path}: expected a file, got a pipe, a socket or a device")
        with path.open("rb") as file:
            head = file.read(64)
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}") from error
    if not head:
        raise InputError(f"{path}: expected a recording, got an empty file; copy it again")
    kind = b"RDX" if path.suffix.lower() in (".rda", ".rdata", ".rds") else head  # compressed
    for magic, advice in _ADVICE.items():
        if kind.startswith(magic):
            raise InputError(f"{path}: expected a recording, got {advice}")
    return head
