import logging
import os
import pickle

import numpy as np
import pytest
from kedro.io import DatasetError

from gyro_pipeline.conventions import InputError
from gyro_pipeline.datasets.file_logs import FileLogs

SENSORS = {"dot": {"imus": 5, "samples": 1200, "recording_s": 10}}


def file_logs(folder, pattern, sensors=SENSORS, **options):
    return FileLogs("dot", "mine", str(folder), sensors, pattern, **options)


def put(folder, *names):
    """Files of ten rows; the first rate is the file's place among the names."""
    for place, name in enumerate(names):
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        rows = (f"{row / 120:.6f},{place},{row},0.5\n" for row in range(10))
        path.write_text("Time (s),w_x (deg/s),w_y (deg/s),w_z (deg/s)\n" + "".join(rows))


def numbers(logs):
    return {entry.where: (entry.imu, entry.recording) for entry in logs.load().entries}


@pytest.mark.parametrize(
    ("pattern", "expected"),
    [
        ("{imu}/{recording}.csv", {"1/2.csv": (1, 2), "1/10.csv": (1, 10), "3/2.csv": (3, 2)}),
        ("dot_{imu}.csv", {"dot_4.csv": (4, 1), "dot_05.csv": (5, 1)}),
        ("{imu:name}.csv", {"1.csv": (1, 1), "1²2.csv": (2, 1)}),
        # in the order of their names, 2 before 10
        ("{imu}_*.csv", {"1_b2.csv": (1, 1), "1_b10.csv": (1, 2), "2_a.csv": (2, 1)}),
        ("D{imu:name}.csv", {"D2A.csv": (1, 1), "D10.csv": (2, 1), "DAF.csv": (3, 1)}),
        ("{recording:name}/{imu}.csv", {"mo/1.csv": (1, 1), "mo/2.csv": (2, 1), "tu/2.csv": (2, 2)}),  # noqa: E501
    ],
)  # fmt: skip
def test_the_pattern_gives_imu_and_recording(tmp_path, pattern, expected):
    put(tmp_path, *expected, ".hidden_1.csv", "~$1.csv", "notes.txt")
    assert numbers(file_logs(tmp_path, pattern)) == expected


def test_files_behind_links_count_and_circles_end(tmp_path):
    put(tmp_path, "in/1/1.csv", "elsewhere/1.csv")
    (tmp_path / "in/2").symlink_to(tmp_path / "elsewhere")
    (tmp_path / "in/1/back").symlink_to(tmp_path / "in")
    (tmp_path / "in/1/2.csv").symlink_to(tmp_path / "nowhere")
    logs = file_logs(tmp_path / "in", "{imu}/{recording}.csv")
    assert numbers(logs) == {"1/1.csv": (1, 1), "1/2.csv": (1, 2), "2/1.csv": (2, 1)}
    with pytest.raises(InputError, match=r"1/2.csv: cannot be read: No such file"):
        logs.load().entries[1].read()


def test_odd_names_are_escaped_and_a_pipe_is_rejected(tmp_path, caplog, read_logs, parameters):
    caplog.set_level(logging.INFO, "gyro_pipeline")
    names = [b"1_\xff.csv", "2_ü<b>=x\n.csv".encode(), b"3_.csv"]
    put(tmp_path, *map(os.fsdecode, names[:2]))
    os.mkfifo(tmp_path / "3_.csv")
    logs = file_logs(tmp_path, "{imu}_*.csv").load()
    shown = ["1_\\udcff.csv", "2_ü<b>=x\\n.csv", "3_.csv"]
    assert [entry.where for entry in logs.entries] == shown
    quality = parameters("base").quality
    with pytest.raises(InputError, match="0 of 3 recordings") as refused:
        read_logs(logs, quality, tmp_path)
    told = caplog.text + str(refused.value)
    told.encode()  # there is no half of a character in it
    assert "3_.csv: file: expected a file, got a pipe" in told


def test_entries_are_in_the_order_of_imu_and_recording_and_read_their_own_file(tmp_path):
    put(tmp_path, "2_1.csv", "1_10.csv", "1_9.csv")
    logs = file_logs(tmp_path, "{imu}_{recording}.csv").load()
    assert (logs.sensor, logs.source, logs.simulated, logs.rate_hz) == ("dot", "mine", False, 120)
    assert [entry.where for entry in logs.entries] == ["1_9.csv", "1_10.csv", "2_1.csv"]
    assert {entry.size for entry in logs.entries} == {(tmp_path / "2_1.csv").stat().st_size}
    first = pickle.loads(pickle.dumps(logs.entries[0])).read()
    np.testing.assert_array_equal(first.samples, [[2, row, 0.5] for row in range(10)])
    assert first.rate_hz == pytest.approx(120, rel=1e-3)


def test_a_file_may_hold_several_imus(tmp_path):
    rows = (f"{row / 120:.6f},1,2,3,{row},5,6\n" for row in range(10))
    text = "time (s),a_gx,a_gy,a_gz,b_gx,b_gy,b_gz\n" + "".join(rows)
    for name in ("7.csv", "8.csv"):
        (tmp_path / name).write_text(text)
    reader = {"columns": {1: ["a_gx", "a_gy", "a_gz"], 2: ["b_gx", "b_gy", "b_gz"]}}
    reader |= {"units": "deg/s"}
    entries = file_logs(tmp_path, "{recording}.csv", reader=reader).load().entries
    assert [(entry.imu, entry.recording) for entry in entries] == [(1, 7), (1, 8), (2, 7), (2, 8)]
    for entry in entries:
        expected = [1, 2, 3] if entry.imu == 1 else [9, 5, 6]
        np.testing.assert_array_equal(entry.read().samples[-1], expected)
    assert len({entry.key for entry in entries}) == 4
    with pytest.raises(InputError, match="remove one of the two"):
        file_logs(tmp_path, "{imu}.csv", reader=reader)


@pytest.mark.parametrize(
    ("names", "pattern", "words"),
    [
        (["a.csv"], "dot_{imu}.csv", ["files like dot_{imu}.csv, got a.csv;", "pattern"]),
        (["1.csv", "01.csv"], "{imu}.csv", ["01.csv and 1.csv", "recording 1 of IMU 1", "remove"]),
        (["0.csv", "1.csv"], "{imu}.csv", ["numbers from 1 for {imu}", "{imu:name}"]),
        (None, "{imu}.csv", ["nowhere: no such folder; put the files there"]),
    ],
)
def test_files_that_cannot_be_told_apart_are_refused(tmp_path, names, pattern, words):
    put(tmp_path, *(names or []))
    logs = file_logs(tmp_path if names else tmp_path / "nowhere", pattern)
    assert logs.exists() == bool(names)
    with pytest.raises(DatasetError) as caught:
        logs.load()
    assert isinstance(caught.value.__cause__, InputError)
    for word in ["dot", *words]:
        assert word in str(caught.value.__cause__)
    for wrong in ({"pattern": "{imu}_{imu:name}.csv"}, {"reader": {"format": "movela_dot"}}):
        with pytest.raises(InputError, match="expected {imu} or {imu:name}|should be 'auto'"):
            file_logs(tmp_path, **{"pattern": pattern} | wrong)


def test_the_key_of_a_file_changes_with_it_its_options_and_the_readers(tmp_path, monkeypatch):
    def keys(**options):
        entries = file_logs(tmp_path, "{imu}.csv", **options).load().entries
        return {entry.where: entry.key for entry in entries}

    put(tmp_path, "1.csv", "2.csv")
    before = keys()
    assert keys() == before
    os.utime(tmp_path / "1.csv", ns=(1, 1))
    touched = keys()
    assert touched["2.csv"] == before["2.csv"]
    slow = {"dot": SENSORS["dot"] | {"recording_s": 20}}
    others = [keys(sensors=slow), keys(reader={"rate_tolerance_pct": 5})]
    monkeypatch.setattr("gyro_pipeline.datasets.file_logs.code_hash", lambda _: "another")
    assert len({entry["1.csv"] for entry in (before, touched, *others, keys())}) == 5
