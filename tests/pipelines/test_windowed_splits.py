import numpy as np
import pandas as pd
import pytest

from gyro_pipeline.conventions import InputError
from gyro_pipeline.parameters import Only
from gyro_pipeline.pipelines.ground_truth.nodes import measure_allan_variance
from gyro_pipeline.pipelines.virtual_gyros.nodes import synthesise
from gyro_pipeline.pipelines.windowed_splits.copies import near_copies
from gyro_pipeline.pipelines.windowed_splits.nodes import cut_to_common_length, split_windows
from gyro_pipeline.pipelines.windowed_splits.protocols import check_table
from gyro_pipeline.splits import split_recordings

RATE_HZ = 20.0
pytestmark = pytest.mark.slow


def test_the_seed_chooses_validation_recordings_and_the_source_or_order_those_that_test(parameters):
    first, other = (
        split_recordings(range(100), range(100), parameters("base", splits=seed).splits)
        for seed in ({"split_seed": 1}, {"split_seed": 2})
    )
    one, two = ({n for n in roles if roles[n] == "validation"} for roles in (first, other))
    assert one != two
    assert all(first[n] == other[n] == "test" for n in range(80, 100))
    given = dict.fromkeys(range(1, 31), "train") | {1: "test", 5: "test", 7: "test"}
    without_7 = [n for n in range(1, 31) if n not in (3, 7)]
    roles = split_recordings(range(1, 31), without_7, parameters("base").splits, given)
    assert [n for n, role in roles.items() if role == "test"] == [1, 5, 7]  # of no tested IMU
    assert roles[3] == "train"


def test_the_papers_split_of_100_recordings_and_its_windows(make, table_of, make_bias, parameters):
    recordings = make(100)
    bias = make_bias(recordings, measure_allan_variance(recordings))
    p = parameters(virtual_gyros={"recordings": 4, "train_recordings": 3})
    virtual = synthesise(recordings, bias, p.virtual_gyros)
    for training_windows, starts in (("all", [0, 200, 400]), (5.0, [*range(0, 401, 100)])):
        table = table_of(recordings, virtual, splits={"training_windows": training_windows})
        assert sorted(table[table.role == "train"].start.unique()) == starts
        assert sorted(table[table.role == "test"].start.unique()) == [0, 200, 400]
    drawn, real = (table[table.origin == origin] for origin in ("virtual", "real"))
    assert numbers(real, "test") == list(range(81, 101))
    assert (len(numbers(real, "validation")), len(numbers(real, "train"))) == (8, 72)
    assert numbers(real, "train", imu=2) == numbers(real, "train")
    assert numbers(real, "test", imu=2) == []
    assert table.fold.unique().tolist() == ["hold-out"]
    # virtual recordings train, and come from recordings that train
    assert set(drawn.role) == {"train"}
    assert sorted(drawn.recording.unique()) == [1, 2, 3]
    leaking = virtual.assign_attrs(drawn_from=np.array([1, 90]))
    with pytest.raises(InputError, match="were drawn from recordings 90, which test"):
        table_of(recordings, leaking)


@pytest.fixture(scope="module")
def make(make_recordings, parameters):
    """Recordings of two IMUs, of 30 s, with the split of as many."""

    def made(count, imus=2):
        recordings = make_recordings(np.zeros((imus, count, 3)), 600, RATE_HZ, 0.005)
        numbers = list(range(1, 1 + count))
        split = split_recordings(numbers, numbers, parameters("base").splits)
        if split is not None:
            recordings = recordings.assign_coords(split=("recording", [split[n] for n in numbers]))
        return recordings

    return made


@pytest.fixture(scope="module")
def table_of(parameters, make_study, make_quality):
    """The windows table of a study of 10 s windows, changed as one likes."""

    def made(made_of, /, virtual=None, splits=None, **changes):
        settings = parameters("base", splits=splits or {}).splits
        study = make_study("augmentation").model_copy(update={"windows_s": [10.0]} | changes)
        places = [(i, n) for i in made_of.imu.values for n in made_of.recording.values]
        means = pd.DataFrame(
            [(*place, axis, 0.0) for place in places for axis in "xyz"],
            columns=["imu", "recording", "axis", "bias_dps"],
        )
        cut, _, contents = cut_to_common_length(made_of, means, make_quality(made_of))
        return split_windows(study, cut, contents, settings, [10.0], Only(), virtual)

    return made


def numbers(table, role, fold="hold-out", imu=1):
    rows = table[(table.fold == fold) & (table.role == role) & (table.imu == imu)]
    return sorted(rows.recording.unique().tolist())


@pytest.mark.parametrize(("count", "folds", "validation"), [(4, 4, 0), (21, 5, 2)])
def test_few_recordings_make_a_k_fold_that_tests_each(make, table_of, count, folds, validation):
    table = table_of(make(count))
    names = [f"fold {fold}" for fold in range(folds)]
    assert table.fold.unique().tolist() == [*names, "all recordings"]
    tested = [number for fold in names for number in numbers(table, "test", fold)]
    assert sorted(tested) == list(range(1, 1 + count))
    assert {len(numbers(table, "validation", fold)) for fold in names} == {validation}
    of_model = table[table.fold == "all recordings"]
    assert set(of_model.role) == {"train", "validation"}
    assert len(numbers(of_model, "validation", "all recordings")) == 2
    assert of_model.recording.nunique() == count


def test_what_is_lost_moves_no_recording_to_another_fold(make, table_of, caplog):
    recordings = make(5).copy(deep=True)
    recordings.angular_rate[0, 1, :, 10:50] = np.nan  # the first window of recording 2
    recordings["samples"][0, 2], recordings.angular_rate[0, 2] = 0, np.nan  # only IMU 2 has it
    table = table_of(recordings, splits={"training_windows": "first"})
    assert "lost more than 10% of their samples and are left out; the first one used" in caplog.text
    folds = [f"fold {fold}" for fold in range(4)]
    assert table.fold.unique().tolist() == [*folds, "all recordings"]
    for fold, tested in zip(folds, (1, 2, 4, 5), strict=True):
        assert numbers(table, "test", fold) == [tested]
        train = numbers(table, "train", fold) + numbers(table, "validation", fold)
        assert sorted(train) == [n for n in (1, 2, 4, 5) if n != tested]
        assert 3 in numbers(table, "train", fold, imu=2)
    trained = table[(table.role != "test") & (table.imu == 1)].groupby("recording").start.unique()
    assert {n: [*starts] for n, starts in trained.items()} == {1: [0], 2: [200], 4: [0], 5: [0]}
    tests = table[(table.role == "test") & (table.recording == 2)]
    assert tests.start.tolist() == [200, 400]


def test_every_device_in_turn_is_unseen(make, table_of):
    table = table_of(make(100, imus=3), protocol="leave_one_device_out")
    folds = [*(f"without IMU {imu}" for imu in (1, 2, 3)), "all recordings"]
    assert table.fold.unique().tolist() == folds
    assert numbers(table, "test", "without IMU 2", imu=2) == list(range(81, 101))
    for imu in (1, 3):
        assert numbers(table, "train", "without IMU 2", imu) == list(range(1, 81))
    few = table_of(make(3), protocol="leave_one_device_out")
    assert numbers(few, "test", "without IMU 1") == [1, 2, 3]
    assert numbers(few, "train", "without IMU 1", imu=2) == [1, 2, 3]
    with pytest.raises(InputError, match="expected at least 2 IMUs, got 1; bring recordings"):
        table_of(make(3, imus=1), protocol="leave_one_device_out")


@pytest.mark.parametrize("protocol", ["k_fold", "window_split", "best_epoch_on_test"])
def test_the_leak_studys_windows_test_once_each(make, table_of, protocol):
    table = table_of(make(100), protocol=protocol, recordings=6, folds=3, strides_s=[5.0])
    tests = table[table.role == "test"]
    assert len(tests) == len(tests.drop_duplicates(["recording", "start"])) == 6 * 5
    assert set(tests.imu) == {1}


def test_a_copy_with_another_role_is_refused(make, table_of):
    recordings = make(100).copy(deep=True)
    rates = recordings.angular_rate.sel(imu=1, recording=90).to_numpy()
    shifted = np.roll(rates, 1, axis=-1)
    resampled = (rates + shifted) / 2
    noisy = rates + np.random.default_rng(3).normal(0, 1e-5, rates.shape)
    message = r"IMU 2 recording 3 \(train\) is a copy of IMU 1 recording 90 \(test\)"
    for copied in (noisy, rates + 0.1, shifted, resampled, rates * (1 + 1e-6)):
        recordings.angular_rate.loc[{"imu": 2, "recording": 3}] = copied
        with pytest.raises(InputError, match=message):
            table_of(recordings)
    recordings.angular_rate.loc[{"imu": 2, "recording": [3, 91]}] = make(1).angular_rate[0, 0]
    recordings.angular_rate.loc[{"imu": 2, "recording": 91}] = resampled
    assert len(table_of(recordings))  # both test


def test_a_hum_and_a_drift_that_recordings_share_make_no_copies():
    generator, time_s = np.random.default_rng(0), np.arange(4096) / 150
    rates = generator.normal(0, 0.04, (40, 1, 4096)) + 0.5
    phases = generator.uniform(0, 0.1, (40, 1, 1))
    rates += 0.4 * np.sin(2 * np.pi * 50.3 * time_s + phases) + 0.2 * np.exp(-time_s / 30)
    assert near_copies(rates) == []


@pytest.mark.parametrize(
    ("apart", "row", "message"),
    [
        ("recording", ("test", "real", 1, 1), r"recording 1 .*test \(IMU 1\), train \(IMU 2, 1\)"),
        ("recording", ("validation", "real", 2, 2), r"recording 2 .*test \(IMU 1\), validation"),
        ("imu", ("test", "real", 2, 3), r"imu 2 has more than one role"),
    ],
)
def test_what_has_two_roles_in_a_fold_is_refused(apart, row, message):
    given = [("train", "real", 2, 1), ("test", "real", 1, 2)]
    given += [("train", "real", 1, 1), ("train", "virtual", 1, 2)] if apart == "recording" else []
    rows = [("a fold", *one) for one in given]
    contents = pd.DataFrame(columns=["imu", "recording", "copies"])

    def check(rows):
        columns = ["fold", "role", "origin", "imu", "recording"]
        check_table(pd.DataFrame(rows, columns=columns), apart, contents, [1])

    check(rows)
    check([*rows, ("another fold", "train", "real", 1, 3), ("another fold", "test", "real", 2, 1)])
    with pytest.raises(InputError, match=f"a fold: {message}"):
        check([*rows, ("a fold", *row)])


def test_without_a_window_that_tests_a_study_says_so(make, table_of):
    recordings = make(4).copy(deep=True)
    recordings.angular_rate[..., ::5] = np.nan
    message = "augmentation sparkfun, 10 s windows: no test recording has a .* lower windows_s"
    with pytest.raises(InputError, match=message):
        table_of(recordings, protocol="test_in_training")
    with pytest.raises(InputError, match=r"window of 60 s is 1200 samples .* has 600"):
        table_of(make(4), windows_s=[60.0])
    with pytest.raises(InputError, match="stride of 0.01 s is less than half a sample"):
        table_of(make(4), strides_s=[0.01])


def test_recordings_are_cut_to_what_keeps_most(make_recordings, make_bias, make_quality, caplog):
    """Of 60, 35 and 50 s; IMU 2 lacks the second, and four samples are masked."""
    uneven = make_recordings(np.full((2, 3, 3), 3.0), 1200, RATE_HZ, 0.005)
    for number, length in ((1, 700), (2, 1000)):
        uneven["samples"][:, number] = length
        uneven.angular_rate[:, number, :, length:] = np.nan
    uneven["samples"][1, 1], uneven.angular_rate[1, 1] = 0, np.nan
    uneven.angular_rate[0, 0, :, [3, 4, 900, 901]] = np.nan
    bias = make_bias(uneven, measure_allan_variance(uneven))
    with caplog.at_level("INFO", "gyro_pipeline"):
        cut, biases, contents = cut_to_common_length(uneven, bias, make_quality(uneven))
    assert "use the first 50.0 s of each, the length of IMU 1 recording 3" in caplog.text
    assert "leave out IMU 1 recording 2 (1_2.csv). quality.length_s sets another" in caplog.text
    assert cut["samples"].values.tolist() == [[1000, 1000], [1000, 1000]]
    assert cut.recording.values.tolist() == [1, 3]
    assert cut.attrs["data_hash"] != uneven.attrs["data_hash"]
    assert len(biases) == 4 * 3
    for row in biases.itertuples():
        place = {"imu": row.imu, "recording": row.recording, "axis": row.axis}
        samples = cut.angular_rate.sel(place).astype(float)
        assert row.bias_dps == pytest.approx(np.nanmean(samples), rel=1e-12)
        assert float(cut.recording_mean.sel(place)) == row.bias_dps
    assert contents.masked[0].tolist() == [3, 4, 900, 901]
    assert uneven["samples"].values.tolist() == [[1200, 700, 1000], [1200, 0, 1000]]
