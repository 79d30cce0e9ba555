"""Selects the rows of a table that are samples.

A recording is of a single device. Rows of other devices or kinds, rows without rates and rows that
repeat the previous row are left out before the time is read, by the options or by evidence in the
rows themselves. Ambiguous files are refused.
"""

import re
from collections.abc import Callable, Collection
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gyro_pipeline.conventions import AXES
from gyro_pipeline.readers.file import File
from gyro_pipeline.readers.names import RATE, Header

Codes = NDArray[np.intp]
Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]
Texts = NDArray[Any]

MOST_VALUES = 32
"""Most values of a column that names devices; columns of more hold measurements or counts."""

_DEVICE = re.compile(
    r"(?i)(?:^|[ _.])(?:device|dev|sensor|imu|gyro|gyroscope|board|chip|unit|module|channel|ch|"
    r"port|slot|mux|bus|node|source|serial|mac|topic|kind|type|id|name|addr|address|tag|instance)"
    r"(?:[ _]?(?:id|no|nr|num|number|name|index|tag|addr|address))?$"
)
_NUMBER_OR_FLAG = re.compile(r"(?i)[-+.\de]*|inf|-inf|true|false|t|f|yes|no|y|n|on|off")


def sample_rows(file: File, rates: Floats) -> Mask:
    """Mask (n,) of the rows that are samples; rates (n, 3) are the numbers of the file.

    Raises:
        InputError: No row has the values that the options require.
    """
    keep = np.ones(len(rates), bool)
    for name, value in file.options.rows.items():
        keep &= _with_value(file, file.find(name), value, len(rates))
    _leave_out(file, keep, rates, blank_at_regular_shares, "are blank, at a regular share")
    if file.options.repeats:
        _leave_out(file, keep, rates, repeats_previous, "repeat the previous row")
    return keep


def _leave_out(
    file: File, keep: Mask, rates: Floats, no_samples: Callable[[Floats], Mask], text: str
) -> None:
    """Remove from the mask ``keep`` (n,) the rows that a check finds not to be samples."""
    out = no_samples(rates if keep.all() else rates[keep])
    if out.any():
        file.note("rows", f"{out.sum()} of {len(out)} rows {text}: not samples, left out")
        keep[np.flatnonzero(keep)[out]] = False


def _with_value(file: File, number: int, value: str | float, count: int) -> Mask:
    """Mask (count,) of the rows with a value in a column."""
    codes, texts = _coded(file.table.columns[number])
    mask = np.asarray(texts == _as_text(value))[codes]
    got = f"{_as_text(value)} in {file.listed([number])}, got {_with_counts(codes, texts)}"
    if len(mask) != count or not mask.any():
        raise file.refusal(f"expected {count} rows, some with {got}; correct rows")
    if Header(_as_text(value)).quantity not in ("", RATE):
        file.add_contradiction(f"rows of the options pick, by its name no angular rate, {got}")
    return mask


def blank_at_regular_shares(
    rates: Floats, least_share: float = 0.05, least_runs: int = 10, alike: float = 0.9
) -> Mask:
    """Mask (n,) of regularly blank rows, as in files with another sensor of a higher rate.

    Args:
        rates: (n, 3), NaN where blank.
        least_share: Least share of blank rows; fewer are losses.
        least_runs: Least number of runs of blank rows, and of other rows.
        alike: Least share of runs that are about as long as the median run; lengths scatter where
            rows are lost at random.
    """
    blank = np.isnan(rates[:, 0])
    blank = blank & np.isnan(rates).all(axis=1) if blank.any() else blank
    lengths = np.diff(np.flatnonzero(np.diff(blank)))
    regular = np.count_nonzero(blank) >= least_share * len(rates) and len(lengths) >= 2 * least_runs
    for runs in (lengths[0::2], lengths[1::2]) if regular else ():
        near = np.abs(runs - np.median(runs)) <= max(1, np.median(runs) / 4)
        regular &= near.mean() >= alike
    return blank if regular else np.zeros_like(blank)


def repeats_previous(rates: Floats) -> Mask:
    """Mask (n,) of the rows whose rates (n, 3) are all equal to those of the previous row."""
    return np.r_[False, (rates[1:] == rates[:-1]).all(axis=1)]


def check_single_device(file: File, used: Collection[int], keep: Mask, rates: Floats) -> None:
    """Add a contradiction for each unused column by which the rows are of several devices.

    Such a column has few values: texts that say what a row is, values of a column that is named as
    a device, or numbers with which the rates change.

    Args:
        file: Collects the contradictions.
        used: Numbers of the columns of measurements.
        keep: (n,), mask of the remaining rows.
        rates: (m, 3), rates of the remaining rows.
    """
    for number, (header, column) in enumerate(zip(file.headers, file.table.columns, strict=True)):
        if number in used or len(column) != len(keep) or not _may_name_devices(header, column):
            continue
        codes, texts = _coded(column[keep])
        evidence = ""
        if 1 < len(texts) <= MOST_VALUES:
            evidence = _evidence(header.name, codes, texts) or _change(rates, codes)
        if evidence:
            file.add_contradiction(
                f"{file.listed([number])} has the values {_with_counts(codes, texts)}, {evidence}, "
                "but a recording is of one device; pick its rows, such as rows: "
                f"{{{file.table.names[number] or number}: {_suggestion(texts)}}}"
            )


def _may_name_devices(header: Header, column: NDArray[Any]) -> bool:
    """Whether a column has no unit or name of a measurement, and few values in a sample of rows."""
    if column.dtype.kind == "f" and (header.unit_text or header.names_time):
        return False
    cells = column[:: len(column) // 100 + 1].tolist()
    return len({cell for cell in cells if cell == cell}) <= MOST_VALUES  # noqa: PLR0124 - not NaN


def _suggestion(texts: Texts) -> str:
    """The value whose rows are probably wanted: a word for a rate, else one without a quantity."""
    ranked = [text for q in (RATE, "") for text in texts if Header(text).quantity == q]
    return next((text for text in ranked if text), "…")


def _evidence(name: str, codes: Codes, texts: Texts) -> str:
    """Evidence that the values, by the codes (m,) of rows, name devices; or an empty text."""
    nonblank, rows = texts.astype(bool), np.bincount(codes)
    runs = np.bincount(codes[np.flatnonzero(np.diff(codes, prepend=-1))])
    words = nonblank & [not _NUMBER_OR_FLAG.fullmatch(text) for text in texts]
    if _DEVICE.search(name) and (nonblank & (rows >= len(codes) / 100)).sum() > 1:
        return "by its name devices"
    return "which say what a row is" if (words & (runs > 2)).sum() > 1 else ""  # noqa: PLR2004


def _change(rates: Floats, codes: Codes, least: float = 0.3, sigmas: float = 8) -> str:
    """Evidence that rates (m, 3) change with the codes (m,) of their rows; or an empty text.

    Each run of a code is compared with the mean of its neighbours, which removes drift. A change is
    larger than ``least`` standard deviations of the rates, and than ``sigmas`` standard errors.
    """
    finite = np.isfinite(rates).all(axis=1)
    starts = np.flatnonzero(np.diff(codes[finite], prepend=-1))
    if len(starts) < 32:  # noqa: PLR2004 - the standard error of fewer is unreliable
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
    """The code of each row's value, and the values by code, as texts."""
    import pandas as pd  # noqa: PLC0415 - few files need it, and every worker would wait for it

    codes, values = pd.factorize(column, use_na_sentinel=False)
    return codes, np.array([_as_text(value) for value in values], object)


def _as_text(value: Any) -> str:
    """A value as a user types it: 1 for 1.0; an empty text for a missing one."""
    missing = value is None or value != value  # noqa: PLR0124 - NaN
    return "" if missing else f"{value:.15g}" if isinstance(value, float) else str(value)


def _with_counts(codes: Codes, texts: Texts, most: int = 8) -> str:
    """Values with their numbers of rows, for a message."""
    pairs = zip(texts[:most], np.bincount(codes), strict=False)
    values = [f"{text or 'blank'} ({count} rows)" for text, count in pairs]
    return ", ".join(values) + (", …" if len(texts) > most else "")
