"""Nodes of the windowed-splits stage. Windows are cut as views where they are used."""

import logging

import numpy as np
import pandas as pd
import xarray as xr

from gyro_pipeline.fingerprints import data_hash
from gyro_pipeline.parameters import Splits
from gyro_pipeline.protocol.splits import assign_roles, leave_one_device_out, refuse_copies

logger = logging.getLogger(__name__)


def split_recordings(recordings: xr.Dataset, splits: Splits) -> pd.DataFrame:
    """Roles of the recordings, by recording, before any window is cut.

    Args:
        recordings: With ``given_split`` where the source came split.
        splits: Counts and the seed.

    Returns:
        Columns ``fold, recording, role``.

    Raises:
        InputError: If no recording is left for a role, or one is there twice, with two roles.
    """
    numbers = recordings.recording.to_numpy().tolist()
    roles = assign_roles(numbers, splits, _given(recordings))
    refuse_copies(_contents(recordings), roles)
    return roles


def split_devices(recordings: xr.Dataset, splits: Splits) -> pd.DataFrame:
    """Roles of the recordings where every IMU in turn is an unseen device.

    Args:
        recordings: With ``given_split`` where the source came split.
        splits: Counts.

    Returns:
        Columns ``fold`` (the unseen IMU), ``imu``, ``recording``, ``role``.

    Raises:
        InputError: Fewer than two IMUs, or a recording that is there twice, with two roles.
    """
    contents = _contents(recordings)
    present: dict[int, list[int]] = {}
    for imu, number in sorted(contents):
        present.setdefault(imu, []).append(number)
    roles = leave_one_device_out(present, splits, _given(recordings))
    untested = sorted(set(present) - set(roles.fold))
    if untested:
        logger.info(
            "%s: IMUs %s have no test recording and only train",
            *(recordings.attrs["sensor"], ", ".join(map(str, untested))),
        )
    refuse_copies(contents, roles)
    return roles


def _given(recordings: xr.Dataset) -> dict[int, str] | None:
    """The role of each recording, where the source came split."""
    if "given_split" not in recordings:
        return None
    numbers = recordings.recording.to_numpy().tolist()
    return dict(zip(numbers, recordings.given_split.to_numpy().tolist(), strict=True))


def _contents(recordings: xr.Dataset) -> dict[tuple[int, int], str]:
    """A hash of each recording of each IMU, without those that an IMU lacks."""
    contents = {}
    for number in recordings.recording.to_numpy().tolist():
        rates = recordings.angular_rate.sel(recording=number).load()
        for imu in recordings.imu.to_numpy().tolist():
            samples = rates.sel(imu=imu).to_numpy()
            if not np.isnan(samples[0, 0]):
                contents[imu, number] = data_hash(samples, None)
    return contents
