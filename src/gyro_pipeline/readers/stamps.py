"""Finds the column of times, by name, unit and content, and measures the sample rate.

If no column of times is found, or its unit is unknown, a finding says so.
"""

import re
from math import isclose
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from gyro_pipeline.logs import REJECTED
from gyro_pipeline.readers.clock import Timing, from_counter, from_stamps
from gyro_pipeline.readers.file import File
from gyro_pipeline.readers.formats import find_all
from gyro_pipeline.readers.times import are_steps, seconds
from gyro_pipeline.units import Unit, read_unit

Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]
Rows = NDArray[np.intp]

_STATED_RATE = re.compile(
    r"(?i)\b(?:(?:sampl\w*|output|update|data)[ _-]?(?:rate|freq\w*)|odr|fs)\b"
    r"[^\w\n]{0,20}(?:hz)?[^\w\n.]{0,20}(\d+(?:\.\d+)?)[ ]{0,3}(k?)(?:hz|\s|$|[,;\"])"
)
_TIME_SCALE = re.compile(r"(?im)^\W*t(?:ime)?[ _]?scale\W+([\d.]+(?:e[-+]?\d+)?)\s*$")
_UNITS_S = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}


class TimeColumn(NamedTuple):
    """A candidate for the column of times."""

    number: int
    unit_s: float | None  # seconds per unit, by the file
    by_name: bool  # whether its name, its content or the options say that it holds times


def timing_of(file: File, keep: Mask) -> Timing:
    """Rate and gaps of the rows in the mask ``keep`` (n,).

    Raises:
        InputError: The column that the options name holds no times.
    """
    problem, stepwise = "", file.options.time_is == "steps"
    for number, header_s, by_name in time_columns(file):
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
            times = np.cumsum(np.nan_to_num(times))  # over all rows, including those left out
        least_share = 0.0 if by_name else 0.95  # other columns must prove that they hold times
        if _increase(times[keep], least_share):
            unit_s = _unit_s(file, number, header_s)
            timing = from_stamps(times[keep], unit_s, np.flatnonzero(keep))
            file.findings += timing.findings
            _check_rate(file, number, timing.rate_hz, unit_s)
            return timing
    if file.options.time_column is not None:
        problem = problem or f"{file.options.time_column!r} holds no times that can be read"
        raise file.refusal(f"{problem}, or correct time_column")
    file.note(
        "timestamps",
        problem or "no column of times: rate and gaps are not measured; give time_column",
    )
    return Timing()


def _increase(times: Floats, share: float) -> bool:
    """Whether most times (n,) are valid, and increase in more than a share of the rows."""
    finite = times[np.isfinite(times)]
    if len(finite) < max(len(times) / 2, 2) or finite[-1] <= finite[0]:
        return False
    return share == 0 or bool(np.count_nonzero(np.diff(finite) >= 0) > share * (len(finite) - 1))


def time_columns(file: File) -> list[TimeColumn]:
    """Candidates for the column of times.

    The format's columns come first, then the others in order; columns with a name of times and an
    uncontradicted unit come before the rest. A column without such a name must increase.
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
            candidates.append(((not by_name, not certain), TimeColumn(number, unit_s, by_name)))
    return [candidate for _, candidate in sorted(candidates, key=lambda pair: pair[0])]


def stated_unit_s(file: File) -> float | None:
    """Seconds per unit of time, by the options."""
    units = file.options.time_units
    return (read_unit(units) or Unit("time")).factor if isinstance(units, str) else units


def _unit_s(file: File, number: int, header_s: float | None) -> float | None:
    """Seconds per unit of a time column, by the options, the header or a line above it."""
    if file.table.columns[number].dtype.kind != "f":
        return 1.0
    name, match = file.listed([number]), _TIME_SCALE.search(file.table.preamble)
    line_s = float(match[1]) if match else None
    unit_s = stated_unit_s(file) or header_s or line_s
    for where, stated_s in {
        f"{name} has": header_s,
        "a line above the header says": line_s,
    }.items():
        if unit_s and stated_s and not isclose(stated_s, unit_s):
            text = f"a unit of {stated_s:g} s, but {unit_s:g} s is used; correct time_units"
            file.add_contradiction(f"{where} {text}")
    if not unit_s:
        text = f"{name} has no unit: the rate is not measured; give time_units"
        if file.options.time_column is not None:
            raise file.refusal(text)
        file.note("timestamps", text)
    return unit_s


def _check_rate(
    file: File, number: int, hz: float | None, unit_s: float | None,
    slow: float = 0.1, fast: float = 2e4,
) -> None:  # fmt: skip
    """Contradict an implausible rate, and suggest the units that make a plausible one."""
    if hz and unit_s and not slow <= hz <= fast:
        rates = {u: hz * unit_s / s for u, s in _UNITS_S.items() if 1 <= hz * unit_s / s < fast}
        units = [f"time_units: {unit}, which makes {rate:.6g} Hz" for unit, rate in rates.items()]
        file.add_contradiction(
            f"{file.listed([number])}, in units of {unit_s:g} s, makes {hz:.6g} Hz, at which no "
            f"gyroscope is read; give {', or '.join(units) or 'time_units'}"
        )


def counted_gaps(file: File, keep: Mask) -> Rows:
    """Gaps by the packet counter of the options or the format, which counts rows of the file."""
    name, bits = file.form.counter if file.form else ("", 16)
    numbers = find_all(file.table, name) if name else []
    if file.options.counter_column is not None:
        numbers = [file.find(file.options.counter_column)]
    if not numbers or len(file.table.columns[numbers[0]]) != len(keep):
        return np.empty(0, np.intp)
    if not keep.all():
        file.note("packet counter", "rows are left out, so the packet counter is not used")
        return np.empty(0, np.intp)
    gaps = from_counter(file.table.numbers(numbers[0]), file.options.counter_bits or bits)
    file.findings += gaps.findings
    return gaps.gap_rows


def compare_rates(file: File, rate_hz: float | None, expected_hz: float | None, keep: Mask) -> None:
    """Compare the measured or expected rate with the expected one and with a stated one."""
    tolerance = file.options.rate_tolerance_pct / 100
    if rate_hz and expected_hz and abs(rate_hz / expected_hz - 1) > tolerance:
        got = f"{expected_hz:g} Hz within {100 * tolerance:g} %, got {rate_hz:.6g} Hz"
        advice = "check time_units, and the sensor's rate_hz, or samples and recording_s"
        file.note("sample rate", f"expected {got}; {advice}", REJECTED)
    # a stated rate is that of all rows of the file
    match = _STATED_RATE.search(file.table.preamble) if keep.all() else None
    stated_hz = float(match[1]) * (1e3 if match[2] else 1) if match else None
    hz, source = (rate_hz, "measured") if rate_hz else (expected_hz, "expected")
    if stated_hz and hz and abs(hz / stated_hz - 1) > tolerance:
        text = f"lines above the header state {stated_hz:g} Hz, {hz:.6g} Hz is {source}"
        file.add_contradiction(f"{text}; give time_units")
