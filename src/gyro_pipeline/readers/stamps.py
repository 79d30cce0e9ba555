"""The time of the samples: the first column that holds times, told by name, unit and content.

What is not known of the time is said in one finding.
"""

import re
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from gyro_pipeline.logs import KEPT, Finding
from gyro_pipeline.readers.clock import Timing, from_stamps
from gyro_pipeline.readers.formats import above_header, find_all
from gyro_pipeline.readers.names import File, Header
from gyro_pipeline.readers.times import are_steps, seconds
from gyro_pipeline.units import Unit, read_unit

_TIME = re.compile(
    r"time|stamp|elapsed|epoch?|clock|date|utc|unix|uptime|tick|second|milli|micro|nano|^ts?$|^$"
)
_DURATION = re.compile(
    r"loop|delta|diff|exposure|response|integration|latency|interval|duration|lag|period|age\b"
    r"|offset|valid|zone|out\b|comp|temp"
)
_STEPS = re.compile(r"dt\b|delta|step|interval|period")


class Candidate(NamedTuple):
    """A column that may be one of times.

    Attributes:
        number: Of the column.
        said_s, asked_s: Its unit in seconds, by the file and by the options.
        only_steps: Whether its name allows nothing but the time since the last row.
    """

    number: int
    said_s: float | None
    asked_s: float | None
    only_steps: bool = False


def names_time(header: Header) -> bool:
    """Whether a column is one of times by its name."""
    name = header.name.lower()
    unit_alone = not name and header.measures("time")
    return bool(unit_alone or (name and _TIME.search(name))) and not _DURATION.search(name)


def timing_of(file: File, keep: NDArray[np.bool_]) -> Timing:
    """Rate and gaps of the rows (n,) that are kept.

    Raises:
        InputError: The column that the options name holds no times.
    """
    steps, options = [], file.options
    for candidate in _candidates(file):
        stamps = _stamps(file, candidate, keep)
        if stamps is None:
            continue
        stepwise = are_steps(stamps)
        if options.time_is == "steps" and (stepwise or options.time_column is not None):
            stamps = np.cumsum(np.nan_to_num(stamps))
        elif stepwise:
            name = file.listed([candidate.number])
            steps.append(f"{name} holds the time since the last row; give time_is: steps")
            continue
        elif candidate.only_steps or options.time_is == "steps":
            continue
        known = stamps[np.isfinite(stamps)]
        if len(known) >= len(stamps) / 2 and known[-1] > known[0]:
            return _measured(file, candidate, stamps)
    if options.time_column is not None:
        problem = steps or [f"{options.time_column!r} holds no times that can be read"]
        raise file.refusal(f"{problem[0]}, or correct time_column")
    text = steps[0] if steps else "no column of times: rate and gaps are unseen; give time_column"
    return Timing(findings=(Finding("timestamps", KEPT, text),))


def _candidates(file: File) -> Sequence[Candidate]:
    """Columns that may be of times: those that say their unit or are no numbers come first."""
    units, form = file.options.time_units, file.form
    asked_s = (read_unit(units) or Unit("time")).factor if isinstance(units, str) else units
    if file.options.time_column is not None:
        number = file.find(file.options.time_column)
        return [Candidate(number, _said_s(file.headers[number]), asked_s)]
    first: list[Candidate] = []
    later: list[Candidate] = []
    steps: list[Candidate] = []
    for name, unit_s in form.times if form else ():
        scale = above_header(file.table.preamble, form.time_scale) if form else 1.0
        numbers = find_all(file.table, name)
        first += [Candidate(n, unit_s and unit_s * scale, asked_s) for n in numbers]
    for number, header in enumerate(file.headers):
        is_text = file.table.columns[number].dtype.kind != "f"
        candidate = Candidate(number, _said_s(header), asked_s)
        if is_text or names_time(header):
            (first if is_text or candidate.said_s or asked_s else later).append(candidate)
        elif candidate.said_s and _STEPS.search(header.name.lower()):
            steps.append(candidate._replace(only_steps=True))
    return [*first, *later, *steps]


def _said_s(header: Header) -> float | None:
    return header.unit.factor if header.unit and header.measures("time") else None


def _stamps(
    file: File, candidate: Candidate, keep: NDArray[np.bool_]
) -> NDArray[np.float64] | None:
    """Times, (n,), numbers in the column's own unit, others in seconds."""
    values = file.table.columns[candidate.number]
    if len(values) != len(keep):
        return None
    times = values if values.dtype.kind == "f" else seconds(values, None)
    return None if times is None else np.asarray(times, np.float64)[keep]


def _measured(file: File, candidate: Candidate, stamps: NDArray[np.float64]) -> Timing:
    """Rate and gaps; the unit of the options contradicts another one of the file."""
    said_s, asked_s = candidate.said_s, candidate.asked_s
    if file.table.columns[candidate.number].dtype.kind != "f":
        said_s, asked_s = 1.0, None
    name = file.listed([candidate.number])
    timing = from_stamps(stamps, asked_s or said_s)
    if not (asked_s or said_s):
        text = f"{name} has no unit: the rate is not measured; give time_units"
        if file.options.time_column is not None:
            raise file.refusal(text)
        return replace(timing, findings=(*timing.findings, Finding("timestamps", KEPT, text)))
    if asked_s and said_s and timing.rate_hz and not np.isclose(asked_s, said_s, 1e-9, 0):
        said_hz = timing.rate_hz * asked_s / said_s
        file.contradictions.append(
            f"{name} has a unit of {said_s:g} s, which makes {said_hz:.6g} Hz, but time_units of "
            f"the options {asked_s:g} s, which makes {timing.rate_hz:.6g} Hz"
        )
    return timing
