"""Models of a recording: covariances, and the best linear estimate by them."""

import numpy as np
import pytest
from scipy.linalg import block_diag

from gyro_pipeline.conventions import DISJOINT, MDPS, PAPER, TRUE, InputError
from gyro_pipeline.physics import recording_model as models
from gyro_pipeline.physics.allan import NoiseFigures
from gyro_pipeline.physics.ceiling import ceiling_rmse, oracle, running_mean_rmse
from gyro_pipeline.physics.noise import simulate_noise

RATE, SAMPLES = 20.0, 1200
N, B, K, TAU = 5 * MDPS, 3 * MDPS, 0.3 * MDPS, 1 * MDPS
WHITE = models.constant_bias(SAMPLES, RATE, NoiseFigures(N, 0, 0), 0.02, TAU)
COLOURED = models.constant_bias(SAMPLES, RATE, NoiseFigures(N, B, K), 0.02, TAU)
PRIOR = np.array([0.02, 0.015]), np.diag([TAU**2, (5 * MDPS) ** 2])
WARMING = models.RecordingModel(SAMPLES, RATE, COLOURED.noise, *PRIOR, time_constant_s=20.0)
MODELS = {"white": WHITE, "coloured": COLOURED, "warming": WARMING}
TRUTHS = (PAPER, DISJOINT, TRUE)


@pytest.mark.parametrize("part", [0, 1, 2])
def test_covariances_are_those_of_the_simulated_noise(part):
    """Block by block, in units of what chance allows with so many recordings."""
    levels, edges = np.eye(3)[part], [0, 10, 35, 36, 400, 1200]
    names = dict(zip(("flicker_dps", "random_walk_dps_rts"), levels[1:], strict=True))
    count = 2000
    generator = np.random.default_rng(part)
    noise = simulate_noise(generator, (count, SAMPLES), RATE, levels[0], **names).astype(float)
    means = np.stack([noise[:, a:b].mean(axis=1) for a, b in zip(edges, edges[1:], strict=False)])
    expected = models.noise_covariances(np.array(edges), SAMPLES, RATE)[part]
    deviation = np.sqrt((np.outer(*2 * [np.diag(expected)]) + expected**2) / count)
    assert (np.abs(means @ means.T / count - expected) < 4.5 * deviation).all()


@pytest.mark.parametrize("truth", TRUTHS)
@pytest.mark.parametrize(("name", "start"), [("white", 0), ("coloured", 300), ("warming", 300)])
def test_weights_are_those_of_the_dense_solution_on_all_blocks(name, start, truth):
    """Everything outside the window in one block each changes nothing."""
    model, size = MODELS[name], 200
    line = models.best_linear(model, start, size, truth)
    edges = np.arange(0, SAMPLES + 1, 10)
    inside = (edges[:-1] >= start) & (edges[1:] <= start + size)
    profile, noise = model.profiles(edges), model.noise_covariance(edges)
    covariance = profile @ model.covariance @ profile.T + noise
    average = {PAPER: np.ones(len(inside)), DISJOINT: 1.0 * ~inside, TRUE: None}[truth]
    if truth == TRUE:
        shared, variance = (profile @ model.covariance)[:, 0], model.covariance[0, 0]
        mean = model.mean[0]
    else:
        average = average / average.sum()
        shared, variance = covariance @ average, average @ covariance @ average
        mean = average @ profile @ model.mean
    window = covariance[np.ix_(inside, inside)]
    weights = np.linalg.solve(window, shared[inside])
    np.testing.assert_array_equal(line.edges, np.arange(0, size + 1, 10))
    np.testing.assert_allclose(line.weights, weights, atol=1e-9)
    assert line.constant == pytest.approx(mean - weights @ (profile @ model.mean)[inside])
    assert line.variance == pytest.approx(variance - weights @ shared[inside])


@pytest.mark.parametrize("truth", TRUTHS)
def test_on_white_noise_it_is_the_oracle_of_the_closed_form(truth, start=700):
    size, recording_s = 200, SAMPLES / RATE
    best, mean = models.mean_squares(WHITE, start, size, truth)
    window_s = size / RATE
    assert np.sqrt(best) == pytest.approx(ceiling_rmse(N, TAU, window_s, recording_s, truth))
    assert np.sqrt(mean) == pytest.approx(running_mean_rmse(N, window_s, recording_s, truth))
    windows = np.random.default_rng(1).normal(0.02, N, (5, size))
    expected = oracle(windows.mean(axis=1), 0.02, TAU, N, window_s, recording_s, truth)
    np.testing.assert_allclose(models.best_linear(WHITE, start, size, truth)(windows), expected)
    assert WHITE.averaging_variance() == pytest.approx(N**2 / recording_s)


@pytest.mark.parametrize("truth", [PAPER, TRUE])
def test_jointly_over_axes_it_is_the_dense_solution_of_all_of_them(truth):
    """Biases correlated over axes, one of which warms up as well."""
    axes = [COLOURED, WARMING, WHITE]
    prior = TAU**2 * (0.8 + 0.2 * np.eye(3))
    edges = np.arange(0, SAMPLES + 1, 10)
    inside = np.tile((edges[:-1] >= 200) & (edges[1:] <= 400), 3)
    noise = block_diag(*[model.noise_covariance(edges) for model in axes])
    decay = np.zeros_like(noise)
    own = slice(120, 240)
    decay[own, own] = np.outer(*2 * [WARMING.profiles(edges)[:, 1]]) * WARMING.covariance[1, 1]
    joint = noise + decay + np.kron(prior, np.ones((120, 120)))
    aims = np.kron(np.eye(3), np.ones((1, 120)) / 120)
    shared, variance = aims @ joint, aims @ joint @ aims.T
    if truth == TRUE:
        shared, variance = np.kron(prior, np.ones((1, 120))), prior
    seen = np.linalg.solve(joint[np.ix_(inside, inside)], shared[:, inside].T)
    expected = np.trace(variance - shared[:, inside] @ seen) / 3
    priors = np.stack([prior, np.diag(np.diag(prior))])
    found = models.joint_squares(axes, 200, 200, truth, priors)
    assert found[0] == pytest.approx(expected, rel=1e-9)
    alone = [models.mean_squares(one, 200, 200, truth)[0] for one in axes]
    assert found[1] == pytest.approx(np.mean(alone))
    assert found[0] < found[1]


def test_windows_outside_the_recording_and_unknown_truths_are_refused():
    for start, size in ((-1, 10), (1150, 51), (0, 0)):
        with pytest.raises(InputError, match="inside a recording of 1200 samples"):
            models.best_linear(WHITE, start, size, PAPER)
    with pytest.raises(InputError, match="got 'mean'"):
        models.best_linear(WHITE, 0, 100, "mean")
    with pytest.raises(InputError, match="shorter than the recording"):
        models.best_linear(WHITE, 0, SAMPLES, DISJOINT)


def test_blocks_have_nearly_equal_lengths_and_are_200_at_most():
    np.testing.assert_array_equal(models.block_edges(10, 3), [0, 3, 7, 10])
    np.testing.assert_array_equal(models.block_edges(2, 10), [0, 2])
    assert len(models.block_edges(10_000, 10)) == 201
    samples = np.arange(10, dtype=np.float32)[None]
    np.testing.assert_allclose(models.block_means(samples, np.array([0, 3, 7, 10])), [[1, 4.5, 8]])
