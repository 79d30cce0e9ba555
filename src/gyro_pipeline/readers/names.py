"""Reads units, quantities and axes from the names of columns."""

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache

from gyro_pipeline.conventions import AXES
from gyro_pipeline.units import Unit, read_unit

OTHER, RATE, ATTITUDE, ACCELERATION = "other", "rate", "attitude", "acceleration"

# the first entry that matches a word of the name decides: gyro_bias_x, yaw_rate, ax
_QUANTITIES = [
    (OTHER, r"d[qv]|velinc|oriinc|bias|offset|std|norm|sigma|err(or)?|min|max"),
    (OTHER, r"[xyz]?(lin|user|free|grav|mag|compass|quat|orient|force|torque|pos|cov|var)\w*"),
    (ACCELERATION, r"[xyz]?acc\w*"),
    (RATE, r"[xyz]?gyr\w*|gy|omega\w*|ang\w* ?vel\w*|angular|rates?"),
    (ATTITUDE, r"roll|pitch|yaw|heading|euler|phi|theta|psi|alpha|beta|gamma"),
    (ATTITUDE, r"angles?|attitude|vel\w*|speed"),
    (RATE, r"[gw] ?[xyz]"),
    (ACCELERATION, r"a ?[xyz]"),
    (OTHER, r"(ac|m|q|f|v) ?[xyz]"),
]
_AXIS_WORDS = [
    {axis: axis for axis in AXES},
    {"alpha": "z", "beta": "x", "gamma": "y"},  # W3C DeviceOrientation Event Specification, 2016
    {"roll": "x", "pitch": "y", "yaw": "z"},
    {"p": "x", "q": "y", "r": "z"},
]
_BRACKETS = re.compile(r"\s*[(\[]((?:[^()\[\]]|[(\[][^()\[\]]*[)\]])*)[)\]]")
_AFTER_UNIT = re.compile(r"(?i)[\W_]*([xyz]|[xyz][\W_]?axis|cal|raw|since .*)?[\W_]*")
INDEX = re.compile(r"[\[.](\d+)\]?$")
_TIME = re.compile(
    r"time|stamp|elapsed|epoch?|clock|date|utc|unix|tick|second|milli|micro|nano|^d?ts?$|^$"
)
_DURATION = re.compile(
    r"loop|exposure|response|integration|latency|duration|lag|age\b|offset|valid|zone|out\b|temp"
)
_LONGEST = 200  # characters of a name that is parsed


@dataclass(frozen=True, eq=False)
class Header:
    """A name, the text of its unit (empty without a unit), and the unit (None if unknown)."""

    name: str
    unit_text: str = ""
    unit: Unit | None = None

    @cached_property
    def quantity(self) -> str:
        """``rate``, ``attitude``, ``acceleration``, ``other``, or an empty text, by the name."""
        words = re.findall(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+", self.name.replace("ω", "omega"))
        text = " ".join(words).lower()
        return next((name for name, word in _QUANTITIES if re.search(rf"\b({word})\b", text)), "")

    def measures(self, *quantities: str) -> bool:
        """Whether the unit is of one of these quantities."""
        return self.unit is not None and self.unit.quantity in quantities

    @cached_property
    def names_time(self) -> bool:
        """Whether the name is that of a column of times."""
        allowed = _TIME.search(self.name.lower()) and not self.names_duration
        return bool(allowed and (self.name or self.measures("time")))

    @cached_property
    def names_duration(self) -> bool:
        """Whether the name is that of a duration, which is also measured in seconds."""
        return bool(_DURATION.search(self.name.lower()))


@lru_cache(64)  # the files of a folder have the same header
def read_headers(names: tuple[str, ...]) -> tuple[Header, ...]:
    """The headers of all columns."""
    return tuple(map(read_header, names))


def read_header(text: str) -> Header:
    """Parse a header such as ``Gyro X (deg/s)``, ``w_x [rad s^-1]``, ``t/s``, ``gyro_dps.x``.

    A unit is in brackets, after a separator, or the whole header.
    """
    if len(text) > _LONGEST:
        return Header(text)
    array = match[0] if (match := re.search(r"\.[xyzXYZ]$", text)) else ""
    text = text.removesuffix(array)
    matches = [m for m in _BRACKETS.finditer(text) if not re.fullmatch(r"\d*|[xyzXYZ]", m[1])]
    if matches:
        brackets = [_in_brackets(text, match) for match in matches]
        last = next((h for h in reversed(brackets) if h.unit), brackets[-1])
        return replace(last, name=last.name + array)
    for start, end in [(0, 0), *(m.span() for m in re.finditer(r"[ _./]+", text))]:
        unit = read_unit(text[end:])
        if unit and _is_unit_without_brackets(unit, text[end:], alone=end == 0):
            return Header(text[:start] + array, text[end:], unit)
    first = re.match(r"[a-z]{5,}(?=_)", text)  # seconds_elapsed
    if first and (header := Header(text, first[0], read_unit(first[0]))).measures("time"):
        return header
    return Header(text + array)


def _in_brackets(text: str, match: re.Match[str]) -> Header:
    """A header with a unit in brackets, and the text after them if it may modify the unit."""
    before, after = text[: match.start()], text[match.end() :]
    is_complete = _AFTER_UNIT.fullmatch(_BRACKETS.sub("", after))  # not gx (deg/s)*100
    unit_text = match[1].strip() if is_complete else text[match.start() :].strip()
    return Header((before + after).strip(), unit_text, read_unit(unit_text))


def _is_unit_without_brackets(unit: Unit, text: str, alone: bool) -> bool:
    """Whether a text without brackets is a unit rather than a word or the letter of an axis."""
    if len(text) == 1 and text not in "sSgG":
        return False
    return not alone or unit.quantity in ("rate", "time", "temperature")


@lru_cache(64)
def triples(headers: tuple[Header, ...]) -> list[tuple[int, ...]]:
    """Numbers of columns (x, y, z) whose names differ only in the axis.

    Axes are x, y, z, a browser's alpha, beta, gamma, roll, pitch, yaw, p, q, r, or numbers at the
    end of a name, from 0 or from 1.
    """
    groups: dict[str, dict[str, list[int]]] = {}
    for number, header in enumerate(headers):
        for stem, axis in _axes_in(header.name[:_LONGEST]):
            groups.setdefault(stem, {}).setdefault(axis, []).append(number)
    return [
        triple
        for axes in groups.values()
        if set(axes) == set(AXES)  # an array of more than three columns has other axes
        for triple in zip(*(axes[axis] for axis in AXES), strict=False)
    ]


def _axes_in(name: str) -> Iterator[tuple[str, str]]:
    """All readings of a name as one with an axis: the name without the axis, and the axis."""
    for kind, words in enumerate(_AXIS_WORDS):
        for match in re.finditer("|".join(words), name.lower()):
            yield f"{name[: match.start()]}*{kind}{name[match.end() :]}", words[match[0]]
    if number := re.search(r"(?<=\D)(\d+)\]?$", name):
        for first in (0, 1):
            axes = {str(first + n): axis for n, axis in enumerate(AXES)}
            yield f"{name[: number.start()]}[{first}…]", axes.get(number[1], number[1])


def is_quaternion(headers: tuple[Header, ...], triple: Sequence[int]) -> bool:
    """Whether columns x, y, z without a unit of rates belong to a quaternion with a column w."""
    first, names = headers[triple[0]], {header.name.lower() for header in headers}
    name = first.name.lower()
    w_names = {f"{name[: x.start()]}w{name[x.end() :]}" for x in re.finditer("x", name)}
    return bool(w_names & names) and not first.measures("rate")
