import numpy as np
import pandas as pd
import pytest

from gyro_pipeline.conventions import HOLD_OUT, TEST, TRAIN, VALIDATION, InputError
from gyro_pipeline.protocol.splits import (
    assign_roles,
    check_roles,
    deal,
    refuse_copies,
    refuse_two_roles,
    with_role,
)

HUNDRED = range(1, 101)


@pytest.fixture(scope="module")
def splits(parameters):
    return parameters("base").splits


def folds_of(roles):
    return roles.fold.unique().tolist()


def test_of_100_recordings_the_last_20_test_and_8_of_the_others_validate(splits):
    roles = assign_roles(HUNDRED, splits)
    assert folds_of(roles) == [HOLD_OUT]
    assert with_role(roles, HOLD_OUT, TEST) == list(range(81, 101))
    validation, train = (with_role(roles, HOLD_OUT, role) for role in (VALIDATION, TRAIN))
    assert len(validation) == 8
    assert sorted(validation + train) == list(range(1, 81))


def test_the_validation_recordings_of_the_base_configuration_stay_what_they_are(splits):
    # Every tracked run was made with these; other ones would silently compare unlike with unlike.
    roles = assign_roles(HUNDRED, splits)
    assert with_role(roles, HOLD_OUT, VALIDATION) == [6, 13, 33, 42, 49, 64, 73, 78]


def test_only_the_split_seed_chooses_them(splits):
    other = splits.model_copy(update={"split_seed": splits.split_seed + 1})
    first, again, different = (assign_roles(HUNDRED, s) for s in (splits, splits, other))
    pd.testing.assert_frame_equal(first, again)
    assert with_role(first, HOLD_OUT, VALIDATION) != with_role(different, HOLD_OUT, VALIDATION)
    assert with_role(first, HOLD_OUT, TEST) == with_role(different, HOLD_OUT, TEST)


def test_no_validation_recordings_is_the_papers_reading(splits):
    roles = assign_roles(HUNDRED, splits.model_copy(update={"validation_recordings": 0}))
    assert with_role(roles, HOLD_OUT, TRAIN) == list(range(1, 81))


@pytest.mark.parametrize(("count", "tested"), [(100, (1, 2, 50)), (11, (4,))])
def test_a_given_split_wins(splits, count, tested):
    recordings = range(1, 1 + count)
    given = {r: TEST if r in tested else TRAIN for r in recordings}
    roles = assign_roles(recordings, splits, given)
    assert folds_of(roles) == [HOLD_OUT]
    assert with_role(roles, HOLD_OUT, TEST) == list(tested)
    assert len(with_role(roles, HOLD_OUT, VALIDATION)) == 8


@pytest.mark.parametrize(
    ("count", "sizes"),
    [
        (4, [1] * 4),
        (11, [1] * 11),
        (20, [1] * 20),
        (21, [5, 4, 4, 4, 4]),
        (49, [10, 10, 10, 10, 9]),
    ],
)
def test_few_recordings_are_folded(splits, count, sizes):
    recordings = np.arange(101, 101 + count).tolist()
    roles = assign_roles(recordings, splits)
    assert folds_of(roles) == list(range(len(sizes)))
    tests = [with_role(roles, fold, TEST) for fold in folds_of(roles)]
    assert [len(test) for test in tests] == sizes
    assert sorted(sum(tests, [])) == recordings  # each tested exactly once
    for _, fold in roles.groupby("fold"):
        assert sorted(fold.recording) == recordings  # each has one role
        assert (fold.role == VALIDATION).sum() == 2


def test_from_50_recordings_on_there_is_a_hold_out(splits):
    roles = assign_roles(range(1, 51), splits)
    assert folds_of(roles) == [HOLD_OUT]
    assert with_role(roles, HOLD_OUT, TEST) == list(range(41, 51))


def test_folds_are_shuffled_by_the_split_seed(splits):
    other = splits.model_copy(update={"split_seed": 1})
    first, second = (with_role(assign_roles(range(30), s), 0, TEST) for s in (splits, other))
    assert first != second
    assert first != list(range(6))


def test_folds_validate_on_different_recordings(splits):
    roles = assign_roles(range(1, 12), splits)
    chosen = {tuple(with_role(roles, fold, VALIDATION)) for fold in range(11)}
    assert len(chosen) > 5


def test_too_many_validation_recordings_are_refused_by_the_key_to_change(splits):
    with pytest.raises(InputError, match=r"8 validation .* of 7 .*splits\.validation_recordings"):
        assign_roles(range(8), splits, dict.fromkeys(range(7), TRAIN) | {7: TEST})
    with pytest.raises(InputError, match=r"fold 0: 2 .* of 2 .*fold_validation_recordings"):
        assign_roles(range(3), splits)


def test_a_given_split_without_test_recordings_is_refused(splits):
    with pytest.raises(InputError, match="none of 100 recordings is left for role 'test'"):
        assign_roles(HUNDRED, splits, dict.fromkeys(HUNDRED, TRAIN))


def frame(*rows):
    return pd.DataFrame(rows, columns=["fold", "recording", "role"])


def test_honest_roles_pass_the_guard():
    check_roles(frame((0, 1, TRAIN), (0, 2, TEST), (1, 1, TEST), (1, 2, TRAIN)))


@pytest.mark.parametrize(
    ("rows", "message"),
    [
        ([(3, 1, TRAIN), (3, 2, TEST), (3, 1, TEST)], "fold 3: recordings 1 have more than one"),
        ([(0, 7, TRAIN), (0, 8, TEST), (0, 7, VALIDATION)], "recordings 7 have more than one"),
        ([(0, 1, TEST), (0, 2, VALIDATION)], "fold 0: none of 2 .* role 'train'"),
        ([(0, 1, TRAIN), (0, 2, TEST), (1, 1, TRAIN), (1, 2, TRAIN)], "fold 1: .* role 'test'"),
    ],
)
def test_the_guard_refuses(rows, message):
    with pytest.raises(InputError, match=message):
        check_roles(frame(*rows))


def test_a_role_of_its_own_for_each_imu_is_refused():
    # IMU 2 would train on the recording that IMU 1 is tested on.
    roles = frame((0, 1, TRAIN), (0, 2, TEST), (0, 2, TRAIN)).assign(imu=[1, 1, 2])
    with pytest.raises(InputError, match="recordings 2 have .* for all IMUs recorded together"):
        check_roles(roles)


def test_recordings_used_in_one_role_pass_whatever_their_imus():
    refuse_two_roles(
        {TRAIN: [(1, 1), (2, 1), (2, 3)], VALIDATION: [(1, 4)], TEST: [(1, 2)]}, "dot fold 0"
    )


@pytest.mark.parametrize(
    ("used", "message"),
    [
        (
            {TRAIN: [(1, 5)], TEST: [(1, 5)]},
            r"dot fold 3: recording 5 .* train \(IMU 1\), test \(IMU 1\)",
        ),
        (
            {TRAIN: [(1, 1), (2, 7), (3, 7)], TEST: [(1, 7)]},
            r"recording 7 .* train \(IMU 2, 3\), test \(IMU 1\); .* all IMUs recorded together",
        ),
        (
            {TRAIN: [(2, 7)], VALIDATION: [(1, 7)], TEST: [(1, 8)]},
            r"recording 7 .* train \(IMU 2\), validation \(IMU 1\)",
        ),
    ],
)
def test_a_recording_used_in_two_roles_is_refused_also_by_different_imus(used, message):
    with pytest.raises(InputError, match=message):
        refuse_two_roles(used, "dot fold 3")


def test_one_recording_under_two_numbers_is_refused_where_their_roles_differ():
    roles = frame((0, 1, TRAIN), (0, 2, TRAIN), (0, 3, TEST), (1, 1, TEST), (1, 2, TRAIN))
    refuse_copies({(1, 1): "a", (1, 2): "b", (2, 1): "c", (2, 2): "d"}, roles)
    refuse_copies({(1, 1): "a", (1, 2): "a"}, frame((0, 1, TRAIN), (0, 2, TRAIN), (0, 3, TEST)))
    with pytest.raises(InputError, match=r"fold 1: IMU 1 recording 2 \(train\) .* 1 \(test\)"):
        refuse_copies({(1, 1): "a", (1, 2): "a"}, roles)
    with pytest.raises(InputError, match=r"fold 0: IMU 2 recording 3 \(test\) .* IMU 1 record"):
        refuse_copies({(1, 1): "a", (2, 3): "a"}, roles)


def test_dealing_gives_every_position_once_and_knows_its_seed():
    parts = deal(11, 5, seed=3)
    assert sorted(map(len, parts)) == [2, 2, 2, 2, 3]
    assert sorted(np.concatenate(parts).tolist()) == list(range(11))
    again, other = deal(11, 5, seed=3), deal(11, 5, seed=4)
    assert all(np.array_equal(a, b) for a, b in zip(parts, again, strict=True))
    assert not all(np.array_equal(a, b) for a, b in zip(parts, other, strict=True))
