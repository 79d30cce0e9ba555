"""Temperature and acceleration: kept beside the rates, never a reason to refuse."""

import re
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from gyro_pipeline.conventions import AXES
from gyro_pipeline.readers.file import File
from gyro_pipeline.readers.formats import find_all
from gyro_pipeline.readers.names import OTHER, triples
from gyro_pipeline.units import Unit, read_unit

_TEMPERATURE = re.compile(r"(?i)(temp|temperature)([_ ]?c|[_ ](gyro|imu|sensor|board|chip|cpu))?$")
_ACCELERATION = re.compile(r"(?i)^(?!.*(lin|user|free|gyr|ang|std|norm)).*(acc|^a[ _.]?[xyz]$)")

Beside = tuple[Sequence[int], Unit]
"""Numbers of columns, none where they are not known, and their unit."""


def read_beside(file: File, beside: Beside, keep: NDArray[np.bool_]) -> NDArray[np.float64] | None:
    """Values (n, k) in °C or g of the rows that are kept; None where they cannot be had."""
    numbers, unit = beside
    columns = [file.table.columns[number] for number in numbers]
    if not columns or any(c.dtype.kind != "f" or len(c) != len(keep) for c in columns):
        return None
    values = np.array(columns).T
    values *= unit.factor
    values += unit.offset
    values = values if keep.all() else values[keep]
    return values if np.isfinite(values).any() else None


def temperature_of(file: File) -> Beside:
    """The column of the options, or the only one that is named so, or has such a unit."""
    celsius = Unit("temperature")
    named = [n for n, h in enumerate(file.headers) if _TEMPERATURE.search(h.name)]
    measured = [n for n, h in enumerate(file.headers) if h.measures("temperature")]
    measured = [n for n in measured if n in named or file.headers[n].unit_text != "K"]  # gain [K]
    numbers = measured or [n for n in named if not file.headers[n].unit_text]
    if file.options.temperature_column is not None:
        numbers = [file.find(file.options.temperature_column)]
    elif len(numbers) > 1:
        text = f"none of {file.listed(numbers)} is kept; name one by temperature_column"
        file.note("temperature", text)
        return (), celsius
    elif numbers and not measured:
        text = f"{file.listed(numbers)} has no unit and is taken for degrees Celsius"
        file.note("temperature", text)
    unit = file.headers[numbers[0]].unit if numbers else None
    return numbers, unit if unit and unit.quantity == "temperature" else celsius


def acceleration_of(file: File, rates: Sequence[int]) -> Beside:
    """The columns of the options, the format's, or the only three that are named so."""
    options, form = file.options, file.form
    numbers = [file.find(column) for column in options.acceleration_columns or ()]
    units = options.acceleration_units
    if form and not numbers:
        numbers = find_all(file.table, *form.acceleration.split())
        units = units or form.acceleration_units
    if not numbers:
        headers = file.headers
        named = [t for t in triples(headers) if _ACCELERATION.search(headers[t[0]].name)]
        named = [t for t in named if headers[t[0]].quantity == OTHER]
        numbers = list(named[0]) if len(named) == 1 else []
    if len(numbers) != len(AXES) or {*numbers} & {*rates}:
        return (), Unit("acceleration")
    unit = read_unit(units or file.headers[numbers[0]].unit_text)
    if unit and unit.quantity == "acceleration":
        return numbers, unit
    text = f"{file.listed(numbers)} have no unit and are not kept; give acceleration_units"
    file.note("acceleration", text)
    return (), Unit("acceleration")
