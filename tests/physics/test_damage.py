import numpy as np
import pytest

from gyro_pipeline.physics.damage import (
    dropouts,
    longest_stretch,
    quantisation_steps,
    rows_between_zeros,
    saturated,
    stuck,
)

FALSE_ALARM = 1e-6


@pytest.fixture
def noise():
    """Three axes at rest, sigma 1, about biases of 20, -3 and 0."""
    return np.random.default_rng(5).normal([[20], [-3], [0]], 1, (3, 4000))


def test_zero_rows_are_cut_at_the_ends_only_and_only_if_all_axes_are_zero():
    rates = np.array([[0, 0, 1, 0, 2, 0], [0, 3, 1, 0, 0, 0]], float)
    assert rows_between_zeros(rates) == (1, 5)
    assert rows_between_zeros(np.zeros((3, 4))) == (4, 4)


@pytest.mark.parametrize(
    ("unusable", "gaps", "expected"),
    [
        ([], [], (0, 10)),
        ([0, 6], [], (1, 6)),
        ([2], [7], (3, 7)),
        ([4], [4, 5], (5, 10)),  # at and behind a gap
        ([9], [], (0, 9)),
        ([5], [], (0, 5)),
        (range(10), [], (0, 0)),
    ],
)
def test_longest_stretches_worked_by_hand(unusable, gaps, expected):
    usable = np.ones(10, bool)
    usable[list(unusable)] = False
    start, stop = longest_stretch(usable, np.array(gaps, np.intp))
    assert (start, stop) == expected


def test_a_halved_row_beside_a_non_finite_one_is_a_dropout_and_a_sound_one_is_none(noise):
    noise[:, 50] /= 2
    noise[:, 51] = np.nan
    assert np.flatnonzero(dropouts(noise, FALSE_ALARM)).tolist() == [50]


def test_a_row_of_zeros_is_a_dropout_where_the_bias_is_beyond_the_noise(noise):
    noise[:, 70] = 0
    assert np.flatnonzero(dropouts(noise, FALSE_ALARM)).tolist() == [70]
    near_zero = noise[1:]
    assert not dropouts(near_zero, FALSE_ALARM).any()


def test_a_held_value_is_stuck_and_one_packet_sent_twice_is_not(noise):
    noise[1, 200:230] = noise[1, 200]
    noise[2, 300:302] = noise[2, 300]
    found = stuck(noise, 10, FALSE_ALARM)
    assert np.argwhere(found).tolist() == [[1, row] for row in range(200, 230)]


def test_a_coarse_step_allows_longer_runs_but_not_a_held_value():
    rates = np.round(np.random.default_rng(6).normal(0.02, 0.4, (1, 13_000)))
    same = rates[0, 1:] == rates[0, :-1]
    assert same.mean() > 0.6  # most values repeat
    assert not stuck(rates, 10, FALSE_ALARM).any()
    rates[0, 5000:5200] = 0
    assert np.count_nonzero(stuck(rates, 10, FALSE_ALARM)) >= 200


@pytest.mark.parametrize("held", [1, 0.999, 0.5])
def test_however_much_is_held_it_is_stuck(held):
    rates = np.random.default_rng(7).normal(0, 1, (1, 13_000))
    count = round(held * 13_000)
    rates[0, :count] = 0.25
    assert np.flatnonzero(stuck(rates, 10, FALSE_ALARM)[0]).tolist() == list(range(count))


@pytest.mark.parametrize("sign", [1, -1])
def test_a_cut_off_tail_is_saturation(noise, sign):
    noise[0] = sign * np.minimum(sign * noise[0], sign * 20 + 2)
    found = saturated(noise)
    np.testing.assert_array_equal(found[0], noise[0] == 20 + 2 * sign)
    assert not found[1:].any()


def test_a_clipped_shock_is_saturation(noise):
    noise[2, 100:110] = 250.0
    assert np.argwhere(saturated(noise)).tolist() == [[2, row] for row in range(100, 110)]


@pytest.mark.parametrize("step", [0.05, 0.2, 0.5, 1, 2])
def test_the_tails_of_rounded_noise_are_not_saturation(noise, step):
    assert not saturated(step * np.round(noise / step)).any()


@pytest.mark.parametrize("step", [0.5, 1.0, 3.0])
def test_the_step_is_found_though_some_values_lie_off_its_grid(noise, step):
    rounded = step * np.round((noise + 0.3) / step)
    rounded[:, 1000:1003] += 0.1
    np.testing.assert_allclose(quantisation_steps(rounded), step, rtol=1e-12)


def test_noise_that_hardly_repeats_has_no_step_to_speak_of(noise):
    noise[1] = 0.1 * np.round(noise[1] / 0.1)
    np.testing.assert_array_equal(quantisation_steps(noise), 0)
