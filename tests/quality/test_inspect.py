import os
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from scipy import signal

from gyro_pipeline.conventions import InputError
from gyro_pipeline.logs import KEPT, REJECTED, REPAIRED, Finding, Log
from gyro_pipeline.parameters import Quality
from gyro_pipeline.physics.noise import simulate_noise
from gyro_pipeline.quality import inspect

ROWS, RATE_HZ, SIGMA = 6000, 100.0, 0.05
BIAS = np.array([0.7, -0.4, 0.15])
SECONDS = np.arange(ROWS) / RATE_HZ
REAL_DATA = os.environ.get("GYRO_PIPELINE_REAL_DATA")
needs_real_data = pytest.mark.skipif(
    REAL_DATA is None, reason="GYRO_PIPELINE_REAL_DATA does not name the folder of real recordings"
)


@pytest.fixture(scope="module")
def quality(parameters):
    return parameters("base").quality


@pytest.fixture
def still():
    """One minute at rest, about three different biases."""
    return np.random.default_rng(8).normal(BIAS, SIGMA, (ROWS, 3))


def checks(inspected):
    return {finding.check: finding.outcome for finding in inspected.findings}


def detail(inspected, check):
    return "; ".join(f.detail for f in inspected.findings if f.check == check)


def decay(size, constant_s):
    return size * np.exp(-SECONDS / constant_s)[:, None]


def rounded(step):
    return lambda x: step * np.round(x / step)


def with_rows(rows, change):
    """A change of some rows, whose index it is given."""

    def apply(x):
        x[rows] = change(x[rows])
        return x

    return apply


def knocked(x):
    x[500:504] += [8, -5, 2]
    return x


def knocked_throughout(x):
    for start in range(30, ROWS, 300):
        x[start : start + 10] += 5
    return x


def touched(x):
    for start in (1000, 3000, 5000):
        x[start : start + 150, 1] += 5 * np.hanning(150)
    return x


def started(x):
    x[:12, 0] = np.linspace(-3, 0.7, 12, endpoint=False)
    return x


def dense_spikes(x):
    x[np.random.default_rng(1).random(ROWS) < 0.02, 1] += 20 * SIGMA
    return x


def dead(x):
    x = x - BIAS + [0.04, -0.02, 0.01]
    return np.where(np.abs(x) < 0.03, 0, x)


def held(x):
    x[100:400, 1] = x[100, 1]
    return x


def taking_turns(period):
    return with_rows(slice(1, None, period), lambda rows: rows + [0.3, 0, 0])


def swaying(amplitude_dps, period_s):
    return lambda x: x + [[0, 0, amplitude_dps]] * np.sin(2 * np.pi / period_s * SECONDS)[:, None]


@pytest.mark.parametrize(
    ("change", "expected", "words"),
    [
        (lambda x: x, {}, []),
        (with_rows(700, lambda row: row * np.nan), {"non-finite values": REPAIRED}, ["row 700, "]),
        (with_rows(200, lambda row: row * 1e300), {"non-finite values": REPAIRED}, ["row 200, "]),
        (held, {"stuck values": REPAIRED}, ["axis y, rows 100 to 399"]),
        (with_rows(77, lambda row: row + [0, 9 * SIGMA, 0]), {"spikes": REPAIRED}, ["y, row 77,"]),
        (dense_spikes, {"spikes": REPAIRED}, ["axis y"]),
        (knocked, {"shocks": REPAIRED}, ["rows 450 to 553"]),
        (started, {"start": REPAIRED}, ["rows 0 to 60 "]),
        (lambda x: x + decay(0.5, 0.4), {"start": REPAIRED}, ["rows 0 to 1"]),
        (lambda x: x + decay(0.3, 8), {"warm-up": KEPT}, ["x by -", "time constant about 8"]),
        (lambda x: x + decay(0.2, 3) + decay(0.3, 40), {"warm-up": KEPT}, []),
        (lambda x: x + 0.4 * SECONDS[:, None] / 60, {"drift": KEPT}, ["by +4", "not settled"]),
        (lambda x: x + 0.3 * (SECONDS[:, None] / 60) ** 2, {"drift": KEPT}, []),
        (lambda x: x + decay(20, 20), {"motion": REJECTED}, ["largest_drift_dps"]),
        (knocked_throughout, {"motion": REJECTED}, ["and 15 more"]),
        (touched, {"motion": REJECTED}, ["rows 9", "rows 29", "rows 49", "axis y"]),
        (with_rows(slice(2500, None), lambda x: x - [0.1, 0, 0]), {"motion": REJECTED}, ["axis x"]),
        (with_rows(slice(3000), lambda x: x * 2 - BIAS), {"motion": REJECTED}, ["the noise"]),
        (swaying(0.5, 2), {"motion": REJECTED}, ["axis z"]),
        (swaying(1, 80), {"motion": REJECTED}, ["axis z"]),
        (swaying(30, 30), {"motion": REJECTED}, ["30 deg/s, axis z"]),
        (lambda x: x - BIAS + BIAS * (SECONDS < 20)[:, None], {"bias taken off": REJECTED}, []),
        (lambda x: x - BIAS + decay(BIAS, 0.7), {"bias taken off": REJECTED}, ["raw rates"]),
        (lambda x: np.minimum(x, BIAS + 2 * SIGMA), {"saturation": REJECTED}, []),
        (rounded(0.3 * SIGMA), {}, []),
        (rounded(1.3 * SIGMA), {"coarse quantisation": KEPT}, []),
        (rounded(3 * SIGMA), {"coarse quantisation": REJECTED}, ["quality.largest_step"]),
        (lambda x: np.repeat(x[::2], 2, axis=0), {"repeated rows": REJECTED}, ["50.0%", "drop"]),
        (lambda x: np.repeat(x[::40], 40, axis=0), {"repeated rows": REJECTED}, ["97.5%"]),
        (with_rows(slice(1, 600, 1), lambda x: np.repeat(x[:200], 3, 0)[:599]),
         {"repeated rows": KEPT}, ["6.7%"]),
        (taking_turns(2), {"alternating rows": REJECTED}, ["every 2 rows axis x", "`rows:"]),
        (taking_turns(3), {"alternating rows": REJECTED}, ["every 3 rows"]),
        (taking_turns(4), {"alternating rows": REJECTED}, ["every 4 rows"]),
        (lambda x: x[:, [0, 1, 0]], {"equal axes": REJECTED}, ["x and z", "`columns`"]),
        (dead, {"dead band": REJECTED}, ["± 0.03 deg/s"]),
        (lambda x: x * 1000, {"noise level": REJECTED}, ["quality.largest_noise_dps"]),
        (lambda x: x / 57.3, {"little noise": KEPT}, ["less noise", "`units`"]),
    ],
)  # fmt: skip
def test_each_oddity_has_its_finding(still, quality, change, expected, words):
    inspected = inspect(Log(change(still)), RATE_HZ, quality)
    assert checks(inspected) == expected
    assert inspected.outcome == max(
        expected.values(), key=[KEPT, REPAIRED, REJECTED].index, default=KEPT
    )
    for word in words:
        assert word in "; ".join(f.detail for f in inspected.findings)


def test_what_is_brief_is_masked_and_does_not_end_the_recording(quality):
    x = np.random.default_rng(0).normal(BIAS, SIGMA, (14_450, 3))
    x[7000, 1] += 0.46
    inspected = inspect(Log(x), 120.0, quality)
    assert (inspected.outcome, inspected.start, inspected.stop) == (REPAIRED, 0, 14_450)
    assert np.flatnonzero(inspected.masked).tolist() == [7000]


def test_rows_are_named_as_the_file_has_them(still, quality):
    still[10] += 9
    inspected = inspect(Log(still, rows=2 * np.arange(ROWS) + 1), RATE_HZ, quality)
    assert "row 21, masked" in detail(inspected, "spikes")
    assert np.flatnonzero(inspected.masked).tolist() == [10]


def test_what_is_masked_at_the_ends_is_cut(still, quality):
    still[:3] = still[-1] = 0
    still[3] = np.nan
    inspected = inspect(Log(still), RATE_HZ, quality)
    assert (inspected.outcome, inspected.start, inspected.stop) == (REPAIRED, 4, ROWS - 1)
    assert not inspected.masked.any()
    assert inspected.masked.shape == (ROWS - 5,)
    assert detail(inspected, "zero rows") == "rows 0 to 2, row 5999, cut"


def test_the_longest_stretch_between_gaps_is_kept_and_findings_of_the_reading_come_first(
    still, quality
):
    said = Finding("sample rate", KEPT, "something about it")
    log = Log(still, gap_rows=np.array([500, 5700]), findings=(said,))
    inspected = inspect(log, RATE_HZ, quality)
    assert (inspected.outcome, inspected.start, inspected.stop) == (REPAIRED, 500, 5700)
    assert [f.check for f in inspected.findings] == ["sample rate", "gaps"]


@pytest.mark.parametrize("value", [np.nan, 0.0, 1.5, 1e300])
def test_a_recording_of_one_value_has_no_rows(quality, value):
    inspected = inspect(Log(np.full((ROWS, 3), value)), RATE_HZ, quality)
    assert inspected.outcome == REJECTED
    assert inspected.start == inspected.stop
    assert "0 of 6000 rows" in detail(inspected, "too short")


@pytest.mark.parametrize(
    ("rows", "lost", "outcome"),
    [(0, 0, REJECTED), (1, 0, REJECTED), (999, 0, REJECTED), (1000, 0, KEPT), (1000, 1, REJECTED),
     (ROWS, 1150, REPAIRED), (ROWS, 1250, REJECTED)],
)  # fmt: skip
def test_too_few_rows_or_too_small_a_share_reject(still, quality, rows, lost, outcome):
    still[300 : 300 + lost] = np.nan
    inspected = inspect(Log(still[:rows]), RATE_HZ, quality)
    assert inspected.outcome == outcome
    assert ("quality.least_share" in detail(inspected, "too short")) == (outcome == REJECTED)


def test_samples_that_are_not_three_columns_are_refused(quality):
    with pytest.raises(InputError, match=r"expected samples of 3 axes, \(n, 3\), got shape \(3, 9"):
        inspect(Log(np.zeros((3, 900))), RATE_HZ, quality)


def test_blocks_too_long_for_the_least_length_are_refused(quality):
    with pytest.raises(ValueError, match="expected at least 10 blocks of block_s, 2 s"):
        Quality(**quality.model_dump() | {"block_s": 2.0})


@pytest.mark.parametrize("change", [knocked, touched, started, held, dense_spikes, taking_turns(3)])
def test_permuted_axes_have_permuted_findings(still, quality, change):
    log = change(still)
    inspected = inspect(Log(log), RATE_HZ, quality)
    turned = inspect(Log(log[:, [2, 0, 1]]), RATE_HZ, quality)  # x is now called y
    np.testing.assert_array_equal(turned.masked, inspected.masked)
    for before, after in zip(inspected.findings, turned.findings, strict=True):
        for axis, name in zip("xyz", "yzx", strict=True):
            assert (f"axis {axis}" in before.detail) == (f"axis {name}" in after.detail)


@pytest.mark.parametrize(("rate_hz", "minutes"), [(5, 120), (10, 60), (108, 2), (1000, 0.5)])
@pytest.mark.parametrize(
    "noise",
    [{}, {"lag1_correlation": -0.15}, {"flicker_dps": 3e-3}, {"random_walk_dps_rts": 1e-4}],
)
def test_at_rest_is_kept_at_any_rate_and_length(quality, rate_hz, minutes, noise):
    """A few of each here; a thousand in benchmarks/quality.py."""
    for seed in range(4):
        generator = np.random.default_rng(seed)
        rates = simulate_noise(generator, (3, int(60 * minutes * rate_hz)), rate_hz, 5e-3, **noise)
        inspected = inspect(Log(rates.T + BIAS), rate_hz, quality)
        assert inspected.outcome == KEPT
        assert checks(inspected).keys() <= {"warm-up", "drift"}


def test_a_sensor_behind_a_narrow_low_pass_filter_is_at_rest(quality):
    for seed in range(4):
        noise = np.random.default_rng(seed).normal(0, 0.55, (60_000, 3))
        rates = signal.sosfilt(signal.butter(2, 5, fs=1000, output="sos"), noise, 0)[5000:]
        rates = np.round(rates / 0.001) * 0.001 + BIAS
        assert inspect(Log(rates), 1000, quality).outcome == KEPT


def test_the_short_recordings_of_the_smoke_environment_are_kept(parameters):
    p, generator = parameters("smoke"), np.random.default_rng(11)
    for sensor in p.sensors.values():
        noise = 1e-3 * np.array(sensor.simulated.noise_mdps_rts)
        for _ in range(25):
            rates = simulate_noise(generator, (3, sensor.samples), sensor.rate_hz, noise).T
            assert inspect(Log(rates + BIAS), sensor.rate_hz, p.quality).outcome == KEPT


def test_a_bias_that_wanders_slowly_is_at_rest_and_said(quality):
    rates = np.random.default_rng(1).normal(BIAS, 0.02, (36_000, 3))
    rates[:, 1] += 0.1 * np.sin(2 * np.pi * np.arange(36_000) / 18_000)
    inspected = inspect(Log(rates), 10.0, quality)
    assert checks(inspected) == {"drift": KEPT}
    assert "axis y wanders by 19" in detail(inspected, "drift")


@needs_real_data
def test_all_real_recordings_are_kept_but_for_two_rows(quality):
    for rates in np.load(Path(REAL_DATA) / "memsense_test_real.npy"):
        inspected = inspect(Log(rates.T), 250.0, quality)
        assert (inspected.outcome, inspected.start, inspected.stop) == (KEPT, 0, 13_000)
    for unit in range(1, 6):
        table = pd.read_csv(Path(REAL_DATA) / f"dot_x_stat_{unit}.csv", skipinitialspace=True)
        log = Log(table[["w_x", "w_y", "w_z"]].to_numpy(np.float64))
        inspected = inspect(log, 120.0, quality)
        assert (inspected.start, inspected.stop) == (1, len(log.samples))
        assert detail(inspected, "zero rows") == "row 0, cut"
        masked = inspected.start + np.flatnonzero(inspected.masked)
        assert masked.tolist() == ([13_000, 13_001] if unit == 1 else [])
