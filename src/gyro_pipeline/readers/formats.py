"""What loggers call their columns, and what they mean by them.

A new format is a subclass of :class:`Reader` that says so, and an entry in :data:`READERS`.
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

from gyro_pipeline.conventions import AXES, InputError
from gyro_pipeline.logs import KEPT, Finding
from gyro_pipeline.parameters import Column, RateUnits, ReaderOptions, TimeUnits
from gyro_pipeline.readers.headers import (
    CELSIUS,
    DEG_PER_S,
    SECONDS,
    TIME_UNITS,
    UNITS,
    axes,
    find,
    listed,
    matching,
    rate_unit,
    rate_units_in,
    split_unit,
)
from gyro_pipeline.readers.tables import Table


@dataclass(frozen=True)
class Layout:
    """Which columns of a table are what, by number.

    Attributes:
        rates: Angular rates about x, y, z.
        scale_dps: deg/s in one unit of them.
        time: Timestamps.
        time_s: Seconds in one unit of them; None: not known.
        temperature: Degrees Celsius are ``celsius[0]`` times it, plus ``celsius[1]``.
        celsius: As above.
        counter: Packets, one more each row.
        counter_bits: The counter starts anew after ``2**counter_bits``.
        findings: What the header does not say.
    """

    rates: tuple[int, ...]
    scale_dps: float
    time: int | None
    time_s: float | None
    temperature: int | None
    celsius: tuple[float, float]
    counter: int | None
    counter_bits: int
    findings: tuple[Finding, ...]


class Reader:
    """A format: names of columns, and units where the header has none.

    A column that is not of the rates may be absent from a file.
    """

    rates: ClassVar[tuple[str, str, str]]
    units: ClassVar[RateUnits | None] = None
    time: ClassVar[str | None] = None
    time_units: ClassVar[TimeUnits | None] = None
    counter: ClassVar[str | None] = None
    counter_bits: ClassVar[int] = 16

    def claims(self, table: Table) -> bool:
        """Whether a table is of this format: it has the rates and the time."""
        needed = [*self.rates, *([self.time] if self.time else [])]
        return all(matching(table.names, name) for name in needed)

    def rate_columns(self, table: Table, where: str) -> Sequence[Column]:
        """The three columns of the rates."""
        del table, where
        return self.rates

    def time_column(self, table: Table) -> Column | None:
        """The column of the timestamps, if there is one."""
        return self._if_there(table, self.time)

    def layout(self, table: Table, options: ReaderOptions, where: str) -> Layout:
        """Find the columns and their units: what options say, the header, the format, in turn.

        Raises:
            InputError: A column is missing or ambiguous, or a unit is unknown or contradicts
                the header.
        """
        names = table.names

        def number(given: Column | None, own: Column | None) -> int | None:
            column = own if given is None else given
            return None if column is None else find(names, column, where)

        columns = options.columns or self.rate_columns(table, where)
        rates = tuple(find(names, column, where) for column in columns)
        if len(set(rates)) < len(AXES):
            raise InputError(f"{where}: expected three columns of rates, got {list(columns)}")
        time = number(options.time_column, self.time_column(table))
        scale_dps, of_unit = self._scale(table, rates, options, where)
        temperature, celsius, of_temperature = self._temperature(table, options, where)
        time_s, without_unit = self._time_unit(table, time, options, where)
        return Layout(
            rates=rates,
            scale_dps=scale_dps,
            time=time,
            time_s=time_s,
            temperature=temperature,
            celsius=celsius,
            counter=number(options.counter_column, self._if_there(table, self.counter)),
            counter_bits=options.counter_bits or self.counter_bits,
            findings=(*of_unit, *without_unit, *of_temperature),
        )

    @staticmethod
    def _if_there(table: Table, name: str | None) -> str | None:
        return name if name and matching(table.names, name) else None

    def _scale(
        self, table: Table, rates: Sequence[int], options: ReaderOptions, where: str
    ) -> tuple[float, tuple[Finding, ...]]:
        """deg/s in one unit of the rates; a finding if the header does not say which."""
        headers = [table.names[number] for number in rates]
        found = {rate_unit(header) for header in headers}
        found |= {unit for header in headers if (unit := rate_unit(split_unit(header, UNITS)[0]))}
        if len(found) > 1:
            raise InputError(
                f"{where}: expected one unit of all rates, got {listed(headers)}; correct the "
                "header"
            )
        by_header = found.pop()
        if by_header and options.units and by_header != options.units:
            raise InputError(
                f"{where}: the header says {by_header}, {listed(headers)}, and units of the "
                f"options {options.units}; correct the one that is wrong"
            )
        # where they differ they are the axes: gyro[x]
        others = {split_unit(header, UNITS)[1] for header in headers}
        unknown = others.pop() if by_header is None and len(others) == 1 else None
        unit = by_header or options.units or (None if unknown else self.units)
        if unit == "raw" and options.scale_dps is None:
            raise InputError(f"{where}: raw counts: give units: raw and scale_dps, deg/s a count")
        if unit is None:
            raise InputError(
                f"{where}: expected a unit of the rates, got {listed(headers)}; give units: "
                f"{', '.join(DEG_PER_S)} or raw (with scale_dps)"
            )
        by_format = not (by_header or options.units)
        above = rate_units_in(table.preamble)
        listed_above = ", ".join(sorted(above - {unit}))
        if listed_above and by_format:
            raise InputError(
                f"{where}: the unit of this format is {unit}, but lines above the header say "
                f"{listed_above}; give units"
            )
        note = None
        if listed_above:
            note = f"{unit}, but lines above the header say {listed_above}"
        elif unknown:
            note = f"{unit}, by the options; the header says {unknown}, which is not known"
        elif by_format and not above:
            note = f"{unit}, by the format; the file does not say"
        findings = (Finding("unit", KEPT, note),) if note else ()
        return options.scale_dps or DEG_PER_S[unit], findings

    @staticmethod
    def _temperature(
        table: Table, options: ReaderOptions, where: str
    ) -> tuple[int | None, tuple[float, float], tuple[Finding, ...]]:
        """A column of the options, or the one that is named so; how it becomes °C."""
        nothing, as_it_is = None, (1.0, 0.0)
        if options.temperature_column is not None:
            number = find(table.names, options.temperature_column, where)
            header = table.names[number]
            unit = split_unit(header, tuple(CELSIUS))[1]
            if unit and unit not in CELSIUS:
                raise InputError(
                    f"{where}: expected a temperature in degC, degF or K, got {header!r}; correct "
                    "temperature_column"
                )
            return number, CELSIUS[unit] if unit else as_it_is, ()
        found = _temperatures(table.names)
        if len(found) > 1:
            names = listed([table.names[number] for number in found])
            text = f"none of {names} is kept; name one by temperature_column"
            return nothing, as_it_is, (Finding("temperature", KEPT, text),)
        for number, unit in found.items():
            if unit:
                return number, CELSIUS[unit], ()
            text = f"{table.names[number]!r} has no unit and is taken for degrees Celsius"
            return number, as_it_is, (Finding("temperature", KEPT, text),)
        return nothing, as_it_is, ()

    def _time_unit(
        self, table: Table, time: int | None, options: ReaderOptions, where: str
    ) -> tuple[float | None, tuple[Finding, ...]]:
        """Seconds in one unit of the timestamps; a finding if that cannot be said."""
        if time is None:
            text = "no time column was found; give time_column to have the rate checked"
            return None, (Finding("timestamps", KEPT, text),)
        if time in table.in_seconds:
            return 1.0, ()
        header = table.names[time]
        said = split_unit(header, UNITS)[1]
        unit = TIME_UNITS.get(said or "")
        if said and unit is None and options.time_units is None:
            raise InputError(
                f"{where}: expected a time in {', '.join(SECONDS)}, got {header!r}; give time_units"
            )
        if unit and options.time_units and unit != options.time_units:
            raise InputError(
                f"{where}: the header says {unit}, {header!r}, and time_units of the options "
                f"{options.time_units}; correct the one that is wrong"
            )
        unit = unit or options.time_units or self.time_units
        if unit:
            return SECONDS[unit], ()
        if options.time_column is not None:
            raise InputError(
                f"{where}: {header!r} has no unit; give time_units: {', '.join(SECONDS)}"
            )
        text = f"{header!r} has no unit; give time_units to have the rate checked"
        return None, (Finding("timestamps", KEPT, text),)


class MovellaDot(Reader):
    """Export of the Movella (Xsens) DOT app.

    Source: Xsens DOT User Manual XD0502P, section 4.2: angular velocity in deg/s; SampleTimeFine
    in microseconds; it and PacketCounter wrap at 2**32.
    """

    rates = ("Gyr_X", "Gyr_Y", "Gyr_Z")
    units = "deg/s"
    time = "SampleTimeFine"
    time_units = "us"
    counter = "PacketCounter"
    counter_bits = 32

    def claims(self, table: Table) -> bool:
        """Whether it is; MT Manager writes the same names and rad/s, below lines of ``//``."""
        comments = any(line.startswith("//") for line in table.preamble.splitlines())
        return super().claims(table) and not comments


class MovellaDotAngles(Reader):
    """DOT recordings as published with ``Multiple-MEMS-IMUs-Estimation``: angles and seconds."""

    rates = ("w_x", "w_y", "w_z")
    units = "deg/s"
    time = "Time"
    time_units = "s"

    def claims(self, table: Table) -> bool:
        """Whether it is: the rates alone are common names."""
        marks = ("phi", "theta", "psi", "f_x", "f_y", "f_z")
        return super().claims(table) and {*marks} <= {*table.names}


class OpenLogArtemis(Reader):
    """SparkFun OpenLog Artemis with its ICM-20948.

    Source: its documentation of sensor units: gX, gY, gZ in degrees per second, imu_degC in
    degrees Celsius; rtcTime is ``HH:MM:SS`` with hundredths.
    """

    rates = ("gX", "gY", "gZ")
    units = "deg/s"
    time = "rtcTime"


class Ngimu(Reader):
    """``sensors.csv`` of x-io's NGIMU software, which has all units in its header."""

    rates = ("Gyroscope X", "Gyroscope Y", "Gyroscope Z")
    time = "Time"


class General(Reader):
    """Any table; rates are the columns of the options, or those whose headers say so."""

    def claims(self, table: Table) -> bool:
        """Every table."""
        del table
        return True

    def rate_columns(self, table: Table, where: str) -> Sequence[Column]:
        """Three columns with units of angular rate that differ in x, y, z; or all of three."""
        rates = [n for n, name in enumerate(table.names) if rate_unit(name) not in (None, "raw")]
        if not rates and len(table.names) == len(AXES):
            return range(len(AXES))
        order = axes([split_unit(table.names[n], UNITS)[0] for n in rates])
        others = [table.names[n] for n in rates if n not in {rates[k] for k in order or ()}]
        others += [name for name in table.names if _GYRO.match(name) and not rate_unit(name)]
        if order is None or not all(_NORM.search(name) for name in others):
            raise InputError(
                f"{where}: expected three columns of angular rate about x, y, z with their unit, "
                f"got {listed(table.names)}; give columns"
            )
        return [rates[number] for number in order]

    def time_column(self, table: Table) -> Column | None:
        """The column that is most plainly a time, the first of equals."""
        found = [(how, n) for n, name in enumerate(table.names) if (how := _is_time(name))]
        plain = [(0, n) for _, n in found if n in table.in_seconds]
        return min([*plain, *found])[1] if found else None


_DURATION = re.compile(
    r"loop|delta|diff|exposure|response|integration|latency|interval|duration|lag"
)
_NORM = re.compile(r"norm|abs|mag|total", re.IGNORECASE)
_GYRO = re.compile(r"(gyro?|omega|w)[ _.]?[xyz]$", re.IGNORECASE)
_TIME_NAMES = ("time", "timestamp", "timestamps", "t", "ts", "elapsed", "elapsedtime", "datetime")


def _is_time(header: str) -> int:
    """How plainly it names a time: 1 with a unit of time, 2 without, 3 and more by its unit; 0."""
    name, unit = split_unit(header, UNITS)
    stem = split_unit(name, UNITS)[0].split(".")[-1]
    word = re.sub(r"[^a-z]", "", stem.lower())
    named = word in _TIME_NAMES and (word != "t" or stem == "t" or unit in TIME_UNITS)
    if unit in TIME_UNITS:
        a_time = "time" in word and not _DURATION.search(word)
        return 1 if named else 3 if a_time else 4 if not word else 0
    if unit is None:
        return 2 if named else 0
    return 5 if named and unit not in CELSIUS else 0


_DEGREES_C = ("degc", "°c", "celsius")
_UNBRACKETED = tuple(set(CELSIUS) - {"f", "k"})
_OF_WHAT = "gyro imu sensor board chip die mcu cpu ambient case out c".split()


def _temperatures(names: Sequence[str]) -> dict[int, str | None]:
    """Columns with a unit of temperature, or named one and without a unit, and their unit."""
    found: dict[int, str | None] = {}
    for number, name in enumerate(names):
        stem, unit = split_unit(name, _UNBRACKETED)
        words = [word.lower() for word in re.findall(r"[A-Z]?[a-z]+|[A-Z]+(?![a-z])", stem)]
        while words and words[-1] in _OF_WHAT:
            words.pop()
        named = bool(words) and words[-1] in ("temp", "temperature", "t")
        told = unit in CELSIUS and (named or unit in _DEGREES_C)
        if told or (unit is None and named and words[-1] != "t"):
            found[number] = unit
    if any(found.values()):
        return {number: unit for number, unit in found.items() if unit}
    return found


READERS: dict[str, Reader] = {
    "movella_dot": MovellaDot(),
    "movella_dot_angles": MovellaDotAngles(),
    "openlog_artemis": OpenLogArtemis(),
    "ngimu": Ngimu(),
    "general": General(),
}
"""Formats by the name that ``format`` of the options has; the first that claims a file reads it."""


def check_format(name: str, where: str) -> None:
    """Refuse a name that no format has.

    Raises:
        InputError: So it is.
    """
    if name != "auto" and name not in READERS:
        raise InputError(f"{where}: expected format auto, {', '.join(READERS)}, got {name!r}")


def reader_of(table: Table, options: ReaderOptions, path: Path) -> Reader:
    """The format that the options name, or the first that claims the table.

    Raises:
        InputError: There is no format of that name.
    """
    check_format(options.format, str(path))
    if options.format == "auto":
        return next(reader for reader in READERS.values() if reader.claims(table))
    return READERS[options.format]
