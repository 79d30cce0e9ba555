"""Stand-in until the readers are merged."""

from pathlib import Path

import numpy as np
import pandas as pd

from gyro_pipeline.conventions import InputError
from gyro_pipeline.logs import Log
from gyro_pipeline.parameters import ReaderOptions


def read_log(path: Path, options: ReaderOptions, expected_rate_hz: float) -> Log:
    """DOT files only."""
    try:
        table = pd.read_csv(path, usecols=["Time", "w_x", "w_y", "w_z"], skipinitialspace=True)
    except Exception as error:
        raise InputError(f"{path}: {error}") from error
    samples = table[["w_x", "w_y", "w_z"]].to_numpy(np.float64)
    return Log(samples, float(1 / np.median(np.diff(table.Time))))
