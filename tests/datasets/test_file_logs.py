import logging
import os
import pickle

import numpy as np
import pytest
from kedro.io import DatasetError

from gyro_pipeline.conventions import InputError
from gyro_pipeline.datasets.file_logs import FileLogs
from gyro_pipeline.logs import Logs

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
    options = {"sensor": "dot", "sensors": SENSORS, "source": "mine"} | options
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
        (["0.csv"], "{imu}.csv", ["0.csv", "from 1 to 1e+18 for {imu}", "{imu:name}"]),
        (["9" * 30 + ".csv"], "{imu}.csv", ["from 1 to 1e+18 for {imu}", "{imu:name}"]),
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
            "expected a character before {recording}",
        ),
        ({"pattern": "dot*{imu}.csv"}, "expected a character before {imu}"),
        (
            {"pattern": "{imu}0{recording}.csv"},
            "expected no digit behind a number, which would belong to it, got 0",
        ),
        (
            {"pattern": "{imu}7.csv"},
            "expected no digit behind a number, which would belong to it, got 7",
        ),
        ({"pattern": 5}, "dot: pattern 5 in the catalog entry: expected a text"),
        ({"reader": {"unit": "deg/s"}}, "dot: reader in the catalog entry"),
        (
            {"reader": {"format": "movela_dot"}},
            "dot: reader in the catalog entry: expected format auto, movella_dot, ",
        ),
    ],
)
def test_a_wrong_entry_is_refused_before_anything_is_read(tmp_path, options, words):
    with pytest.raises(InputError) as caught:
        file_logs(tmp_path, **{"pattern": "{imu}.csv"} | options)
    assert words in str(caught.value)


def test_logs_are_read_only(tmp_path):
    with pytest.raises(DatasetError, match="read only"):
        file_logs(tmp_path, "{imu}.csv").save(Logs("dot", "mine", False, 120, []))


def keys(logs):
    return {entry.where: entry.key for entry in logs.load().entries}


def test_the_key_of_a_file_changes_with_it_its_options_and_the_readers(tmp_path, monkeypatch):
    put(tmp_path, "1.csv", "2.csv")
    before = keys(file_logs(tmp_path, "{imu}.csv"))
    assert keys(file_logs(tmp_path, "{imu}.csv")) == before
    os.utime(tmp_path / "1.csv", ns=(1, 1))
    touched = keys(file_logs(tmp_path, "{imu}.csv"))
    assert touched["2.csv"] == before["2.csv"]
    slow = {"dot": SENSORS["dot"] | {"recording_s": 20}}
    others = [
        file_logs(tmp_path, "{imu}.csv", sensors=slow),
        file_logs(tmp_path, "{imu}.csv", reader={"rate_tolerance_pct": 5}),
    ]
    found = {before["1.csv"], touched["1.csv"], *(keys(one)["1.csv"] for one in others)}
    monkeypatch.setattr("gyro_pipeline.datasets.file_logs.package_hash", lambda _: "another")
    found.add(keys(file_logs(tmp_path, "{imu}.csv"))["1.csv"])
    assert len(found) == 5


def test_a_cache_of_older_versions_is_not_needed(tmp_path, caplog):
    put(tmp_path, "1.csv")
    with caplog.at_level(logging.INFO, "gyro_pipeline"):
        numbers(file_logs(tmp_path, "{imu}.csv", cache={"path": str(tmp_path / "read")}))
    assert caplog.messages[0] == "dot: cache in the catalog entry is no longer needed; remove it"
    assert not (tmp_path / "read").exists()


def test_a_file_may_hold_several_imus(tmp_path, monkeypatch):
    """Once the readers know columns by IMU; here each is asked for its own."""
    put(tmp_path, "7.csv", "8.csv")
    logs = file_logs(tmp_path, "{recording}.csv")
    logs._side_by_side = [1, 2]
    monkeypatch.setattr("gyro_pipeline.readers.read_log", lambda *_, imu: imu)
    entries = logs.load().entries
    assert [(e.imu, e.recording, e.where) for e in entries] == [
        *((1, 7, "7.csv"), (1, 8, "8.csv"), (2, 7, "7.csv"), (2, 8, "8.csv")),
    ]
    assert [entry.read() for entry in entries] == [1, 1, 2, 2]
    assert len({entry.key for entry in entries}) == 4
