"""Converts columns of times to seconds.

Times are recognised by content: a column of texts, whatever its name, is a column of times if most
of a hundred sampled cells match the form of a time.
"""

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray

# RE2 is fast with at most five groups, no two of which can match the same text
_S = r"(?P<s>\d\d?(?:[.,:]\d{1,12})?)(?P<tail>\s*[A-Za-z. ]{0,8}(?:[+-]\d[\d:]*)?\s*)$"
_FORMS = [
    r"^\s*(?P<date>)(?P<h>\d+):(?P<m>\d\d?):" + _S,
    r"^\s*(?P<date>\w+[-/., ]+\w+[-/., ]+\d+)[T ,_]+(?P<h>\d\d?)[:.-](?P<m>\d\d?)[:.-]" + _S,
    r"^\s*(?P<date>)(?P<h>)(?P<m>\d\d?):" + _S,
    r"^\s*(?P<date>\d{8})[T _]?(?P<h>\d\d)(?P<m>\d\d)" + _S,
]
_TAIL = r"^\s*(?:(?P<half>[ap])\.?m)?[^+-]*(?P<h>[+-]\d\d?)?:?(?P<m>\d\d)?"


def seconds(column: NDArray, unit_s: float | None) -> NDArray[np.float64] | None:
    """Convert a column to times in seconds from any origin.

    Args:
        column: (n,), numbers, texts (None: missing), ``datetime64`` or ``timedelta64``.
        unit_s: Seconds per unit of numbers; None: numbers are not times.

    Returns:
        (n,), NaN where a cell is not a time; None if most cells are not times, or are ambiguous. A
        time of day continues after midnight, and one of minutes and seconds after the full hour.
    """
    if column.dtype.kind in "fiu":
        return None if unit_s is None else np.asarray(column * unit_s, float)
    if column.dtype.kind in "mM":
        present = column[~np.isnat(column)]
        return (column - present[0]) / np.timedelta64(1, "s") if len(present) else None
    if column.dtype.kind not in "OU":
        return None
    texts = pa.array(column, pa.string(), from_pandas=True)
    present = texts.drop_null()
    sample = present.take(np.linspace(0, len(present) - 1, min(len(present), 100)).astype(int))
    for form in _FORMS:
        if pc.extract_regex(sample, form).null_count < len(sample) / 2:
            parts = pc.extract_regex(texts, form)
            return _of_parts(dict(zip(parts.type.names, parts.flatten(), strict=True)))
    return None


def are_steps(values: NDArray[np.float64]) -> bool:
    """Whether a column holds times since the previous row, which fall as often as they rise.

    Args:
        values: (n,), in any unit; NaN: missing.
    """
    values = values[np.isfinite(values)]
    change = np.diff(values[1:])  # the first row has no previous one, so its value is arbitrary
    rises, falls = np.count_nonzero(change > 0), np.count_nonzero(change < 0)
    if not len(change) or rises > 3 * falls or falls > 3 * rises:
        return False
    return bool((values >= 0).all() and np.median(values) > 0)


def _of_parts(parts: dict[str, pa.Array]) -> NDArray[np.float64] | None:
    """Seconds (n,) from the parts of texts, each (n,); None if they are ambiguous."""
    import pandas as pd  # noqa: PLC0415 - few files need it, and every worker would wait for it

    hours, minutes = _numbers(parts["h"]), _numbers(parts["m"])
    if np.isnan(hours).all() and not pc.any(pc.match_substring_regex(parts["s"], r"\D")).as_py():
        return None  # 09:50 may be hours and minutes, or minutes and seconds
    period = 3600 if np.isnan(hours).all() else 86_400
    codes, tails = pd.factorize(parts["tail"].to_numpy(False))
    tail = pd.Series(tails, dtype=object).str.lower().str.extract(_TAIL)
    half = tail["half"].to_numpy()[codes]
    hours = np.where(pd.isna(half), np.nan_to_num(hours), hours % 12 + 12 * (half == "p"))
    times = 3600 * hours + 60 * minutes + _decimal(parts["s"])
    zone_h, zone_m = (tail[name].fillna("0").astype(float).to_numpy()[codes] for name in "hm")
    times -= 3600 * zone_h + 60 * np.copysign(zone_m, zone_h)
    codes, dates = pd.factorize(parts["date"].to_numpy(False))
    valid = np.isfinite(times)
    if len(dates) == 1:
        times[valid] += period * np.cumsum(np.diff(times[valid], prepend=0.0) < -period / 2)
        return times
    # the right order of day and month is the one that makes the recording short
    orders = (_days(dates, first)[codes] + times for first in (False, True))
    return min(orders, key=lambda t: (np.isnan(t).sum(), np.abs(np.diff(t[valid])).sum()))


def _decimal(texts: pa.Array) -> NDArray[np.float64]:
    """Seconds such as 5.02, 5,02 or 5:02; after a colon, if widths vary, 5 stands for 005."""
    if not pc.any(pc.match_substring(texts, ":")).as_py():
        return _numbers(pc.replace_substring(texts, ",", "."))
    whole, digits = pc.extract_regex(texts, r"^(?P<s>\d+):(?P<count>\d+)$").flatten()
    widths = pc.utf8_length(digits).to_numpy(False)
    least, most = np.nanmin(widths), np.nanmax(widths)
    return _numbers(whole) + _numbers(digits) / 10 ** (most if least == most else max(most, 3))


def _numbers(texts: pa.Array) -> NDArray[np.float64]:
    return pc.if_else(pc.equal(texts, ""), None, texts).cast(pa.float64()).to_numpy(False)


def _days(dates: NDArray, day_first: bool) -> NDArray[np.float64]:
    """Seconds from the first date to each, NaN for texts that are not dates, then a NaN."""
    import pandas as pd  # noqa: PLC0415 - as above

    days = pd.to_datetime(pd.Series(dates), errors="coerce", format="mixed", dayfirst=day_first)
    return np.append((days - days.min()).dt.total_seconds().to_numpy(float), np.nan)
