"""Delimited text as a table: its head tells how it is laid out, then Arrow parses it, once.

Two neighbouring lines of equally many fields, three of which are numbers, are rows; what is above
them is the header and lines of text. Where that leaves a choice, the file is refused. A line below
that has another number of fields is a damaged row.
"""

import codecs
import csv
import re
from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.csv

from gyro_pipeline.conventions import InputError
from gyro_pipeline.logs import REPAIRED, Finding
from gyro_pipeline.parameters import ReaderOptions
from gyro_pipeline.readers.lines import advice, read_lines
from gyro_pipeline.readers.table import IN_READER, Table, columns_of, few

DELIMITERS = {",": "comma", ";": "semicolon", "\t": "tab", " ": "blanks"}

_HEAD = 1 << 14  # bytes that tell the layout
_LEAST = 3  # numbers in a row
_COMMENT, _SENTENCE = ("#", "%", "//"), ("$", "!")  # NMEA 0183 begins sentences so
_MISSING = ["", " ", "NA", "N/A", "null", "NULL", "None"]


class _Layout(NamedTuple):
    names: tuple[str, ...]  # the header, as long as a row; all empty where there is none
    preamble: str  # the lines above it
    above: int  # how many lines of the file are above the rows
    delimiter: str  # a blank stands for runs of them
    decimal_point: str
    quoted: bool  # if fields are not in quotes, a stray quote is one more damaged field
    texts: list[int]  # columns that are not of numbers alone in the head


def read_text(path: Path, options: ReaderOptions) -> Table:
    """Read a text of rows, or of lines if the options say what a row is.

    Raises:
        InputError: It is not a text, or not one of rows that are told apart safely.
    """
    text, hint = _decoded(path, options.encoding)
    try:
        if options.row is not None:
            return read_lines(str(path), text, options.row)
        return replace(_read_rows(str(path), text, options.delimiter), hint=hint)
    except InputError as error:
        raise InputError(f"{error}; {hint}" if hint else str(error)) from error


def _decoded(path: Path, encoding: str | None) -> tuple[bytes, str]:
    """The text in UTF-8, and what to say of its names if they look odd."""
    data = path.read_bytes()
    if data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        encoding = encoding or "utf-16"
    try:
        data = data.decode(encoding, "replace").encode() if encoding else data
    except LookupError as error:
        raise InputError(f"{path}: `encoding` {IN_READER}: {error}") from error
    data = data.removeprefix(codecs.BOM_UTF8).rstrip(b"\0")  # those of a card that lost power
    if b"\0" in data[:1000]:
        raise InputError(
            f"{path}: expected a text, got binary data, or UTF-16 without byte order mark; export "
            f"the recording as CSV in UTF-8, or give `encoding: utf-16-le` {IN_READER}"
        )
    if data.isascii():
        return data, ""
    try:
        data[: data.rfind(b"\n", 0, _HEAD) + 1].decode()
    except UnicodeDecodeError:
        hint = f"the text is not UTF-8: if names look odd, give `encoding`, as gbk, {IN_READER}"
        return data.decode("cp1252", "replace").encode(), hint
    return data.decode("utf-8", "replace").encode(), ""  # a damaged byte is no other encoding


def _read_rows(where: str, text: bytes, delimiter: str | None) -> Table:
    layout = _layout(where, text, delimiter)
    start = sum(map(len, text[:_HEAD].splitlines(keepends=True)[: layout.above]))
    body = memoryview(text)[start:]  # not a copy
    if layout.delimiter == " ":
        body = memoryview(b"\n".join(b" ".join(row.split()) for row in bytes(body).splitlines()))

    @cache  # needed only where rows are damaged
    def lines() -> list[tuple[int, str]]:
        numbered = enumerate(bytes(body).splitlines(), layout.above + 1)
        return [(number, row.decode()) for number, row in numbered if row.strip()]

    def place(row: int) -> str:
        return f"row {row} (line {lines()[row][0]})"

    arrays, odd = _parse(body, layout)
    columns, findings, damaged = columns_of(layout.names, arrays, place, layout.decimal_point)
    for row in sorted(damaged | {*odd})[:100]:
        if _is_header(_split(lines()[row][1], layout.delimiter), layout.names):
            raise InputError(
                f"{where}: expected numbers, got a second header in {place(row)}, "
                f"{lines()[row][1][:80]!r}: two recordings in one file? Split it"
            )
    if odd:
        shown = "; ".join(f"{place(row)}: {problem}" for row, problem in [*odd.items()][:3])
        findings += (_odd_rows(where, layout, len(odd), shown, [row for _, row in lines()]),)
    return Table(where, layout.names, columns, layout.preamble, findings, place)


def _odd_rows(where: str, layout: _Layout, odd: int, shown: str, rows: list[str]) -> Finding:
    """Say that a few rows have another number of fields, or refuse more."""
    if few(odd, len(rows)) and odd < len(rows) - 1:
        detail = f"{odd} of {len(rows)} rows cannot be read and are NaN: {shown}"
        return Finding("unreadable rows", REPAIRED, detail)
    raise InputError(
        f"{where}: expected rows of {len(layout.names)} columns, separated by "
        f"{DELIMITERS.get(layout.delimiter, repr(layout.delimiter))}, got {odd} of {len(rows)} "
        f"that are not: {shown}; correct or export the file anew, or, if other lines stand between "
        f"the rows, {advice(rows[:200])}"
    )


def _parse(body: memoryview, layout: _Layout) -> tuple[list[Any], dict[int, str]]:
    """Let Arrow split rows; what it does not take for a number is a text.

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
            null_values=_MISSING,
            strings_can_be_null=True,
            decimal_point=layout.decimal_point,
        ),
    )
    blank = np.cumsum([not row.text.strip() for row in skipped])  # lines of blanks are no rows
    odd = {
        row.number - 1 - before: f"expected {row.expected_columns} fields, got {row.actual_columns}"
        for row, before in zip(skipped, blank.tolist(), strict=True)
        if row.text.strip()
    }
    if not odd:
        return table.columns, odd
    rows = np.insert(np.arange(table.num_rows + 0.0), [*odd] - np.arange(len(odd)), np.nan)
    return table.take(pa.array(rows, pa.int64(), from_pandas=True)).columns, odd


def _layout(where: str, text: bytes, delimiter: str | None) -> _Layout:
    """Tell the layout of a text: by which delimiter a row has most numbers, blanks last.

    Raises:
        InputError: There are no rows, or they cannot be told safely.
    """
    numbered = _head(text)
    lines = [*numbered.values()]
    delimiters = [delimiter] if delimiter else [*DELIMITERS]
    starts: dict[str, tuple[int, int, int]] = {}
    for sign in delimiters:
        if (sign != " " or not starts) and (start := _first_row(lines, sign)):
            starts[sign] = start
    if not starts:
        number, line = next(iter(numbered.items()), (1, ""))
        raise InputError(
            f"{where}: expected two rows or more of three numbers or more, separated by "
            f"{' or '.join(DELIMITERS.get(d, repr(d)) for d in delimiters)}, got none in the "
            f"first {len(lines)} lines; line {number} begins {line[:60]!r}; {advice(lines)}"
        )
    delimiter = max(starts, key=lambda sign: starts[sign][-1])
    first, width, _ = starts[delimiter]
    rows = [_split(line, delimiter) for line in lines[first : first + 50]]
    rows = [row for row in rows if len(row) == width]
    names, above = _header(where, lines[:first], rows, delimiter)
    return _Layout(
        names=names,
        preamble="\n".join(above),
        above=[0, *numbered][first],
        delimiter=delimiter,
        decimal_point=_decimal_point(where, [field for row in rows for field in row]),
        quoted='"' in lines[first],
        texts=[n for n in range(width) if not all(_is_number(row[n]) for row in rows)],
    )


def _head(text: bytes) -> dict[int, str]:
    """The lines in the head of a text that are not blank, whole if others follow them."""
    head = text[:_HEAD]
    if len(text) > _HEAD:
        head = head[: 1 + max(head.rfind(b"\n"), head.rfind(b"\r"))] or head
    lines = enumerate(head.decode("utf-8", "replace").encode().splitlines(), 1)
    return {number: line.decode() for number, line in lines if line.strip()}


def _split(line: str, delimiter: str) -> list[str]:
    """Fields without quotes and outer blanks; none if the line cannot be split."""
    if delimiter == " ":
        return line.split()
    try:
        return [field.strip() for field in next(csv.reader([line], delimiter=delimiter), [])]
    except csv.Error:  # a field beyond csv's limit
        return []


def _is_number(field: str) -> bool:
    """Whether it is a number, with a point or a comma, or NaN or infinity."""
    try:
        float(field.replace(",", "."))
    except ValueError:
        return False
    return True


def _are_names(fields: Sequence[str]) -> bool:
    """Whether these are names of columns rather than a row, be it a damaged one."""
    filled = [field.lstrip("[(") for field in fields if field]
    words = [field for field in filled if field[:1].isalpha() and not _is_number(field)]
    return len(words) > max(1, len(filled) // 2)


def _is_header(fields: list[str], names: Sequence[str]) -> bool:
    """Whether a line below the header is another one, not a message that has delimiters in it."""
    same = len(fields) == len(names) or _filled(fields) == _filled([*names])
    return same and _are_names(fields)


def _first_row(lines: list[str], delimiter: str) -> tuple[int, int, int] | None:
    """The index of the first row, and how many fields and numbers rows have; None without rows."""
    rows = [(0, 0)]  # fields and numbers of the lines
    for line in lines:
        rows.append(_counts(line, delimiter))
        width, numbers = rows[-1][0], max(rows[-1][1], rows[-2][1])
        if width == rows[-2][0] and numbers >= _LEAST:
            break
    else:
        return None
    at = len(rows) - 3
    while rows[at][0]:  # a row of which numbers are missing, or a damaged one
        at -= 1
    first = [field for field in _split(lines[at], delimiter) if _is_number(field)]
    numbered = at == 0 and first == [str(number) for number in range(len(first))]  # by pandas
    return at + numbered, width, numbers


def _counts(text: str, delimiter: str) -> tuple[int, int]:
    """How many fields a row has, and how many of them are numbers; no fields if it is no row."""
    if delimiter not in text or text.lstrip().startswith(_COMMENT + _SENTENCE):
        return 0, 0
    fields = _split(text, delimiter)
    numbers = sum(map(_is_number, fields))
    figures = [field[:1] in "+-.0123456789" for field in fields if field]  # times and dates, too
    if delimiter == " ":  # words between blanks are a sentence
        is_row = all(figures) or numbers == len(fields)
    else:
        is_row = numbers >= _LEAST or (any(figures) and not _are_names(fields))
    return (len(fields), numbers) if is_row and len(fields) >= _LEAST else (0, 0)


def _header(
    where: str, above: list[str], rows: list[list[str]], delimiter: str
) -> tuple[tuple[str, ...], list[str]]:
    """The names, of the nearest line above the rows that is as wide as they, and the lines left.

    A row of units, and a row of names that span columns, belong to it.
    """
    width, used = len(rows[0]), max(len(_filled(row)) for row in rows)
    for at in reversed(range(len(above))):
        fields = _names(above[at], delimiter, width, used)
        names = _filled(fields)
        if _fit(fields, width, used):
            break
        if len(names) >= _LEAST and not above[at].lstrip().startswith(_COMMENT):
            raise InputError(
                f"{where}: expected a header of as many columns as the rows, {used}, got "
                f"{len(names)}, {', '.join(map(repr, names[:30]))}; which is which cannot be told: "
                "correct it"
            )
    else:
        return ("",) * width, above
    names, units = (names + [""] * width)[:width], [""] * width
    upper = [_split(line.lstrip("#%/ "), delimiter) for line in above[:at]]
    # neighbours have the same unit but different axes: names repeated side by side are units
    if upper and len(upper[-1]) == width and any(a == b != "" for a, b in pairwise(names)):
        names, units = upper.pop(), [unit.strip("[]() ") for unit in names]
    while upper and len(upper[-1]) == width and len({*names[:used]} - {""}) < used:
        names = _joined(upper.pop(), names)  # some are empty, or there more than once
    names = [f"{name} [{unit}]" if unit else name for name, unit in zip(names, units, strict=True)]
    return tuple(names), above[: len(upper)] + above[at + 1 :]


def _filled(fields: list[str]) -> list[str]:
    """Fields without empty ones at the end: a delimiter at the end of a line is no column."""
    return fields[: max((n for n, field in enumerate(fields, 1) if field), default=0)]


def _fit(fields: list[str], width: int, used: int) -> bool:
    """Whether names are those of rows; a delimiter too many or too few would shift them."""
    names = _filled(fields)
    return len(names) == used or (len(fields) == width and "" not in names)


def _names(text: str, delimiter: str, width: int, used: int) -> list[str]:
    """Names in a header; NumPy and others write it as a comment, and by a delimiter of its own."""
    text = text.lstrip("#%/ ")
    ways = [_split(text, d) for d in (delimiter, ",", ";", "\t")]
    ways.append(re.findall(r"[^\s(\[]\S*(?:\s+[(\[][^)\]]*[)\]])?", text))  # gx (deg/s) is one
    return next((fields for fields in ways if _fit(fields, width, used)), ways[0])


def _joined(upper: Sequence[str], lower: Sequence[str]) -> list[str]:
    """Two rows of a header as one: a name carries on over the empty fields beside it.

    Its unit stays behind the axis: ``Gyro (rad/s)`` above ``X`` is ``Gyro X (rad/s)``.
    """
    joined, span = [], ""
    for name, axis in zip(upper, lower, strict=True):
        span = name or (span if axis else "")
        stem, *unit = re.split(r"(?=\s*[(\[])", span, maxsplit=1)
        joined.append(" ".join(filter(None, (stem, axis))) + "".join(unit))
    return joined


def _decimal_point(where: str, fields: list[str]) -> str:
    """A comma where numbers have one that cannot separate thousands."""
    pattern = re.compile(r"[+-]?\d+,\d+([eE][+-]?\d+)?")
    commas = [field for field in fields if "," in field and pattern.fullmatch(field)]
    if commas and all(re.fullmatch(r"[+-]?[1-9]\d*,\d{3}", field) for field in commas):
        raise InputError(
            f"{where}: expected decimal points, or decimal commas, got a comma before three digits "
            f"each time, {commas[0]}, which may separate thousands; export the recording with "
            "decimal points and without thousands separators"
        )
    return "," if commas else "."
