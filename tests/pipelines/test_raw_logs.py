import copy
import logging
from dataclasses import replace
from functools import partial

import numpy as np
import pandas as pd
import pytest

from gyro_pipeline.conventions import DIMENSIONS, InputError
from gyro_pipeline.datasets.recordings import InspectedRecordings
from gyro_pipeline.logs import KEPT, REJECTED, REPAIRED, Finding, Log, LogEntry, Logs
from gyro_pipeline.parameters import Execution
from gyro_pipeline.pipelines.raw_logs import inspection, nodes
from gyro_pipeline.pipelines.raw_logs.nodes import inspect_logs, require_enough
from gyro_pipeline.quality import Inspected

RATE_HZ, SAMPLES = 100.0, 2000
PAIR = Execution(executor="processes", workers=2)
DEAD = Log(np.zeros((SAMPLES, 3)))


def noise(seed, samples=SAMPLES):
    """A recording of white noise around a bias, (samples, 3)."""
    return np.random.default_rng(seed).normal(0.3, 0.05, (samples, 3))


def fail(error):
    raise error


def listed(logs, **changes):
    """A source of these, by IMU and recording; in place of a log, what its reading raises."""
    entries = []
    for (imu, recording), log in logs.items():
        # what other processes can call as well, however pytest imported this file
        read = partial(copy.copy if isinstance(log, Log) else fail, log)
        size = len(log.samples) if isinstance(log, Log) else 0
        place = imu, recording, f"{imu}_{recording}.csv"
        entries.append(LogEntry(*place, read, size=size, key=f"{place} {hash(str(log))}"))
    return replace(Logs("dot", "mine", False, RATE_HZ, entries), **changes)


def started(samples=SAMPLES):
    """A recording whose first three rows are zero."""
    return np.concatenate([np.zeros((3, 3)), noise(7, samples)[3:]])


def four(**changes):
    """Two recordings of two IMUs, some of them changed: ``four(log_12=...)`` is IMU 1's second."""
    numbers = [(1, 1), (1, 2), (2, 1), (2, 2)]
    logs = {number: Log(noise(seed)) for seed, number in enumerate(numbers)}
    return logs | {(int(name[4]), int(name[5])): log for name, log in changes.items()}


@pytest.fixture
def quality(parameters):
    return parameters("base").quality.model_copy(update={"needed_pct": 1.0})


@pytest.fixture
def inspected(read_logs, quality, tmp_path):
    """Recordings of a source, and their table by (imu, recording)."""

    def inspect(files, **changes):
        asked = quality.model_copy(update=changes)
        recordings, table = read_logs(files, asked, tmp_path, workers=2)
        return recordings, table.set_index(["imu", "recording"])

    return inspect


def samples_of(recordings, imu, recording):
    """Of its own length."""
    one = recordings.sel(imu=imu, recording=recording)
    return one.angular_rate.to_numpy()[:, : int(one["samples"])]


def test_recordings_are_labelled_as_the_conventions_say(inspected):
    logs = four()
    recordings, table = inspected(listed(logs))
    assert recordings.angular_rate.dims == DIMENSIONS
    assert recordings.angular_rate.dtype == np.float32
    assert recordings.angular_rate.attrs == {"units": "deg/s"}
    expected = logs[2, 1].samples.T.astype(np.float32)
    np.testing.assert_array_equal(recordings.angular_rate.sel(imu=2, recording=1), expected)
    labels = {"imu": [1, 2], "recording": [1, 2], "axis": ["x", "y", "z"]}
    assert {name: one.values.tolist() for name, one in recordings.coords.items()} == labels
    given = {"sensor": "dot", "source": "mine", "simulated": 0, "rate_hz": RATE_HZ}
    assert recordings.attrs == given | {"data_hash": recordings.attrs["data_hash"]}
    assert "split" not in recordings.coords  # few recordings make a k-fold
    assert table.outcome.tolist() == [KEPT] * 4
    row = table.loc[2, 1][["file", "rows", "start", "stop", "masked"]]
    assert row.tolist() == ["2_1.csv", SAMPLES, 0, SAMPLES, 0]


def test_each_has_its_own_length_from_the_first_usable_row_on(inspected):
    logs = four(log_12=Log(started()), log_21=Log(noise(8, 2500)), log_22=Log(noise(9, 300)))
    recordings, table = inspected(listed(logs))
    assert recordings["samples"].values.tolist() == [[2000, 1997], [2500, 0]]
    for (imu, recording), first in {(1, 1): 0, (1, 2): 3, (2, 1): 0}.items():
        kept = logs[imu, recording].samples[first:].T.astype(np.float32)
        np.testing.assert_array_equal(samples_of(recordings, imu, recording), kept)
        assert table.loc[imu, recording].start == first
    assert np.isnan(recordings.angular_rate.sel(imu=1, recording=2)[:, 1997:]).all()
    assert "zero rows" in table.loc[1, 2].findings
    assert "too short" in table.loc[2, 2].findings
    assert table.loc[2, 2][["start", "stop", "masked"]].isna().all()


def test_masked_samples_are_nan_and_counted(inspected, monkeypatch):
    def masking(log, *_):
        rows = len(log.samples) - 10
        return Inspected(KEPT, 10, 10 + rows, np.isin(np.arange(rows), [5, 1600]), ())

    monkeypatch.setattr(inspection, "inspect", masking)
    logs = four(log_12=Log(noise(9, 1200)))
    recordings, table = inspected(listed(logs), length_s=16.0)
    short = "too short: 1190 rows can be used, quality.length_s asks for 1600"
    assert table.loc[1, 2].findings == short
    samples = samples_of(recordings, 2, 1)
    assert samples.shape == (3, 1600)
    assert np.flatnonzero(np.isnan(samples).all(axis=0)).tolist() == [5]
    assert np.isnan(samples).sum() == 3
    assert table.masked.dropna().tolist() == [1] * 3
    assert table.stop.dropna().tolist() == [1610] * 3


def test_what_cannot_be_read_is_rejected_what_is_no_number_masked_other_errors_raised(inspected):
    samples = noise(7)
    samples[200, 1] = 1e300  # which overflows float32
    zip_file = InputError("2_1.csv: expected text, got a zip")
    recordings, table = inspected(listed(four(log_12=Log(samples), log_21=zip_file)))
    assert (table.loc[1, 2].outcome, table.loc[1, 2].masked) == (REPAIRED, 1)
    samples[200] = np.nan
    np.testing.assert_array_equal(samples_of(recordings, 1, 2), samples.T.astype(np.float32))
    assert table.loc[2, 1].outcome == REJECTED
    assert table.loc[2, 1].findings == "file: 2_1.csv: expected text, got a zip"
    with pytest.raises(ZeroDivisionError):
        inspected(listed(four(log_12=ZeroDivisionError())))


def test_the_same_samples_twice_are_one_recording_which_is_used_once_alone(inspected):
    logs = four()
    logs[2, 2] = logs[1, 2]
    recordings, table = inspected(listed(logs))
    assert np.isnan(recordings.angular_rate.sel(imu=2, recording=2)).all()
    assert table.outcome.tolist() == [KEPT, KEPT, KEPT, REJECTED]
    assert "duplicate: the same samples as 1_2.csv" in table.loc[2, 2].findings
    logs[1, 2] = Log(noise(11))
    recordings, _ = inspected(listed(logs))
    kept = logs[2, 2].samples.T.astype(np.float32)
    np.testing.assert_array_equal(samples_of(recordings, 2, 2), kept)


def test_the_rate_is_the_median_of_the_measured_ones(inspected):
    rates = [100.01, 100.02, 99.0, None]
    found = (Finding("sample rate", REJECTED, "99 Hz, expected 100 Hz"),)
    logs = {
        number: replace(log, rate_hz=rate, findings=found if rate == 99 else ())
        for (number, log), rate in zip(four().items(), rates, strict=True)
    }
    recordings, table = inspected(listed(logs))
    assert recordings.rate_hz == 100.015
    assert table.outcome.tolist() == [KEPT, KEPT, REJECTED, KEPT]
    assert table.rate_hz.tolist()[:3] == [100.01, 100.02, 99.0]
    assert "sample rate: 99 Hz" in table.loc[2, 1].findings
    recordings, table = inspected(listed(logs, rate_hz=None))  # not stated either
    assert table.outcome.tolist() == [KEPT, KEPT, REJECTED, REJECTED]
    assert "rate_hz, samples a second, in the sensor's entry in globals.yml" in table.findings[2, 2]


def test_temperature_and_acceleration_are_kept_with_their_recording(inspected):
    warm, acceleration = np.linspace(20, 30, SAMPLES), noise(3)
    logs = four(
        log_11=Log(noise(1), temperature_c=warm, acceleration_g=acceleration),
        log_22=Log(started(), temperature_c=warm),
    )
    recordings, _ = inspected(listed(logs))
    felt, warmth = recordings.acceleration_g, recordings.temperature_c.astype(float)
    np.testing.assert_allclose(felt.sel(imu=1, recording=1), acceleration.T, rtol=1e-6)
    assert np.isnan(felt.sel(imu=2)).all()
    np.testing.assert_allclose(warmth.sel(imu=1, recording=1), warm, rtol=1e-6)
    np.testing.assert_allclose(warmth.sel(imu=2, recording=2)[:-3], warm[3:], rtol=1e-6)
    assert np.isnan(warmth.sel(imu=1, recording=2)).all()


def test_splits_and_what_was_drawn_go_with_the_recordings(inspected, make_recordings):
    drawn = make_recordings(np.zeros((2, 4, 3)), 20, 10, 0.1)[["angular_rate"]].drop_attrs()
    drawn = drawn.rename(angular_rate="true_bias").isel(sample=0)
    logs = {(imu, n): Log(noise(10 * imu + n)) for imu in (1, 2) for n in (1, 2, 3, 4)}
    logs[1, 1] = logs[2, 1] = DEAD
    files = listed(logs, simulated=True, truth=drawn)
    of_source = {1: "train", 2: "test", 3: "train", 4: "test"}
    entries = [replace(one, split=of_source[one.recording]) for one in files.entries]
    recordings, _ = inspected(replace(files, entries=entries))
    assert recordings.simulated == 1
    assert recordings.split.values.tolist() == ["test", "train", "test"]
    np.testing.assert_array_equal(recordings.true_bias, drawn.true_bias.sel(recording=[2, 3, 4]))


def test_a_source_without_a_split_gets_one_where_there_are_many_recordings(inspected):
    many = {(imu, n): Log(noise(100 * imu + n, 1100)) for imu in (1, 2) for n in range(1, 51)}
    del many[1, 50]  # which the tested IMU lacks, so it cannot test
    many[2, 50] = Log(noise(5))
    del many[1, 49]
    many[1, 51], many[1, 52] = Log(noise(6)), Log(noise(7))
    recordings, _ = inspected(listed(many))
    roles = dict(zip(recordings.recording.values, recordings.split.values, strict=True))
    tested = [number for number, role in roles.items() if role == "test"]
    assert tested == [*range(41, 49), 51, 52]
    assert roles[50] == "train"


@pytest.mark.slow
def test_processes_give_the_same_as_this_one(inspected, monkeypatch, caplog, tmp_path):
    files = listed(four(log_12=Log(started()), log_21=Log(noise(8, 2500)), log_22=Log(started())))
    here, table = inspected(files)
    here = here.load()
    (tmp_path / "recordings.nc").unlink()
    monkeypatch.setattr(nodes, "_MIN_PARALLEL_BYTES", 0)
    with caplog.at_level(logging.INFO, "gyro_pipeline"):
        there, other = inspected(files)
    assert there.identical(here)
    assert other.equals(table)
    assert "dot: 4 recordings on 2 processes" in caplog.messages


def entries_that_count(monkeypatch):
    """The recordings that are read."""
    read = []
    judge = nodes.judge
    monkeypatch.setattr(nodes, "judge", lambda job: read.append(job.entry.where) or judge(job))
    return read


def test_an_interrupted_read_goes_on(quality, tmp_path, monkeypatch, inspected, caplog):
    read = entries_that_count(monkeypatch)
    logs = four(log_12=Log(noise(7, 2500)))
    reading = InspectedRecordings(str(tmp_path / "recordings.nc"))
    items = inspect_logs(listed(logs), [], quality, PAIR)
    for _ in range(3):  # what is listed, and two recordings
        reading.save(next(items))
    reading.release()
    with caplog.at_level(logging.INFO, "gyro_pipeline"):
        recordings, _ = inspected(listed(logs))
    assert read == ["1_1.csv", "1_2.csv", "2_1.csv", "2_2.csv"]
    assert caplog.messages[0] == "dot: 2 of 4 recordings were read before"
    assert {path.name for path in tmp_path.glob("*.nc")} == {"recordings.nc"}
    for place, log in logs.items():
        np.testing.assert_array_equal(samples_of(recordings, *place), log.samples.T.astype("f4"))


def test_only_what_changed_is_read_again(monkeypatch, inspected):
    read = entries_that_count(monkeypatch)
    before, _ = inspected(listed(four()))
    logs = four(log_12=Log(noise(9, 1500))) | {(3, 1): Log(noise(10))}
    del logs[2, 2]
    recordings, _ = inspected(listed(logs))
    assert recordings.attrs["data_hash"] != before.attrs["data_hash"]
    assert read[4:] == ["1_2.csv", "3_1.csv"]
    assert recordings["samples"].values.tolist() == [[2000, 1500], [2000, 0], [2000, 0]]
    for place, log in logs.items():
        np.testing.assert_array_equal(samples_of(recordings, *place), log.samples.T.astype("f4"))
    again, _ = inspected(listed(logs), drift_mdps=11.0)
    assert again.attrs["data_hash"] == recordings.attrs["data_hash"]  # the samples are the same
    assert len(read) == 6 + 4  # other settings judge anew


def test_what_the_system_could_not_read_is_read_again(monkeypatch, inspected):
    error = InputError("1_2.csv: cannot be read")
    error.__cause__ = OSError(5, "Input/output error")
    damaged = InputError("2_1.csv: truncated")
    damaged.__cause__ = OSError("truncated file")  # as h5py says it
    files = listed(four(log_12=error, log_21=damaged))
    inspected(files)
    read = entries_that_count(monkeypatch)
    _, table = inspected(files)
    assert read == ["1_2.csv"]
    assert table.outcome.tolist() == [KEPT, REJECTED, REJECTED, KEPT]


def test_too_few_leave_the_old_recordings_and_what_was_read(inspected, tmp_path, monkeypatch):
    inspected(listed(four()))
    before = (tmp_path / "recordings.nc").read_bytes()
    worse = listed(four(log_11=DEAD))
    with pytest.raises(InputError, match="3 of 4 recordings can be used"):
        inspected(worse, needed_pct=90.0)
    assert (tmp_path / "recordings.nc").read_bytes() == before
    read = entries_that_count(monkeypatch)
    recordings, _ = inspected(worse)
    assert read == []
    assert recordings["samples"].values.tolist() == [[0, SAMPLES], [SAMPLES, SAMPLES]]


def test_the_tested_imu_must_be_among_them(quality):
    table = pd.DataFrame({"imu": [2] * 11 + [1], "recording": range(12), "sensor": "dot"})
    table = table.assign(outcome=[KEPT] * 11 + [REJECTED], findings="file: is a zip", file="a.csv")
    with pytest.raises(InputError, match="dot, the tested IMU 1: 0 of 1 recordings"):
        require_enough(table, quality.model_copy(update={"needed_pct": 90.0}))
    require_enough(table.iloc[:-1], quality)  # without any of it, studies say so
