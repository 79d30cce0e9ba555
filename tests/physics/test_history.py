"""The prior of a bias that walks from one calibration to the next."""

from dataclasses import replace

import numpy as np
import pytest

from gyro_pipeline.physics.allan import NoiseFigures
from gyro_pipeline.physics.history import BiasHistory
from gyro_pipeline.physics.recording_model import RecordingModel, constant_bias

MODEL = constant_bias(1000, 20.0, NoiseFigures(5.0, 0.0, 0.0), 3.0, 7.0)
AVERAGING = 5.0**2 * 20 / 1000


def walked(count, step, deviation, seed=0):
    generator = np.random.default_rng(seed)
    levels = 100 + np.cumsum(generator.normal(0, step, count))
    bias = levels + generator.normal(0, deviation, count)
    return np.arange(1, count + 1), bias + generator.normal(0, np.sqrt(AVERAGING), count)


def kriged(history, number):
    """Mean and variance of a bias given all labels: generalised least squares, unknown level."""
    times = np.append(history.numbers, number) - history.numbers[0]
    covariance = history.step**2 * np.minimum.outer(times, times)
    covariance += np.diag(np.append(np.full(times.size - 1, AVERAGING), 0) + history.deviation**2)
    weights = np.linalg.inv(covariance[:-1, :-1])
    level = weights.sum(axis=0) @ history.labels / weights.sum()
    gain = covariance[-1, :-1] @ weights
    variance = covariance[-1, -1] - gain @ covariance[:-1, -1]
    variance += (1 - gain.sum()) ** 2 / weights.sum()
    return level + gain @ (history.labels - level), variance


@pytest.mark.parametrize(("step", "deviation"), [(1.0, 0.5), (0.0, 1.0), (2.0, 0.0)])
def test_the_prior_is_the_best_prediction_from_all_earlier_labels(step, deviation):
    numbers, labels = walked(12, 1.0, 0.5)
    history = BiasHistory(np.delete(numbers, 4), np.delete(labels, 4), AVERAGING, step, deviation)
    for number in (None, 15):
        prior = history.prior(MODEL, number)
        expected = kriged(history, number or 13)
        assert (prior.mean[0], prior.covariance[0, 0]) == pytest.approx(expected)


def test_draws_scatter_about_the_parameters_that_were_drawn():
    numbers, labels = walked(80, 1.0, 0.5, seed=4)
    drawn = BiasHistory.fit(numbers, labels, MODEL).draws(400, seed=0)
    for values, truth in ((drawn.step, 1.0), (drawn.deviation, 0.5)):
        low, high = np.quantile(values, [0.025, 0.975])
        assert low < truth < high < 3 * truth
    mean, variance = drawn.next_bias(81)
    assert mean.shape == variance.shape == (400,)


def test_only_what_came_before_counts():
    numbers, labels = walked(12, 1.0, 0.5)
    history = BiasHistory(numbers, labels, AVERAGING, 1.0, 0.5)
    other = replace(history, labels=np.where(numbers > 6, -50.0, labels))
    assert history.prior(MODEL, 7).mean == other.prior(MODEL, 7).mean
    assert history.prior(MODEL, 8).mean != other.prior(MODEL, 8).mean
    assert history.prior(MODEL, 3) is MODEL  # two calibrations came before


@pytest.mark.slow
def test_the_walk_is_found():
    steps = [BiasHistory.fit(*walked(80, 1.0, 0.5, seed), MODEL).step for seed in range(3)]
    assert np.mean(steps) == pytest.approx(1.0, rel=0.2)
    steady = [BiasHistory.fit(*walked(80, 0.0, 1.0, seed), MODEL) for seed in range(3)]
    assert np.mean([found.step for found in steady]) < 0.1
    assert np.mean([found.deviation for found in steady]) == pytest.approx(1.0, rel=0.1)


def test_a_warm_up_s_share_of_the_labels_is_not_the_bias():
    warming = RecordingModel(
        1000, 20.0, MODEL.noise, np.array([0.0, 30.0]), np.diag([1.0, 4.0]), time_constant_s=10.0
    )
    share = warming.profiles(np.array([0, 1000]))[0, 1]
    numbers, labels = walked(20, 0.0, 0.5)
    history = BiasHistory.fit(numbers, labels + 30 * share, warming)
    assert history.averaging == pytest.approx(AVERAGING + 4 * share**2)
    assert history.prior(warming, None).mean[0] == pytest.approx(labels.mean(), abs=0.01)
