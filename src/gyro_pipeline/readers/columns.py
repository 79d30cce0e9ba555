"""Which columns of a table are the rates.

A column is a rate only if it says so: by a name and a unit, or by the user's word. What a name, a
header, the lines above it, a format and the options say of the same thing must agree. Where two of
them contradict each other, both are named and the file is refused; ``trust: options`` decides for
the options, and a finding then says what they overruled.
"""

import re
from collections.abc import Sequence

from gyro_pipeline.conventions import AXES, InputError
from gyro_pipeline.parameters import Column
from gyro_pipeline.readers.file import File
from gyro_pipeline.readers.formats import find_all
from gyro_pipeline.readers.names import (
    ATTITUDE,
    INDEX,
    RATE,
    Header,
    is_quaternion,
    numbered,
    triples,
)
from gyro_pipeline.readers.scales import RATE_UNITS

Columns = Sequence[int]

_NOTES = {
    "motionRotationRate": "{} is what is left of a bias: Core Motion removes it (Apple, "
    "CMDeviceMotion.rotationRate); gyroRotation columns are free of that",
    "gyroADC": "{} is what is left of a bias: Betaflight takes off the mean at power-on",
    "unbiased|debias|bias_?(free|corrected|removed)|(?<!un)calibrated(?=[_ ]|$)": "{} is what is "
    "left of a bias: by its name, it is taken off",
    "alpha|beta|gamma": "{}: a browser's alpha is taken for the rate about z, beta x, gamma y "
    "(W3C, 2016); some browsers number them from x",
}
"""What the name of a rate says beside."""


def rate_columns(file: File, imu: int | None = None) -> Columns:
    """Numbers of the columns of the rates about x, y, z.

    Args:
        file: Its table and options.
        imu: Whose columns, where the options give those of several IMUs.

    Raises:
        InputError: No columns, or several, could be meant.
    """
    columns = file.options.columns
    if isinstance(columns, dict):
        if imu not in columns:
            imus = ", ".join(map(str, columns))
            raise file.refusal(f"columns are of IMUs {imus}, not of IMU {imu}; correct them")
        columns = columns[imu]
    rates = _by_options(file, columns) if columns else _by_name(file)
    for words, text in _NOTES.items():
        if re.search(words, file.table.names[rates[0]], re.IGNORECASE):
            file.note("rates", text.format(repr(file.table.names[rates[0]])))
    return rates


def _by_options(file: File, columns: Sequence[Column]) -> Columns:
    """The columns of the options, compared with what their names say of quantity, axes, samples."""
    rates = [file.find(column) for column in columns]
    if len(set(rates)) < len(AXES):
        raise file.refusal(f"expected three columns of rates, got {list(columns)}; correct columns")
    headers, contradict = file.headers, file.contradictions.append
    overlapping = [t for t in (*triples(headers), *numbered(headers)) if {*t} & {*rates}]
    same = [triple for triple in overlapping if {*triple} == {*rates}]
    if overlapping and tuple(rates) not in same:
        together = "in this order" if same else "together"
        contradict(
            f"columns of the options are {file.listed(rates)}, but by their names "
            f"{file.listed((same or overlapping)[0])} belong {together}; give these, or no columns"
        )
    arrays = [INDEX.sub("", header.name) for header in headers]
    samples = min(arrays.count(arrays[number]) for number in rates)
    if samples > 1 and len({arrays[number] for number in rates}) == len(AXES):
        contradict(
            f"a row holds {samples} samples, {file.listed(rates)} and so on, of which the options "
            "name one; write a row for each sample"
        )
    others = [number for number in rates if not _may_be_rate(file, headers[number])]
    if others or is_quaternion(headers, rates):
        contradict(
            f"columns of the options name {file.listed(others or rates)}, by name "
            f"{'no angular rate' if others else 'of a quaternion'}; give columns of angular rates"
        )
    return rates


def _may_be_rate(file: File, header: Header) -> bool:
    """Whether a name allows a rate; that of an angle allows increments, or a rate by its unit."""
    angle_turned = file.options.increments or header.measures("rate")
    return header.quantity in ("", RATE) or (header.quantity == ATTITUDE and angle_turned)


def _by_name(file: File) -> Columns:
    """The only three columns that say they are rates about x, y, z."""
    if file.form:
        return find_all(file.table, *file.form.rates.split())
    measured = "angle" if file.options.increments else "rate"
    certain, possible = list[Columns](), list[Columns]()
    with_axes = triples(file.headers)
    for triple in with_axes + numbered(file.headers):
        header = file.headers[triple[0]]
        if header.quantity in ("", RATE):
            if header.quantity == RATE or header.measures(measured):
                certain.append(triple)
            elif triple in with_axes:
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
    file.note("rates", f"nothing but units of the options says that {names} are rates")
    return possible[0]


def _refusal_of(file: File, candidates: Sequence[Columns]) -> InputError:
    """An error about columns of several sensors or samples, or of none."""
    if candidates:
        first, second = map(list, candidates[:2])
        return file.refusal(
            f"expected one sensor and one sample a row, got {len(candidates)}, such as "
            f"{file.listed(first)} and {file.listed(second)}; if they are samples, write a row for "
            f"each; if they are sensors, give columns of the one to read, such as {first}, or of "
            f"both as IMUs, {{1: {first}, 2: {second}}},"
        )
    return file.refusal(
        "expected three columns of angular rate about x, y, z that say so by name or unit, got "
        f"{file.table.listed()}; give columns, such as [gx, gy, gz], and units"
    )
