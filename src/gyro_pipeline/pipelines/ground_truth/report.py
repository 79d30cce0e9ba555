"""The report of the ground-truth stage on the terminal."""

import logging

import numpy as np
import pandas as pd
import xarray as xr

from gyro_pipeline.conventions import AXES
from gyro_pipeline.logs import REJECTED
from gyro_pipeline.quality.rejections import reasons

logger = logging.getLogger(__name__)

_KEYS = ["imu", "recording"]


def report_biases(
    recordings: xr.Dataset, bias: pd.DataFrame, quality: pd.DataFrame, most: int = 20
) -> None:
    """Print the bias of every recording and axis with its standard error, in deg/s.

    Args:
        recordings: Recordings with the name and the rate of the sensor.
        bias: The ground truth of all recordings.
        quality: A row per recording with its outcome, the rows used and how many are masked.
        most: Maximum number of recordings that are printed; the others are counted. Each reason
            for a rejection is printed once.
    """
    sensor, rate_hz = recordings.attrs["sensor"], recordings.attrs["rate_hz"]
    texts = list(map(_with_error, bias.bias_dps, bias.standard_error_dps))
    table = bias.assign(text=texts).pivot(index=_KEYS, columns="axis", values="text")
    table = table.reset_index().merge(quality, on=_KEYS)
    table["seconds"] = [f"{rows / rate_hz:.2f}" for rows in table["stop"] - table["start"]]
    columns = [*_KEYS, *AXES, "seconds", "outcome", *table.columns.intersection(["masked"])]
    first = table[columns].head(most).convert_dtypes()  # counts are floats beside rejected rows
    lines = [first.to_string(index=False)]
    if bias.standard_error_dps.isna().any():
        lines.append("± –: no standard error, the recordings are too short to fit their noise")
    if len(table) > most:
        lines.append(f"{len(table) - most} more are in the table of biases")
    lines += [f"rejected: {reason}" for reason in reasons(quality[quality.outcome == REJECTED])]
    logger.info("%s: biases ± standard errors, deg/s\n%s", sensor, "\n".join(lines))


def _with_error(value: float, error: float) -> str:
    """A value and its standard error, with two digits of the error."""
    if not error > 0:
        return f"{value:.5f} ± –"
    digits = max(0, 1 - int(np.floor(np.log10(error))))
    return f"{value:.{digits}f} ± {error:.{digits}f}"
