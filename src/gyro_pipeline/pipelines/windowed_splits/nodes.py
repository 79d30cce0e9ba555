"""Nodes of the windowed-splits stage. Windows are cut as views where they are used."""

import logging

import pandas as pd
import xarray as xr

from gyro_pipeline.conventions import AXES, TEST, TRAIN
from gyro_pipeline.fingerprints import data_hash
from gyro_pipeline.parameters import Splits
from gyro_pipeline.physics.bias import recording_mean, sample_sigma
from gyro_pipeline.protocol.recordings import cut, one_by_one, recordings_of_test_imu
from gyro_pipeline.protocol.splits import assign_roles, leave_one_device_out, refuse_copies

logger = logging.getLogger(__name__)


def cut_to_shortest(
    recordings: xr.Dataset, bias: pd.DataFrame, quality: pd.DataFrame
) -> tuple[xr.Dataset, pd.DataFrame]:
    """Recordings of one length, which studies need; the length and who set it are logged.

    Args:
        recordings: Of a length each; what is cut off stays in their file.
        bias: Their ground truth.
        quality: The table of the raw-logs stage, for the name of the shortest one's file.

    Returns:
        Recordings as long as the shortest one, and the biases and sample sigmas of what is left of
        them: the truth of a study is the mean of recordings of the study's length.
    """
    sensor, rate_hz = recordings.attrs["sensor"], recordings.attrs["rate_hz"]
    used = quality.dropna(subset="stop")
    lengths = (used["stop"] - used["start"]).to_numpy(int)
    shortest, longest = int(lengths.min()), int(lengths.max())
    if shortest == longest:
        logger.info("%s: all recordings are %.1f s", sensor, shortest / rate_hz)
        return recordings, bias
    first = used.iloc[int(lengths.argmin())]
    logger.info(
        "%s: recordings are %.1f to %.1f s; studies use the first %.1f s of each, the length of "
        "IMU %d recording %d, %s. quality.length_s rejects shorter ones",
        *(sensor, shortest / rate_hz, longest / rate_hz, shortest / rate_hz),
        *(first.imu, first.recording, first.file),
    )
    alike = cut(recordings, shortest)
    return alike, pd.concat(
        [
            pd.DataFrame(
                {
                    "sensor": sensor,
                    "imu": imu,
                    "recording": number,
                    "axis": list(AXES),
                    "bias_dps": recording_mean(samples),
                    "sample_sigma_dps": sample_sigma(samples),
                }
            )
            for imu, number, samples in one_by_one(alike)
        ],
        ignore_index=True,
    )


def split_recordings(recordings: xr.Dataset, splits: Splits) -> pd.DataFrame:
    """Roles of the recordings, by recording, before any window is cut.

    Recordings that the tested IMU lacks cannot test: they train, unless the source gave them to
    test.

    Args:
        recordings: With ``given_split`` where the source came split.
        splits: Counts and the seed.

    Returns:
        Columns ``fold, recording, role``.

    Raises:
        InputError: If no recording is left for a role, one is there twice, with two roles, or the
            tested IMU has none.
    """
    there, given = recordings_of_test_imu(recordings), _given(recordings)
    numbers = recordings.recording.to_numpy()
    roles = assign_roles(numbers[there].tolist(), splits, given)
    others = [n for n in numbers[~there].tolist() if given is None or given[n] != TEST]
    added = [(fold, number, TRAIN) for fold in roles.fold.unique() for number in others]
    if added:
        roles = pd.concat([roles, pd.DataFrame(added, columns=roles.columns)], ignore_index=True)
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
    """A hash of each recording of each IMU."""
    return {
        (imu, number): data_hash(samples, None) for imu, number, samples in one_by_one(recordings)
    }
