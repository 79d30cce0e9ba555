"""A network as an estimator: which windows train and validate it, and as what."""

import numpy as np
import pytest

from gyro_pipeline.conventions import BEST, BIAS, LAST, MDPS, RECORDING_MEAN, TRAIN, InputError
from gyro_pipeline.conventions import VALIDATION as VALIDATE
from gyro_pipeline.estimators import make_estimator, settings_of
from gyro_pipeline.estimators.base import Estimator
from gyro_pipeline.estimators.nn_module import ModuleEstimator
from gyro_pipeline.estimators.training_set import TrainingSet
from gyro_pipeline.parameters import Training
from gyro_pipeline.physics.allan import NoiseFigures
from gyro_pipeline.physics.recording_model import constant_bias

RATE, SAMPLES, SIZE = 20.0, 650, 200
MODEL = constant_bias(SAMPLES, RATE, NoiseFigures(5 * MDPS, 0, 0), 0.0, 20 * MDPS)
SETTINGS = Training(
    **{"centring": "per_device", "channels": 4, "kernel": 6, "stride": 5, "pool": 2, "hidden": 8},
    **{"epochs": 6, "batch_size": 8, "learning_rate": 1e-3, "decay": 0.1, "decay_every": 4},
)
ROLES = {9: VALIDATE, 10: VALIDATE}
PAPER = "gyro_pipeline.learning.network:CalibrationNetwork"


@pytest.fixture(scope="module")
def recordings(simulate):
    return simulate(MODEL, 10, imus=3)


@pytest.fixture(scope="module")
def training(training_set, recordings):
    return training_set(recordings, roles=ROLES)


def network(seed=0, shuffled=False, **changes):
    return ModuleEstimator(PAPER, SETTINGS.model_copy(update=changes), seed, shuffled)


def test_every_imu_is_a_device_and_the_first_alone_validates(training):
    job = network().job(training)
    assert [device.imus for device in job.devices] == [(1,), (2,), (3,)]
    assert all(device.numbers == tuple(range(1, 9)) for device in job.devices)
    assert all(starts.tolist() == [0, 200, 400] for starts in job.devices[0].starts)
    assert (job.validation.imus, job.validation.numbers) == ((1,), (9, 10))
    means = training.real.recording_mean.to_numpy()[1, :8]
    np.testing.assert_array_equal(job.devices[1].biases, means)


def test_side_by_side_a_window_is_used_if_all_have_it(training):
    lacking = training.windows
    gone = (lacking.imu == 2) & (lacking.recording == 4) & (lacking.start == 200)
    together = TrainingSet(training.real, None, lacking[~gone], SIZE, 1, (1, 2, 3))
    job = network().job(together)
    (device,) = job.devices
    assert device.imus == (1, 2, 3)
    assert [len(starts) for starts in device.starts] == [3, 3, 3, 2, 3, 3, 3, 3]
    assert job.design.gyroscopes == 9
    means = training.real.recording_mean.to_numpy()[:, :8]
    np.testing.assert_array_equal(device.biases, means.transpose(1, 0, 2).reshape(8, 9))


def test_it_learns_and_is_saved_with_the_weights_of_both_epochs(recordings, training, tmp_path):
    fitted = network(epochs=60, learning_rate=1e-2, decay_every=60).fit(training)
    assert fitted.engine in {"fused", "cpu"}
    windows = recordings.angular_rate.to_numpy()[0, :8, :, :SIZE]
    bias, sigma = fitted.estimate(windows)
    np.testing.assert_array_equal(bias, fitted.estimate(windows, RECORDING_MEAN, 3.0, 7)[0])
    assert np.isnan(sigma).all()
    truth = recordings.true_bias.to_numpy()[0, :8]
    assert np.std(bias - truth) < 0.7 * np.std(truth - truth.mean(axis=0))
    fitted.save(tmp_path / "fit")
    loaded = Estimator.load(tmp_path / "fit")
    assert list(fitted.variants()) == list(loaded.variants()) == [LAST, BEST]
    last, best = (one.estimate(windows, BIAS)[0] for one in fitted.variants().values())
    assert not np.array_equal(last, best)
    for one, expected in zip(loaded.variants().values(), (last, best), strict=True):
        np.testing.assert_array_equal(one.estimate(windows, BIAS)[0], expected)


def test_shuffled_labels_are_those_of_the_recordings(training):
    plain = network().job(training)
    shuffled = network(shuffled=True).job(training)
    other = network(1, shuffled=True).job(training)
    for one, two in zip(plain.devices, shuffled.devices, strict=True):
        assert not np.array_equal(one.biases, two.biases)
        np.testing.assert_array_equal(np.sort(one.biases, axis=0), np.sort(two.biases, axis=0))
    np.testing.assert_array_equal(plain.validation.biases, shuffled.validation.biases)
    assert len({plain.cell, shuffled.cell, other.cell}) == 3
    assert plain.cell == network(5).job(training).cell


def test_what_it_cannot_be_fitted_to_is_refused_before(training, training_set, recordings):
    own = training.windows
    few = own[(own.recording == 1) | (own.role != TRAIN)]
    with pytest.raises(InputError, match="at least two training recordings, got one"):
        network().check(TrainingSet(training.real, None, few, SIZE, 1))
    with pytest.raises(InputError, match="windows of the device to train on, got none"):
        network().check(TrainingSet(training.real, None, own[own.imu != 1], SIZE, 1))
    network(centring="global").check(TrainingSet(training.real, None, few, SIZE, 1))


def test_a_name_says_what_is_made_and_settings_that_follow_it_change_that(training):
    plain = make_estimator("cnn", SETTINGS, 0)
    assert plain.settings == {
        **{name: getattr(SETTINGS, name) for name in SETTINGS.schedule},
        **{"channels": 4, "kernel": 6, "stride": 5, "pool": 2, "hidden": 8},
    }
    assert make_estimator("cnn_shuffled", SETTINGS, 0)._shuffled
    wide = make_estimator("cnn learning_rate=1e-2 channels=6", SETTINGS, 0)
    changes = {"learning_rate": 0.01, "channels": 6}
    assert wide.settings == plain.settings | changes
    assert wide.job(training).design.options["channels"] == 6
    lstm = make_estimator("lstm units=5 centring=global", SETTINGS, 0)
    options = {"units": 5, "layers": 1, "block_s": 0.1, "centring": "global"}
    assert lstm.settings == SETTINGS.schedule | options
    assert lstm.job(training).design.options["rate_hz"] == RATE
    assert make_estimator("best_linear warm_up=true", SETTINGS, 0)._warm_up is True
    assert settings_of("best_linear", SETTINGS) == {}
    for name, told in (
        ("cnn channels", "'cnn channels': expected key=value once, got 'channels'"),
        ("cnn width=3", "has no option 'width'; it has channels, kernel, stride, pool, hidden"),
        ("ridge epochs=3", "unexpected keyword argument 'epochs'"),
    ):
        with pytest.raises(InputError, match=told):
            make_estimator(name, SETTINGS, 0)


@pytest.mark.slow
def test_every_network_learns_is_saved_and_estimates_again(training, recordings, tmp_path):
    windows = recordings.angular_rate.to_numpy()[0, :, :, :SIZE]
    estimates, settings = {}, SETTINGS.model_copy(update={"epochs": 2})
    for name in ("cnn", "single_gyroscope", "lstm", "tcn"):
        fitted = make_estimator(name, settings, 0).fit(training)
        fitted.save(tmp_path / name)
        estimates[name] = fitted.estimate(windows)[0]
        loaded = Estimator.load(tmp_path / name)
        np.testing.assert_array_equal(loaded.estimate(windows)[0], estimates[name])
    distinct = {values.tobytes() for values in estimates.values()}
    assert len(distinct) == len(estimates)
