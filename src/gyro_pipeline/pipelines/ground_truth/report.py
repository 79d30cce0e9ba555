"""What the ground-truth stage prints."""

import logging

import numpy as np
import pandas as pd
import xarray as xr

from gyro_pipeline.conventions import AXES
from gyro_pipeline.logs import REJECTED
from gyro_pipeline.quality.rejections import reasons

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
        most: Number of biases that are printed; more are counted. Of the rejected recordings each
            reason is printed once.
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
    if len(table) > most:
        lines.append(f"{len(table) - most} more are in the table of biases")
    lines += [f"rejected: {reason}" for reason in reasons(quality[quality.outcome == REJECTED])]
    logger.info("%s: biases ± standard errors, deg/s\n%s", sensor, "\n".join(lines))


def _with_error(value: float, error: float) -> str:
    """A value and its standard error, of which two digits are given."""
    if not error > 0:
        return f"{value:.5f} ± –"
    digits = max(0, 1 - int(np.floor(np.log10(error))))
    return f"{value:.{digits}f} ± {error:.{digits}f}"
