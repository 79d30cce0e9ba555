"""How a delimited text is laid out, told from its head: delimiter, header and decimal sign.

Two neighbouring lines of equally many fields, three of which are numbers, are rows; what is above
them is the header and lines of text. Where that leaves a choice, the file is refused.
"""

import csv
import re
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

from gyro_pipeline.conventions import InputError
from gyro_pipeline.readers.lines import advice

DELIMITERS = {",": "comma", ";": "semicolon", "\t": "tab", " ": "blanks"}

_LEAST = 3  # numbers in a row
_COMMENT, _SENTENCE = ("#", "%", "//"), ("$", "!")  # NMEA 0183 begins sentences so
_DECIMAL_COMMA = re.compile(r"[+-]?\d+,\d+([eE][+-]?\d+)?")
_TOKEN = re.compile(r"[^\s(\[]\S*(?:\s+[(\[][^)\]]*[)\]])?|\S+")  # "gx (deg/s)" is one


class _Line(NamedTuple):
    number: int  # in the file, from 1
    end: int  # offset of what follows
    text: str


@dataclass(frozen=True)
class Layout:
    """Where and how the rows of a text are written.

    Attributes:
        names: The header, as long as a row; all empty where there is none.
        preamble: Lines above it.
        start: Offset of the first row.
        line: Its number in the file, from 1.
        delimiter: Between fields; a blank stands for runs of them.
        decimal_point: A point or a comma.
        quoted: Whether fields are in quotes; if not, a stray quote is one more damaged field.
        texts: Columns that are not of numbers alone in the head.
    """

    names: tuple[str, ...]
    preamble: str
    start: int
    line: int
    delimiter: str
    decimal_point: str
    quoted: bool
    texts: tuple[int, ...]


def layout_of(where: str, data: bytes, delimiter: str | None) -> Layout:
    """Tell the layout of a text.

    Args:
        where: For messages.
        data: The text, UTF-8.
        delimiter: Of the options; None: that by which a row has most numbers, blanks last.

    Raises:
        InputError: There are no rows, or they cannot be told safely.
    """
    lines = _head(data)
    delimiters = (delimiter,) if delimiter else tuple(DELIMITERS)
    visible = [d for d in delimiters if d != " "]
    starts = [(*start, d) for d in visible if (start := _first_row(lines, d))]
    if not starts and " " in delimiters and (start := _first_row(lines, " ")):
        starts = [(*start, " ")]
    if not starts:
        shown = lines[0] if lines else _Line(1, 0, "")
        raise InputError(
            f"{where}: expected two rows or more of three numbers or more, separated by "
            f"{' or '.join(DELIMITERS.get(d, repr(d)) for d in delimiters)}, got none in the "
            f"first {len(lines)} lines; line {shown.number} begins {shown.text[:60]!r}; "
            f"{advice([line.text for line in lines])}"
        )
    at, width, _, delimiter = max(starts, key=lambda start: start[2])
    above, rows = lines[:at], [split(line.text, delimiter) for line in lines[at : at + 50]]
    rows = [row for row in rows if len(row) == width]
    names, header = _header(where, above, rows, delimiter)
    return Layout(
        names=names,
        preamble="\n".join(line.text for line in above if line not in header),
        start=above[-1].end if above else 0,
        line=above[-1].number + 1 if above else 1,
        delimiter=delimiter,
        decimal_point=_decimal_point(where, [field for row in rows for field in row]),
        quoted='"' in lines[at].text,
        texts=tuple(
            n for n, column in enumerate(zip(*rows, strict=True)) if not all(map(is_number, column))
        ),
    )


def _head(data: bytes, size: int = 1 << 15) -> list[_Line]:
    """The lines in the head of a text that are not blank, whole if others follow them."""
    if len(data) > size:
        size = 1 + max(data.rfind(b"\n", 0, size), data.rfind(b"\r", 0, size)) or size
    lines, end = [], 0
    for number, line in enumerate(data[:size].splitlines(keepends=True), 1):
        end += len(line)
        if line.strip():
            lines.append(_Line(number, end, line.decode("utf-8", "replace").strip("\r\n")))
    return lines


def split(line: str, delimiter: str) -> list[str]:
    """Fields without quotes and outer blanks; none if the line cannot be split."""
    if delimiter == " ":
        return line.split()
    try:
        return [field.strip() for field in next(csv.reader([line], delimiter=delimiter), [])]
    except csv.Error:  # a field beyond csv's limit
        return []


def is_number(field: str) -> bool:
    """Whether it is a number, with a point or a comma, or NaN or infinity."""
    try:
        float(field.replace(",", "."))
    except ValueError:
        return False
    return True


def is_header(fields: Sequence[str]) -> bool:
    """Whether these are names of columns rather than a row, be it a damaged one."""
    filled = [field for field in fields if field]
    words = [field for field in filled if field.lstrip("[(")[:1].isalpha() and not is_number(field)]
    return len(words) > max(1, len(filled) // 2)


def _first_row(lines: list[_Line], delimiter: str) -> tuple[int, int, int] | None:
    """The index of the first row, and how many fields and numbers rows have; None without rows."""
    rows = [(0, 0)]  # fields and numbers of the lines
    for line in lines:
        rows.append(_counts(line.text, delimiter))
        width, numbers = rows[-1][0], max(rows[-1][1], rows[-2][1])
        if width and width == rows[-2][0] and numbers >= _LEAST:
            break
    else:
        return None
    at = len(rows) - 3
    while rows[at][0] == width or rows[at][1] >= _LEAST:
        at -= 1  # a row of which numbers are missing, or a damaged one
    first = [field for field in split(lines[at].text, delimiter) if is_number(field)]
    numbered = at == 0 and first == [str(number) for number in range(len(first))]  # by pandas
    return at + numbered, width, numbers


def _counts(text: str, delimiter: str) -> tuple[int, int]:
    """How many fields a row has, and how many of them are numbers; no fields if it is no row."""
    if delimiter not in text or text.lstrip().startswith(_COMMENT + _SENTENCE):
        return 0, 0
    fields = split(text, delimiter)
    numbers = sum(map(is_number, fields))
    if delimiter == " ":  # words between blanks are a sentence
        is_row = all(is_number(field) or field[0] in "+-.0123456789" for field in fields)
    else:
        is_row = numbers >= _LEAST or (any(fields) and not is_header(fields))
    return (len(fields), numbers) if is_row and len(fields) >= _LEAST else (0, 0)


def _header(
    where: str, above: list[_Line], rows: list[list[str]], delimiter: str
) -> tuple[tuple[str, ...], list[_Line]]:
    """The names, and the lines they are from: the nearest above the rows that is as wide as they.

    A row of units, and a row of names that span columns, belong to it.
    """
    width = len(rows[0])
    used = max(len(_filled(row)) for row in rows)
    for at in reversed(range(len(above))):
        fields = _fields(above[at].text, delimiter, width, used)
        if _fits(fields, width, used):
            break
        if len(_filled(fields)) >= _LEAST and not above[at].text.lstrip().startswith(_COMMENT):
            shown = ", ".join(repr(name[:40]) for name in fields[:30])
            raise InputError(
                f"{where} line {above[at].number}: expected a header of as many columns as the "
                f"rows, {used}, got {len(_filled(fields))}, {shown}; which is which cannot be "
                "told: correct it"
            )
    else:
        return ("",) * width, []
    end = at + 1
    names = (_filled(fields) + [""] * width)[:width]
    upper = [split(line.text.lstrip("#%/ "), delimiter) for line in above[:at]]
    units = [""] * width
    # neighbours have the same unit but different axes: names repeated side by side are units
    if upper and len(upper[-1]) == width and any(a == b != "" for a, b in pairwise(names)):
        units, names, at = names, upper.pop(), at - 1
    while upper and len(upper[-1]) == width and _is_incomplete(names[:used]):
        names, at = _joined(upper.pop(), names), at - 1
    units = [unit.strip("[]() ") for unit in units]
    names = [f"{name} [{unit}]" if unit else name for name, unit in zip(names, units, strict=True)]
    return tuple(names), above[at:end]


def _filled(fields: list[str]) -> list[str]:
    """Fields without empty ones at the end: a delimiter at the end of a line is no column."""
    return fields[: max((n for n, field in enumerate(fields, 1) if field), default=0)]


def _fits(fields: list[str], width: int, used: int) -> bool:
    """Whether names are those of rows; a delimiter too many or too few would shift them."""
    names = _filled(fields)
    return len(names) == used or (len(fields) == width and "" not in names)


def _fields(text: str, delimiter: str, width: int, used: int) -> list[str]:
    """Names in a header; NumPy and others write it as a comment, and by a delimiter of its own."""
    text = text.lstrip("#%/ ")
    ways = [split(text, d) for d in (delimiter, ",", ";", "\t")] + [_TOKEN.findall(text)]
    return next((fields for fields in ways if _fits(fields, width, used)), ways[0])


def _is_incomplete(names: Sequence[str]) -> bool:
    """Whether names lack the row above them: some are empty, or there more than once."""
    return "" in names or len({*names}) < len(names)


def _joined(upper: Sequence[str], lower: Sequence[str]) -> list[str]:
    """Two rows of a header as one: a name carries on over the empty fields beside it.

    Its unit stays behind the axis: ``Gyro (rad/s)`` above ``X`` is ``Gyro X (rad/s)``.
    """
    joined, span = [], ""
    for name, axis in zip(upper, lower, strict=True):
        span = name or (span if axis else "")
        stem, unit = re.fullmatch(r"(.*?)(\s*[(\[][^)\]]*[)\]])?", span).groups()  # type: ignore[union-attr]
        joined.append(" ".join(filter(None, (stem, axis))) + (unit or ""))
    return joined


def _decimal_point(where: str, fields: list[str]) -> str:
    """A comma where numbers have one that cannot separate thousands."""
    commas = [field for field in fields if "," in field and _DECIMAL_COMMA.fullmatch(field)]
    if commas and all(re.fullmatch(r"[+-]?[1-9]\d*,\d{3}", field) for field in commas):
        raise InputError(
            f"{where}: expected decimal points, or decimal commas, got a comma before three digits "
            f"each time, {commas[0]}, which may separate thousands; export the recording with "
            "decimal points and without thousands separators"
        )
    return "," if commas else "."
