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
    if given is not None:
        folds = {HOLD_OUT: [r for r in recordings if given[r] == TEST]}
    elif len(recordings) < splits.k_fold_below:
        folds = _k_folds(recordings, splits)
    else:
        n_test = max(1, round(splits.test_fraction * len(recordings)))
        folds = {HOLD_OUT: list(recordings[-n_test:])}
    roles = pd.concat([_fold_roles(f, test, recordings, splits) for f, test in folds.items()])
    check_roles(roles)
    return roles.reset_index(drop=True)


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
        roles: From :func:`assign_roles`.

    Raises:
        InputError: Naming both recordings and the fold.
    """
    first: dict[str, tuple[int, int]] = {}
    for (imu, number), content in contents.items():
        twin_imu, twin = first.setdefault(content, (imu, number))
        for fold, group in roles.groupby("fold"):
            role = group.set_index("recording").role
            if role[twin] != role[number]:
                raise InputError(
                    f"fold {fold}: IMU {imu} recording {number} ({role[number]}) holds the same "
                    f"samples as IMU {twin_imu} recording {twin} ({role[twin]}); leave one of "
                    "them out, or give both the same role"
                )


def deal(count: int, folds: int, seed: int) -> list[np.ndarray]:
    """Deal positions 0 to ``count`` - 1 at random to ``folds`` parts of nearly equal size."""
    return np.array_split(np.random.default_rng(seed).permutation(count), folds)


def with_role(roles: pd.DataFrame, fold: int, role: str) -> list[int]:
    """Recording numbers that have ``role`` in ``fold``."""
    return roles.recording[(roles.fold == fold) & (roles.role == role)].tolist()


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
