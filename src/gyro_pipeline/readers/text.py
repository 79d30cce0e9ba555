"""Delimited text as a table: Arrow parses it, once; only damaged rows are looked at again."""

import re
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.csv

from gyro_pipeline.conventions import InputError
from gyro_pipeline.logs import KEPT, REPAIRED, Finding
from gyro_pipeline.parameters import ReaderOptions
from gyro_pipeline.readers.layout import DELIMITERS, Layout, is_header, layout_of, split
from gyro_pipeline.readers.lines import advice, read_lines
from gyro_pipeline.readers.table import IN_READER, Table, columns_of, few

_HEAD, _ZEROS = 1 << 14, 0.1  # bytes in which a larger share of zeros is none of a text
_UTF16, _UTF8 = (b"\xff\xfe", b"\xfe\xff"), b"\xef\xbb\xbf"
_COMMENTS = re.compile(rb"(?:\A|(?<=[\r\n]))[ \t]*(?:#|%|//)[^\r\n]*")
_NULLS = ["", " ", "NaN", "nan", "NAN", "-nan", "NA", "N/A", "null", "NULL", "None"]


def read_text(path: Path, options: ReaderOptions) -> Table:
    """Read a text of rows, or of lines if the options say what a row is.

    Raises:
        InputError: It is not a text, or not one of rows that are told apart safely.
    """
    data, hint = _decoded(path, options.encoding)
    try:
        if options.row is not None:
            return read_lines(str(path), data, options.row)
        return replace(_read_rows(str(path), data, options.delimiter), hint=hint)
    except InputError as error:
        raise InputError(f"{error}{hint and f'; {hint}'}") from error


def _read_rows(where: str, data: bytes, delimiter: str | None) -> Table:
    layout = layout_of(where, data, delimiter)
    body, findings = _body(data, layout)
    rows = _Rows(where, body, layout)
    arrays, odd = _parse(body, layout)
    rows.refuse_quotes_over_lines(len(arrays[0]))
    columns, unread, damaged = columns_of(layout.names, arrays, rows.place, layout.decimal_point)
    rows.refuse_second_header(damaged | {*odd})
    findings += rows.check_odd(odd, len(arrays[0])) + unread
    return Table(where, layout.names, columns, layout.preamble, findings, rows.place)


def _decoded(path: Path, encoding: str | None) -> tuple[bytes, str]:
    """The text in UTF-8, without byte order mark, and what to say of its names if they look odd."""
    data = path.read_bytes()
    if encoding is not None or data.startswith(_UTF16):
        try:
            data = data.decode(encoding or "utf-16", "replace").encode()
        except LookupError as error:
            raise InputError(f"{path}: `encoding` {IN_READER}: {error}") from error
    data = data.removeprefix(_UTF8)
    head = data[:_HEAD].rstrip(b"\0")
    if head.count(0) > len(head) * _ZEROS:
        raise InputError(
            f"{path}: expected a text, got binary data, or UTF-16 without byte order mark; export "
            f"the recording as CSV in UTF-8, or give `encoding: utf-16-le` {IN_READER}"
        )
    if data.isascii() or _is_utf8(data):
        return data, ""
    lines = data.splitlines(keepends=True)  # those with a damaged byte only are read otherwise
    text = b"".join(
        line if _is_utf8(line) else line.decode("cp1252", "replace").encode() for line in lines
    )
    return text, f"the text is not UTF-8: if names look odd, give `encoding`, as gbk, {IN_READER}"


def _is_utf8(data: bytes) -> bool:
    try:
        data.decode()
    except UnicodeDecodeError:
        return False
    return True


def _body(data: bytes, layout: Layout) -> tuple[memoryview, tuple[Finding, ...]]:
    """The rows, without what an interrupted recording leaves behind them, and without comments."""
    findings: tuple[Finding, ...] = ()
    start, end = layout.start, len(data)
    if data.endswith(b"\0"):
        end = len(data.rstrip(b"\0"))
        text = f"{len(data) - end} zero bytes at the end of the file were left out"
        findings += (Finding("end of file", REPAIRED, text),)
    line_end = b"\n" if b"\n" in data else b"\r"
    last = max(start, 1 + data.rfind(line_end, start, end))
    fields = split(data[last:end].decode("utf-8", "replace"), layout.delimiter)
    if fields and len(fields) != len(layout.names):
        text = f"the last line, of {end - last} bytes, is cut and was left out"
        findings += (Finding("end of file", REPAIRED, text),)
        end = last
    body = memoryview(data)[start:end]  # not a copy
    marks = [mark for mark in (b"#", b"%", b"/") if data.find(mark, start) >= 0]
    if marks and (marks != [b"/"] or b"//" in data):  # each is faster than the next
        rows, comments = _COMMENTS.subn(b"", body)  # blank lines are no rows
        if comments:
            body = memoryview(rows)
            text = f"{comments} lines of comment among the rows were left out"
            findings += (Finding("comments", KEPT, text),)
    if layout.delimiter == " ":
        body = memoryview(b"\n".join(b" ".join(line.split()) for line in bytes(body).splitlines()))
    return body, findings


@dataclass(frozen=True)
class _Rows:
    """The rows as lines, which are looked at only where some are damaged."""

    where: str
    body: memoryview
    layout: Layout

    @cached_property
    def lines(self) -> list[tuple[int, str]]:
        """Number in the file and text of the line of each row."""
        text = bytes(self.body).decode().replace("\r\n", "\n").replace("\r", "\n")
        numbered = enumerate(text.split("\n"), self.layout.line)
        return [(number, line) for number, line in numbered if line.strip()]

    def place(self, row: int) -> str:
        return f"row {row} (line {self.lines[row][0]})"

    def refuse_quotes_over_lines(self, count: int) -> None:
        if self.layout.quoted and count != len(self.lines):
            raise InputError(
                f"{self.where}: expected a row on each line, got {count} rows on {len(self.lines)} "
                "lines: a quoted field does not end on its line; correct it"
            )

    def refuse_second_header(self, damaged: set[int]) -> None:
        for row in sorted(damaged)[:100]:
            text = self.lines[row][1]
            if is_header(split(text, self.layout.delimiter)):
                raise InputError(
                    f"{self.where}: expected numbers, got a second header in {self.place(row)}, "
                    f"{text[:80]!r}: two recordings in one file? Split it"
                )

    def check_odd(self, odd: dict[int, str], count: int) -> tuple[Finding, ...]:
        """Say which rows have another number of fields, or refuse so many."""
        shown = "; ".join(f"{self.place(row)}: {text}" for row, text in [*odd.items()][:3])
        if count - len(odd) < 2 or not few(len(odd), count):  # noqa: PLR2004
            name = DELIMITERS.get(self.layout.delimiter, repr(self.layout.delimiter))
            raise InputError(
                f"{self.where}: expected rows of {len(self.layout.names)} columns, separated by "
                f"{name}, got {len(odd)} of {count} that are not: {shown}; correct or export the "
                "file anew, or, if other lines stand between the rows, "
                f"{advice([text for _, text in self.lines[:200]])}"
            )
        text = f"{len(odd)} of {count} rows cannot be read and are NaN: {shown}"
        return (Finding("unreadable rows", REPAIRED, text),) if odd else ()


def _parse(body: memoryview, layout: Layout) -> tuple[list[Any], dict[int, str]]:
    """Let Arrow parse, and tell numbers from texts.

    Returns:
        Arrow's columns, and what is wrong with rows of another number of fields, by row, which are
        null in them.
    """
    skipped: list[Any] = []

    def skip(row: Any) -> str:
        skipped.append(row)
        return "skip"

    table = pyarrow.csv.read_csv(
        pa.BufferReader(pa.py_buffer(body)),
        pyarrow.csv.ReadOptions(
            use_threads=False,
            block_size=min(len(body) + 1, 2**31 - 1),  # so that no line is too long
            column_names=[str(number) for number in range(len(layout.names))],
        ),
        pyarrow.csv.ParseOptions(
            delimiter=layout.delimiter,
            quote_char='"' if layout.quoted else False,
            invalid_row_handler=skip,
        ),
        pyarrow.csv.ConvertOptions(
            column_types={str(number): pa.string() for number in layout.texts},
            null_values=_NULLS,
            true_values=[],
            false_values=[],
            strings_can_be_null=True,
            decimal_point=layout.decimal_point,
        ),
    )
    return _with_odd_rows(table, skipped)


def _with_odd_rows(table: Any, skipped: list[Any]) -> tuple[list[Any], dict[int, str]]:
    odd: dict[int, str] = {}
    blank = 0  # lines of blanks are no rows
    for row in skipped:
        if row.text.strip():
            text = f"expected {row.expected_columns} fields, got {row.actual_columns}"
            odd[row.number - 1 - blank] = text
        else:
            blank += 1
    if not odd:
        return table.columns, {}
    taken = np.arange(table.num_rows + 0.0)
    taken = np.insert(taken, np.array([*odd]) - np.arange(len(odd)), np.nan)
    return table.take(pa.array(taken, pa.int64(), from_pandas=True)).columns, odd
