"""Which recordings train, validate and test; always by recording, never by window."""

from collections.abc import Mapping, Sequence

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


def with_role(roles: pd.DataFrame, fold: int, role: str) -> list[int]:
    """Recording numbers that have ``role`` in ``fold``."""
    return roles.recording[(roles.fold == fold) & (roles.role == role)].tolist()


def _k_folds(recordings: Sequence[int], splits: Splits) -> dict[int, list[int]]:
    leave_one_out = len(recordings) <= splits.leave_one_out_up_to
    if leave_one_out:
        return {fold: [recording] for fold, recording in enumerate(recordings)}
    shuffled = np.random.default_rng(splits.split_seed).permutation(recordings)
    parts = np.array_split(shuffled, splits.folds)
    return {fold: sorted(map(int, part)) for fold, part in enumerate(parts)}


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
