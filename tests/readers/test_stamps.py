"""The first column that holds times is taken; what is not known is said in one finding."""

import re

import numpy as np
import pandas as pd
import pytest
from device_tables import read, said, still

from gyro_pipeline.conventions import InputError

X = still()
N = len(X)
S = np.arange(N) / 100
RATES = "gx (deg/s),gy (deg/s),gz (deg/s)"
DATES = ["2019-09-27T10.12.33.000"] * N
CLOCK = [f"10:{k // 6000:02d}:{k // 100 % 60:02d}.{k % 100:02d}" for k in range(N)]
STEPS = np.random.default_rng(0).normal(10, 0.5, N)


@pytest.mark.parametrize(
    ("header", "columns", "options"),
    [
        ("epoc (ms),timestamp (-0700),elapsed (s)", [1.6e12 + 10 * np.arange(N), DATES, S], {}),
        ("timestamp (-0700),elapsed (s)", [DATES, S], {}),
        ("time,seconds_elapsed", [1.7e18 + S * 1e9, S], {}),
        ("t_ms", [S * 1e3], {}),
        ("t/s", [S], {}),
        ("seconds", [S], {}),
        ("T (degC),t [s]", [S * 0 + 25, S], {}),
        ("time (s),Unix time CAL [ms]", [S * np.nan, S * 1e3], {}),
        ("time", [S / 25e-6], {"time_units": 25e-6}),
        ("Time (min)", [S / 60], {}),
        ("Zeit (s)", [S], {}),
        ("time,seconds_elapsed", [1.7e18 + S * 1e9, S], {"time_units": "ns"}),
        ("when", [CLOCK], {}),
        ("stamp", [pd.Timestamp("2024-03-01").to_datetime64() + (S * 1e9).astype("m8[ns]")], {}),
        ("k", [S], {"time_column": "k", "time_units": "s"}),
        ("t (ms)", [S], {"time_units": "s", "trust": "options"}),
        ("dt (ms)", [STEPS * 100 / (STEPS[1:].mean() * 10)], {"time_is": "steps"}),
        ("dt,k", [STEPS * 100 / (STEPS[1:].mean() * 10), S],
         {"time_is": "steps", "time_column": "dt", "time_units": "ms"}),
    ],
)  # fmt: skip
def test_the_first_column_that_holds_times_gives_the_rate(header, columns, options):
    log = read(f"{header},{RATES}", *columns, X, rate_hz=100, **options)
    assert log.rate_hz == pytest.approx(100, rel=1e-3)
    assert not said(log, "timestamps")
    np.testing.assert_array_equal(log.samples, X)


@pytest.mark.parametrize(
    ("header", "column", "words"),
    [
        ("k", S * 0, "no column of times: rate and gaps are unseen; give time_column"),
        ("Time", ["no times"] * N, "no column of times: rate and gaps are unseen"),
        ("time", S, "'time' has no unit: the rate is not measured; give time_units"),
        ("dt (ms)", STEPS, "'dt .ms.' holds the time since the last row; give time_is: steps"),
        ("time (ms)", STEPS, "'time .ms.' holds the time since the last row"),
        ("exposure (ms)", S, "no column of times"),
        ("load (ms)", STEPS, "no column of times"),
    ],
)
def test_what_is_not_known_of_the_time_is_one_short_finding(header, column, words):
    log = read(f"{header},{RATES}", column, X)
    (text,) = said(log, "timestamps")
    assert log.rate_hz is None
    assert len(text) < 90
    assert re.match(words, text)


@pytest.mark.parametrize(
    ("header", "column", "options", "words"),
    [
        ("t (ms)", S, {"time_units": "s"}, "0.001 s, which makes 100000 Hz, but.* 1 s.* 100 Hz"),
        ("k", S, {"time_column": "k"}, "'k' has no unit"),
        ("k", S * 0, {"time_column": "k", "time_units": "s"}, "'k' holds no times"),
        ("dt", STEPS, {"time_column": "dt", "time_units": "ms"}, "give time_is: steps"),
        ("dt", STEPS, {"time_column": "no"}, "expected a column 'no'"),
    ],
)
def test_a_time_that_the_options_name_must_be_one(header, column, options, words):
    with pytest.raises(InputError, match=f"{words}.*in `reader:` of the catalog entry"):
        read(f"{header},{RATES}", column, X, **options)


@pytest.mark.parametrize(
    ("preamble", "outcome"),
    [
        ("Sample rate: 100 Hz", ()),
        ("fs = 100", ()),
        ("OutputRate:,120Hz", ("rejected",)),
        ("Sampling frequency (Hz): 50.0\n", ("rejected",)),
        ("// Update Rate: 0.1kHz", ()),
        ("ODR 200", ("rejected",)),
        ("rate of turn 5", ()),
    ],
)
def test_a_rate_above_the_header_is_compared_with_the_measured_one(preamble, outcome):
    log = read(f"time (s),{RATES}", S, X, preamble=preamble)
    found = [finding for finding in log.findings if finding.check == "stated rate"]
    assert tuple(finding.outcome for finding in found) == outcome
    trusted = read(f"time (s),{RATES}", S, X, preamble=preamble, trust="options")
    assert {finding.outcome for finding in trusted.findings} <= {"kept"}
    if not outcome:
        assert not read(RATES, X, preamble=preamble, rate_hz=100).findings[1:]


def test_steps_are_summed_over_rows_that_are_left_out_as_well():
    sensor = np.arange(N) % 2
    log = read(f"dt (ms),sensor,{RATES}", S * 0 + 5, sensor, X, time_is="steps", rows={"sensor": 1})
    assert log.rate_hz == pytest.approx(100)
