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
from gyro_pipeline.readers.lines import advice, is_sentence

DELIMITERS = {",": "comma", ";": "semicolon", "\t": "tab", " ": "blanks"}

_HEAD = 1 << 15
_LEAST = 3  # numbers in a row
_SEPARATOR_LINE = re.compile(r'"?sep=(.)"?,*', re.IGNORECASE)
_DIGITS = re.compile(r"[\d:.,/TZ +-]+")  # of numbers, times and dates
_TOKEN = re.compile(r"[^\s(\[]\S*(?:\s+[(\[][^)\]]*[)\]])?|\S+")  # "gx (deg/s)" is one
_WITH_BOTH = re.compile(r"\d,\d{3}\.\d|\d\.\d{3},\d")


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
        texts: Columns whose first field is no number.
    """

    names: tuple[str, ...]
    preamble: str
    start: int
    line: int
    delimiter: str
    decimal_point: str
    quoted: bool
    texts: frozenset[int]


class _Rows(NamedTuple):
    delimiter: str
    at: int  # index of the first row among the lines
    fields: Sequence[str]  # of the first undamaged one
    numbers: int  # most in a row


def layout_of(where: str, data: bytes, delimiter: str | None) -> Layout:
    """Tell the layout of a text.

    Args:
        where: For messages.
        data: The text, UTF-8.
        delimiter: Of the options; None: told, runs of blanks last.

    Raises:
        InputError: There are no rows, or they cannot be told safely.
    """
    lines = _head_lines(data)
    rows = _find_rows(where, lines, delimiter, data)
    above = lines[: rows.at]
    head = [split(line.text, rows.delimiter) for line in lines[rows.at : rows.at + 20]]
    alike = [fields for fields in head if len(fields) == len(rows.fields)]
    names, header = _header(where, above, rows.fields, rows.delimiter)
    start = above[-1].end if above else 0
    text = data[start : start + _HEAD].decode("utf-8", "replace")
    first = [next(filter(None, fields), "0") for fields in zip(*alike, strict=True)]
    return Layout(
        names=names,
        preamble="\n".join(line.text for line in above if line not in header),
        start=start,
        line=above[-1].number + 1 if above else 1,
        delimiter=rows.delimiter,
        decimal_point=_decimal_point(where, text, rows.delimiter),
        quoted='"' in lines[rows.at].text,
        texts=frozenset(n for n, field in enumerate(first) if not is_number(field)),
    )


def _head_lines(data: bytes) -> list[_Line]:
    """The lines in the head of a text that are not blank, and whole if others follow them."""
    lines, end = [], 0
    for number, line in enumerate(data[:_HEAD].splitlines(keepends=True), 1):
        end += len(line)
        if end == _HEAD < len(data) and not line.endswith((b"\n", b"\r")):
            break
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
    if fields and fields[0].lower().startswith("sep="):
        return True
    filled = [field for field in fields if field]
    words = [field for field in filled if field[0].isalpha() and not is_number(field)]
    return len(words) > max(1, len(filled) // 2)


def _is_comment(line: str) -> bool:
    return line.lstrip().startswith(("#", "%", "//"))


def _find_rows(where: str, lines: list[_Line], delimiter: str | None, data: bytes) -> _Rows:
    """Find rows by each delimiter: that which makes most numbers is taken, blanks come last."""
    said = _SEPARATOR_LINE.fullmatch(lines[0].text) if lines else None
    asked = delimiter or (said[1] if said else None)
    tried = (asked,) if asked else tuple(DELIMITERS)
    visible = [rows for each in tried if each != " " and (rows := _rows_by(each, lines))]
    candidates = visible or [rows for rows in [" " in tried and _rows_by(" ", lines)] if rows]
    if not candidates:
        shown = lines or [_Line(1, 0, data[:_HEAD].decode("utf-8", "replace"))]
        raise InputError(
            f"{where}: expected two rows or more of three numbers or more, separated by "
            f"{' or '.join(DELIMITERS.get(each, repr(each)) for each in tried)}, got none in the "
            f"first {len(lines)} lines; line {shown[0].number} begins {shown[0].text[:60]!r}; "
            f"{advice([line.text for line in shown])}"
        )
    return max(candidates, key=lambda rows: rows.numbers)


def _rows_by(delimiter: str, lines: list[_Line]) -> _Rows | None:
    start, width, numbers = 0, 0, 0
    for at, line in enumerate(lines):
        fields, count = _row(line.text, delimiter, at == 0)
        if len(fields) != width:
            start, width, numbers = at, len(fields), 0
        numbers = max(numbers, count)
        if width and at > start and numbers >= _LEAST:
            first = split(lines[start].text, delimiter)
            while start and _row(lines[start - 1].text, delimiter, start == 1)[1] >= _LEAST:
                start -= 1  # damaged ones, of another width
            return _Rows(delimiter, start, first, numbers)
    return None


def _row(text: str, delimiter: str, first: bool = False) -> tuple[Sequence[str], int]:
    """Fields of a line and how many of them are numbers; no fields of a line that is no row."""
    if delimiter not in text or _is_comment(text) or is_sentence(text):
        return (), 0
    fields = split(text, delimiter)
    filled = [field for field in fields if field]
    count = sum(map(is_number, filled))
    if first and filled == [str(number) for number in range(len(filled))]:  # numbered columns
        return (), 0
    if delimiter == " ":  # words between blanks are a sentence
        is_row = all(is_number(field) or _DIGITS.fullmatch(field) for field in filled)
    else:
        some = count > 0 or any(map(_DIGITS.fullmatch, filled))
        is_row = count >= _LEAST or (some and not is_header(fields))
    return (fields, count) if is_row and len(fields) >= _LEAST else ((), 0)


def _header(
    where: str, above: list[_Line], row: Sequence[str], delimiter: str
) -> tuple[tuple[str, ...], list[_Line]]:
    """The names, and the lines they are from: the line next to the rows, or one as wide as they.

    A row of units, and a row of names that span columns, belong to it.
    """
    width = len(row)
    widths = [len(_fields(line.text, delimiter, width)) for line in above]
    for at in reversed(range(len(above))):
        by_width = abs(widths[at] - width) <= (not _is_comment(above[at].text))
        nearest = at == len(above) - 1 and not _is_comment(above[at].text)
        if by_width or (nearest and widths[at] >= _LEAST):
            break
    else:
        return ("",) * width, []
    rows = [_fields(line.text, delimiter, width) for line in above[: at + 1]]
    names, units = rows.pop(), [""] * widths[at]
    # neighbours have the same unit but different axes: names repeated side by side are units
    if rows and len(rows[-1]) == len(names) and any(a == b != "" for a, b in pairwise(names)):
        names, units = rows.pop(), [unit.strip("[]() ") for unit in names]
    while rows and len(rows[-1]) == len(names) and _is_incomplete(names):
        names = _joined(rows.pop(), names)
    names = [f"{n} [{u}]" if u else n for n, u in zip(names, units, strict=True)]
    return _fitted(f"{where} line {above[at].number}", names, row), above[len(rows) : at + 1]


def _fields(text: str, delimiter: str, width: int) -> list[str]:
    """Names in a header; NumPy and others write it as a comment, and by a delimiter of its own."""
    text = text.lstrip("#%/ ") if _is_comment(text) else text
    if delimiter in text and delimiter != " ":
        return split(text, delimiter)
    ways = [split(text, other) for other in (",", ";", "\t")]
    ways += [_TOKEN.findall(text), re.split(r"\s{2,}|\t", text.strip())]
    return next((names for names in ways if len(names) == width), split(text, delimiter))


def _is_incomplete(names: Sequence[str]) -> bool:
    """Whether names lack the row above them: some are empty, or there more than once."""
    filled = [name for name in names if name]
    return len({*filled}) < len(filled) or "" in names[:-1]


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


def _fitted(where: str, names: Sequence[str], row: Sequence[str]) -> tuple[str, ...]:
    """Names as many as the fields of a row; a delimiter at the end of one alone does not count.

    A header with a delimiter too many or too few elsewhere would shift the names: it is refused.
    """
    width, ends = len(row), (bool(names[-1]), bool(row[-1]))
    if ends == (False, True) and len(names) == width + 1:
        return tuple(names[:-1])
    if ends == (True, False) and len(names) == width - 1:
        return (*names, "")
    if len(names) != width or (ends[0] != ends[1] and "" in names):
        shown = ", ".join(repr(name[:40]) for name in names[:30])
        raise InputError(
            f"{where}: expected a header of as many columns as the rows, {width}, got "
            f"{len(names)}, {shown}; which is which cannot be told: correct it"
        )
    return tuple(names)


def _decimal_point(where: str, head: str, delimiter: str) -> str:
    """A comma where numbers have one that cannot separate thousands."""
    if delimiter == "," or "," not in head:
        return "."
    field_start = rf'(?:^|[\n{re.escape(delimiter)}])\s*"?'
    commas = re.findall(rf'{field_start}[+-]?(\d+),(\d+)(?=[eE\s"{re.escape(delimiter)}]|$)', head)
    if _WITH_BOTH.search(head):
        problem = "numbers with both commas and points"
    elif not commas:  # but in texts
        return "."
    elif all(len(after) == 3 and before.strip("0") for before, after in commas):  # noqa: PLR2004
        problem = "a comma before three digits each time, which may separate thousands"
    else:
        return ","
    raise InputError(
        f"{where}: expected decimal points, or decimal commas, got {problem}; export the recording "
        "with decimal points and without thousands separators"
    )
