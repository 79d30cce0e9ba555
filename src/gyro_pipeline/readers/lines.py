"""Lines that are no table: the option ``row`` says what a row is, and a refusal makes one.

Serial consoles, NMEA-like sentences and JSON lines have a row of numbers on a line, with words
around them. An expression with named groups finds them; all other lines are skipped.
"""

import re
from collections import Counter
from collections.abc import Sequence

import pyarrow as pa

from gyro_pipeline.conventions import InputError
from gyro_pipeline.logs import KEPT, Finding
from gyro_pipeline.readers.table import IN_READER, Table, columns_of

_CHECKSUM = re.compile(r"\*[0-9A-Fa-f]{2}\s*$")
_DATE, _CLOCK = r"\d{4}[-/.]\d\d[-/.]\d\d", r"\d{1,2}:\d\d(?::\d\d)?(?:[.:]\d+|,\d{3})?"
_TIME = rf"{_DATE}(?:[T ]{_CLOCK}(?:Z|[+-]\d\d:?\d\d)?)?|{_CLOCK}"
_NUMBER = r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?"
_VALUE = re.compile(
    rf"(?<![\w.+:-])(?:(?P<time>{_TIME})|{_NUMBER})(?![\w.:])|(?<=:){_NUMBER}(?![\w.:])"
)
_LABEL = re.compile(r"([A-Za-z]\w*)[\"']?\s*[:=]\s*$")
_JSON = re.compile(r"\s*[\[{]\s*($|[\[{\"])")
_LEAST, _MOST = 3, 100  # numbers in a line


def is_sentence(line: str) -> bool:
    """Whether a line is framed as NMEA 0183 has it, ``$…*68``: its last field has a checksum."""
    return line.startswith(("$", "!")) and _CHECKSUM.search(line) is not None


def read_lines(where: str, data: bytes, expression: str) -> Table:
    """Read the lines of a text that an expression matches.

    Args:
        where: For messages.
        data: The text, UTF-8.
        expression: A regular expression, which is searched in each line; its named groups are the
            columns.

    Raises:
        InputError: The expression is none, has no named groups, or matches fewer than two lines.
    """
    try:
        pattern = re.compile(expression)
    except re.error as error:
        raise InputError(f"{where}: `row:` {IN_READER} is no expression: {error}") from error
    names = tuple(pattern.groupindex)
    lines = [line.decode("utf-8", "replace") for line in data.rstrip(b"\0").splitlines()]
    filled = [(number, line) for number, line in enumerate(lines, 1) if line.strip()]
    matches = [(number, match) for number, line in filled if (match := pattern.search(line))]
    if not names or len(matches) < 2:  # noqa: PLR2004
        raise InputError(
            f"{where}: expected named groups, such as (?P<gx>…), in `row:` and two lines or more "
            f"that it matches, got {len(names)} groups and {len(matches)} of {len(filled)} lines; "
            f"{advice([line for _, line in filled[:200]])}"
        )
    numbers = [number for number, _ in matches]
    arrays = [pa.array([match[name] for _, match in matches], pa.string()) for name in names]

    def place(row: int) -> str:
        return f"row {row} (line {numbers[row]})"

    columns, unread, _ = columns_of(names, arrays, place, ".")
    findings = _skipped(filled, {*numbers}) + unread
    return Table(where, names, columns, "\n".join(lines[: numbers[0] - 1]), findings, place)


def _skipped(filled: list[tuple[int, str]], rows: set[int]) -> tuple[Finding, ...]:
    skipped = [(number, line) for number, line in filled if number not in rows]
    if not skipped:
        return ()
    number, line = skipped[0]
    text = f"{len(skipped)} of {len(filled)} lines do not match `row` and were skipped, the first "
    return (Finding("row", KEPT, f"{text}is line {number}: {line[:60]!r}"),)


def advice(lines: Sequence[str]) -> str:
    """Say how lines like these can be read: an expression to paste, if they hold numbers."""
    made = Counter(filter(None, map(expression_of, lines))).most_common(1)
    if not made and lines and _JSON.match(lines[0]):
        return (
            "a document of JSON: write an object a line, or CSV, such as by "
            "`pandas.read_json(PATH).to_csv('log.csv', index=False)`"
        )
    if not made:
        return "export the recording as CSV"
    text = made[0][0].replace("'", "''")  # as YAML has it in quotes
    return (
        f"to read lines like these, write {IN_READER}: row: '{text}' – with the groups of the "
        "angular rates named gx, gy, gz, that of the time t, and the units in `units`"
    )


def expression_of(line: str) -> str | None:
    """An expression that matches lines like this one, each number a group; None of few numbers.

    Groups are named by the label before them (``X: 1`` and ``"X": 1`` make X), else v1, v2, ….
    """
    line = _CHECKSUM.sub("*", line.rstrip())
    expression, end, names = "^", 0, list[str]()
    for value in _VALUE.finditer(line):
        between = line[end : value.start()]
        label = _LABEL.search(between)
        name = "t" if value["time"] else label[1] if label else f"v{len(names) + 1}"
        while name in names:
            name += "_"
        names.append(name)
        signs = "".join(sign for sign in ",/TZ " if sign in value[0]) if value["time"] else "eE"
        cell = rf"[-+.{':' if value['time'] else ''}{signs}\d]+"
        blanks = r"\s+" if between and not between.strip() else r"\s*"
        expression += f"{_literal(between.rstrip())}{blanks}(?P<{name}>{cell})"
        end = value.end()
    if not _LEAST <= len(names) <= _MOST:
        return None
    return expression + (_literal(line[end:]) if end < len(line) else r"\s*$")


def _literal(text: str) -> str:
    """An expression for a text between numbers, whatever the number of blanks in it."""
    return re.sub(r"\s+", r"\\s+", re.sub(r"([\\.^$*+?{}\[\]|()])", r"\\\1", text))
