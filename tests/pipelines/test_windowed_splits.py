import numpy as np
import pytest

from gyro_pipeline.conventions import HOLD_OUT, TEST, TRAIN, VALIDATION, InputError
from gyro_pipeline.pipelines.ground_truth.nodes import measure_allan_variance
from gyro_pipeline.pipelines.windowed_splits.nodes import cut_to_shortest, split_recordings


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


@pytest.fixture
def uneven(make_recordings):
    """Of 60, 40 and 50 s at 20 Hz; IMU 2 lacks the second, and four samples are masked."""
    made = make_recordings(np.full((2, 3, 3), 3.0), 1200, 20.0, 0.005)
    for number, length in ((1, 800), (2, 1000)):
        made["samples"][:, number] = length
        made.angular_rate[:, number, :, length:] = np.nan
    made["samples"][1, 1], made.angular_rate[1, 1] = 0, np.nan
    made.angular_rate[0, 0, :, [3, 4, 900, 901]] = np.nan
    return made


def table_of(recordings):
    """What the raw-logs stage says of them."""
    rows = recordings["samples"].to_dataframe().reset_index()
    stop = rows.samples.where(rows.samples > 0) + 5
    files = [f"{i}_{n}.csv" for i, n in zip(rows.imu, rows.recording, strict=True)]
    return rows[["imu", "recording"]].assign(file=files, start=stop * 0 + 5, stop=stop)


def test_studies_use_the_first_samples_of_each_and_say_who_is_the_shortest(
    uneven, make_bias, caplog
):
    bias = make_bias(uneven, measure_allan_variance(uneven))
    with caplog.at_level("INFO", "gyro_pipeline"):
        cut, biases = cut_to_shortest(uneven, bias, table_of(uneven))
    assert caplog.messages == [
        "sparkfun: recordings are 40.0 to 60.0 s; studies use the first 40.0 s of each, the length "
        "of IMU 1 recording 2, 1_2.csv. quality.length_s rejects shorter ones"
    ]
    assert cut.angular_rate.identical(uneven.angular_rate[..., :800])
    assert cut["samples"].values.tolist() == [[800, 800, 800], [800, 0, 800]]
    assert cut.attrs["data_hash"] != uneven.attrs["data_hash"]
    assert len(biases) == 5 * 3
    for row in biases.itertuples():
        samples = cut.angular_rate.sel(imu=row.imu, recording=row.recording, axis=row.axis)
        assert row.bias_dps == pytest.approx(np.nanmean(samples.astype(float)), rel=1e-12)
    assert uneven["samples"].values.tolist() == [[1200, 800, 1000], [1200, 0, 1000]]


def test_recordings_of_one_length_stay_as_they_are(make_recordings, caplog):
    alike = make_recordings(np.zeros((1, 2, 3)), 1200, 20.0, 0.005)
    with caplog.at_level("INFO", "gyro_pipeline"):
        cut, bias = cut_to_shortest(alike, "bias", table_of(alike))
    assert cut is alike
    assert bias == "bias"
    assert caplog.messages == ["sparkfun: all recordings are 60.0 s"]


def test_recordings_that_the_tested_imu_lacks_train(recordings, parameters):
    made = recordings(30).copy(deep=True)
    made["samples"].loc[{"imu": 1, "recording": [3, 30]}] = 0
    roles = split_recordings(made, parameters("base").splits)
    lacking = roles[roles.recording.isin([3, 30])]
    assert set(lacking.role) == {TRAIN}
    assert len(lacking) == 2 * roles.fold.nunique()
    given = recordings(30, given_test=(1, 30)).copy(deep=True)
    given["samples"].loc[{"imu": 1, "recording": [3, 30]}] = 0
    roles = split_recordings(given, parameters("base").splits)
    assert numbers(roles, TEST) == [1]
    assert 3 in numbers(roles, TRAIN)
    assert 30 not in roles.recording.tolist()


def test_without_the_tested_imu_the_way_out_is_said(recordings, parameters):
    made = recordings(30).assign_coords(imu=[2, 3])
    with pytest.raises(
        InputError, match=r"sparkfun: expected .* IMU 1, .* got IMUs 2, 3.*imu:name"
    ):
        split_recordings(made, parameters("base").splits)
