"""The time of the samples: the first column that holds times, told by name, unit and content.

What is not known of the time is said in one finding.
"""

import re
from dataclasses import replace
from math import isclose

import numpy as np
from numpy.typing import NDArray

from gyro_pipeline.logs import KEPT, REJECTED, Finding
from gyro_pipeline.readers.clock import Timing, from_counter, from_stamps
from gyro_pipeline.readers.file import File
from gyro_pipeline.readers.formats import find_all
from gyro_pipeline.readers.table import IN_READER
from gyro_pipeline.readers.times import are_steps, seconds
from gyro_pipeline.units import Unit, read_unit

Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]
Rows = NDArray[np.intp]

_STATED_RATE = re.compile(
    r"(?i)\b(?:(?:sampl\w*|output|update|data)[ _-]?(?:rate|freq\w*)|odr|fs)\b"
    r"[^\w\n]{0,20}(?:hz)?[^\w\n.]{0,20}(\d+(?:\.\d+)?)[ ]{0,3}(k?)(?:hz|\s|$|[,;\"])"
)
_UNITS_S = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
_TIME_SCALE = re.compile(r"(?im)^\W*t(?:ime)?[ _]?scale\W+([\d.]+(?:e[-+]?\d+)?)\s*$")


def timing_of(file: File, keep: Mask) -> Timing:
    """Rate and gaps of the rows (n,) that are kept.

    Raises:
        InputError: The column that the options name holds no times.
    """
    problem, stepwise = "", file.options.time_is == "steps"
    for number, unit_s, by_name in time_columns(file):
        values = file.table.columns[number]
        times = values if values.dtype.kind == "f" else seconds(values, None)
        if times is None or len(times) != len(keep):
            continue
        if are_steps(times) != stepwise:
            if by_name and not stepwise and not problem:
                name = file.listed([number])
                problem = f"{name} holds the time since the last row; give time_is: steps"
            continue
        if stepwise:
            times = np.cumsum(np.nan_to_num(times))  # of all rows, also of those left out
        if _increase(times[keep], 0.0 if by_name else 0.95):
            return _measured(file, number, unit_s, times[keep], np.flatnonzero(keep))
    if file.options.time_column is not None:
        problem = problem or f"{file.options.time_column!r} holds no times that can be read"
        raise file.refusal(f"{problem}, or correct time_column")
    problem = problem or "no column of times: rate and gaps are unseen; give time_column"
    return Timing(findings=(Finding("timestamps", KEPT, problem),))


def _increase(times: Floats, share: float) -> bool:
    """Whether most times (n,) are there and increase, in more than a share of the rows."""
    finite = times[np.isfinite(times)]
    if len(finite) < max(len(times) / 2, 2) or finite[-1] <= finite[0]:
        return False
    return share == 0 or bool(np.count_nonzero(np.diff(finite) >= 0) > share * (len(finite) - 1))


def time_columns(file: File) -> list[tuple[int, float | None, bool]]:
    """Columns that may be of times: number, seconds in a unit by the file, and whether by name.

    The format's go first, then others in the file's order; those with a time's name and a unit
    that nothing contradicts before the rest. A column without such a name must increase.
    """
    times, column = file.form.times if file.form else (), file.options.time_column
    by_format = {n: unit_s for name, unit_s in times for n in find_all(file.table, name)}
    order = dict.fromkeys([*by_format, *range(len(file.headers))])
    candidates, options_s = [], stated_unit_s(file)
    for number in order if column is None else [file.find(column)]:
        header, unit = file.headers[number], file.headers[number].unit
        unit_s = unit.factor if unit and header.measures("time") else by_format.get(number)
        is_text = file.table.columns[number].dtype.kind != "f"
        by_name = is_text or column is not None or number in by_format or header.names_time
        certain = is_text or len({unit_s, options_s} - {None}) == 1
        if by_name or (unit_s and not header.names_duration):
            candidates.append(((not by_name, not certain), (number, unit_s, by_name)))
    return [candidate for _, candidate in sorted(candidates, key=lambda pair: pair[0])]


def stated_unit_s(file: File) -> float | None:
    """Seconds in the options' unit of time."""
    units = file.options.time_units
    return (read_unit(units) or Unit("time")).factor if isinstance(units, str) else units


def _measured(
    file: File, number: int, header_s: float | None, times: Floats, numbers: Rows
) -> Timing:
    """Rate and gaps by times (n,) of the rows with these numbers.

    Options, header and a line above it may state the unit; what differs from it contradicts.
    """
    if file.table.columns[number].dtype.kind != "f":
        return from_stamps(times, 1.0, numbers)
    name, unit_s = file.listed([number]), stated_unit_s(file) or header_s
    match = _TIME_SCALE.search(file.table.preamble)
    line_s = float(match[1]) if match else 1.0
    timing = from_stamps(times, unit_s, numbers)
    if not unit_s:
        text = f"{name} has no unit: the rate is not measured; give time_units"
        text += f": {line_s:g}, as a line above the header says" if match else ""
        if file.options.time_column is not None:
            raise file.refusal(text)
        return replace(timing, findings=(*timing.findings, Finding("timestamps", KEPT, text)))
    hz = timing.rate_hz
    stated = {f"{name} has": header_s, "a line above the header says": line_s if match else None}
    for where, stated_s in stated.items():
        if hz and stated_s and not isclose(stated_s, unit_s):
            file.contradictions.append(
                f"{where} a unit of {stated_s:g} s, which makes {hz * unit_s / stated_s:.6g} Hz, "
                f"but it is read in {unit_s:g} s, which makes {hz:.6g} Hz; correct time_units"
            )
    return replace(timing, findings=(*timing.findings, *_implausible(file, name, hz, unit_s)))


def _implausible(
    file: File, name: str, hz: float | None, unit_s: float, slow: float = 0.1, fast: float = 2e4
) -> tuple[Finding, ...]:
    """A rate at which no gyroscope is read, and the units that make an ordinary one."""
    if hz is None or slow <= hz <= fast:
        return ()
    rates = {unit: hz * unit_s / s for unit, s in _UNITS_S.items() if 1 <= hz * unit_s / s < fast}
    units = ", or ".join(f"time_units: {u}, which makes {r:.6g} Hz" for u, r in rates.items())
    text = f"{name}, in units of {unit_s:g} s, makes {hz:.6g} Hz, at which no gyroscope is read; "
    text += f"give {units or 'time_units'}, and trust: options {IN_READER}"
    return (Finding("sample rate", KEPT if file.options.trust else REJECTED, text),)


def counted(file: File, keep: Mask) -> Timing:
    """Gaps by the packet counter of the options or the format; it counts the rows of the file."""
    name, bits = file.form.counter if file.form and file.form.counter else ("", 16)
    numbers = find_all(file.table, name) if name else []
    if file.options.counter_column is not None:
        numbers = [file.find(file.options.counter_column)]
    if not numbers or len(file.table.columns[numbers[0]]) != len(keep):
        return Timing()
    if not keep.all():
        text = "rows are left out, so the packet counter is not used"
        return Timing(findings=(Finding("packet counter", KEPT, text),))
    return from_counter(file.table.numbers(numbers[0]), file.options.counter_bits or bits)


def compare_rates(
    file: File, rate_hz: float | None, expected_hz: float | None, keep: Mask
) -> tuple[Finding, ...]:
    """Rates that differ by more than the tolerance: measured, expected, stated above the header."""
    findings, tolerance = [], file.options.rate_tolerance_pct / 100
    if rate_hz and expected_hz and abs(rate_hz / expected_hz - 1) > tolerance:
        text = f"expected {expected_hz:g} Hz within {100 * tolerance:g} %, got {rate_hz:.6g} Hz; "
        powers = [n for n in (-6, -3, 3, 6) if abs(rate_hz / expected_hz / 10.0**n - 1) < tolerance]
        text += (
            f"it is off by 10^{powers[0]}: check time_units"
            if powers
            else ("check the file's time, and samples and recording_s of the sensor")
        )
        findings.append(Finding("sample rate", REJECTED, text))
    # it is stated of the file's rows, not of those that are left of them
    match = _STATED_RATE.search(file.table.preamble) if keep.all() else None
    stated_hz = float(match[1]) * (1e3 if match[2] else 1) if match else None
    hz, how = (rate_hz, "measured") if rate_hz else (expected_hz, "expected")
    if stated_hz and hz and abs(hz / stated_hz - 1) > tolerance:
        text = f"lines above the header state {stated_hz:g} Hz, {hz:.6g} Hz is {how}; give "
        text += f"time_units, or, if it is right, trust: options {IN_READER}"
        outcome = KEPT if file.options.trust else REJECTED
        findings.append(Finding("stated rate", outcome, text))
    return (*findings,)
