"""Samples from a pipe or a serial port, as lines of CSV or one JSON object per line."""

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

_HEADER_LINES = 20  # that columns, units and the rate are inferred from
_REGULAR = 0.8  # share of equal steps from which their median is the period of the samples
_MOST_OFF = 1.1  # factor between the given rate and that of the first times
_OF_FILES = {"increments", "repeats", "row", "rows", "signed_bits", "time_is"}  # options

Samples = list[Any]  # times (n,), rates (n, 3), accelerations (n, 3), temperatures (n,); or None


@contextmanager
def source(port: str | None, baud: int) -> Iterator[int]:
    """The file descriptor of a serial port, or of standard input.

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
        with serial.Serial(port, baud) as connection:
            yield int(connection.fileno())
    except serial.SerialException as error:
        text = f"--port {port}: {error}; check its name, and that no other program reads it"
        raise InputError(text) from error


def lines_of(descriptor: int, timeout_s: float, say: Callable[[str], None]) -> Iterator[list[str]]:
    """Complete lines, some at a time as they arrive, until a silence, which is reported."""
    remainder, data = b"", b" "
    while data:
        if not select.select([descriptor], [], [], timeout_s)[0]:
            say(f"nothing came for {timeout_s:g} s; the result is from the samples before")
            return
        data = os.read(descriptor, 1 << 16)
        *lines, remainder = (remainder + data).split(b"\n") if data else (remainder, b"")
        yield [line.decode("utf-8", "replace").strip() for line in lines if line.strip()]


class Parser:
    """Finds the columns in the first lines, as the readers of files do, and parses all lines.

    Without ``rate_hz``, the rate is inferred from the times. ``bad`` counts lines of another shape;
    ``doubt`` says that the times contradict the rate.

    Raises:
        InputError: An option would change the samples of a file, but not those of a stream.
    """

    def __init__(self, options: Any, rate_hz: float | None) -> None:
        for name in sorted(_OF_FILES & options.model_fields_set):
            text = f"--{name.replace('_', '-')}: expected a log file, got a stream"
            raise InputError(f"{text}; leave it out, or store the stream and use log")
        self.options, self.rate_hz, self.bad, self.doubt = options, rate_hz, 0, ""
        self._names: list[str] = []
        self._split: Callable[[str], list[Any]] = str.split  # a line into the cells of the names
        self._parts: list[tuple[list[int], float, float]] = []  # columns, factor, offset

    def seconds(self, lines: Iterable[Sequence[str]]) -> Iterator[Samples]:
        """Samples, at most a second at a time.

        Raises:
            InputError: Columns, units or rate are unknown; the message names the option to give.
        """
        lines, first = iter(lines), list[str]()
        for batch in lines:
            first += batch
            if len(first) > _HEADER_LINES:
                break
        if not first:
            return
        rows = self._start(first)
        step = max(round(self.rate_hz or 1), 1)
        for ready in chain([rows], map(self._rows, lines)):
            for start in range(0, len(ready), step):
                table = np.array(ready[start : start + step])
                yield [_columns(table, *part) for part in self._parts]

    def _start(self, lines: Sequence[str]) -> list[list[float]]:
        """Infer columns, units and rate from the first lines; returns the rows among them."""
        from gyro_pipeline.readers import columns, file, scales, table  # noqa: PLC0415

        rows = self._rows(lines[self._read_names(lines[0]) :])
        if not rows:
            text = f"expected numbers in {len(self._names)} columns, got {lines[-1][:60]!r}"
            raise InputError(f"stream: {text}; correct the program that sends them")
        content = table.Table("stream", tuple(self._names), tuple(np.array(rows).T))
        log = file.File(content, self.options)
        rates = list(columns.rate_columns(log, None))
        scale, _ = scales.scale_of(log, rates)
        log.settle()
        times, offset = _times(log), -(self.options.offset or 0.0) * scale
        self._parts = [times, (rates, scale, offset)]
        for numbers, unit in (columns.acceleration_of(log, rates), columns.temperature_of(log)):
            self._parts.append((list(numbers), unit.factor, unit.offset))
        self._infer_rate(_columns(np.array(rows), *times))
        return rows

    def _read_names(self, first: str) -> int:
        """Recognise the names, and how lines are split; returns the number of header lines."""
        if first.startswith("{"):
            try:
                self._names = list(json.loads(first))
            except ValueError as error:
                text = f"expected a JSON object in the first line, got {first[:60]!r} ({error})"
                raise InputError(f"stream: {text}; send whole lines, or start again") from error
            self._split = self._of_json
            return 0
        separator = next((mark for mark in ",;\t" if mark in first), None)
        self._split = lambda line: line.split(separator)
        cells = [cell.strip() for cell in self._split(first)]
        header = any(np.isnan(_number(cell)) for cell in cells if cell)
        self._names = cells if header else [""] * len(cells)
        return int(header)

    def _of_json(self, line: str) -> list[Any]:
        try:
            content = json.loads(line)
            return [content[name] for name in self._names]
        except (ValueError, TypeError, KeyError):
            return []

    def _rows(self, lines: Sequence[str]) -> list[list[float]]:
        """Numbers of lines, NaN for cells that are none; lines of another shape are left out."""
        rows = [cells for cells in map(self._split, lines) if len(cells) == len(self._names)]
        self.bad += len(lines) - len(rows)
        return [[_number(cell) for cell in cells] for cells in rows]

    def _infer_rate(self, times: NDArray[np.float64] | None) -> None:
        """Set the rate from the times of the first lines, where no option gives it."""
        steps = np.zeros(1) if times is None else np.diff(times[np.isfinite(times)])
        step = float(np.median(steps)) if steps.size else 0.0
        if np.sum(np.abs(steps - step) < step / 10) < _REGULAR * steps.size:
            near = steps[(steps >= 0) & (steps <= 2 * step)]  # stamps of whole ms alternate
            step = near.sum() / max(near.size, 1)
        if self.rate_hz is None and not step > 0:
            text = "expected times that increase, in a column with a unit, or the rate, got neither"
            raise InputError(f"stream: {text}; give --rate, or --time-column and --time-units")
        measured = float(f"{1 / step:.4g}") if step > 0 else 0.0
        self.rate_hz = given = self.rate_hz or measured
        if measured and not 1 / _MOST_OFF < given / measured < _MOST_OFF:
            self.doubt = f"--rate {given:g}: the first times show {measured:g} samples a second"


def _times(file: Any) -> tuple[list[int], float, float]:
    """The first column of times by the rules of the readers, if its unit is known."""
    from gyro_pipeline.readers.stamps import stated_unit_s, time_columns  # noqa: PLC0415

    for number, unit_s, by_name in time_columns(file):
        if by_name and (factor := stated_unit_s(file) or unit_s):
            return [number], factor, 0.0
    return [], 1.0, 0.0


def _columns(
    table: NDArray[np.float64], columns: list[int], factor: float, offset: float
) -> NDArray[np.float64] | None:
    values = table[:, columns] * factor + offset
    return None if not columns else values if len(columns) > 1 else values[:, 0]


def _number(cell: Any) -> float:
    try:
        return float(cell)
    except (TypeError, ValueError):
        return np.nan
