"""Any file as a table: named columns, of numbers or texts. Nothing here knows of gyroscopes.

A file is a table, or the option ``row`` makes it one. What a file is, its first bytes tell.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray

from gyro_pipeline.conventions import InputError
from gyro_pipeline.logs import KEPT, Finding
from gyro_pipeline.parameters import ReaderOptions

IN_READER = "in `reader:` of the catalog entry in catalog.yml"

_NUMBER = r"^[+-]?((\d+\.?\d*|\.\d+)([eE][+-]?\d+)?|(?i:inf|infinity|nan))$"
_THOUSANDS = r"^[+-]?\d{1,3}([,' .]\d{3})+([.,]\d+)?$"


@dataclass(frozen=True)
class Table:
    """A file as named columns, all of them read.

    Attributes:
        where: Path of the file, for messages.
        names: The header, with units in brackets where a row or an attribute of units gives them;
            an empty string for each column that it says nothing of.
        columns: Each (n,): float64, with NaN where a value is missing or cannot be read; objects,
            str or None, of a column of texts; or datetime64[ns] or timedelta64[ns]. The columns of
            stored arrays are as long as their arrays, which can differ.
        preamble: Lines above the header.
        findings: Of the reading.
        place: Where a row is, for messages: ``row 5 (line 12)``, the row from 0.
        hint: What may be wrong with the names, for messages that show them.
    """

    where: str
    names: tuple[str, ...]
    columns: tuple[NDArray[Any], ...]
    preamble: str = ""
    findings: tuple[Finding, ...] = ()
    place: Callable[[int], str] = "row {}".format
    hint: str = ""

    def listed(self) -> str:
        """The names for a message, the first thirty, and what may be wrong with them."""
        shown = ", ".join(repr(name[:40]) for name in self.names[:30])
        more = ", …" if len(self.names) > 30 else ""  # noqa: PLR2004
        hint = self.hint if not shown.isascii() else ""
        return (shown + more if any(self.names) else "no header") + (hint and f" ({hint})")

    def numbers(self, column: int) -> NDArray[np.float64]:
        """The values of a column, (n,), for whoever needs numbers.

        Raises:
            InputError: The column is of texts or dates; says where the first is.
        """
        values = self.columns[column]
        if values.dtype == np.float64:
            return values
        name = repr(self.names[column] or f"column {column}")
        if values.dtype != object:
            raise InputError(f"{self.where}: expected numbers in {name}, got {values.dtype}")
        texts = pa.array(values, pa.string())
        bad = np.flatnonzero(numbers(texts)[1])  # none: points where commas are decimal
        bad = bad if len(bad) else np.flatnonzero(texts.is_valid())
        thousands = pc.any(pc.match_substring_regex(texts, _THOUSANDS)).as_py()
        raise InputError(
            f"{self.where}: expected numbers{' without thousands separators' * bool(thousands)} in "
            f"{name}, got {values[bad[0]][:40]!r} in {self.place(int(bad[0]))}, {len(bad)} of "
            f"{len(values)} rows are like it; export the file anew, or give other columns, or "
            f"`row:` {IN_READER}"
        )


def numbers(texts: Any, decimal_point: str = ".") -> tuple[NDArray[np.float64], NDArray[np.bool]]:
    """Texts without outer blanks as numbers; none of those with separators of thousands.

    Args:
        texts: Arrow strings, (n,).
        decimal_point: A point or a comma; where it is a comma, a point is no part of a number.

    Returns:
        The numbers, (n,), NaN for what is none; and which texts are none, (n,).
    """
    points = texts
    if decimal_point != ".":
        points = pc.replace_substring(pc.replace_substring(texts, ".", "?"), decimal_point, ".")
    good = pc.match_substring_regex(points, _NUMBER)
    values = pc.if_else(good, points, None).cast(pa.float64()).to_numpy(zero_copy_only=False)
    return values, ~pc.fill_null(good, True).to_numpy(zero_copy_only=False)


def column(values: Any, decimal_point: str = ".") -> tuple[NDArray[Any], dict[int, str]]:
    """Arrow's values as a column of a table.

    Texts of which all but a few are numbers are numbers.

    Returns:
        The column, and the texts in a column of numbers, by row, which are NaN in it.
    """
    if not pa.types.is_string(values.type):
        return _typed(values), {}
    texts = pc.utf8_trim_whitespace(values)
    texts = pc.if_else(pc.equal(texts, ""), None, texts)
    result, unread = numbers(texts, decimal_point)
    rows = np.flatnonzero(unread)
    if len(rows) and (
        2 * len(rows) >= len(texts) - texts.null_count or not few(len(rows), len(texts))
    ):
        return texts.to_numpy(zero_copy_only=False), {}
    return result, dict(zip(rows.tolist(), texts.take(pa.array(rows)).to_pylist(), strict=True))


def columns_of(
    names: Sequence[str], arrays: Sequence[Any], place: Callable[[int], str], decimal_point: str
) -> tuple[tuple[NDArray[Any], ...], tuple[Finding, ...], set[int]]:
    """Columns of a text, what is unreadable in those of numbers, and in which rows."""
    cells = [column(values, decimal_point) for values in arrays]
    findings = []
    for number, (name, (values, unread)) in enumerate(zip(names, cells, strict=True)):
        if unread:
            first = [f"{text[:40]!r} in {place(row)}" for row, text in [*unread.items()][:3]]
            text = f"{len(unread)} of {len(values)} cells of {name or f'column {number}'!r} are no "
            text += f"numbers and are NaN: {', '.join(first)}{', …' * (len(unread) > len(first))}"
            findings.append(Finding("unreadable cells", KEPT, text))
    rows = {row for _, unread in cells for row in unread}
    return tuple(values for values, _ in cells), tuple(findings), rows


def few(bad: int, rows: int) -> bool:
    """Whether so few rows are damaged, one in a hundred or three, that the others are trusted."""
    return bad <= max(3, 0.01 * rows)


def _typed(values: Any) -> NDArray[Any]:
    kind = values.type
    if pa.types.is_dictionary(kind):
        return column(values.cast(kind.value_type))[0]
    if pa.types.is_time(kind):
        values = values.cast(pa.time64("ns")).cast(pa.int64()).cast(pa.duration("ns"))
    for to in (pa.float64(), pa.timestamp("ns", getattr(kind, "tz", None)), pa.duration("ns")):
        try:
            return np.array(values.cast(to, safe=to != pa.float64()).to_numpy(zero_copy_only=False))
        except (pa.ArrowInvalid, pa.ArrowNotImplementedError):
            continue
    return np.array([None if value is None else str(value) for value in values.to_pylist()], object)


_PAGE = "a web page; download the file itself (on GitHub: `Download raw file`)"
_ADVICE = {
    b"BZh": "a bzip2 archive; unpack it",
    b"\xfd7zXZ": "an xz archive; unpack it",
    b"\x28\xb5\x2f\xfd": "a zstd archive; unpack it",
    b"7z\xbc\xaf": "a 7z archive; unpack it",
    b"Rar!": "a RAR archive; unpack it",
    b"\x1f\x8b": "a gzip archive; unpack it with gunzip",
    b"\xd0\xcf\x11\xe0": "an Excel workbook (.xls), whatever its name; save it as CSV",
    b"%PDF": "a PDF document; export the recording as CSV",
    b"<!DOCTYPE": _PAGE,
    b"<html": _PAGE,
    b"version https://git-lfs": "a git LFS pointer to a file; fetch the file by `git lfs pull`",
}
_R = "data of R; save its table in R by `write.csv(TABLE, 'log.csv', row.names = FALSE)`"
_VEHICLES = (b"ULog\x01\x12\x35", b"#ROSBAG", b"\x89MCAP", b"SQLite format 3", b"\xa3\x95")
_HDF5 = b"\x89HDF\r\n\x1a\n"
_USER_BLOCK = 512  # bytes of MATLAB's own header before HDF5 begins


def read_table(path: Path, options: ReaderOptions) -> Table:
    """Read a file, whichever way it is stored.

    Raises:
        InputError: It cannot be read, is damaged or empty, is no table, or is of a kind that is
            not read; says what to do.
    """
    from gyro_pipeline.readers import stored, text  # noqa: PLC0415 - they make tables

    head = _head(path)
    if head is None or head.startswith(_VEHICLES):
        from gyro_pipeline.readers import vehicles  # noqa: PLC0415 - its libraries are optional

        return vehicles.read(path, options)
    for recognised, read in (
        (head.startswith(b"PAR1"), stored.read_parquet),
        (head.startswith(b"\x93NUMPY"), stored.read_npy),
        (head.startswith(b"PK"), stored.read_npz),
        (head.startswith(_HDF5) or head[_USER_BLOCK:] == _HDF5, stored.read_hdf5),
        (head.startswith(b"MATLAB "), stored.read_mat5),
    ):
        if recognised:
            return stored.guarded(path, read)
    return text.read_text(path, options)


def _head(path: Path) -> bytes | None:
    """The first bytes of a file; None of the folder of a ROS 2 bag."""
    try:
        if (path / "metadata.yaml").exists():
            return None
        with path.open("rb") as file:
            head = file.read(_USER_BLOCK + len(_HDF5))
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}") from error
    if not head:
        raise InputError(f"{path}: expected a recording, got an empty file; copy it anew")
    if path.suffix.lower() in (".rda", ".rdata", ".rds") or head.startswith((b"RDX", b"RDA")):
        raise InputError(f"{path}: expected a recording, got {_R}")
    for magic, advice in _ADVICE.items():
        if head.startswith(magic):
            raise InputError(f"{path}: expected a recording, got {advice}")
    return head
