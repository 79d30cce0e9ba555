"""What one unit of the rates is, in deg/s.

The header, the lines above it, the format and the options may say so; those that say it must agree.
"""

import re
from collections.abc import Sequence
from math import isclose

from gyro_pipeline.readers.formats import above_header, find_all
from gyro_pipeline.readers.names import File, read_header
from gyro_pipeline.units import Unit, read_unit

RATE_UNITS = "deg/s, rad/s, mdps, deg/h, … or raw (with scale_dps)"

_RAD_PER_S_DPS = 57.29577951308232
_SCALE = re.compile(
    r"(?im)^\W*((?:g|gyro\w*)[ _]?(?:scale|sensitivity)(?:[ _]?factor)?|scale[ _]?factor|scale)"
    r"\W+([-+]?[\d.]+(?:e[-+]?\d+)?)"
)

Stated = tuple[str, Unit]
"""A unit as written, and what it is."""


def scale_of(file: File, rates: Sequence[int]) -> tuple[float, bool]:
    """deg/s, or degrees of increments, in one unit of the rates; and whether they are counts.

    Raises:
        InputError: Nobody says the unit, or the scale of raw counts.
    """
    asked, header = _asked(file), _of_header(file, rates)
    above = _above(file.table.preamble)
    lines = f"lines above the header {' and '.join(above)}"
    if above and header and not any(_same(header[1], unit) for unit in above.values()):
        file.contradictions.append(f"the header says {header[0]}, but {lines}; give units")
    stated = header or (next(iter(above.items())) if len(above) == 1 else None)
    by_format = _of_format(file, rates)
    if by_format and not header:
        if stated and not _same(stated[1], by_format[1]):
            file.contradictions.append(f"the format has {by_format[0]}, but {lines}; give units")
        elif not stated and not asked:
            file.note("unit", f"{by_format[0]}, by the format; the file does not say")
        stated = by_format
    if asked and stated and not _same(asked[1], stated[1]):
        file.contradictions.append(
            f"the file says {stated[0]}, {file.listed(rates)}, but units of the options are "
            f"{asked[0]}; correct units"
        )
    unit = asked or stated
    names = file.listed(rates)
    if unit is None:
        raise file.refusal(f"expected a unit of the rates, got {names}; give units: {RATE_UNITS}")
    raw = unit[1].quantity == "count"
    if raw and unit[1].factor == 1 and file.options.scale_dps is None:
        text = f"{names} are raw counts: give units: raw and scale_dps, deg/s a count,"
        raise file.refusal(text)
    if stated != by_format:
        _contradict_scale_above(file, unit[1].factor)
    return unit[1].factor, raw


def _asked(file: File) -> Stated | None:
    units, scale_dps = file.options.units, file.options.scale_dps
    if scale_dps is not None:
        return f"raw, of {scale_dps:g} deg/s", Unit("count", scale_dps)
    return (units, read_unit(units) or Unit("rate")) if units else None


def _of_format(file: File, rates: Sequence[int]) -> Stated | None:
    """The format's unit, of its own columns; counts, where a line above gives their scale."""
    form = file.form
    if form is None or {*rates} != {find_all(file.table, name)[0] for name in form.rates}:
        return None
    factor = (read_unit(form.units) or Unit("rate")).factor
    if not form.scale:
        return form.units, Unit("rate", factor)
    scale = above_header(file.table.preamble, form.scale)
    return f"counts of {scale:g} {form.units}", Unit("count", factor * scale)


def _same(one: Unit, other: Unit) -> bool:
    """Whether two units agree; a header that says counts says nothing of their size."""
    of_any_size = one.quantity == "count" and 1 in (one.factor, other.factor)
    alike = isclose(one.factor, other.factor, rel_tol=1e-6)
    return one.quantity == other.quantity and (of_any_size or alike)


def _of_header(file: File, rates: Sequence[int]) -> Stated | None:
    """The header's unit; a unit of anything but a rate contradicts that they are rates."""
    headers = [file.headers[number] for number in rates]
    names = file.listed(rates)
    inner = [read_header(header.name) for header in headers]  # gx_dps (rad/s)
    units = {h.unit for h in headers} | {h.unit for h in inner if h.measures("rate")}
    if len(units) > 1:
        text = f"expected one unit of all rates, got {names}"
        if not file.options.units:
            raise file.refusal(f"{text}; correct the header, or give units and trust: options")
        file.contradictions.append(f"{text}; correct the header")
    first, increments = headers[0], file.options.increments
    if first.unit and first.measures(*(("angle",) if increments else ("rate", "count"))):
        return first.said, first.unit
    if first.has_unit:
        kind = "angle turned" if increments else "angular rate"
        hint = "give increments: true if they are angles turned since the last row"
        what = hint if first.measures("angle") else "give columns of angular rates"
        file.contradictions.append(f"{names} say {first.said!r}, but that is no {kind}; {what}")
    elif first.said and {header.said for header in headers} == {first.said}:
        file.note("unit", f"the remark {first.said!r} in the header is no unit that is known")
    return None


def _above(preamble: str) -> dict[str, Unit]:
    """Units of angular rate that lines above the header name; not that of a range of 250 dps."""
    words = re.findall(r"[^\s,;:=()\[\]\"'#%]+", preamble)
    found: dict[str, Unit] = {}
    for at, word in enumerate(words):
        if at and re.fullmatch(r"[-+±]*[\d.]+", words[at - 1]):
            continue
        for text in (" ".join(words[at : at + count]) for count in (3, 2, 1)):
            spelled = re.search(r"/|per|[drs]ps|rpm|-1|⁻¹", text.lower()) or word == "LSB"
            unit = read_unit(text) if spelled else None
            if unit and unit.quantity in ("rate", "count"):
                if not any(_same(unit, other) for other in found.values()):
                    found[text] = unit
                break
    return found


def _contradict_scale_above(file: File, scale: float) -> None:
    """A factor on the rates in the lines above the header that is not the scale."""
    match = _SCALE.search(file.table.preamble)
    factor = float(match[2]) if match else 1.0
    readings = (1.0, scale, 1 / scale, scale / _RAD_PER_S_DPS)
    if match and factor and not any(isclose(factor, other, rel_tol=1e-3) for other in readings):
        file.contradictions.append(
            f"a line above the header says {match[1]} {match[2]}, but the scale is {scale:g} "
            "deg/s; give units: raw and scale_dps"
        )
