"""Which recordings train, validate and test; always by recording, never by window."""

from collections.abc import Iterable, Mapping, Sequence

import numpy as np
import pandas as pd

from gyro_pipeline.conventions import HOLD_OUT, TEST, TRAIN, VALIDATION, InputError
from gyro_pipeline.parameters import Splits


def assign_roles(
    recordings: Sequence[int], splits: Splits, given: Mapping[int, str] | None = None
) -> pd.DataFrame:
    """Give every recording one role in every fold, the same for all IMUs recorded together.

    A split that the source gives is kept. Otherwise few recordings make a k-fold (leave-one-out
    when very few), and many a hold-out whose test recordings are the last ones.

    Args:
        recordings: Recording numbers, in order.
        splits: Fractions, counts and the ``split_seed``.
        given: ``"train"`` or ``"test"`` for each recording, where the source came split.

    Returns:
        Columns ``fold`` (``HOLD_OUT`` or 0, 1, ...), ``recording``, ``role``.

    Raises:
        InputError: If no recording would be left for training.
    """
    held_out = _held_out(recordings, splits, given)
    folds = _k_folds(recordings, splits) if held_out is None else {HOLD_OUT: held_out}
    roles = pd.concat([_fold_roles(f, test, recordings, splits) for f, test in folds.items()])
    check_roles(roles)
    return roles.reset_index(drop=True)


def leave_one_device_out(
    recordings: Mapping[int, Sequence[int]],
    splits: Splits,
    given: Mapping[int, str] | None = None,
) -> pd.DataFrame:
    """Let every IMU in turn be the unseen device: it tests, and all others train.

    One that has no recording to test, as all but IMU 1 of the published files, only trains.

    Where :func:`assign_roles` holds recordings out, only those of the unseen device test, and only
    the rest of the others' train: recordings made together with a test recording never train. Where
    it makes a k-fold, or there is one recording, all of the device's test and all of the others'
    train: few recordings are all needed, and what IMUs recorded together share is no bias.

    Args:
        recordings: Numbers, in order, of the recordings that each IMU has.
        splits: Fractions and counts.
        given: ``"train"`` or ``"test"`` for each recording, where the source came split.

    Returns:
        Columns ``fold`` (the unseen IMU), ``imu``, ``recording``, ``role``.

    Raises:
        InputError: Fewer than two IMUs, none with a recording to test, or one with none to learn
            from.
    """
    if len(recordings) <= 1:
        raise InputError(
            f"unseen devices: expected at least 2 IMUs, got {len(recordings)}; bring recordings of "
            "more, or leave the sensor out of the study"
        )
    numbers = sorted({number for own in recordings.values() for number in own})
    held_out = _held_out(numbers, splits, given)
    tested = [
        imu for imu, own in recordings.items() if held_out is None or set(held_out) & set(own)
    ]
    if not tested:
        raise InputError(
            "unseen devices: expected an IMU with a recording to test, got none; bring test "
            "recordings, or leave the sensor out of the study"
        )
    rows = [
        (unseen, imu, number, TEST if imu == unseen else TRAIN)
        for unseen in tested
        for imu, own in recordings.items()
        for number in own
        if held_out is None or (number in held_out) == (imu == unseen)
    ]
    roles = pd.DataFrame(rows, columns=["fold", "imu", "recording", "role"])
    check_devices(roles)
    return roles


def check_devices(roles: pd.DataFrame) -> None:
    """Refuse a fold in which the unseen device trains or another tests, and one that lacks either.

    Args:
        roles: As from :func:`leave_one_device_out`.

    Raises:
        InputError: Naming the fold, the IMU and its recordings.
    """
    for unseen, group in roles.groupby("fold"):
        wrong = group[(group.imu == unseen) != (group.role == TEST)]
        for (imu, role), rows in wrong.groupby(["imu", "role"]):
            raise InputError(
                f"unseen device IMU {unseen}: recordings {', '.join(map(str, rows.recording))} of "
                f"IMU {imu} have role {role!r}; the unseen device tests, and only the others train"
            )
        for role in (TRAIN, TEST):
            if not (group.role == role).any():
                raise InputError(
                    f"unseen device IMU {unseen}: no recording has role {role!r}; bring more "
                    "recordings, or leave the sensor out of the study"
                )


def check_roles(roles: pd.DataFrame) -> None:
    """Refuse a recording with two roles in one fold, and a fold without training or test.

    Raises:
        InputError: Naming the fold and the recordings.
    """
    for fold, group in roles.groupby("fold"):
        twice = group.recording[group.recording.duplicated()].unique()
        if len(twice):
            raise InputError(
                f"fold {fold}: recordings {', '.join(map(str, twice))} have more than one role; "
                "a recording trains, validates or tests, for all IMUs recorded together"
            )
        for role in (TRAIN, TEST):
            if not (group.role == role).any():
                raise InputError(
                    f"fold {fold}: none of {len(group)} recordings is left for role {role!r}; "
                    "lower splits.validation_recordings or bring more recordings"
                )


def refuse_two_roles(used: Mapping[str, Iterable[tuple[int, int]]], where: str) -> None:
    """Refuse recordings used in two roles, be it by different IMUs: they were recorded together.

    Args:
        used: For each role the IMU and the number of every recording used in it.
        where: What an error message calls the training.

    Raises:
        InputError: Naming the recording, its roles and the IMUs.
    """
    imus_of: dict[int, dict[str, set[int]]] = {}
    for role, recordings in used.items():
        for imu, number in recordings:
            imus_of.setdefault(number, {}).setdefault(role, set()).add(imu)
    for number, roles in sorted(imus_of.items()):
        if len(roles) > 1:
            uses = ", ".join(
                f"{role} (IMU {', '.join(map(str, sorted(imus)))})" for role, imus in roles.items()
            )
            raise InputError(
                f"{where}: recording {number} is used in more than one role: {uses}; a recording "
                "trains, validates or tests, for all IMUs recorded together"
            )


def refuse_copies(contents: Mapping[tuple[int, int], str], roles: pd.DataFrame) -> None:
    """Refuse one recording under two numbers with different roles.

    Args:
        contents: A hash of the samples, by IMU and recording number.
        roles: From :func:`assign_roles` or :func:`leave_one_device_out`.

    Raises:
        InputError: Naming both recordings and the fold.
    """
    first: dict[str, tuple[int, int]] = {}
    twins = [(place, first.setdefault(content, place)) for place, content in contents.items()]
    copies = [(place, twin) for place, twin in twins if place != twin]
    for fold, group in roles.groupby("fold"):
        by_imu = "imu" in group
        index = ["imu", "recording"] if by_imu else "recording"
        role_of = group.set_index(index).role.to_dict()
        for place, twin in copies:
            role, other = (role_of.get(one if by_imu else one[1]) for one in (place, twin))
            if role and other and role != other:
                raise InputError(
                    f"fold {fold}: IMU {place[0]} recording {place[1]} ({role}) holds the same "
                    f"samples as IMU {twin[0]} recording {twin[1]} ({other}); leave one of "
                    "them out, or give both the same role"
                )


def deal(count: int, folds: int, seed: int) -> list[np.ndarray]:
    """Deal positions 0 to ``count`` - 1 at random to ``folds`` parts of nearly equal size."""
    return np.array_split(np.random.default_rng(seed).permutation(count), folds)


def with_role(roles: pd.DataFrame, fold: int, role: str) -> list[int]:
    """Recording numbers that have ``role`` in ``fold``."""
    return roles.recording[(roles.fold == fold) & (roles.role == role)].tolist()


def _held_out(
    recordings: Sequence[int], splits: Splits, given: Mapping[int, str] | None
) -> list[int] | None:
    """The test recordings of a hold-out; None where few recordings make a k-fold."""
    if given is not None:
        return [r for r in recordings if given[r] == TEST]
    if len(recordings) < splits.k_fold_below:
        return None
    return list(recordings[-max(1, round(splits.test_fraction * len(recordings))) :])


def _k_folds(recordings: Sequence[int], splits: Splits) -> dict[int, list[int]]:
    leave_one_out = len(recordings) <= splits.leave_one_out_up_to
    if leave_one_out:
        return {fold: [recording] for fold, recording in enumerate(recordings)}
    parts = deal(len(recordings), splits.folds, splits.split_seed)
    return {fold: sorted(recordings[i] for i in part) for fold, part in enumerate(parts)}


def _fold_roles(
    fold: int, test: Sequence[int], recordings: Sequence[int], splits: Splits
) -> pd.DataFrame:
    rest = [r for r in recordings if r not in set(test)]
    hold_out = fold == HOLD_OUT
    key = "validation_recordings" if hold_out else "fold_validation_recordings"
    wanted = getattr(splits, key)
    if wanted >= len(rest):
        raise InputError(
            f"fold {fold}: {wanted} validation recordings asked of {len(rest)} that are not for "
            f"testing; lower splits.{key} or bring more recordings"
        )
    generator = np.random.default_rng([splits.split_seed, fold - HOLD_OUT])
    validation = set(generator.choice(rest, wanted, replace=False).tolist())
    role = {r: VALIDATION if r in validation else TRAIN for r in rest} | dict.fromkeys(test, TEST)
    return pd.DataFrame(
        {"fold": fold, "recording": list(recordings), "role": [role[r] for r in recordings]}
    )
