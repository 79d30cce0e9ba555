"""A logger's file in, a recording in deg/s out.

A file is a table (``table``). Names, units, format and options say which of its columns is what
(``columns``); some of its rows are samples (``rows``); their time is told by content (``times``,
``clock``), and their values must be a gyroscope's (``counts``).
"""

import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from gyro_pipeline.conventions import InputError
from gyro_pipeline.logs import KEPT, REJECTED, Finding, Log
from gyro_pipeline.parameters import ReaderOptions
from gyro_pipeline.readers import counts, rows
from gyro_pipeline.readers.clock import Timing, check_rate, from_counter, from_stamps
from gyro_pipeline.readers.columns import Layout, TimeColumn, find, layout_of
from gyro_pipeline.readers.formats import FORMATS, check_format
from gyro_pipeline.readers.table import IN_READER, Table, read_table
from gyro_pipeline.readers.times import are_steps, seconds

__all__ = ["FORMATS", "Table", "check_format", "log_of", "read_log"]

Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]


def read_log(
    path: Path,
    options: ReaderOptions,
    expected_rate_hz: float | None = None,
    imu: int | None = None,
) -> Log:
    """Read one recording from a logger's file.

    Args:
        path: The file; what it is, its content tells.
        options: What it does not say of itself.
        expected_rate_hz: A sample rate that differs by more than ``options.rate_tolerance_pct`` is
            a REJECTED finding; None: not compared.
        imu: Whose recording, where ``options.columns`` has those of several IMUs.

    Returns:
        The recording in deg/s, with NaN, infinity and zeros as they are in the file.

    Raises:
        InputError: The file cannot be read, or can be read in two ways; says where and why.
    """
    return log_of(read_table(path, options), options, expected_rate_hz, imu)


def log_of(
    table: Table,
    options: ReaderOptions,
    expected_rate_hz: float | None = None,
    imu: int | None = None,
) -> Log:
    """The same of a table."""
    layout = layout_of(table, options, imu)
    raw = _stacked(table, layout.rates)
    keep, left_out = _samples(table, raw, options)
    values = _checked_counts(raw[keep], layout, options, table.where)
    timing, of_time = _timing(table, layout, keep, options)
    rates = _in_dps(values, layout, options, timing.rate_hz or expected_rate_hz, table.where)
    contradictions = [
        *layout.contradictions,
        *_turns(table, layout, keep, rates),
        *_implausible(raw[keep], rates, layout, options),
        *of_time,
    ]
    overruled = _settled(contradictions, options, table.where)
    count, of_counter = _counted(table, layout, keep)
    temperature, acceleration = (_beside(table, some, keep) for some in (layout.temperature, layout.acceleration))
    rate = _compared(timing.rate_hz, expected_rate_hz, table.preamble, options)
    return Log(
        samples=rates,
        rate_hz=timing.rate_hz,
        gap_rows=np.union1d(timing.gap_rows, count.gap_rows).astype(np.intp),
        temperature_c=None if temperature is None else temperature[:, 0],
        acceleration_g=acceleration,
        rows=None if keep.all() else np.flatnonzero(keep),
        findings=(
            *table.findings,
            *layout.findings,
            *overruled,
            *left_out,
            *timing.findings,
            *of_counter,
            *count.findings,
            *rate,
        ),
    )


def _settled(contradictions: Sequence[str], options: ReaderOptions, where: str) -> list[Finding]:
    """Refuse what can be read in two ways, unless the options are trusted, which is then said."""
    if not contradictions:
        return []
    if options.trust == "options":
        return [Finding("trust: options", KEPT, f"overruled: {text}") for text in contradictions]
    more = f" (and {len(contradictions) - 1} more)" if len(contradictions) > 1 else ""
    raise InputError(
        f"{where}: {contradictions[0]}{more}; or, if the options are right, trust: options {IN_READER}"
    )


def _stacked(table: Table, columns: Sequence[int]) -> Floats:
    values = [table.numbers(number) for number in columns]
    if len({len(column) for column in values}) > 1:
        lengths = {table.names[n]: len(table.columns[n]) for n in columns}
        raise InputError(f"{table.where}: expected columns of the same length, got {lengths}")
    return np.stack(values, axis=1)


def _samples(table: Table, raw: Floats, options: ReaderOptions) -> tuple[Mask, list[Finding]]:
    """Rows of the table that are samples, and what was left out."""
    keep = np.ones(len(raw), bool)
    if options.rows:
        keep = rows.picked(table, options.rows, lambda name: find(table, name))
        if len(keep) != len(raw):
            raise InputError(f"{table.where}: rows: columns as long as the rates were expected")
    findings = []
    for check, some, text in (
        ("blank rows", rows.blank_at_regular_shares, "are blank in all rates, at a regular share"),
        ("repeated rows", rows.repeated, "repeat the one before (repeats: drop)"),
    ):
        if some is rows.repeated and options.repeats is None:
            continue
        there = np.flatnonzero(keep)
        out = some(raw[keep])
        keep[there[out]] = False
        if out.any():
            text = f"{out.sum()} of {len(out)} rows {text}; they are no samples and left out"
            findings.append(Finding(check, KEPT, text))
    return keep, findings


def _turns(table: Table, layout: Layout, keep: Mask, rates: Floats) -> list[str]:
    """What columns that nobody asked for say of the rows."""
    said = (rows.takes_turns(table, number, keep, rates) for number in layout.unasked)
    return [text for text in said if text]


def _checked_counts(raw: Floats, layout: Layout, options: ReaderOptions, where: str) -> Floats:
    """The file's numbers; signed, and from the offset, where the options say so."""
    if options.signed_bits is not None:
        raw = counts.signed(raw, options.signed_bits, f"{where}: {IN_READER}")
    return raw - options.offset if options.offset is not None else raw


def _implausible(raw: Floats, rates: Floats, layout: Layout, options: ReaderOptions) -> list[str]:
    """Values that no gyroscope at rest gives."""
    if options.offset is not None or options.signed_bits is not None:
        return []
    found = [counts.wrapped(raw), "" if layout.raw else counts.lost_decimal_points(raw)]
    return [text for text in (*found, counts.implausible_level(rates)) if text][:1]


def _in_dps(
    values: Floats, layout: Layout, options: ReaderOptions, rate_hz: float | None, where: str
) -> Floats:
    """Rates; of increments, the angle of each sample over the step between samples."""
    if not options.increments:
        return values * layout.scale
    if rate_hz is None:
        raise InputError(
            f"{where}: increments: true: the step between samples is not known; give time_column "
            f"{IN_READER}, or the sensor's rate"
        )
    return values * layout.scale * rate_hz


def _timing(
    table: Table, layout: Layout, keep: Mask, options: ReaderOptions
) -> tuple[Timing, list[str]]:
    """Rate and gaps by the first column that holds times, and what contradicts its unit."""
    steps = []
    for column in layout.times:
        name = table.names[column.number] or f"column {column.number}"
        stamps = _stamps(table, column, keep, options)
        if stamps is None:
            continue
        stepwise = are_steps(stamps)
        if options.time_is == "steps" and (stepwise or options.time_column is not None):
            stamps = np.cumsum(np.nan_to_num(stamps))
        elif stepwise:
            steps.append(f"{name!r} holds the time since the last row: give time_is: steps")
            continue
        elif column.only_steps or options.time_is == "steps":
            continue
        finite = stamps[np.isfinite(stamps)]
        if len(finite) < len(stamps) / 2 or finite[-1] <= finite[0]:
            continue
        return _measured(stamps, column, name, table)
    if options.time_column is not None:
        problem = steps[0] if steps else f"{options.time_column!r} holds no times that can be read"
        raise InputError(f"{table.where}: {problem}, or correct time_column {IN_READER}")
    text = steps[0] if steps else "no column of times: rate and gaps are unseen; give time_column"
    return Timing(findings=(Finding("timestamps", KEPT, text),)), []


def _stamps(
    table: Table, column: TimeColumn, keep: Mask, options: ReaderOptions
) -> Floats | None:
    """Times of the samples, (n,), in the column's own unit, or in seconds if it has none."""
    values = table.columns[column.number]
    if len(values) != len(keep):
        return None
    is_number = values.dtype.kind == "f"
    stamps = values if is_number else seconds(values, None)
    return None if stamps is None else np.asarray(stamps, np.float64)[keep]


def _measured(
    stamps: Floats, column: TimeColumn, name: str, table: Table
) -> tuple[Timing, list[str]]:
    is_number = table.columns[column.number].dtype.kind == "f"
    unit_s = (column.asked_s or column.said_s) if is_number else 1.0
    timing = from_stamps(stamps, unit_s)
    if unit_s is None:
        text = f"{name!r} has no unit: the rate is not measured; give time_units"
        return replace(timing, findings=(*timing.findings, Finding("timestamps", KEPT, text))), []
    if not (is_number and column.asked_s and column.said_s) or timing.rate_hz is None:
        return timing, []
    if np.isclose(column.asked_s, column.said_s, rtol=1e-9, atol=0):
        return timing, []
    said_hz = timing.rate_hz * column.asked_s / column.said_s
    return timing, [
        f"{name!r} says a unit of {column.said_s:g} s, which makes {said_hz:.6g} Hz, but time_units "
        f"of the options {column.asked_s:g} s, which makes {timing.rate_hz:.6g} Hz"
    ]


def _counted(table: Table, layout: Layout, keep: Mask) -> tuple[Timing, list[Finding]]:
    """Gaps by the packet counter, unless rows that were left out have numbers of their own."""
    if layout.counter is None or len(table.columns[layout.counter[0]]) != len(keep):
        return Timing(), []
    numbers = table.numbers(layout.counter[0])[keep]
    if not keep.all() and np.nanmedian(np.diff(numbers)) != 1:
        text = "the packet counter counts rows that were left out as well, and is not used"
        return Timing(), [Finding("packet counter", KEPT, text)]
    return from_counter(numbers, layout.counter[1]), []


def _beside(table: Table, some: tuple[Sequence[int], object], keep: Mask) -> Floats | None:
    """Columns beside the rates in their unit, (n, k); None where they cannot be had."""
    numbers, unit = some
    columns = [table.columns[number] for number in numbers]
    if not columns or any(c.dtype.kind != "f" or len(c) != len(keep) for c in columns):
        return None
    values = np.stack(columns, axis=1)[keep] * unit.factor + unit.offset
    return values if np.isfinite(values).any() else None


_STATED_RATE = re.compile(
    r"(?i)\b(?:(?:sampl\w*|output|update|data)[ _-]?(?:rate|freq\w*)|odr|fs)\b"
    r"[^\w\n]*(?:hz)?[^\w\n.]*(\d+(?:\.\d+)?)[ ]*(k?)(?:hz|\s|$|[,;\"])"
)


def _compared(
    rate_hz: float | None, expected_hz: float | None, preamble: str, options: ReaderOptions
) -> list[Finding]:
    """The measured rate with the expected one, and with that of the lines above the header."""
    findings: list[Finding] = []
    if rate_hz is not None and expected_hz is not None:
        findings += check_rate(rate_hz, expected_hz, options.rate_tolerance_pct)
    if match := _STATED_RATE.search(preamble):
        stated_hz = float(match[1]) * (1e3 if match[2] else 1)
        other_hz = rate_hz or expected_hz
        if other_hz and stated_hz and check_rate(other_hz, stated_hz, options.rate_tolerance_pct):
            what = "measured" if rate_hz else "expected"
            text = (
                f"lines above the header state {stated_hz:g} Hz, {what} is {other_hz:.6g} Hz; check "
                f"time_units {IN_READER}"
            )
            findings.append(Finding("stated rate", REJECTED, text))
    return findings
