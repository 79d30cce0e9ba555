"""Nodes of the raw-logs stage."""

import numpy as np
import xarray as xr

from gyro_pipeline.conventions import DIMENSIONS, InputError


def label_recordings(files: xr.Dataset) -> xr.Dataset:
    """Check what a source gives, so that later stages can rely on it.

    Args:
        files: Recordings from any source (see :mod:`gyro_pipeline.conventions`).

    Returns:
        The same, in the order of the conventions.

    Raises:
        InputError: If a recording holds NaN without being absent as a whole.
    """
    recordings = files.transpose(*DIMENSIONS)
    missing = np.isnan(recordings.angular_rate).sum(["axis", "sample"])
    partly = (missing > 0) & (missing < recordings.sizes["axis"] * recordings.sizes["sample"])
    for imu, recording in np.argwhere(partly.to_numpy()):
        raise InputError(
            f"{files.attrs['sensor']} IMU {int(files.imu[imu])} recording "
            f"{int(files.recording[recording])}: expected finite samples, got "
            f"{int(missing[imu, recording])} NaN; repair or leave out this recording"
        )
    return recordings
