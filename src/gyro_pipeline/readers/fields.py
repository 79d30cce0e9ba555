"""Fields of a line of delimited text."""

import csv
import re
from typing import Any

import pyarrow as pa

DELIMITERS = {",": "comma", ";": "semicolon", "\t": "tab"}

_TIMES = {
    re.compile(r"\d{1,2}:\d\d:\d\d(\.\d+)?"): pa.time64("us"),
    re.compile(r"\d{4}-\d\d-\d\d[T ][\d:.]+"): pa.timestamp("us"),
    re.compile(r"\d{4}-\d\d-\d\d[T ][\d:.]+(Z|[+-]\d\d:?\d\d)"): pa.timestamp("us", "UTC"),
}


def split(line: str, delimiter: str) -> list[str]:
    """Fields without quotes and outer white space; none if the line cannot be split."""
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


def time_type(field: str) -> Any:
    """Arrow's type of a time of day, or of a date with one as ISO 8601 has it; else None."""
    return next((kind for times, kind in _TIMES.items() if times.fullmatch(field)), None)


def is_header(fields: list[str]) -> bool:
    """Whether these are names of columns rather than a row, be it a damaged one."""
    if fields and fields[0].lower().startswith("sep="):
        return True
    filled = [field for field in fields if field]
    words = [field for field in filled if field[0].isalpha() and not is_number(field)]
    return len(words) > max(1, len(filled) // 2)
