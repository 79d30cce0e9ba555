"""Which column of a table is what.

A column is a rate only if it says so: by a name and a unit, or by the user's word. What a name, a
header, the lines above it, a format and the options say of the same thing must agree. Where two of
them contradict each other, both are named and the file is refused; ``trust: options`` decides for
the options, and a finding then says what they overruled.
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from math import isclose
from typing import NoReturn

from gyro_pipeline.conventions import AXES, InputError
from gyro_pipeline.logs import KEPT, Finding
from gyro_pipeline.parameters import Column, ReaderOptions
from gyro_pipeline.readers.formats import (
    BIAS_TAKEN_OFF,
    Format,
    above_header,
    find_all,
    format_of,
)
from gyro_pipeline.readers.names import (
    OTHER,
    RATE,
    Header,
    read_header,
    samples_a_row,
    triples,
)
from gyro_pipeline.readers.table import IN_READER, Table
from gyro_pipeline.units import Unit, read_unit

_RATE_UNITS = "deg/s, rad/s, mdps, deg/h, … or raw (with scale_dps)"


@dataclass(frozen=True)
class TimeColumn:
    """A column that may be one of times.

    Attributes:
        number: Of the column.
        said_s, asked_s: Its unit in seconds, by the file and by the options.
        only_steps: Whether its name allows nothing but the time since the last row.
    """

    number: int
    said_s: float | None
    asked_s: float | None = None
    only_steps: bool = False


@dataclass(frozen=True)
class Layout:
    """Which columns of a table are what, by number.

    Attributes:
        rates: About x, y, z.
        scale: deg/s, or degrees where they are increments, in one unit of them.
        raw: Whether they are counts.
        times: Columns that may be of times, the best first.
        temperature, acceleration: Columns and their unit; empty where there are none.
        counter: Number and bits of a packet counter.
        unasked: Columns that say nothing of what they hold.
        contradictions: What to refuse the file for, unless the options are trusted.
        findings: What the header does not say.
    """

    rates: Sequence[int]
    scale: float
    raw: bool
    times: Sequence[TimeColumn]
    temperature: tuple[Sequence[int], Unit]
    acceleration: tuple[Sequence[int], Unit]
    counter: tuple[int, int] | None
    unasked: Sequence[int]
    contradictions: Sequence[str]
    findings: Sequence[Finding]


@dataclass(frozen=True)
class _File:
    """A table, its headers, the options and the format; what was noticed goes into the lists."""

    table: Table
    headers: Sequence[Header]
    options: ReaderOptions
    form: Format | None
    contradictions: list[str] = field(default_factory=list)
    findings: list[Finding] = field(default_factory=list)

    @property
    def where(self) -> str:
        return self.table.where

    def listed(self, numbers: Sequence[int]) -> str:
        return ", ".join(repr(self.table.names[n] or f"column {n}") for n in numbers)

    def note(self, check: str, text: str) -> None:
        self.findings.append(Finding(check, KEPT, text))


def layout_of(table: Table, options: ReaderOptions, imu: int | None = None) -> Layout:
    """Find the columns and their units.

    Args:
        table: Of the file.
        options: What the file does not say.
        imu: Whose columns, where the options give those of several IMUs.

    Raises:
        InputError: A column or unit is missing, or is one of several that could be meant.
    """
    headers = [read_header(name) for name in table.names]
    file = _File(table, headers, options, format_of(table, options.format))
    given = _columns_of(imu, options, table.where)
    rates = _given_rates(file, given) if given else _named_rates(file)
    _note_what_names_say(file, rates)
    scale, raw = _scale(file, rates)
    times, counter = _times(file, rates), _counter(file)
    temperature, acceleration = _temperature(file), _acceleration(file, rates)
    used = {*rates, *temperature[0], *acceleration[0], *(counter or ())[:1]}
    return Layout(
        rates=rates,
        scale=scale,
        raw=raw,
        times=times,
        temperature=temperature,
        acceleration=acceleration,
        counter=counter,
        unasked=[n for n in range(len(headers)) if n not in used and _says_nothing(file, n)],
        contradictions=tuple(file.contradictions),
        findings=tuple(file.findings),
    )


def find(table: Table, column: Column) -> int:
    """Look up a column by its name, with or without the unit behind it, or by its number from 0.

    Raises:
        InputError: There is no such column, or more than one.
    """
    if isinstance(column, int):
        if column < len(table.names):
            return column
        raise InputError(
            f"{table.where}: expected a column {column} (from 0), got {len(table.names)} columns: "
            f"{table.listed()}; correct the number {IN_READER}"
        )
    exact = [number for number, name in enumerate(table.names) if name == column]
    alike = exact or [n for n, name in enumerate(table.names) if read_header(name).name == column]
    if len(alike) == 1:
        return alike[0]
    if alike:
        raise InputError(
            f"{table.where}: expected one column {column!r}, got {len(alike)}, numbers {alike} (from "
            f"0): two sensors in one file? Give the columns' numbers {IN_READER}"
        )
    raise InputError(
        f"{table.where}: expected a column {column!r}, got {table.listed()}; correct the name "
        f"{IN_READER}"
    )


def _columns_of(
    imu: int | None, options: ReaderOptions, where: str
) -> Sequence[Column] | None:
    if not isinstance(options.columns, dict):
        return options.columns
    if imu not in options.columns:
        raise InputError(
            f"{where}: columns are given of IMUs {', '.join(map(str, options.columns))}, not of IMU "
            f"{imu}; correct columns {IN_READER}"
        )
    return options.columns[imu]


def _given_rates(file: _File, given: Sequence[Column]) -> Sequence[int]:
    """The columns of the options; they contradict names of something else or of another order."""
    rates = [find(file.table, column) for column in given]
    if len(set(rates)) < len(AXES):
        raise InputError(f"{file.where}: expected three columns of rates, got {list(given)}")
    for triple in triples(file.headers):
        if set(triple) == set(rates) and list(triple) != rates:
            file.contradictions.append(
                f"columns of the options are {file.listed(rates)}, but by their names x, y, z are "
                f"{file.listed(triple)}; give that order, or no columns"
            )
        elif 0 < len({*triple} & {*rates}) < len(AXES):
            file.contradictions.append(
                f"columns of the options are {file.listed(rates)}, but by their names "
                f"{file.listed(triple)} belong together; give columns of one sensor"
            )
    for number in rates:
        quantity = file.headers[number].quantity
        if quantity not in ("", RATE) and not file.options.increments:
            file.contradictions.append(
                f"columns of the options name {file.table.names[number]!r}, which by its name is "
                "no angular rate; give columns of angular rates"
            )
            break
    return rates


def _named_rates(file: _File) -> Sequence[int]:
    """The only three columns that say they are rates about x, y, z."""
    if file.form:
        return [find_all(file.table, name)[0] for name in file.form.rates]
    found = triples(file.headers)
    named = [t for t in found if file.headers[t[0]].quantity == RATE]
    plain = [t for t in found if not file.headers[t[0]].quantity]
    wanted = ("angle",) if file.options.increments else ("rate", "count")
    by_unit = [t for t in plain if (unit := file.headers[t[0]].unit) and unit.quantity in wanted[:1]]
    good = [t for t in named if (unit := file.headers[t[0]].unit) is None or unit.quantity in wanted]
    candidates = good + by_unit or named
    if not candidates and file.options.units:  # the user's word
        candidates = plain
        if not any(file.table.names) and len(file.table.names) == len(AXES):
            candidates = [(0, 1, 2)]
    if len(candidates) == 1:
        return candidates[0]
    if candidates and samples_a_row(file.headers, candidates[0]) > 1:
        return candidates[0]  # is refused for that
    _refuse_candidates(file, candidates, plain)


def _refuse_candidates(
    file: _File, candidates: Sequence[Sequence[int]], plain: Sequence[Sequence[int]]
) -> NoReturn:
    if not candidates and len(plain) == 1:
        raise InputError(
            f"{file.where}: {file.listed(plain[0])} do not say what they measure, of "
            f"{file.table.listed()}; if they are angular rates, give units: {_RATE_UNITS} {IN_READER}"
        )
    if not candidates:
        raise InputError(
            f"{file.where}: expected three columns of angular rate about x, y, z that say so by "
            f"name or unit, got {file.table.listed()}; give columns, such as [gx, gy, gz], and units "
            f"{IN_READER}"
        )
    first, second = candidates[:2]
    raise InputError(
        f"{file.where}: expected one sensor, got rates {file.listed(first)} and {file.listed(second)}"
        f"{' and others' if len(candidates) > 2 else ''}; give columns of the one to read, such as "  # noqa: PLR2004
        f"{list(first)}, or of both as IMUs, {{1: {list(first)}, 2: {list(second)}}}, {IN_READER}"
    )


def _note_what_names_say(file: _File, rates: Sequence[int]) -> None:
    """Several samples a row; rates that are free of their bias; a browser's axes."""
    samples = samples_a_row(file.headers, rates)
    if samples > len(AXES):
        file.contradictions.append(
            f"each row holds {samples} samples, {file.listed(rates)} and so on, of which one would "
            "be read; write a row for each sample"
        )
    first = file.table.names[rates[0]]
    for words, reason in BIAS_TAKEN_OFF.items():
        if re.search(words, first, re.IGNORECASE):
            file.note("bias taken off", f"{first!r} is what is left of a bias: {reason}")
    if re.search("alpha|beta|gamma", first, re.IGNORECASE):
        text = "a browser's alpha is taken for the rate about z, beta x, gamma y (W3C, 2016)"
        file.note("axes", f"{text}; some browsers number them from x")
    if file.form and file.form.remark:
        file.note("axes", file.form.remark)


def _scale(file: _File, rates: Sequence[int]) -> tuple[float, bool]:
    """deg/s, or degrees of increments, in one unit of the rates; and whether they are counts."""
    options = file.options
    header, asked = _unit_of_header(file, rates), _unit_asked(options)
    above = _units_above(file.table.preamble)
    stated = header or (next(iter(above.items())) if len(above) == 1 else None)
    if header and above and not any(_same(header[1], unit) for unit in above.values()):
        _contradict(file, f"the header says {header[0]}", f"lines above it {', '.join(above)}")
    if file.form and stated is None:
        stated = (file.form.units, read_unit(file.form.units) or Unit("rate"))
        if above:
            _contradict(file, f"the format writes {stated[0]}", f"lines above {', '.join(above)}")
        elif asked is None:
            file.note("unit", f"{stated[0]}, by the format; the file does not say")
    if asked and stated and not _same(asked[1], stated[1]):
        _contradict(file, f"the file says {stated[0]}, {file.listed(rates)}", f"units {asked[0]}")
    unit = asked or stated
    if unit is None:
        raise InputError(
            f"{file.where}: expected a unit of the rates, got {file.listed(rates)}; give units: "
            f"{_RATE_UNITS} {IN_READER}"
        )
    if unit[1].quantity == "count" and options.scale_dps is None:
        raise InputError(
            f"{file.where}: {file.listed(rates)} are raw counts: give units: raw and scale_dps, "
            f"deg/s a count, {IN_READER}"
        )
    return _with_scale_above(file, options.scale_dps or unit[1].factor), options.scale_dps is not None


def _unit_of_header(file: _File, rates: Sequence[int]) -> tuple[str, Unit] | None:
    """As written, and what it is; none where the header has none, or one of something else."""
    wanted = ("angle",) if file.options.increments else ("rate", "count")
    headers = [file.headers[number] for number in rates]
    inner = [read_header(header.name) for header in headers]  # gx_dps (rad/s)
    units = {h.unit for h in headers} | {h.unit for h in inner if h.unit and h.unit.quantity == "rate"}
    if len(units) > 1:
        _contradict(file, f"the header has several units, {file.listed(rates)}", "expected one")
    said, unit = headers[0].said, headers[0].unit
    if unit and unit.quantity in wanted:
        return said, unit
    if headers[0].says_another_unit:
        kind = "angle turned" if file.options.increments else "angular rate"
        hint = "; of an angle turned since the last row, give increments: true"
        is_angle = bool(unit and unit.quantity == "angle")
        _contradict(file, f"{file.listed(rates)} say {said}", f"no unit of {kind}{hint * is_angle}")
    elif said and {h.said for h in headers} == {said}:
        file.note("unit", f"the header's remark {said!r} is no unit and says nothing here")
    return None


def _unit_asked(options: ReaderOptions) -> tuple[str, Unit] | None:
    if options.units is None:
        return None
    return options.units, read_unit(options.units) or Unit("rate")


def _same(one: Unit, other: Unit) -> bool:
    return one.quantity == other.quantity and isclose(one.factor, other.factor, rel_tol=1e-9)


def _contradict(file: _File, one: str, other: str) -> None:
    file.contradictions.append(f"{one}, but {other}")


def _units_above(preamble: str) -> dict[str, Unit]:
    """Units of angular rate that lines above the header name; not those of a range, 250 dps."""
    words = re.findall(r"[^\s,;:=()\[\]\"'#%]+", preamble)
    found: dict[str, Unit] = {}
    for at in range(len(words)):
        if at and re.fullmatch(r"[-+±]*[\d.]+", words[at - 1]):
            continue
        for text in (" ".join(words[at : at + count]) for count in (3, 2, 1)):
            unit = read_unit(text)
            if unit and (unit.quantity == "rate" or text == "LSB"):
                if not any(_same(unit, other) for other in found.values()):
                    found[text] = unit
                break
    return found


_SCALE_ABOVE = re.compile(
    r"(?im)^\W*((?:g|gyro\w*)[ _]?(?:scale|sensitivity)(?:[ _]?factor)?|scale[ _]?factor|scale)"
    r"\W+([-+]?[\d.]+(?:e[-+]?\d+)?)"
)


def _with_scale_above(file: _File, scale: float) -> float:
    """The scale, times a factor above the header that the format knows; others contradict it."""
    match = _SCALE_ABOVE.search(file.table.preamble)
    if match is None or float(match[2]) == 1:
        return scale
    if file.form and file.form.scale:
        return scale * above_header(file.table.preamble, file.form.scale)
    factor = float(match[2])
    read = (factor, 1 / factor, (read_unit("rad/s") or Unit("rate")).factor * factor)
    if not any(isclose(scale, value, rel_tol=1e-3) for value in read):
        _contradict(
            file,
            f"a line above the header says {match[1]} {match[2]}",
            f"the scale is {scale:g} deg/s; give units: raw and scale_dps",
        )
    return scale


# ---- time: told by content, among the columns whose name or unit allows it

_TIME_WORDS = re.compile(
    r"time|stamp|elapsed|epoch?|clock|date|utc|unix|uptime|tick|second|milli|micro|nano|^ts?$|^$"
)
_DURATION = re.compile(
    r"loop|delta|diff|exposure|response|integration|latency|interval|duration|lag|period|age\b"
    r"|offset|valid|zone|out\b"
)


def _times(file: _File, rates: Sequence[int]) -> Sequence[TimeColumn]:
    """Columns that may be of times: those that say their unit or are no numbers come first."""
    asked = file.options.time_units
    asked_s = (read_unit(asked) or Unit("time")).factor if isinstance(asked, str) else asked
    if file.options.time_column is not None:
        number = find(file.table, file.options.time_column)
        return [TimeColumn(number, _said_s(file.headers[number]), asked_s)]
    by_format = [
        TimeColumn(n, unit_s and unit_s * above_header(file.table.preamble, file.form.time_scale), asked_s)
        for name, unit_s in (file.form.times if file.form else ())
        for n in find_all(file.table, name)
    ]
    with_unit, without, steps = [], [], []
    for number, header in enumerate(file.headers):
        name, said_s = header.name.lower(), _said_s(header)
        is_text = file.table.columns[number].dtype.kind != "f"
        named = bool(_TIME_WORDS.search(name)) and not _DURATION.search(name)
        candidate = TimeColumn(number, said_s, asked_s)
        if named or is_text:
            (with_unit if is_text or said_s or asked_s else without).append(candidate)
        elif said_s and re.search(r"dt\b|delta|step|interval|period", name):
            steps.append(replace(candidate, only_steps=True))
    return [*by_format, *with_unit, *without, *steps]


def _said_s(header: Header) -> float | None:
    return header.unit.factor if header.unit and header.unit.quantity == "time" else None


# ---- what is kept beside the rates, and never a reason to refuse

_NOTHING: tuple[Sequence[int], Unit] = ((), Unit("other"))
_CELSIUS = {
    "c": Unit("temperature"),
    "f": Unit("temperature", 5 / 9, -160 / 9),
    "k": Unit("temperature", 1.0, -273.15),
}
_OF_WHAT = "gyro imu sensor board chip die mcu cpu ambient case out".split()


def _temperature(file: _File) -> tuple[Sequence[int], Unit]:
    """The column of the options, or the only one that is named so, and its unit."""
    if file.options.temperature_column is not None:
        number = find(file.table, file.options.temperature_column)
        header = file.headers[number]
        return [number], _celsius(header)[1] or Unit("temperature")
    found = {n: unit for n, h in enumerate(file.headers) for named, unit in [_celsius(h)] if named}
    told = {n: unit for n, unit in found.items() if unit} or found
    if len(told) > 1:
        names = file.listed(list(told))
        file.note("temperature", f"none of {names} is kept; name one by temperature_column")
        return _NOTHING
    for number, unit in told.items():
        if unit is None:
            name = file.table.names[number]
            file.note("temperature", f"{name!r} has no unit and is taken for degrees Celsius")
        return [number], unit or Unit("temperature")
    return _NOTHING


def _celsius(header: Header) -> tuple[bool, Unit | None]:
    """Whether a header names a temperature, and its unit if it says one."""
    words = [word.lower() for word in re.findall(r"[A-Z]?[a-z]+|[A-Z]+(?![a-z])", header.name)]
    letter = words.pop() if len(words) > 1 and words[-1] in _CELSIUS else ""
    while words and words[-1] in _OF_WHAT:
        words.pop()
    named = bool(words) and words[-1] in ("temp", "temperature", "t")
    if header.unit and header.unit.quantity == "temperature":
        return named or len(header.said) > 1, header.unit
    if header.said:
        unit = _CELSIUS.get(header.said.lower())
        return named and unit is not None, unit
    # temp_c, but temp_f may be a filtered one
    return named and (letter == "c" or (not letter and words[-1] != "t")), _CELSIUS.get(letter)


def _acceleration(file: _File, rates: Sequence[int]) -> tuple[Sequence[int], Unit]:
    """The columns of the options, the format's, or the only three that are named so."""
    options = file.options
    unit = read_unit(options.acceleration_units) if options.acceleration_units else None
    if options.acceleration_columns:
        columns: Sequence[int] = [find(file.table, c) for c in options.acceleration_columns]
    elif file.form and file.form.acceleration:
        names, by_format = file.form.acceleration
        columns = [n for name in names for n in find_all(file.table, name)]
        factor = above_header(file.table.preamble, file.form.acceleration_scale)
        unit = unit or _scaled(read_unit(by_format), factor)
    else:
        found = [t for t in triples(file.headers) if _accelerates(file.headers[t[0]])]
        columns = found[0] if len(found) == 1 else ()
    if len(columns) != len(AXES) or {*columns} & {*rates}:
        return _NOTHING
    header = file.headers[columns[0]]
    said = next((u for u in map(read_unit, (header.said, header.said.lower())) if u and u.quantity == "acceleration"), None)
    if not (unit or said):
        text = f"{file.listed(columns)} have no unit and are not kept; give acceleration_units"
        file.note("acceleration", text)
        return _NOTHING
    return columns, unit or said or Unit("acceleration")


def _scaled(unit: Unit | None, factor: float) -> Unit | None:
    return unit and unit._replace(factor=unit.factor * factor)


def _accelerates(header: Header) -> bool:
    """Whether it names what an accelerometer measures, gravity included."""
    name = header.name.lower()
    named = re.search(r"acc|^a[ _.]?[xyz]$", name) and header.quantity == OTHER
    return bool(named) and not re.search(r"lin|user|free|gyr|ang|cov|bias|offset|std|norm", name)


def _says_nothing(file: _File, number: int) -> bool:
    """Whether a header names no quantity, so that its column may say what a row is."""
    header = file.headers[number]
    measures = header.quantity or _celsius(header)[0] or header.says_another_unit
    is_time = _TIME_WORDS.search(header.name.lower()) and header.name
    is_number = file.table.columns[number].dtype.kind == "f"
    return not (is_number and (measures or is_time))


def _counter(file: _File) -> tuple[int, int] | None:
    options, by_format = file.options, file.form.counter if file.form else None
    if options.counter_column is not None:
        return find(file.table, options.counter_column), options.counter_bits or 16
    if by_format and (found := find_all(file.table, by_format[0])):
        return found[0], options.counter_bits or by_format[1]
    return None
