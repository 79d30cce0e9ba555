"""The first column that holds times is taken; what is not known is said in one finding."""

import re

import numpy as np
import pandas as pd
import pytest

from gyro_pipeline.conventions import InputError

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
