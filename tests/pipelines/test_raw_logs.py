import copy
import logging
from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from gyro_pipeline.conventions import DIMENSIONS, InputError
from gyro_pipeline.fingerprints import data_hash
from gyro_pipeline.logs import KEPT, REJECTED, REPAIRED, Finding, Log, LogEntry, Logs
from gyro_pipeline.parameters import Execution
from gyro_pipeline.pipelines.raw_logs import nodes
from gyro_pipeline.pipelines.raw_logs.nodes import inspect_logs, require_enough

RATE_HZ, SAMPLES = 100.0, 2000
PAIR = Execution(executor="processes", workers=2)


def noise(seed, samples=SAMPLES):
    """A recording of white noise around a bias, (samples, 3)."""
    return np.random.default_rng(seed).normal(0.3, 0.05, (samples, 3))


def fail(error):
    raise error


def listed(logs, **changes):
    """A source of these, by IMU and recording; in place of a log, what its reading raises."""
    entries = [
        # what other processes can call as well, however pytest imported this file
        LogEntry(
            *(imu, recording, f"{imu}_{recording}.csv"),
            partial(copy.copy if isinstance(log, Log) else fail, log),
            size=len(log.samples) if isinstance(log, Log) else 0,
        )
        for (imu, recording), log in logs.items()
    ]
    return replace(Logs("dot", "mine", False, RATE_HZ, entries), **changes)


def four(**changes):
    """Two recordings of two IMUs, some of them changed: ``four(log_12=...)`` is IMU 1's second."""
    numbers = [(1, 1), (1, 2), (2, 1), (2, 2)]
    logs = {number: Log(noise(seed)) for seed, number in enumerate(numbers)}
    return logs | {(int(name[4]), int(name[5])): log for name, log in changes.items()}


@pytest.fixture
def quality(parameters):
    return parameters("base").quality


@pytest.fixture
def inspected(quality):
    """Recordings and table, the second with the index (imu, recording)."""

    def inspect(files, **changes):
        asked = quality.model_copy(update=changes)
        recordings, table = inspect_logs(files, asked, PAIR)
        return recordings, table.set_index(["imu", "recording"])

    return inspect


def test_recordings_are_labelled_as_the_conventions_say(inspected):
    logs = four()
    recordings, table = inspected(listed(logs))
    assert recordings.angular_rate.dims == DIMENSIONS
    assert recordings.angular_rate.dtype == np.float32
    assert recordings.angular_rate.attrs == {"units": "deg/s"}
    np.testing.assert_array_equal(
        recordings.angular_rate.sel(imu=2, recording=1), logs[2, 1].samples.T.astype(np.float32)
    )
    labels = {"imu": [1, 2], "recording": [1, 2], "axis": ["x", "y", "z"]}
    attributes = {"sensor": "dot", "source": "mine", "simulated": 0, "rate_hz": RATE_HZ}
    assert {name: one.values.tolist() for name, one in recordings.coords.items()} == labels
    digest = data_hash(recordings.angular_rate.values, [labels, attributes])
    assert recordings.attrs == attributes | {"data_hash": digest}
    assert table.outcome.tolist() == [KEPT] * 4
    assert table.loc[2, 1].to_dict() == {
        **{"sensor": "dot", "file": "2_1.csv", "outcome": KEPT, "rows": SAMPLES},
        **{"start": 0, "stop": SAMPLES, "rate_hz": None, "findings": None},
    }


def test_all_are_cut_to_the_shortest_that_is_kept_from_the_first_usable_row_on(inspected):
    started = noise(7)
    started[:3] = 0
    logs = four(log_12=Log(started), log_21=Log(noise(8, 2500)), log_22=Log(noise(9, 1200)))
    recordings, table = inspected(listed(logs))
    assert recordings.sizes["sample"] == 1200
    for (imu, recording), first in {(1, 1): 0, (1, 2): 3, (2, 1): 0, (2, 2): 0}.items():
        kept = logs[imu, recording].samples[first : first + 1200].T.astype(np.float32)
        found = recordings.angular_rate.sel(imu=imu, recording=recording)
        np.testing.assert_array_equal(found, kept)
        assert table.loc[imu, recording][["start", "stop"]].tolist() == [first, first + 1200]
    assert "zero rows" in table.loc[1, 2].findings


def test_a_rejected_recording_does_not_decide_the_length(inspected):
    recordings, table = inspected(listed(four(log_22=Log(noise(9, 300)))))
    assert recordings.sizes["sample"] == SAMPLES
    assert table.loc[2, 2].outcome == REJECTED
    assert "too short" in table.loc[2, 2].findings
    assert table.loc[2, 2][["start", "stop"]].isna().all()


def test_all_are_cut_to_a_stated_length_and_shorter_ones_rejected(inspected):
    logs = four(log_22=Log(noise(9, 1200)))
    recordings, table = inspected(listed(logs), length_s=15.0)
    assert recordings.sizes["sample"] == 1500
    assert table.outcome.tolist() == [KEPT, KEPT, KEPT, REJECTED]
    assert table.loc[2, 2].findings == (
        "too short: 1200 rows can be used, quality.length_s asks for 1500"
    )


def test_a_recording_that_is_rejected_is_nan_and_left_out_if_it_is_for_all_imus(inspected):
    dead = Log(np.zeros((SAMPLES, 3)))
    recordings, _ = inspected(listed(four(log_21=dead)))
    assert np.isnan(recordings.angular_rate.sel(imu=2, recording=1)).all()
    assert int(np.isnan(recordings.angular_rate).sum()) == 3 * SAMPLES
    recordings, table = inspected(listed(four(log_11=dead, log_21=dead)))
    assert recordings.recording.values.tolist() == [2]
    assert not np.isnan(recordings.angular_rate).any()
    assert len(table) == 4
    recordings, _ = inspected(listed(four(log_21=dead, log_22=dead)))
    assert recordings.imu.values.tolist() == [1]


def test_an_imu_may_lack_recordings_from_the_start(inspected):
    logs = four()
    del logs[2, 1]
    recordings, table = inspected(listed(logs))
    assert np.isnan(recordings.angular_rate.sel(imu=2, recording=1)).all()
    assert len(table) == 3


def test_a_file_that_cannot_be_read_is_a_rejected_recording(inspected):
    _, table = inspected(listed(four(log_12=InputError("1_2.csv: expected text, got a zip"))))
    assert table.loc[1, 2].outcome == REJECTED
    assert table.loc[1, 2].findings == "file: 1_2.csv: expected text, got a zip"
    assert table.loc[1, 2].rows == 0


def test_an_error_that_is_no_bad_input_is_not_hidden(inspected):
    with pytest.raises(ZeroDivisionError):
        inspected(listed(four(log_12=ZeroDivisionError())))


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, 1e300])  # 1e300 overflows float32
def test_the_longest_stretch_without_a_fault_is_kept(inspected, value):
    samples = noise(7)
    samples[200, 1] = value
    logs = four(log_12=Log(samples))
    recordings, table = inspected(listed(logs))
    assert table.loc[1, 2].outcome == REPAIRED
    assert recordings.sizes["sample"] == SAMPLES - 201
    np.testing.assert_array_equal(
        recordings.angular_rate.sel(imu=1, recording=2), samples[201:].T.astype(np.float32)
    )


def test_the_same_samples_twice_are_one_recording(inspected):
    logs = four()
    logs[2, 2] = logs[1, 2]
    recordings, table = inspected(listed(logs))
    assert np.isnan(recordings.angular_rate.sel(imu=2, recording=2)).all()
    assert table.loc[1, 2].outcome == KEPT
    assert table.loc[2, 2].outcome == REJECTED
    assert "duplicate: the same samples as 1_2.csv" in table.loc[2, 2].findings


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


def test_a_temperature_is_kept_with_its_recording(inspected):
    warm = np.linspace(20, 30, SAMPLES)
    started = noise(7)
    started[:3] = 0
    logs = four(log_11=Log(noise(1), temperature_c=warm), log_22=Log(started, temperature_c=warm))
    recordings, _ = inspected(listed(logs))
    warmth = recordings.temperature_c
    assert warmth.dims == ("imu", "recording", "sample")
    np.testing.assert_array_equal(warmth.sel(imu=1, recording=1), warm[:-3].astype(np.float32))
    np.testing.assert_array_equal(warmth.sel(imu=2, recording=2), warm[3:].astype(np.float32))
    assert np.isnan(warmth.sel(imu=1, recording=2)).all()
    without, _ = inspected(listed(four(log_22=Log(started))))
    assert "temperature_c" not in without


def test_splits_and_what_was_drawn_go_with_the_recordings(inspected, make_recordings):
    drawn = make_recordings(np.zeros((2, 2, 3)), 20, 10, 0.1).drop_attrs()
    drawn = drawn.rename(angular_rate="true_bias").isel(sample=0)
    logs = listed(four(log_11=Log(np.zeros((9, 3))), log_21=Log(np.zeros((9, 3)))))
    entries = [
        replace(one, split="train" if one.recording == 1 else "test") for one in logs.entries
    ]
    recordings, _ = inspected(replace(logs, entries=entries, simulated=True, drawn=drawn))
    assert recordings.simulated == 1
    assert recordings.given_split.values.tolist() == ["test"]
    np.testing.assert_array_equal(recordings.true_bias, drawn.true_bias.sel(recording=[2]))


def test_processes_give_the_same_as_this_one(quality, monkeypatch, caplog):
    started = noise(7)
    started[:3] = 0
    files = listed(
        four(log_12=Log(started), log_21=Log(noise(8, 2500)), log_22=Log(noise(9, 1700)))
    )
    here, table = inspect_logs(files, quality, PAIR)
    monkeypatch.setattr(nodes, "_WORTH_PROCESSES", 0)
    with caplog.at_level(logging.INFO, "gyro_pipeline"):
        there, other = inspect_logs(files, quality, PAIR)
    assert there.identical(here)
    assert other.equals(table)
    assert caplog.messages[0] == "dot: 4 recordings on 2 processes"
    assert caplog.messages[-1].startswith("dot: 4 recordings in ")


def test_counts_are_said_and_enough_recordings_go_on(inspected, quality, caplog):
    started = noise(7)
    started[200] = np.nan
    recordings, table = inspected(listed(four(log_12=Log(started), log_21=Log(np.zeros((9, 3))))))
    with caplog.at_level(logging.INFO, "gyro_pipeline"):
        asked = quality.model_copy(update={"needed_pct": 75.0})
        assert require_enough(recordings, table.reset_index(), asked) is recordings
    assert caplog.messages == ["dot: 4 recordings, 2 kept, 1 repaired, 1 rejected"]


def test_a_much_shorter_recording_that_shortens_all_is_named(inspected, caplog):
    recordings, _ = inspected(listed(four(log_12=Log(noise(7, 1100)))))
    assert recordings.sizes["sample"] == 1100
    assert caplog.messages == [
        "dot: all recordings are cut to 11 s, as long as IMU 1 recording 2, 1_2.csv; half of them "
        "have 20 s or more. Remove or repair it, or raise quality.least_s"
    ]
    caplog.clear()
    inspected(listed(four(log_12=Log(noise(7, 1700)))))
    assert caplog.messages == []


def test_too_few_recordings_stop_and_the_rejected_ones_are_named(inspected, quality):
    logs = {(1, number): Log(np.zeros((9, 3))) for number in range(1, 13)} | {(2, 1): Log(noise(1))}
    logs[1, 3] = InputError("1_3.csv: is a zip")
    recordings, table = inspected(listed(logs))
    with pytest.raises(InputError) as caught:
        require_enough(recordings, table.reset_index(), quality)
    first, *lines = str(caught.value).splitlines()
    assert first == (
        "dot: 1 of 13 recordings can be used, quality.needed_pct asks for 90 %. Repair or remove "
        "the others, or lower it:"
    )
    assert len(lines) == 11
    assert lines[2] == "  IMU 1 recording 3, 1_3.csv: file: 1_3.csv: is a zip"
    assert lines[-1] == "  and 2 more, in the table of their quality"


def test_the_tested_imu_must_be_among_them(inspected, quality):
    logs = {(2, number): Log(noise(number)) for number in range(1, 12)} | {
        (1, 1): Log(np.zeros((9, 3)))
    }
    recordings, table = inspected(listed(logs))
    with pytest.raises(InputError, match="dot, the tested IMU 1: 0 of 1 recordings") as caught:
        require_enough(recordings, table.reset_index(), quality)
    assert "IMU 1 recording 1, 1_1.csv" in str(caught.value)


def test_an_imu_of_which_nothing_is_left_is_named(inspected, quality, caplog):
    logs = {(1, number): Log(noise(number)) for number in range(1, 12)} | {
        (2, 1): Log(np.zeros((9, 3)))
    }
    recordings, table = inspected(listed(logs))
    assert require_enough(recordings, table.reset_index(), quality) is recordings
    assert caplog.messages[-1] == "dot: no recording is left of IMU 2"


def test_none_that_can_be_used_is_too_few_at_any_setting(inspected, quality):
    recordings, table = inspected(listed({(1, 1): Log(np.zeros((9, 3)))}))
    assert recordings.sizes == {"imu": 0, "recording": 0, "axis": 3, "sample": 0}
    with pytest.raises(InputError, match="dot: 0 of 1 recordings can be used"):
        asked = quality.model_copy(update={"needed_pct": 1.0})
        require_enough(recordings, table.reset_index(), asked)
