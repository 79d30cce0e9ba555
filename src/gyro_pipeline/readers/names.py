"""What the name of a column says: a unit, a quantity, an axis."""

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

from gyro_pipeline.conventions import AXES, InputError
from gyro_pipeline.logs import KEPT, Finding
from gyro_pipeline.parameters import Column, ReaderOptions
from gyro_pipeline.readers.formats import Format
from gyro_pipeline.readers.table import IN_READER, Table
from gyro_pipeline.units import Unit, read_unit

RATE, ATTITUDE, OTHER = "rate", "attitude", "other"

_QUANTITIES = {
    OTHER: r"acc\w*|lin|linear|user|grav\w*|mag|magn\w*|compass|quat\w*|orientation|force|torque"
    r"|pos|position|dq|dv|velinc|oriinc|bias|offset|cov\w*|std|var\w*|sigma|err|error|min|max",
    RATE: r"gyr\w*|gy|omega\w*|angular\w*|angl?vel\w*|rates?",
    ATTITUDE: r"roll|pitch|yaw|heading|euler|phi|theta|psi|alpha|beta|gamma|angles?|attitude"
    r"|vel|velocity|speed",
}
"""Words of each quantity; of two in a name, the first decides: ``gyro_bias_x``, ``roll_rate``."""
_LETTERS = {"g": RATE, "w": RATE}
"""Of the letters that stand before an axis in names without any such word: ``gx``, but ``ax``."""

_BRACKETS = re.compile(r"\s*[(\[]((?:[^()\[\]]|[(\[][^()\[\]]*[)\]])*)[)\]]")
# neither gx (deg/s)*100 nor gx (deg/s) per sqrt Hz
_BEHIND = re.compile(r"(?!.*\b(?:per|times|in|over|sqrt|integrated|squared)\b)[a-zA-Z_ ]*")
_ARRAY = re.compile(r"\.[xyz]$", re.IGNORECASE)
_INDEX = re.compile(r"[\[.](\d+)\]?$")
_LONGEST = 200  # characters of a name that is looked into
_CLOCK_UNITS = {1.0, 1e-3, 1e-6, 1e-9, 60.0, 3600.0}
_AXES = [
    {axis: axis for axis in AXES},
    {"alpha": "z", "beta": "x", "gamma": "y"},  # W3C DeviceOrientation Event Specification, 2016
    {"roll": "x", "pitch": "y", "yaw": "z"},
]
"""Words for the axes."""


class Header(NamedTuple):
    """A name, its unit as written (an empty text: none), and what that is (None: not known)."""

    name: str
    said: str
    unit: Unit | None

    @property
    def quantity(self) -> str:
        """``rate``, ``attitude``, ``other``, or an empty text, by the words of the name."""
        words = [w.lower() for w in re.findall(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+", self.name)]
        stems = {*words, *(w[:-1] for w in words if w[-1] in AXES)}
        stems |= {w[1:] for w in words if w[0] in AXES}
        for quantity, pattern in _QUANTITIES.items():
            if any(re.fullmatch(pattern, stem) for stem in stems):
                return quantity
        letters = re.search(r"\b(a|ac|m|q|f|v|g|w) ?[xyz]\b", " ".join(words))
        return _LETTERS.get(letters[1], OTHER) if letters else ""

    def measures(self, *quantities: str) -> bool:
        """Whether its unit is of one of these quantities."""
        return self.unit is not None and self.unit.quantity in quantities

    @property
    def has_unit(self) -> bool:
        """Whether it has a unit, if an unknown one, rather than a remark in brackets."""
        return self.unit is not None or bool(re.search(r"[/^√*\d]", self.said))


def read_header(header: str) -> Header:
    """Part a header such as ``Gyro X (deg/s)``, ``w_x [rad s^-1]``, ``t/s``, ``gyro_dps.x``.

    A unit is in brackets, or behind a separator, or it is all of the header.
    """
    if len(header) > _LONGEST:
        return Header(header, "", None)
    array = match[0] if (match := _ARRAY.search(header)) else ""
    text = header.removesuffix(array)
    brackets = [m for m in _BRACKETS.finditer(text) if not re.fullmatch(r"\d*|[xyzXYZ]", m[1])]
    for match in sorted(reversed(brackets), key=lambda m: read_unit(m[1]) is None):
        before, behind = text[: match.start()], text[match.end() :]
        is_all = _BEHIND.fullmatch(_BRACKETS.sub("", behind))
        said = match[1].strip() if is_all else text[match.start() :].strip()
        return Header((before + behind).strip() + array, said, read_unit(said))
    for start, end in [(0, 0), *(m.span() for m in re.finditer(r"[ _./]+", text))]:
        unit = read_unit(text[end:])
        if unit and _stands_without_brackets(unit, text[end:], alone=end == 0):
            return Header(text[:start] + array, text[end:], unit)
    leading = re.match(r"[a-z]{5,}(?=_)", text)  # seconds_elapsed
    if leading and (first := Header(header, leading[0], read_unit(leading[0]))).measures("time"):
        return first
    return Header(header, "", None)


def _stands_without_brackets(unit: Unit, text: str, alone: bool) -> bool:
    """Whether it is a unit rather than a word that pint knows, such as ``a``, ``fs``, ``cal``."""
    if unit.quantity == "time":
        return unit.factor in _CLOCK_UNITS and (len(text) > 1 or text == "s")
    if unit.quantity == "temperature":
        return len(text) > 1
    return unit.quantity == "rate" or (not alone and unit.quantity != "other")


def triples(headers: Sequence[Header]) -> list[tuple[int, ...]]:
    """Numbers of columns (x, y, z) whose names differ in nothing but the axis.

    Axes are x, y, z, a browser's alpha, beta, gamma, roll, pitch, yaw, or [0], [1], [2].
    """
    groups: dict[str, dict[str, list[int]]] = {}
    for number, header in enumerate(headers):
        for stem, axis in _axes_in(header.name) if len(header.name) <= _LONGEST else ():
            groups.setdefault(stem, {}).setdefault(axis, []).append(number)
    return [
        triple
        for axes in groups.values()
        if set(axes) == set(AXES)  # an array of more than three has others
        for triple in zip(*(axes[axis] for axis in AXES), strict=False)
    ]


def _axes_in(name: str) -> Iterator[tuple[str, str]]:
    """Each way in which a name names an axis: the name without it, and the axis."""
    for kind, words in enumerate(_AXES):
        for match in re.finditer("|".join(words), name.lower()):
            yield f"{name[: match.start()]}*{kind}{name[match.end() :]}", words[match[0]]
    if index := _INDEX.search(name):
        number = int(index[1])
        yield f"{name[: index.start()]}[*]", AXES[number] if number < len(AXES) else index[1]


def samples_a_row(headers: Sequence[Header], columns: Sequence[int]) -> int:
    """How many samples a row holds: 8 of ``x[0]``, …, ``x[7]``, ``y[0]``, …; mostly 1."""
    names = {header.name for header in headers}
    counts = []
    for name in (headers[number].name for number in columns):
        match = _INDEX.search(name)
        if match is None or not name[: match.start()].lower().endswith(AXES):
            return 1
        stem, opened = name[: match.start()], match[0][0]
        closed = "]" if match[0].endswith("]") else ""
        counts.append(sum(f"{stem}{opened}{k}{closed}" in names for k in range(len(names))))
    return min(counts)


@dataclass(frozen=True)
class File:
    """A table, what its names say, the options and the format.

    What contradicts each other and what is worth a word is collected while it is looked at.
    """

    table: Table
    headers: Sequence[Header]
    options: ReaderOptions
    form: Format | None
    contradictions: list[str] = field(default_factory=list)
    findings: list[Finding] = field(default_factory=list)

    def listed(self, numbers: Sequence[int]) -> str:
        """Names of columns, for a message."""
        return ", ".join(repr(self.table.names[n] or f"column {n}") for n in numbers)

    def note(self, check: str, text: str) -> None:
        """Something to say, whatever comes of it."""
        self.findings.append(Finding(check, KEPT, text))

    def refusal(self, text: str) -> InputError:
        """An error that says where, and in which file to type what it asks for."""
        return InputError(f"{self.table.where}: {text} {IN_READER}")

    def find(self, column: Column) -> int:
        """Look up a column by its name, with or without its unit, or by its number from 0.

        Raises:
            InputError: There is no such column, or more than one.
        """
        names = self.table.names
        if isinstance(column, int):
            alike = [column] if column < len(names) else []
        else:
            exact = [number for number, name in enumerate(names) if name == column]
            alike = exact or [n for n, header in enumerate(self.headers) if header.name == column]
        if len(alike) > 1:
            raise self.refusal(
                f"expected one column {column!r}, got {len(alike)}, numbers {alike} (from 0): two "
                "sensors in one file? Give numbers in place of the name"
            )
        if not alike:
            raise self.refusal(
                f"expected a column {column!r}{' (from 0)' * isinstance(column, int)}, got "
                f"{len(names)} columns, {self.table.listed()}; correct it"
            )
        return alike[0]
