"""The time of the samples: the first column that holds times, told by name, unit and content.

What is not known of the time is said in one finding.
"""

import re
from collections.abc import Sequence
from dataclasses import replace
from math import isclose
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


Floats = NDArray[np.float64]


class Candidate(NamedTuple):
    """A column that may be one of times.

    Attributes:
        number: Of the column.
        said_s, asked_s: Its unit in seconds, by the file and by the options.
        named: Whether its name allows it; if not, its unit does, and its values must increase.
    """

    number: int
    said_s: float | None
    asked_s: float | None
    named: bool = True


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
        stamps = _stamps(file, candidate, len(keep))
        if stamps is None:
            continue
        name = file.listed([candidate.number])
        stepwise = are_steps(stamps)
        if stepwise and not (candidate.named or _STEPS.search(name.lower())):
            continue
        if stepwise and options.time_is is None:
            steps.append(f"{name} holds the time since the last row; give time_is: steps")
            continue
        if options.time_is == "steps":
            if not (stepwise or options.time_column):
                continue
            stamps = np.cumsum(np.nan_to_num(stamps))  # of all rows, also of those left out
        if _increase(stamps[keep], 0.0 if candidate.named else 0.95):
            return _measured(file, candidate, stamps[keep])
    if options.time_column is not None:
        problem = steps or [f"{options.time_column!r} holds no times that can be read"]
        raise file.refusal(f"{problem[0]}, or correct time_column")
    text = steps[0] if steps else "no column of times: rate and gaps are unseen; give time_column"
    return Timing(findings=(Finding("timestamps", KEPT, text),))


def _increase(stamps: Floats, share: float) -> bool:
    """Whether most stamps (n,) are there and increase, in more than a share of the rows."""
    known = stamps[np.isfinite(stamps)]
    if len(known) < max(len(stamps) / 2, 2) or known[-1] <= known[0]:
        return False
    return bool((np.diff(known) >= 0).mean() > share)


def _candidates(file: File) -> Sequence[Candidate]:
    """Columns that may be of times; the first are those whose unit is known, or that are texts."""
    units, form = file.options.time_units, file.form
    asked_s = (read_unit(units) or Unit("time")).factor if isinstance(units, str) else units
    by_format: dict[int, float | None] = {}
    for name, unit_s in form.times if form else ():
        scale = above_header(file.table.preamble, form.time_scale) if form else 1.0
        by_format |= {n: unit_s and unit_s * scale for n in find_all(file.table, name)}
    order = [*by_format, *(n for n in range(len(file.headers)) if n not in by_format)]
    asked = file.options.time_column
    ranked = []
    for number in order if asked is None else [file.find(asked)]:
        header = file.headers[number]
        name, is_text = header.name.lower(), file.table.columns[number].dtype.kind != "f"
        said_s = header.unit.factor if header.unit and header.measures("time") else None
        said_s = said_s or by_format.get(number)
        named = is_text or asked is not None or number in by_format or names_time(header)
        differs = bool(said_s and asked_s and not _same(said_s, asked_s)) and not is_text
        rank = 2 if differs else 0 if is_text or said_s or asked_s else 1
        if named or (said_s and (_STEPS.search(name) or not _DURATION.search(name))):
            ranked.append((rank if named else 3, Candidate(number, said_s, asked_s, named)))
    return [candidate for _, candidate in sorted(ranked, key=lambda pair: pair[0])]


def _same(one_s: float, other_s: float) -> bool:
    return isclose(one_s, other_s, rel_tol=1e-9)


def _stamps(file: File, candidate: Candidate, count: int) -> Floats | None:
    """Times (count,), numbers in the column's own unit, others in seconds."""
    values = file.table.columns[candidate.number]
    if len(values) != count:
        return None
    return values if values.dtype.kind == "f" else seconds(values, None)


def _measured(file: File, candidate: Candidate, stamps: Floats) -> Timing:
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
    if asked_s and said_s and timing.rate_hz and not _same(asked_s, said_s):
        said_hz = timing.rate_hz * asked_s / said_s
        file.contradictions.append(
            f"{name} has a unit of {said_s:g} s, which makes {said_hz:.6g} Hz, but time_units of "
            f"the options {asked_s:g} s, which makes {timing.rate_hz:.6g} Hz"
        )
    return timing
