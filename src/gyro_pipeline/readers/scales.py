"""What one unit of the rates is, in deg/s.

The options, the header, the lines above it and the format may say so; all that say it must agree.
"""

import re
from collections.abc import Sequence
from math import isclose
from typing import NamedTuple

from gyro_pipeline.readers.file import File
from gyro_pipeline.readers.formats import find_all
from gyro_pipeline.readers.names import read_header
from gyro_pipeline.units import Unit, read_unit

RATE_UNITS = "deg/s, rad/s, mdps, deg/h, … or raw (with scale_dps)"

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


class Statement(NamedTuple):
    """Who says what the unit is, and the unit."""

    text: str
    unit: Unit

    def agrees(self, other: "Statement") -> bool:
        """Whether units are the same; one of counts may say nothing of their size."""
        sizes = self.unit.factor, other.unit.factor
        of_any_size = self.unit.quantity == "count" and 1 in sizes
        alike = of_any_size or isclose(*sizes, rel_tol=1e-6)
        return self.unit.quantity == other.unit.quantity and alike


def scale_of(file: File, rates: Sequence[int]) -> tuple[float, bool]:
    """deg/s, or degrees of increments, in one unit of the rates; and whether they are counts.

    Raises:
        InputError: Nobody says the unit, or the scale of raw counts.
    """
    options, names = file.options, file.listed(rates)
    by_options, by_format = _of_options(file), _of_format(file, rates)
    by_file = [*_of_headers(file, rates), *_above(file)]
    scales = _stated_scales(file, rates)
    stated = "".join(f"; {where}: give {_typed(readings)}" for where, readings in scales)
    if not (by_options or by_file or by_format):
        text = f"expected a unit of the rates, got {names}; give units: {RATE_UNITS}{stated}"
        raise file.refusal(file.contradictions[0] if file.contradictions else text)
    if not (by_options or by_file):
        file.note("unit", f"{by_format[0].text}; the file does not say")
    statements = [*by_options, *by_file, *by_format]
    first = statements[0]
    for other in statements[1:]:
        if not other.agrees(first):
            text = f"{first.text}, but {other.text}, of {names}"
            if not by_options:
                raise file.refusal(f"{text}; give units and trust: options")
            file.contradictions.append(f"{text}; correct units")
    counts = first.unit.quantity == "count"
    if counts and first.unit.factor == 1 and options.scale_dps is None:
        text = f"{names} are raw counts: give units: raw and scale_dps, deg/s a count{stated},"
        raise file.refusal(text)
    _contradict_scales(file, first.unit.factor, scales)
    if options.scale_dps is None and all(_FACTOR.search(file.table.names[n]) for n in rates):
        text = f"{names} name a factor, and the scale is {first.unit.factor:g} deg/s"
        file.contradictions.append(f"{text}; give units: raw and scale_dps, deg/s a count")
    return first.unit.factor, counts


def _of_options(file: File) -> list[Statement]:
    units, scale_dps = file.options.units, file.options.scale_dps
    if scale_dps is not None:
        return [Statement(f"the options say raw, of {scale_dps:g} deg/s", Unit("count", scale_dps))]
    unit = read_unit(units) if units else None
    return [Statement(f"units of the options are {units}", unit)] if unit else []


def _of_format(file: File, rates: Sequence[int]) -> list[Statement]:
    """Of the format's own columns."""
    form = file.form
    if form is None or {*rates} != {*find_all(file.table, *form.rates.split())}:
        return []
    return [Statement(f"the format has {form.units}", read_unit(form.units) or Unit("rate"))]


def _of_headers(file: File, rates: Sequence[int]) -> list[Statement]:
    """Units in brackets and names; a unit of anything but a rate contradicts."""
    headers = [file.headers[number] for number in rates]
    inner = [read_header(header.name) for header in headers if header.unit_text]
    headers += [header for header in inner if header.measures("rate")]  # gx_dps (rad/s)
    quantities = ("angle",) if file.options.increments else ("rate", "count")
    strange = [h for h in headers if h.has_unit and not h.measures(*quantities)]
    if strange:
        kind = "angle turned" if file.options.increments else "angular rate"
        angles = "give increments: true if they are angles turned since the last row"
        hint = angles if strange[0].measures("angle") else "give columns of angular rates"
        names = f"{file.listed(rates)} say {strange[0].unit_text!r}"
        file.contradictions.append(f"{names}, but that is no {kind}; {hint}")
    elif headers[0].unit_text and headers[0].unit is None:
        text = f"the remark {headers[0].unit_text!r} in the header is no unit that is known"
        file.note("unit", text)
    units = {h.unit: h for h in headers if h.unit and h not in strange}
    return [Statement(f"the header says {h.unit_text}", unit) for unit, h in units.items()]


def _above(file: File) -> list[Statement]:
    """The unit of angular rate that lines above name, if one; not that of a range of 250 dps."""
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
    statements = [Statement(f"lines above the header say {t}", u) for u, t in units.items()]
    return statements if len(statements) == 1 else []


def _stated_scales(file: File, rates: Sequence[int]) -> list[tuple[str, dict[str, float]]]:
    """Factors on the rates that lines above the header or constant columns name.

    Returns:
        Where each stands, and deg/s a count by what it may be.
    """
    lines = [
        (f"a line above the header says {line[:200].strip()!r}", line[:200])
        for line in file.table.preamble.splitlines()
    ]
    for number, (name, column) in enumerate(zip(file.table.names, file.table.columns, strict=True)):
        if number not in rates and len(column) and (column == column[0]).all():
            lines.append((f"column {name!r} is {column[0]}", f"{name}: {column[0]}"))
    scales = []
    for where, line in lines:
        text = _RANGE.sub("", line)
        # acc: 16384 LSB/g, gyro: 131 LSB/dps
        of_several = _OF_OTHERS.search(text) and "gyr" in text.lower()
        for part in re.split(r"[,;]\s*(?=[^\W\d])", text) if of_several else [text]:
            match = None if _OF_OTHERS.search(part) else _SCALE.search(part)
            if match and (factor := abs(float(match[1] or match[2]))):
                scales.append((where, _readings(part, factor)))
    return scales


def _readings(line: str, factor: float) -> dict[str, float]:
    """deg/s a count, by what a factor may be; the unit in its line leaves fewer readings."""
    factor *= 1e-3 if re.search(r"(?i)mdps|m(?:illi)?(?:deg|°)", line) else 1
    in_rad = {"rad/s a count": factor * _DPS_PER_RAD}
    in_deg = {"deg/s a count": factor, "counts per deg/s": 1 / factor}
    if re.search(r"(?i)dps|deg|°", line):
        return in_deg
    if re.search(r"(?i)rad", line):
        return in_rad | {"counts per rad/s": _DPS_PER_RAD / factor}
    return in_deg | in_rad


def _typed(readings: dict[str, float]) -> str:
    """What to type for a factor; a count of a gyroscope is less than a degree per second."""
    likely = {what: dps for what, dps in readings.items() if dps < 1} or readings
    return "units: raw, scale_dps: " + ", or ".join(
        f"{dps:.6g} if it is {what}" for what, dps in likely.items()
    )


def _contradict_scales(
    file: File, scale: float, scales: Sequence[tuple[str, dict[str, float]]]
) -> None:
    """Factors that are named and are not the scale; which reading of one is taken is said."""
    for where, readings in scales:
        if isclose(readings.get("deg/s a count", 0), 1, rel_tol=1e-3):
            continue
        same = [what for what, dps in readings.items() if isclose(dps, scale, rel_tol=1e-3)]
        if not same:
            text = f"{where}, but the scale is {scale:g} deg/s; give {_typed(readings)}"
            file.contradictions.append(text)
        elif sum(dps < 1 for dps in readings.values()) > 1:
            file.note("scale", f"{where}, which is taken for {same[0]}")
