"""The network that adds to the best linear predictor, where there is something to add and not."""

import numpy as np
import pytest

from gyro_pipeline.conventions import MDPS
from gyro_pipeline.estimators.linear import BestLinear
from gyro_pipeline.estimators.networks import ResidualNetwork, helpful_share
from gyro_pipeline.physics.allan import NoiseFigures
from gyro_pipeline.physics.recording_model import constant_bias

SAMPLES, RECORDING_S = 650, 87.0
RATE = SAMPLES / RECORDING_S
N, TAU = 3.3 * MDPS, 0.31 * MDPS
WHITE = constant_bias(SAMPLES, RATE, NoiseFigures(N, 0, 0), 0.0, TAU)
FLICKER = NoiseFigures(N, 3 * MDPS, 0.1 * MDPS)
COLOURED = constant_bias(SAMPLES, RATE, FLICKER, 0.0, TAU)


def rms(errors):
    return np.sqrt(np.mean(errors**2))


@pytest.mark.slow
def test_it_finds_what_the_linear_model_lacks_and_else_adds_little(simulate, judged, training_set):
    def judge(recordings):
        training, tested = (recordings.isel(recording=part) for part in np.split(np.arange(80), 2))
        network = ResidualNetwork(warm_up=False).fit(training_set(training))
        linear, _ = judged(network._linear, tested, 10)
        errors, sigma = judged(network, tested, 10)
        return rms(linear), rms(errors), np.mean(np.abs(errors) < sigma)

    # a drift that no linear model knows: a heater that is switched on at a random time
    heated, generator = simulate(COLOURED, 80, seed=6), np.random.default_rng(6)
    on_s = generator.uniform(10, 60, (1, 80, 3, 1))
    size = generator.normal(20, 5, on_s.shape) * MDPS
    since = np.maximum(np.arange(SAMPLES) / RATE - on_s, 0)
    drift = size * (1 - np.exp(-since / 5))
    heated["angular_rate"] = heated.angular_rate + drift.astype(np.float32)
    linear, corrected, within = judge(heated)
    assert corrected < 0.9 * linear
    assert 0.6 < within < 0.8
    linear, corrected, _ = judge(simulate(COLOURED, 80, seed=5))
    assert corrected == pytest.approx(linear, rel=0.01)


@pytest.mark.slow
def test_with_few_recordings_it_is_the_linear_predictor(simulate, judged, training_set):
    recordings = simulate(WHITE, 25, seed=10)
    training, tested = recordings.isel(recording=slice(9)), recordings.isel(recording=slice(9, 25))
    linear = BestLinear().fit(training_set(training))
    for window_s in (10, RECORDING_S):
        network = ResidualNetwork(False).fit(training_set(training, window_s=window_s))
        ours, theirs = judged(network, tested, window_s), judged(linear, tested, window_s)
        np.testing.assert_array_equal(ours, theirs)


def test_a_correction_is_used_as_far_as_it_surely_helps_and_one_of_chance_is_not():
    generator = np.random.default_rng(0)
    chance = [helpful_share(*generator.normal(size=(2, 40, 24))) for _ in range(400)]
    # two standard errors: 1 in 44, a little more as 40 recordings fix the error itself
    assert np.mean(np.array(chance) > 0) < 0.06
    found = generator.normal(size=(80, 24))
    for true_share, least, most in ((1.0, 0.85, 1.0), (0.3, 0.15, 0.3), (-1, 0, 0)):
        aims = true_share * found + generator.normal(size=found.shape)
        assert least <= helpful_share(found, aims) <= most
