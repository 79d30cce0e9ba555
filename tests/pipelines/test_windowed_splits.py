import numpy as np
import pytest

from gyro_pipeline.conventions import HOLD_OUT, TEST, TRAIN, VALIDATION, InputError
from gyro_pipeline.pipelines.windowed_splits.nodes import split_recordings


@pytest.fixture(scope="module")
def recordings(make_recordings):
    def make(count, given_test=()):
        made = make_recordings(np.zeros((2, count, 3)), samples=4, rate_hz=1, noise_dps_rts=1.0)
        if len(given_test):
            split = [TEST if n in given_test else TRAIN for n in range(1, 1 + count)]
            made = made.assign_coords(given_split=("recording", split))
        return made

    return make


def numbers(roles, role, fold=HOLD_OUT):
    return roles.recording[(roles.fold == fold) & (roles.role == role)].tolist()


def test_the_papers_split_of_100_recordings(recordings, parameters):
    splits = parameters("base").splits
    roles = split_recordings(recordings(100), splits)
    assert numbers(roles, TEST) == list(range(81, 101))
    assert len(numbers(roles, VALIDATION)) == 8
    assert len(numbers(roles, TRAIN)) == 72
    given = split_recordings(recordings(100, given_test=range(81, 101)), splits)
    assert given.equals(roles)


def test_a_split_that_the_source_gives_is_used(recordings, parameters):
    roles = split_recordings(recordings(30, given_test=(1, 5, 7)), parameters("base").splits)
    assert numbers(roles, TEST) == [1, 5, 7]
    assert roles.fold.unique().tolist() == [HOLD_OUT]


def test_no_validation_recordings_is_the_papers_reading(recordings, parameters):
    splits = parameters("base", splits={"validation_recordings": 0}).splits
    roles = split_recordings(recordings(100), splits)
    assert numbers(roles, TRAIN) == list(range(1, 81))


def test_the_split_seed_chooses_validation_recordings_and_no_test_ones(recordings, parameters):
    first, other = (
        split_recordings(recordings(100), parameters("base", splits={"split_seed": seed}).splits)
        for seed in (1, 2)
    )
    assert numbers(first, VALIDATION) != numbers(other, VALIDATION)
    assert numbers(first, TEST) == numbers(other, TEST)


@pytest.mark.parametrize(("count", "folds"), [(11, 11), (20, 20), (21, 5), (49, 5)])
def test_few_recordings_make_a_k_fold_that_tests_each_once(recordings, parameters, count, folds):
    roles = split_recordings(recordings(count), parameters("base").splits)
    assert roles.fold.unique().tolist() == list(range(folds))
    tested = [number for fold in range(folds) for number in numbers(roles, TEST, fold)]
    assert sorted(tested) == list(range(1, 1 + count))
    assert {len(numbers(roles, VALIDATION, fold)) for fold in range(folds)} == {2}


def test_a_recording_that_is_in_both_of_a_sources_files_is_refused(recordings, parameters):
    made, splits = recordings(30, given_test=(1, 5, 7)), parameters("base").splits
    twice = made.copy(deep=True)
    twice.angular_rate.loc[{"recording": 7}] = made.angular_rate.sel(recording=9)
    with pytest.raises(InputError, match=r"recording 9 .* IMU 1 recording 7 \(test\)"):
        split_recordings(twice, splits)


def test_a_copy_under_another_imu_is_refused_and_absent_ones_are_no_copies(recordings, parameters):
    made, splits = recordings(30, given_test=(1, 5, 7)), parameters("base").splits
    absent = made.copy(deep=True)
    absent["samples"].loc[{"imu": 2, "recording": [5, 9]}] = 0
    split_recordings(absent, splits)
    absent.angular_rate.loc[{"imu": 2, "recording": 12}] = made.angular_rate.sel(imu=1, recording=7)
    with pytest.raises(InputError, match=r"IMU 2 recording 12 .* IMU 1 recording 7"):
        split_recordings(absent, splits)
