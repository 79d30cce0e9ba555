"""Determines the scale of the rates, deg/s per unit.

The options, the header, the lines above it and the format may state the unit; all statements must
agree. A factor that the file states as well must agree with the unit in one of its readings.
"""

import re
from collections.abc import Iterator, Sequence
from math import isclose

from gyro_pipeline.readers.file import File
from gyro_pipeline.readers.formats import find_all
from gyro_pipeline.readers.names import read_header
from gyro_pipeline.units import Unit, read_unit

RATE_UNITS = "deg/s, rad/s, mdps, deg/h, … or raw (with scale_dps)"

# not part of a name, a date, a time of day or a number of bits
_NUMBER = (
    r"(?<![\w.])(?<!\d[-:])([-+]?(?:\d+\.?\d*|\.\d+)(?:e[-+]?\d+)?)(?![\w.]*\d|[-:/]\d|\s*-?bit)"
)
_SCALE = re.compile(
    r"(?i)(?:scal(?:e|ing)|sensitivity|resolution|gain|factor(?!y)|multiplier|lsb|(?<![a-z])g?res(?![a-z]))"
    rf"[^\n]*?{_NUMBER}|{_NUMBER}(?=\s*(?:lsb|counts?|digits?)\W*(?:/|per))"
)
_OF_OTHERS = re.compile(
    r"(?i)acc|mag|temp|time|baro|press|humid|image|video|lens|camera|screen|"
    r"(?<![a-z])[atm][ _]?(?:scal|res|sens|gain|lsb)"
)
_RANGE = re.compile(r"(?i)(?:full[ _-]?scale|range)[^\d\n]*[\d.]+")
_FACTOR = re.compile(r"(?i)[*×]\s*\d|\d\s*[*×]|(?<![a-z])x\d+(?![a-z\d])")
_DPS_PER_RAD = 57.29577951308232

Statement = tuple[str, Unit]
"""A statement of a unit, for a message, and the unit."""


def scale_of(file: File, rates: Sequence[int]) -> tuple[float, bool]:
    """The scale of the rates, deg/s (or degrees) per unit, and whether they are counts.

    Raises:
        InputError: The unit, or the scale of raw counts, is not stated.
    """
    names, by_options, by_format = file.listed(rates), _of_options(file), _of_format(file, rates)
    by_file = [*_of_headers(file, rates), *_of_lines(file)]
    statements, factors = [*by_options, *by_file, *by_format], dict(_stated_factors(file, rates))
    to_type = "".join(f"; {where}: give {_options_for(dps)}" for where, dps in factors.items())
    if not statements:
        text = f"expected a unit of the rates, got {names}; give units: {RATE_UNITS}{to_type}"
        raise file.refusal(file.contradictions[0] if file.contradictions else text)
    if statements == by_format:
        file.note("unit", f"{by_format[0][0]}; the file does not say")
    first, unit = statements[0]
    for other, other_unit in statements:
        if not _agree(unit, other_unit):
            text = f"{first}, but {other}, of {names}"
            if not by_options:
                raise file.refusal(f"{text}; give units and trust: options")
            file.add_contradiction(f"{text}; correct units")
    scale, are_counts = unit.factor, unit.quantity == "count"
    if are_counts and not by_options and scale == 1:
        text = f"{names} are raw counts: give units: raw and scale_dps, deg/s per count{to_type},"
        raise file.refusal(text)
    for where, readings in factors.items():
        equal = [reading for reading, dps in readings.items() if isclose(dps, scale, rel_tol=1e-3)]
        if not equal:
            file.add_contradiction(
                f"{where}, but the scale is {scale:g} deg/s; give {_options_for(readings)}"
            )
        elif len(readings) > 1:
            file.note("scale", f"{where}, which is taken for {equal[0]}")
    if file.options.scale_dps is None and all(_FACTOR.search(file.table.names[n]) for n in rates):
        text = f"{names} name a factor, and the scale is {scale:g} deg/s"
        file.add_contradiction(f"{text}; give units: raw and scale_dps, deg/s per count")
    return scale, are_counts


def _agree(first: Unit, second: Unit) -> bool:
    """Whether units are equal; a unit of counts may leave their scale open."""
    of_any_size = first.quantity == "count" and 1 in (first.factor, second.factor)
    alike = of_any_size or isclose(first.factor, second.factor, rel_tol=1e-6)
    return first.quantity == second.quantity and alike


def _of_options(file: File) -> list[Statement]:
    units, scale_dps = file.options.units, file.options.scale_dps
    if scale_dps is not None:
        return [(f"the options say raw, of {scale_dps:g} deg/s", Unit("count", scale_dps))]
    unit = read_unit(units) if units else None
    return [(f"units of the options are {units}", unit)] if unit else []


def _of_format(file: File, rates: Sequence[int]) -> list[Statement]:
    form = file.form
    unit = read_unit(form.units) if form else None
    if not (form and unit and {*rates} == {*find_all(file.table, *form.rates.split())}):
        return []
    return [(f"the format has {form.units}", unit)]


def _of_headers(file: File, rates: Sequence[int]) -> Iterator[Statement]:
    """Units of rates in brackets and names; other texts in brackets are contradictions."""
    headers = [file.headers[number] for number in rates]
    inner = [read_header(header.name) for header in headers if header.unit_text]
    headers += [header for header in inner if header.measures("rate")]  # gx_dps (rad/s)
    expected = ("angle",) if file.options.increments else ("rate", "count")
    others = [h for h in headers if h.unit_text and not h.measures(*expected)]
    if others:
        kind = "angle turned" if file.options.increments else "angular rate"
        angles = "give increments: true if they are angles turned since the last row"
        hint = angles if others[0].measures("angle") else "give columns of angular rates"
        names = f"{file.listed(rates)} say {others[0].unit_text!r}"
        file.add_contradiction(f"{names}, but that is no {kind}; {hint}")
    units = {h.unit: h.unit_text for h in headers if h.unit and h not in others}
    yield from ((f"the header says {text}", unit) for unit, text in units.items())


def _of_lines(file: File) -> list[Statement]:
    """The only unit of angular rate in the lines above the header, apart from ranges."""
    words = re.findall(r"[^\s,;:=()\[\]\"'#%]+", file.table.preamble)
    units: dict[Unit, str] = {}
    for at, word in enumerate(words):
        if at and re.fullmatch(r"[-+±]*[\d.]+", words[at - 1]):
            continue
        for text in (" ".join(words[at : at + count]) for count in (3, 2, 1)):
            spelled = re.search(r"/|per|[drs]ps|rpm|-1|⁻¹", text.lower()) or word == "LSB"
            unit = read_unit(text) if spelled else None
            if unit and unit.quantity in ("rate", "count"):
                units.setdefault(unit, text)
                break
    statements = [(f"lines above the header say {text}", unit) for unit, text in units.items()]
    return statements if len(statements) == 1 else []


def _stated_factors(file: File, rates: Sequence[int]) -> Iterator[tuple[str, dict[str, float]]]:
    """Factors of the rates in the lines above the header and in constant columns.

    Yields:
        The source of the factor, for messages, and deg/s per count for each reading of the factor.
    """
    above = [line[:200].strip() for line in file.table.preamble.splitlines()]
    texts = {f"a line above the header says {line!r}": line for line in above}
    for number, (name, column) in enumerate(zip(file.table.names, file.table.columns, strict=True)):
        ends_equal = len(column) > 0 and column[0] == column[-1]  # a quick test
        if number not in rates and ends_equal and (column == column[0]).all():
            texts[f"column {name!r} is {column[0]}"] = f"{name}: {column[0]}"
    for where, text in texts.items():
        line = _RANGE.sub("", text)
        # acc: 16384 LSB/g, gyro: 131 LSB/dps
        of_several = _OF_OTHERS.search(line) and "gyr" in line.lower()
        for part in re.split(r"[,;]\s*(?=[^\W\d])", line) if of_several else [line]:
            match = None if _OF_OTHERS.search(part) else _SCALE.search(part)
            if match and (factor := abs(float(match[1] or match[2]))):
                readings = _readings(part, factor)
                if not isclose(readings.get("deg/s per count", 0), 1, rel_tol=1e-3):
                    yield where, readings


def _readings(line: str, factor: float) -> dict[str, float]:
    """Readings of a factor, by the unit in its line; a gyroscope's count is less than 1 deg/s."""
    factor *= 1e-3 if re.search(r"(?i)mdps|m(?:illi)?(?:deg|°)", line) else 1
    in_deg = re.search(r"(?i)dps|deg|°", line)
    in_rad = not in_deg and re.search("(?i)rad", line)
    unit, size = ("rad/s", _DPS_PER_RAD) if in_rad else ("deg/s", 1)
    readings = {f"{unit} per count": factor * size, f"counts per {unit}": size / factor}
    if not (in_deg or in_rad):
        readings["rad/s per count"] = factor * _DPS_PER_RAD
    return {reading: dps for reading, dps in readings.items() if dps < 1} or readings


def _options_for(readings: dict[str, float]) -> str:
    """The options to type for each reading of a factor."""
    texts = (f"{dps:.6g} if it is {reading}" for reading, dps in readings.items())
    return "units: raw, scale_dps: " + ", or ".join(texts)
