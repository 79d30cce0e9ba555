"""Finds the columns of the rates, the temperature and the acceleration in a table.

A column is a rate only if its name and unit, or the options, say so. Names, headers, the lines
above them, the format and the options must agree. If two of them contradict each other, the file is
refused with a message that names both, unless ``trust: options`` decides for the options; then a
finding says what they overruled.
"""

import re
from collections.abc import Sequence

from gyro_pipeline.conventions import AXES, InputError
from gyro_pipeline.parameters import Column
from gyro_pipeline.readers.file import File
from gyro_pipeline.readers.formats import find_all
from gyro_pipeline.readers.names import (
    ACCELERATION,
    ATTITUDE,
    INDEX,
    RATE,
    Header,
    is_quaternion,
    triples,
)
from gyro_pipeline.readers.scales import RATE_UNITS
from gyro_pipeline.units import Unit, read_unit

Columns = Sequence[int]

Auxiliary = tuple[Columns, Unit]
"""Numbers of the columns of another quantity, empty if unknown, and their unit."""

_NOTES = {
    "motionRotationRate|gyroADC|unbiased|debias|bias_?(free|corrected|removed)|"
    "(?<!un)calibrated(?=[_ ]|$)": "{!r}: by its name a rate from which a bias was subtracted, as "
    "by Core Motion (CMDeviceMotion.rotationRate), and by Betaflight at power-on",
    "alpha|beta|gamma": "{!r}: a browser's alpha is taken for the rate about z, beta x, gamma y "
    "(W3C, 2016); some browsers number them from x",
}
"""Notes on rates by a regular expression for their names."""

_TEMPERATURE = re.compile(r"(?i)(temp|temperature)([_ ]?c|[_ ](gyro|imu|sensor|board|chip|cpu))?$")


def rate_columns(file: File, imu: int | None = None) -> Columns:
    """Numbers of the columns of the rates about x, y, z.

    Args:
        file: The table and the options.
        imu: Number of the IMU, if the options name the columns of several.

    Raises:
        InputError: No columns, or several groups of columns, may be the rates.
    """
    columns = file.options.columns
    if isinstance(columns, dict):
        if imu not in columns:
            imus = ", ".join(map(str, columns))
            raise file.refusal(
                f"columns: expected IMU {imu}, got those of IMUs {imus}; correct them"
            )
        columns = columns[imu]
    rates = _by_options(file, columns) if columns else _by_name(file)
    for words, text in _NOTES.items():
        if re.search(words, file.table.names[rates[0]], re.IGNORECASE):
            file.note("rates", text.format(file.table.names[rates[0]]))
    return rates


def _by_options(file: File, columns: Sequence[Column]) -> Columns:
    """The columns of the options, compared with the axes, samples and quantity of their names."""
    rates, headers = [file.find(column) for column in columns], file.headers
    if len(set(rates)) < len(AXES):
        raise file.refusal(f"expected three columns of rates, got {list(columns)}; correct columns")
    intro = f"columns of the options are {file.listed(rates)}, but"
    overlapping = [triple for triple in triples(headers) if {*triple} & {*rates}]
    permuted = [triple for triple in overlapping if {*triple} == {*rates}]
    if overlapping and tuple(rates) not in permuted:
        belong = f"{file.listed((permuted or overlapping)[0])} belong together in this order"
        file.add_contradiction(f"{intro} by their names {belong}; give these, or no columns")
    arrays = [INDEX.sub("", header.name) for header in headers]
    samples = min(arrays.count(arrays[number]) for number in rates)
    if samples > 1 and len({arrays[number] for number in rates}) == len(AXES):
        text = f"a row holds {samples} samples; write a row for each sample"
        file.add_contradiction(f"{intro} {text}")
    others = [number for number in rates if not _may_be_rate(file, headers[number])]
    if others or is_quaternion(headers, rates):
        kind = "no angular rate" if others else "of a quaternion"
        text = f"{file.listed(others or rates)} is by name {kind}; give columns of angular rates"
        file.add_contradiction(f"{intro} {text}")
    return rates


def _may_be_rate(file: File, header: Header) -> bool:
    """Whether a name allows a rate; a name of an angle does with increments or a unit of rates."""
    angle_turned = file.options.increments or header.measures("rate")
    return header.quantity in ("", RATE) or (header.quantity == ATTITUDE and angle_turned)


def _by_name(file: File) -> Columns:
    """The only three columns that are rates about x, y, z by their names."""
    if file.form:
        return find_all(file.table, *file.form.rates.split())
    measured = "angle" if file.options.increments else "rate"
    certain, possible = list[Columns](), list[Columns]()
    for triple in triples(file.headers):
        header = file.headers[triple[0]]
        if header.quantity == RATE or (header.quantity == "" and header.measures(measured)):
            certain.append(triple)
        elif header.quantity == "" and not header.name[-1:].isdigit():
            possible.append(triple)
    if not any(file.table.names) and len(file.table.names) == len(AXES):
        possible.append((0, 1, 2))
    if len(certain) == 1:
        return certain[0]
    if certain or len(possible) != 1:
        raise _refusal_of(file, certain or possible)
    names = file.listed(possible[0])
    if is_quaternion(file.headers, possible[0]):
        raise file.refusal(f"{names} are by name of a quaternion; give columns")
    if not file.options.units:
        raise file.refusal(
            f"{names} do not say what they measure, got {file.table.listed()}; if they are angular "
            f"rates, give units: {RATE_UNITS}"
        )
    file.note("rates", f"only the option units says that {names} are rates")
    return possible[0]


def _refusal_of(file: File, candidates: Sequence[Columns]) -> InputError:
    """An error about columns of several sensors or samples, or about missing columns."""
    if candidates:
        first, second = map(list, candidates[:2])
        return file.refusal(
            f"expected one sensor and one sample per row, got {len(candidates)}, such as "
            f"{file.listed(first)} and {file.listed(second)}; if they are samples, write a row for "
            f"each; if they are sensors, give columns of the one to read, such as {first}, or of "
            f"both as IMUs, {{1: {first}, 2: {second}}},"
        )
    return file.refusal(
        "expected three columns of angular rate about x, y, z that say so by name or unit, got "
        f"{file.table.listed()}; give columns, such as [gx, gy, gz], and units"
    )


def temperature_of(file: File) -> Auxiliary:
    """The column of the options, or the only one with a name or unit of temperature."""
    celsius, headers = Unit("temperature"), file.headers
    by_name = [n for n, header in enumerate(headers) if _TEMPERATURE.search(header.name)]
    by_unit = [n for n, header in enumerate(headers) if header.measures("temperature")]
    by_unit = [n for n in by_unit if n in by_name or headers[n].unit_text != "K"]  # gain [K]
    numbers = by_unit or [n for n in by_name if not headers[n].unit_text]
    if file.options.temperature_column is not None:
        numbers = [file.find(file.options.temperature_column)]
    if len(numbers) != 1:
        if numbers:
            text = f"none of {file.listed(numbers)} is kept; name one by temperature_column"
            file.note("temperature", text)
        return (), celsius
    unit = headers[numbers[0]].unit
    if unit and unit.quantity == "temperature":
        return numbers, unit
    if file.options.temperature_column is None:
        text = f"{file.listed(numbers)} has no unit; degrees Celsius are assumed"
        file.note("temperature", text)
    return numbers, celsius


def acceleration_of(file: File, rates: Columns) -> Auxiliary:
    """The columns of the options, of the format, or the only three with names of acceleration."""
    options, form = file.options, file.form
    numbers = [file.find(column) for column in options.acceleration_columns or ()]
    units = options.acceleration_units
    if form and not numbers:
        numbers = find_all(file.table, *form.acceleration.split())
        units = units or form.acceleration_units
    if not numbers:
        by_name = [t for t in triples(file.headers) if file.headers[t[0]].quantity == ACCELERATION]
        numbers = list(by_name[0]) if len(by_name) == 1 else []
    if len(numbers) != len(AXES) or {*numbers} & {*rates}:
        return (), Unit(ACCELERATION)
    unit = read_unit(units or file.headers[numbers[0]].unit_text)
    if unit and unit.quantity == ACCELERATION:
        return numbers, unit
    text = f"{file.listed(numbers)} have no unit and are not kept; give acceleration_units"
    file.note("acceleration", text)
    return (), Unit(ACCELERATION)
