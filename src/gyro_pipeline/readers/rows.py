"""Which rows of a table are samples.

A recording is of one device, and its values are samples. Rows of another device or kind, rows
without rates and rows that repeat the one before are left out before the time is read, by the
options or where the rows themselves say so. What could be either is refused.
"""

import re
from collections.abc import Callable, Collection
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from gyro_pipeline.conventions import AXES
from gyro_pipeline.readers.file import File
from gyro_pipeline.readers.names import RATE, Header

Codes = NDArray[np.intp]
Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]
Texts = NDArray[Any]

MOST_VALUES = 32
"""Of a column that says what a row is of; one of more holds measurements or counts."""

_DEVICE = re.compile(
    r"(?i)(?:^|[ _.])(?:device|dev|sensor|imu|gyro|gyroscope|board|chip|unit|module|channel|ch|"
    r"port|slot|mux|bus|node|source|serial|mac|topic|kind|type|id|name|addr|address|tag|instance)"
    r"(?:[ _]?(?:id|no|nr|num|number|name|index|tag|addr|address))?$"
)
_NUMBER_OR_FLAG = re.compile(r"(?i)[-+.\de]*|inf|-inf|true|false|t|f|yes|no|y|n|on|off")


def sample_rows(file: File, rates: Floats) -> Mask:
    """Rows (n,) that are samples; rates (n, 3) are the numbers of the file.

    Raises:
        InputError: No row has what the options ask for.
    """
    keep = np.ones(len(rates), bool)
    for name, value in file.options.rows.items():
        keep &= _with_value(file, file.find(name), value, len(rates))
    _leave_out(file, keep, rates, blank_at_regular_shares, "are blank, at a regular share")
    if file.options.repeats:
        _leave_out(file, keep, rates, repeated, "repeat the one before")
    return keep


def _leave_out(
    file: File, keep: Mask, rates: Floats, no_samples: Callable[[Floats], Mask], text: str
) -> None:
    """Leave out rows (n,) that a check of those that are kept tells to be no samples."""
    out = no_samples(rates if keep.all() else rates[keep])
    if out.any():
        file.note("rows", f"{out.sum()} of {len(out)} rows {text}: no samples, left out")
        keep[np.flatnonzero(keep)[out]] = False


def _with_value(file: File, number: int, value: str | float, count: int) -> Mask:
    """Rows (count,) with a value in a column."""
    codes, texts = _coded(file.table.columns[number])
    same = np.asarray(texts == _as_text(value))[codes]
    got = f"{_as_text(value)} in {file.listed([number])}, got {_counted(codes, texts)}"
    if len(same) != count or not same.any():
        raise file.refusal(f"expected {count} rows, some with {got}; correct rows")
    if Header(_as_text(value)).quantity not in ("", RATE):
        file.contradict(f"rows of the options pick, by its name no angular rate, {got}")
    return same


def blank_at_regular_shares(
    rates: Floats, least_share: float = 0.05, least_runs: int = 10, alike: float = 0.9
) -> Mask:
    """Rows (n,) without rates that come regularly, as where another sensor has a higher rate.

    Args:
        rates: (n, 3), NaN where blank.
        least_share: Of the rows; fewer are losses.
        least_runs: Of blank rows, and of others.
        alike: Share of the runs of each that are about as long as their median; where rows are lost
            at random, lengths scatter.
    """
    blank = np.isnan(rates[:, 0])
    blank = blank & np.isnan(rates).all(axis=1) if blank.any() else blank
    lengths = np.diff(np.flatnonzero(np.diff(blank)))
    regular = np.count_nonzero(blank) >= least_share * len(rates) and len(lengths) >= 2 * least_runs
    for runs in (lengths[0::2], lengths[1::2]) if regular else ():
        near = np.abs(runs - np.median(runs)) <= max(1, np.median(runs) / 4)
        regular &= near.mean() >= alike
    return blank if regular else np.zeros_like(blank)


def repeated(rates: Floats) -> Mask:
    """Rows (n,) whose rates (n, 3) are all those of the row before."""
    return np.r_[False, (rates[1:] == rates[:-1]).all(axis=1)]


def contradict_turns(file: File, used: Collection[int], keep: Mask, rates: Floats) -> None:
    """Columns that nobody asked for, measure nothing, and say what a row is of.

    Such a column has few values: texts that come and go, those of a column that is named as a
    device, or numbers with which the rates change.

    Args:
        file: Gets the contradictions.
        used: Numbers of the columns that have been asked for.
        keep: (n,), the rows that are left.
        rates: (m, 3), of these.
    """
    for number, (header, column) in enumerate(zip(file.headers, file.table.columns, strict=True)):
        measures = column.dtype.kind == "f" and (header.unit_text or header.names_time)
        if number in used or measures or len(column) != len(keep):
            continue
        cells = column[:: len(column) // 100 + 1].tolist()
        if len({cell for cell in cells if cell == cell}) > MOST_VALUES:  # noqa: PLR0124 - not NaN
            continue
        codes, texts = _coded(column[keep])
        if 1 < len(texts) <= MOST_VALUES and (
            evidence := _evidence(header.name, codes, texts) or _change(rates, codes)
        ):
            # to pick: a rate by its word, else one without a quantity
            ranked = [text for q in (RATE, "") for text in texts if Header(text).quantity == q]
            pick = next((text for text in ranked if text), "…")
            file.contradict(
                f"{file.listed([number])} takes turns among {_counted(codes, texts)}, {evidence}, "
                "but a recording is of one device; pick its rows, such as rows: "
                f"{{{file.table.names[number] or number}: {pick}}}"
            )


def _evidence(name: str, codes: Codes, texts: Texts) -> str:
    """What tells that the value of a row, by the codes (m,), says what it is of; or nothing."""
    filled, rows = texts.astype(bool), np.bincount(codes)
    runs = np.bincount(codes[np.flatnonzero(np.diff(codes, prepend=-1))])
    words = filled & [not _NUMBER_OR_FLAG.fullmatch(text) for text in texts]
    if _DEVICE.search(name) and (filled & (rows >= len(codes) / 100)).sum() > 1:
        return "by its name devices"
    return "which say what a row is" if (words & (runs > 2)).sum() > 1 else ""  # noqa: PLR2004


def _change(rates: Floats, codes: Codes, least: float = 0.3, sigmas: float = 8) -> str:
    """How rates (m, 3) change with the codes (m,) of their rows, for a message; or nothing.

    Each run of a code is compared with both of its neighbours, which takes off drift. A change is
    more than ``least`` of the mean size of the noise, and than ``sigmas`` standard errors.
    """
    finite = np.isfinite(rates).all(axis=1)
    starts = np.flatnonzero(np.diff(codes[finite], prepend=-1))
    if len(starts) < 32:  # noqa: PLR2004 - of fewer, a standard error says little
        return ""
    level = np.clip(rates[finite], *np.quantile(rates[finite], [0.01, 0.99], axis=0))  # no spikes
    means = np.add.reduceat(level, starts) / np.diff(starts, append=finite.sum())[:, None]
    differences, runs = means[1:-1] - (means[:-2] + means[2:]) / 2, codes[finite][starts[1:-1]]
    for code in np.flatnonzero(np.bincount(runs) > 10):  # noqa: PLR2004 - as above
        of_code = differences[runs == code]
        sizes, errors = np.abs(of_code.mean(axis=0)), of_code.std(axis=0) / len(of_code) ** 0.5
        excess = sizes - np.maximum(sigmas * errors, least * level.std(axis=0))
        if excess.max() > 0:
            size = f"{AXES[excess.argmax()]} changes by {sizes[excess.argmax()]:.3g} deg/s"
            return f"with which the rate about {size}"
    return ""


def _coded(column: NDArray[Any]) -> tuple[Codes, Texts]:
    """Of each row the number of its value, and the values as texts."""
    codes, values = pd.factorize(column, use_na_sentinel=False)
    return codes, np.array([_as_text(value) for value in values], object)


def _as_text(value: Any) -> str:
    """A value as it is typed: 1 of 1.0; an empty text of none."""
    return "" if pd.isna(value) else f"{value:.15g}" if isinstance(value, float) else str(value)


def _counted(codes: Codes, texts: Texts, most: int = 8) -> str:
    """Values and how many rows have each, for a message."""
    pairs = zip(texts[:most], np.bincount(codes), strict=False)
    shown = [f"{text or 'blank'} ({count} rows)" for text, count in pairs]
    return ", ".join(shown) + (", …" if len(texts) > most else "")
