"""Readers of loggers' files: a file in, a recording in deg/s out.

:func:`log_of` has all steps. A file is read as a table (``table``, with ``text``, ``lines``,
``stored`` and ``vehicles``). Names, units, the format and the options determine the columns of the
rates (``columns``) and their unit (``scales``). Then the rows that are samples are selected
(``rows``), their times are recognised by content (``stamps``, ``times``), and their values must be
plausible for a gyroscope (``counts``). Contradictions, such as rows of several devices, are
collected and refused together (``File.settle``) unless the options are trusted. Gaps (``clock``)
are listed in ``Log.gap_rows``; quality control keeps the longest stretch between two of them.
"""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from gyro_pipeline.logs import Log
from gyro_pipeline.parameters import ReaderOptions
from gyro_pipeline.readers.columns import Auxiliary, acceleration_of, rate_columns, temperature_of
from gyro_pipeline.readers.counts import check_values, to_signed
from gyro_pipeline.readers.file import File
from gyro_pipeline.readers.formats import FORMATS
from gyro_pipeline.readers.rows import check_single_device, sample_rows
from gyro_pipeline.readers.scales import scale_of
from gyro_pipeline.readers.stamps import compare_rates, counted_gaps, timing_of
from gyro_pipeline.readers.table import Table, read_table

__all__ = ["FORMATS", "Table", "log_of", "read_log"]

Floats = NDArray[np.float64]


def read_log(
    path: Path,
    options: ReaderOptions,
    expected_rate_hz: float | None = None,
    imu: int | None = None,
) -> Log:
    """Read a recording from a logger's file.

    Args:
        path: The file; its type is recognised by its content.
        options: Everything that the file does not say about itself.
        expected_rate_hz: A sample rate that differs by more than ``options.rate_tolerance_pct`` is
            a REJECTED finding; None: no comparison.
        imu: Number of the IMU, if ``options.columns`` names the columns of several.

    Returns:
        The recording in deg/s, with the NaN, infinity and zeros of the file.

    Raises:
        InputError: The file cannot be read, or is ambiguous; the message says where and why.
    """
    return log_of(read_table(path, options), options, expected_rate_hz, imu)


def log_of(
    table: Table,
    options: ReaderOptions,
    expected_rate_hz: float | None = None,
    imu: int | None = None,
) -> Log:
    """The recording in a table; arguments and errors are as for :func:`read_log`."""
    file = File(table, options)
    columns = rate_columns(file, imu)
    scale, are_counts = scale_of(file, columns)
    temperature, acceleration = temperature_of(file), acceleration_of(file, columns)
    numbers = [table.numbers(number) for number in columns]
    if len({*map(len, numbers)}) > 1:
        lengths = [len(column) for column in numbers]
        raise file.refusal(f"expected columns of equal length, got {lengths}; correct columns")
    raw = np.array(numbers).T
    keep = sample_rows(file, raw)
    timing = timing_of(file, keep)
    raw = raw if keep.all() else raw[keep]
    rates = _to_dps(file, raw, scale, timing.rate_hz or expected_rate_hz)
    check_values(file, raw, rates, are_counts)
    check_single_device(file, {*columns, *temperature[0], *acceleration[0]}, keep, rates)
    compare_rates(file, timing.rate_hz, expected_rate_hz, keep)
    file.settle()
    gap_rows = np.union1d(timing.gap_rows, counted_gaps(file, keep)).astype(np.intp)
    celsius = _auxiliary_values(file, temperature, keep)
    return Log(
        samples=rates,
        rate_hz=timing.rate_hz,
        gap_rows=gap_rows,
        temperature_c=None if celsius is None else celsius[:, 0],
        acceleration_g=_auxiliary_values(file, acceleration, keep),
        rows=None if keep.all() else np.flatnonzero(keep),
        findings=(*table.findings, *file.findings),
        lost=timing.lost,
    )


def _to_dps(file: File, raw: Floats, scale: float, rate_hz: float | None) -> Floats:
    """Convert the file's numbers to rates; increments are divided by the step between samples."""
    options = file.options
    if options.signed_bits is not None:
        raw = to_signed(file, raw, options.signed_bits)
    if options.offset is not None:
        raw = raw - options.offset
    if not options.increments:
        return raw * scale
    if rate_hz is None:
        text = "increments: true: the step between samples is not known; give time_column"
        raise file.refusal(text)
    file.note("increments", f"angles are divided by {1 / rate_hz:.6g} s, the step between samples")
    return raw * scale * rate_hz


def _auxiliary_values(file: File, auxiliary: Auxiliary, keep: NDArray[np.bool_]) -> Floats | None:
    """Temperatures in °C or accelerations in g, (n, k); None if they are missing or not numbers."""
    numbers, unit = auxiliary
    columns = [file.table.columns[number] for number in numbers]
    if not columns or any(c.dtype.kind != "f" or len(c) != len(keep) for c in columns):
        return None
    values = np.array(columns).T
    values *= unit.factor
    values += unit.offset
    values = values if keep.all() else values[keep]
    return values if np.isfinite(values).any() else None
