"""The mixture of a narrow and a wide prior against direct integration and known figures."""

import numpy as np
import pytest

from gyro_pipeline.physics.mixture import log_e, log_ratios, mixture_posterior


def test_one_axis_is_the_mixture_of_two():
    x = np.linspace(-30, 30, 200_001)
    density = 0.95 * np.exp(-(x**2) / 2 / 0.3**2) / 0.3 + 0.05 * np.exp(-(x**2) / 2 / 5**2) / 5
    posterior = density * np.exp(-((3.0 - x) ** 2) / 2 / 1.1**2)
    posterior /= posterior.sum()
    mean = posterior @ x
    found = mixture_posterior([3.0], [1.1**2], [0.0], [0.3**2], [5.0**2])
    np.testing.assert_allclose(found.mean, mean, rtol=1e-6)
    np.testing.assert_allclose(found.variance, posterior @ (x - mean) ** 2, rtol=1e-6)


def test_axes_that_speak_for_the_history_do_not_suffer_from_one_that_does_not():
    found = mixture_posterior([9.0, 0.1, -0.2], 1.0, 0.0, 0.1, 25.0)
    assert found.wide[0] > 0.99
    assert found.wide[1:].max() < 0.3
    np.testing.assert_allclose(found.mean[0], 9 * 25 / 26, rtol=1e-2)


@pytest.mark.parametrize("narrow", [0.31, 0.6])
def test_the_charged_variance_covers_where_the_history_is_right(narrow):
    rng = np.random.default_rng(2)
    for seconds in (1, 10, 30):
        own = 3.3**2 / seconds
        truth = rng.normal(0, narrow, (20_000, 3))
        estimate = truth + rng.normal(0, np.sqrt(own), truth.shape)
        found = mixture_posterior(estimate, own, 0.0, narrow**2, 25.0)
        covered = np.mean(np.abs(found.mean - truth) <= 1.96 * np.sqrt(found.charged))
        assert 0.945 < covered < 0.97


def test_the_mean_ratio_exceeds_its_limit_as_seldom_as_it_says():
    """Looked at after every half second of 30 s; where the history holds, 1 in 20 at most."""
    rng = np.random.default_rng(3)
    bias, worst = rng.normal(0, 0.31, (4000, 3)), np.full(4000, -np.inf)
    sums = np.zeros_like(bias)
    for block in range(1, 61):
        sums += bias + rng.normal(0, 3.3 / np.sqrt(0.5), bias.shape)
        ratios = log_ratios(sums / block, 3.3**2 / (block / 2), 0.31**2, 25.0)
        worst = np.maximum(worst, log_e(ratios))
    assert np.mean(worst > np.log(20)) <= 0.05
