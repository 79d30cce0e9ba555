"""Nodes of the windowed-splits stage: which windows train, validate and test."""

import logging
from collections.abc import Mapping
from typing import Any

import numpy as np
import pandas as pd
import xarray as xr

from gyro_pipeline.conventions import (
    ORIGIN_REAL,
    ORIGIN_VIRTUAL,
    TEST,
    TRAIN,
    UNUSED,
    InputError,
)
from gyro_pipeline.parameters import Only, Splits, Study
from gyro_pipeline.pipelines.windowed_splits.copies import SAMPLES as COMPARED
from gyro_pipeline.pipelines.windowed_splits.copies import near_copies
from gyro_pipeline.pipelines.windowed_splits.protocols import (
    PROTOCOLS,
    Candidates,
    check_table,
)
from gyro_pipeline.recordings import (
    bias_rows,
    common_length,
    cut_to_length,
    iterate_recordings,
    tested_imu,
)
from gyro_pipeline.studies import study_rows
from gyro_pipeline.windows import describe_losses, usable_windows, window_size

logger = logging.getLogger(__name__)

_KEYS = ["imu", "recording"]

WINDOWS_TABLE = [
    "protocol",
    "window_s",
    "window_stride_s",
    "fold",
    "role",
    "origin",
    *_KEYS,
    "start",
]
"""Columns of a windows table."""

_COMPACT = dict.fromkeys(["protocol", "fold", "role", "origin"], "category") | dict.fromkeys(
    [*_KEYS, "start"], "int32"
)


def cut_to_common_length(
    recordings: xr.Dataset, bias: pd.DataFrame, quality: pd.DataFrame
) -> tuple[xr.Dataset, pd.DataFrame, pd.DataFrame]:
    """Cut recordings to one length, which studies need, and list masked samples and copies.

    The length, and the recording that sets it, are logged.

    Args:
        recordings: Recordings of different lengths.
        bias: Ground truth of the recordings.
        quality: The quality table, for the file names of the recordings.

    Returns:
        Recordings of the length that keeps most samples, with their means, the labels in training.
        Their ground truth, measured again if they were cut. And a row for each recording:
        ``imu, recording``; ``masked``, the numbers of its masked samples; and ``copies``, the rows
        of its copies among the recordings before it, with their correlation.
    """
    length, lengths = common_length(recordings), recordings["samples"].to_numpy()
    lengths, rate_hz = lengths[lengths > 0], recordings.attrs["rate_hz"]
    equal = cut_to_length(recordings, length)
    if (lengths != length).any():
        _log_lengths(recordings.attrs["sensor"], quality, length, rate_hz)
        bias = bias_rows(equal)
    else:
        logger.info("%s: all recordings are %.1f s", recordings.attrs["sensor"], length / rate_hz)
    means = bias.set_index([*_KEYS, "axis"]).bias_dps.to_xarray()
    equal = equal.assign(recording_mean=means.reindex_like(equal[[*_KEYS, "axis"]]))
    rows: list[tuple[Any, ...]] = []
    starts = []
    for imu, number, rates in iterate_recordings(equal):
        rows.append((imu, number, np.flatnonzero(np.isnan(rates).any(axis=0)), []))
        starts.append(rates[:, :COMPARED])
    for pair in near_copies(np.stack(starts)):
        rows[pair.second][-1].append((pair.first, pair.correlation))
    return equal, bias, pd.DataFrame(rows, columns=[*_KEYS, "masked", "copies"])


def _log_lengths(sensor: str, quality: pd.DataFrame, length: int, rate_hz: float) -> None:
    """Log the length to which recordings are cut, which one sets it, and which are too short."""
    used = quality.dropna(subset="stop")
    lengths = (used["stop"] - used["start"]).to_numpy(int)
    first = used.iloc[int(np.flatnonzero(lengths == length)[0])]
    shorter = used[lengths < length]
    left_out = [
        f"IMU {row.imu} recording {row.recording} ({row.file})" for row in shorter.itertuples()
    ]
    logger.info(
        "%s: recordings are %.1f to %.1f s; studies use the first %.1f s of each, the length of "
        "IMU %d recording %d, %s, which keeps most samples%s. quality.length_s sets another length",
        *(sensor, lengths.min() / rate_hz, lengths.max() / rate_hz, length / rate_hz),
        *(first.imu, first.recording, first.file),
        f", and leave out {', '.join(left_out[:5])}{', …' * (len(left_out) > 5)}" * bool(left_out),  # noqa: PLR2004
    )


def split_windows(  # noqa: PLR0917 - a node's arguments are its datasets
    study: Study,
    recordings: xr.Dataset,
    contents: pd.DataFrame,
    splits: Splits,
    windows_s: list[float],
    only: Only,
    virtual: xr.Dataset | None = None,
) -> pd.DataFrame:
    """Make the windows table of a study: which windows train, validate and test.

    Args:
        study: The study with its protocol, windows and strides.
        recordings: Real recordings, all of one length.
        contents: Masked samples and copies, from :func:`cut_to_common_length`.
        splits: Counts, the seed, and which windows train.
        windows_s: Window lengths, if the study sets none.
        only: Filters of the study.
        virtual: Virtual recordings, all of whose windows train, if the study uses some.

    Returns:
        A row per window and fold; see :mod:`gyro_pipeline.conventions`.

    Raises:
        InputError: No window can be used, or the table breaks its protocol.
    """
    sensor, source = recordings.attrs["sensor"], recordings.attrs["source"]
    seed = only.seed or 0  # windows have no seed, but rows must match the filter
    rows = study_rows(study, sensor, source, windows_s, [seed], only)
    drawn_from = [] if virtual is None else np.atleast_1d(virtual.attrs["drawn_from"]).tolist()
    splits = study.splits_of(splits)
    tables = []
    for protocol, window_s, stride_s in dict.fromkeys(
        (row.protocol, row.window_s, row.window_stride_s) for row in rows
    ):
        size, stride = sizes_of(window_s, stride_s, recordings)
        table = _real_windows(study, protocol, size, stride, recordings, contents, splits)
        if virtual is not None:
            folds = table[["fold"]].drop_duplicates()
            virtual_table = _virtual_windows(virtual, size, splits).merge(folds, how="cross")
            table = pd.concat([table, virtual_table])
        if column := PROTOCOLS[protocol].single_role:
            check_table(table, column, contents, drawn_from)
        tables.append(table.assign(protocol=protocol, window_s=window_s, window_stride_s=stride_s))
    return pd.concat(tables, ignore_index=True)[WINDOWS_TABLE].astype(_COMPACT)


def sizes_of(window_s: float, stride_s: float, recordings: xr.Dataset) -> tuple[int, int]:
    """Window length and stride in samples.

    Raises:
        InputError: A window is longer than a recording, or the stride is less than a sample.
    """
    rate_hz, sensor = recordings.attrs["rate_hz"], recordings.attrs["sensor"]
    size = window_size(window_s, rate_hz, recordings.sizes["sample"], sensor)
    stride = round(stride_s * rate_hz)
    if stride < 1:
        raise InputError(
            f"{sensor}: a window stride of {stride_s:g} s is less than half a sample at "
            f"{rate_hz:.5g} Hz; choose strides above {0.5 / rate_hz:.2g} s"
        )
    return size, stride


def _real_windows(  # noqa: PLR0917 - everything that a table depends on
    study: Study,
    protocol: str,
    size: int,
    stride: int,
    recordings: xr.Dataset,
    contents: pd.DataFrame,
    splits: Splits,
) -> pd.DataFrame:
    """Windows of real recordings in each fold: ``fold, role, origin, imu, recording, start``."""
    samples, rate_hz = recordings.sizes["sample"], recordings.attrs["rate_hz"]
    label = f"{study.experiment} {recordings.attrs['sensor']}, {size / rate_hz:g} s windows"
    if losses := describe_losses(contents, samples, size):
        logger.warning("%s: %s", label, losses)
    split, imu, used = _split(recordings), tested_imu(recordings), contents
    if study.recordings is not None:
        split, used = None, _first_recordings(contents, samples, size, imu, study)
    windows = usable_windows(used, samples, size, stride)
    numbers = sorted(windows.recording[windows.imu == imu].unique().tolist())

    def in_folds(windows: pd.DataFrame) -> pd.DataFrame:
        candidates = Candidates(windows, split, imu, numbers, splits)
        folds = [
            windows[roles != UNUSED].assign(fold=fold, role=roles[roles != UNUSED])
            for fold, roles in PROTOCOLS[protocol].folds(candidates)
        ]
        return pd.concat(folds, ignore_index=True).assign(origin=ORIGIN_REAL)

    tested = in_folds(windows)
    if not (tested.role == TEST).any():
        raise InputError(
            f"{label}: no test recording has a usable window; lower windows_s of the study, or "
            "bring recordings that lost fewer samples"
        )
    if splits.training_windows == "all":
        return tested
    if splits.training_windows == "first":
        trained = tested[tested.role != TEST]
        first = trained.groupby(["fold", *_KEYS]).start.transform("min") == trained.start
        return pd.concat([trained[first], tested[tested.role == TEST]])
    training_stride = round(splits.training_windows * rate_hz)
    trained = in_folds(usable_windows(used, samples, size, max(training_stride, 1)))
    return pd.concat([trained[trained.role != TEST], tested[tested.role == TEST]])


def _first_recordings(
    contents: pd.DataFrame, samples: int, size: int, tested: int, study: Study
) -> pd.DataFrame:
    """The first recordings of the tested IMU with a window, in the number that the study uses."""
    contents = contents[contents.imu == tested]
    usable = usable_windows(contents, samples, size, size).recording.unique()
    return contents[contents.recording.isin(usable)].iloc[: study.recordings]


def _virtual_windows(virtual: xr.Dataset, size: int, splits: Splits) -> pd.DataFrame:
    """Windows of the virtual recordings, all of which train."""
    rate_hz, samples = virtual.attrs["rate_hz"], virtual.sizes["sample"]
    strides = {"all": size, "first": samples}
    stride = strides.get(str(splits.training_windows)) or max(
        round(float(splits.training_windows) * rate_hz), 1
    )
    starts = range(0, samples - size + 1, stride)
    numbers = range(1, 1 + int(virtual.attrs["train_recordings"]))
    index = pd.MultiIndex.from_product(
        [virtual.imu.to_numpy(), numbers, starts], names=[*_KEYS, "start"]
    )
    return index.to_frame(index=False).assign(role=TRAIN, origin=ORIGIN_VIRTUAL)


def _split(recordings: xr.Dataset) -> Mapping[int, str] | None:
    """The role of each recording in a hold-out; None for a k-fold."""
    if "split" not in recordings.coords:
        return None
    numbers = recordings.recording.to_numpy().tolist()
    return dict(zip(numbers, recordings.split.to_numpy().tolist(), strict=True))
