"""Delimited text as a table: Arrow parses it, once; only damaged rows are looked at again."""

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.csv
from numpy.typing import NDArray

from gyro_pipeline.conventions import InputError
from gyro_pipeline.logs import KEPT, REPAIRED, Finding
from gyro_pipeline.parameters import ReaderOptions
from gyro_pipeline.readers.layout import DELIMITERS, Layout, is_header, layout_of, split
from gyro_pipeline.readers.lines import advice, read_lines, unreadable
from gyro_pipeline.readers.table import IN_READER, Table, column, few

_HEAD, _ZEROS = 1 << 14, 0.1  # bytes in which a larger share of zeros is none of a text
_UTF16, _UTF8 = (b"\xff\xfe", b"\xfe\xff"), b"\xef\xbb\xbf"
_COMMENTS = re.compile(rb"(?:\A|(?<=[\r\n]))[ \t]*(?:#|%|//)[^\r\n]*")
_NULLS = ["", " ", "NaN", "nan", "NAN", "-nan", "NA", "N/A", "null", "NULL", "None"]


def read_text(path: Path, options: ReaderOptions) -> Table:
    """Read a text of rows, or of lines if the options say what a row is.

    Raises:
        InputError: It is not a text, or not one of rows that are told apart safely.
    """
    where = str(path)
    data, hint = _decoded(path, options.encoding)
    if options.row is not None:
        return read_lines(where, data, options.row)
    layout = layout_of(where, data, options.delimiter)
    body, findings = _body(data, layout)
    rows = _parse(where, body, layout)
    cells = [column(values, layout.decimal_point) for values in rows.columns]
    bad = {*rows.odd, *(row for _, unread in cells for row in unread)}
    _refuse_second_header(where, rows, bad, layout)
    findings += _odd_rows(where, rows, layout)
    findings += tuple(
        unreadable(
            layout.names[number] or f"column {number}",
            unread,
            rows.count,
            [f"row {row} (line {rows.line_of()[row]})" for row in unread[:3]],
        )
        for number, (_, unread) in enumerate(cells)
        if unread
    )
    columns = tuple(values for values, _ in cells)
    return Table(where, layout.names, columns, layout.preamble, findings, rows.line_of, hint)


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
class _Parsed:
    columns: list[Any]  # Arrow's values, null in odd rows
    count: int  # rows
    odd: dict[int, str]  # what is wrong with rows of another number of fields
    lines: Callable[[], list[tuple[int, str]]]  # number and text of the line of each row

    def line_of(self) -> Sequence[int]:
        return [number for number, _ in self.lines()]

    def shown(self, rows: Sequence[int]) -> str:
        first = [f"row {row} (line {self.line_of()[row]}): {self.odd[row]}" for row in rows[:3]]
        return "; ".join(first) + ("; …" if len(rows) > len(first) else "")


def _parse(where: str, body: memoryview, layout: Layout) -> _Parsed:
    skipped: list[Any] = []

    def skip(row: Any) -> str:
        skipped.append(row)
        return "skip"

    numbers = [str(number) for number in range(len(layout.names))]
    table = pyarrow.csv.read_csv(
        pa.BufferReader(pa.py_buffer(body)),
        pyarrow.csv.ReadOptions(
            use_threads=False,
            block_size=min(len(body) + 1, 2**31 - 1),  # so that no line is too long
            column_names=numbers,
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

    @cache
    def lines() -> list[tuple[int, str]]:
        texts = bytes(body).splitlines()
        return [
            (number, line.decode("utf-8", "replace"))
            for number, line in enumerate(texts, layout.line)
            if line.strip()
        ]

    blank = [row.number - 1 for row in skipped if not row.text.strip()]
    odd = {
        row.number - 1 - int(np.searchsorted(blank, row.number)): (
            f"expected {row.expected_columns} fields, got {row.actual_columns}"
        )
        for row in skipped
        if row.text.strip()
    }
    count = table.num_rows + len(odd)
    if layout.quoted and count != len(lines()):
        raise InputError(
            f"{where}: expected a row on each line, got {count} rows on {len(lines())} lines: a "
            "quoted field does not end on its line; correct it"
        )
    columns = table.columns
    if odd:
        taken = np.insert(
            np.arange(table.num_rows, dtype=float),
            np.array(list(odd)) - np.arange(len(odd)),
            np.nan,
        )
        places = pa.array(taken, pa.int64(), from_pandas=True)
        columns = [values.take(places) for values in columns]
    return _Parsed(columns, count, odd, lines)


def _refuse_second_header(where: str, rows: _Parsed, bad: set[int], layout: Layout) -> None:
    for row in sorted(bad)[:100]:
        line, text = rows.lines()[row]
        if is_header(split(text, layout.delimiter)):
            raise InputError(
                f"{where} line {line} (row {row}): expected numbers, got a second header, "
                f"{text[:80]!r}: two recordings in one file? Split it"
            )


def _odd_rows(where: str, rows: _Parsed, layout: Layout) -> tuple[Finding, ...]:
    """Say which rows have another number of fields, or refuse so many."""
    odd = sorted(rows.odd)
    good = rows.count - len(odd)
    if good < 2 or not few(len(odd), rows.count):  # noqa: PLR2004
        texts = [text for _, text in rows.lines()[:200]]
        raise InputError(
            f"{where}: expected rows of {len(layout.names)} columns, "
            f"{DELIMITERS.get(layout.delimiter, repr(layout.delimiter))}-separated, got {len(odd)} "
            f"of {rows.count} that are not: {rows.shown(odd)}; correct or export the file anew, or, "
            f"if other lines stand between the rows, {advice(texts)}"
        )
    if not odd:
        return ()
    text = f"{len(odd)} of {rows.count} rows cannot be read and are NaN: {rows.shown(odd)}"
    return (Finding("unreadable rows", REPAIRED, text),)
