"""Which rows of a table are samples.

A recording is of one device, and its values are samples. Rows of another device or kind, rows
without rates and rows that repeat the one before are left out before the time is read, by the
options or where the rows themselves say so. What could be either is refused.
"""

import re
from collections.abc import Sequence
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter1d
from scipy.stats import trim_mean

from gyro_pipeline.conventions import AXES, InputError
from gyro_pipeline.readers.table import IN_READER, Table

Mask = NDArray[np.bool_]
Floats = NDArray[np.float64]

WINDOW = 51
"""Rows whose mean a sample is compared with, to see its noise."""

_DEVICE = re.compile(
    r"(?i)(?:^|[ _.])(?:device|sensor|imu|node|serial|mac|topic|dev)"
    r"(?:[ _]?(?:id|no|nr|num|number|name|index|tag|addr|address))?$"
)
_FLAGS = {"true", "false", "t", "f", "yes", "no", "y", "n", "on", "off"}


def with_value(table: Table, number: int, value: Any, count: int) -> Mask:
    """Rows (count,) with a value in a column.

    Raises:
        InputError: There is none, or the column is of another length.
    """
    column = table.columns[number]
    same = _as_texts(column) == _as_text(value)
    if len(same) != count or not same.any():
        raise InputError(
            f"{table.where}: expected {count} rows, some with {_as_text(value)} in "
            f"{table.names[number]!r}, got {_counted(column)}; correct rows {IN_READER}"
        )
    return same


def blank_at_regular_shares(
    rates: Floats, least_share: float = 0.05, least_runs: int = 10, alike: float = 0.9
) -> Mask:
    """Rows without rates that come regularly, as where another sensor has a higher rate.

    Args:
        rates: (n, 3), NaN where blank.
        least_share: Of the rows; fewer are losses.
        least_runs: Of such rows in a row.
        alike: Share of the runs, of blank rows and of others, that are of about one length; where
            rows are lost at random, lengths scatter.

    Returns:
        (n,), nothing where blank rows are losses.
    """
    blank = np.isnan(rates).all(axis=1)
    lengths = _run_lengths(np.asarray(blank, np.intp))[1:-1]
    if blank.mean() < least_share or len(lengths) < 2 * least_runs:
        return np.zeros(len(rates), bool)
    for some in (lengths[0::2], lengths[1::2]):
        usual = np.median(some)
        if (np.abs(some - usual) <= max(1, usual / 4)).mean() < alike:
            return np.zeros(len(rates), bool)
    return np.asarray(blank)


def repeated(rates: Floats) -> Mask:
    """Rows (n,) whose rates (n, 3) are all those of the row before."""
    same = np.zeros(len(rates), bool)
    same[1:] = (rates[1:] == rates[:-1]).all(axis=1)
    return same


def takes_turns(table: Table, number: int, keep: Mask, rates: Floats, most_values: int = 32) -> str:
    """Whether a column says what a row is of, such as a device, a sensor or a kind of row.

    It has few values, and they come and go. Texts then say what a row is; so do numbers of a column
    that is named as a device, and those with which the rates change.

    Args:
        table: (n) rows.
        number: Of a column that nobody asked for.
        keep: (n,), the rows that are left.
        rates: (m, 3), of these.
        most_values: More are measurements or counters.

    Returns:
        What it is, for a message; an empty text where it says nothing of the rows.
    """
    column = table.columns[number]
    some = column[:: len(column) // 256 + 1]
    if len(column) != len(keep) or len(pd.unique(some)) > most_values:
        return ""
    codes, values = pd.factorize(column[keep], use_na_sentinel=False)
    if not 1 < len(values) <= most_values:
        return ""
    name = table.names[number]
    evidence = _evidence(name, [_as_text(value) for value in values], codes, rates)
    if not evidence:
        return ""
    pick = f"{{{name or number}: {next(filter(None, map(_as_text, values)))}}}"
    return (
        f"{name or f'column {number}'!r} takes turns among {_counted(column[keep])}, {evidence}, "
        f"but a recording is of one device; pick its rows, such as rows: {pick}"
    )


def _evidence(name: str, values: Sequence[str], codes: NDArray[np.intp], rates: Floats) -> str:
    """Why values, by the codes (n,) of the rows, say what a row is; nothing if they do not."""
    rows = np.bincount(codes, minlength=len(values))
    runs = np.bincount(codes[np.flatnonzero(np.diff(codes, prepend=-1))], minlength=len(values))
    filled = np.array([bool(value) for value in values])
    if _DEVICE.search(name) and (filled & (rows >= 0.01 * len(codes))).sum() > 1:
        return "by its name devices"
    texts = filled & np.array([not _is_number_or_flag(value) for value in values])
    if (texts & (runs > 2)).sum() > 1:  # noqa: PLR2004
        return "which say what a row is"
    for code in _suspected(rates, codes, len(values)) if (runs > 4).any() else ():  # noqa: PLR2004
        if runs[code] > 4 and (difference := _rates_change(rates, codes == code)):  # noqa: PLR2004
            return f"and with {values[code] or 'blank'} {difference}"
    return ""


def _is_number_or_flag(value: str) -> bool:
    return bool(re.fullmatch(r"[-+.\deE]+|inf|-inf", value)) or value.lower() in _FLAGS


def _suspected(rates: Floats, codes: NDArray[np.intp], values: int) -> NDArray[np.intp]:
    """Codes with which means or noise of the rates differ at all; a look that costs little."""
    finite = np.isfinite(rates).all(axis=1)
    rates, codes = rates[finite], codes[finite]
    rows = np.maximum(np.bincount(codes, minlength=values), 1)
    sizes = np.abs(rates - uniform_filter1d(rates, WINDOW, axis=0))
    found = np.zeros(values, bool)
    for column, size in zip(rates.T, sizes.T, strict=True):
        means, noises = (np.bincount(codes, some, values) / rows for some in (column, size))
        least = np.maximum(0.1, 4 / np.sqrt(rows)) * 1.5 * np.median(size)
        found |= (np.abs(means - column.mean()) > least) | (noises > 1.2 * size.mean())
    return np.flatnonzero(found)


def _rates_change(
    rates: Floats,
    there: Mask,
    least: float = 0.2,
    sigmas: float = 8.0,
    noisier: float = 1.5,
) -> str:
    """How rates (n, 3) differ in the runs of some rows (n,) from those in the runs between them.

    Each run is compared with both of its neighbours, which takes off drift and the slow part of
    flicker; how these differences scatter is the rest. Trimmed means leave single spikes out.

    Args:
        rates: deg/s.
        there: The rows.
        least: Difference of the means that matters, in standard deviations of a sample.
        sigmas: The same, in standard errors.
        noisier: Ratio of the standard deviations that matters.
    """
    finite = np.isfinite(rates).all(axis=1)
    rates, there = rates[finite], there[finite]
    starts = np.flatnonzero(np.diff(there.astype(int), prepend=-1))
    if len(starts) < 12 or len(rates) < WINDOW:  # noqa: PLR2004
        return ""
    means = np.add.reduceat(rates, starts) / np.diff(starts, append=len(rates))[:, None]
    apart = means[1:-1] - (means[:-2] + means[2:]) / 2
    apart *= np.where(there[starts[1:-1]], 1, -1)[:, None]
    sizes = trim_mean(apart, 0.1)
    errors = _spread(apart - sizes) / np.sqrt(len(apart) / 2)  # neighbours share runs
    deviations = rates - uniform_filter1d(rates, WINDOW, axis=0)
    noise = np.stack([_spread(deviations[there]), _spread(deviations[~there])])
    for axis, size in enumerate(np.abs(sizes)):
        if size > max(sigmas * errors[axis], least * noise[:, axis].min(), 0):
            return f"the rate about {AXES[axis]} differs by {size:.3g} deg/s"
    ratios = noise.max(axis=0) / np.maximum(noise.min(axis=0), 1e-300)
    enough = min(there.sum(), (~there).sum()) > 4 * WINDOW
    if enough and ratios.max() > noisier:
        return f"the noise about {AXES[ratios.argmax()]} differs by a factor of {ratios.max():.3g}"
    return ""


def _spread(values: Floats) -> Floats:
    """Standard deviations (3,) of values (n, 3) about 0, by the mean of their sizes."""
    return np.asarray(trim_mean(np.abs(values), 0.05) * np.sqrt(np.pi / 2))


def _run_lengths(codes: NDArray[np.intp]) -> NDArray[np.intp]:
    starts = np.flatnonzero(np.diff(codes, prepend=codes[:1] - 1))
    return np.diff(starts, append=len(codes))


def _as_text(value: Any) -> str:
    """A value as it is typed: 1 of 1.0; an empty text of none."""
    if isinstance(value, float):
        return "" if np.isnan(value) else f"{value:.15g}"
    return "" if value is None else str(value).strip()


def _as_texts(column: NDArray[Any]) -> NDArray[Any]:
    return np.array([_as_text(value) for value in column.tolist()], object)


def _counted(column: NDArray[Any], most: int = 8) -> str:
    """Values and how many rows have each, for a message."""
    values, counts = np.unique(_as_texts(column), return_counts=True)
    shown = [
        f"{v or 'blank'} ({n} rows)" for v, n in zip(values[:most], counts[:most], strict=True)
    ]
    return ", ".join(shown) + (", …" if len(values) > most else "")
