"""Samples from a pipe or a serial port, line by line: CSV, or one JSON object a line."""

import json
import os
import select
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from itertools import chain
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gyro_pipeline.conventions import InputError

_FIRST = 20  # lines that columns, units and the rate are told from

Samples = list[Any]
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
        text = f"--port {port}: {error}; check its name, and who else reads it"
        raise InputError(text) from error


def lines_of(descriptor: int, timeout_s: float, say: Callable[[str], None]) -> Iterator[list[str]]:
    """Whole lines, some at a time as they come; silence ends them, and is said."""
    left, data = b"", b" "
    while data:
        if not select.select([descriptor], [], [], timeout_s)[0]:
            say(f"nothing came for {timeout_s:g} s; this is what there is")
            return
        data = os.read(descriptor, 1 << 16)
        *whole, left = (left + data).split(b"\n") if data else (left, b"")
        yield [line.decode("utf-8", "replace").strip() for line in whole if line.strip()]


class Parser:
    """Finds the columns in the first lines, as the readers of files do, then reads on.

    Args:
        options: Of the readers.
        rate_hz: Samples per second; None: as the times say.
    """

    def __init__(self, options: Any, rate_hz: float | None) -> None:
        self.options, self.rate_hz, self.bad = options, rate_hz, 0
        self._names: list[str] = []
        self._separator: str | None = ""  # empty for JSON, None for blanks
        self._parts: list[tuple[list[int], float, float]] = []  # columns, factor, offset

    def seconds(self, lines: Iterable[Sequence[str]]) -> Iterator[Samples]:
        """Samples of a second at most at a time.

        Raises:
            InputError: Columns, units or rate cannot be told; says which option is lacking.
        """
        lines, first = iter(lines), list[str]()
        for some in lines:
            first += some
            if len(first) > _FIRST:
                break
        if not first:
            return
        header = self._start(first)
        step = max(round(self.rate_hz or 1), 1)
        for some in chain([first[header:]], lines):
            rows = [row for row in map(self._row, some) if row]
            for start in range(0, len(rows), step):
                table = np.array(rows[start : start + step])
                yield [self._columns(table, *part) for part in self._parts]

    def _columns(
        self, table: NDArray[np.float64], columns: list[int], factor: float, offset: float
    ) -> NDArray[np.float64] | None:
        values = table[:, columns] * factor + offset
        return None if not columns else values if len(columns) > 1 else values[:, 0]

    def _start(self, lines: Sequence[str]) -> int:
        """Tell columns, units and rate from the first lines; returns how many are a header."""
        from gyro_pipeline.readers import columns, file, scales, table  # noqa: PLC0415

        header = self._tell_names(lines[0])
        rows = [row for row in map(self._row, lines[header:]) if row]
        if not rows:
            text = f"expected numbers in {len(self._names)} columns, got {lines[-1][:60]!r}"
            raise InputError(f"stream: {text}; correct what sends them")
        content = table.Table("stream", tuple(self._names), tuple(np.array(rows).T))
        opened = file.File(content, self.options)
        rates = list(columns.rate_columns(opened, None))
        scale, _ = scales.scale_of(opened, rates)
        opened.settle()
        times, offset = _times(opened), -(self.options.offset or 0.0) * scale
        self._parts = [times, (rates, scale, offset)]
        others = columns.acceleration_of(opened, rates), columns.temperature_of(opened)
        for numbers, unit in others:
            self._parts.append((list(numbers), unit.factor, unit.offset))
        self._tell_rate(self._columns(np.array(rows), *times))
        self.bad = 0
        return header

    def _tell_names(self, first: str) -> int:
        if first.startswith("{"):
            self._names = list(json.loads(first))
            return 0
        self._separator = next((mark for mark in ",;\t" if mark in first), None)
        cells = [cell.strip() for cell in first.split(self._separator)]
        header = any(np.isnan(_number(cell)) for cell in cells if cell)
        self._names = cells if header else [""] * len(cells)
        return int(header)

    def _row(self, line: str) -> list[float] | None:
        """Numbers of a line, NaN for what is none; None for a line of another shape."""
        cells: list[Any] = []
        if self._separator != "":
            cells = line.split(self._separator)
        else:
            try:
                content = json.loads(line)
                cells = [content[name] for name in self._names]
            except (ValueError, TypeError, KeyError):
                pass
        if len(cells) == len(self._names):
            return [_number(cell) for cell in cells]
        self.bad += 1
        return None

    def _tell_rate(self, times: NDArray[np.float64] | None) -> None:
        """The rate of the first lines' times, where no option says it."""
        step = 0.0 if times is None else float(np.nanmedian(np.diff(times)))
        if self.rate_hz is None and not step > 0:
            text = "expected times that increase, in a column with a unit, or the rate, got neither"
            raise InputError(f"stream: {text}; give --rate, or --time-column and --time-units")
        self.rate_hz = self.rate_hz or float(f"{1 / step:.4g}")


def _times(file: Any) -> tuple[list[int], float, float]:
    """The column of times that the readers try first, if its unit is known."""
    from gyro_pipeline.readers.stamps import stated_unit_s, time_columns  # noqa: PLC0415

    for number, unit_s, by_name in time_columns(file):
        if by_name and (factor := stated_unit_s(file) or unit_s):
            return [number], factor, 0.0
    return [], 1.0, 0.0


def _number(cell: Any) -> float:
    try:
        return float(cell)
    except (TypeError, ValueError):
        return np.nan
