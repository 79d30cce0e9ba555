import numpy as np
import pytest
from scipy import stats

from gyro_pipeline.physics.noise import simulate_noise, warm_up
from gyro_pipeline.physics.stationarity import (
    Blocks,
    Means,
    bursts,
    changes,
    drifts,
    excursions,
    settling,
)

FALSE_ALARM = 1e-6
LAGS = (1, 8)


def at_rest(blocks):
    """Means of blocks that are calm all."""
    return Means.of(blocks, np.ones(blocks.starts.size, bool))


def white(shape, seed=0):
    return np.random.default_rng(seed).normal(0, 1, shape)


def test_the_last_block_ends_with_the_recording():
    rates = np.arange(22.0).reshape(2, 11)
    blocks = Blocks.of(rates, 4)
    assert blocks.starts.tolist() == [0, 4, 7]
    np.testing.assert_array_equal(blocks.rates[1, 2], [18, 19, 20, 21])
    np.testing.assert_array_equal(blocks.means, [[1.5, 5.5, 8.5], [12.5, 16.5, 19.5]])
    assert Blocks.of(rates[:, :8], 4).starts.tolist() == [0, 4]


@pytest.mark.parametrize("size", [7, 75])
def test_the_noise_is_that_of_a_sample_though_a_third_of_the_blocks_is_wild(size):
    rates = white((3, 30_000))
    rates[:, :10_000] *= 100
    # a third wild: the median is the quantile 3/4 of the others'
    at_rest = Blocks.of(rates[:, 10_000:], size).noise
    np.testing.assert_allclose(at_rest, 1, rtol=0.03)
    shift = np.sqrt(stats.chi2.ppf(0.75, size - 1) / stats.chi2.ppf(0.5, size - 1))
    np.testing.assert_allclose(Blocks.of(rates, size).noise, shift, rtol=0.05)


def test_excursions_are_single_rows_wherever_they_are():
    rates = white((3, 1010))
    rates[1, [0, 333, 1009]] += [9, -9, 9]
    assert excursions(Blocks.of(rates, 50), FALSE_ALARM).tolist() == [0, 333, 1009]


def test_white_noise_has_excursions_as_often_as_asked():
    found = [excursions(Blocks.of(white((3, 2000), seed), 100), 0.1).size for seed in range(300)]
    # the median of a block is 0.125 sigma off, which adds 20 % at this level
    assert 20 <= np.count_nonzero(found) <= 60


def test_bursts_worked_by_hand():
    assert bursts(np.array([3, 5, 15, 26, 27]), 10).tolist() == [[3, 15], [26, 27]]
    assert bursts(np.array([], int), 10).shape == (0, 2)


def test_blocks_apart_from_a_burst_have_a_block_between():
    blocks = Blocks.of(np.zeros((3, 80)), 10)
    apart = blocks.apart_from(np.array([[35, 38]]))
    assert blocks.starts[apart].tolist() == [0, 10, 50, 60, 70]


def test_the_noise_of_means_is_that_of_white_noise_or_more():
    blocks = Blocks.of(white((3, 20_000)), 50)
    expected = blocks.noise / np.sqrt(50)
    np.testing.assert_allclose(at_rest(blocks).noise, expected, rtol=0.15)
    held = Blocks.of(np.repeat(white((3, 20_000)), 2, axis=1), 50)  # 25 values to a mean
    ratio = at_rest(held).noise / (held.noise / np.sqrt(50))
    np.testing.assert_allclose(ratio, np.sqrt(2), rtol=0.15)


def test_white_noise_has_changes_no_more_often_than_asked():
    generator = np.random.default_rng(1)
    found = 0
    for _ in range(300):
        blocks = Blocks.of(generator.normal(0, 1, (3, 6000)), 50)
        found += changes(at_rest(blocks), LAGS, 0.1).any()
    # 30 of 300 expected; the tests overlap, and the noise is estimated
    assert 3 <= found <= 45


@pytest.mark.parametrize("lags", [(1,), (8,)])
def test_a_step_is_a_change_and_found_where_it_is(lags):
    rates = white((3, 5000))
    rates[2, 3000:] += 3  # 21 standard deviations of a mean
    blocks = Blocks.of(rates, 50)
    found = np.flatnonzero(changes(at_rest(blocks), lags, FALSE_ALARM))
    assert found.size
    assert np.all(np.abs(found - 60) <= 1.5 * lags[0])


def test_a_slow_onset_is_a_change_to_the_long_lag_only():
    rates = white((3, 10_000))
    rates[0] += np.clip((np.arange(10_000) - 4000) / 1000, 0, 1) * 9
    blocks = Blocks.of(rates, 50)
    assert not changes(at_rest(blocks), (1,), FALSE_ALARM).any()
    assert changes(at_rest(blocks), (8,), FALSE_ALARM).any()


def test_a_drift_is_no_change_however_far_it_goes():
    rates = white((3, 10_000)) + np.linspace(0, 10, 10_000)  # 70 standard deviations of a mean
    blocks = Blocks.of(rates, 50)
    assert not changes(at_rest(blocks), LAGS, FALSE_ALARM).any()


def test_a_change_at_blocks_that_are_not_calm_is_not_looked_at():
    rates = white((3, 5000))
    rates[2, 3000:3050] += 3
    blocks = Blocks.of(rates, 50)
    some = np.ones(blocks.starts.size, bool)
    assert changes(Means.of(blocks, some), LAGS, FALSE_ALARM).any()
    some[60] = False
    assert not changes(Means.of(blocks, some), LAGS, FALSE_ALARM).any()


def test_a_warm_up_is_measured():
    rate_hz, n = 150.0, 13_000
    rates = simulate_noise(np.random.default_rng(2), (3, n), rate_hz, 0.0033).astype(float)
    rates[1] += warm_up(0.02, 30, n, rate_hz)
    (one,) = drifts(at_rest(Blocks.of(rates, 75)), n / rate_hz, FALSE_ALARM, 0.01)
    assert one.axis == 1
    assert one.size_dps == pytest.approx(-0.02 * (1 - np.exp(-n / rate_hz / 30)), abs=0.003)
    assert one.time_constant_s == pytest.approx(30, rel=0.5)


def test_a_drift_below_the_least_one_is_left_out():
    rates = white((3, 10_000)) + np.linspace(0, 1, 10_000)
    means = at_rest(Blocks.of(rates, 50))
    assert len(drifts(means, 100, FALSE_ALARM, 0.5)) == 3
    assert drifts(means, 100, FALSE_ALARM, 1.5) == []


@pytest.mark.parametrize("sign", [-1, 1])
def test_a_warm_up_settles_whatever_its_time_constants_and_a_step_does_not(sign):
    seconds = np.arange(13_000) / 100
    warm = sign * (0.2 * np.exp(-seconds / 3) + 0.3 * np.exp(-seconds / 40))
    rates = 0.05 * white((3, 13_000)) + warm
    means = at_rest(Blocks.of(rates, 50))
    settled = means.without(settling(means))
    assert changes(means, LAGS, FALSE_ALARM).any()
    assert not changes(settled, LAGS, FALSE_ALARM).any()
    np.testing.assert_allclose(settled.rates.std(axis=1), 0.05 / np.sqrt(50), rtol=0.15)
    rates[1, 5000:] -= sign * 0.2
    means = at_rest(Blocks.of(rates, 50))
    assert changes(means.without(settling(means)), LAGS, FALSE_ALARM).any()
