"""Samples from a pipe or a serial port, as lines of CSV or one JSON object per line."""

import json
import os
import select
import signal
import socket
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from itertools import chain
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gyro_pipeline.conventions import InputError

_HEADER_LINES = 20  # that columns and units are inferred from
_LEAST_S = 2.0  # of times that the rate is inferred from
_MOST_S = 10.0  # of times that the rate is compared with at once
_MOST_OFF = 1.1  # factor between the rate that is used and that of the times
_MOST_ROWS = 1000  # with one time, after which no other is awaited
_MOST_MISSING = 1.5  # factor between a rate and the mean one, from which it is that within bursts
_OF_FILES = {"increments", "repeats", "row", "rows", "signed_bits", "time_is"}  # options
_COMMENT = "#%/ "  # before a header
_SIGNALS = signal.SIGINT, signal.SIGTERM

Samples = list[Any]  # times (n,), rates (n, 3), accelerations (n, 3), temperatures (n,); or None


@contextmanager
def source(port: str | None, baud: int) -> Iterator[int]:
    """The file descriptor of a serial port, or of standard input.

    Raises:
        InputError: The port cannot be opened, or standard input is closed.
    """
    if port is None and sys.stdin is None:
        raise InputError("stream: expected standard input, but it is closed; give --port")
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


@contextmanager
def interruption() -> Iterator[int]:
    """A file descriptor to read from after SIGINT or SIGTERM; a second one acts as usual."""
    reading, writing = socket.socketpair()
    before = {number: signal.getsignal(number) for number in _SIGNALS}

    def end(*_: Any) -> None:
        writing.send(b" ")
        for number, handler in before.items():
            signal.signal(number, handler)

    with reading, writing:
        for number in _SIGNALS:
            signal.signal(number, end)
        try:
            yield reading.fileno()
        finally:
            end()


class Parser:
    """Finds the columns in the first lines, as the readers of files do, and parses all lines.

    Without ``rate_hz``, the rate is inferred from the times. ``bad`` counts lines of another shape;
    ``doubt`` says that the times contradict the rate; ``within`` that the first line may be the end
    of one.

    Raises:
        InputError: An option would change the samples of a file, but not those of a stream.
    """

    def __init__(self, options: Any, rate_hz: float | None, within: bool = False) -> None:
        for name in sorted(_OF_FILES & options.model_fields_set):
            text = f"--{name.replace('_', '-')}: expected a log file, got a stream"
            raise InputError(f"{text}; leave it out, or store the stream and use log")
        self.options, self.rate_hz, self.bad, self.doubt = options, rate_hz, 0, ""
        self._given, self._within, self._heard = rate_hz is not None, within, 0
        self._names: list[str] = []
        self._split: Callable[[str], list[Any]] = str.split  # a line into the cells of the names
        self._parts: list[tuple[list[int], float, float]] = []  # columns, factor, offset
        self._stamps = list[float]()  # of late

    def lines_of(
        self, descriptors: Sequence[int], timeout_s: float, say: Callable[[str], None]
    ) -> Iterator[list[str]]:
        """Complete lines, some at a time as they arrive from the first descriptor.

        They end when another descriptor can be read from, and where no usable sample came for a
        while, which is reported.
        """
        remainder, data, heard, since = b"", b" ", 0, time.monotonic()
        while data:
            if self._heard > heard:
                heard, since = self._heard, time.monotonic()
            silence_s = time.monotonic() - since
            ready = select.select(descriptors, [], [], max(timeout_s - silence_s, 0))[0]
            if not ready or silence_s > timeout_s:
                say(f"no usable sample came for {timeout_s:g} s; the result is from those before")
            if ready != [descriptors[0]] or silence_s > timeout_s:
                return
            try:
                data = os.read(descriptors[0], 1 << 16)
            except OSError as error:
                say(f"the connection broke ({error.strerror}); the result is from what came before")
                data = b""
            *lines, remainder = (remainder + data).split(b"\n") if data else (remainder, b"")
            yield [line.decode("utf-8", "replace").strip() for line in lines if line.strip()]

    def seconds(self, lines: Iterable[Sequence[str]]) -> Iterator[Samples]:
        """Samples, at most a second at a time.

        Raises:
            InputError: Columns, units or rate are unknown, or the rate changes; the message names
                the option to give.
        """
        lines, first = iter(lines), list[str]()
        for batch in lines:
            first += batch
            self._heard += len(batch)
            if len(first) > _HEADER_LINES:
                break
        if not first:
            return
        rows, batches = self._start(first), map(self._rows, lines)
        while self.rate_hz is None and self._awaits_times(rows):
            if (more := next(batches, None)) is None:
                break
            rows += more
            self._heard += len(more)
        if self.rate_hz is None:
            self._compare_rate(self._times(rows))
        step = max(round(self.rate_hz or 1), 1)
        for ready in chain([rows], batches):
            for start in range(0, len(ready), step):
                yield self._samples(np.array(ready[start : start + step]))

    def _samples(self, table: NDArray[np.float64]) -> Samples:
        times, rates, *others = (_columns(table, *part) for part in self._parts)
        usable = np.isfinite(rates).all(axis=1) & np.any(rates, axis=1)  # type: ignore[arg-type]
        if times is not None:
            usable &= np.isfinite(times)
            self._stamps += times[np.isfinite(times)].tolist()
        self._heard += int(usable.sum())
        if self._stamps and abs(self._stamps[-1] - self._stamps[0]) > _MOST_S:
            self.check_rate()
            del self._stamps[: len(self._stamps) // 2]
        return [times, rates, *others]

    def check_rate(self) -> None:
        """Compare the rate with the times of the last seconds, as :meth:`seconds` does at times."""
        if _ptp(stamps := np.array(self._stamps)) > _LEAST_S:
            self._compare_rate(stamps)

    def _start(self, lines: Sequence[str]) -> list[list[float]]:
        """Infer columns, units and rate from the first lines; returns the rows among them."""
        from gyro_pipeline.readers import columns, file, scales, table  # noqa: PLC0415

        rows = self._rows(lines[self._read_names(lines) :])
        if not rows:
            text = f"expected numbers in {len(self._names)} columns, got {lines[-1][:60]!r}"
            raise InputError(f"stream: {text}; correct the program that sends them")
        content = table.Table("stream", tuple(self._names), tuple(np.array(rows).T))
        log = file.File(content, self.options)
        rates = list(columns.rate_columns(log, None))
        scale, _ = scales.scale_of(log, rates)
        log.settle()
        times, offset = _time_column(log), -(self.options.offset or 0.0) * scale
        self._parts = [times, (rates, scale, offset)]
        for numbers, unit in (columns.acceleration_of(log, rates), columns.temperature_of(log)):
            self._parts.append((list(numbers), unit.factor, unit.offset))
        return rows

    def _read_names(self, lines: Sequence[str]) -> int:
        """Recognise the names, and how lines are split; returns the number of the first row.

        Most lines have the shape of a row; a header is a line of that shape without numbers.
        """
        shape, _ = Counter(map(_shape, lines)).most_common(1)[0]
        alike = [number for number, line in enumerate(lines) if _shape(line) == shape]
        if shape == ("{", 0):
            self._split = self._of_json
            for number in alike:
                with suppress(ValueError):
                    self._names = list(json.loads(lines[number]))
                    return number
            text = f"expected JSON objects, got {lines[alike[0]][:60]!r}"
            raise InputError(f"stream: {text}; correct the program that sends them")
        self._split = lambda line: line.split(shape[0])
        for number in alike:
            cells = [cell.strip() for cell in self._split(lines[number].lstrip(_COMMENT))]
            if not any(map(_is_number, cells)):
                self._names = cells
                return number + 1
        self._names = [""] * shape[1]
        return int(self._within)

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

    def _times(self, rows: list[list[float]]) -> NDArray[np.float64]:
        """The finite times of rows; empty without a column of times."""
        times = _columns(np.array(rows), *self._parts[0])
        return np.empty(0) if times is None else times[np.isfinite(times)]

    def _awaits_times(self, rows: list[list[float]]) -> bool:
        """Whether more times are needed to infer the rate: of a second, or of several bursts."""
        stamps = self._times(rows)
        lasts_s = _ptp(stamps)
        if not lasts_s:
            return 0 < stamps.size < _MOST_ROWS
        return lasts_s < _LEAST_S or (lasts_s < _MOST_S and not _is_even(*_rates_of(stamps)))

    def _compare_rate(self, stamps: NDArray[np.float64]) -> None:
        """Compare the rate with that of times, by the rule for files, or infer it from them."""
        measured, mean = _rates_of(stamps)
        if self.rate_hz is None and not _is_even(measured, mean):
            text = "expected times at even steps, in a column with a unit, or the rate, got neither"
            raise InputError(f"stream: {text}; give --rate, or --time-column and --time-units")
        self.rate_hz = used = self.rate_hz or measured
        if any(1 / _MOST_OFF < used / rate < _MOST_OFF for rate in (measured, mean) if rate):
            return
        got = f"{measured or mean:g} samples a second"
        if not self._given:
            text = f"expected times at one rate, got {got} after {used:g}"
            raise InputError(f"stream: {text}; give --rate, or send at one rate")
        self.doubt = f"--rate {used:g}: the times show {got}"


def _rates_of(stamps: NDArray[np.float64]) -> tuple[float, float]:
    """The rate by the rule for files, without gaps, and the mean rate; 0 where unknown."""
    from gyro_pipeline.readers.clock import from_stamps  # noqa: PLC0415

    if not _ptp(stamps):
        return 0.0, 0.0
    rate, mean = from_stamps(stamps, 1.0).rate_hz or 0.0, (stamps.size - 1) / _ptp(stamps)
    return float(f"{rate:.4g}"), float(f"{mean:.4g}")


def _is_even(rate: float, mean: float) -> bool:
    """Whether a rate is not that within bursts."""
    return 0 < rate < _MOST_MISSING * mean


def _time_column(file: Any) -> tuple[list[int], float, float]:
    """The first column of times by the rules of the readers, if its unit is known."""
    from gyro_pipeline.readers.stamps import stated_unit_s, time_columns  # noqa: PLC0415

    for number, unit_s, by_name in time_columns(file):
        if by_name and (factor := stated_unit_s(file) or unit_s):
            return [number], factor, 0.0
    return [], 1.0, 0.0


def _ptp(values: NDArray[np.float64]) -> float:
    return float(np.ptp(values)) if values.size else 0.0


def _columns(
    table: NDArray[np.float64], columns: list[int], factor: float, offset: float
) -> NDArray[np.float64] | None:
    values = table[:, columns] * factor + offset
    return None if not columns else values if len(columns) > 1 else values[:, 0]


def _shape(line: str) -> tuple[str | None, int]:
    """The separator of the cells of a line and their number; 0 for an object of JSON."""
    if line.startswith("{"):
        return "{", 0
    line = line.lstrip(_COMMENT)
    separator = next((mark for mark in ",;\t" if mark in line), None)
    return separator, len(line.split(separator))


def _is_number(cell: str) -> bool:
    return not np.isnan(_number(cell)) or cell.lower() == "nan"


def _number(cell: Any) -> float:
    try:
        return float(cell)
    except (TypeError, ValueError):
        return np.nan
