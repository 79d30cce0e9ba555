"""Temperature, acceleration and packet counter: kept beside the rates, never a reason to refuse."""

import re
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from gyro_pipeline.conventions import AXES
from gyro_pipeline.readers.formats import above_header, find_all
from gyro_pipeline.readers.names import OTHER, File, Header, triples
from gyro_pipeline.readers.table import Table
from gyro_pipeline.units import Unit, read_unit

_LETTERS = {
    "c": Unit("temperature"),
    "f": Unit("temperature", 5 / 9, -160 / 9),
    "k": Unit("temperature", 1.0, -273.15),
}
_OF_WHAT = "gyro imu sensor board chip die mcu cpu ambient case out".split()


class Beside(NamedTuple):
    """Numbers of columns, and their unit."""

    columns: Sequence[int] = ()
    unit: Unit = Unit("other")

    def read(self, table: Table, keep: NDArray[np.bool_]) -> NDArray[np.float64] | None:
        """Values (n, k) in °C or g of the rows that are kept; None where they cannot be had."""
        columns = [table.columns[number] for number in self.columns]
        if not columns or any(c.dtype.kind != "f" or len(c) != len(keep) for c in columns):
            return None
        values = np.stack(columns, axis=1)[keep] * self.unit.factor + self.unit.offset
        return values if np.isfinite(values).any() else None


def temperature_of(file: File) -> Beside:
    """The column of the options, or the only one that is named so; of several those with a unit."""
    if file.options.temperature_column is not None:
        number = file.find(file.options.temperature_column)
        return Beside([number], named_celsius(file.headers[number])[1] or _LETTERS["c"])
    named = {n: unit for n, h in enumerate(file.headers) for yes, unit in [named_celsius(h)] if yes}
    told = {n: unit for n, unit in named.items() if unit} or named
    if len(told) > 1:
        names = file.listed(list(told))
        file.note("temperature", f"none of {names} is kept; name one by temperature_column")
        return Beside()
    for number, unit in told.items():
        if unit is None:
            name = file.table.names[number]
            file.note("temperature", f"{name!r} has no unit and is taken for degrees Celsius")
        return Beside([number], unit or _LETTERS["c"])
    return Beside()


def named_celsius(header: Header) -> tuple[bool, Unit | None]:
    """Whether a header names a temperature, and its unit if it says one."""
    words = [word.lower() for word in re.findall(r"[A-Z]?[a-z]+|[A-Z]+(?![a-z])", header.name)]
    letter = words.pop() if len(words) > 1 and words[-1] in _LETTERS else ""
    while words and words[-1] in _OF_WHAT:
        words.pop()
    named = bool(words) and words[-1] in ("temp", "temperature", "t")
    if header.measures("temperature"):
        return named or len(header.said) > 1, header.unit
    if header.said:
        unit = _LETTERS.get(header.said.lower())
        return named and unit is not None, unit
    # temp_c, but temp_f may be a filtered one
    return named and (letter == "c" or (not letter and words[-1] != "t")), _LETTERS.get(letter)


def acceleration_of(file: File, rates: Sequence[int]) -> Beside:
    """The columns of the options, the format's, or the only three that are named so."""
    options, form = file.options, file.form
    unit = read_unit(options.acceleration_units) if options.acceleration_units else None
    columns: Sequence[int] = ()
    if options.acceleration_columns:
        columns = [file.find(column) for column in options.acceleration_columns]
    elif form and form.acceleration:
        names, by_format = form.acceleration
        columns = [number for name in names for number in find_all(file.table, name)]
        factor = above_header(file.table.preamble, form.acceleration_scale)
        unit = unit or ((u := read_unit(by_format)) and u._replace(factor=u.factor * factor))
    else:
        named = [t for t in triples(file.headers) if _accelerates(file.headers[t[0]])]
        columns = named[0] if len(named) == 1 else ()
    if len(columns) != len(AXES) or {*columns} & {*rates}:
        return Beside()
    said = file.headers[columns[0]].said
    by_header = [u for u in map(read_unit, (said, said.lower())) if u]  # G is a gauss to pint
    unit = unit or next((u for u in by_header if u.quantity == "acceleration"), None)
    if unit is None:
        text = f"{file.listed(columns)} have no unit and are not kept; give acceleration_units"
        file.note("acceleration", text)
        return Beside()
    return Beside(columns, unit)


def _accelerates(header: Header) -> bool:
    """Whether it names what an accelerometer measures, gravity included."""
    name = header.name.lower()
    named = re.search(r"acc|^a[ _.]?[xyz]$", name) and header.quantity == OTHER
    return bool(named) and not re.search(r"lin|user|free|gyr|ang|cov|bias|offset|std|norm", name)


def counter_of(file: File) -> tuple[int, int] | None:
    """Number and bits of a packet counter."""
    options, by_format = file.options, file.form.counter if file.form else None
    if options.counter_column is not None:
        return file.find(options.counter_column), options.counter_bits or 16
    if by_format and (numbers := find_all(file.table, by_format[0])):
        return numbers[0], options.counter_bits or by_format[1]
    return None
