"""The best linear predictor against the dense solution, and ridge regression."""

import copy
from dataclasses import replace
from itertools import product

import numpy as np
import pytest

from gyro_pipeline.conventions import BIAS, MDPS, RECORDING_MEAN, InputError
from gyro_pipeline.estimators.linear import BestLinear, Ridge, ridge_regression
from gyro_pipeline.estimators.shrinkage import LastCalibration, TrainingMean
from gyro_pipeline.physics.allan import NoiseFigures
from gyro_pipeline.physics.recording_model import RecordingModel, block_edges, block_means
from gyro_pipeline.physics.recording_model import constant_bias as model_of

RATE, SAMPLES, SIZE = 20.0, 800, 200
N, TAU = 5 * MDPS, 1 * MDPS
WHITE = model_of(SAMPLES, RATE, NoiseFigures(N, 0, 0), 0.0, TAU)
COLOURED = model_of(SAMPLES, RATE, NoiseFigures(N, 5 * MDPS, 0.3 * MDPS), 0.0, TAU)
PRIOR = np.array([0.0, 20 * MDPS]), np.diag([TAU**2, TAU**2])
WARMING = RecordingModel(SAMPLES, RATE, WHITE.noise, *PRIOR, time_constant_s=15.0)


def rms(errors):
    return np.sqrt(np.mean(errors**2))


def halves(recordings, count):
    """The first recordings, which train, and the others, which test."""
    parts = slice(count), slice(count, None)
    return tuple(recordings.isel(recording=part) for part in parts)


@pytest.mark.slow
def test_it_is_the_dense_conditional_mean_given_training_and_window(simulate, training_set):
    """One normal distribution of training recordings and the new one, with a diffuse mean."""
    recordings = simulate(COLOURED, 6)
    estimator = BestLinear().fit(training_set(recordings.isel(recording=slice(5))))
    fitted = estimator.models[0]
    edges = block_edges(SAMPLES, 10)
    means = block_means(recordings.angular_rate.to_numpy()[0, :, 0].astype(np.float64), edges)
    offset = means.mean()
    # REML gives tau^2 + its share of the mean's own uncertainty; take the two apart
    noise = fitted.noise_covariance(edges)
    precision = np.linalg.inv(noise).sum()  # of one recording's bias
    uncertain = fitted.covariance[0, 0]
    tau2 = (uncertain - 1 / precision / 5) / (1 + 1 / 5)
    blocks = len(edges) - 1
    same = np.kron(np.eye(6), np.ones((blocks, blocks)))
    diffuse = 1e3
    joint = np.kron(np.eye(6), noise) + tau2 * same + diffuse * np.ones_like(same)
    seen = np.ones(6 * blocks, dtype=bool)
    for start, target in product((0, 400), (RECORDING_MEAN, BIAS)):
        seen[-blocks:] = (edges[:-1] >= start) & (edges[1:] <= start + SIZE)
        if target == RECORDING_MEAN:
            aim = np.concatenate([np.zeros(5 * blocks), np.full(blocks, 1 / blocks)])
            shared, own = joint @ aim, aim @ joint @ aim
        else:
            shared = diffuse + tau2 * np.repeat([0] * 5 + [1], blocks)
            own = diffuse + tau2
        weights = np.linalg.solve(joint[np.ix_(seen, seen)], shared[seen])
        expected = offset + weights @ (means.ravel() - offset)[seen]
        sigma = np.sqrt(own - weights @ shared[seen])
        samples = recordings.angular_rate.to_numpy()[0, 5:, :, start : start + SIZE]
        bias, estimated = estimator.estimate(samples, target, start / RATE)
        assert bias[0, 0] == pytest.approx(expected, abs=1e-4 * TAU)
        assert estimated[0, 0] == pytest.approx(sigma, rel=1e-3)


@pytest.mark.slow
def test_each_place_of_a_window_has_its_own_weights(simulate, training_set):
    recordings = simulate(WARMING, 12, seed=3)
    estimator = BestLinear(warm_up=True).fit(training_set(recordings))
    samples = recordings.angular_rate.to_numpy()[0, 0]
    windows = np.stack([samples[:, :SIZE], samples[:, 600 : 600 + SIZE]])
    both, _ = estimator.estimate(windows, start_s=np.array([0.0, 30.0]))
    np.testing.assert_allclose(both[0], estimator.estimate(windows[:1], start_s=0.0)[0][0])
    np.testing.assert_allclose(both[1], estimator.estimate(windows[1:], start_s=30.0)[0][0])
    wrong, _ = estimator.estimate(windows[1:])
    assert np.abs(wrong - both[1]).min() > 0.5 * MDPS


@pytest.mark.slow
def test_history_goes_on_with_calibrations_made_since_the_fit(simulate, training_set):
    recordings = simulate(WHITE, 12, 0)
    walk = np.random.default_rng(1).normal(0, 2 * MDPS, (1, 12, 3)).cumsum(axis=1)
    recordings["angular_rate"] = recordings.angular_rate + walk[..., None]
    labels = recordings.angular_rate.mean("sample", dtype=np.float64).to_numpy()[0]
    windows = recordings.angular_rate.to_numpy()[0, 11:, :, :SIZE]
    for estimator in (BestLinear(history=True), LastCalibration()):
        fitted = estimator.fit(training_set(recordings.isel(recording=slice(8))))
        told = fitted.with_calibrations(np.arange(9, 13), labels[8:])
        stale, current = (one.estimate(windows, recording=12)[0] for one in (fitted, told))
        assert np.abs(current - labels[10]).max() < np.abs(stale - labels[10]).max()
        # its own calibration and later ones do not count
        other = fitted.with_calibrations(np.arange(9, 13), labels[8:] + [[0], [0], [0], [9]])
        np.testing.assert_array_equal(other.estimate(windows, recording=12)[0], current)
        early, before = (one.estimate(windows, recording=5)[0] for one in (told, fitted))
        np.testing.assert_array_equal(early, before)
    mean = TrainingMean().fit(training_set(recordings))
    assert mean.with_calibrations(np.arange(9, 13), labels[8:]) is mean


@pytest.mark.slow
def test_a_fallback_costs_little_and_saves_where_the_prior_fails(simulate, judged, training_set):
    training, tested = halves(simulate(WHITE, 80, seed=4), 40)
    turned = tested.copy(deep=True)
    turned["angular_rate"] = turned.angular_rate + np.float32(15 * MDPS)
    plain, fallback = (BestLinear(fallback=f).fit(training_set(training)) for f in (False, True))
    assert rms(judged(fallback, tested, 10)[0]) < 1.03 * rms(judged(plain, tested, 10)[0])
    errors, sigma = judged(fallback, turned, 10)
    assert rms(errors) < 0.3 * rms(judged(plain, turned, 10)[0])
    assert np.mean(np.abs(errors) < 1.96 * sigma) > 0.85
    for wrong, told in (
        ({"history": True, "fallback": True}, "expected no history"),
        ({"noise": "white"}, "expected 'reml' or 'allan', got 'white'"),
    ):
        with pytest.raises(InputError, match=told):
            BestLinear(**wrong)


@pytest.mark.slow
def test_correlated_axes_are_estimated_jointly(simulate, judged, training_set):
    training, tested = halves(simulate(WARMING, 80, seed=5), 40)
    assert BestLinear(None).fit(training_set(training))._biases is None  # nothing is correlated
    common = np.random.default_rng(6).normal(0, 3 * TAU, 80)[None, :, None]
    for part, shift in zip((training, tested), np.split(common, 2, axis=1), strict=True):
        part["angular_rate"] = part.angular_rate + np.float32(shift)[..., None]
        part["true_bias"] = part.true_bias + shift
    joint = BestLinear(None).fit(training_set(training))
    alone = copy.copy(joint)
    alone._biases, alone._lines = None, {}
    for target in (RECORDING_MEAN, BIAS):
        errors, sigma = judged(joint, tested, 10, target)
        assert rms(errors) < 0.9 * rms(judged(alone, tested, 10, target)[0])
        assert np.mean(np.abs(errors) < 1.96 * sigma) > 0.88


def test_ridge_regression_solves_its_normal_equations():
    generator = np.random.default_rng(4)
    x = generator.normal(size=(60, 4)) + 5
    y = x @ [1.0, -1.0, 0.5, 0.0] + 0.1 * generator.normal(size=60) + 7
    weights, constant = ridge_regression(x, y, groups=np.repeat(np.arange(30), 2))
    centred = x - x.mean(axis=0)
    penalty = (centred.T @ (y - y.mean() - centred @ weights)) / weights
    np.testing.assert_allclose(penalty, penalty[0], rtol=1e-6)
    assert penalty[0] > 0
    assert constant == pytest.approx(y.mean() - x.mean(axis=0) @ weights)
    np.testing.assert_allclose(weights, [1.0, -1.0, 0.5, 0.0], atol=0.1)


@pytest.mark.slow
def test_ridge_copes_with_a_warm_up_and_of_nothing_is_the_constant(simulate, judged, training_set):
    long = replace(WARMING, samples=2 * SAMPLES)
    training, tested = halves(simulate(long, 100, seed=6), 70)
    same, any_time = (
        rms(judged(Ridge(t).fit(training_set(training)), tested, 10)[0]) for t in (True, False)
    )
    assert same < 0.9 * any_time
    flat = simulate(model_of(2 * SAMPLES, RATE, NoiseFigures(N, 0, 0), 0.0, 0.0), 60, seed=5)
    rates = flat.angular_rate.to_numpy()[0]
    bias, _ = Ridge().fit(training_set(flat)).estimate(rates[..., :SIZE])
    assert rms(bias - rates.mean(axis=(0, 2), dtype=np.float64)) < 0.2 * N / np.sqrt(SIZE / RATE)
