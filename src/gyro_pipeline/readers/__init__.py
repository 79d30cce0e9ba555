from collections.abc import Sequence
from itertools import combinations
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from gyro_pipeline.conventions import InputError
from gyro_pipeline.logs import KEPT, Finding, Log
from gyro_pipeline.parameters import ReaderOptions
from gyro_pipeline.readers.clock import Timing, check_rate, from_counter, from_stamps
from gyro_pipeline.readers.formats import READERS, Reader, check_format, reader_of
from gyro_pipeline.readers.headers import listed
from gyro_pipeline.readers.tables import Table, open_table

__all__ = ["READERS", "Reader", "Table", "check_format", "read_log"]


def read_log(path: Path, options: ReaderOptions, expected_rate_hz: float | None = None) -> Log:
    """Read one recording from a logger's file.

    Samples are as found, a row each, with NaN, infinity and zeros; only a cut last line is left
    out. Rows that cannot be read are NaN.

    Args:
        path: The file; what it is, its content tells.
        options: What the header does not say, or says wrongly.
        expected_rate_hz: A measured sample rate that differs by more than
            ``options.rate_tolerance_pct`` is a REJECTED finding; None: not compared.

    Returns:
        The recording in deg/s.

    Raises:
        InputError: The file cannot be read, or is not told apart safely; says where and why.
    """
    table = open_table(path)
    layout = reader_of(table, options, path).layout(table, options, str(path))
    found_only = [
        number
        for number, given in (
            (layout.time, options.time_column),
            (layout.temperature, options.temperature_column),
        )
        if number is not None and given is None
    ]
    columns = [*layout.rates, layout.time, layout.temperature, layout.counter]
    column, damage = _read(table, columns, layout.temperature, found_only)
    stamps = Timing()
    if layout.time in column:
        stamps = from_stamps(column[layout.time], layout.time_s)
    counts = Timing()
    if layout.counter is not None:
        counts = from_counter(column[layout.counter], layout.counter_bits)
    temperature_c = None
    if layout.temperature in column and np.isfinite(column[layout.temperature]).any():
        a, b = layout.celsius
        temperature_c = a * column[layout.temperature] + b
    rate: tuple = ()
    if stamps.rate_hz is not None and expected_rate_hz is not None:
        rate = check_rate(stamps.rate_hz, expected_rate_hz, options.rate_tolerance_pct)
    return Log(
        samples=np.stack([column[n] for n in layout.rates]).T * layout.scale_dps,
        rate_hz=stamps.rate_hz,
        gap_rows=np.union1d(stamps.gap_rows, counts.gap_rows),
        temperature_c=temperature_c,
        findings=(*damage, *layout.findings, *stamps.findings, *counts.findings, *rate),
    )


def _read(
    table: Table, columns: Sequence[int | None], lenient: int | None, found_only: Sequence[int]
) -> tuple[dict[int | None, NDArray[np.float64]], tuple[Finding, ...]]:
    """Columns by number, without those that nobody asked for if they are the trouble."""
    wanted = list(dict.fromkeys(number for number in columns if number is not None))
    try:
        values, damage = table.read(wanted, lenient)
    except InputError as error:
        if error.__cause__ is not None:  # the file is the trouble
            raise
        for count in range(1, len(found_only) + 1):
            for without in combinations(found_only, count):
                others = [number for number in wanted if number not in without]
                try:
                    values, damage = table.read(others, lenient)
                except InputError:
                    continue
                text = f"{listed([table.names[n] for n in without])} left out: {error}"
                finding = Finding("columns", KEPT, text)
                return dict(zip(others, values, strict=True)), (*damage, finding)
        raise
    return dict(zip(wanted, values, strict=True)), damage
