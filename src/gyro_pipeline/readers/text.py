"""Delimited text as a table: Arrow parses it, once; only damaged rows are looked at again."""

import codecs
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.csv

from gyro_pipeline.conventions import InputError
from gyro_pipeline.logs import REPAIRED, Finding
from gyro_pipeline.parameters import ReaderOptions
from gyro_pipeline.readers.layout import DELIMITERS, Layout, is_header, layout_of, split
from gyro_pipeline.readers.lines import advice, read_lines
from gyro_pipeline.readers.table import IN_READER, Table, columns_of, few

_NULLS = ["", " ", "NaN", "nan", "-nan", "NA", "N/A", "null", "NULL", "None"]


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


def _decoded(path: Path, encoding: str | None) -> tuple[bytes, str]:
    """The text in UTF-8, without byte order mark, and what to say of its names if they look odd."""
    data = path.read_bytes()
    if encoding is not None or data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        try:
            data = data.decode(encoding or "utf-16", "replace").encode()
        except LookupError as error:
            raise InputError(f"{path}: `encoding` {IN_READER}: {error}") from error
    data = data.removeprefix(codecs.BOM_UTF8)
    head = data[: 1 << 14].rstrip(b"\0")
    if head.count(0) > len(head) // 10:
        raise InputError(
            f"{path}: expected a text, got binary data, or UTF-16 without byte order mark; export "
            f"the recording as CSV in UTF-8, or give `encoding: utf-16-le` {IN_READER}"
        )
    text = data if data.isascii() else data.decode("utf-8", "gyro_pipeline.cp1252").encode()
    hint = f"the text is not UTF-8: if names look odd, give `encoding`, as gbk, {IN_READER}"
    return text, hint * (text != data)


def _as_cp1252(error: UnicodeError) -> tuple[str, int]:
    """Bytes that are not UTF-8 are cp1252, so that a degree sign of it is one."""
    assert isinstance(error, UnicodeDecodeError)
    return error.object[error.start : error.end].decode("cp1252", "replace"), error.end


codecs.register_error("gyro_pipeline.cp1252", _as_cp1252)


def _read_rows(where: str, data: bytes, delimiter: str | None) -> Table:
    text = data.rstrip(b"\0")  # an interrupted recording can end in them
    layout = layout_of(where, text, delimiter)
    body = memoryview(text)[layout.start :]  # not a copy
    if layout.delimiter == " ":
        body = memoryview(b"\n".join(b" ".join(row.split()) for row in bytes(body).splitlines()))

    @cache
    def lines() -> list[tuple[int, str]]:
        """Number in the file and text of the line of each row; needed only where one is damaged."""
        rows = enumerate(bytes(body).splitlines(), layout.line)
        return [(number, row.decode()) for number, row in rows if row.strip()]

    def place(row: int) -> str:
        return f"row {row} (line {lines()[row][0]})"

    arrays, odd = _parse(body, layout)
    columns, findings, damaged = columns_of(layout.names, arrays, place, layout.decimal_point)
    for row in sorted(damaged | {*odd})[:100]:
        if is_header(split(lines()[row][1], layout.delimiter)):
            raise InputError(
                f"{where}: expected numbers, got a second header in {place(row)}, "
                f"{lines()[row][1][:80]!r}: two recordings in one file? Split it"
            )
    if odd:
        shown = [f"{place(row)}: {problem}" for row, problem in [*odd.items()][:3]]
        findings = (_odd_rows(where, layout, shown, len(odd), lines()), *findings)
    if len(text) < len(data):
        detail = f"{len(data) - len(text)} zero bytes at the end of the file were left out"
        findings = (Finding("end of file", REPAIRED, detail), *findings)
    return Table(where, layout.names, columns, layout.preamble, findings, place)


def _odd_rows(
    where: str, layout: Layout, shown: list[str], odd: int, lines: list[tuple[int, str]]
) -> Finding:
    """Say that a few rows have another number of fields, or refuse more."""
    if len(lines) - odd >= 2 and few(odd, len(lines)):  # noqa: PLR2004
        detail = f"{odd} of {len(lines)} rows cannot be read and are NaN: {'; '.join(shown)}"
        return Finding("unreadable rows", REPAIRED, detail)
    name = DELIMITERS.get(layout.delimiter, repr(layout.delimiter))
    raise InputError(
        f"{where}: expected rows of {len(layout.names)} columns, separated by {name}, got {odd} of "
        f"{len(lines)} that are not: {'; '.join(shown)}; correct or export the file anew, or, if "
        f"other lines stand between the rows, {advice([text for _, text in lines[:200]])}"
    )


def _parse(body: memoryview, layout: Layout) -> tuple[list[Any], dict[int, str]]:
    """Let Arrow split rows; what it does not take for a number is a text.

    Returns:
        Arrow's columns, and what is wrong with rows of another number of fields, by row, which are
        null in them.
    """
    odd: dict[int, str] = {}
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
            invalid_row_handler=_skip_into(odd),
        ),
        pyarrow.csv.ConvertOptions(
            column_types={str(number): pa.string() for number in layout.texts},
            null_values=_NULLS,
            strings_can_be_null=True,
            decimal_point=layout.decimal_point,
        ),
    )
    if not odd:
        return table.columns, odd
    rows = np.arange(table.num_rows + 0.0)
    rows = np.insert(rows, np.array([*odd]) - np.arange(len(odd)), np.nan)
    return table.take(pa.array(rows, pa.int64(), from_pandas=True)).columns, odd


def _skip_into(odd: dict[int, str]) -> Callable[[Any], str]:
    blank = 0

    def skip(row: Any) -> str:
        nonlocal blank
        if row.text.strip():
            expected = f"expected {row.expected_columns} fields, got {row.actual_columns}"
            odd[row.number - 1 - blank] = expected
        else:  # a line of blanks is no row
            blank += 1
        return "skip"

    return skip
