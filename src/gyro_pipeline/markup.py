"""Tables and texts as escaped Markdown."""

import re
from typing import Any

import pandas as pd

_WITHOUT_EXPONENT = 1e4
_SPECIAL = re.compile(r"[\\`*<>|&~$]|(?<!\w)_|_(?!\w)|\](?=[(\[:])|^\s*(?=[#+-])(?![+-][\d.])")
_INTERVAL = re.compile(r"[-+−\d.]+ \[[-+−\d.]+, [-+−\d.]+\]")


def escape(text: str) -> str:
    """Escape a text, such as a file name, so that Markdown shows it literally, on one line."""
    return _SPECIAL.sub(lambda match: f"\\{match[0]}" if match[0] else "\\", " ".join(text.split()))


def pipe_table(table: pd.DataFrame) -> str:
    """Format a table, without its index, as a Markdown pipe table.

    Numeric columns are aligned to the right. Numbers have four significant digits, and a missing
    value is a dash.
    """
    numeric = [pd.api.types.is_numeric_dtype(dtype) for dtype in table.dtypes]
    rules = ["---:" if right else "---" for right in numeric]
    rows = [[escape(str(name)) for name in table.columns], rules]
    rows += [[_cell(value) for value in row] for row in table.itertuples(index=False, name=None)]
    return "".join(f"| {' | '.join(row)} |\n" for row in rows)


def plain(value: Any) -> str:
    """Format the value of a table cell for readers."""
    if pd.isna(value):
        return "–"
    if not isinstance(value, float):
        return str(value)
    return f"{value:.4g}" if abs(value) < _WITHOUT_EXPONENT else f"{value:.0f}"


def _cell(value: Any) -> str:
    text = plain(value)
    if _INTERVAL.fullmatch(text):  # keep it on one line
        return text.replace(" ", "\N{NO-BREAK SPACE}")
    return escape(text) or "–"
