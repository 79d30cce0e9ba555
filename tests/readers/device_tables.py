"""Small tables of a device at rest."""

import numpy as np

from gyro_pipeline.parameters import ReaderOptions
from gyro_pipeline.readers import log_of
from gyro_pipeline.readers.table import Table

BIAS = np.array([0.7, -0.4, 0.15])


def still(rows=6000, bias=BIAS, seed=0):
    """(rows, 3), deg/s, of a device at rest."""
    return np.random.default_rng(seed).normal(bias, 0.05, (rows, 3))


def table(header, *columns, preamble=""):
    """A table of vectors, matrices and lists of texts, with a header of names between commas."""
    split = []
    for column in columns:
        array = np.array(column, object) if isinstance(column, list) else np.asarray(column)
        split += list(array.T) if array.ndim > 1 else [array]
    typed = tuple(c if c.dtype.kind in "OmM" else c.astype(float) for c in split)
    names = tuple(header.split(",")) if header else ("",) * len(typed)
    assert len(names) == len(typed)
    return Table("log.csv", names, typed, preamble)


def read(header, *columns, preamble="", rate_hz=None, imu=None, **options):
    """A recording from such a table, with options by name."""
    file = table(header, *columns, preamble=preamble)
    return log_of(file, ReaderOptions(**options), rate_hz, imu)


def said(log, check):
    """Details of the findings of a check."""
    return [finding.detail for finding in log.findings if finding.check == check]
