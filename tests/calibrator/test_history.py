"""The prior from past calibrations, and the types that it starts from."""

import json
from dataclasses import replace
from importlib.resources import files

import numpy as np
import pytest

from gyro_pipeline.calibrator.device_types import read_type, type_names, type_of, type_of_models
from gyro_pipeline.calibrator.history import (
    EARTH_DPS,
    Calibration,
    Circumstances,
    _days,
    level_members,
    noise_of,
    prior_of,
)
from gyro_pipeline.conventions import InputError
from gyro_pipeline.physics.allan import NoiseFigures
from gyro_pipeline.physics.recording_model import constant_bias

DECLARED = Circumstances(same_heading=True)
SURE = {"turn_on_factor": 1.0001, "walk_factor": 1.0001}  # tau and walk are known


def kind(**content):
    content = {"turn_on_mdps": 1.0, "walk_mdps_per_rtday": 0.0, **SURE, **content}
    return type_of({"noise_mdps_rts": 3, **content}, "here")


def past(*means, variance=1e-6, **more):
    return [Calibration((m * 1e-3,) * 3, (variance,) * 3, **more) for m in means]


WARM = kind(turn_on_mdps=0.01, temperature_spread_mdps_per_c=10.0)


def warmed(slope, degrees):
    """Calibrations at 20 degrees and some more, with a slope in mdps a degree."""
    made = [(past(slope * t, variance=1e-12)[0], 20.0 + t) for t in degrees]
    return [replace(calibration, temperature_c=(t,) * 3) for calibration, t in made]


def test_one_calibration_adds_tau_twice_and_many_are_weighted_by_their_variances():
    """tau 1 mdps; variances 0 and 3 mdps^2: weights 1 and 1/4 about an unknown level."""
    prior = prior_of(past(5.0), kind(), DECLARED)
    np.testing.assert_allclose(prior.mean, 5e-3)
    np.testing.assert_allclose(prior.narrow, 1e-6 * (1 + 1 + 1), rtol=1e-4)
    two = past(0.0, variance=1e-14) + past(5.0, variance=3e-6)
    prior = prior_of(two, kind(), DECLARED)
    np.testing.assert_allclose(prior.mean, 1e-3, rtol=1e-3)
    np.testing.assert_allclose(prior.narrow, 1e-6 * (1 + 1 / 1.25), rtol=1e-3)


def test_a_walk_follows_the_latest_and_grows_with_age_of_a_day_where_it_is_not_known():
    kinds = kind(turn_on_mdps=0.001, walk_mdps_per_rtday=1.0)
    made = past(0, time=0.0) + past(3, time=86400.0) + past(9, time=2 * 86400.0)
    made = [replace(calibration, variance_dps2=(1e-14,) * 3) for calibration in made]
    for age in (1.0, 10.0):
        now = Circumstances(time=(2.0 + age) * 86400, same_heading=True)
        prior = prior_of(made, kinds, now)
        np.testing.assert_allclose(prior.mean, 9e-3, rtol=1e-3)
        np.testing.assert_allclose(prior.narrow, age * 1e-6, rtol=1e-2)
    prior = prior_of(past(0.0, variance=1e-14), kinds, DECLARED)
    np.testing.assert_allclose(prior.narrow, 1e-6, rtol=1e-2)


@pytest.mark.parametrize(
    ("days", "now", "filled"),
    [
        ((None, None), None, [0, 1, 2]),
        ((0, None), 400, [0, 1, 400]),
        ((0, None, 0.5), None, [0, 0.5, 0.5, 1.5]),
        ((None, None, 10, None, None), 30, [8, 9, 10, 11, 12, 30]),
        ((10, 0, None, 0.5), None, [10, 0, 0.5, 0.5, 11]),
    ],
)
def test_a_time_that_is_not_known_lies_between_those_that_are(days, now, filled):
    seconds = [None if day is None else day * 86400.0 for day in (*days, now)]
    made = [past(0.0, variance=1e-14, time=time)[0] for time in seconds[:-1]]
    found = _days(made, Circumstances(time=seconds[-1]))
    np.testing.assert_allclose(found - found[1], np.array(filled) - filled[1])


def test_the_order_in_which_calibrations_were_stored_does_not_change_their_ages():
    kinds = kind(turn_on_mdps=0.001, walk_mdps_per_rtday=1.0)
    made = [past(t, variance=1e-14, time=t * 86400.0)[0] for t in (0, 3, 9)]
    now = replace(DECLARED, time=13 * 86400.0)
    for order in (made, made[::-1]):
        prior = prior_of(order, kinds, now)
        np.testing.assert_allclose(prior.mean, 9e-3, rtol=0.01)
        np.testing.assert_allclose(prior.narrow, 4e-6, rtol=0.01)


def test_the_fitted_tau_lies_between_the_types_and_the_scatter():
    made = past(*np.random.default_rng(1).normal(0, 4, 30), variance=1e-8)
    tau, sigma = prior_of(made, kind(turn_on_factor=3.0), DECLARED).fitted[0]["tau"]
    assert 3e-3 < tau < 4.5e-3
    assert sigma < 1e-3
    assert prior_of(made, kind(), DECLARED).fitted[0]["tau"][0] == pytest.approx(1e-3, rel=1e-2)


def test_temperature_follows_a_slope_and_widens_beyond_the_range():
    made = warmed(2.0, range(5))
    inside, beyond = (prior_of(made, WARM, replace(DECLARED, temperature_c=t)) for t in (23.5, 27))
    np.testing.assert_allclose(inside.mean, 7e-3, atol=1e-4)
    np.testing.assert_allclose(beyond.mean, 14e-3, atol=2e-4)
    assert np.all(inside.narrow < 1e-8)
    np.testing.assert_allclose(np.sqrt(beyond.narrow), 30e-3, rtol=1e-2)  # 10 mdps/C, 3 C
    assert {reason.code for reason in beyond.reasons} == {"temperature"}
    unknown = prior_of(warmed(20.0, range(0, 9, 2)), WARM, DECLARED)  # the slope costs as well
    np.testing.assert_allclose(np.sqrt(unknown.narrow), 8e-3 * np.hypot(10, 20), rtol=1e-2)


@pytest.mark.parametrize("celsius", [None, 65.0])
def test_a_type_that_leaves_the_temperature_out_says_so(celsius):
    made, now = warmed(0.0, range(5)), replace(DECLARED, temperature_c=celsius)
    prior = prior_of(made, kind(turn_on_mdps=0.01), now)
    assert ["σ leaves this out" in reason.sentence for reason in prior.reasons] == [True]
    assert "σ leaves this out" not in prior_of(made, WARM, now).reasons[0].sentence
    assert not prior_of(made, kind(), replace(DECLARED, temperature_c=22.0)).reasons


@pytest.mark.parametrize(("celsius", "degrees"), [(20.0, 0), (23.0, 3), (None, 5)])
def test_at_one_past_temperature_the_slope_is_that_of_the_type_and_counts_once(celsius, degrees):
    made = past(0.0, 0.0, variance=1e-12, temperature_c=(20.0,) * 3)
    made += past(9.0, variance=1e-12)  # at an unknown temperature, so that it counts little
    prior = prior_of(made, WARM, replace(DECLARED, temperature_c=celsius))
    np.testing.assert_allclose(prior.mean, 0, atol=1e-6)
    np.testing.assert_allclose(np.sqrt(prior.narrow), 10e-3 * degrees, rtol=1e-3, atol=1e-4)


def test_a_knock_costs_the_spread_of_a_wrong_history_until_the_next_calibration():
    kinds, now = kind(turn_on_mdps=0.01), replace(DECLARED, knocks=1)
    before = past(0.0, 0.0, variance=1e-12)
    prior = prior_of(before, kinds, now)
    np.testing.assert_allclose(np.sqrt(prior.narrow), 5e-3, rtol=1e-3)
    assert {reason.code for reason in prior.reasons} == {"knocked"}
    prior = prior_of(before + past(7.0, variance=1e-12, knocks=1), kinds, now)
    np.testing.assert_allclose(prior.mean, 7e-3, rtol=1e-3)
    assert (np.all(prior.narrow < 1e-9), prior.reasons) == (True, ())


@pytest.mark.parametrize(
    ("up", "axes"),
    [(None, (1, 1, 1)), ((0, 0, 1), (1, 1, 0)), ((0.6, 0, 0.8), (0.64, 1, 0.36))],
)
def test_the_earths_rate_of_an_unknown_heading_is_on_horizontal_axes(up, axes):
    direction = None if up is None else np.array(up, float)
    made = past(0.0, gravity=up)
    now = Circumstances(up=direction, latitude_deg=32.0)
    added = prior_of(made, kind(), now).narrow - prior_of(made, kind(), DECLARED).narrow
    expected = np.array(axes) * (EARTH_DPS * np.cos(np.radians(32.0))) ** 2
    np.testing.assert_allclose(added, expected, rtol=1e-6, atol=1e-15)


def test_a_device_on_its_side_is_corrected_for_the_earths_vertical_rate():
    up, side = np.array([0.0, 0, 1]), np.array([1.0, 0, 0])
    now = Circumstances(up=side, latitude_deg=90.0, same_heading=True)
    prior = prior_of(past(0.0, gravity=up), kind(), now)
    np.testing.assert_allclose(prior.mean, [EARTH_DPS, 0, -EARTH_DPS], atol=1e-12)
    assert {reason.code for reason in prior.reasons} == {"attitude"}


def test_where_attitudes_differ_the_larger_of_tau_and_the_earth_counts():
    tilted = tuple(np.array([0.0, 0.2, 0.98]) / np.hypot(0.2, 0.98))
    made = past(0, variance=1e-12, gravity=(0.0, 0.0, 1.0))
    made += past(1, variance=1e-12, gravity=tilted)
    now = Circumstances(up=np.array([0.0, 0, 1]))
    prior = prior_of(made, kind(turn_on_mdps=10.0), now)
    np.testing.assert_allclose(prior.narrow, 1e-4 * 1.5, rtol=0.02)


@pytest.mark.parametrize(
    ("dropped", "means", "members"),
    [
        ("..x.", (0, 0, 50, 0), [0, 1, 3]),
        ("..xx", (0, 0, 50, 51), [2, 3]),
        ("..xx", (0, 0, 50, -50), [0, 1]),
    ],
)
def test_two_at_a_new_level_restart_the_level(dropped, means, members):
    outcomes = [("dropped" if mark == "x" else "used",) * 3 for mark in dropped]
    pairs = zip(past(*means), outcomes, strict=True)
    made = [replace(calibration, outcome=outcome) for calibration, outcome in pairs]
    assert level_members(made, 0, 1e-3) == members


def test_noise_is_learned_from_past_logs_with_the_types():
    """Freedom 8 of the type (spread 0.25) and 92 of logs with 1.5 times its N."""
    spread = kind(noise_spread=0.25)
    made = past(0.0, noise_mdps_rts=(4.5,) * 3, noise_freedom=92.0)
    scale, freedom = noise_of(made, spread)
    np.testing.assert_allclose(freedom, 100)
    np.testing.assert_allclose(scale, (8 + 92 * 2.25) / 100)
    assert np.isinf(noise_of(made, kind())[1]).all()


# types


def models(devices, seconds=120, flicker=0.0):
    rng = np.random.default_rng(1)
    whites = 3e-3 * (1 + 0.1 * rng.standard_normal(devices))
    return [
        [constant_bias(seconds * 100, 100.0, NoiseFigures(w, flicker, 0.0), 0.0, 1e-3)] * 3
        for w in whites
    ]


def test_a_type_is_made_from_fits_and_read_again(tmp_path):
    content = type_of_models("bench", models(30), "30 devices of 120 s")
    (tmp_path / "types").mkdir()
    (tmp_path / "types/bench.json").write_text(json.dumps(content))
    kind = read_type("bench", tmp_path)
    np.testing.assert_allclose(kind.noise.white, 3e-3, rtol=0.03)
    np.testing.assert_allclose(kind.dps("turn_on_mdps"), 1e-3, rtol=1e-3)
    assert 25 < kind.noise_freedom < 100  # a spread of a tenth is worth 50
    assert type_names(tmp_path) == ["bench", "consumer", "dot", "memsense"]


def test_flicker_that_short_recordings_show_as_turn_on_spread_is_counted_once():
    """Recordings of 60 s leave flicker from 120 to 240 s in tau: B^2 ln(2) / pi."""
    content = type_of_models("bench", models(5, seconds=60, flicker=1e-3), "")
    expected = np.sqrt(1 - np.log(2) / np.pi)
    np.testing.assert_allclose(content["turn_on_mdps"], expected, rtol=1e-3)


def test_every_shipped_type_is_read_and_each_number_has_a_source(tmp_path):
    with pytest.raises(InputError, match="expected consumer, dot, memsense, got 'dott'"):
        read_type("dott")
    with pytest.raises(InputError, match=r"here: noise: unexpected keyword argument, got 3; corr"):
        type_of({"noise": 3}, "here")
    for key in ("noise_mdps_rts", "turn_on_factor"):
        with pytest.raises(InputError, match=f"here: {key}: expected more than 0, got 0"):
            type_of({key: 0}, "here")
    (tmp_path / "types").mkdir()
    for text in (b"[1]", b"\xff"):
        (tmp_path / "types/bad.json").write_bytes(text)
        with pytest.raises(InputError, match=r"bad\.json: .*; correct it"):
            read_type("bad", tmp_path)
    for path in (files("gyro_pipeline.calibrator") / "types").iterdir():
        content = json.loads(path.read_text())
        assert read_type(content["type"]).noise_freedom > 0
        numbers = {key for key in content if "_mdps" in key and key != "conflict_mdps"}
        assert numbers <= set(content["sources"]), path.name
