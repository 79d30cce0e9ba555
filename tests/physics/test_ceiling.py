"""The ceiling in closed form against simulation and known figures, and the turn-on spread."""

import numpy as np
import pytest

from gyro_pipeline.conventions import DISJOINT, MDPS, PAPER, TRUE, InputError
from gyro_pipeline.physics import ceiling as limits

N = 5 * MDPS
T = 87.0
MU = 20 * MDPS
DRAWS = 200_000


@pytest.mark.parametrize(("r", "q"), [(0.05, 0.05), (10 / 87, 0.1), (0.5, 10.0)])
def test_monte_carlo_agrees_with_the_closed_forms(r, q):
    generator = np.random.default_rng([int(1000 * r), int(1000 * q)])
    window = r * T
    tau = np.sqrt(q * N**2 / window)
    bias = generator.normal(MU, tau, DRAWS)
    inside = bias + generator.normal(0, N / np.sqrt(window), DRAWS)
    outside = bias + generator.normal(0, N / np.sqrt(T - window), DRAWS)
    aims = {PAPER: r * inside + (1 - r) * outside, DISJOINT: outside, TRUE: bias}
    for truth, aim in aims.items():
        own_noise = N**2 / (T - window) if truth == DISJOINT else 0.0
        best = limits.oracle(inside, MU, tau, N, window, T, truth)
        for estimate, expected in (
            (best, limits.ceiling_rmse(N, tau, window, T, truth)),
            (inside, limits.running_mean_rmse(N, window, T, truth)),
        ):
            rmse = np.sqrt(np.mean((estimate - aim) ** 2) - own_noise)
            assert rmse == pytest.approx(expected, rel=0.01)


def test_known_ceilings_at_ten_seconds_without_turn_on_spread():
    for recording_s, saving, gain in ((87, 78, 66), (120, 84, 71), (65, 72, 61), (52, 65, 56)):
        ceiling = limits.ceiling_rmse(N, 0.0, 10, recording_s, PAPER)
        rho = ceiling / limits.running_mean_rmse(N, 10, recording_s, PAPER)
        assert round(100 * limits.best_saving(rho, 10 / recording_s).item()) == saving
        assert round(100 * limits.best_gain(rho).item()) == gain


def test_turn_on_spread_by_hand_counts_present_recordings_only():
    means = np.array([[1.0, 0.0], [3.0, 0.0], [np.nan, 1.0], [5.0, 1.0]])
    # sample variances 4 and 1/3, averaging noise 2^2 / 4
    np.testing.assert_allclose(limits.turn_on_spread(means, 2.0**2 / 4), [np.sqrt(3.0), 0.0])
    with pytest.raises(InputError, match="at least 2 recordings"):
        limits.turn_on_spread(means[1:3], N**2 / T)
    assert limits.pooled([3.0, 4.0, 5.0]) == pytest.approx(np.sqrt(50 / 3))
    with pytest.raises(InputError, match="expected 'paper', 'disjoint' or 'true', got 'mean'"):
        limits.running_mean_rmse(N, 10, T, "mean")


def test_draws_of_the_spread_hold_it_as_often_as_they_say():
    """Of 11 recordings, with little averaging noise, jointly over axes as well."""
    generator, tau = np.random.default_rng(2), np.array([1.0, 2.0, 3.0])
    held = []
    for _ in range(300):
        means = generator.normal(0, np.hypot(tau, 0.5), (11, 3))
        draws = limits.spread_draws(means, 0.25, 200)
        lo, hi = np.percentile(draws, [2.5, 97.5], axis=0)
        held.append((lo <= tau) & (tau <= hi))
    np.testing.assert_allclose(np.mean(held, axis=0), 0.95, atol=0.04)
    joint = limits.joint_draws(means, np.full(3, 0.25), 200)
    np.testing.assert_allclose(joint[0], np.cov(means.T) - 0.25 * np.eye(3), atol=0.3)
    assert (np.linalg.eigvalsh(joint) > -1e-9).all()
    assert np.median(joint[1:, 2, 2]) == pytest.approx(np.median(draws[:, 2] ** 2), rel=0.4)
