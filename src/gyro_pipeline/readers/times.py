"""Columns of times as seconds.

Time is told by content: under any name, a column is one of times if most of its cells read so.
"""

import re
from collections.abc import Callable

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray

DAY_S, HOUR_S = 86_400.0, 3600.0

_TAIL = (
    r"(?:(?P<mark>[.,:])(?P<digits>\d{1,12}))?\s*(?P<half>[AaPp]\.?[Mm]\.?)?"
    r"\s*(?P<zone>[A-Z]*(?:[+-]\d[\d:]*)?)\s*$"
)
_FORMS = (
    r"^\s*(?P<date>)(?:(?P<h>\d+):)?(?P<m>\d{1,2}):(?P<s>\d{1,2})" + _TAIL,
    r"^\s*(?P<date>.*\d.*?)[T ,_]+(?P<h>\d{1,2})[:.-](?P<m>\d{1,2})[:.-](?P<s>\d{1,2})" + _TAIL,
    r"^\s*(?P<date>\d{8})[T _]?(?P<h>\d\d)(?P<m>\d\d)(?P<s>\d\d)" + _TAIL,
)
"""A time of day, one behind a date, and ISO 8601's basic format."""
_OFFSET = re.compile(r"[A-Z]*([+-]\d\d?):?(\d\d)?")


def seconds(column: NDArray, unit_s: float | None) -> NDArray[np.float64] | None:
    """Read a column as times in seconds, from any origin.

    Args:
        column: (n,), numbers, texts (None: missing), ``datetime64`` or ``timedelta64``.
        unit_s: Seconds in one unit of numbers; without it, numbers are no times.

    Returns:
        (n,), NaN where a cell is no time; None where most are none, or can be read in two ways. A
        time of day goes on at midnight, and one of minutes and seconds at the full hour.
    """
    if column.dtype.kind in "fiu":
        return None if unit_s is None else np.asarray(column * unit_s, float)
    if column.dtype.kind in "mM":
        there = column[~np.isnat(column)]
        return (column - there[0]) / np.timedelta64(1, "s") if len(there) else None
    if column.dtype.kind not in "OU":
        return None
    texts = pa.array(column, pa.string(), from_pandas=True)
    for form in _FORMS:
        parts = pc.extract_regex(texts, form)
        if parts.null_count - texts.null_count < (len(texts) - texts.null_count) / 2:
            return _of_parts(dict(zip(parts.type.names, parts.flatten(), strict=True)))
    return None


def are_steps(values: NDArray[np.float64]) -> bool:
    """Whether a column holds the time since the last row, which falls as often as it rises.

    Args:
        values: (n,), in any unit; NaN: missing.
    """
    values = values[np.isfinite(values)]
    change = np.diff(values[1:])  # a first row has no last one, so it may hold anything
    rises, falls = np.count_nonzero(change > 0), np.count_nonzero(change < 0)
    alike = rises <= 3 * falls and falls <= 3 * rises
    return bool(len(change) and (values >= 0).all() and np.median(values) > 0 and alike)


def _of_parts(parts: dict[str, pa.Array]) -> NDArray[np.float64] | None:
    """Seconds (n,) of the parts of texts, each (n,); None where they can be read in two ways."""
    hours, minutes, s, digits = (_numbers(parts[name]) for name in ("h", "m", "s", "digits"))
    of_hour = np.isnan(hours).all()
    if of_hour and np.isnan(digits).all():
        return None  # 09:50 may be hours and minutes
    places = pc.utf8_length(parts["digits"]).fill_null(0).to_numpy().astype(float)
    if pc.any(pc.equal(parts["mark"], ":")).as_py():  # a count: of varying width, 5 is 005
        widths = places[np.isfinite(digits)]
        places = max(widths.max(), 3) if np.ptp(widths) else widths.max()
    half = _by_value(parts["half"], lambda text: " ap".find(text[:1].lower()) if text else 0)
    hours = np.where(half > 0, hours % 12 + 12 * (half - 1), np.nan_to_num(hours))
    times = HOUR_S * hours + 60 * minutes + s + np.nan_to_num(digits) / 10**places
    times -= _by_value(parts["zone"], _offset_s)
    codes, dates = pd.factorize(parts["date"].to_numpy(False))
    there = np.isfinite(times)
    if len(dates) == 1:
        period = HOUR_S if of_hour else DAY_S
        times[there] += period * np.cumsum(np.diff(times[there], prepend=0.0) < -period / 2)
        return times
    # of day and month, the right order is the one in which the recording is short
    readings = (_days(pd.Series(dates), first)[codes] + times for first in (False, True))
    return min(readings, key=lambda t: (np.isnan(t).sum(), np.abs(np.diff(t[there])).sum()))


def _numbers(texts: pa.Array) -> NDArray[np.float64]:
    return pc.if_else(pc.equal(texts, ""), None, texts).cast(pa.float64()).to_numpy(False)


def _by_value(texts: pa.Array, value: Callable[[str], float]) -> NDArray[np.float64]:
    """A function of each text (n,), of which there are few; 0 where one is missing."""
    encoded = texts.dictionary_encode()
    values = np.array([*map(value, encoded.dictionary.to_pylist()), 0.0])
    return values[encoded.indices.fill_null(-1).to_numpy()]


def _days(dates: pd.Series, day_first: bool) -> NDArray[np.float64]:
    """Seconds from the first date to each, NaN where it is none and behind them."""
    read = pd.to_datetime(dates, errors="coerce", format="mixed", dayfirst=day_first)
    return np.append((read - read.min()).dt.total_seconds().to_numpy(float), np.nan)


def _offset_s(zone: str) -> float:
    """Seconds that a zone such as ``Z``, ``UTC+2`` or ``-07:00`` is ahead of UTC; 0 of a name."""
    match = _OFFSET.fullmatch(zone)
    hours, minutes = (match[1], match[2] or 0) if match else ("0", 0)
    return HOUR_S * int(hours) + 60 * int(minutes) * (-1 if hours.startswith("-") else 1)
