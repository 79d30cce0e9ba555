import numpy as np
import pytest
import xarray as xr

from gyro_pipeline.conventions import InputError
from gyro_pipeline.parameters import VirtualGyros
from gyro_pipeline.pipelines.ground_truth.nodes import measure_allan_variance
from gyro_pipeline.pipelines.virtual_gyros.nodes import synthesise

RATE_HZ, SAMPLES = 10.0, 600
SIGMA = 0.02
SETTINGS = VirtualGyros(
    imus=8, recordings=20, train_recordings=16, turn_on_jitter_mdps=0.0, seed=20240901
)


@pytest.fixture(scope="module")
def real(make_recordings):
    """Ten recordings that train, two that validate and four that test, these of wild gyroscopes."""
    bias = np.random.default_rng(3).uniform(-1, 1, (2, 16, 3))
    bias[:, 10:] *= 50
    noise = SIGMA / np.sqrt(RATE_HZ)
    recordings = make_recordings(bias, SAMPLES, RATE_HZ, noise, split=(10, 2, 4))
    recordings.angular_rate[:, 10:] *= 7
    recordings["samples"][:, 3] = 100  # studies leave it out, and cut no other
    return recordings


@pytest.fixture(scope="module")
def bias(real, make_bias):
    return make_bias(real, measure_allan_variance(real))


@pytest.fixture(scope="module")
def virtual(real, bias):
    return synthesise(real, bias, SETTINGS)


def test_biases_and_noise_are_those_of_training_recordings(virtual, bias):
    training = bias[bias.recording <= 10]
    slack = 5 * SIGMA / np.sqrt(SAMPLES)
    low, high = float(virtual.recording_mean.min()), float(virtual.recording_mean.max())
    assert low > training.bias_dps.min() - slack
    assert high < training.bias_dps.max() + slack
    assert high - low > 0.7 * np.ptp(training.bias_dps)
    noise = virtual.angular_rate - virtual.recording_mean
    expected = np.sqrt(np.mean(training.sample_sigma_dps**2))
    assert float(noise.std()) == pytest.approx(expected, rel=0.005)
    successive = float((noise[..., 1:].to_numpy() * noise[..., :-1].to_numpy()).mean())
    assert successive / float((noise**2).mean()) == pytest.approx(0, abs=0.01)


def test_a_gyroscope_keeps_one_bias_over_recordings_or_with_jitter_about_one(virtual, real, bias):
    over_recordings = virtual.recording_mean.std("recording", ddof=1)
    assert float(over_recordings.mean()) == pytest.approx(SIGMA / np.sqrt(SAMPLES), rel=0.1)
    assert np.unique(virtual.recording_mean.mean("recording").round(2)).size > 15
    moved = synthesise(real, bias, SETTINGS.model_copy(update={"turn_on_jitter_mdps": 50.0}))
    over_recordings = moved.recording_mean.std("recording", ddof=1)
    assert float(np.sqrt((over_recordings**2).mean())) == pytest.approx(0.05, rel=0.1)


def test_the_seed_and_the_sensor_decide_and_the_layout_is_that_of_recordings(virtual, real, bias):
    assert dict(virtual.sizes) == {"imu": 8, "recording": 20, "axis": 3, "sample": SAMPLES}
    assert virtual.angular_rate.dtype == np.float32
    assert (virtual.rate_hz, virtual.source, virtual.simulated) == (RATE_HZ, "test", 1)
    assert virtual.drawn_from.tolist() == list(range(1, 11))
    expected = virtual.angular_rate.to_numpy().astype(np.float64).mean(axis=-1)
    np.testing.assert_allclose(virtual.recording_mean, expected, rtol=1e-12)
    xr.testing.assert_identical(synthesise(real, bias, SETTINGS), virtual)
    others = [synthesise(real, bias, SETTINGS.model_copy(update={"seed": 1}))]
    others.append(synthesise(real.assign_attrs(sensor="dot"), bias, SETTINGS))
    assert len({one.data_hash for one in [virtual, *others]}) == 3
    for other in others:
        assert not np.allclose(other.recording_mean, virtual.recording_mean, atol=0.01)
    with pytest.raises(InputError, match=r"sparkfun: virtual gyroscopes need a hold-out, got 16"):
        synthesise(real.drop_vars("split"), bias, SETTINGS)
