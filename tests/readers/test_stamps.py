"""Columns of times, told by content: the first is taken, and what is not known is said once."""

import re

import numpy as np
import pandas as pd
import pytest

from gyro_pipeline.conventions import InputError
from gyro_pipeline.readers.times import seconds

X = np.random.default_rng(0).normal((0.7, -0.4, 0.15), 0.05, (6000, 3))
N = len(X)
S = np.arange(N) / 100
RATES = "gx (deg/s),gy (deg/s),gz (deg/s)"
STEPS = np.random.default_rng(0).normal(10, 0.5, N)
STEPS *= 10 / STEPS[1:].mean()
DATES = pd.Timestamp("2024-03-01").to_datetime64() + (S * 1e9).astype("m8[ns]")
K = {"time_column": "k"}


@pytest.mark.parametrize(
    ("header", "columns", "options"),
    [
        ("t_ms", [S * 1e3], {}),
        ("time (s),Unix time CAL [ms]", [S * np.nan, S * 1e3], {}),
        ("T (degC),t [s]", [S * 0 + 25, S], {}),
        ("delta_time (s),time (s)", [STEPS / 1e3, S], {}),
        ("time,seconds_elapsed", [1.7e18 + S * 1e9, S], {"time_units": "ns"}),
        ("stamp", [DATES], {}),
        ("k,t (s)", [STEPS, S], K | {"time_is": "steps", "time_units": "ms"}),
        *[("t (s)", [S], {"preamble": text}) for text in (
            "Sample rate: 100 Hz", "fs = 100", "// Update Rate: 0.1kHz", "rate of turn 5")],
    ],
)  # fmt: skip
def test_the_first_column_that_holds_times_gives_the_rate(header, columns, options, read, details):
    log = read(f"{header},{RATES}", *columns, X, rate_hz=101.9, **options)
    assert log.rate_hz == pytest.approx(100, rel=1e-3)
    assert not details(log, "timestamps") and not details(log, "sample rate")


def test_what_is_not_known_of_the_time_is_one_short_finding(read, details):
    for header, column, words in (
        ("k", S * 0, "no column of times: rate and gaps are not measured; give time_column"),
        ("time (s)", S * np.nan, "no column of times"),
        ("load (ms)", STEPS, "no column of times"),
        ("time", S, "'time' has no unit: the rate is not measured; give time_units"),
        ("dt (ms)", STEPS, "'dt .ms.' holds the time since the last row; give time_is: steps"),
    ):
        log = read(f"{header},{RATES}", column, X)
        (text,) = details(log, "timestamps")
        assert log.rate_hz is None
        assert re.match(words, text) and len(text) < 90


@pytest.mark.parametrize(
    ("header", "column", "options", "words"),
    [
        ("t (ms)", S, {"time_units": "s"}, "has a unit of 0.001 s, but 1 s is used.*trust"),
        ("t (ms)", S, {}, "makes 100000 Hz,.*give time_units: s, which makes 100 Hz;.*trust"),
        ("t (s)", S * 1e6, {}, "makes 0.0001 Hz.*time_units: us, which makes 100 Hz;.*trust"),
        ("t (s)", S, {"preamble": "OutputRate:,120Hz"}, "state 120 Hz, 100 Hz is measured.*trust"),
        ("k", STEPS, K | {"time_units": "ms"}, "give time_is: steps"),
    ],
)
def test_times_that_contradict_or_are_none_are_refused(header, column, options, words, read):
    with pytest.raises(InputError, match=f"{words}.*in `reader:` of the catalog entry") as refusal:
        read(f"{header},{RATES}", column, X, **options)
    if "trust" in words:
        advice = re.search(r"time_units: (.?s),", str(refusal.value))
        options = options | ({"time_units": advice[1]} if advice else {})
        log = read(f"{header},{RATES}", column, X, trust="options", **options)
        assert log.rate_hz == pytest.approx(100)
        assert {finding.outcome for finding in log.findings} == {"kept"}


def test_rows_that_are_left_out_take_time_but_have_no_number(read, details):
    header, options = f"dt (ms),sensor,k,{RATES}", {"counter_column": "k", "time_is": "steps"}
    sensor, lost = np.arange(N) % 2, np.where(np.arange(N) < 300, 0, 5) + np.arange(N)
    log = read(header, S * 0 + 5, sensor, lost, X, rows={"sensor": 1}, **options)
    assert log.rate_hz == pytest.approx(100)
    assert not len(log.gap_rows) and details(log, "packet counter")
    assert read(header, S * 0 + 5, S, lost, X, **options).gap_rows.tolist() == [300]


def test_a_rate_beyond_the_tolerance_is_rejected_with_advice(read):
    (finding,) = read(f"time (s),{RATES}", S, X, rate_hz=200).findings
    assert finding.outcome == "rejected"
    assert finding.detail.startswith("expected 200 Hz within 2 %, got 100 Hz; check time_units")


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize(
    ("texts", "expected"),
    [
        (["59:59.9", "00:00.0"], 0.1),
        (["10:00:00:5", "10:00:00:15"], 0.01),
        (["2019-09-27T01:59:59.5+02:00", "2019-09-27T01:00:00.5+01:00"], 1.0),
        (["2019-09-27 23:59:59.99 -0330", "2019-09-28 00:59:59.99 -02:30"], 0),
        (["Sep 27, 2019, 10:12:33.02 a.m.", "Sep 27, 2019, 10:12:33.03 a.m."], 0.01),
        (["11:59:59.99 pm", "12:00:00.00 am"], 0.01),
        (["23:59:59.99", "00:00:00.00"], 0.01),
        (["04.05.2023 23:59:59.99", "05.05.2023 00:00:00.00"], 0.01),
        (["05/04/2023 23:59:59.99", "05/05/2023 00:00:00.00"], 0.01),
    ],
)
def test_texts_of_times_are_told_by_content(texts, expected):
    times = seconds(np.array([texts[0], None, texts[1]], object), None)
    assert times[2] - times[0] == pytest.approx(expected, abs=1e-6)
    assert np.isnan(times[1])


def test_texts_that_are_no_times_or_may_be_two_are_none():
    for texts in (["acc", "gyr"], ["09:50", "09:51"], ["2023-05-04", "2023-05-05"], ["1.5", "1.6"]):
        assert seconds(np.array([*texts, None], object), 1.0) is None


def test_numbers_need_a_unit_of_any_size_and_datetimes_none():
    numbers = np.array([0.0, 400.0, np.nan])
    np.testing.assert_allclose(seconds(numbers, 25e-6), [0, 0.01, np.nan])
    assert seconds(numbers, None) is None
    dates = pd.to_datetime(["2023-05-04 10:00:00.00", None, "2023-05-04 10:00:00.01"]).to_numpy()
    for column in (dates, dates - dates[0]):
        np.testing.assert_allclose(seconds(column, None), [0, np.nan, 0.01])
