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


def kalman(history, last_step=1):
    """Mean and variance of the next bias, by a local-level filter with a diffuse start."""
    own = history.deviation**2 + history.averaging
    mean, variance = history.labels[0], own
    for gap, label in zip(np.diff(history.numbers), history.labels[1:], strict=True):
        variance += gap * history.step**2
        gain = variance / (variance + own)
        mean, variance = mean + gain * (label - mean), (1 - gain) * variance
    return mean, variance + last_step * history.step**2 + history.deviation**2


@pytest.mark.parametrize(("step", "deviation"), [(1.0, 0.5), (0.0, 1.0), (2.0, 0.0)])
def test_the_prior_is_that_of_a_kalman_filter(step, deviation):
    numbers, labels = walked(12, 1.0, 0.5)
    history = BiasHistory(np.delete(numbers, 4), np.delete(labels, 4), AVERAGING, step, deviation)
    prior = history.prior(MODEL, None)
    assert (prior.mean[0], prior.covariance[0, 0]) == pytest.approx(kalman(history))
    later = history.prior(MODEL, 15)
    assert (later.mean[0], later.covariance[0, 0]) == pytest.approx(kalman(history, 3))


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
