"""Which recordings test: given by the source, or held out where there are many."""

from collections.abc import Mapping, Sequence

import numpy as np

from gyro_pipeline.conventions import TEST, TRAIN, VALIDATION, InputError
from gyro_pipeline.parameters import Splits

FEWEST_TRAINING = 2
"""Recordings, without which none validates: a network centres each device on its own mean."""


def split_recordings(
    recordings: Sequence[int],
    of_tested: Sequence[int],
    splits: Splits,
    given: Mapping[int, str] | None = None,
) -> dict[int, str] | None:
    """Give every recording its role in a hold-out, the same for all IMUs recorded together.

    A split that the source gives is kept; otherwise the last recordings test. Recordings that the
    tested IMU lacks cannot test: they train, unless the source gave them to test.

    Args:
        recordings: Numbers of all recordings, in order.
        of_tested: Those of the tested IMU, in order.
        splits: Fractions, counts and the ``split_seed``.
        given: ``train`` or ``test`` for each recording, where the source came split.

    Returns:
        Roles by recording; None where few recordings make a k-fold.

    Raises:
        InputError: No recording would be left to test, or to train.
    """
    if given is not None:
        tests = [number for number in of_tested if given[number] == TEST]
    elif len(of_tested) < splits.k_fold_below:
        return None
    else:
        tests = list(of_tested[-max(1, round(splits.test_fraction * len(of_tested))) :])
    rest = [number for number in of_tested if number not in set(tests)]
    if not tests or not rest:
        raise InputError(
            f"of {len(of_tested)} recordings of the tested IMU {len(tests)} test and {len(rest)} "
            "are left to train; the source's split needs both, as splits.test_fraction does"
        )
    roles = {number: (given or {}).get(number, TRAIN) for number in recordings}
    validation = choose_validation(rest, splits.validation_recordings, splits.split_seed, 0)
    return roles | dict.fromkeys(validation, VALIDATION) | dict.fromkeys(tests, TEST)


def choose_validation(
    recordings: Sequence[int], wanted: int, split_seed: int, number: int
) -> list[int]:
    """Choose at random which training recordings validate; none where too few would train.

    Args:
        recordings: Those that do not test.
        wanted: How many.
        split_seed: Of the choice.
        number: Of the fold, from 1; 0 of a hold-out.
    """
    if len(recordings) - wanted < FEWEST_TRAINING:
        return []
    generator = np.random.default_rng([split_seed, number])
    return sorted(generator.choice(recordings, wanted, replace=False).tolist())


def deal(count: int, folds: int, seed: int) -> list[np.ndarray]:
    """Deal positions 0 to ``count`` - 1 at random to ``folds`` parts of nearly equal size."""
    return np.array_split(np.random.default_rng(seed).permutation(count), folds)
