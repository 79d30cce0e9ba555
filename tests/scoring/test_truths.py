"""Truths of test recordings, errors against them, and the curve of the running mean."""

import math

import numpy as np
import pytest

from gyro_pipeline.conventions import ALL, DISJOINT, FIRST, PAPER, TRUE
from gyro_pipeline.physics.allan import NoiseFigures
from gyro_pipeline.physics.noise import simulate_noise
from gyro_pipeline.scoring import truths
from gyro_pipeline.windows import usable_starts

RATE_HZ, NOISE = 8.0, np.array([1.0, 2.0, 3.0])
FIGURES = tuple(NoiseFigures(white, 0.0, 0.0) for white in NOISE)
BIAS = np.array([5.0, -4.0, 0.5])


def recording(n=47, seed=0, true_bias=BIAS, offset=0.0, masked=()):
    samples = np.random.default_rng(seed).normal(BIAS[:, None], 1.0, (3, n)) + offset
    samples[:, list(masked)] = np.nan
    return truths.TestRecording(7, samples, RATE_HZ, FIGURES, true_bias, 2, np.array([0, 10]))


def of(samples, figures=FIGURES, rate_hz=RATE_HZ, true_bias=None, tested=(0,)):
    return truths.TestRecording(4, samples, rate_hz, figures, true_bias, 1, np.array(tested))


def brute_force(one, size, starts):
    """Window means and each truth, one window at a time."""
    n = one.samples.shape[1]
    inside = [np.arange(start, start + size) for start in starts]
    means = np.array([np.nanmean(one.samples[:, part], axis=1) for part in inside])
    found = {PAPER: np.tile(np.nanmean(one.samples, axis=1), (len(starts), 1)), TRUE: one.true_bias}
    if size < n:
        rest = [np.delete(one.samples, part, axis=1) for part in inside]
        found[DISJOINT] = np.array([np.nanmean(samples, axis=1) for samples in rest])
    return means, found


@pytest.mark.parametrize("masked", [(), (3, 30, 31)])
@pytest.mark.parametrize(("size", "starts"), [(1, [0, 46]), (10, [0, 7, 25, 37]), (46, [0, 1])])
def test_truths_are_those_of_brute_force_wherever_the_windows_are(size, starts, masked):
    one, starts = recording(masked=masked), np.array(starts)
    means, expected = brute_force(one, size, starts)
    np.testing.assert_allclose(one.window_means(starts, size), means, atol=1e-12)
    found = one.truths(starts, size)
    assert set(found) == set(expected)
    for truth, (value, _) in found.items():
        np.testing.assert_allclose(value - expected[truth], 0, atol=1e-12)


@pytest.mark.parametrize("figures", [NoiseFigures(1, 0, 0), NoiseFigures(1, 1, 0.5)])
def test_the_disjoint_variance_is_what_that_truth_scatters_by(figures):
    given = np.random.default_rng(4), (1000, 3, 48), RATE_HZ, np.full(3, figures.white)
    colour = {"flicker_dps": figures.instability, "random_walk_dps_rts": figures.random_walk}
    noise = simulate_noise(*given, **colour)
    starts = np.array([0, 16, 32])
    found = [of(one, 3 * (figures,)).truths(starts, 16)[DISJOINT] for one in noise]
    scatter = np.array([value for value, _ in found]).var(axis=(0, 2))
    np.testing.assert_allclose(scatter, found[0][1][:, 0], rtol=0.1)
    walks = figures.random_walk > 0
    assert (scatter[0] > 1.2 * scatter[2]) == walks  # what comes later has walked further


def test_sums_are_in_double_precision():
    samples = np.random.default_rng(0).normal(3, 0.05, (3, 13_000)).astype(np.float32)
    exact = [math.fsum(axis) / 13_000 for axis in samples.astype(float)]
    found = of(samples).truths(np.array([0]), 1000)[PAPER][0][0]
    np.testing.assert_allclose(found, exact, rtol=1e-13)


def test_error_table_by_hand():
    samples = np.array([[1.0, 3, 5, 7, 100], [0, 0, 0, 0, 5], [2, 2, 2, 2, 2]])
    one = of(samples, rate_hz=2.0, true_bias=np.array([1.0, 1, 1]), tested=(0, 3))
    estimates, sigma = np.array([[2.0, 0, 2], [6, 1, 3]]), np.arange(6.0).reshape(2, 3)
    known = one.truths(one.starts, 2).items()
    table = truths.stack_columns(
        [truths.error_columns(one, *each, estimates, sigma) for each in known]
    )
    assert (set(table.imu), set(table.recording)) == ({1}, {4})
    assert len(table) == 3 * 2 * 3
    shown = table.set_index(["truth", "window", "axis"]).sort_index()
    assert shown.loc[(PAPER, 0, "x"), "error_dps"] == pytest.approx(2 - 116 / 5)
    assert shown.loc[(PAPER, 1, "x"), "error_dps"] == pytest.approx(6 - 116 / 5)
    assert shown.loc[(DISJOINT, 0, "x"), "error_dps"] == pytest.approx(2 - 112 / 3)
    assert shown.loc[(DISJOINT, 1, "x"), "error_dps"] == pytest.approx(6 - 9 / 3)
    assert shown.loc[(TRUE, 1, "z"), "error_dps"] == pytest.approx(2)
    assert shown.loc[(DISJOINT, 1, "y"), "truth_variance"] == pytest.approx(4 * 2 / 3)
    assert shown.loc[(PAPER, 1, "y"), "truth_variance"] == 0
    assert shown.loc[(TRUE, 1, "y"), "sigma_dps"] == 4
    assert shown.loc[(PAPER, 1)].start.tolist() == [3, 3, 3]


def view(curve, truth, windows):
    return curve[(curve.truth == truth) & (curve.windows == windows)].set_index("time_s")


@pytest.mark.parametrize("masked", [(), (3, 30, 31)])
def test_the_curve_is_that_of_brute_force(masked):
    one = recording(masked=masked)
    curve = truths.running_mean_curve(one, 11)
    lengths = sorted({*range(2, 47, 2), 11, 47})  # every 0.25 s, the study's window and the whole
    for truth in (PAPER, DISJOINT, TRUE):
        shown = [n for n in lengths if truth != DISJOINT or n <= 0.75 * 47]
        first, everything = (view(curve, truth, windows) for windows in (FIRST, ALL))
        np.testing.assert_allclose(first.index, np.array(shown) / RATE_HZ)
        np.testing.assert_allclose(everything.index, np.array(shown) / RATE_HZ)
        for row, length in enumerate(shown):
            starts = usable_starts(one.masked, length)
            means, expected = brute_force(one, length, starts)
            squares = (means - expected[truth]) ** 2
            if truth == DISJOINT:
                squares -= NOISE**2 * RATE_HZ / (47 - length)
            assert everything.sum_sq.iloc[row] == pytest.approx(squares.sum(), abs=1e-10)
            assert everything["count"].iloc[row] == 3 * len(starts)
            assert first.sum_sq.iloc[row] == pytest.approx(squares[0].sum(), abs=1e-10)
            assert first["count"].iloc[row] == 3
    assert (set(curve.imu), set(curve.recording)) == ({2}, {7})
