"""Column headers: names and units."""

import re
from collections.abc import Sequence
from functools import lru_cache
from itertools import product
from math import pi

from gyro_pipeline.conventions import AXES, MDPS, InputError
from gyro_pipeline.parameters import Column

DEG_PER_S = {
    "deg/s": 1.0,
    "rad/s": 180 / pi,
    "mdps": MDPS,
    "mrad/s": 0.18 / pi,
    "deg/h": 1 / 3600,
}
"""deg/s in one of each unit of angular rate but raw counts."""

SECONDS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
"""Seconds in one of each unit of time."""

_SPELLINGS = {  # as `_written` has them
    "deg/s": "deg/s dps degps °/s deg/sec deg/second degree/s degrees/s degrees/sec degree/second "
    "degrees/second deg_s",
    "rad/s": "rad/s radps rad/sec rad/second radian/s radians/s radians/sec radian/second "
    "radians/second rad_s",
    "mdps": "mdps mdeg/s m°/s mdeg/sec mdeg_s",
    "mrad/s": "mrad/s mradps mrad/sec mrad_s",
    "deg/h": "deg/h dph °/h deg/hr deg/hour degree/hour degrees/h degrees/hour deg_h",
    "raw": "raw lsb count counts",
    "s": "s sec secs second seconds",
    "ms": "ms msec millis millisecond milliseconds",
    "us": "us µs μs usec micros microsecond microseconds",  # two different signs for micro
    "ns": "ns nsec nanosecond nanoseconds",
}
RATE_UNITS = {text: unit for unit in (*DEG_PER_S, "raw") for text in _SPELLINGS[unit].split()}
TIME_UNITS = {text: unit for unit in SECONDS for text in _SPELLINGS[unit].split()}
UNITS = (*RATE_UNITS, *TIME_UNITS)
"""All spellings."""

CELSIUS = {
    **dict.fromkeys(("degc", "°c", "celsius", "c"), (1.0, 0.0)),
    **dict.fromkeys(("degf", "°f", "fahrenheit", "f"), (5 / 9, -160 / 9)),
    **dict.fromkeys(("degk", "kelvin", "k"), (1.0, -273.15)),
}
"""By the spelling of a unit of temperature: degrees Celsius are a times a value, plus b."""

_BRACKETED = re.compile(r"\s*[(\[]([^()\[\]]*)[)\]]")
# neither t (s) *1000 nor gx (deg/s) per sqrt Hz
_BEHIND = re.compile(r"[ _](?!.*\b(?:per|times|in|over|sqrt|integrated|squared)\b)[a-zA-Z_ ]+")
_AXIS = re.compile(r"\.[xyz]$")  # of an array of three columns
_SEPARATOR = re.compile(r"[ _./]+")
_TIMES = re.compile(r"[\s^*·⋅.]")
_EACH = re.compile(r"(?<=.)(?:per(s|sec|second|h|hr|hour)|(s|sec|h|hr)-1)$")
_SIGNS = str.maketrans({"º": "°", "˚": "°", "℃": "°c", "℉": "°f"})
_WORDS = re.compile(r"[\s,;:=()\[\]\"'#%]+")
_LONGEST = 3  # words of a unit, such as "rad per s"


@lru_cache(1 << 12)  # a folder's files have the same headers
def split_unit(header: str, spellings: tuple[str, ...]) -> tuple[str, str | None]:
    """Part a header into its name and its unit as written.

    Args:
        header: Such as ``Gyroscope X (deg/s)``, ``w_x [rad s^-1]``, ``t/s``, ``gx_dps`` or ``w_x``.
        spellings: Units to look for where there are no brackets.

    Returns:
        The name, and what is in brackets at the end, else a spelling in brackets, or behind a
        space, dot, underscore or slash, or all of it, in lower case, without spaces and with a
        slash; None if there is none.
    """
    axis = match[0] if (match := _AXIS.search(header)) else ""
    text = header.removesuffix(axis)
    for found in reversed(list(_BRACKETED.finditer(text))):
        unit, before, behind = (
            _written(found[1]),
            text[: found.start()],
            text[found.end() :].rstrip(),
        )
        within = sum(map(before.count, "([")) > sum(map(before.count, ")]"))  # gx [LSB/(deg/s)]
        if not within and (not behind or (unit in spellings and _BEHIND.fullmatch(behind))):
            return before + behind + axis, unit
    for name, start in [(0, 0), *(one.span() for one in _SEPARATOR.finditer(text))]:
        if (unit := _written(text[start:])) in spellings:
            return text[:name] + axis, unit
    return header, None


def _written(unit: str) -> str:
    """A unit as it is spelled here: ``deg/s`` of ``deg·s⁻¹``, ``Deg. per s`` or ``deg s^-1``."""
    text = unit.lower().translate(_SIGNS).replace("⁻¹", "-1")
    return _EACH.sub(r"/\1\2", _TIMES.sub("", text))


def rate_units_in(text: str) -> set[str]:
    """Units of angular rate that a text names; of raw counts LSB, for others are common words."""
    words = _WORDS.split(text)
    parts = (
        _written(" ".join(words[at : at + count]))
        for count in range(1, _LONGEST + 1)
        for at in range(len(words) - count + 1)
    )
    found = {part for part in parts if part in RATE_UNITS}
    return {RATE_UNITS[part] for part in found if RATE_UNITS[part] != "raw" or part == "lsb"}


def rate_unit(header: str) -> str | None:
    """Unit of an angular rate as its header has it; None if it says none or an unknown one."""
    said = split_unit(header, UNITS)[1] or ""
    return "raw" if said.endswith("/lsb") else RATE_UNITS.get(said)


def find(names: Sequence[str], column: Column, where: str) -> int:
    """Look up a column by its name, with or without the unit behind it, or by its number.

    Args:
        names: The header.
        column: Name or number, from 0.
        where: For messages.

    Raises:
        InputError: There is no such column, or more than one.
    """
    if isinstance(column, int):
        if column < len(names):
            return column
        raise InputError(f"{where}: expected a column {column} (from 0), got {len(names)} columns")
    found = matching(names, column)
    if len(found) == 1:
        return found[0]
    if found:
        raise InputError(
            f"{where}: expected one column {column!r}, got {len(found)}, numbers "
            f"{', '.join(map(str, found))} (from 0): two sensors in one file? Give the columns' "
            "numbers"
        )
    raise InputError(
        f"{where}: expected a column {column!r}, got {listed(names)}; correct the name, or give "
        "columns of the options"
    )


def matching(names: Sequence[str], column: str) -> list[int]:
    """Numbers of the columns with a name, as a whole or else without the unit behind it."""
    exact = [number for number, name in enumerate(names) if name == column]
    return exact or [n for n, name in enumerate(names) if split_unit(name, UNITS)[0] == column]


def axes(names: Sequence[str]) -> list[int] | None:
    """Numbers of the only three columns whose names differ but in the letters x, y, z, in order."""
    alike: dict[tuple[str, str], dict[str, list[int]]] = {}
    for number, name in enumerate(names):
        for at, letter in enumerate(name.lower()):
            if letter in AXES:
                others = alike.setdefault((name[:at], name[at + 1 :]), {})
                others.setdefault(letter, []).append(number)
    found = {
        triple
        for one in alike.values()
        if len(one) == len(AXES)
        for triple in product(*(one[axis] for axis in AXES))
    }
    return list(found.pop()) if len(found) == 1 else None


def listed(names: Sequence[str]) -> str:
    """Names for a message, the first thirty of them."""
    shown = ", ".join(repr(name[:40]) for name in names[:30])
    return (shown + (", …" if len(names) > 30 else "")) if names else "no header"  # noqa: PLR2004
