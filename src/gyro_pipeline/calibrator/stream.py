"""Samples from a pipe or a serial port, line by line: CSV, or one JSON object a line."""

import json
import os
import select
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gyro_pipeline.conventions import InputError

_FIRST = 20  # lines that columns, units and the rate are told from
_CHUNK = 1 << 16

Samples = tuple[Any, Any, Any, Any]
"""Times (n,), rates (n, 3) in deg/s, accelerations (n, 3) in g, temperatures (n,), or None each."""


@contextmanager
def source(port: str | None, baud: int) -> Iterator[int]:
    """The descriptor of a serial port, or of standard input.

    Raises:
        InputError: The port cannot be opened.
    """
    if port is None:
        yield sys.stdin.fileno()
        return
    try:
        import serial  # noqa: PLC0415 - the extra [serial]
    except ImportError as error:
        text = "--port needs pyserial: pip install 'gyro-pipeline[serial]'"
        raise InputError(text) from error
    try:
        with serial.Serial(port, baud) as opened:
            yield int(opened.fileno())
    except serial.SerialException as error:
        raise InputError(
            f"--port {port}: {error}; check its name, and who else reads it"
        ) from error


def lines_of(descriptor: int, timeout_s: float, say: Callable[[str], None]) -> Iterator[list[str]]:
    """Whole lines, some at a time as they come; silence ends them, and is said."""
    left = b""
    while True:
        if not select.select([descriptor], [], [], timeout_s)[0]:
            say(f"nothing came for {timeout_s:g} s; this is what there is")
            return
        data = os.read(descriptor, _CHUNK)
        *whole, left = (left + data).split(b"\n")
        if not data:
            whole.append(left)
        yield [line.decode("utf-8", "replace").strip() for line in whole if line.strip()]
        if not data:
            return


class Parser:
    """Finds the columns in the first lines, as the readers of files do, then reads on.

    Args:
        options: Of the readers.
        rate_hz: Samples per second; None: as the times say.
    """

    def __init__(self, options: Any, rate_hz: float | None) -> None:
        self.options, self.rate_hz, self.bad = options, rate_hz, 0
        self._names: list[str] = []
        self._separator = ""  # of JSON there is none
        self._parts: list[tuple[list[int], float, float]] = []  # columns, factor, offset

    def seconds(self, lines: Iterable[Sequence[str]]) -> Iterator[Samples]:
        """Samples of a second at most at a time.

        Raises:
            InputError: Columns, units or rate cannot be told; says which option is lacking.
        """
        waiting: list[str] = []
        for some in _and_last(lines):
            waiting += some or []
            if not self._parts and waiting and (some is None or len(waiting) > _FIRST):
                waiting = waiting[self._start(waiting) :]
            if not self._parts:
                continue
            rows = [row for row in map(self._row, waiting) if row]
            waiting, step = [], max(round(self.rate_hz or 1), 1)
            for first in range(0, len(rows), step):
                yield self._samples(np.array(rows[first : first + step]))

    def _samples(self, table: NDArray[np.float64]) -> Samples:
        time_s, rates, accel, warmth = (
            table[:, columns] * factor + offset if columns else None
            for columns, factor, offset in self._parts
        )
        one, other = (None if x is None else x[:, 0] for x in (time_s, warmth))
        return one, rates, accel, other

    def _start(self, lines: Sequence[str]) -> int:
        """Tell columns, units and rate from the first lines; returns how many are a header."""
        from gyro_pipeline.readers.beside import acceleration_of, temperature_of  # noqa: PLC0415
        from gyro_pipeline.readers.columns import rate_columns  # noqa: PLC0415
        from gyro_pipeline.readers.file import File  # noqa: PLC0415
        from gyro_pipeline.readers.scales import scale_of  # noqa: PLC0415
        from gyro_pipeline.readers.table import Table  # noqa: PLC0415

        header = self._tell_names(lines[0])
        rows = [row for row in map(self._row, lines[header:]) if row]
        if not rows:
            text = f"expected numbers in {len(self._names)} columns, got {lines[-1][:60]!r}"
            raise InputError(f"stream: {text}; correct what sends them")
        columns = tuple(np.array(rows).T)
        file = File(Table("stream", tuple(self._names), columns), self.options)
        rates = list(rate_columns(file, None))
        scale, _ = scale_of(file, rates)
        file.settle()
        self._parts = [_times(file), (rates, scale, -(self.options.offset or 0.0) * scale)]
        for found, unit in (acceleration_of(file, rates), temperature_of(file)):
            self._parts.append((list(found), unit.factor, unit.offset))
        self._tell_rate(columns)
        self.bad = 0
        return header

    def _tell_names(self, first: str) -> int:
        if first.startswith("{"):
            self._names = list(json.loads(first))
            return 0
        self._separator = next((mark for mark in ",;\t" if mark in first), " ")
        cells = [cell.strip() for cell in first.split(self._separator)]
        header = any(np.isnan(_number(cell)) for cell in cells if cell)
        self._names = cells if header else [""] * len(cells)
        return int(header)

    def _row(self, line: str) -> list[float] | None:
        """Numbers of a line, NaN for what is none; None for a line of another shape."""
        cells: list[Any] = line.split(self._separator) if self._separator else []
        if not self._separator:
            try:
                content = json.loads(line)
                cells = [content[name] for name in self._names]
            except (ValueError, TypeError, KeyError):
                cells = []
        if len(cells) != len(self._names):
            self.bad += 1
            return None
        return [_number(cell) for cell in cells]

    def _tell_rate(self, columns: Sequence[NDArray[np.float64]]) -> None:
        """The rate of the first lines' times, where no option says it."""
        (numbers, unit_s, _), step = self._parts[0], 0.0
        if self.rate_hz is None and numbers:
            step = float(np.nanmedian(np.diff(columns[numbers[0]]))) * unit_s
        if self.rate_hz is None and not step > 0:
            text = "expected times that increase, in a column with a unit, or the rate, got neither"
            raise InputError(f"stream: {text}; give --rate, or --time-column and --time-units")
        self.rate_hz = self.rate_hz or float(f"{1 / step:.4g}")


def _and_last(lines: Iterable[Sequence[str]]) -> Iterator[Sequence[str] | None]:
    """Lines, and None after the last."""
    yield from lines
    yield None


def _times(file: Any) -> tuple[list[int], float, float]:
    """The column of times: the option's, or the first of such a name, if its unit is known."""
    from gyro_pipeline.units import read_unit  # noqa: PLC0415

    column, given = file.options.time_column, file.options.time_units
    named = [number for number, header in enumerate(file.headers) if header.names_time]
    for number in named if column is None else [file.find(column)]:
        if isinstance(given, float):
            return [number], given, 0.0
        unit = read_unit(given) if given else file.headers[number].unit
        if unit is not None and unit.quantity == "time":
            return [number], unit.factor, 0.0
    return [], 1.0, 0.0


def _number(cell: Any) -> float:
    try:
        return float(cell)
    except (TypeError, ValueError):
        return np.nan
