"""Recordings of a length each, one by one, and cut to one length."""

from collections.abc import Iterator

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from gyro_pipeline.conventions import TEST_IMU, InputError
from gyro_pipeline.fingerprints import fingerprint


def present(recordings: xr.Dataset) -> xr.DataArray:
    """Whether an IMU has a recording, (imu, recording)."""
    return recordings["samples"].transpose("imu", "recording").load() > 0


def recordings_of_test_imu(recordings: xr.Dataset) -> NDArray[np.bool_]:
    """Which recordings the tested IMU has, (recording,).

    Raises:
        InputError: It has none.
    """
    imus = recordings.imu.to_numpy().tolist()
    if TEST_IMU not in imus:
        raise InputError(
            f"{recordings.attrs['sensor']}: expected recordings of IMU {TEST_IMU}, which studies "
            f"test, got IMUs {', '.join(map(str, imus))}. Write {{imu:name}} for {{imu}} in the "
            "pattern of the catalog entry in catalog.yml, which numbers them from 1 in their order"
        )
    return np.asarray(present(recordings).sel(imu=TEST_IMU).to_numpy())


def one_by_one(recordings: xr.Dataset) -> Iterator[tuple[int, int, NDArray[np.floating]]]:
    """Recordings that are there, one in memory at a time.

    Yields:
        IMU, number and samples (axis, n), deg/s, of the recording's own length; NaN where masked.
    """
    rates = recordings.angular_rate.transpose("imu", "recording", "axis", "sample")
    lengths = recordings["samples"].transpose("imu", "recording").to_numpy()
    imus, numbers = (recordings[name].to_numpy().tolist() for name in ("imu", "recording"))
    for imu, number in np.argwhere(lengths > 0).tolist():
        stretch = slice(int(lengths[imu, number]))
        yield imus[imu], numbers[number], rates[imu, number, :, stretch].to_numpy()


def cut(recordings: xr.Dataset, length: int) -> xr.Dataset:
    """The first so many samples of each recording; none may be shorter. Nothing is read."""
    if length == recordings.sizes["sample"]:
        return recordings
    part = recordings.isel(sample=slice(length))
    changed = fingerprint([recordings.attrs["data_hash"], length])
    return part.assign(samples=part["samples"].clip(max=length)).assign_attrs(data_hash=changed)
