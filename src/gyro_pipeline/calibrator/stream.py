"""Samples from a pipe or a serial port, line by line: CSV with a header, or a JSON object a line."""

import json
import os
import select
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gyro_pipeline.conventions import InputError

_FIRST = 20  # lines that columns, units and the rate are told from
_CHUNK = 1 << 16


@dataclass
class Samples:
    """Some samples: times (n,) or None, rates (n, 3) in deg/s, accelerations, temperatures."""

    time_s: NDArray[np.float64] | None
    gyro_dps: NDArray[np.float64]
    accel_g: NDArray[np.float64] | None
    temperature_c: NDArray[np.float64] | None


class Silence(Exception):
    """Nothing came for too long."""


def lines_of(descriptor: int, timeout_s: float) -> Iterator[list[str]]:
    """Whole lines as they come, some at a time.

    Raises:
        Silence: Nothing came within the timeout.
    """
    left = b""
    while True:
        if not select.select([descriptor], [], [], timeout_s)[0]:
            raise Silence
        data = os.read(descriptor, _CHUNK)
        parts = (left + data).split(b"\n")
        left = parts.pop()
        if not data and left:
            parts.append(left)
        if parts:
            yield [part.decode("utf-8", "replace").strip() for part in parts]
        if not data:
            return


class Parser:
    """Finds the columns in the first lines, as the readers of files do, then reads on.

    Args:
        options: Options of the readers.
        rate_hz: Samples per second, where the option says so.
    """

    def __init__(self, options: Any, rate_hz: float | None) -> None:
        self.options, self.rate_hz, self.bad = options, rate_hz, 0
        self._names: list[str] = []
        self._waiting: list[str] = []
        self._json = False
        self._separator = ","
        self._columns: dict[str, tuple[list[int], float, float]] = {}

    def feed(self, lines: Sequence[str], ended: bool = False) -> Samples | None:
        """Take lines; nothing comes back until there are enough to tell the columns from.

        Raises:
            InputError: The columns or the rate cannot be told; says which option is lacking.
        """
        self._waiting += [line for line in lines if line]
        if not self._columns:
            if len(self._waiting) <= _FIRST and not ended:
                return None
            self._start()
        rows = [self._row(line) for line in self._waiting]
        self._waiting = []
        table = np.array([row for row in rows if row is not None], np.float64)
        if not len(table):
            return None
        parts = {
            name: self._part(table, name)
            for name in ("time", "rate", "acceleration", "temperature")
        }
        time_s, warmth = parts["time"], parts["temperature"]
        rates = parts["rate"]
        if rates is None:
            return None
        return Samples(
            None if time_s is None else time_s[:, 0], rates, parts["acceleration"],
            None if warmth is None else warmth[:, 0],
        )  # fmt: skip

    def _part(self, table: NDArray[np.float64], name: str) -> NDArray[np.float64] | None:
        numbers, factor, offset = self._columns[name]
        return table[:, numbers] * factor + offset if numbers else None

    def _start(self) -> None:
        """Tell the names, the columns, their units and the rate from the first lines."""
        from gyro_pipeline.readers.beside import acceleration_of, temperature_of  # noqa: PLC0415
        from gyro_pipeline.readers.columns import rate_columns  # noqa: PLC0415
        from gyro_pipeline.readers.file import File  # noqa: PLC0415
        from gyro_pipeline.readers.scales import scale_of  # noqa: PLC0415
        from gyro_pipeline.readers.table import Table  # noqa: PLC0415

        if not self._waiting:
            raise InputError("standard input: expected lines of samples, got none")
        self._tell_names()
        rows = [row for row in map(self._row, self._waiting) if row is not None]
        if not rows:
            first = self._waiting[0][:60]
            raise InputError(
                f"standard input: expected numbers in rows of {len(self._names)} columns, got {first!r}"
            )
        columns = tuple(np.array(rows, np.float64).T)
        file = File(Table("standard input", tuple(self._names), columns), self.options)
        numbers = list(rate_columns(file, None))
        scale, _ = scale_of(file, numbers)
        file.settle()
        zero = -(self.options.offset or 0.0) * scale
        self._columns = {"rate": (numbers, scale, zero), "time": self._times(file)}
        for name, (found, unit) in (
            ("acceleration", acceleration_of(file, numbers)),
            ("temperature", temperature_of(file)),
        ):
            self._columns[name] = list(found), unit.factor, unit.offset
        self._tell_rate(columns)

    def _tell_names(self) -> None:
        first = self._waiting[0]
        self._json = first.startswith("{")
        if self._json:
            self._names = list(json.loads(first))
            return
        self._separator = next((mark for mark in ",;\t" if mark in first), " ")
        cells = [cell.strip() for cell in first.split(self._separator)]
        if any(_number(cell) is None for cell in cells if cell):
            self._names = cells
            self._waiting.pop(0)
        else:
            self._names = [""] * len(cells)

    def _row(self, line: str) -> list[float] | None:
        """Numbers of a line, NaN for what is none; None for a line of another shape."""
        if self._json:
            try:
                content = json.loads(line)
                cells = [content.get(name) for name in self._names]
            except (ValueError, AttributeError):
                self.bad += 1
                return None
        else:
            cells = line.split(self._separator)
        if len(cells) != len(self._names):
            self.bad += 1
            return None
        values = [_number(cell) for cell in cells]
        return [np.nan if value is None else value for value in values]

    def _times(self, file: Any) -> tuple[list[int], float, float]:
        """The column of time: the option's, or the first that is named so and has a unit."""
        from gyro_pipeline.readers.stamps import _candidates, _options_s  # noqa: PLC0415

        for number, unit_s, _ in _candidates(file):
            if (seconds := _options_s(file) or unit_s) is not None:
                return [number], seconds, 0.0
        return [], 1.0, 0.0

    def _tell_rate(self, columns: Sequence[NDArray[np.float64]]) -> None:
        """The rate of the option, or of the first lines' times."""
        numbers, unit_s, _ = self._columns["time"]
        if self.rate_hz is not None:
            return
        if not numbers:
            raise InputError(
                "standard input: expected a column of times with a unit, or the rate, got neither; "
                "give --rate, or --time-column and --time-units"
            )
        step = float(np.median(np.diff(columns[numbers[0]]))) * unit_s
        if not step > 0:
            raise InputError("standard input: expected times that increase; give --rate")
        self.rate_hz = float(f"{1 / step:.4g}")


def _number(cell: Any) -> float | None:
    try:
        return float(cell)
    except (TypeError, ValueError):
        return None
