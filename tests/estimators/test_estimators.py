"""What all estimators have in common, and what the simple ones return."""

import numpy as np
import pytest
from scipy import stats

from gyro_pipeline.conventions import BIAS, MDPS, PAPER, RECORDING_MEAN, TRUE, InputError
from gyro_pipeline.estimators import DEFAULT, ESTIMATORS, estimator_class, make_estimator
from gyro_pipeline.estimators.averages import RunningMean
from gyro_pipeline.estimators.base import Estimator
from gyro_pipeline.estimators.shrinkage import EmpiricalBayes, PooledEmpiricalBayes
from gyro_pipeline.physics.allan import NoiseFigures
from gyro_pipeline.physics.ceiling import oracle, running_mean_rmse
from gyro_pipeline.physics.recording_model import constant_bias
from gyro_pipeline.physics.turn_on import guarded_spread

RATE, SAMPLES, SIZE = 20.0, 800, 200
N, TAU = 5 * MDPS, 1 * MDPS
MODEL = constant_bias(SAMPLES, RATE, NoiseFigures(N, 0, 0), 0.0, TAU)
NO_SIGMA = {"median", "trimmed_mean", "ridge", "ridge_same_time", "window_mean_network"}
NAMES = [name for name in ESTIMATORS if not estimator_class(name).seeded]


def make(name):
    """Of those that ask for no settings."""
    return make_estimator(name, None, 0)


@pytest.fixture(scope="module")
def recordings(simulate):
    return simulate(MODEL, 12, imus=2)


@pytest.fixture(scope="module")
def windows(recordings):
    return recordings.angular_rate.to_numpy()[0, :, :, :SIZE]


@pytest.fixture(scope="module")
def labels(recordings):
    return recordings.angular_rate.to_numpy()[0].mean(axis=-1, dtype=np.float64)


@pytest.fixture(scope="module")
def fitted(recordings, training_set):
    return {name: make(name).fit(training_set(recordings)) for name in NAMES}


@pytest.mark.slow
def test_each_gives_a_bias_and_its_sigma_also_when_saved_without_the_recordings(
    fitted, recordings, windows, tmp_path
):
    for name, one in fitted.items():
        for target in (RECORDING_MEAN, BIAS):
            bias, sigma = one.estimate(windows, target)
            assert bias.shape == sigma.shape == (12, 3)
            assert bias.dtype == sigma.dtype == np.float64
            assert np.isfinite(bias).all()
            assert np.isnan(sigma).all() if name in NO_SIGMA else (sigma > 0).all(), name
        one.save(tmp_path / name)
        loaded = Estimator.load(tmp_path / name)
        np.testing.assert_array_equal(loaded.estimate(windows, BIAS), [bias, sigma])
        size = sum(file.stat().st_size for file in (tmp_path / name).iterdir())
        assert size < 0.6 * recordings.angular_rate.sel(imu=1).nbytes, name
    with pytest.raises(InputError, match="expected 'recording_mean' or 'bias', got 'mean'"):
        fitted["mean"].estimate(windows, "mean")
    recommended = {name for name, estimator in fitted.items() if estimator.recommended}
    assert {DEFAULT, "empirical_bayes", "best_linear", "residual_network"} <= recommended
    others = {"mean", "ridge", "empirical_bayes_pooled", "best_linear_allan", "window_mean_network"}
    assert not recommended & others


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
def test_a_shift_of_all_recordings_shifts_the_estimates_and_priors_alone_remember_it(
    recordings, fitted, windows, name, training_set
):
    """By 1 deg/s, thousands of times what the power-ons scatter."""
    shifted = recordings.copy()
    shifted["angular_rate"] = recordings.angular_rate.astype(np.float64) + 1
    bias, sigma = fitted[name].estimate(windows)
    other = make(name).fit(training_set(shifted))
    moved, moved_sigma = other.estimate(windows.astype(np.float64) + 1)
    np.testing.assert_allclose(moved, bias + 1, atol=0.005 * MDPS)
    np.testing.assert_allclose(moved_sigma, sigma, rtol=0.01)
    assert np.allclose(other.estimate(windows)[0], bias, atol=1e-9) == (not other.uses_prior)


@pytest.mark.slow
def test_masked_samples_hardly_matter_and_recordings_that_a_device_lacks_are_left_out(
    recordings, fitted, windows, training_set
):
    masked = recordings.copy(deep=True)
    masked.angular_rate[:, :, :, [3, 100, 101]] = np.nan
    lacking = recordings.copy(deep=True)
    lacking.angular_rate[0, [2, 5]], lacking["samples"][0, [2, 5]] = np.nan, 0
    fewer = recordings.isel(recording=[0, 1, 3, 4, *range(6, 12)])
    # where nothing warms up, chance alone decides what best_linear_warm_up finds
    for name in set(NAMES) - {"best_linear_warm_up"}:
        bias, _ = make(name).fit(training_set(masked)).estimate(windows)
        close = {"atol": (1.5 if "network" in name else 0.5) * TAU, "err_msg": name}
        np.testing.assert_allclose(bias, fitted[name].estimate(windows)[0], **close)
    for name in ("training_mean", "empirical_bayes", "best_linear", "ridge"):
        bias, _ = make(name).fit(training_set(lacking)).estimate(windows)
        np.testing.assert_allclose(bias, make(name).fit(training_set(fewer)).estimate(windows)[0])


def test_averages_are_numpys_and_only_the_sigma_needs_a_fit(recordings, windows, training_set):
    exact = windows.astype(np.float64)
    for name, expected in {
        "mean": exact.mean(axis=-1),
        "median": np.median(exact, axis=-1),
        "trimmed_mean": stats.trim_mean(exact, 0.1, axis=-1),
    }.items():
        bias, sigma = make(name).estimate(windows)
        np.testing.assert_allclose(bias, expected, atol=1e-12)
        assert np.isnan(sigma).all()
    fitted = make("mean").fit(training_set(recordings))
    for target, truth in {RECORDING_MEAN: PAPER, BIAS: TRUE}.items():
        bias, sigma = fitted.estimate(windows, target)
        np.testing.assert_array_equal(bias, RunningMean().estimate(windows)[0])
        expected = running_mean_rmse(N, SIZE / RATE, SAMPLES / RATE, truth)
        np.testing.assert_allclose(sigma, expected, rtol=0.15)


def test_the_constant_is_the_mean_of_the_labels(recordings, labels, windows, training_set):
    estimator = make("training_mean").fit(training_set(recordings))
    bias, sigma = estimator.estimate(windows, RECORDING_MEAN)
    np.testing.assert_allclose(bias, np.tile(labels.mean(axis=0), (12, 1)))
    np.testing.assert_allclose(sigma[0], labels.std(axis=0, ddof=1) * np.sqrt(1 + 1 / 12))


def test_the_last_calibration_is_of_the_recording_before(recordings, labels, windows, training_set):
    estimator = make("last_calibration").fit(training_set(recordings.sel(recording=[2, 7, 4])))
    for number, stored in {3: 2, 4: 2, 5: 4, 7: 4, 8: 7, None: 7}.items():
        bias, _ = estimator.estimate(windows[:1], recording=number)
        np.testing.assert_allclose(bias[0], labels[stored - 1])
    nothing_stored, _ = estimator.estimate(windows[:1], recording=2)
    np.testing.assert_allclose(nothing_stored[0], labels[[1, 6, 3]].mean(axis=0))


def test_empirical_bayes_is_the_oracle_with_what_it_learned_and_pooled_has_one_spread(
    recordings, labels, windows, training_set
):
    estimator = EmpiricalBayes().fit(training_set(recordings))
    noise, recording_s = estimator._noise, SAMPLES / RATE
    own = noise**2 / recording_s
    tau = np.array([guarded_spread(s, 11, v) for s, v in zip(labels.var(0) * 12, own, strict=True)])
    prior = np.sqrt(tau**2 + (tau**2 + own) / 12)
    m = windows.mean(axis=-1, dtype=np.float64)
    for target, truth in {RECORDING_MEAN: PAPER, BIAS: TRUE}.items():
        expected = oracle(m, labels.mean(axis=0), prior, noise, SIZE / RATE, recording_s, truth)
        np.testing.assert_allclose(estimator.estimate(windows, target)[0], expected, atol=1e-12)
    pooled = PooledEmpiricalBayes().fit(training_set(recordings))
    tau = np.sqrt((pooled._prior - pooled._noise**2 / recording_s / 12) / (1 + 1 / 12))
    np.testing.assert_allclose(tau, tau[0])
    assert tau[0] == pytest.approx(TAU, rel=0.3)
