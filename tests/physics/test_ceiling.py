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


def test_axes_are_pooled_and_an_unknown_truth_is_refused():
    assert limits.pooled([3.0, 4.0, 5.0]) == pytest.approx(np.sqrt(50 / 3))
    with pytest.raises(InputError, match="expected 'paper', 'disjoint' or 'true', got 'mean'"):
        limits.running_mean_rmse(N, 10, T, "mean")
