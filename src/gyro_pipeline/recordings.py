"""Functions on recordings of different lengths: to cut them, and to go through them one by one."""

from collections.abc import Callable, Iterator, Mapping

import numpy as np
import pandas as pd
import xarray as xr
from numpy.typing import NDArray

from gyro_pipeline.conventions import AXES
from gyro_pipeline.fingerprints import fingerprint
from gyro_pipeline.logs import with_recordings
from gyro_pipeline.physics.bias import recording_mean, sample_sigma


def tested_imu(recordings: xr.Dataset) -> int:
    """The IMU whose recordings test: the first, as IMU 1 of the paper (section IV-B)."""
    return int(recordings.imu[0])


def common_length(recordings: xr.Dataset) -> int:
    """The length to which studies cut all recordings, in samples.

    This length keeps the most samples in total. Shorter recordings are left out, so that a single
    short recording does not shorten all others.
    """
    lengths = np.sort(recordings["samples"].to_numpy().ravel())
    counts = np.arange(len(lengths), 0, -1)  # recordings of at least each length
    return int(lengths[np.argmax(lengths * counts)])


def iterate_recordings(recordings: xr.Dataset) -> Iterator[tuple[int, int, NDArray[np.floating]]]:
    """Iterate over all existing recordings with one in memory at a time.

    Yields:
        IMU, recording number and samples (axis, n), deg/s, of the recording's full length; NaN
        where masked.
    """
    rates = recordings.angular_rate.transpose("imu", "recording", "axis", "sample")
    lengths = recordings["samples"].transpose("imu", "recording").to_numpy()
    imus, numbers = (recordings[name].to_numpy().tolist() for name in ("imu", "recording"))
    for imu, number in np.argwhere(lengths > 0).tolist():
        stretch = slice(int(lengths[imu, number]))
        yield imus[imu], numbers[number], rates[imu, number, :, stretch].to_numpy()


def cut_to_length(recordings: xr.Dataset, length: int) -> xr.Dataset:
    """Cut recordings to a length in samples and drop shorter ones, without reading samples."""
    samples = recordings["samples"].load()
    if bool(((samples == length) | (samples == 0)).all()):
        return recordings.isel(sample=slice(length))
    data_hash = fingerprint([recordings.attrs["data_hash"], length])
    part = recordings.isel(sample=slice(length)).assign(samples=(samples >= length) * length)
    return with_recordings(part.assign_attrs(data_hash=data_hash))


def bias_rows(
    recordings: xr.Dataset,
    more: Callable[[int, NDArray[np.floating]], Mapping[str, NDArray[np.float64]]] | None = None,
) -> pd.DataFrame:
    """The mean of each recording, the ground truth of the paper.

    Args:
        recordings: Angular rates, deg/s.
        more: Computes further columns from the IMU's number and the samples (axis, n).

    Returns:
        A row per existing recording and axis: ``sensor, imu, recording, axis``, ``bias_dps`` and
        ``sample_sigma_dps``.
    """
    tables = [
        pd.DataFrame(
            {
                **{"sensor": recordings.attrs["sensor"], "imu": imu, "recording": number},
                **{"axis": list(AXES), "bias_dps": recording_mean(samples)},
                "sample_sigma_dps": sample_sigma(samples),
                **(more(imu, samples) if more else {}),
            }
        )
        for imu, number, samples in iterate_recordings(recordings)
    ]
    return pd.concat(tables, ignore_index=True)
