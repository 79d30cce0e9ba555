import pickle
from itertools import chain, permutations

import numpy as np
import pytest
from kedro.io import DatasetError

from gyro_pipeline.conventions import InputError
from gyro_pipeline.datasets.array_logs import LAYOUT, ArrayLogs

SENSORS = {"memsense": {"imus": 2, "samples": 13000, "recording_s": 52}}
TRAIN_TEST = {"test": "test.npy", "train": "train.npy"}


def array_logs(folder, files=None, sensor="memsense", **options):
    return ArrayLogs(sensor, SENSORS, "array", str(folder), files or {"all": "all.npy"}, **options)


def made(recordings, gyroscopes, samples, seed=0):
    return np.random.default_rng(seed).normal(size=(recordings, gyroscopes, samples))


def check(logs, *arrays):
    """All of these recordings are read, numbered on from array to array."""
    expected = {
        (imu, number): recording[3 * imu - 3 : 3 * imu].T
        for number, recording in enumerate(chain(*arrays), 1)
        for imu in range(1, len(recording) // 3 + 1)
    }
    read = {(entry.imu, entry.recording): entry.read().samples for entry in logs.load().entries}
    assert list(read) == sorted(expected)
    for place, samples in read.items():
        np.testing.assert_array_equal(samples, expected[place])


def refusal(logs):
    with pytest.raises(DatasetError) as caught:
        logs.load()
    assert isinstance(caught.value.__cause__, InputError)
    return str(caught.value.__cause__)


def test_a_recording_says_where_it_is_and_can_be_read_by_another_process(tmp_path):
    array = np.asfortranarray(np.arange(5 * 6 * 200, dtype=np.int16).reshape(5, 6, 200))
    np.save(tmp_path / "all.npy", array)
    logs = array_logs(tmp_path).load()
    told = (logs.sensor, logs.source, logs.simulated, logs.rate_hz, logs.truth)
    assert told == ("memsense", "array", False, 250, None)
    entry = pickle.loads(pickle.dumps(logs.entries[7]))
    assert (entry.imu, entry.recording, entry.split) == (2, 3, None)
    assert entry.where == "all.npy recording 3"
    log = entry.read()
    np.testing.assert_array_equal(log.samples, array[2, 3:].T)
    assert log.samples.dtype == np.float64
    assert (log.rate_hz, log.gap_rows.size, log.temperature_c, log.findings) == (None, 0, None, ())


def test_train_and_test_are_numbered_on_and_an_imu_may_lack_recordings(tmp_path):
    train, test = made(7, 6, 200), made(2, 3, 201, seed=1)
    np.save(tmp_path / "train.npy", train)
    assert not array_logs(tmp_path, TRAIN_TEST).exists()
    message = refusal(array_logs(tmp_path, TRAIN_TEST))
    assert f"memsense test.npy: no such file in {tmp_path}" in message
    np.save(tmp_path / "test.npy", test)
    source = array_logs(tmp_path, TRAIN_TEST)
    assert source.exists()
    check(source, train, test)
    entries = source.load().entries
    assert all(entry.split == ("test" if entry.recording > 7 else "train") for entry in entries)
    assert len({entry.key for entry in entries}) == len(entries)


def test_an_ambiguous_shape_is_settled_by_the_other_file_or_axes_order(tmp_path):
    array = made(5, 6, 200)
    for order in permutations(LAYOUT):  # any gives the same recordings
        np.save(tmp_path / "all.npy", array.transpose([LAYOUT.index(name) for name in order]))
        check(array_logs(tmp_path), array)
    np.save(tmp_path / "train.npy", train := made(9, 6, 200))
    message = refusal(array_logs(tmp_path, {"all": "train.npy"}))
    assert message.startswith("memsense train.npy of shape (9, 6, 200): axes_order in the catalog")
    assert "[recording, gyroscope, sample] or [gyroscope, recording, sample]" in message
    order = ["gyroscope", "recording", "sample"]
    check(array_logs(tmp_path, {"all": "train.npy"}, axes_order=order), train.transpose(1, 0, 2))
    np.save(tmp_path / "test.npy", test := made(2, 6, 200))
    check(array_logs(tmp_path, TRAIN_TEST), train, test)
    np.save(tmp_path / "all.npy", unusual := made(50, 3, 60))
    check(array_logs(tmp_path, axes_order=LAYOUT), unusual)
    assert refusal(array_logs(tmp_path)).endswith("they can be none")
    np.save(tmp_path / "all.npy", made(5, 3, 200))
    message = refusal(array_logs(tmp_path, axes_order=["sample", "gyroscope", "recording"]))
    assert message.endswith("they can be [recording, gyroscope, sample]")


@pytest.mark.parametrize(("shape", "dtype"), [((5, 3, 200), "complex64"), ((2, 600), "f8")])
def test_what_is_no_array_of_rates_is_refused(tmp_path, shape, dtype):
    np.save(tmp_path / "all.npy", np.zeros(shape, dtype))
    message = refusal(array_logs(tmp_path))
    assert "expected real numbers in deg/s along 3 axes" in message
    assert f"got {np.dtype(dtype)} of shape {shape}" in message
    with pytest.raises(InputError, match="unknown sensor 'memsens'; expected one of memsense"):
        array_logs(tmp_path, sensor="memsens")
    with pytest.raises(InputError, match="expected train and test, two different files"):
        array_logs(tmp_path, {"train": "a.npy", "test": "a.npy"})


def test_damaged_files_and_pickles_are_refused_by_name_and_nothing_is_unpickled(tmp_path):
    file = tmp_path / "all.npy"
    np.save(file, made(5, 3, 200))
    whole, shape = file.read_bytes(), b"(5, 3, 200)"
    trap = f"cos\nmkdir\n(V{tmp_path / 'sprung'}\ntR.".encode()
    damaged = [b"", whole[:40], whole[:-1], b"time,w_x,w_y,w_z\n" * 10, trap]
    damaged += [whole.replace(shape, b"(5,3,-200)"), whole.replace(shape, b"(5, 3, 200}")]
    for content in damaged:
        file.write_bytes(content)
        message = refusal(array_logs(tmp_path))
        assert message.startswith("memsense all.npy: expected a plain numeric .npy file")
        assert message.endswith(f"which are never loaded; replace or delete {file}")
    assert not (tmp_path / "sprung").exists()
