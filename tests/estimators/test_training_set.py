"""What a training set holds for an estimator, in which order, and what is read for it."""

import pickle

import numpy as np
import pandas as pd
import pytest
import xarray as xr

from gyro_pipeline.conventions import AXES, DIMENSIONS
from gyro_pipeline.estimators import training_set as module
from gyro_pipeline.estimators.training_set import TrainingSet

SIZE, SAMPLES, RATE = 20, 100, 10.0


def drawn(imus=3, recordings=6, seed=0):
    rates = np.random.default_rng(seed).normal(size=(imus, recordings, 3, SAMPLES))
    coords = {"imu": range(1, 1 + imus), "recording": range(1, 1 + recordings), "axis": list(AXES)}
    data = {
        "angular_rate": (DIMENSIONS, rates.astype(np.float32)),
        "samples": (DIMENSIONS[:2], np.full((imus, recordings), SAMPLES)),
        "recording_mean": (DIMENSIONS[:-1], rates.mean(axis=-1)),
    }
    return xr.Dataset(data, coords, {"rate_hz": RATE, "data_hash": str(seed)})


def table(*rows):
    """Rows of role, origin, IMU, recordings and starts."""
    made = pd.DataFrame(rows, columns=["role", "origin", "imu", "recording", "start"])
    return made.explode("recording").explode("start").astype({"recording": int, "start": int})


WINDOWS = table(
    ("train", "virtual", 1, [1, 2], [0]),
    ("train", "real", 3, [5, 4], [20, 0]),
    ("validation", "real", 2, [3], [0]),
    ("train", "real", 2, [6, 1], [40]),
    ("train", "real", 1, [2], [0]),
)


@pytest.fixture
def training():
    return TrainingSet(drawn(), drawn(2, 2, seed=1), WINDOWS, SIZE, device=2)


def places(training):
    return [(origin, imu, one.numbers.tolist()) for (origin, imu), one in training.imus.items()]


def test_the_device_comes_first_virtual_imus_last_and_a_part_is_what_an_estimator_uses(training):
    assert places(training) == [
        *(("real", 2, [1, 3, 6]), ("real", 1, [2]), ("real", 3, [4, 5])),
        ("virtual", 1, [1, 2]),
    ]
    assert [s.tolist() for s in training.imus["real", 3].starts] == [[0, 20], [0, 20]]
    unseen = TrainingSet(training.real, training.virtual, WINDOWS, SIZE, device=9)
    assert training.labels[0].tolist() == [1, 3, 6]
    assert unseen.labels[0].tolist() == [2, 1, 3, 6, 4, 5]
    cases = [(training, "nothing", []), (training, "own", [2]), (training, "real", [2, 1, 3])]
    for one, uses, imus in [*cases, (unseen, "own", [1, 2, 3]), (unseen, "real", [1, 2, 3])]:
        part = one.part(uses)
        assert [imu for _, imu, _ in places(part)] == imus
        assert {origin for origin, *_ in places(part)} <= {"real"}
    assert len(training.part("all").imus) == 4


def test_keys_tell_training_sets_and_recordings_apart(training):
    def other(windows=WINDOWS, size=SIZE, device=2):
        return TrainingSet(training.real, training.virtual, windows, size, device)

    assert other(WINDOWS.sample(frac=1, random_state=0)).key == training.key
    keys = {training.key, other(WINDOWS[1:]).key, other(size=10).key, other(device=1).key}
    assert len(keys) == 4
    moved = WINDOWS.assign(start=WINDOWS.start + 1)
    assert other(moved).key != training.key
    assert other(moved).recordings_key == training.recordings_key


def test_recordings_are_read_once_for_all_folds_and_pickled_as_references(tmp_path, monkeypatch):
    monkeypatch.setattr(module, "_FILE_CACHE", module._array_cache())
    drawn().to_netcdf(tmp_path / "recordings.nc", engine="h5netcdf")
    filed = xr.open_dataset(tmp_path / "recordings.nc", engine="h5netcdf")
    windows = table(("train", "real", 1, range(1, 7), [0]))
    first = TrainingSet(filed, None, windows, SIZE, 1)
    noise, means = first.white_noise, first.labels[1]
    monkeypatch.setattr(module, "allan_variance", lambda *_: pytest.fail("once is enough"))
    again = TrainingSet(filed, None, windows[1:], SIZE, 1)
    np.testing.assert_allclose(again.labels[1], means[1:])
    assert np.isfinite([noise, again.white_noise]).all()
    np.testing.assert_array_equal(again.rates, drawn().angular_rate.to_numpy()[0, 1:])
    pickled = pickle.dumps(again)
    assert len(pickled) < filed.angular_rate.nbytes
    np.testing.assert_array_equal(pickle.loads(pickled).rates, again.rates)
