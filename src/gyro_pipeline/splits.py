"""The split of recordings: as in the source, or by holding out recordings for testing."""

from collections.abc import Mapping, Sequence

import numpy as np

from gyro_pipeline.conventions import TEST, TRAIN, VALIDATION, InputError
from gyro_pipeline.parameters import Splits

FEWEST_TRAINING = 2
"""Fewest training recordings beside validation: a network centres each device on their mean."""


def split_recordings(
    recordings: Sequence[int],
    of_tested: Sequence[int],
    splits: Splits,
    source_split: Mapping[int, str] | None = None,
) -> dict[int, str] | None:
    """Give every recording its role in a hold-out, the same for all IMUs recorded together.

    A split that comes with the source is kept; otherwise the last recordings test. Recordings that
    the tested IMU lacks cannot test: they train, unless the source assigns them to testing.

    Args:
        recordings: Numbers of all recordings, in order.
        of_tested: Numbers of the tested IMU's recordings, in order.
        splits: Fractions, counts and the ``split_seed``.
        source_split: ``train`` or ``test`` for each recording, if the source comes split.

    Returns:
        Roles by recording; None where so few recordings exist that they make a k-fold.

    Raises:
        InputError: No recording would test, or none would train.
    """
    if source_split is not None:
        tests = [number for number in of_tested if source_split[number] == TEST]
    elif len(of_tested) < splits.k_fold_below:
        return None
    else:
        tests = list(of_tested[-max(1, round(splits.test_fraction * len(of_tested))) :])
    rest = [number for number in of_tested if number not in set(tests)]
    if not tests or not rest:
        raise InputError(
            f"of {len(of_tested)} recordings of the tested IMU {len(tests)} test and {len(rest)} "
            "are left to train; expected at least one of both: change the split of the source, or "
            "splits.test_fraction"
        )
    roles = {number: (source_split or {}).get(number, TRAIN) for number in recordings}
    validation = choose_validation(rest, splits.validation_recordings, splits.split_seed, 0)
    return roles | dict.fromkeys(validation, VALIDATION) | dict.fromkeys(tests, TEST)


def choose_validation(
    recordings: Sequence[int], count: int, split_seed: int, number: int
) -> list[int]:
    """Choose validation recordings at random; none where too few would be left to train.

    Args:
        recordings: Numbers of the recordings that do not test.
        count: Number of validation recordings.
        split_seed: Seed of the choice.
        number: Number of the fold, from 1; 0 for a hold-out.
    """
    if len(recordings) - count < FEWEST_TRAINING:
        return []
    generator = np.random.default_rng([split_seed, number])
    return sorted(generator.choice(recordings, count, replace=False).tolist())


def split_at_random(count: int, folds: int, seed: int) -> list[np.ndarray]:
    """Split positions 0 to ``count`` - 1 at random into ``folds`` parts of nearly equal size."""
    return np.array_split(np.random.default_rng(seed).permutation(count), folds)
