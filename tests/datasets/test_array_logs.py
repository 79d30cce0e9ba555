import os
import pickle
from itertools import permutations, product
from pathlib import Path

import numpy as np
import pytest
from kedro.io import DatasetError

from gyro_pipeline.conventions import InputError
from gyro_pipeline.datasets.array_logs import LAYOUT, ArrayLogs

SENSORS = {"memsense": {"imus": 2, "samples": 13000, "recording_s": 52}}
TRAIN_TEST = {"train": "train.npy", "test": "test.npy"}


def array_logs(folder, files=None, **options):
    options = {"sensor": "memsense", "sensors": SENSORS, "source": "array"} | options
    return ArrayLogs(path=str(folder), files=files or {"all": "all.npy"}, **options)


def made(recordings, gyroscopes, samples, seed=0):
    return np.random.default_rng(seed).normal(size=(recordings, gyroscopes, samples))


def ramps(recordings, gyroscopes, samples):
    """Every value tells its recording, gyroscope and sample: 11.0207 is 10, 1 and 207."""
    r, g, s = np.ogrid[:recordings, :gyroscopes, :samples]
    return 100.0 * r + g + s / 10_000


def rates(logs):
    """All samples of a source, (imu, recording, axis, sample), float32; NaN where it has none."""
    read = {(entry.imu, entry.recording): entry.read().samples.T for entry in logs.load().entries}
    imus, recordings = map(max, zip(*read, strict=True))
    absent = np.full_like(next(iter(read.values())), np.nan)
    numbers = product(range(1, imus + 1), range(1, recordings + 1))
    stacked = np.array([read.get(number, absent) for number in numbers], dtype=np.float32)
    return stacked.reshape(imus, recordings, *absent.shape)


def refusal(logs):
    with pytest.raises(DatasetError) as caught:
        logs.load()
    assert isinstance(caught.value.__cause__, InputError)
    return str(caught.value.__cause__)


@pytest.mark.parametrize("order", list(permutations(LAYOUT)))
def test_any_axis_order_gives_the_same_recordings(tmp_path, order):
    array = ramps(5, 6, 200)
    np.save(tmp_path / "all.npy", array.transpose([LAYOUT.index(name) for name in order]))
    rate = rates(array_logs(tmp_path))
    assert rate.shape == (2, 5, 3, 200)
    # gyroscope 4 (0-based) is IMU 2's y axis
    np.testing.assert_array_equal(rate[1, 4, 1], array[4, 4].astype(np.float32))
    np.save(tmp_path / "plain.npy", array)
    np.testing.assert_array_equal(rate, rates(array_logs(tmp_path, {"all": "plain.npy"})))


def test_recordings_are_listed_by_imu_and_say_where_they_are(tmp_path):
    np.save(tmp_path / "all.npy", made(5, 6, 200))
    logs = array_logs(tmp_path).load()
    numbers = [(entry.imu, entry.recording) for entry in logs.entries]
    assert numbers == [(imu, recording) for imu in (1, 2) for recording in (1, 2, 3, 4, 5)]
    assert logs.entries[7].where == "all.npy recording 3"
    assert {entry.split for entry in logs.entries} == {None}
    assert (logs.sensor, logs.source, logs.simulated, logs.rate_hz) == (
        *("memsense", "array", False, 250),
    )
    assert logs.drawn is None


def test_a_recording_is_read_alone_and_can_be_read_by_another_process(tmp_path):
    array = ramps(5, 6, 200)
    np.save(tmp_path / "all.npy", array)
    entry = pickle.loads(pickle.dumps(array_logs(tmp_path).load().entries[7]))
    log = entry.read()
    np.testing.assert_array_equal(log.samples, array[2, 3:].T)
    assert log.samples.dtype == np.float64
    assert (log.rate_hz, log.gap_rows.size, log.temperature_c, log.findings) == (None, 0, None, ())


def test_train_and_test_are_numbered_on_and_an_imu_may_lack_recordings(tmp_path):
    train, test = ramps(7, 6, 200), 1000 + ramps(2, 3, 200)
    np.save(tmp_path / "train.npy", train)
    np.save(tmp_path / "test.npy", test)
    source = array_logs(tmp_path, {"test": "test.npy", "train": "train.npy"})
    numbers = {(entry.imu, entry.recording): entry.split for entry in source.load().entries}
    assert numbers == {(imu, recording): "train" for imu in (1, 2) for recording in range(1, 8)} | {
        (1, 8): "test",
        (1, 9): "test",
    }
    rate = rates(source)
    np.testing.assert_array_equal(rate[0, 8, 2], test[1, 2].astype(np.float32))
    np.testing.assert_array_equal(rate[1, 6, 2], train[6, 5].astype(np.float32))
    assert np.isnan(rate[1, 7:]).all()


def test_integers_and_fortran_order_are_read(tmp_path):
    array = np.asfortranarray(np.arange(5 * 3 * 60, dtype=np.int16).reshape(5, 3, 60))
    np.save(tmp_path / "all.npy", array)
    np.testing.assert_array_equal(rates(array_logs(tmp_path)), array[None])


def test_an_ambiguous_shape_is_settled_by_the_other_file_or_axes_order(tmp_path):
    np.save(tmp_path / "train.npy", ramps(9, 6, 200))
    message = refusal(array_logs(tmp_path, {"all": "train.npy"}))
    assert message.startswith("memsense train.npy of shape (9, 6, 200): axes_order in the catalog")
    assert "[recording, gyroscope, sample] or [gyroscope, recording, sample]" in message
    order = ["gyroscope", "recording", "sample"]
    rate = rates(array_logs(tmp_path, {"all": "train.npy"}, axes_order=order))
    assert rate.shape == (3, 6, 3, 200)
    assert rate[2, 1, 0, 7] == np.float32(601.0007)
    np.save(tmp_path / "test.npy", made(2, 6, 200))
    assert rates(array_logs(tmp_path, TRAIN_TEST)).shape == (2, 11, 3, 200)


@pytest.mark.parametrize(
    ("shape", "order", "shown"),
    [
        ((50, 3, 60), None, "none"),
        ((5, 3, 200), ["sample", "gyroscope", "recording"], "[recording, gyroscope, sample]"),
        ((5, 3, 200), ["recording", "sample", "gyroscope"], "[recording, gyroscope, sample]"),
        ((5, 4, 200), LAYOUT, "none"),
    ],
)
def test_an_order_that_the_shape_contradicts_is_refused(tmp_path, shape, order, shown):
    np.save(tmp_path / "all.npy", made(*shape))
    message = refusal(array_logs(tmp_path, axes_order=order))
    assert "axes_order in the catalog entry: expected recording or gyroscope or sample" in message
    assert message.endswith(f"recordings or gyroscopes: {shown}")


def test_axes_order_reads_shapes_that_do_not_look_like_logs(tmp_path):
    np.save(tmp_path / "all.npy", made(50, 3, 60))
    assert rates(array_logs(tmp_path, axes_order=LAYOUT)).shape == (1, 50, 3, 60)


@pytest.mark.parametrize(
    ("shape", "dtype"),
    [
        *(((5, 3, 200), dtype) for dtype in ("complex64", "bool", "U3", "m8[s]", [("x", "f4")])),
        *(((2, 600), "f8"), ((0, 3, 200), "f8")),
    ],
)
def test_what_is_no_array_of_rates_is_refused(tmp_path, shape, dtype):
    np.save(tmp_path / "all.npy", np.zeros(shape, dtype))
    assert refusal(array_logs(tmp_path)) == (
        "memsense all.npy: expected real numbers in deg/s along 3 axes (recordings, gyroscopes, "
        f"samples in any order), got {np.dtype(dtype)} of shape {shape}"
    )


def test_missing_file(tmp_path):
    logs = array_logs(tmp_path, TRAIN_TEST)
    np.save(tmp_path / "train.npy", made(5, 6, 200))
    assert not logs.exists()
    assert f"memsense test.npy: no such file in {tmp_path}" in refusal(logs)
    np.save(tmp_path / "test.npy", made(2, 3, 200))
    assert logs.exists()


class Trap:
    """Unpickling one leaves a file behind."""

    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return Path.touch, (self.path,)


def test_pickles_are_refused_without_being_loaded(tmp_path):
    sprung = tmp_path / "sprung"
    np.save(tmp_path / "all.npy", np.array([[[Trap(sprung)]]], dtype=object), allow_pickle=True)
    assert "pickled objects, which are never loaded" in refusal(array_logs(tmp_path))
    (tmp_path / "all.npy").write_bytes(pickle.dumps(Trap(sprung)))
    assert "pickled objects, which are never loaded" in refusal(array_logs(tmp_path))
    assert not sprung.exists()


def damaged_files():
    yield "empty", lambda whole: b""
    yield "truncated header", lambda whole: whole[:40]
    yield "truncated samples", lambda whole: whole[:-1]
    yield "text", lambda whole: b"time,w_x,w_y,w_z\n" * 10
    yield "negative shape", lambda whole: whole.replace(b"(5, 3, 200)", b"(5,3,-200)")
    yield "unbalanced header", lambda whole: whole.replace(b"(5, 3, 200)", b"(5, 3, 200}")


@pytest.mark.parametrize("damage", [pytest.param(f, id=name) for name, f in damaged_files()])
def test_damaged_files_are_refused_by_name(tmp_path, damage):
    file = tmp_path / "all.npy"
    np.save(file, made(5, 3, 200))
    file.write_bytes(damage(file.read_bytes()))
    message = refusal(array_logs(tmp_path))
    assert message.startswith("memsense all.npy: expected a plain numeric .npy file")
    assert message.endswith(f"replace or delete {file}")


def test_sample_counts_may_differ_and_keys_too(tmp_path):
    np.save(tmp_path / "train.npy", made(7, 6, 200))
    np.save(tmp_path / "test.npy", made(2, 3, 201))
    entries = array_logs(tmp_path, TRAIN_TEST).load().entries
    assert {len(entry.read().samples) for entry in entries} == {200, 201}
    assert len({entry.key for entry in entries}) == len(entries) == 7 * 2 + 2


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"sensor": "memsens"}, "unknown sensor 'memsens'; conf/base/globals.yml knows memsense"),
        ({"sensors": {"memsense": SENSORS["memsense"] | {"imus": 0}}}, "imus"),
        ({"sensors": {"memsense": SENSORS["memsense"] | {"imu": 1}}}, "imu"),
        ({"files": {"train": "a.npy"}}, "expected a train and a test file"),
        ({"files": {"train": "a.npy", "test": "a.npy"}}, "which are not the same one"),
        ({"axes_order": ["recording", "sample"]}, "expected recording, gyroscope, sample"),
    ],
)
def test_a_wrong_entry_is_refused_before_anything_is_read(tmp_path, options, said):
    with pytest.raises(InputError) as caught:
        array_logs(tmp_path, **options)
    assert said in str(caught.value)


def test_the_real_memsense_file_gives_the_known_running_mean():
    folder = os.environ.get("GYRO_PIPELINE_REAL_DATA")
    if not folder:
        pytest.skip("GYRO_PIPELINE_REAL_DATA does not name the folder of memsense_test_real.npy")
    samples = rates(array_logs(folder, {"all": "memsense_test_real.npy"})).astype(np.float64)
    assert samples.shape == (1, 11, 3, 13000)
    error = samples[..., :2500].mean(axis=-1) - samples.mean(axis=-1)
    assert np.sqrt(np.mean(error**2)) == pytest.approx(0.0015854, abs=5e-8)
