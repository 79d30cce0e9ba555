"""A logger's file in, a recording in deg/s out.

A file is a table (``table``). Names, units, format and options say which of its columns are the
rates (``columns``, ``scales``) and what stands beside them (``beside``); some of its rows are
samples (``rows``); their time is told by content (``stamps``, ``times``, ``clock``), and their
values must be a gyroscope's (``counts``).
"""

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from gyro_pipeline.logs import KEPT, REJECTED, Finding, Log
from gyro_pipeline.parameters import ReaderOptions
from gyro_pipeline.readers import counts, rows
from gyro_pipeline.readers.beside import acceleration_of, counter_of, named_celsius, temperature_of
from gyro_pipeline.readers.clock import Timing, check_rate, from_counter
from gyro_pipeline.readers.columns import rate_columns
from gyro_pipeline.readers.formats import FORMATS, check_format, format_of
from gyro_pipeline.readers.names import File, read_header, triples
from gyro_pipeline.readers.scales import scale_of
from gyro_pipeline.readers.stamps import names_time, timing_of
from gyro_pipeline.readers.table import IN_READER, Table, read_table

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
    """The recording that a table holds; arguments and errors are those of :func:`read_log`."""
    headers = [read_header(name) for name in table.names]
    file = File(table, headers, options, format_of(table, options.format))
    columns = rate_columns(file, imu)
    scale, raw_counts = scale_of(file, columns)
    raw = _stacked(file, columns)
    keep = _samples(file, raw)
    timing = timing_of(file, keep)
    rates = _in_dps(file, raw[keep], scale, timing.rate_hz or expected_rate_hz)
    temperature, acceleration = temperature_of(file), acceleration_of(file, columns)
    counter = counter_of(file)
    used = {*columns, *temperature.columns, *acceleration.columns, *(counter or ())[:1]}
    _contradict_by_values(file, raw[keep], rates, raw_counts)
    _contradict_by_turns(file, used, keep, rates)
    overruled = _settled(file)
    counted = _counted(file, counter, keep)
    compared = _compared(file, timing.rate_hz, expected_rate_hz, keep)
    celsius = temperature.read(table, keep)
    findings = *table.findings, *file.findings, *overruled, *timing.findings, *counted.findings
    return Log(
        samples=rates,
        rate_hz=timing.rate_hz,
        gap_rows=np.union1d(timing.gap_rows, counted.gap_rows).astype(np.intp),
        temperature_c=None if celsius is None else celsius[:, 0],
        acceleration_g=acceleration.read(table, keep),
        rows=None if keep.all() else np.flatnonzero(keep),
        findings=(*findings, *compared),
    )


def _settled(file: File) -> list[Finding]:
    """Refuse what can be read in two ways, unless the options are trusted, which is then said."""
    texts = file.contradictions
    if file.options.trust == "options":
        return [Finding("trust: options", KEPT, f"overruled: {text}") for text in texts]
    if texts:
        more = f" (and {len(texts) - 1} more)" if len(texts) > 1 else ""
        raise file.refusal(f"{texts[0]}{more}; or, if the options are right, trust: options")
    return []


def _stacked(file: File, columns: Sequence[int]) -> Floats:
    values = [file.table.numbers(number) for number in columns]
    if len({*map(len, values)}) > 1:
        lengths = [len(column) for column in values]
        names = file.listed(columns)
        raise file.refusal(f"expected columns of one length, got {lengths} of {names}; correct it")
    return np.stack(values, axis=1)


def _samples(file: File, raw: Floats) -> Mask:
    """Rows (n,) of the table that are samples."""
    keep = np.ones(len(raw), bool)
    for name, value in file.options.rows.items():
        keep &= rows.with_value(file.table, file.find(name), value, len(raw))
    for check, wanted, leave_out, why in (
        ("blank rows", True, rows.blank_at_regular_shares, "are blank, at a regular share"),
        ("repeated rows", file.options.repeats, rows.repeated, "repeat the one before"),
    ):
        out = leave_out(raw[keep]) if wanted else np.zeros(1, bool)
        if out.any():
            file.note(check, f"{out.sum()} of {len(out)} rows {why}: no samples, left out")
            keep[np.flatnonzero(keep)[out]] = False
    return keep


def _in_dps(file: File, raw: Floats, scale: float, rate_hz: float | None) -> Floats:
    """Rates of the file's numbers; of increments, the angle of a sample over its step."""
    options = file.options
    if options.signed_bits is not None:
        raw = counts.signed(raw, options.signed_bits, file.table.where)
    rates = (raw - (options.offset or 0.0)) * scale
    if not options.increments:
        return rates
    if rate_hz is None:
        text = "increments: true: the step between samples is not known; give time_column"
        raise file.refusal(text)
    return rates * rate_hz


def _contradict_by_values(file: File, raw: Floats, rates: Floats, raw_counts: bool) -> None:
    """Values that no gyroscope at rest gives, unless the options explain them."""
    from_zero, of_sign = file.options.offset is not None, file.options.signed_bits is not None
    for text in (
        "" if from_zero or of_sign else counts.wrapped(raw),
        "" if raw_counts else counts.lost_decimal_points(raw),
        "" if from_zero else counts.implausible_level(rates),
    ):
        if text:
            file.contradictions.append(text)
            return


def _contradict_by_turns(file: File, used: set[int], keep: Mask, rates: Floats) -> None:
    """Columns that nobody asked for and that say what a row is."""
    of_axes = {number for triple in triples(file.headers) for number in triple}
    for number, header in enumerate(file.headers):
        named = number in of_axes and header.quantity
        measures = named or header.has_unit or named_celsius(header)[0]
        is_number = file.table.columns[number].dtype.kind == "f"
        if number in used or (is_number and (measures or names_time(header))):
            continue
        if text := rows.takes_turns(file.table, number, keep, rates):
            file.contradictions.append(text)


def _counted(file: File, counter: tuple[int, int] | None, keep: Mask) -> Timing:
    """Gaps by the packet counter, unless rows that were left out have numbers of their own."""
    if counter is None or len(file.table.columns[counter[0]]) != len(keep):
        return Timing()
    numbers = file.table.numbers(counter[0])[keep]
    if not keep.all() and np.nanmedian(np.diff(numbers)) != 1:
        text = "the packet counter counts rows that were left out as well, and is not used"
        return Timing(findings=(Finding("packet counter", KEPT, text),))
    return from_counter(numbers, counter[1])


_STATED_RATE = re.compile(
    r"(?i)\b(?:(?:sampl\w*|output|update|data)[ _-]?(?:rate|freq\w*)|odr|fs)\b"
    r"[^\w\n]{0,20}(?:hz)?[^\w\n.]{0,20}(\d+(?:\.\d+)?)[ ]{0,3}(k?)(?:hz|\s|$|[,;\"])"
)


def _compared(
    file: File, rate_hz: float | None, expected_hz: float | None, keep: Mask
) -> list[Finding]:
    """The measured rate with the expected one, and with that of the lines above the header."""
    findings: list[Finding] = []
    tolerance_pct = file.options.rate_tolerance_pct
    if rate_hz is not None and expected_hz is not None:
        findings += check_rate(rate_hz, expected_hz, tolerance_pct)
    # it is stated of the file's rows, not of those that are left of them
    match = _STATED_RATE.search(file.table.preamble) if keep.all() else None
    stated_hz = float(match[1]) * (1e3 if match[2] else 1) if match else 0.0
    other_hz = rate_hz or expected_hz
    if stated_hz and other_hz and check_rate(other_hz, stated_hz, tolerance_pct):
        what = "measured" if rate_hz else "expected"
        text = (
            f"lines above the header state {stated_hz:g} Hz, {what} is {other_hz:.6g} Hz; give "
            f"time_units, or, if it is right, trust: options {IN_READER}"
        )
        findings.append(Finding("stated rate", KEPT if file.options.trust else REJECTED, text))
    return findings
