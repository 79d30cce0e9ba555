"""What the ground-truth stage prints."""

import logging

import numpy as np
import pandas as pd
import xarray as xr

from gyro_pipeline.conventions import AXES
from gyro_pipeline.logs import REJECTED

logger = logging.getLogger(__name__)

_PLACE = ["imu", "recording"]


def report_biases(
    recordings: xr.Dataset, bias: pd.DataFrame, quality: pd.DataFrame, most: int = 20
) -> None:
    """Print the bias of every recording and axis with its standard error, in deg/s.

    Args:
        recordings: For the sensor and its sample rate.
        bias: The ground truth of all recordings.
        quality: A row per recording: its outcome, which rows are used and how many masked.
        most: Number of recordings that are printed, of the used and of the rejected; more are
            counted.
    """
    sensor, rate_hz = recordings.attrs["sensor"], recordings.attrs["rate_hz"]
    texts = list(map(_with_error, bias.bias_dps, bias.standard_error_dps))
    table = bias.assign(text=texts).pivot(index=_PLACE, columns="axis", values="text")
    table = table.reset_index().merge(quality, on=_PLACE)
    table["seconds"] = [f"{rows / rate_hz:.2f}" for rows in table["stop"] - table["start"]]
    columns = [*_PLACE, *AXES, "seconds", "outcome", *table.columns.intersection(["masked"])]
    whole = table[columns].head(most).convert_dtypes()  # counts are floats beside rejected rows
    lines = [whole.to_string(index=False)]
    if bias.standard_error_dps.isna().any():
        lines.append("± –: no standard error, the recordings are too short to fit their noise")
    rejected = quality[quality.outcome == REJECTED]
    for row in rejected.head(most).itertuples():
        where = f"IMU {row.imu} recording {row.recording}, {row.file}"
        lines.append(f"rejected: {where}: {row.findings}")
    for rows, name in ((table, "biases"), (rejected, "their quality")):
        if len(rows) > most:
            lines.append(f"{len(rows) - most} more are in the table of {name}")
    logger.info("%s: biases ± standard errors, deg/s\n%s", sensor, "\n".join(lines))


def _with_error(value: float, error: float) -> str:
    """A value and its standard error, of which two digits are given."""
    if not error > 0:
        return f"{value:.5f} ± –"
    digits = max(0, 1 - int(np.floor(np.log10(error))))
    return f"{value:.{digits}f} ± {error:.{digits}f}"
