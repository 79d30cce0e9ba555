"""Fields of a line of delimited text."""

import csv
import re

DELIMITERS = {",": "comma", ";": "semicolon", "\t": "tab"}

_CLOCK = re.compile(r"\d{1,2}:\d\d:\d\d(\.\d+)?")
_DATE = re.compile(r"\d{4}-\d\d-\d\d[T ]\d\d:\d\d(:\d\d(\.\d+)?)?")


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


def is_clock(field: str) -> bool:
    """Whether it is a time of day."""
    return _CLOCK.fullmatch(field) is not None


def is_date(field: str) -> bool:
    """Whether it is a date with a time of day, as ISO 8601 has it."""
    return _DATE.fullmatch(field) is not None


def is_header(fields: list[str]) -> bool:
    """Whether these are names of columns rather than a row, be it a damaged one."""
    if fields and fields[0].lower().startswith("sep="):
        return True
    filled = [field for field in fields if field]
    words = [field for field in filled if field[0].isalpha() and not is_number(field)]
    return len(words) > max(1, len(filled) // 2)
