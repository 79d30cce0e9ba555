from pathlib import Path

import numpy as np

from gyro_pipeline.logs import Log
from gyro_pipeline.parameters import ReaderOptions
from gyro_pipeline.readers.formats import READERS, Reader, check_format, reader_of
from gyro_pipeline.readers.tables import Table, open_table
from gyro_pipeline.readers.timing import Timing, check_rate, from_counter, from_stamps

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
    extra = [n for n in (layout.time, layout.temperature, layout.counter) if n is not None]
    columns = [*layout.rates, *(n for n in dict.fromkeys(extra) if n not in layout.rates)]
    values, damage = table.read(columns, lenient=layout.temperature)
    column = dict(zip(columns, values, strict=True))
    stamps = Timing() if layout.time is None else from_stamps(column[layout.time], layout.time_s)
    counts = Timing()
    if layout.counter is not None:
        counts = from_counter(column[layout.counter], layout.counter_bits)
    temperature_c = None
    if layout.temperature is not None and np.isfinite(column[layout.temperature]).any():
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
