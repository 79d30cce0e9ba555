"""Reads lines that are not delimited, by the option ``row``, and suggests such an option.

Serial consoles, NMEA-like sentences and JSON lines have a row of numbers in each line, among words.
A regular expression with named groups finds the numbers; all other lines are skipped.
"""

import re
from collections import Counter
from collections.abc import Sequence
from itertools import islice

import pyarrow as pa

from gyro_pipeline.conventions import IN_READER, InputError
from gyro_pipeline.logs import KEPT, Finding
from gyro_pipeline.readers.table import Table, columns_of, unreadable

_CHECKSUM = re.compile(r"\*[0-9A-Fa-f]{2}\s*$")  # of NMEA 0183
_DATE, _CLOCK = r"\d{4}[-/.]\d\d[-/.]\d\d", r"\d{1,2}:\d\d(?::\d\d)?(?:[.:]\d+|,\d{3})?"
_TIME = rf"{_DATE}(?:[T ]{_CLOCK}(?:Z|[+-]\d\d:?\d\d)?)?|{_CLOCK}"
_NUMBER = r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?"
_VALUE = re.compile(
    rf"(?<![\w.+:-])(?:(?P<time>{_TIME})|{_NUMBER})(?![\w.:])|(?<=:){_NUMBER}(?![\w.:])"
)
_LABEL = re.compile(r"([A-Za-z]\w*)[\"']?\s*[:=]\s*$")


def read_lines(where: str, data: bytes, expression: str) -> Table:
    """Read the lines of a text that match an expression.

    Args:
        where: Name of the file, for messages.
        data: The text, UTF-8.
        expression: A regular expression that is searched in each line; its named groups are the
            columns.

    Raises:
        InputError: The expression is invalid, has no named groups, or matches fewer than two lines.
    """
    try:
        pattern = re.compile(expression)
    except re.error as error:
        raise InputError(
            f"{where}: `row:` {IN_READER} is not a regular expression: {error}; correct it"
        ) from error
    names = tuple(pattern.groupindex)
    lines = [line.decode("utf-8", "replace") for line in data.rstrip(b"\0").splitlines()]
    nonblank = {number: line for number, line in enumerate(lines, 1) if line.strip()}
    matches = {n: match for n, line in nonblank.items() if (match := pattern.search(line))}
    if not names or len(matches) < 2:  # noqa: PLR2004
        raise InputError(
            f"{where}: expected named groups, such as (?P<gx>…), in `row:` and at least two lines "
            f"that match it, got {len(names)} groups and {len(matches)} of {len(nonblank)} lines; "
            f"{advice([*nonblank.values()][:200])}"
        )
    numbers = [*matches]
    texts = [pa.array([match[name] for match in matches.values()], pa.string()) for name in names]
    columns, damage = columns_of(names, texts)

    def position(row: int) -> str:
        return f"row {row} (line {numbers[row]})"

    findings = [*unreadable(damage, len(matches), position)]
    if skipped := [number for number in nonblank if number not in matches]:
        detail = f"{len(skipped)} of {len(nonblank)} lines do not match `row` and were skipped, "
        detail += f"the first is line {skipped[0]}: {nonblank[skipped[0]][:60]!r}"
        findings.insert(0, Finding("row", KEPT, detail))
    return Table(where, names, columns, "\n".join(lines[: numbers[0] - 1]), (*findings,), position)


def advice(lines: Sequence[str]) -> str:
    """Say how to read lines: by an expression to paste, if they contain numbers."""
    expressions = Counter(filter(None, map(expression_of, lines))).most_common(1)
    if expressions:
        text = expressions[0][0].replace("'", "''")  # YAML's escape in single quotes
        return (
            f"to read lines like these, write {IN_READER}: row: '{text}' – with the groups of the "
            "angular rates named gx, gy, gz, that of the time t, and the units in `units`"
        )
    if lines and re.match(r"\s*[\[{]\s*($|[\[{\"])", lines[0]):
        return (
            "a document of JSON: write one object per line, or convert it to CSV, such as by "
            "`pandas.read_json(PATH).to_csv('log.csv', index=False)`"
        )
    return "export the recording as CSV"


def expression_of(line: str, least: int = 3, most: int = 100) -> str | None:
    """An expression that matches lines of the same form, with a group for each number.

    Groups are named by the label before them (X for ``X: 1`` and ``"X": 1``), else v1, v2, ….

    Returns:
        The expression; None if the line has too few or too many numbers.
    """
    line = _CHECKSUM.sub("*", line.rstrip())
    expression, end, names = "^", 0, list[str]()
    for value in islice(_VALUE.finditer(line), most + 1):
        between = line[end : value.start()]
        label = _LABEL.search(between)
        name = "t" if value["time"] else label[1] if label else f"v{len(names) + 1}"
        while name in names:
            name += "_"
        names.append(name)
        signs = ":" + "".join(s for s in ",/TZ " if s in value[0]) if value["time"] else "eE"
        blanks = r"\s+" if between and not between.strip() else r"\s*"
        expression += rf"{_literal(between.rstrip())}{blanks}(?P<{name}>[-+.{signs}\d]+)"
        end = value.end()
    if not least <= len(names) <= most:
        return None
    return expression + (_literal(line[end:]) if end < len(line) else r"\s*$")


def _literal(text: str) -> str:
    """An expression for a text between numbers, with any number of blanks."""
    return re.sub(r"\s+", r"\\s+", re.sub(r"([\\.^$*+?{}\[\]|()])", r"\\\1", text))
