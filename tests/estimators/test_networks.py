"""The network that adds to the best linear predictor, where there is something to add and not."""

import numpy as np
import pytest

from gyro_pipeline.conventions import MDPS, RECORDING_MEAN
from gyro_pipeline.estimators.linear import BestLinear
from gyro_pipeline.estimators.networks import ResidualNetwork, helpful_share
from gyro_pipeline.learning.perceptrons import train_perceptrons
from gyro_pipeline.physics.allan import NoiseFigures
from gyro_pipeline.physics.recording_model import RecordingModel, constant_bias, innovations

SAMPLES, RECORDING_S = 1300, 87.0
RATE = SAMPLES / RECORDING_S
N, TAU = 3.3 * MDPS, 0.31 * MDPS
WHITE = constant_bias(SAMPLES, RATE, NoiseFigures(N, 0, 0), 0.0, TAU)
FLICKER = NoiseFigures(N, 3 * MDPS, 0.1 * MDPS)
COLOURED = constant_bias(SAMPLES, RATE, FLICKER, 0.0, TAU)
WARMING = RecordingModel(
    SAMPLES,
    RATE,
    FLICKER,
    np.array([0.0, 20 * MDPS]),
    np.diag([TAU**2, (5 * MDPS) ** 2]),
    time_constant_s=30.0,
)


def rms(errors):
    return np.sqrt(np.mean(errors**2))


def with_heater(recordings, generator):
    """A drift that no linear model knows: a heater that is switched on at a random time."""
    imus, count, axes, samples = recordings.angular_rate.shape
    on_s = generator.uniform(10, 60, (imus, count, axes, 1))
    size = generator.normal(20, 5, on_s.shape) * MDPS
    since = np.arange(samples) / RATE - on_s
    heated = recordings.copy()
    drift = np.where(since > 0, size * (1 - np.exp(-np.maximum(since, 0) / 5)), 0)
    heated["angular_rate"] = recordings.angular_rate + drift.astype(np.float32)
    return heated


def both(recordings, judged, training_set, make, target=RECORDING_MEAN):
    """RMSE of the linear estimate and of the corrected one on the other half; shares of errors."""
    training, tested = (
        recordings.isel(recording=slice(80)),
        recordings.isel(recording=slice(80, 160)),
    )
    network = make().fit(training_set(training))
    linear, _ = judged(network._linear, tested, 10, target)
    errors, sigma = judged(network, tested, 10, target)
    return rms(linear), rms(errors), np.mean(np.abs(errors) < sigma)


@pytest.mark.parametrize("model", [COLOURED, WARMING], ids=["coloured", "warming"])
def test_where_the_linear_model_holds_it_adds_next_to_nothing(
    simulate, judged, model, training_set
):
    warm_up = model is WARMING
    made = simulate(model, 160, seed=5)
    linear, corrected, _ = both(made, judged, training_set, lambda: ResidualNetwork(warm_up))
    assert corrected == pytest.approx(linear, rel=0.01)


def test_it_finds_a_drift_that_the_linear_model_lacks(simulate, judged, training_set):
    heated = with_heater(simulate(COLOURED, 160, seed=6), np.random.default_rng(6))
    linear, corrected, within = both(
        heated, judged, training_set, lambda: ResidualNetwork(warm_up=False)
    )
    assert corrected < 0.9 * linear
    assert 0.6 < within < 0.8


def test_with_few_recordings_it_is_the_linear_predictor(simulate, judged, training_set):
    recordings = simulate(WHITE, 25, seed=10)
    training, tested = recordings.isel(recording=slice(9)), recordings.isel(recording=slice(9, 25))
    linear = BestLinear().fit(training_set(training))
    for window_s in (10, RECORDING_S):
        network = ResidualNetwork(False).fit(training_set(training, window_s=window_s))
        ours, theirs = judged(network, tested, window_s), judged(linear, tested, window_s)
        np.testing.assert_array_equal(ours, theirs)


def test_innovations_of_the_model_itself_are_independent_with_variance_1(simulate):
    made = simulate(WARMING, 300, seed=12, unit_bias=0.0)
    windows = made.angular_rate.to_numpy()[0, :, :, 300:450].reshape(-1, 150).astype(float)
    found = innovations(WARMING, 300, windows)
    np.testing.assert_allclose(np.cov(found.T), np.eye(found.shape[1]), atol=0.2)
    np.testing.assert_allclose(found.mean(axis=0), 0, atol=0.15)


def test_a_correction_made_of_chance_is_not_used():
    generator = np.random.default_rng(0)
    shares = [
        helpful_share(generator.normal(size=(40, 24)), generator.normal(size=(40, 24)))
        for _ in range(400)
    ]
    # two standard errors: 1 in 44, a little more as 40 recordings fix the error itself
    assert np.mean(np.array(shares) > 0) < 0.06


@pytest.mark.parametrize(
    ("true_share", "lo", "hi"), [(1.0, 0.85, 1.0), (0.3, 0.15, 0.3), (-1, 0, 0)]
)
def test_a_correction_that_helps_is_used_as_far_as_it_surely_helps(true_share, lo, hi):
    generator = np.random.default_rng(1)
    found = generator.normal(size=(80, 24))
    aims = true_share * found + generator.normal(size=found.shape)
    assert lo <= helpful_share(found, aims) <= hi


def test_networks_side_by_side_are_trained_on_their_own_examples():
    inputs = np.linspace(-1, 1, 400)[:, None]
    left = inputs[:, 0] < 0
    aims = np.where(left, inputs[:, 0], -inputs[:, 0])[:, None]  # the slope differs by side
    trained = train_perceptrons(inputs, aims, np.stack([left, ~left]))
    outputs = trained(inputs)[..., 0]
    np.testing.assert_allclose(outputs[0, left], aims[left, 0], atol=0.05)
    np.testing.assert_allclose(outputs[1, ~left], aims[~left, 0], atol=0.05)
    alone = train_perceptrons(inputs, aims, left[None])
    assert alone(inputs).shape == (1, 400, 1)
