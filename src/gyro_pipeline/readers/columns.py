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
from gyro_pipeline.readers.formats import BIAS_TAKEN_OFF, find_all
from gyro_pipeline.readers.names import ATTITUDE, RATE, File, Header, samples_a_row, triples
from gyro_pipeline.readers.scales import RATE_UNITS

Columns = Sequence[int]


def rate_columns(file: File, imu: int | None = None) -> Columns:
    """Numbers of the columns of the rates about x, y, z.

    Args:
        file: Its table and options.
        imu: Whose columns, where the options give those of several IMUs.

    Raises:
        InputError: No columns, or several, could be meant.
    """
    given = file.options.columns
    if isinstance(given, dict):
        if imu not in given:
            known = ", ".join(map(str, given))
            raise file.refusal(f"columns are given of IMUs {known}, not of IMU {imu}; correct them")
        given = given[imu]
    rates = _given(file, given) if given else _named(file)
    _note_what_names_say(file, rates)
    return rates


def _given(file: File, given: Sequence[Column]) -> Columns:
    """The columns of the options; they contradict names of something else or of another order."""
    rates = [file.find(column) for column in given]
    if len(set(rates)) < len(AXES):
        raise file.refusal(f"expected three columns of rates, got {list(given)}; correct columns")
    others = [triple for triple in triples(file.headers) if {*triple} & {*rates}]
    same = [triple for triple in others if {*triple} == {*rates}]
    if others and list(rates) not in map(list, same):
        together = "in this order" if same else "together"
        file.contradictions.append(
            f"columns of the options are {file.listed(rates)}, but by their names "
            f"{file.listed((same or others)[0])} belong {together}; give these, or no columns"
        )
    strange = [n for n in rates if not _may_be_rate(file, file.headers[n])]
    if strange:
        file.contradictions.append(
            f"columns of the options name {file.listed(strange)}, by name no angular rate; give "
            "columns of angular rates"
        )
    return rates


def _may_be_rate(file: File, header: Header) -> bool:
    """Whether a name allows it; that of an angle does, of increments or with a unit of rates."""
    of_angle = header.quantity == ATTITUDE
    return header.quantity in ("", RATE) or (
        of_angle and (file.options.increments or header.measures("rate"))
    )


def _named(file: File) -> Columns:
    """The only three columns that say they are rates about x, y, z."""
    if file.form:
        return [find_all(file.table, name)[0] for name in file.form.rates]
    by_name: list[Columns] = []
    by_unit: list[Columns] = []
    silent: list[Columns] = []
    wrong: list[Columns] = []
    for triple in triples(file.headers):
        header = file.headers[triple[0]]
        if header.quantity == RATE:
            right = not header.unit or header.measures("rate", "count", "angle")
            (by_name if right else wrong).append(triple)
        elif not header.quantity:
            measured = header.measures("angle" if file.options.increments else "rate")
            (by_unit if measured else silent).append(triple)
    if not any(file.table.names) and len(file.table.names) == len(AXES):
        silent = [(0, 1, 2)]
    asked = bool(file.options.units)  # the user's word
    candidates = by_name + by_unit or wrong or (silent if asked else [])
    several = len(candidates) > 1 and samples_a_row(file.headers, candidates[0]) <= len(AXES)
    if candidates and not several:
        return candidates[0]
    raise _refusal_of(file, candidates, silent)


def _refusal_of(file: File, candidates: Sequence[Columns], silent: Sequence[Columns]) -> InputError:
    if candidates:
        first, second = map(list, candidates[:2])
        return file.refusal(
            f"expected one sensor, got {len(candidates)}, such as {file.listed(first)} and "
            f"{file.listed(second)}; give columns of the one to read, such as {first}, or of both "
            f"as IMUs, {{1: {first}, 2: {second}}},"
        )
    if len(silent) == 1:
        return file.refusal(
            f"{file.listed(silent[0])} do not say what they measure, got {file.table.listed()}; if "
            f"they are angular rates, give units: {RATE_UNITS}"
        )
    return file.refusal(
        "expected three columns of angular rate about x, y, z that say so by name or unit, got "
        f"{file.table.listed()}; give columns, such as [gx, gy, gz], and units"
    )


def _note_what_names_say(file: File, rates: Columns) -> None:
    """Several samples a row; rates that are free of their bias; a browser's axes."""
    samples = samples_a_row(file.headers, rates)
    if samples > len(AXES):
        file.contradictions.append(
            f"each row holds {samples} samples, {file.listed(rates)} and so on, but one of them "
            "would be read; write a row for each sample"
        )
    first = file.table.names[rates[0]]
    for words, reason in BIAS_TAKEN_OFF.items():
        if re.search(words, first, re.IGNORECASE):
            file.note("bias taken off", f"{first!r} is what is left of a bias: {reason}")
    if re.search("alpha|beta|gamma", first, re.IGNORECASE):
        text = "a browser's alpha is taken for the rate about z, beta x, gamma y (W3C, 2016)"
        file.note("axes", f"{text}; some browsers number them from x")
    if file.form and file.form.remark:
        file.note("axes", file.form.remark)
