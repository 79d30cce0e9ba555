"""Reads delimited text as a table: the head determines the layout, then Arrow parses the rows once.

Two neighbouring lines with the same number of fields, three of which are numbers, are rows. Above
the first row are the header and lines of text. An ambiguous layout is refused. A line below with
another number of fields is a damaged row.
"""

import codecs
import csv
import re
from dataclasses import dataclass
from functools import cached_property
from itertools import chain, pairwise
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.csv

from gyro_pipeline.conventions import IN_READER, InputError
from gyro_pipeline.parameters import ReaderOptions
from gyro_pipeline.readers.lines import advice, read_lines
from gyro_pipeline.readers.table import Table, columns_of, few, unreadable

DELIMITERS = ",;\t "  # a blank stands for one or more blanks

_HEAD = 1 << 14  # bytes that determine the layout
_SAMPLE = 50  # rows of the head that determine decimal commas and columns of texts
_LEAST = 3  # least numbers in a row
_COMMENT = ("#", "%", "//")
_NO_ROW = (*_COMMENT, "$", "!")  # the latter begin sentences of NMEA 0183
_MISSING = ["", " ", "NA", "N/A", "null", "NULL", "None"]

Row = list[str]


@dataclass(frozen=True)
class _Rows:
    """Rows of a text and their layout."""

    where: str
    names: tuple[str, ...]  # the header, as long as a row; all empty without a header
    preamble: str  # the lines above the header
    above: int  # number of lines of the file above the rows
    body: memoryview
    delimiter: str  # a blank stands for one or more blanks
    decimal_point: str
    quoted: bool  # whether fields may be quoted; otherwise a stray quote damages only its field
    texts: list[bool]  # whether a column has other values than numbers in the head

    @cached_property  # needed only if rows are damaged
    def numbered(self) -> list[tuple[int, str]]:
        """Line numbers from 1 and lines, without blank lines."""
        lines = enumerate(bytes(self.body).splitlines(), self.above + 1)
        return [(n, line.decode("utf-8", "replace")) for n, line in lines if line.strip()]

    def position(self, row: int) -> str:
        """Position of a row, for messages."""
        return f"row {row} (line {self.numbered[row][0]})"

    def repaired(self) -> tuple[bytes, dict[int, str]]:
        """The body with empty rows in place of rows with a wrong number of fields, and problems."""
        width, lines, problems = len(self.names), [line for _, line in self.numbered], {}
        for row, line in enumerate(lines):
            fields = line.count(self.delimiter) + 1
            if self.quoted:
                fields = len(_split(line, self.delimiter, strict=True))
            if fields != width:
                problems[row] = f"expected {width} fields, got {fields or 'damaged quotes'}"
                lines[row] = self.delimiter * (width - 1)
        return "\n".join(lines).encode(), problems


def read_text(path: Path, options: ReaderOptions) -> Table:
    """Read a text of delimited rows, or of lines with the option ``row``.

    Raises:
        InputError: The file is not a text, or its layout is ambiguous.
    """
    where, text = _decode(path, options.encoding)
    if options.row is not None:
        return read_lines(where, text, options.row)
    rows, misshapen = _rows(where, text, options.delimiter), dict[int, str]()
    try:
        arrays = _parse(rows.body, rows, pa.float64())
    except pa.ArrowInvalid:
        body, misshapen = rows.repaired()
        arrays = _parse(body, rows, None)
    columns, damage = columns_of(rows.names, arrays, rows.decimal_point)
    if damage or misshapen:
        damage |= misshapen
        _refuse_damage(rows, damage, misshapen)
    findings = unreadable(damage, len(columns[0]), rows.position)
    return Table(where, rows.names, columns, rows.preamble, (*findings,), rows.position)


def _parse(body: memoryview | bytes, rows: _Rows, number: pa.DataType | None) -> list[Any]:
    """Parse columns by Arrow; ``number`` is the type of columns of numbers, None: inferred.

    Raises:
        pyarrow.ArrowInvalid: A value is not of its type, or a row has a wrong number of fields.
    """
    types = {str(n): pa.string() if is_text else number for n, is_text in enumerate(rows.texts)}
    table = pyarrow.csv.read_csv(
        pa.BufferReader(pa.py_buffer(body)),
        pyarrow.csv.ReadOptions(
            use_threads=False,
            block_size=min(len(body) + 1, 2**31 - 1),  # so that no line is too long
            column_names=[*types],
        ),
        pyarrow.csv.ParseOptions(delimiter=rows.delimiter, quote_char=rows.quoted and '"'),
        pyarrow.csv.ConvertOptions(
            column_types={name: kind for name, kind in types.items() if kind},
            null_values=_MISSING,
            strings_can_be_null=True,
            decimal_point=rows.decimal_point,
        ),
    )
    return list(table.columns)


def _refuse_damage(rows: _Rows, damage: dict[int, str], misshapen: dict[int, str]) -> None:
    """Refuse a second header among damaged rows, and more than a few misshapen rows.

    A message with some delimiters is not a header.
    """
    lines = [line for _, line in rows.numbered]
    for row in sorted(damage)[:100]:
        fields = _split(lines[row], rows.delimiter)
        as_wide = len(fields) == len(rows.names) or _filled(fields) == _filled([*rows.names])
        if as_wide and not _is_row(fields):
            raise InputError(
                f"{rows.where}: expected numbers, got a second header in {rows.position(row)}, "
                f"{lines[row][:80]!r}: two recordings in one file? Split it"
            )
    count = len(misshapen)
    if not few(count, len(lines)) or count >= len(lines) - 1:
        first = [*misshapen.items()][:3]
        problems = "; ".join(f"{rows.position(row)}: {problem}" for row, problem in first)
        raise InputError(
            f"{rows.where}: expected rows of {len(rows.names)} columns, separated by "
            f"{rows.delimiter!r}, got {count} of {len(lines)} that are not: {problems}; correct "
            "the file or export it again, or, if other lines are between the rows, "
            f"{advice(lines[:200])}"
        )


def _decode(path: Path, encoding: str | None) -> tuple[str, bytes]:
    """The path, with a hint for messages, and the text in UTF-8; damaged bytes may remain."""
    data = path.read_bytes()
    if data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        encoding = encoding or "utf-16"
    try:
        data = data.decode(encoding, "replace").encode() if encoding else data
    except LookupError as error:
        raise InputError(f"{path}: `encoding` {IN_READER}: {error}") from error
    data = data.removeprefix(codecs.BOM_UTF8).rstrip(b"\0")  # zeros from a loss of power
    if b"\0" in data[:1000]:
        raise InputError(
            f"{path}: expected a text, got binary data, or UTF-16 without byte order mark; export "
            f"the recording as CSV in UTF-8, or give `encoding: utf-16-le` {IN_READER}"
        )
    try:
        data[: data.rfind(b"\n", 0, _HEAD) + 1].decode()
    except UnicodeDecodeError:
        hint = f"not UTF-8: if names look odd, give `encoding`, such as gbk, {IN_READER}"
        return f"{path} ({hint})", data.decode("cp1252", "replace").encode()
    return str(path), data


def _rows(where: str, text: bytes, delimiter: str | None) -> _Rows:
    """Determine the layout: the delimiter is the one with most numbers in a row, blanks last.

    Raises:
        InputError: The text has no rows, or the layout is ambiguous.
    """
    head = text[:_HEAD]
    if len(text) > _HEAD:  # without the last, incomplete line
        head = head[: 1 + max(head.rfind(b"\n"), head.rfind(b"\r"))] or head
    raw_lines = head.splitlines(keepends=True)
    decoded = enumerate(line.decode("utf-8", "replace").strip("\r\n") for line in raw_lines)
    numbered = {number: line for number, line in decoded if line.strip()}
    lines, delimiters = [*numbered.values()], delimiter or DELIMITERS
    present = [sign for sign in delimiters if sign.encode() in head]
    starts = {sign: start for sign in present if (start := _first_row(lines, sign))}
    if not starts:
        number, line = next(iter(numbered.items()), (0, ""))
        raise InputError(
            f"{where}: expected at least two rows of at least three numbers, separated by "
            f"{' or '.join(map(repr, delimiters))}, got none in the "
            f"first {len(lines)} lines; line {number + 1} begins {line[:60]!r}; {advice(lines)}"
        )
    delimiter = max(starts, key=lambda sign: (sign != " ", starts[sign][-1]))
    first, width, _ = starts[delimiter]
    samples = [_split(line, delimiter) for line in lines[first : first + _SAMPLE]]
    columns = list(zip(*(row for row in samples if len(row) == width), strict=True))
    used = max(number for number, column in enumerate(columns, 1) if any(column))
    names, preamble = _header(where, lines[:first], delimiter, width, used)
    above = [*numbered][first]
    body = memoryview(text)[sum(map(len, raw_lines[:above])) :]  # not a copy
    if delimiter == " ":
        body = memoryview(b"\n".join(b" ".join(row.split()) for row in bytes(body).splitlines()))
    return _Rows(
        where=where,
        names=names,
        preamble="\n".join(preamble),
        above=above,
        body=body,
        delimiter=delimiter,
        decimal_point=_decimal_point(where, [*chain(*columns)]),
        quoted='"' in lines[first],
        texts=[not _are_numbers(*column) for column in columns],
    )


def _split(line: str, delimiter: str, strict: bool = False) -> Row:
    """Fields without quotes and outer blanks; empty if ``strict`` and quotes are damaged."""
    if delimiter == " ":
        return line.split()
    fields = line.split(delimiter)
    if '"' in line:
        try:
            fields = next(csv.reader([line], delimiter=delimiter, strict=strict))
        except csv.Error:  # an open quote, or a field beyond csv's limit
            return []
    return [field.strip() for field in fields]


def _are_numbers(*fields: str) -> bool:
    """Whether all fields are numbers, with a point or a comma, or NaN or infinity."""
    try:
        for field in fields:
            float(field.replace(",", "."))
    except ValueError:
        return False
    return True


def _figures(fields: Row) -> int:
    """Number of fields that are numbers, times or dates."""
    return sum(field[:1] in "+-.0123456789" or _are_numbers(field) for field in fields if field)


def _is_row(fields: Row) -> bool:
    """Whether three, or half, of the fields are numbers, times or dates, rather than names."""
    filled = len(fields) - fields.count("")
    return _figures(fields) >= min(_LEAST, max(1, filled / 2))


def _first_row(lines: list[str], delimiter: str) -> tuple[int, int, int] | None:
    """Index of the first row, and numbers of fields and of numbers in rows; None without rows."""
    shapes = [(0, 0)]  # numbers of fields and of numbers of each row; 0 for other lines
    for line in lines:
        is_candidate = delimiter in line and not line.lstrip().startswith(_NO_ROW)
        fields = _split(line, delimiter) if is_candidate else []
        is_row = len(fields) >= _LEAST and _is_row(fields)
        if delimiter == " ":  # words separated by blanks are a sentence
            is_row = is_row and _figures(fields) == len(fields)
        shapes.append((len(fields), sum(map(_are_numbers, fields))) if is_row else (0, 0))
        width, numbers = shapes[-1][0], max(shapes[-2][1], shapes[-1][1])
        if width == shapes[-2][0] and numbers >= _LEAST:
            break
    else:
        return None
    first = len(shapes) - 3
    while shapes[first][0]:  # a row with missing numbers, or a damaged row
        first -= 1
    labels = [field for field in _split(lines[first], delimiter) if _are_numbers(field)]
    is_header = first == 0 and labels == [str(n) for n in range(len(labels))]  # pandas' default
    return first + is_header, width, numbers


def _header(
    where: str, above: list[str], delimiter: str, width: int, used: int
) -> tuple[tuple[str, ...], list[str]]:
    """The names, in the last line above the rows of the same width, and the remaining lines.

    A row of units, and rows of names that span columns, belong to the header. Rows have ``width``
    fields; after the first ``used`` fields all are empty.
    """
    bare = [line.lstrip("#%/ ") for line in above]
    for at in reversed(range(len(above))):
        if names := _names(bare[at], delimiter, width, used):
            break
        names = _filled(_split(bare[at], delimiter))
        if len(names) >= _LEAST and not above[at].lstrip().startswith(_COMMENT):
            raise InputError(
                f"{where}: expected a header of as many columns as the rows, {used}, got "
                f"{len(names)}, {', '.join(map(repr, names[:30]))}, which cannot be assigned to "
                "columns: correct it"
            )
    else:
        return ("",) * width, above
    upper, units = [_split(line, delimiter) for line in bare[:at]], [""] * width
    # neighbours have the same unit but different axes, so repeated neighbours are units
    if upper and len(upper[-1]) == width and any(a == b != "" for a, b in pairwise(names)):
        names, units = upper.pop(), [unit.strip("[]() ") for unit in names]
    while upper and len(upper[-1]) == width and len({*names[:used]} - {""}) < used:
        names = _joined(upper.pop(), names)  # some names are empty or repeated
    names = [f"{name} [{unit}]" if unit else name for name, unit in zip(names, units, strict=True)]
    return tuple(names), above[: len(upper)] + above[at + 1 :]


def _names(line: str, delimiter: str, width: int, used: int) -> Row:
    """The names in a header, one per field of a row; empty if their number differs.

    NumPy and other programs write headers with another delimiter than rows.
    """
    rows = [_split(line, sign) for sign in (delimiter, *DELIMITERS)]
    rows.append(re.findall(r"[^\s(\[]\S*(?:\s+[(\[][^)\]]*[)\]])?", line))  # gx (deg/s) is one
    for fields in rows:
        names = _filled(fields)
        if len(names) == used or (len(fields) == width and "" not in names):
            return (names + [""] * width)[:width]
    return []


def _filled(fields: Row) -> Row:
    """Fields without empty ones at the end, as a delimiter at the end of a line adds no column."""
    return fields[: max((n for n, field in enumerate(fields, 1) if field), default=0)]


def _joined(upper: Row, lower: Row) -> Row:
    """Join two rows of a header; a name in the upper row spans the empty fields after it.

    Its unit moves to the end: ``Gyro (rad/s)`` above ``X`` becomes ``Gyro X (rad/s)``.
    """
    joined, span = [], ""
    for name, axis in zip(upper, lower, strict=True):
        span = name or (span if axis else "")
        stem, *unit = re.split(r"(?=\s*[(\[])", span, maxsplit=1)
        joined.append(" ".join(filter(None, (stem, axis))) + "".join(unit))
    return joined


def _decimal_point(where: str, fields: Row) -> str:
    """A comma if numbers have commas that cannot be thousands separators, else a point."""
    commas = [field for field in fields if "," in field]
    commas = [field for field in commas if re.fullmatch(r"[+-]?\d+,\d+([eE][+-]?\d+)?", field)]
    if commas and all(re.fullmatch(r"[+-]?[1-9]\d*,\d{3}", field) for field in commas):
        raise InputError(
            f"{where}: expected decimal points, or decimal commas, got a comma before three digits "
            f"each time, {commas[0]}, which may separate thousands; export the recording with "
            "decimal points and without thousands separators"
        )
    return "," if commas else "."
