import errno
import logging
import os
import pickle

import h5py
import numpy as np
import pytest
from kedro.io import DatasetError

from gyro_pipeline.conventions import InputError
from gyro_pipeline.datasets import parse_cache
from gyro_pipeline.datasets.file_logs import FileLogs
from gyro_pipeline.logs import KEPT, Finding, Log, Logs

SENSORS = {
    "dot": {
        "imus": 5,
        "recordings": 100,
        "train_recordings": 80,
        "samples": 1200,
        "recording_s": 10,
        "simulated": {
            "noise_mdps_rts": [5.4, 5.4, 5.4],
            "turn_on_spread_mdps": [0.3, 0.3, 0.3],
            "unit_bias_dps": 3,
        },
    }
}


def file_logs(folder, pattern, **options):
    cache = {"path": str(folder / ".read")}
    options = {"sensor": "dot", "sensors": SENSORS, "source": "mine", "cache": cache} | options
    return FileLogs(path=str(folder), pattern=pattern, **options)


def put(folder, *names):
    """Files of ten rows; the first rate is the file's place among the names."""
    for place, name in enumerate(names):
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        rows = (f"{row / 120:.6f},{place},{row},0.5\n" for row in range(10))
        path.write_text("Time (s),w_x (deg/s),w_y (deg/s),w_z (deg/s)\n" + "".join(rows))


def numbers(logs):
    return {entry.where: (entry.imu, entry.recording) for entry in logs.load().entries}


def refusal(logs):
    with pytest.raises(DatasetError) as caught:
        logs.load()
    assert isinstance(caught.value.__cause__, InputError)
    return str(caught.value.__cause__)


@pytest.mark.parametrize(
    ("pattern", "expected"),
    [
        ("{imu}/{recording}.csv", {"1/2.csv": (1, 2), "1/10.csv": (1, 10), "3/2.csv": (3, 2)}),
        ("dot_{imu}.csv", {"dot_4.csv": (4, 1), "dot_05.csv": (5, 1)}),
        ("run{recording}.csv", {"run7.csv": (1, 7)}),
        ("only.csv", {"only.csv": (1, 1)}),
        ("{imu:name}.csv", {"1.csv": (1, 1), "1²2.csv": (2, 1)}),
        # in the order of their names, 2 before 10
        ("{imu}_*.csv", {"1_b2.csv": (1, 1), "1_b10.csv": (1, 2), "2_a.csv": (2, 1)}),
        ("*/log*.csv", {"1/log2.csv": (1, 1), "1/log10.csv": (1, 2), "2/log1.csv": (1, 3)}),
        ("D{imu:name}.csv", {"D2A.csv": (1, 1), "D10.csv": (2, 1), "DAF.csv": (3, 1)}),
        (
            "{recording:name}/{imu}.csv",
            {"mon/1.csv": (1, 1), "mon/2.csv": (2, 1), "tue/2.csv": (2, 2)},
        ),
    ],
)
def test_the_pattern_gives_imu_and_recording(tmp_path, pattern, expected):
    put(tmp_path, *expected, ".hidden_1.csv", "notes.txt")
    assert numbers(file_logs(tmp_path, pattern)) == expected


def test_files_behind_links_count_and_circles_end(tmp_path):
    put(tmp_path, "in/1/1.csv", "elsewhere/1.csv")
    (tmp_path / "in/2").symlink_to(tmp_path / "elsewhere")
    (tmp_path / "in/1/back").symlink_to(tmp_path / "in")
    assert numbers(file_logs(tmp_path / "in", "{imu}/{recording}.csv")) == {
        "1/1.csv": (1, 1),
        "2/1.csv": (2, 1),
    }
    (tmp_path / "in/1/2.csv").symlink_to(tmp_path / "nowhere")
    message = refusal(file_logs(tmp_path / "in", "{imu}/{recording}.csv"))
    assert "1/2.csv: cannot be read: No such file or directory; correct the link" in message


def test_lock_files_are_no_recordings(tmp_path):
    put(tmp_path, "1.csv", "~$1.csv")
    assert numbers(file_logs(tmp_path, "{imu:name}.csv")) == {"1.csv": (1, 1)}


def test_a_cache_that_cannot_be_written_to_is_refused(tmp_path):
    put(tmp_path, "1.csv")
    (tmp_path / "file").touch()
    message = refusal(file_logs(tmp_path, "{imu}.csv", cache={"path": str(tmp_path / "file")}))
    assert "is a file where a folder is needed" in message


def test_sensors_may_share_a_cache(tmp_path, counted):
    put(tmp_path, "a/1.csv", "b/1.csv")
    both = SENSORS | {"other": SENSORS["dot"]}
    cache = {"path": str(tmp_path / "read")}
    for _ in range(2):
        read_all(file_logs(tmp_path / "a", "{imu}.csv", cache=cache))
        read_all(file_logs(tmp_path / "b", "{imu}.csv", cache=cache, sensor="other", sensors=both))
    assert counted[0] == ["1.csv"] * 2


def test_entries_are_in_the_order_of_imu_and_recording_and_read_their_own_file(tmp_path):
    put(tmp_path, "2_1.csv", "1_10.csv", "1_9.csv")
    logs = file_logs(tmp_path, "{imu}_{recording}.csv").load()
    assert (logs.sensor, logs.source, logs.simulated, logs.rate_hz) == ("dot", "mine", False, 120)
    assert [entry.where for entry in logs.entries] == ["1_9.csv", "1_10.csv", "2_1.csv"]
    assert [entry.size for entry in logs.entries] == [
        (tmp_path / entry.where).stat().st_size for entry in logs.entries
    ]
    first = pickle.loads(pickle.dumps(logs.entries[0])).read()
    np.testing.assert_array_equal(first.samples, [[2, row, 0.5] for row in range(10)])
    assert first.rate_hz == pytest.approx(120, rel=1e-3)


def test_files_that_do_not_match_are_named(tmp_path, caplog):
    put(tmp_path, "dot_1.csv", "dot_x.csv", "readme.txt", ".hidden")
    with caplog.at_level(logging.INFO, "gyro_pipeline"):
        file_logs(tmp_path, "dot_{imu}.csv").load()
    assert caplog.messages == [
        f"dot {tmp_path}: 2 files are not like dot_{{imu}}.csv: dot_x.csv, readme.txt",
        f"dot: files of 1 IMUs in {tmp_path}, where globals.yml says imus: 5",
    ]


def test_names_that_became_numbers_are_said(tmp_path, caplog):
    put(tmp_path, "D2A.csv", "D10.csv")
    with caplog.at_level(logging.INFO, "gyro_pipeline"):
        file_logs(tmp_path, "D{imu:name}.csv").load()
    assert caplog.messages[0] == "dot: 2 imus by name: 2A is 1, 10 is 2"


@pytest.mark.parametrize(
    ("names", "pattern", "words"),
    [
        (["a.csv"], "dot_{imu}.csv", ["files like dot_{imu}.csv, got a.csv;", "pattern"]),
        ([f"{n}.txt" for n in range(9)], "{imu}.csv", ["got 0.txt, 1.txt, 2.txt, 3.txt, 4.txt, …"]),
        ([], "{imu}.csv", ["got none"]),
        (["1.csv", "01.csv"], "{imu}.csv", ["01.csv and 1.csv", "recording 1 of IMU 1", "remove"]),
        (["1/2_a.csv", "1/2_b.csv"], "{imu}/{recording}_*.csv", ["1/2_a.csv and 1/2_b.csv"]),
        (
            [f"{imu}/{imu}{number}.csv" for imu in "abc" for number in range(3)],
            "{imu:name}/{recording:name}.csv",
            ["9 recordings of 3 IMUs with 9 different numbers", "write * for the recording"],
        ),
        (["0.csv"], "{imu}.csv", ["0.csv", "from 1 on for {imu}", "{imu:name}"]),
        (["9" * 30 + ".csv"], "{imu}.csv", ["at most 18 digits for {imu}", "{imu:name}"]),
    ],
)
def test_files_that_cannot_be_told_apart_are_refused(tmp_path, names, pattern, words):
    put(tmp_path, *names)
    message = refusal(file_logs(tmp_path, pattern))
    assert message.startswith("dot")
    for word in words:
        assert word in message


def test_a_missing_folder(tmp_path):
    logs = file_logs(tmp_path / "nowhere", "{imu}.csv")
    assert not logs.exists()
    assert f"dot {tmp_path / 'nowhere'}: no such folder; put the files there" in refusal(logs)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"pattern": "{sensor}_{imu}.csv"}, "expected {imu}, {recording}, {imu:name}"),
        ({"pattern": "{imu}_{imu}.csv"}, "{imu} is there twice"),
        ({"pattern": "{imu.csv"}, "expected {imu}"),
        ({"sensor": "dott"}, "unknown sensor 'dott'"),
        (
            {"pattern": "{imu}{recording}.csv"},
            "expected a character of the names before {recording}",
        ),
        ({"pattern": "dot*{imu}.csv"}, "expected a character of the names before {imu}"),
        ({"pattern": "{imu}0{recording}.csv"}, "expected no digit behind a number, got '0'"),
        ({"pattern": "{imu}7.csv"}, "expected no digit behind a number, got '7'"),
        ({"pattern": 5}, "dot: pattern in the catalog entry: expected a text"),
        ({"reader": {"unit": "deg/s"}}, "dot: reader in the catalog entry"),
        (
            {"reader": {"format": "movela_dot"}},
            "dot: reader in the catalog entry: expected format auto, movella_dot, ",
        ),
        ({"cache": {"path": ""}}, "dot: cache in the catalog entry: expected {path: a folder}"),
        (
            {"cache": "data"},
            "dot: cache in the catalog entry: expected {path: a folder}, got 'data'",
        ),
        ({"cache": {}}, "dot: cache in the catalog entry: expected {path: a folder}, got {}"),
    ],
)
def test_a_wrong_entry_is_refused_before_anything_is_read(tmp_path, options, words):
    with pytest.raises(InputError) as caught:
        file_logs(tmp_path, **{"pattern": "{imu}.csv"} | options)
    assert words in str(caught.value)


def test_logs_are_read_only(tmp_path):
    with pytest.raises(DatasetError, match="read only"):
        file_logs(tmp_path, "{imu}.csv").save(Logs("dot", "mine", False, 120, []))


# what is kept of files that were read


@pytest.fixture
def counted(monkeypatch):
    """Names of the files that are read, and what each of them gives."""
    names = []
    log = Log(
        np.array([[0.1, np.nan, np.inf]]),
        **{"rate_hz": 120.5, "gap_rows": np.array([3, 7]), "temperature_c": np.array([21.5])},
        findings=(Finding("time", KEPT, "jitter of 3 ms"),),
    )

    def read_log(path, *_):
        names.append(path.name)
        if path.read_text().startswith("bad"):
            raise InputError(f"{path.name}: bad")
        return log

    monkeypatch.setattr(parse_cache, "read_log", read_log)
    return names, log


def read_all(logs):
    read = []
    for entry in logs.load().entries:
        try:
            read.append(entry.read())
        except InputError:
            read.append(None)
    return read


def test_what_was_read_before_is_not_read_again_and_the_same(tmp_path, counted, caplog):
    names, log = counted
    put(tmp_path, "1.csv", "2.csv")
    logs = file_logs(tmp_path, "{imu}.csv")
    logs.load().entries[0].read()  # and then it was interrupted
    with caplog.at_level(logging.INFO, "gyro_pipeline"):
        again, _ = read_all(logs)
    assert names == ["1.csv", "2.csv"]
    assert caplog.messages[-1] == "dot: 1 of 2 files were read before"
    np.testing.assert_array_equal(again.samples, log.samples.astype(np.float32))
    np.testing.assert_array_equal(again.gap_rows, log.gap_rows)
    np.testing.assert_array_equal(again.temperature_c, log.temperature_c)
    assert (again.rate_hz, again.findings) == (log.rate_hz, log.findings)


def rewrite(path):
    path.write_text(path.read_text() + "1,2,3,4\n")


def touch(path):
    os.utime(path, ns=(1, 1))


@pytest.mark.parametrize("change", [rewrite, touch])
def test_a_changed_file_is_read_anew_and_its_old_reading_removed(tmp_path, counted, change):
    put(tmp_path, "1.csv", "2.csv")
    logs = file_logs(tmp_path, "{imu}.csv")
    read_all(logs)
    change(tmp_path / "1.csv")
    read_all(logs)
    assert counted[0] == ["1.csv", "2.csv", "1.csv"]
    assert len(list((tmp_path / ".read").iterdir())) == 2


def test_other_options_and_other_readers_read_anew(tmp_path, counted, monkeypatch):
    put(tmp_path, "1.csv")
    read_all(file_logs(tmp_path, "{imu}.csv"))
    slow = {"dot": SENSORS["dot"] | {"recording_s": 20}}
    read_all(file_logs(tmp_path, "{imu}.csv", sensors=slow))
    monkeypatch.setattr("gyro_pipeline.datasets.file_logs._readers_hash", lambda: "another")
    read_all(file_logs(tmp_path, "{imu}.csv", sensors=slow))
    assert counted[0] == ["1.csv"] * 3


def test_a_damaged_reading_is_none(tmp_path, counted):
    put(tmp_path, "1.csv")
    logs = file_logs(tmp_path, "{imu}.csv")
    read_all(logs)
    (kept,) = (tmp_path / ".read").iterdir()
    kept.write_bytes(kept.read_bytes()[:-30])
    assert read_all(logs)[0] is not None
    assert counted[0] == ["1.csv"] * 2


def test_why_a_file_is_refused_is_kept_too(tmp_path, counted):
    (tmp_path / "1.csv").write_text("bad")
    logs = file_logs(tmp_path, "{imu}.csv")
    (entry,) = logs.load().entries
    for _ in range(2):
        with pytest.raises(InputError, match="^1.csv: bad$"):
            entry.read()
    assert counted[0] == ["1.csv"]


def test_that_a_file_could_not_be_read_this_time_is_not_kept(tmp_path):
    put(tmp_path, "1.csv")
    (entry,) = file_logs(tmp_path, "{imu}.csv").load().entries
    (tmp_path / "1.csv").rename(tmp_path / "away")
    with pytest.raises(InputError, match="cannot be read"):
        entry.read()
    (tmp_path / "away").rename(tmp_path / "1.csv")
    assert len(entry.read().samples) == 10


def chained(*causes):
    """An InputError from the first of them, which is from the second, and so on."""
    error = InputError("1.csv: refused")
    last = error
    for cause in causes:
        last.__cause__ = cause
        last = cause
    return error


@pytest.mark.parametrize(
    ("causes", "kept"),
    [
        ([], 1),
        ([OSError("truncated file")], 1),  # as h5py and Arrow say it of a damaged file
        ([OSError(errno.EIO, "Input/output error")], 0),
        ([OSError("Reader needs file name"), PermissionError(errno.EACCES, "denied")], 0),  # SciPy
        ([MemoryError()], 0),
    ],
)
def test_only_reasons_that_lie_in_the_file_are_kept(tmp_path, monkeypatch, causes, kept):
    def read_log(*_):
        raise chained(*causes)

    monkeypatch.setattr(parse_cache, "read_log", read_log)
    put(tmp_path, "1.csv")
    assert read_all(file_logs(tmp_path, "{imu}.csv")) == [None]
    assert len(list(tmp_path.glob(".read/*"))) == kept


def test_why_a_damaged_hdf5_file_is_refused_is_kept(tmp_path):
    path = tmp_path / "1.h5"
    with h5py.File(path, "w") as file:
        file["w_x (deg/s)"] = np.zeros(5000)
    path.write_bytes(path.read_bytes()[:-1000])
    (entry,) = file_logs(tmp_path, "{imu}.h5").load().entries
    with pytest.raises(InputError, match="truncated"):
        entry.read()
    assert len(list((tmp_path / ".read").iterdir())) == 1


def test_files_of_every_kind_are_parsed_once(tmp_path, counted):
    put(tmp_path, "1.parquet")
    logs = file_logs(tmp_path, "{imu}.parquet")
    read_all(logs)
    read_all(logs)
    assert counted[0] == ["1.parquet"]


def test_only_readings_are_tidied_away(tmp_path):
    put(tmp_path, "1.csv")
    logs = file_logs(tmp_path, "{imu}.csv", cache={"path": str(tmp_path)})
    for name in ("mine.npy", "notes.txt", ".dot.01234567.1.reading", "dot.gone.reading"):
        (tmp_path / name).touch()
    logs.load()
    left = {path.name for path in tmp_path.iterdir()}
    assert left == {"1.csv", "mine.npy", "notes.txt", ".dot.01234567.1.reading"}
