"""The prior from past calibrations."""

import numpy as np
import pytest

from gyro_pipeline.calibrator.device_types import type_of
from gyro_pipeline.calibrator.history import (
    EARTH_DPS,
    Calibration,
    Circumstances,
    level_members,
    noise_of,
    prior_of,
)

DECLARED = Circumstances(same_heading=True)
SURE = {"turn_on_factor": 1.0001, "walk_factor": 1.0001}  # tau and walk are known


def kind(**content):
    content = {"turn_on_mdps": 1.0, "walk_mdps_per_rtday": 0.0, **SURE, **content}
    return type_of({"noise_mdps_rts": 3, **content}, "here")


def past(*means, variance=1e-6, **more):
    return [Calibration((m * 1e-3,) * 3, (variance,) * 3, **more) for m in means]


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
    made = [
        past(level, variance=1e-14, time=day * 86400.0)[0] for day, level in enumerate((0, 3, 9))
    ]
    for age in (1.0, 10.0):
        now = Circumstances(time=(2.0 + age) * 86400, same_heading=True)
        prior = prior_of(made, kinds, now)
        np.testing.assert_allclose(prior.mean, 9e-3, rtol=1e-3)
        np.testing.assert_allclose(prior.narrow, age * 1e-6, rtol=1e-2)
    prior = prior_of(past(0.0, variance=1e-14), kinds, DECLARED)
    np.testing.assert_allclose(prior.narrow, 1e-6, rtol=1e-2)


def test_the_fitted_tau_lies_between_the_types_and_the_scatter():
    rng = np.random.default_rng(1)
    made = past(*rng.normal(0, 4, 30), variance=1e-8)
    open_minded = kind(turn_on_factor=3.0)
    tau, sigma = prior_of(made, open_minded, DECLARED).fitted[0]["tau"]
    assert 3e-3 < tau < 4.5e-3
    assert sigma < 1e-3
    assert prior_of(made, kind(), DECLARED).fitted[0]["tau"][0] == pytest.approx(1e-3, rel=1e-2)


def test_temperature_follows_a_slope_and_widens_beyond_the_range():
    kinds = kind(turn_on_mdps=0.01, temperature_spread_mdps_per_c=10.0)
    made = [
        past(2.0 * t, variance=1e-12, temperature_c=(20.0 + t,) * 3)[0] for t in (0, 1, 2, 3, 4)
    ]
    inside, beyond = (
        prior_of(made, kinds, Circumstances(temperature_c=t, same_heading=True)) for t in (23.5, 27)
    )
    np.testing.assert_allclose(inside.mean, 7e-3, atol=1e-4)
    np.testing.assert_allclose(beyond.mean, 14e-3, atol=2e-4)
    assert np.all(inside.narrow < 1e-8)
    np.testing.assert_allclose(np.sqrt(beyond.narrow), 30e-3, rtol=1e-2)  # 10 mdps/C, 3 C
    assert {reason.code for reason in beyond.reasons} == {"temperature"}


@pytest.mark.parametrize(("celsius", "degrees"), [(20.0, 0), (23.0, 3), (None, 5)])
def test_at_one_past_temperature_the_slope_is_that_of_the_type_and_counts_once(celsius, degrees):
    kinds = kind(turn_on_mdps=0.01, temperature_spread_mdps_per_c=10.0)
    made = past(0.0, 0.0, variance=1e-12, temperature_c=(20.0,) * 3)
    made += past(9.0, variance=1e-12)  # at an unknown temperature, so that it counts little
    prior = prior_of(made, kinds, Circumstances(temperature_c=celsius, same_heading=True))
    np.testing.assert_allclose(prior.mean, 0, atol=1e-6)
    np.testing.assert_allclose(np.sqrt(prior.narrow), 10e-3 * degrees, rtol=1e-3, atol=1e-4)


def test_an_unknown_temperature_costs_the_known_slope_as_well():
    kinds = kind(turn_on_mdps=0.01, temperature_spread_mdps_per_c=10.0)
    made = [
        past(20.0 * t, variance=1e-12, temperature_c=(20.0 + t,) * 3)[0] for t in range(0, 9, 2)
    ]
    prior = prior_of(made, kinds, DECLARED)
    np.testing.assert_allclose(np.sqrt(prior.narrow), 8e-3 * np.hypot(10, 20), rtol=1e-2)


def test_a_knock_costs_the_spread_of_a_wrong_history_until_the_next_calibration():
    kinds, now = kind(turn_on_mdps=0.01), Circumstances(same_heading=True, knocks=1)
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
    ups = [np.array([0.0, 0, 1]), np.array([0.0, 0.2, 0.98])]
    made = [
        past(m, variance=1e-12, gravity=tuple(u / np.linalg.norm(u)))[0]
        for m, u in zip((0, 1), ups, strict=True)
    ]
    large = kind(turn_on_mdps=10.0)
    prior = prior_of(made, large, Circumstances(up=ups[0]))
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
    made = [
        past(m, outcome=("dropped" if d == "x" else "used",) * 3)[0]
        for d, m in zip(dropped, means, strict=True)
    ]
    assert level_members(made, 0, 1e-3) == members


def test_noise_is_learned_from_past_logs_with_the_types():
    """Freedom 8 of the type (spread 0.25) and 92 of logs with 1.5 times its N."""
    spread = kind(noise_spread=0.25)
    made = past(0.0, noise_mdps_rts=(4.5,) * 3, noise_freedom=92.0)
    scale, freedom = noise_of(made, spread)
    np.testing.assert_allclose(freedom, 100)
    np.testing.assert_allclose(scale, (8 + 92 * 2.25) / 100)
    assert np.isinf(noise_of(made, kind())[1]).all()
