"""The filter against exact best linear estimates from the same blocks."""

import numpy as np
import pytest

from gyro_pipeline.calibrator.filter import FLICKER_S, Filter, Noise
from gyro_pipeline.physics.recording_model import noise_covariances, profiles

RATE, BLOCK = 100, 50
BLOCK_S = BLOCK / RATE
WORLDS = {  # N, B, K in mdps and s; warm-up's mean, spread, time constant
    "white": (3.3, 0, 0, None),
    "flicker": (3.3, 3, 0, None),
    "walk": (3.3, 0, 1.0, None),
    "warm-up": (3.3, 0, 0, (5.0, 2.0, 20.0)),
    "all": (3.3, 3, 0.5, (5.0, 2.0, 20.0)),
}


def noise_of(white, flicker, walk, warm_up):
    triples = [np.full(3, value * 1e-3) for value in (white, flicker, walk)]
    if warm_up:
        mean, spread, time_constant_s = warm_up
        warm_up = np.full(3, mean * 1e-3), np.full(3, spread * 1e-3), time_constant_s
    return Noise(*triples, warm_up)


def exact(world, seconds):
    """Covariance of block means, of them with the walk now, and the design, (deg/s)^2."""
    white, flicker, walk, warm_up = WORLDS[world]
    edges = np.arange(0, round(seconds * RATE) + 1, BLOCK)
    unit = noise_covariances(edges, round(FLICKER_S * RATE), RATE)
    covariance = np.tensordot(np.square([white, flicker, walk]), unit, axes=1) * 1e-6
    now = (walk * 1e-3) ** 2 * (edges[:-1] + edges[1:] + 1) / 2 / RATE
    columns = 2 if warm_up else 1
    design = profiles(edges, RATE, warm_up[2] if warm_up else np.inf)[:, :columns]
    return covariance, now, design


def run(world, means, age_s=0.0):
    """Estimates of the bias now, from (n, blocks), three at a time; and its variance."""
    noise, biases = noise_of(*WORLDS[world]), []
    for three in means.reshape(-1, 3, means.shape[-1]):
        filter_ = Filter.start(noise, BLOCK_S, age_s)
        for mean in three.T:
            filter_, _ = filter_.update(mean)
        biases.append(filter_.estimate().bias)
    return np.concatenate(biases), filter_.estimate()


def best(world, seconds):
    """Weights and variance of the exact best linear unbiased estimate, by the same prior."""
    covariance, now, design = exact(world, seconds)
    prior = 0.0
    if WORLDS[world][3]:
        prior = (WORLDS[world][3][1] * 1e-3) ** 2
        covariance = covariance + prior * np.outer(design[:, 1], design[:, 1])
    solved = np.linalg.solve(covariance, np.column_stack([design[:, 0], now]))
    level = solved[:, 0] / solved[:, 0].sum()
    weights = solved[:, 1] + (1 - solved[:, 1].sum()) * level
    walk_s = seconds * (WORLDS[world][2] * 1e-3) ** 2
    variance = weights @ covariance @ weights - 2 * weights @ now + walk_s
    return weights, variance, (covariance, now, walk_s)


@pytest.mark.parametrize("world", WORLDS)
@pytest.mark.parametrize("seconds", [1, 10, 30])
def test_the_filter_is_the_best_linear_estimate(world, seconds):
    """RMSE under the exact model at most 0.5 % above the least, sigma within 0.5 %."""
    blocks = round(seconds / BLOCK_S)
    _, variance, (covariance, now, walk_s) = best(world, seconds)
    units = np.vstack([np.eye(blocks), np.zeros((-blocks % 3, blocks))])
    constant, _ = run(world, np.zeros((3, blocks)))
    estimates, last = run(world, units)
    weights = estimates[:blocks] - constant[0]
    squares = weights @ covariance @ weights - 2 * weights @ now + walk_s
    assert np.sqrt(squares / variance) <= 1.005
    np.testing.assert_allclose(np.sqrt(last.variance / squares), 1, atol=5e-3)


def test_a_gap_lets_the_flicker_be_forgotten():
    noise, block = noise_of(*WORLDS["flicker"]), np.full(3, 1e-3)
    together = Filter.start(noise, BLOCK_S).update(block)[0]
    apart = together.skip(1000.0).update(block)[0]
    together = together.update(block)[0]
    one = Filter.start(noise, BLOCK_S).update(block)[0].estimate().variance
    np.testing.assert_allclose(apart.estimate().variance, one / 2, rtol=1e-6)
    assert np.all(together.estimate().variance > 1.2 * apart.estimate().variance)
