"""How a text is laid out, told from its first 16 KiB: header, delimiter, decimal sign.

Where that leaves a choice, the file is refused.
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from gyro_pipeline.conventions import AXES, InputError
from gyro_pipeline.readers.fields import DELIMITERS, is_number, split, time_type
from gyro_pipeline.readers.headers import UNITS, listed, rate_unit, split_unit
from gyro_pipeline.readers.text import TextTable

_HEAD = 1 << 14
_SEPARATOR_LINE = re.compile(r'"?sep=(.)"?,*', re.IGNORECASE)
_COMMENT = "#% "  # before a header, as NumPy and MATLAB write it
_ZEROS = 0.1  # a larger share of zero bytes: not a text
_UTF16 = (b"\xff\xfe", b"\xfe\xff")
_UTF8 = b"\xef\xbb\xbf"
_WITH_COMMA = re.compile(r"(?:^|[;\t\n])\s*\"?[+-]?(\d+),(\d+)(?=[eE;\t\r\n\" ]|$)")
_WITH_BOTH = re.compile(r"\d,\d{3}\.\d|\d\.\d{3},\d")


class _Line(NamedTuple):
    number: int  # in the file, from 1
    end: int  # offset of what follows
    text: str


@dataclass(frozen=True)
class _Rows:
    """Where rows of numbers were found."""

    delimiter: str
    at: int  # index of the first of them among the lines
    fields: tuple[str, ...]

    @property
    def numbers(self) -> int:
        return sum(map(is_number, self.fields))


def open_text(path: Path) -> TextTable:
    """Read a text and find its header.

    Raises:
        InputError: It is not a text, or not one of rows of numbers that are told apart safely.
    """
    data = _decoded(path)
    lines = _first_lines(data)
    rows = _find_rows(path, lines)
    above = _above(lines, rows)
    header = _header(above, rows)
    start = above[-1].end if above else 0
    head = data[start : start + _HEAD].decode("latin-1")
    return TextTable(
        path=path,
        names=_names(path, header, rows),
        preamble="\n".join(line.text for line in above if line not in header),
        data=data,
        start=start,
        header_lines=above[-1].number if above else 0,
        delimiter=rows.delimiter,
        quoted='"' in lines[rows.at].text,
        decimal_point=_decimal_point(path, head, rows.delimiter),
        times={n: kind for n, field in enumerate(rows.fields) if (kind := time_type(field))},
    )


def _decoded(path: Path) -> bytes:
    """Bytes of the text, without byte order mark; UTF-16 becomes UTF-8."""
    try:
        data = path.read_bytes()
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}") from error
    if data.startswith(_UTF16):
        data = data.decode("utf-16", "replace").encode()
    data = data.removeprefix(_UTF8)
    head = data[:_HEAD].rstrip(b"\0")
    if head.count(0) > len(head) * _ZEROS:
        raise InputError(
            f"{path}: expected a text, got binary data, or UTF-16 without byte order mark; export "
            "the recording as CSV in UTF-8"
        )
    return data


def _first_lines(data: bytes) -> list[_Line]:
    """Lines in the head of a text that are not blank, and whole if others follow them."""
    lines, end = [], 0
    for number, line in enumerate(data[:_HEAD].splitlines(keepends=True), 1):
        end += len(line)
        if end == _HEAD < len(data) and not line.endswith((b"\n", b"\r")):
            break
        try:
            text = line.decode()
        except UnicodeDecodeError:
            text = line.decode("cp1252", "replace")  # for the degree sign in headers
        if text.strip():
            lines.append(_Line(number, end, text.strip("\r\n")))
    return lines


def _find_rows(path: Path, lines: list[_Line]) -> _Rows:
    """Find the first two lines alike of at least three numbers, by each delimiter.

    The delimiter that makes most numbers of them is taken; a ``sep=`` line decides.
    """
    said = _SEPARATOR_LINE.fullmatch(lines[0].text) if lines else None
    candidates = [
        rows
        for delimiter in ([said[1]] if said else DELIMITERS)
        if delimiter in DELIMITERS and (rows := _rows_by(delimiter, lines))
    ]
    if not candidates:
        first = lines[0].text[:60] if lines else ""
        raise InputError(
            f"{path}: expected a header and rows of three numbers or more, separated by "
            f"{said[1] if said else 'comma, semicolon or tab'}, got none in the first "
            f"{len(lines)} lines, which begin {first!r}; export the recording as CSV"
        )
    return max(candidates, key=lambda rows: rows.numbers)


def _rows_by(delimiter: str, lines: list[_Line]) -> _Rows | None:
    previous: tuple[str, ...] = ()
    for at, line in enumerate(lines):
        fields = _row(line.text, delimiter)
        last_of_one = at == len(lines) - 1 and not previous
        if fields and (len(fields) == len(previous) or last_of_one):
            return _Rows(delimiter, at - (not last_of_one), previous or fields)
        previous = fields
    return None


def _row(text: str, delimiter: str) -> tuple[str, ...]:
    """Fields of a line, if three of them or more are numbers."""
    if text.count(delimiter) < len(AXES) - 1:
        return ()
    fields = split(text, delimiter)
    return tuple(fields) if sum(map(is_number, fields)) >= len(AXES) else ()


def _above(lines: list[_Line], rows: _Rows) -> list[_Line]:
    """Lines above the first row of numbers, be it a damaged one."""
    above = lines[: rows.at]
    while above and _row(above[-1].text, rows.delimiter):
        above.pop()
    return above


def _header(above: list[_Line], rows: _Rows) -> list[_Line]:
    """The line next to the rows, or the nearest as wide as they are if that has too few fields.

    Two lines where the last one has units only and the one before it has names.
    """
    widths = [len(split(line.text, rows.delimiter)) for line in above]
    wide = [n for n, width in enumerate(widths) if abs(width - len(rows.fields)) <= 1]
    if widths and widths[-1] >= len(AXES):
        last = len(above) - 1
    elif wide:
        last = wide[-1]
    else:
        return []
    names = [split(line.text.lstrip(_COMMENT), rows.delimiter) for line in above[: last + 1][-2:]]
    if [_are_units(one) for one in names] == [False, True] and len(names[0]) == len(names[1]):
        return above[last - 1 : last + 1]
    return [above[last]]


def _names(path: Path, header: list[_Line], rows: _Rows) -> tuple[str, ...]:
    """The header, as long as the rows; a delimiter at the end of one alone does not count.

    A header with a delimiter too many or too few elsewhere would shift the names: it is refused.
    """
    width = len(rows.fields)
    if not header:
        return ("",) * width
    names, *units = [split(line.text.lstrip(_COMMENT), rows.delimiter) for line in header]
    if units:
        names = [_with_unit(*both) for both in zip(names, units[0], strict=True)]
    ends = bool(names[-1]), bool(rows.fields[-1])
    if ends == (False, True) and len(names) == width + 1:
        return tuple(names[:-1])
    if ends == (True, False) and len(names) == width - 1:
        return (*names, "")
    if len(names) != width or (ends[0] != ends[1] and "" in names):
        raise InputError(
            f"{path} line {header[0].number}: expected a header of as many columns as "
            f"the rows, {width}, got {len(names)}, {listed(names)}; which is which cannot be told: "
            "correct it"
        )
    return tuple(names)


def _are_units(names: Sequence[str]) -> bool:
    """Whether at least three are a unit of angular rate and nothing else."""
    return sum(
        not split_unit(name, UNITS)[0] and rate_unit(name) is not None for name in names
    ) >= len(AXES)


def _with_unit(name: str, unit: str) -> str:
    return f"{name} [{unit.strip('[]() ')}]" if unit else name


def _decimal_point(path: Path, head: str, delimiter: str) -> str:
    """A comma where numbers have one that cannot separate thousands."""
    if delimiter == "," or "," not in head:
        return "."
    commas = _WITH_COMMA.findall(head)
    if _WITH_BOTH.search(head):
        problem = "numbers with both commas and points"
    elif not commas:  # but in texts
        return "."
    elif all(len(after) == 3 and before.strip("0") for before, after in commas):  # noqa: PLR2004
        problem = "a comma before three digits each time, which may separate thousands"
    else:
        return ","
    raise InputError(
        f"{path}: expected decimal points, or decimal commas, got {problem}; export the recording "
        "with decimal points and without thousands separators"
    )
