"""Simulated noise: its spread, correlation, flicker and walk are those that were asked for."""

import numpy as np
import pytest

from gyro_pipeline.conventions import MDPS, InputError
from gyro_pipeline.physics.allan import FLICKER_FLOOR, allan_variance, averaging_times_s
from gyro_pipeline.physics.noise import simulate_noise, warm_up

RATE = 100.0
N = 5 * MDPS


def lag_correlation(noise, lag):
    return np.mean(noise[..., lag:] * noise[..., :-lag]) / np.mean(noise**2)


@pytest.mark.parametrize("lag1", [0.0, -0.15, 0.3])
def test_means_scatter_by_n_over_root_t_and_samples_are_correlated_over_one_period(lag1):
    noise = simulate_noise(np.random.default_rng(1), (100, 20_000), RATE, N, lag1)
    noise, seconds = noise.astype(np.float64), 5.0
    means = noise.reshape(-1, int(seconds * RATE)).mean(axis=1)
    assert means.size == 4000
    assert means.std() * np.sqrt(seconds) == pytest.approx(N, rel=0.04)
    assert means.mean() == pytest.approx(0, abs=4 * N / np.sqrt(means.size * seconds))
    assert lag_correlation(noise, 1) == pytest.approx(lag1, abs=0.005)
    assert lag_correlation(noise, 2) == pytest.approx(0, abs=0.005)
    assert noise.std() == pytest.approx(N * np.sqrt(RATE / (1 + 2 * lag1)), rel=0.005)


def test_every_axis_has_its_own_n_and_the_first_sample_is_like_all_others():
    first = simulate_noise(np.random.default_rng(3), (20_000, 2), RATE, N, -0.4)
    assert first[:, 0].std() == pytest.approx(first[:, 1].std(), rel=0.03)
    with pytest.raises(InputError, match="lag1_correlation"):
        simulate_noise(np.random.default_rng(5), (10,), RATE, N, 0.5)
    per_axis = np.array([1.0, 2.0, 0.0]) * MDPS
    noise = simulate_noise(np.random.default_rng(4), (2, 5, 3, 5000), RATE, per_axis)
    assert noise.dtype == np.float32
    sigma = noise.std(axis=-1, dtype=np.float64)
    expected = np.broadcast_to(per_axis * np.sqrt(RATE), (2, 5, 3))
    np.testing.assert_allclose(sigma, expected, rtol=0.05)


@pytest.mark.parametrize("rate", [50.0, 250.0])
def test_the_flicker_floor_is_flat_at_0664_b(rate):
    b = 3 * MDPS
    noise = simulate_noise(np.random.default_rng(6), (150, 6000), rate, 0.0, flicker_dps=b)
    times = averaging_times_s(6000, rate)
    times = times[times >= 8 / rate]
    variance = np.mean([allan_variance(samples, rate, times)[0] for samples in noise], axis=0)
    floor = np.sqrt(FLICKER_FLOOR) * b
    np.testing.assert_allclose(np.sqrt(variance), floor, rtol=0.1)
    assert np.sqrt(variance[:6]).mean() == pytest.approx(floor, rel=0.02)
    blocks = noise.reshape(150, 40, 150).mean(axis=-1)  # none ends where it began
    assert np.std(blocks[:, -1] - blocks[:, 0]) > 1.4 * np.std(blocks[:, 1] - blocks[:, 0])


@pytest.mark.parametrize("flicker", [0.0, 3 * MDPS])
def test_recordings_are_independent_and_reproducible(flicker):
    def draw(seed):
        generator = np.random.default_rng(seed)
        return simulate_noise(generator, (400, 500), RATE, N, -0.15, flicker)

    noise = draw(9)
    np.testing.assert_array_equal(noise, draw(9))
    assert not np.any(noise == draw(10))
    means = noise.mean(axis=1)
    assert abs(np.corrcoef(means[1:], means[:-1])[0, 1]) < 0.2


def test_a_random_walk_starts_at_power_on_and_widens_as_k_root_t():
    k, count = 2 * MDPS, 2000
    generator = np.random.default_rng(12)
    walk = simulate_noise(generator, (count, 1000), RATE, 0.0, random_walk_dps_rts=k)
    for sample in (0, 99, 999):
        expected = k * np.sqrt((sample + 1) / RATE)
        assert walk[:, sample].std() == pytest.approx(expected, rel=0.05)
    steps = np.diff(walk.astype(np.float64), axis=1)
    assert steps.std() == pytest.approx(k / np.sqrt(RATE), rel=0.01)


def test_a_warm_up_decays_from_its_amplitude():
    amplitudes = np.array([[10.0, -5.0]])
    settling = warm_up(amplitudes, 30.0, 9000, RATE)
    assert settling.shape == (1, 2, 9000)
    time_s = (np.arange(9000) + 0.5) / RATE
    np.testing.assert_allclose(settling[0, 1], -5 * np.exp(-time_s / 30))
    each = warm_up(amplitudes, np.array([[15.0, 60.0]]), 9000, RATE)
    np.testing.assert_allclose(each[0, 1], warm_up(-5.0, 60.0, 9000, RATE))
