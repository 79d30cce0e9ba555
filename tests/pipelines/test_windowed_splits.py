import numpy as np
import pandas as pd
import pytest

from gyro_pipeline.conventions import (
    ALL_RECORDINGS,
    HOLD_OUT,
    ORIGIN_VIRTUAL,
    TEST,
    TRAIN,
    VALIDATION,
    InputError,
)
from gyro_pipeline.parameters import Only
from gyro_pipeline.pipelines.ground_truth.nodes import measure_allan_variance
from gyro_pipeline.pipelines.virtual_gyros.nodes import synthesise
from gyro_pipeline.pipelines.windowed_splits.nodes import cut_to_common_length, split_windows
from gyro_pipeline.protocol.splits import split_recordings

RATE_HZ = 20.0


@pytest.fixture(scope="module")
def make(make_recordings):
    """Recordings of two IMUs, of 30 s, with the split of as many."""

    def made(count, splits, imus=2, given=None):
        recordings = make_recordings(np.zeros((imus, count, 3)), 600, RATE_HZ, 0.005)
        numbers = list(range(1, 1 + count))
        split = split_recordings(numbers, numbers, splits, given)
        if split is not None:
            recordings = recordings.assign_coords(split=("recording", [split[n] for n in numbers]))
        return recordings

    return made


def table_of(recordings, parameters, make_study, virtual=None, **changes):
    p = parameters("base", **{name: changes.pop(name) for name in ("splits",) if name in changes})
    study = make_study("augmentation", **changes.pop("grid", {"real_gyros": [3]}))
    study = study.model_copy(update={"windows_s": [10.0]} | changes)
    rows = [(i, n) for i in recordings.imu.values for n in recordings.recording.values]
    means = pd.DataFrame(
        [(i, n, axis, 0.0) for i, n in rows for axis in "xyz"],
        columns=["imu", "recording", "axis", "bias_dps"],
    )
    cut, _, contents = cut_to_common_length(recordings, means, quality_of(recordings))
    return split_windows(study, cut, contents, p.splits, [10.0], Only(), virtual)


def quality_of(recordings):
    """What the raw-logs stage says of them."""
    rows = recordings["samples"].to_dataframe().reset_index()
    stop = rows.samples.where(rows.samples > 0) + 5
    files = [f"{i}_{n}.csv" for i, n in zip(rows.imu, rows.recording, strict=True)]
    return rows[["imu", "recording"]].assign(file=files, start=stop * 0 + 5, stop=stop)


def numbers(table, role, fold=HOLD_OUT, imu=1):
    rows = table[(table.fold == fold) & (table.role == role) & (table.imu == imu)]
    return sorted(rows.recording.unique().tolist())


# which recordings


def test_the_papers_split_of_100_recordings(make, parameters, make_study):
    splits = parameters("base").splits
    table = table_of(make(100, splits), parameters, make_study)
    assert numbers(table, TEST) == list(range(81, 101))
    assert len(numbers(table, VALIDATION)) == 8
    assert len(numbers(table, TRAIN)) == 72
    assert numbers(table, TRAIN, imu=2) == numbers(table, TRAIN)
    assert numbers(table, TEST, imu=2) == []
    assert table.fold.unique().tolist() == [HOLD_OUT]
    assert sorted(table.start.unique()) == [0, 200, 400]


def test_a_split_that_the_source_gives_is_used(parameters):
    given = dict.fromkeys(range(1, 31), TRAIN) | {1: TEST, 5: TEST, 7: TEST}
    roles = split_recordings(range(1, 31), range(1, 31), parameters("base").splits, given)
    assert [n for n, role in roles.items() if role == TEST] == [1, 5, 7]
    without_7 = [n for n in range(1, 31) if n not in (3, 7)]
    roles = split_recordings(range(1, 31), without_7, parameters("base").splits, given)
    assert [n for n, role in roles.items() if role == TEST] == [1, 5, 7]  # of no tested IMU
    assert roles[3] == TRAIN


def test_the_seed_chooses_validation_recordings_and_no_test_ones(parameters):
    first, other = (
        split_recordings(
            range(100), range(100), parameters("base", splits={"split_seed": s}).splits
        )
        for s in (1, 2)
    )
    validation = [
        {n for n, role in roles.items() if role == VALIDATION} for roles in (first, other)
    ]
    assert validation[0] != validation[1]
    assert all(first[n] == other[n] == TEST for n in range(80, 100))


@pytest.mark.parametrize(("count", "folds"), [(4, 4), (20, 20), (21, 5), (49, 5)])
def test_few_recordings_make_a_k_fold_that_tests_each_once(
    make, parameters, make_study, count, folds
):
    table = table_of(make(count, parameters("base").splits), parameters, make_study)
    names = [f"fold {fold}" for fold in range(folds)]
    assert table.fold.unique().tolist() == [*names, ALL_RECORDINGS]
    tested = [number for fold in names for number in numbers(table, TEST, fold)]
    assert sorted(tested) == list(range(1, 1 + count))
    assert {len(numbers(table, VALIDATION, fold)) for fold in names} == {2}
    of_model = table[table.fold == ALL_RECORDINGS]
    assert set(of_model.role) == {TRAIN, VALIDATION}
    assert of_model.recording.nunique() == count


def test_two_recordings_are_enough_for_a_table(make, parameters, make_study):
    table = table_of(make(2, parameters("base").splits), parameters, make_study)
    assert numbers(table, TRAIN, "fold 0") == [2]
    assert numbers(table, VALIDATION, "fold 0") == []


def test_every_device_in_turn_is_unseen(make, parameters, make_study):
    splits = parameters("base").splits
    table = table_of(
        make(100, splits, imus=3), parameters, make_study, protocol="leave_one_device_out"
    )
    assert table.fold.unique().tolist() == [f"without IMU {i}" for i in (1, 2, 3)] + [
        ALL_RECORDINGS
    ]
    assert numbers(table, TEST, "without IMU 2", imu=2) == list(range(81, 101))
    for imu in (1, 3):
        assert numbers(table, TRAIN, "without IMU 2", imu) == list(range(1, 81))
    few = table_of(make(3, splits), parameters, make_study, protocol="leave_one_device_out")
    assert (
        numbers(few, TEST, "without IMU 1") == numbers(few, TRAIN, "without IMU 1", 2) == [1, 2, 3]
    )
    with pytest.raises(InputError, match="expected at least 2 IMUs, got 1; bring recordings"):
        table_of(make(3, splits, imus=1), parameters, make_study, protocol="leave_one_device_out")


# which windows


@pytest.mark.parametrize(
    ("training_windows", "starts"),
    [("all", [0, 200, 400]), ("first", [0]), (5.0, range(0, 401, 100))],
)
def test_training_windows_are_all_the_first_or_at_a_stride(
    make, parameters, make_study, training_windows, starts
):
    splits = {"training_windows": training_windows}
    table = table_of(make(100, parameters("base").splits), parameters, make_study, splits=splits)
    assert sorted(table[table.role == TRAIN].start.unique()) == list(starts)
    assert sorted(table[table.role == TEST].start.unique()) == [0, 200, 400]


@pytest.mark.parametrize("protocol", ["k_fold", "window_split", "best_epoch_on_test"])
def test_the_leak_studys_windows_test_once_each(make, parameters, make_study, protocol):
    grid = {"protocol": protocol, "recordings": 6, "folds": 3, "strides_s": [5.0]}
    table = table_of(make(100, parameters("base").splits), parameters, make_study, **grid)
    tests = table[table.role == TEST]
    assert len(tests) == len(tests.drop_duplicates(["recording", "start"])) == 6 * 5
    assert set(tests.imu) == {1}
    for _, rows in table.groupby("fold", observed=True):
        train, test = (set(rows.recording[rows.role == role]) for role in (TRAIN, TEST))
        assert bool(train & test) == (protocol == "window_split")
        if protocol == "best_epoch_on_test":
            places = [
                rows[rows.role == role][["recording", "start"]] for role in (VALIDATION, TEST)
            ]
            assert places[0].to_numpy().tolist() == places[1].to_numpy().tolist()


def test_all_windows_train_and_test_where_the_test_set_is_in_training(make, parameters, make_study):
    grid = {"protocol": "test_in_training", "recordings": 6, "folds": 3}
    table = table_of(make(100, parameters("base").splits), parameters, make_study, **grid)
    assert numbers(table, TRAIN) == numbers(table, TEST) == list(range(1, 7))


# what is refused


def test_a_copy_with_another_role_is_refused(make, parameters, make_study):
    recordings = make(100, parameters("base").splits).copy(deep=True)
    recordings.angular_rate.loc[{"imu": 2, "recording": 3}] = recordings.angular_rate.sel(
        imu=1, recording=90
    )
    with pytest.raises(
        InputError,
        match=r"IMU 1 recording 90 \(test\) holds the same samples as|"
        r"IMU 2 recording 3 \(train\) holds",
    ):
        table_of(recordings, parameters, make_study)


def test_virtual_recordings_train_and_come_from_recordings_that_train(
    make, parameters, make_study, make_bias
):
    p = parameters(virtual_gyros={"recordings": 4, "train_recordings": 3})
    recordings = make(100, p.splits)
    bias = make_bias(recordings, measure_allan_variance(recordings))
    virtual = synthesise(recordings, bias, p.virtual_gyros)
    table = table_of(recordings, parameters, make_study, virtual)
    drawn = table[table.origin == ORIGIN_VIRTUAL]
    assert set(drawn.role) == {TRAIN}
    assert sorted(drawn.recording.unique()) == [1, 2, 3]
    assert len(drawn) == 8 * 3 * 3
    leaking = virtual.assign_attrs(drawn_from=np.array([1, 90]))
    with pytest.raises(InputError, match="were drawn from recordings 90, which test"):
        table_of(recordings, parameters, make_study, leaking)


# one length


@pytest.fixture
def uneven(make_recordings):
    """Of 60, 40 and 50 s; IMU 2 lacks the second, and four samples are masked."""
    made = make_recordings(np.full((2, 3, 3), 3.0), 1200, RATE_HZ, 0.005)
    for number, length in ((1, 800), (2, 1000)):
        made["samples"][:, number] = length
        made.angular_rate[:, number, :, length:] = np.nan
    made["samples"][1, 1], made.angular_rate[1, 1] = 0, np.nan
    made.angular_rate[0, 0, :, [3, 4, 900, 901]] = np.nan
    return made


def test_recordings_are_cut_to_the_length_that_keeps_most(uneven, make_bias, caplog):
    bias = make_bias(uneven, measure_allan_variance(uneven))
    with caplog.at_level("INFO", "gyro_pipeline"):
        cut, biases, contents = cut_to_common_length(uneven, bias, quality_of(uneven))
    assert caplog.messages == [
        "sparkfun: recordings are 40.0 to 60.0 s; studies use the first 50.0 s of each, the length "
        "of IMU 1 recording 3, 1_3.csv, which keeps most samples, and leave out IMU 1 recording 2 "
        "(1_2.csv). quality.length_s sets another length"
    ]
    assert cut["samples"].values.tolist() == [[1000, 1000], [1000, 1000]]
    assert cut.recording.values.tolist() == [1, 3]
    assert cut.attrs["data_hash"] != uneven.attrs["data_hash"]
    assert len(biases) == 4 * 3
    for row in biases.itertuples():
        samples = cut.angular_rate.sel(imu=row.imu, recording=row.recording, axis=row.axis)
        assert row.bias_dps == pytest.approx(np.nanmean(samples.astype(float)), rel=1e-12)
        place = {"imu": row.imu, "recording": row.recording, "axis": row.axis}
        assert float(cut.recording_mean.sel(place)) == row.bias_dps
    assert contents.masked[0].tolist() == [3, 4, 900, 901]
    assert uneven["samples"].values.tolist() == [[1200, 800, 1000], [1200, 0, 1000]]


def test_recordings_of_one_length_stay_as_they_are(make_recordings, make_bias, caplog):
    alike = make_recordings(np.zeros((1, 2, 3)), 1200, RATE_HZ, 0.005)
    bias = make_bias(alike, measure_allan_variance(alike))
    with caplog.at_level("INFO", "gyro_pipeline"):
        cut, same, _ = cut_to_common_length(alike, bias, quality_of(alike))
    assert cut.angular_rate.identical(alike.angular_rate)
    assert cut.attrs["data_hash"] == alike.attrs["data_hash"]
    assert same is bias
    assert caplog.messages == ["sparkfun: all recordings are 60.0 s"]
