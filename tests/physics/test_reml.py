"""The model that is fitted to recordings is the one that they were drawn from."""

import numpy as np
import pytest
from scipy import stats

from gyro_pipeline.conventions import MDPS, InputError
from gyro_pipeline.physics.allan import NoiseFigures
from gyro_pipeline.physics.noise import simulate_noise, warm_up
from gyro_pipeline.physics.recording_model import block_edges, block_means, constant_bias
from gyro_pipeline.physics.reml import _Likelihood, fit_recording_model

RATE, SAMPLES = 20.0, 1600
N, B, K, TAU = 5 * MDPS, 5 * MDPS, 0.5 * MDPS, 2 * MDPS


def recorded(count, seed=0, flicker=0.0, walk=0.0, amplitudes=None, level=0.3):
    generator = np.random.default_rng(seed)
    noise = simulate_noise(generator, (count, SAMPLES), RATE, N, 0.0, flicker, walk)
    rates = noise + level + generator.normal(0, TAU, (count, 1))
    if amplitudes:
        rates += warm_up(generator.normal(*amplitudes, count), 15.0, SAMPLES, RATE)
    return rates


def test_white_noise_and_prior_are_found():
    model = fit_recording_model(recorded(80), RATE)
    assert model.noise.white == pytest.approx(N, rel=0.03)
    assert model.noise.instability < 0.15 * N
    assert model.mean[0] == pytest.approx(0.3, abs=3 * TAU / np.sqrt(80))
    assert np.sqrt(model.covariance[0, 0]) == pytest.approx(TAU, rel=0.25)


@pytest.mark.slow
def test_flicker_and_random_walk_are_told_apart():
    flicker = fit_recording_model(recorded(80, 1, flicker=B), RATE).noise
    assert flicker.instability == pytest.approx(B, rel=0.08)
    assert flicker.white == pytest.approx(N, rel=0.05)
    walk = fit_recording_model(recorded(80, 2, walk=K), RATE).noise
    assert walk.random_walk == pytest.approx(K, rel=0.15)
    assert walk.instability < B / 3


@pytest.mark.slow
def test_a_warm_up_is_found_where_its_end_is_seen():
    # whether there is one is decided by the data
    model = fit_recording_model(recorded(60, 3, B, 0.0, (20 * MDPS, 5 * MDPS)), RATE, None)
    assert model.mean[1] == pytest.approx(20 * MDPS, rel=0.15)
    assert np.sqrt(model.covariance[1, 1]) == pytest.approx(5 * MDPS, rel=0.3)
    assert model.time_constant_s == pytest.approx(15, rel=0.15)
    decay = np.exp(-np.arange(SAMPLES) / RATE / 300.0)
    recordings = recorded(20) + np.linspace(0.02, 0.04, 20)[:, None] * decay
    assert fit_recording_model(recordings, RATE, None).mean.size == 1


def test_the_likelihood_is_the_dense_one_of_all_contrasts():
    """REML is the likelihood of the data projected to where the fixed effect is not."""
    samples = 400
    edges = block_edges(samples, 10)
    table = block_means(recorded(4, 5)[:, :samples], edges)
    likelihood, means = _Likelihood(table, samples, RATE, False, None), table.ravel()
    contrasts = np.linalg.svd(np.ones((means.size, 1)))[0][:, 1:]

    def dense(figures, tau):
        model = constant_bias(samples, RATE, NoiseFigures(*figures), 0.0, tau)
        one = model.noise_covariance(edges) + tau**2
        covariance = contrasts.T @ np.kron(np.eye(4), one) @ contrasts
        return stats.multivariate_normal.logpdf(contrasts.T @ means, None, covariance)

    points = [((N, B, K), TAU), ((N / 2, B / 9, 2 * K), TAU / 3)]
    fast = [-likelihood.deviance(np.log([*f, tau]))[0] / 2 - np.log(tau) for f, tau in points]
    assert fast[1] - fast[0] == pytest.approx(dense(*points[1]) - dense(*points[0]), rel=1e-8)


def test_two_recordings_are_too_few():
    for count in (0, 2):
        with pytest.raises(InputError, match=f"at least 3 recordings of a gyroscope, got {count}"):
            fit_recording_model(recorded(3)[:count], RATE)
