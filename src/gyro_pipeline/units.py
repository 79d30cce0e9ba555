"""Units as headers and options spell them, read by pint with a small registry.

In pint's default registry a radian is dimensionless, so that 1/s would be an angular rate. Here
angles and the counts of an AD converter have dimensions, and g is the acceleration of gravity.
"""

import re
from functools import lru_cache
from typing import Any, NamedTuple

_DEFINITIONS = """
nano- = 1e-9 = n-
micro- = 1e-6 = u- = µ- = μ-
milli- = 1e-3 = m-
kilo- = 1e3 = k-
second = [time] = s = sec = secs
minute = 60 * second = min
hour = 60 * minute = h = hr
millis = 0.001 * second
micros = 0.000001 * second
degree = [angle] = deg = degs
radian = 57.29577951308232 * degree = rad = rads
arcsecond = degree / 3600 = arcsec
turn = 360 * degree = _ = revolution = rev = revs
degree_per_second = degree / second = dps = degps = deg_s = deg_per_s = deg_sec = deg_per_sec
radian_per_second = radian / second = radps = rad_s = rad_per_s = rad_sec = rad_per_sec
degree_per_hour = degree / hour = dph = deg_h = deg_per_h
turn_per_second = turn / second = rps
turn_per_minute = turn / minute = rpm
count = [count] = counts = lsb = LSB = digit = digits = raw
meter = [length] = m = metre
earth_gravity = 9.80665 * meter / second ** 2 = g
kelvin = [temperature] = K
celsius = kelvin; offset: 273.15 = C = degC = degc
fahrenheit = 5 / 9 * kelvin; offset: 459.67 * 5 / 9 = F = degF = degf
"""
_REFERENCES = {
    "rate": "degree_per_second",
    "angle": "degree",
    "time": "second",
    "acceleration": "earth_gravity",
    "temperature": "celsius",
    "count": "count",
}
"""The quantities, and the unit in which each is used here."""

_SPELLINGS = {"º": "°", "˚": "°", "℃": "°C", "℉": "°F", "°": "deg"}
_SPELLINGS |= {"·": "*", "⋅": "*", "⁻¹": "^-1", "⁻²": "^-2", "²": "^2"}
_TERM = r"[^\W\d_][^\W\d]*(?:\^?-?[1-3])?"
# words, products and quotients, but neither numbers nor powers: pint would evaluate 9**9**9
_EXPRESSION = re.compile(rf"(?=.{{1,40}}$)\(?{_TERM}(?:[/* ()]{{1,3}}{_TERM})*\)?")


class Unit(NamedTuple):
    """A unit: ``factor * value + offset`` is in deg/s, deg, s, g, °C or counts.

    Attributes:
        quantity: ``rate``, ``angle``, ``time``, ``acceleration``, ``temperature`` or ``count``.
        factor: As above.
        offset: As above; not 0 for temperatures only.
    """

    quantity: str
    factor: float = 1.0
    offset: float = 0.0


@lru_cache(1)
def _registry() -> tuple[Any, dict[Any, str]]:
    """The registry, and the quantity of each dimensionality."""
    import pint  # noqa: PLC0415  # it starts slowly, and few commands need it

    units: Any = pint.UnitRegistry(None)
    units.load_definitions(_DEFINITIONS.strip().splitlines())
    references = {units.Quantity(1, unit): quantity for quantity, unit in _REFERENCES.items()}
    return units, {unit.dimensionality: quantity for unit, quantity in references.items()}


@lru_cache(1 << 12)  # a folder's files have the same headers
def read_unit(text: str) -> Unit | None:
    """Read a unit such as ``deg/s``, ``rad s^-1``, ``°/sec``, ``mdps``, ``m/s²`` or ``degC``.

    Returns:
        The unit; None if it is unknown or of no supported quantity.
    """
    text = text.strip()
    for spelling, of_pint in _SPELLINGS.items():
        text = text.replace(spelling, of_pint)
    text = re.sub(r"\.(?=\s|$)", "", text)  # Deg. per s
    text = re.sub(r"(?<=[^\W\d])\.(?=[^\W\d])", "*", text)
    text = re.sub(r"(?<=[^\W\d])(?=-?[123]\b)", "^", text)  # rad s-1, m/s2
    return _parsed(text) or _parsed(text.lower())  # DPS, Deg/Sec, G


def _parsed(expression: str) -> Unit | None:
    if not _EXPRESSION.fullmatch(expression):
        return None
    units, quantities = _registry()
    try:
        unit = units.parse_units(expression)
        quantity = quantities[unit.dimensionality]
        zero, one = (units.Quantity(v, unit).to(_REFERENCES[quantity]).magnitude for v in (0, 1))
    except Exception:  # pint raises what its parser and Python's tokenizer do
        return None
    # conversions are rounded, and a degree per second is exactly one
    return Unit(quantity, float(f"{one - zero:.14g}"), float(f"{zero:.10g}"))
