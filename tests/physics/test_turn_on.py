"""Estimates of the turn-on spread from the means of recordings."""

import numpy as np
import pytest

from gyro_pipeline.conventions import InputError
from gyro_pipeline.physics import turn_on


def test_the_spread_by_hand_counts_present_recordings_only():
    means = np.array([[1.0, 0.0], [3.0, 0.0], [np.nan, 1.0], [5.0, 1.0]])
    # sample variances 4 and 1/3, averaging noise 2^2 / 4
    np.testing.assert_allclose(turn_on.turn_on_spread(means, 2.0**2 / 4), [np.sqrt(3.0), 0.0])
    with pytest.raises(InputError, match="at least 2 recordings"):
        turn_on.turn_on_spread(means[1:3], 0.1)


def test_draws_of_the_spread_hold_it_as_often_as_they_say():
    """Of 11 recordings, with little averaging noise, jointly over axes as well."""
    generator, tau = np.random.default_rng(2), np.array([1.0, 2.0, 3.0])
    held = []
    for _ in range(300):
        means = generator.normal(0, np.hypot(tau, 0.5), (11, 3))
        draws = turn_on.spread_draws(means, 0.25, 200)
        lo, hi = np.percentile(draws, [2.5, 97.5], axis=0)
        held.append((lo <= tau) & (tau <= hi))
    np.testing.assert_allclose(np.mean(held, axis=0), 0.95, atol=0.04)
    joint = turn_on.joint_draws(means, np.full(3, 0.25), 200)
    np.testing.assert_allclose(joint[0], np.cov(means.T) - 0.25 * np.eye(3), atol=0.3)
    assert (np.linalg.eigvalsh(joint) > -1e-9).all()
    assert np.median(joint[1:, 2, 2]) == pytest.approx(np.median(draws[:, 2] ** 2), rel=0.4)


def test_the_guarded_spread_solves_its_equation_and_matters_with_few_recordings_only():
    """The root of a quadratic in w = tau^2 + v for one group."""
    squares, freedom, v = 30.0, 9, 2.0
    b = squares + freedom * v
    w = (b + np.sqrt(b**2 - 4 * (freedom - 1) * v * squares)) / (2 * (freedom - 1))
    assert turn_on.guarded_spread(squares, freedom, v) == pytest.approx(np.sqrt(w - v))
    assert turn_on.guarded_spread(0.5 * 4 * 4.0, 4, 4.0) > 0.3  # the plain estimate is 0
    many = 10_000
    assert turn_on.guarded_spread(3 * many, many, 2.0) == pytest.approx(1.0, rel=1e-3)
    assert turn_on.guarded_spread(0.0, 5, 0.0) == 0


def test_the_correlation_of_biases_is_freed_from_their_errors():
    """Errors as large as the spread halve the correlation of the measured biases."""
    generator, truth, held = np.random.default_rng(5), 0.8, []
    for _ in range(300):
        biases = generator.multivariate_normal([0, 0], [[1, truth], [truth, 1]], 80)
        measured = biases + generator.normal(0, 1, biases.shape)
        value, lo, hi = turn_on.bias_correlation(measured, [1.0, 1.0])
        held.append((value, lo <= truth <= hi))
    values, covered = np.mean(held, axis=0)
    assert values == pytest.approx(truth, abs=0.03)
    assert covered > 0.9
    assert turn_on.bias_correlation(measured[:4], [1.0, 1.0]) is None
    assert turn_on.bias_correlation(measured, [9.0, 9.0]) is None


def test_a_correlation_between_axes_is_detected_and_rarely_where_there_is_none():
    generator, common = np.random.default_rng(3), np.array([[1.0, 1.0, 0.0]])
    alarms, detected = [], []
    for _ in range(1000):
        independent = generator.normal(0, 1, (11, 3))
        alarms.append(turn_on.axes_are_correlated(independent))
        correlated = independent + 3 * generator.normal(0, 1, (11, 1)) * common
        detected.append(turn_on.axes_are_correlated(correlated))
    assert np.mean(alarms) < 0.02
    assert np.mean(detected) > 0.8
    assert not turn_on.axes_are_correlated(correlated[:3])  # too few
    assert not turn_on.axes_are_correlated(correlated[:, :1])
