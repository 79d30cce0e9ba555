"""Samples in, a state out: what holds for every recording."""

import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest

from gyro_pipeline.calibrator import Calibration, Calibrator, Circumstances
from gyro_pipeline.calibrator.cli import _feed
from gyro_pipeline.calibrator.device_types import read_type, type_of
from gyro_pipeline.conventions import InputError
from gyro_pipeline.parameters import ReaderOptions
from gyro_pipeline.readers import read_log

RATE = 100.0
BIAS = np.array([0.412, -0.104, 0.087])  # three different axes
KIND = type_of({"type": "test", "noise_mdps_rts": [3, 4, 5], "turn_on_mdps": 0.3}, "here")
UNKNOWN = type_of({}, "here")


def still(seconds, seed=1, rate=RATE):
    noise = np.array([3, 4, 5]) * 1e-3 * np.sqrt(rate)
    return BIAS + np.random.default_rng(seed).normal(0, noise, (round(seconds * rate), 3))


def history(count=14, seed=2, spread=0.3e-3):
    rng = np.random.default_rng(seed)
    return [Calibration(tuple(BIAS + rng.normal(0, spread, 3)), (1e-8,) * 3) for _ in range(count)]


DECLARED = Circumstances(same_heading=True)
UP = np.tile([0.0, 0, 1], (1000, 1))


def fed(samples, kind=KIND, gravity=None, warmth=None, time_s=None, **options):
    calibrator = Calibrator(kind, RATE, **options)
    calibrator.update(time_s, samples, gravity, warmth)
    return calibrator


def finished(samples, **options):
    return fed(samples, **options).finish()


def codes(state):
    return {reason.code for reason in state.reasons}


def test_importing_it_imports_numpy_alone():
    check = (
        "import sys, gyro_pipeline.calibrator as _;"
        "roots = {name.split('.')[0] for name in sys.modules};"
        "heavy = roots - set(sys.stdlib_module_names) - {'gyro_pipeline', 'numpy', '__main__'};"
        "print({name for name in heavy if not name.startswith('_')})"
    )
    options = [sys.executable, "-S", "-c", f"import sys; sys.path[:] = {sys.path!r}; {check}"]
    out = subprocess.run(options, capture_output=True, text=True, check=True)
    assert out.stdout.strip() == "set()"


def test_without_history_it_is_the_mean_and_before_any_sample_the_history():
    samples = still(20)
    state = finished(samples)
    np.testing.assert_allclose(state.bias_dps, samples.mean(axis=0), rtol=1e-12)
    np.testing.assert_allclose(state.sigma_dps, np.array([3, 4, 5]) * 1e-3 / np.sqrt(20))
    assert (state.rest, state.seconds_at_rest, state.history) == ("still", 20.0, ("none",) * 3)
    state = Calibrator(KIND, RATE, history(), DECLARED).state()
    np.testing.assert_allclose(state.bias_dps, BIAS, atol=0.5e-3)
    assert np.all(state.sigma_dps < 0.5e-3)
    assert (state.rest, state.history) == ("unsure", ("used",) * 3)


def test_with_history_it_is_the_posterior_mean():
    """One calibration, N known: weights by the inverse variances, tau twice, the mixture aside."""
    state = finished(still(10), history=history(), now=DECLARED)
    own, past = 1 / state.stretch.estimate.variance, 1 / state.stretch.prior.narrow
    expected = (own * state.stretch.estimate.bias + past * state.stretch.prior.mean) / (own + past)
    np.testing.assert_allclose(state.bias_dps, expected, atol=5e-5)
    np.testing.assert_allclose(state.sigma_dps, (own + past) ** -0.5, rtol=0.03)


def test_a_heading_that_is_not_declared_costs_the_earths_rate_twice_but_on_the_vertical_axis():
    known = DECLARED, Circumstances(latitude_deg=60.0)
    declared, not_declared = (Calibrator(KIND, RATE, history(), now).state() for now in known)
    added = not_declared.stretch.prior.narrow - declared.stretch.prior.narrow
    np.testing.assert_allclose(added, (4.178e-3 * 0.5) ** 2, rtol=1e-6)
    assert "heading" in codes(not_declared)
    assert "heading" not in codes(declared)
    past = [replace(c, gravity=(0.0, 0.0, 1.0)) for c in history()]
    sigma = finished(still(5), history=past, gravity=UP[:500]).stretch.prior.narrow ** 0.5
    assert np.all(sigma[:2] > 4e-3)
    assert sigma[2] < 0.5e-3


def test_how_a_recording_is_cut_changes_no_bit(seed=1):
    """Motion, a turn, a gap, warmth, a wrong history and lost samples included."""
    rng = np.random.default_rng(seed)
    samples, time_s = still(60, seed), np.arange(6000) / RATE
    samples[1500:1530] += np.sin(np.linspace(0, 2 * np.pi, 30))[:, None] * 3
    samples[4000:4100, 2] += 20
    samples[2222], time_s[3000:] = np.nan, time_s[3000:] + 4.3
    gravity = np.array([0, 0.1, 0.99]) + rng.normal(0, 1e-3, (6000, 3))
    warmth = 25 + np.arange(6000) / 2000
    past = [replace(c, mean_dps=tuple(c.mean + 0.01), temperature_c=(25.0,) * 3) for c in history()]
    kind = type_of({"noise_mdps_rts": 4, "temperature_spread_mdps_per_c": 2}, "here")
    whole = fed(samples, kind, gravity, warmth, time_s, history=past, now=DECLARED, target_dps=1e-3)
    parts = Calibrator(kind, RATE, past, DECLARED, 1e-3)
    edges = [0, 1, 2, *np.sort(rng.choice(np.arange(3, 6000), 60, replace=False)), 6000]
    for first, last in zip(edges[:-1], edges[1:], strict=True):
        part = slice(first, last)
        parts.update(time_s[part], samples[part], gravity[part], warmth[part])
    one, other = whole.finish(), parts.finish()
    for name in ("bias_dps", "sigma_dps", "seconds_left"):
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name))
    assert one.reasons == other.reasons
    assert (one.rest, one.seconds_at_rest) == (other.rest, other.seconds_at_rest)
    assert {"cut", "attitude", "gap", "not_finite", "conflict"} <= codes(one)


def test_a_first_sample_alone_changes_neither_a_bit_nor_the_order_of_what_is_said():
    """An index leaves lost samples out in another memory layout; an axis dies after a turn."""
    samples = still(20)
    samples[1500], samples[800:900, 2] = np.nan, samples[800:900, 2] + 30
    samples[1600:, 0] = 0.5
    whole, parts = fed(samples, UNKNOWN), Calibrator(UNKNOWN, RATE)
    for part in (samples[:1], samples[1:1400], samples[1400:]):
        parts.update(None, part)
    one, other = whole.finish(), parts.finish()
    np.testing.assert_array_equal(one.sigma_dps, other.sigma_dps)
    assert one.reasons == other.reasons
    assert [reason.code for reason in one.reasons][:2] == ["dead", "attitude"]


def test_seconds_left_are_the_ones_it_takes():
    samples = still(60)
    calibrator = Calibrator(KIND, RATE, target_dps=1.0001e-3)
    state = calibrator.update(None, samples[:500])  # N^2 / target^2 = 9, 16, 25 s
    np.testing.assert_array_equal(state.seconds_left, [4.0, 11.0, 20.0])
    assert not calibrator.update(None, samples[500:2450]).done
    assert calibrator.update(None, samples[2450:2500]).done


def test_seconds_left_expect_a_history_that_is_away_to_come_nearer():
    kind, late = type_of({"noise_mdps_rts": 3.3, "turn_on_mdps": 0.31}, "here"), []
    for seed in range(6):
        samples, options = still(200, seed), {"history": history(seed=seed), "now": DECLARED}
        calibrator = fed(samples[:150], kind, target_dps=0.28e-3, **options)
        expected, took = calibrator.state().seconds_left, np.zeros(3)
        for block in samples[150:].reshape(-1, 50, 3):
            took += 0.5 * ~calibrator.state().stretch.reached
            calibrator.update(None, block)
        late += (took - expected).tolist()
    assert np.median(np.abs(late)) == 0
    assert np.mean(np.abs(late) <= 1) > 0.8


def test_a_target_below_the_floor_is_not_offered():
    kind = type_of({"noise_mdps_rts": 3, "flicker_mdps": [3, 0, 0]}, "here")
    state = finished(still(5), kind=kind, target_dps=1.5e-3)
    assert np.isinf(state.seconds_left).tolist() == [True, False, False]
    (floor,) = [reason for reason in state.reasons if reason.code == "floor"]
    assert (floor.axis, floor.value) == ("x", pytest.approx(0.664 * 3, rel=1e-3))
    assert "below 1.99 mdps" in floor.sentence
    kind = replace(KIND, flicker_mdps=3.0)  # a target that a history reaches counts
    known = finished(still(5), kind=kind, target_dps=1.5e-3, history=history(), now=DECLARED)
    assert (known.done, "floor" in codes(known)) == (True, False)


def test_noise_that_is_not_known_makes_students_intervals_and_a_least_time():
    state = finished(still(5), kind=UNKNOWN, target_dps=0.1)
    assert not state.done
    means = still(5).reshape(10, 50, 3).mean(axis=1)
    sigma = means.std(axis=0, ddof=1) / np.sqrt(10) * 2.262 / 1.96
    np.testing.assert_allclose(state.sigma_dps, sigma, rtol=2e-3)
    assert finished(still(10), kind=UNKNOWN, target_dps=0.1).done
    assert "colour" in codes(state)


KNOCK = np.s_[1000:1030], 2 * np.sin(np.linspace(0, 2 * np.pi, 30))[:, None]
TURN = np.s_[1000:1100], np.array([0, 0, 30.0])  # by 30 degrees
HANDLED = np.s_[2000:], np.random.default_rng(4).normal(0, 20, (1000, 3))


@pytest.mark.parametrize(
    ("motion", "code", "least", "most"),
    [(KNOCK, "cut", 27, 29.5), (TURN, "attitude", 18, 19.5), (HANDLED, "motion", 19, 20)],
)
def test_what_is_left_of_a_recording_with_a_motion(motion, code, least, most):
    """A knock is cut, a turn ends the stretch, and what came before the end in the hand is kept."""
    samples = still(30)
    samples[motion[0]] += motion[1]
    state = finished(samples)
    assert (state.rest, code in codes(state)) == ("still", True)
    assert least <= state.seconds_at_rest <= most


def test_motion_throughout_is_not_at_rest_and_not_taken_for_a_wrong_unit():
    fast, slow, slower = (20 * np.sin(np.arange(2000) / n)[:, None] for n in (10, 30, 300))
    for kind in (KIND, UNKNOWN):
        assert finished(still(20) + slow, kind=kind).rest == "moving"
    for sway in (fast, slower):
        state = finished(still(20) + sway, kind=read_type("memsense"))
        told = state.rest, "noise" in codes(state), "unit" in codes(state)
        assert told == ("moving", True, False)


def test_a_slow_rotation_is_seen_by_the_accelerometer_alone():
    """3 times the noise of the mean, about x; 100 ug/sqrt(Hz), one-sided."""
    samples, t = still(10), np.arange(1000) / RATE
    rate = 3 * 3e-3 / np.sqrt(10)
    samples[:, 0] += rate
    gravity = np.random.default_rng(5).normal([0, 0, 1], 1e-4 * np.sqrt(RATE / 2), (1000, 3))
    gravity[:, 1] += np.sin(np.radians(rate) * t)
    state = finished(samples, gravity=gravity)
    assert (state.rest, "rotation" in codes(state)) == ("moving", True)
    assert finished(samples).rest == "still"


def test_a_wrong_history_is_dropped_where_it_is_wrong_and_never_part_of_the_evidence():
    off = {"gravity": (0.0, 0.0, 1.0)}
    past = [replace(c, mean_dps=tuple(c.mean + [0, 0, 0.02]), **off) for c in history()]
    state = finished(still(10), history=past, now=DECLARED, gravity=UP)
    assert state.history == ("used", "used", "dropped")
    assert state.bias_dps[2] == state.stretch.estimate.bias[2]
    assert [r.axis for r in state.reasons if r.code == "conflict"] == ["z"]
    one = fed(still(10), history=history(), now=DECLARED).calibration()
    other = fed(still(10)).calibration()
    np.testing.assert_array_equal(one.mean, other.mean)
    np.testing.assert_array_equal(one.variance, other.variance)


def test_warm_up_settles_and_is_said():
    warm = {"amplitude_mdps": 20, "spread_mdps": 5, "time_constant_s": 20}
    kind = type_of({"noise_mdps_rts": [3, 4, 5], "warm_up": warm}, "here")
    samples = still(30) + 0.02 * np.exp(-np.arange(3000) / RATE / 20)[:, None]
    state = finished(samples, kind=kind, now=Circumstances(since_power_on_s=0.0))
    assert np.all(np.abs(state.bias_dps - BIAS) < 3 * state.sigma_dps)
    assert "warm_up" in codes(state)


def test_a_gap_before_the_first_block_of_a_stretch_makes_it_start_later():
    stretch = Calibrator(KIND, RATE, now=Circumstances(since_power_on_s=3.0)).stretch.cut(5.0, None)
    assert (stretch.start_s, stretch.filter.age_s, stretch.filter.time_s) == (5.0, 8.0, 0.0)


@pytest.mark.parametrize(
    "samples",
    [
        np.tile([0.1, 0.2, 0.3], (1000, 1)),  # whose block means are rounded
        np.r_[still(8), np.tile(BIAS + 1e-3, (600, 1))],
        (still(10) - BIAS) / np.degrees(1) + BIAS,
    ],
    ids=["constant", "frozen", "rad/s"],
)
def test_data_that_cannot_be_used_are_never_done_and_no_evidence(samples):
    calibrator = Calibrator(KIND, RATE, target_dps=1.7e-3)  # 8.7 s
    states = [calibrator.update(None, block) for block in samples.reshape(-1, 50, 3)]
    assert not any(state.done for state in states)
    assert (states[-1].reached, states[-1].unusable) == (True, True)
    assert calibrator.calibration().mean_dps is None
    past = [replace(c, mean_dps=(0.1, 0.2, 0.3)) for c in history()]
    assert not fed(np.tile([0.1, 0.2, 0.3], (100, 1)), history=past, target_dps=9e-3).state().done


def test_a_wrong_unit_is_not_done_before_block_means_can_tell_it_from_a_motion():
    for factor, ends in ((1.0, True), (np.radians(1), False), (np.degrees(1), False)):
        calibrator = Calibrator(KIND, RATE, target_dps=0.05)
        states = [calibrator.update(None, b) for b in (factor * still(10)).reshape(-1, 50, 3)]
        assert any(state.done for state in states) == ends


def test_a_gap_is_no_motion_and_in_a_file_it_is_as_long_as_in_a_stream(tmp_path):
    samples, time_s = still(20), np.arange(2000) / RATE
    cases = {"gap": np.where(time_s >= 10, time_s + 30, time_s), "clock": time_s % 10}
    for code, stamps in cases.items():
        np.savetxt(
            tmp_path / "still.csv",
            np.c_[stamps, samples],
            delimiter=",",
            header="time (s),gyro_x (deg/s),gyro_y (deg/s),gyro_z (deg/s)",
            comments="",
        )
        from_file = Calibrator(KIND, RATE)
        _feed(from_file, read_log(tmp_path / "still.csv", ReaderOptions()), np.inf)
        for state in (from_file.finish(), finished(samples, time_s=stamps)):
            assert (state.rest, state.seconds_at_rest) == ("still", 20)
            told = {r.code: r.value for r in state.reasons}
            assert told.get(code) == {"gap": pytest.approx(30), "clock": 1}[code]


def test_an_attempt_in_motion_is_stored_as_it_is_reported():
    past = [replace(c, mean_dps=tuple(c.mean + 0.05)) for c in history()]
    moving = still(40) + 20 * np.sin(np.arange(4000) / 30)[:, None]
    calibrator = fed(np.r_[still(10), moving], history=past, now=DECLARED)
    state, stored = calibrator.finish(), calibrator.calibration()
    assert calibrator.best.outcome == ("dropped",) * 3
    assert (stored.rest, stored.outcome) == (state.rest, state.history) == ("moving", ("used",) * 3)


def test_data_that_cannot_be_used_and_a_clock_that_jumps_are_told():
    for dead in (np.zeros((1000, 3)), np.full((1000, 3), np.nan)):
        assert "dead" in codes(finished(dead))
    assert "unit" in codes(finished(still(10) * np.degrees(1)))
    time_s = np.arange(2000) / RATE
    time_s[700:] -= 1e6
    time_s[1400:] += 1e9
    state = finished(still(20), time_s=time_s)
    assert "clock" in codes(state)
    assert state.seconds_at_rest >= 18


def test_arguments_that_do_not_fit_are_refused():
    samples = still(1)
    for bad in ({"time_s": 0.0}, {"accel_g": UP[:9]}, {"accel_g": samples.T}):
        with pytest.raises(InputError, match="expected as many samples of each"):
            Calibrator(KIND, RATE).update(**{"time_s": None, "gyro_dps": samples, **bad})
    for now in (Circumstances(latitude_deg=np.nan), Circumstances(since_power_on_s=-5.0)):
        with pytest.raises(InputError, match="(latitude|since_power_on): expected"):
            Calibrator(KIND, RATE, now=now)


def test_a_temperature_that_is_infinite_is_not_measured():
    state = finished(still(2), warmth=np.r_[np.inf, np.full(199, 25.0)])
    assert state.stretch.temperature[:4] == (3, 25.0, 25.0, 25.0)


def test_seconds_left_are_those_at_the_last_temperature():
    kind = type_of({"noise_mdps_rts": 3, "temperature_spread_mdps_per_c": 10}, "here")
    samples = still(100)
    warmth = np.r_[np.linspace(25, 26, 20), np.full(180, 26.0)].repeat(50)
    calibrator = fed(samples[:1000], kind, warmth=warmth[:1000], target_dps=2e-3)
    expected = round(float(calibrator.state().seconds_left.max()) * RATE)
    assert expected > 1000
    calibrator.update(None, samples[1000 : 900 + expected], None, warmth[1000 : 900 + expected])
    assert not calibrator.state().reached
    end = np.s_[900 + expected : 1000 + expected]
    assert calibrator.update(None, samples[end], None, warmth[end]).reached


def test_a_thermometer_of_whole_degrees_does_not_move_the_bias():
    slope = {"temperature_slope_mdps_per_c": 20, "temperature_spread_mdps_per_c": 10}
    kind = type_of({"noise_mdps_rts": [3, 4, 5], **slope}, "here")
    samples = still(40)
    warmth = np.random.default_rng(3).integers(25, 27, 80).repeat(50)
    noise = np.array([3, 4, 5]) * 1e-3 / np.sqrt(40)
    for end in range(3000, 4001, 50):
        state = finished(samples[:end], kind=kind, warmth=warmth[:end])
        error = state.bias_dps - samples[:end].mean(axis=0)
        assert np.all(np.abs(error) < 6e-3)  # half a degree is 10 mdps
        assert np.all(np.abs(error) < state.sigma_dps)
        assert np.all(state.sigma_dps > noise)


def test_a_temperature_that_moves_makes_the_bias_now_less_certain():
    spread = type_of({"noise_mdps_rts": [3, 4, 5], "temperature_spread_mdps_per_c": 10}, "here")
    samples, warmth = still(20), np.linspace(20, 24, 2000)
    plain, warm = (fed(samples, kind, warmth=warmth) for kind in (KIND, spread))
    evidence, plain, warm = warm.calibration(), plain.finish(), warm.finish()
    added = warm.sigma_dps**2 - plain.sigma_dps**2
    np.testing.assert_allclose(np.sqrt(added), 10e-3 * 2, rtol=0.03)  # 2 degrees from the mean
    np.testing.assert_allclose(evidence.variance, plain.sigma_dps**2)
    assert "temperature" in codes(warm)
