"""Protocols: functions that decide which windows train, validate and test in each fold.

Without a leak, a recording (of all IMUs, which were recorded together) or a device has only one
role in a fold. The leaks of the leak study break this rule on purpose. One of them yields a fold
twice, once for each role of its windows.

A run has one fit for each fold. The fit to a hold-out is also the model that users load. A protocol
of several folds ends with the fold ALL_RECORDINGS, in which nothing tests and whose fit is the
model; leaks have no model for use, so the first fold stands for it.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from gyro_pipeline.conventions import (
    ALL_RECORDINGS,
    BEST_EPOCH_ON_TEST,
    BY_RECORDING,
    HOLD_OUT,
    K_FOLD,
    LEAVE_ONE_DEVICE_OUT,
    ORIGIN_REAL,
    TEST,
    TEST_IN_TRAINING,
    TRAIN,
    UNUSED,
    VALIDATION,
    WINDOW_SPLIT,
    InputError,
)
from gyro_pipeline.parameters import Splits
from gyro_pipeline.splits import choose_validation, split_at_random

Texts = NDArray[np.object_]
Folds = Iterator[tuple[str, Texts]]
"""The name of each fold, and the roles (n,) of all windows in it."""


@dataclass(frozen=True)
class Candidates:
    """The windows that a protocol assigns to roles."""

    windows: pd.DataFrame  # a row per usable window of a real recording: imu, recording, start
    split: Mapping[int, str] | None  # role of each recording in a hold-out; None for a k-fold
    tested: int  # the IMU whose recordings test
    numbers: Sequence[int]  # recordings of this IMU that can test, in order
    splits: Splits  # counts, and the seed of all random choices

    def roles(self, of_recordings: Mapping[int, str]) -> Texts:
        """Roles of windows by their recordings; only the tested IMU tests."""
        roles = self.windows.recording.map(of_recordings).fillna(UNUSED).to_numpy(object)
        return np.where((roles == TEST) & (self.windows.imu != self.tested), UNUSED, roles)


def by_recording(candidates: Candidates) -> Folds:
    """Hold out the test recordings of the split; without a split, every recording tests once.

    Recordings that the tested IMU lacks cannot test: in a k-fold they train in every fold.
    """
    if candidates.split is not None:
        yield HOLD_OUT, candidates.roles(candidates.split)
        return
    numbers, splits = candidates.numbers, candidates.splits
    if len(numbers) <= splits.leave_one_out_up_to:
        parts = [[number] for number in numbers]
    else:
        positions = split_at_random(len(numbers), splits.folds, splits.split_seed)
        parts = [sorted(numbers[position] for position in part) for part in positions]
    others = dict.fromkeys(candidates.windows.recording.unique().tolist(), TRAIN)
    for fold, test in enumerate([*parts, []]):
        rest = [number for number in numbers if number not in set(test)]
        count = splits.fold_validation_recordings
        validation = choose_validation(rest, count, splits.split_seed, fold + 1)
        roles = others | dict.fromkeys(validation, VALIDATION) | dict.fromkeys(test, TEST)
        yield f"fold {fold}" if test else ALL_RECORDINGS, candidates.roles(roles)


def k_fold(candidates: Candidates) -> Folds:
    """Assign recordings to folds at random, without validation."""
    numbers, splits = candidates.numbers, candidates.splits
    parts = split_at_random(len(numbers), splits.folds, splits.split_seed)
    for fold, part in enumerate([*parts, np.array([], np.intp)]):
        test = {numbers[position] for position in part}
        roles = {number: TEST if number in test else TRAIN for number in numbers}
        yield f"fold {fold}" if test else ALL_RECORDINGS, candidates.roles(roles)


def leave_one_device_out(candidates: Candidates) -> Folds:
    """Let every IMU in turn be the unseen device: it tests, and all others train.

    With a split, only test recordings test and only the others train, so recordings made together
    with a test recording never train. Without a split, all recordings of the device test and all
    recordings of the other IMUs train: a few recordings are all needed, and IMUs that were recorded
    together do not share their biases. An IMU without a test recording only trains.
    """
    imus, split = candidates.windows.imu.to_numpy(), candidates.split
    if len(np.unique(imus)) < 2:  # noqa: PLR2004
        raise InputError(
            f"unseen devices: expected at least 2 IMUs, got {len(np.unique(imus))}; bring "
            "recordings of more, or leave the sensor out of the study"
        )
    held_out = np.ones(len(imus), bool)
    if split is not None:
        held_out = candidates.windows.recording.map(split).to_numpy() == TEST
    training = np.ones(len(imus), bool) if split is None else ~held_out
    for unseen in np.unique(imus).tolist():
        tests = held_out & (imus == unseen)
        if tests.any():
            trains = training & (imus != unseen)
            yield f"without IMU {unseen}", np.select([tests, trains], [TEST, TRAIN], UNUSED)
    yield ALL_RECORDINGS, np.full(len(imus), TRAIN, object)


def window_split(candidates: Candidates) -> Folds:
    """Leak: windows are assigned at random, so test windows share recordings with training ones."""
    of_tested = np.flatnonzero(candidates.windows.imu == candidates.tested)
    splits = candidates.splits
    parts = split_at_random(len(of_tested), splits.folds, splits.split_seed)
    for fold, part in enumerate(parts):
        roles = np.where(candidates.windows.imu == candidates.tested, TRAIN, UNUSED).astype(object)
        roles[of_tested[part]] = TEST
        yield f"fold {fold}", roles


def test_in_training(candidates: Candidates) -> Folds:
    """Leak: all windows train, and all test."""
    roles = np.where(candidates.windows.imu == candidates.tested, TRAIN, UNUSED).astype(object)
    yield HOLD_OUT, roles
    yield HOLD_OUT, np.where(roles == TRAIN, TEST, UNUSED)


def best_epoch_on_test(candidates: Candidates) -> Folds:
    """Leak: a k-fold by recording whose test windows also choose the best epoch."""
    for fold, roles in k_fold(candidates):
        if fold != ALL_RECORDINGS:
            yield fold, roles
            yield fold, np.where(roles == TEST, VALIDATION, UNUSED)


class Protocol(NamedTuple):
    """A protocol, and the column whose values have only one role in a fold; None for a leak."""

    folds: Callable[[Candidates], Folds]
    single_role: str | None


PROTOCOLS: Mapping[str, Protocol] = {
    BY_RECORDING: Protocol(by_recording, "recording"),
    LEAVE_ONE_DEVICE_OUT: Protocol(leave_one_device_out, "imu"),
    K_FOLD: Protocol(k_fold, "recording"),
    WINDOW_SPLIT: Protocol(window_split, None),
    TEST_IN_TRAINING: Protocol(test_in_training, None),
    BEST_EPOCH_ON_TEST: Protocol(best_epoch_on_test, None),
}
"""Protocols by their name in the setting ``protocol`` of a study."""


def check_table(
    table: pd.DataFrame, single_role: str, contents: pd.DataFrame, drawn_from: Sequence[int]
) -> None:
    """Refuse a windows table that breaks the rules of protocols without leaks.

    Args:
        table: Columns ``fold, role, origin, imu, recording`` and more.
        single_role: Column whose values have one role in a fold: ``recording`` or ``imu``.
        contents: A row per real recording: ``imu, recording``, and ``copies``, the positions of
            the rows of its copies, each with its correlation; from
            :func:`gyro_pipeline.pipelines.windowed_splits.nodes.cut_to_common_length`.
        drawn_from: Real recordings from which the virtual ones were drawn.

    Raises:
        InputError: A recording or device has two roles in a fold; a recording and its copy have
            different roles; a virtual recording that trains was drawn from a test recording; or a
            fold has nothing to train on. The message names the fold and the recordings.
    """
    keys = table.drop_duplicates(["fold", "role", "origin", "imu", "recording"])
    for fold, rows in keys.groupby("fold", observed=True, sort=False):
        real = rows[rows.origin == ORIGIN_REAL]
        _refuse_two_roles(str(fold), real, single_role)
        _refuse_copies(str(fold), real, contents)
        tests = set(real.recording[real.role == TEST])
        leaked = sorted(tests & set(drawn_from)) if len(real) < len(rows) else []
        if leaked:
            raise InputError(
                f"{fold}: virtual recordings that train were drawn from recordings "
                f"{', '.join(map(str, leaked))}, which test; "
                "draw them from training recordings alone"
            )
        if tests and not (rows.role == TRAIN).any():
            raise InputError(
                f"{fold}: no recording is left to train on; lower splits.test_fraction or bring "
                "more recordings"
            )


def _refuse_two_roles(fold: str, rows: pd.DataFrame, column: str) -> None:
    if column == "imu":  # a device that does not test may train and validate
        rows = rows.assign(role=np.where(rows.role == TEST, TEST, TRAIN))
    roles = rows.drop_duplicates([column, "role"]).groupby(column, observed=True).role
    for name, of_name in roles:
        if len(of_name) > 1:
            uses = rows[rows[column] == name].groupby("role", observed=True).imu.unique()
            texts = (f"{role} (IMU {', '.join(map(str, imus))})" for role, imus in uses.items())
            raise InputError(
                f"{fold}: {column} {name} has more than one role: {', '.join(texts)}; a recording "
                "trains, validates or tests, for all IMUs recorded together, and an unseen device "
                "never trains"
            )


def _refuse_copies(fold: str, rows: pd.DataFrame, contents: pd.DataFrame) -> None:
    roles = rows.groupby(["imu", "recording"]).role.agg(set).to_dict()
    keys = list(zip(contents.imu, contents.recording, strict=True))
    for key, copies in zip(keys, contents.copies, strict=True):
        for other, correlation in copies:
            first, second = roles.get(key, set()), roles.get(keys[other], set())
            if first and second and first != second:
                (imu, number), (imu_2, number_2) = key, keys[other]
                raise InputError(
                    f"{fold}: IMU {imu} recording {number} ({', '.join(sorted(first))}) is a copy "
                    f"of IMU {imu_2} recording {number_2} ({', '.join(sorted(second))}): their "
                    f"noise has a correlation of {correlation:.2f}, where two recordings have less "
                    "than 0.1; leave one of them out, or give both the same role"
                )
