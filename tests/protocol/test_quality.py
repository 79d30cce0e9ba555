import os
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from scipy import signal

from gyro_pipeline.conventions import AXES, InputError
from gyro_pipeline.logs import KEPT, REJECTED, REPAIRED, Finding, Log
from gyro_pipeline.parameters import Quality
from gyro_pipeline.physics.noise import simulate_noise, warm_up
from gyro_pipeline.protocol.quality import inspect

ROWS, RATE_HZ, SIGMA = 6000, 100.0, 0.05
REAL_DATA = os.environ.get("GYRO_PIPELINE_REAL_DATA")
needs_real_data = pytest.mark.skipif(
    REAL_DATA is None, reason="GYRO_PIPELINE_REAL_DATA does not name the folder of real recordings"
)


@pytest.fixture(scope="module")
def quality(parameters):
    return parameters().quality


@pytest.fixture
def samples():
    """One minute at rest, about biases of 3, -1 and 0.02 deg/s."""
    return np.random.default_rng(8).normal([3, -1, 0.02], SIGMA, (ROWS, 3))


def checks(inspected):
    return {finding.check: finding.outcome for finding in inspected.findings}


def detail(inspected, check):
    (finding,) = [one for one in inspected.findings if one.check == check]
    return finding.detail


def held(rates):
    rates[100:400, 1] = rates[100, 1]


def clipped(rates):
    rates[:, 0] = np.minimum(rates[:, 0], 3 + 2 * SIGMA)


def lost(rates):
    rates[700] /= 2
    rates[701] = np.inf


def knocked(rates):
    rates[500:504] += [8, -5, 2]


def turned(rates):
    rates[3000:3200, 2] += 20 * np.sin(np.pi * np.arange(200) / 200) ** 2


def rotating(rates):
    rates[2500:, 0] -= 0.5


def shaken(rates):
    rates[4000:4100] = rates.mean(axis=0) + 2.5 * (rates[4000:4100] - rates.mean(axis=0))


def carried(rates):
    rates += 2 * np.sin(2 * np.pi * 0.4 / RATE_HZ * np.arange(ROWS) + 0.1)[:, None]


def warming(rates):
    rates[:, 1] += warm_up(0.2, 20, ROWS, RATE_HZ)


def interleaved(rates):
    rates[1::2] += [0.0, 0.0, 0.8 * SIGMA]


def garbled(rates):
    rates[200, 1] = 2000


def doubled(rates):
    rates[1::2] = rates[::2]


def copied(rates):
    rates[:, 2] = rates[:, 0]


def swaying(rates):
    rates[:, 2] += np.sin(2 * np.pi / 80 * np.arange(ROWS) / RATE_HZ)


def speeding_up(rates):
    rates[:, 0] += 5 * np.exp((np.arange(ROWS) / RATE_HZ - 60) / 15)


def spinning_down(rates):
    rates[:, 0] += 20 * np.exp(-np.arange(ROWS) / RATE_HZ / 20)


def shivering(rates):
    sections = signal.butter(2, 1.0, fs=RATE_HZ, output="sos")
    sway = signal.sosfilt(sections, np.random.default_rng(3).normal(size=ROWS))
    rates[:, 2] += 2 * SIGMA * sway / sway.std()


def drifting(rates):
    rates[:, 1] += 0.3 * np.linspace(0, 1, ROWS) ** 2


def spiky(rates):
    rates[np.random.default_rng(1).random(ROWS) < 0.05, 1] += 20 * SIGMA


def calmed(rates):
    rates[3000:] = rates.mean(axis=0) + (rates[3000:] - rates.mean(axis=0)) / 2


def rounded(step):
    def change(rates):
        rates[:] = step * np.round(rates / step)

    return change


def test_a_sound_recording_is_kept_whole_without_a_finding(samples, quality):
    inspected = inspect(Log(samples), RATE_HZ, quality)
    assert (inspected.outcome, inspected.start, inspected.stop) == (KEPT, 0, ROWS)
    assert inspected.findings == ()


@pytest.mark.parametrize(
    ("change", "expected", "stretch"),
    [
        (held, {"stuck values": REPAIRED}, (400, ROWS)),
        (lost, {"non-finite values": REPAIRED, "dropouts": REPAIRED}, (702, ROWS)),
        (knocked, {"shocks": REPAIRED}, (554, ROWS)),  # and half a second behind it
        (garbled, {"shocks": REPAIRED}, (251, ROWS)),
        (clipped, {"saturation": REPAIRED, "too short": REJECTED}, None),
        (turned, {"motion": REJECTED}, None),
        (rotating, {"motion": REJECTED}, None),
        (shaken, {"motion": REJECTED}, None),
        (carried, {"motion": REJECTED}, None),
        (swaying, {"motion": REJECTED}, None),
        (speeding_up, {"motion": REJECTED}, None),
        (spinning_down, {"motion": REJECTED}, None),
        (shivering, {"motion": REJECTED}, None),
        (drifting, {"warm-up drift": KEPT}, (0, ROWS)),
        (spiky, {"spikes": REJECTED}, None),
        (calmed, {"motion": REJECTED}, None),
        (interleaved, {"alternating rows": REJECTED}, None),
        (doubled, {"repeated rows": KEPT}, (0, ROWS)),
        (copied, {"equal axes": REJECTED}, None),
        (warming, {"warm-up drift": KEPT}, (0, ROWS)),
        (rounded(0.3 * SIGMA), {}, (0, ROWS)),
        (rounded(1.3 * SIGMA), {"coarse quantisation": KEPT}, (0, ROWS)),
        (rounded(3 * SIGMA), {"coarse quantisation": REJECTED}, None),
    ],
)
def test_each_damage_has_its_finding_and_outcome(samples, quality, change, expected, stretch):
    change(samples)
    inspected = inspect(Log(samples), RATE_HZ, quality)
    assert checks(inspected) == expected
    severity = [KEPT, REPAIRED, REJECTED]
    assert inspected.outcome == max(expected.values(), key=severity.index, default=KEPT)
    if stretch is not None:
        assert (inspected.start, inspected.stop) == stretch


def test_zero_rows_at_the_ends_are_cut_and_the_recording_is_kept(samples, quality):
    samples[:3] = samples[-1] = 0
    inspected = inspect(Log(samples), RATE_HZ, quality)
    assert (inspected.outcome, inspected.start, inspected.stop) == (KEPT, 3, ROWS - 1)
    assert inspected.findings == (Finding("zero rows", KEPT, "4 rows from 0 to 5999, cut"),)


@pytest.mark.parametrize("value", [np.nan, 0.0, 1.5, 1e300])
def test_a_recording_of_one_value_has_no_stretch(quality, value):
    inspected = inspect(Log(np.full((ROWS, 3), value)), RATE_HZ, quality)
    assert inspected.outcome == REJECTED
    assert inspected.start == inspected.stop
    assert "0 of 6000 rows" in detail(inspected, "too short")


def test_garbage_bytes_read_as_a_number_are_no_value(samples, quality):
    samples[200, 1] = -1e300
    inspected = inspect(Log(samples), RATE_HZ, quality)
    assert checks(inspected) == {"non-finite values": REPAIRED}
    assert (inspected.start, inspected.stop) == (201, ROWS)


def test_one_constant_axis_rejects_the_recording_and_is_named(samples, quality):
    samples[:, 2] = 0.1
    inspected = inspect(Log(samples), RATE_HZ, quality)
    assert inspected.outcome == REJECTED
    assert detail(inspected, "stuck values") == "axis z, rows 0 to 5999, cut"


@pytest.mark.parametrize("rows", [0, 1, 2, 999])
def test_a_log_shorter_than_the_least_length_is_rejected(samples, quality, rows):
    inspected = inspect(Log(samples[:rows]), RATE_HZ, quality)
    assert checks(inspected) == {"too short": REJECTED}
    assert "expected at least 10 s" in detail(inspected, "too short")


def test_the_least_length_itself_is_kept(samples, quality):
    assert inspect(Log(samples[:1000]), RATE_HZ, quality).outcome == KEPT


def test_the_longest_stretch_between_gaps_is_kept(samples, quality):
    said = Finding("gaps", REPAIRED, "samples are missing")
    log = Log(samples, gap_rows=np.array([500, 5700]), findings=(said,))
    inspected = inspect(log, RATE_HZ, quality)
    assert (inspected.outcome, inspected.start, inspected.stop) == (REPAIRED, 500, 5700)
    assert inspected.findings == (said,)


def test_where_a_length_is_stated_no_share_of_the_recording_is_asked_for(samples, quality):
    asked = quality.model_copy(update={"length_s": 12.0})
    log = Log(samples, gap_rows=np.array([1500, 3000]))
    assert inspect(log, RATE_HZ, quality).outcome == REJECTED
    inspected = inspect(log, RATE_HZ, asked)
    assert (inspected.outcome, inspected.start, inspected.stop) == (KEPT, 3000, ROWS)


@pytest.mark.parametrize(("share", "outcome"), [(0.8, REJECTED), (0.5, REPAIRED)])
def test_a_repair_that_leaves_too_little_of_the_recording_rejects_it(
    samples, quality, share, outcome
):
    samples[2000:2004] += 9
    asked = quality.model_copy(update={"least_share": share})
    inspected = inspect(Log(samples), RATE_HZ, asked)
    assert checks(inspected)["shocks"] == REPAIRED
    assert (inspected.outcome, inspected.start, inspected.stop) == (outcome, 2054, ROWS)


def test_findings_of_the_reading_come_first_and_count(samples, quality):
    read = Finding("sample rate", REPAIRED, "something about it")
    inspected = inspect(Log(samples, findings=(read,)), RATE_HZ, quality)
    assert inspected.findings == (read,)
    assert inspected.outcome == REPAIRED


def test_what_is_no_gyroscope_at_rest_is_refused_for_its_noise(samples, quality):
    inspected = inspect(Log(samples * 100), RATE_HZ, quality)  # mdps or counts, say
    assert checks(inspected) == {"noise level": REJECTED}
    assert "quality.largest_noise_dps" in detail(inspected, "noise level")


@pytest.mark.parametrize("rate_hz", [100, 250, 1000])
def test_a_sensor_behind_a_narrow_low_pass_filter_is_at_rest(quality, rate_hz):
    filtered = signal.butter(2, 5, fs=rate_hz, output="sos")
    for seed in range(5):
        noise = np.random.default_rng(seed).normal(0, 1, (60 * rate_hz, 3))
        rates = signal.sosfilt(filtered, noise, 0)[5 * rate_hz :]
        rates = np.round(0.05 * rates / rates.std() / 0.001) * 0.001
        assert inspect(Log(rates), rate_hz, quality).outcome == KEPT


@pytest.mark.parametrize("rate_hz", [100, 1000])
def test_a_warm_up_with_a_knock_at_its_start_is_at_rest(quality, rate_hz):
    seconds = np.arange(40 * rate_hz) / rate_hz
    for seed in range(4):
        rates = np.random.default_rng(seed).normal(0, 0.03, (len(seconds), 3))
        rates += np.exp(-seconds / 10)[:, None] * [1, 0.5, -0.3]
        if rate_hz == 100:
            rates[30:50] += 5 * np.sin(np.arange(20))[:, None]
        found = checks(inspect(Log(rates), rate_hz, quality))
        assert found == {"warm-up drift": KEPT} | ({"shocks": REPAIRED} if rate_hz == 100 else {})


@pytest.mark.parametrize("rate_hz", [0.1, 2.0])
def test_a_rate_too_low_for_blocks_asks_for_rows(samples, quality, rate_hz):
    assert checks(inspect(Log(samples[:49]), rate_hz, quality)) == {"too short": REJECTED}
    assert inspect(Log(samples[:50]), rate_hz, quality).outcome == KEPT


@pytest.mark.filterwarnings("error")
def test_knocks_all_the_time_leave_no_stretch(samples, quality):
    samples[::70] += 5
    assert checks(inspect(Log(samples), RATE_HZ, quality)) == {
        "shocks": REPAIRED,
        "too short": REJECTED,
    }


def test_samples_that_are_not_three_columns_are_refused(quality):
    with pytest.raises(InputError, match=r"expected samples of 3 axes, \(n, 3\), got shape \(3, 9"):
        inspect(Log(np.zeros((3, 900))), RATE_HZ, quality)


def test_blocks_too_long_for_the_least_length_are_refused(quality):
    with pytest.raises(ValueError, match="expected at least 10 blocks of block_s, 2 s"):
        Quality(**quality.model_dump() | {"block_s": 2.0})


CHANGES = [held, clipped, lost, knocked, turned, rotating, shaken, warming, rounded(3 * SIGMA)]


@pytest.mark.parametrize("change", CHANGES)
@pytest.mark.parametrize(("scale", "bias"), [(8, 0), (0.125, 0), (1, 40), (-1, 0)])
def test_neither_scale_nor_bias_changes_the_outcome(samples, quality, change, scale, bias):
    change(samples)
    one = inspect(Log(samples), RATE_HZ, quality)
    other = inspect(Log(samples * scale + bias), RATE_HZ, quality)
    assert (other.outcome, other.start, other.stop) == (one.outcome, one.start, one.stop)
    assert checks(other) | {"warm-up drift": KEPT} == checks(one) | {"warm-up drift": KEPT}


@pytest.mark.parametrize("change", CHANGES)
def test_permuted_axes_have_permuted_findings(samples, quality, change):
    change(samples)
    one = inspect(Log(samples), RATE_HZ, quality)
    other = inspect(Log(samples[:, [2, 0, 1]]), RATE_HZ, quality)  # x is now called y
    names = str.maketrans("xyz", "yzx")
    for before, after in zip(one.findings, other.findings, strict=True):
        assert after.check == before.check
        for axis in AXES:
            assert (f"axis {axis}" in before.detail) == (
                f"axis {axis.translate(names)}" in after.detail
            )


def at_rest(generator, sensor, **noise):
    """A recording of a sensor's stand-in, with a bias."""
    simulated = sensor.simulated
    noise = {"lag1_correlation": simulated.lag1_correlation} | noise
    white = 1e-3 * np.array(simulated.noise_mdps_rts)
    rates = simulate_noise(generator, (3, 13_000), sensor.rate_hz, white, **noise)
    return rates.T + generator.uniform(-1, 1, 3) * simulated.unit_bias_dps


def a_turn(generator, rates, rate_hz):
    n = round(2 * rate_hz)
    start, peak = generator.integers(len(rates) - n), generator.uniform(5, 60)
    rates[start : start + n] += peak * np.hanning(n)[:, None] * a_direction(generator)


def a_slow_rotation(generator, rates, rate_hz):
    rates[int(generator.uniform(0.1, 0.9) * len(rates)) :] += 0.5 * a_direction(generator)


def a_shock(generator, rates, rate_hz):
    n = generator.integers(3, round(0.2 * rate_hz) + 1)
    start, peak = generator.integers(len(rates) - n), generator.uniform(3, 50)
    rates[start : start + n] += peak * np.hanning(n + 2)[1:-1, None] * a_direction(generator)


def a_direction(generator):
    """Some axis and sign."""
    return generator.choice([-1, 1]) * np.eye(3)[generator.integers(3)]


@pytest.mark.parametrize(
    ("disturb", "check"),
    [(a_turn, "motion"), (a_slow_rotation, "motion"), (a_shock, "shocks")],
)
def test_of_100_disturbances_at_least_99_are_found(parameters, disturb, check):
    p, generator = parameters("base"), np.random.default_rng(9)
    found = 0
    for _ in range(25):
        for sensor in p.sensors.values():
            rates = at_rest(generator, sensor)
            disturb(generator, rates, sensor.rate_hz)
            inspected = inspect(Log(rates), sensor.rate_hz, p.quality)
            found += check in checks(inspected) and inspected.outcome != KEPT
    assert found >= 99


@pytest.mark.parametrize(
    ("amplitude_dps", "time_constant_s"), [(0.2, 3), (0.3, 5), (0.5, 5), (1, 10), (0.1, 1)]
)
def test_a_quick_warm_up_is_at_rest(parameters, amplitude_dps, time_constant_s):
    p, generator = parameters("base"), np.random.default_rng(11)
    for sensor in p.sensors.values():
        for sign in (-1, 1):
            rates = at_rest(generator, sensor)
            amplitudes = sign * amplitude_dps * np.array([1, 0.6, 0.4])
            rates += warm_up(amplitudes, time_constant_s, len(rates), sensor.rate_hz).T
            inspected = inspect(Log(rates), sensor.rate_hz, p.quality)
            assert checks(inspected) == {"warm-up drift": KEPT}


@pytest.mark.parametrize(("size_dps", "within_s"), [(0.5, 20), (0.3, 10), (0.5, 5), (0.1, 0)])
def test_a_slow_or_small_onset_is_motion_and_no_warm_up(parameters, size_dps, within_s):
    p, generator = parameters("base"), np.random.default_rng(12)
    for name in ("dot", "sparkfun"):  # of 87 s and more; in Memsense's 52 s a ramp is a drift
        sensor = p.sensors[name]
        for start in (0.2, 0.4, 0.6):
            rates = at_rest(generator, sensor)
            seconds = (np.arange(len(rates)) - start * len(rates)) / sensor.rate_hz
            rates[:, 1] += size_dps * np.clip(seconds / max(within_s, 1e-9), 0, 1)
            assert checks(inspect(Log(rates), sensor.rate_hz, p.quality))["motion"] == REJECTED


@pytest.mark.parametrize("colour", ["white", "lag 1", "flicker", "warm-up"])
def test_of_1000_recordings_at_rest_at_most_10_are_not_kept(parameters, colour):
    """About a tenth of them here; all of them in benchmarks/quality.py."""
    p, generator = parameters("base"), np.random.default_rng(10)
    noise = {"lag 1": {"lag1_correlation": -0.15}, "flicker": {"flicker_dps": 3e-3}}
    lost = 0
    for _ in range(6):
        for sensor in p.sensors.values():
            rates = at_rest(generator, sensor, **noise.get(colour, {}))
            if colour == "warm-up":
                amplitude = generator.normal(20e-3, 5e-3, 3)
                rates += warm_up(amplitude, 30, len(rates), sensor.rate_hz).T
            lost += inspect(Log(rates), sensor.rate_hz, p.quality).outcome != KEPT
    assert lost == 0


def test_the_short_recordings_of_the_smoke_environment_are_kept(parameters):
    p, generator = parameters("smoke"), np.random.default_rng(11)
    for sensor in p.sensors.values():
        for _ in range(25):
            rates = at_rest(generator, sensor)[: sensor.samples]
            assert inspect(Log(rates), sensor.rate_hz, p.quality).outcome == KEPT


@needs_real_data
def test_all_real_memsense_recordings_are_kept(parameters):
    recordings = np.load(Path(REAL_DATA) / "memsense_test_real.npy")
    for rates in recordings:
        inspected = inspect(Log(rates.T), 250.0, parameters().quality)
        assert (inspected.outcome, inspected.start, inspected.stop) == (KEPT, 0, 13_000)


@needs_real_data
@pytest.mark.parametrize("unit", [1, 2, 3, 4, 5])
def test_real_dot_recordings_are_kept_and_the_one_with_a_dropout_is_repaired(parameters, unit):
    table = pd.read_csv(Path(REAL_DATA) / f"dot_x_stat_{unit}.csv", skipinitialspace=True)
    rates = table[["w_x", "w_y", "w_z"]].to_numpy(np.float64)
    inspected = inspect(Log(rates), 120.0, parameters().quality)
    assert detail(inspected, "zero rows") == "row 0, cut"
    if unit > 1:
        assert (inspected.outcome, inspected.start) == (KEPT, 1)
        assert inspected.stop == len(rates)
    else:
        assert detail(inspected, "dropouts") == "row 13000, cut"
        assert detail(inspected, "non-finite values") == "axes x, y, z, row 13001, cut"
        assert (inspected.outcome, inspected.start, inspected.stop) == (REPAIRED, 1, 13_000)
