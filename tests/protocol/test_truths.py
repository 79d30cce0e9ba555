import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gyro_pipeline.conventions import ALL, AXES, DISJOINT, FIRST, PAPER, TRUE
from gyro_pipeline.physics.allan import NoiseFigures
from gyro_pipeline.physics.ceiling import running_mean_rmse
from gyro_pipeline.physics.noise import simulate_noise
from gyro_pipeline.protocol import truths

RATE_HZ, NOISE = 8.0, np.array([1.0, 2.0, 3.0])
FIGURES = tuple(NoiseFigures(white, 0.0, 0.0) for white in NOISE)
BIAS = np.array([5.0, -4.0, 0.5])


def recording(n=47, seed=0, true_bias=BIAS, offset=0.0, number=7, masked=()):
    samples = np.random.default_rng(seed).normal(BIAS[:, None], 1.0, (3, n)) + offset
    samples[:, list(masked)] = np.nan
    return truths.TestRecording(number, samples, RATE_HZ, FIGURES, true_bias)


def error_table(one, size, estimates):
    """Errors against all truths."""
    stated = np.full(estimates.shape, np.nan)
    known = one.truths(size).items()
    return truths.stacked([truths.error_columns(one, *each, estimates, stated) for each in known])


def brute_force(one, size):
    """Window means and each truth, one window and axis at a time, of windows with 90 % there."""
    n = one.samples.shape[1]
    means, found = [], {PAPER: [], TRUE: []} | ({DISJOINT: []} if size < n else {})
    for k in range(n // size):
        inside = np.arange(k * size, (k + 1) * size)
        if np.isnan(one.samples[0, inside]).mean() > 0.1:
            continue
        means.append([np.nanmean(axis[inside]) for axis in one.samples])
        found[PAPER].append([np.nanmean(axis) for axis in one.samples])
        if size < n:
            found[DISJOINT].append([np.nanmean(np.delete(axis, inside)) for axis in one.samples])
        found[TRUE].append(list(one.true_bias))
    return np.array(means), {truth: np.array(values) for truth, values in found.items()}


@pytest.mark.parametrize("masked", [(), (3, 30, 31)])  # 2 of 10 in the fourth window of 10
@pytest.mark.parametrize("size", [1, 10, 23, 46])
def test_truths_are_those_of_brute_force(size, masked):
    one = recording(masked=masked)
    means, expected = brute_force(one, size)
    np.testing.assert_allclose(one.window_means(size), means, atol=1e-12)
    found = one.truths(size)
    assert set(found) == set(expected)
    for truth, (value, _) in found.items():
        np.testing.assert_allclose(value, expected[truth], atol=1e-12)


def test_only_the_disjoint_truth_has_a_variance_of_its_own():
    found = recording().truths(10)
    np.testing.assert_allclose(found[DISJOINT][1], 4 * [NOISE**2 / ((47 - 10) / RATE_HZ)])
    for truth in (PAPER, TRUE):
        assert not found[truth][1].any()


def test_the_disjoint_variance_is_what_that_truth_scatters_by():
    # White noise of N around a known bias: the running mean must come out at N / sqrt(T0).
    generator, size = np.random.default_rng(3), 16
    squares = []
    for _ in range(1500):
        samples = generator.normal(0, NOISE[:, None] * np.sqrt(RATE_HZ), (3, 48))
        one = truths.TestRecording(1, samples, RATE_HZ, FIGURES, None)
        value, variance = one.truths(size)[DISJOINT]
        squares.append((one.window_means(size) - value) ** 2 - variance)
    expected = running_mean_rmse(NOISE, size / RATE_HZ, 48 / RATE_HZ, DISJOINT) ** 2
    # 4500 squares have a standard error of 2 %; leaving the variance out would be 50 % off
    np.testing.assert_allclose(np.mean(squares, axis=(0, 1)), expected, rtol=0.1)


def test_the_disjoint_variance_of_coloured_noise_is_what_that_truth_scatters_by():
    figures = NoiseFigures(1.0, 1.0, 0.5)
    noise = simulate_noise(
        np.random.default_rng(4),
        (4000, 3, 48),
        RATE_HZ,
        np.full(3, figures.white),
        flicker_dps=figures.instability,
        random_walk_dps_rts=figures.random_walk,
    )
    found = [
        truths.TestRecording(1, one, RATE_HZ, 3 * (figures,), None).truths(16) for one in noise
    ]
    values = np.array([one[DISJOINT][0] for one in found])  # (recordings, windows, axes)
    scatter = values.var(axis=(0, 2))
    np.testing.assert_allclose(scatter, found[0][DISJOINT][1][:, 0], rtol=0.05)
    assert scatter[0] > 1.2 * scatter[2]  # what comes later has walked further


def test_a_window_of_the_whole_recording_has_nothing_outside():
    assert set(recording().truths(47)) == {PAPER, TRUE}


def test_measured_recordings_have_no_true_bias():
    assert set(recording(true_bias=None).truths(10)) == {PAPER, DISJOINT}


def test_sums_are_in_double_precision():
    samples = np.random.default_rng(0).normal(3, 0.05, (3, 13_000)).astype(np.float32)
    one = truths.TestRecording(1, samples, RATE_HZ, FIGURES, None)
    exact = [math.fsum(axis) / 13_000 for axis in samples.astype(float)]
    np.testing.assert_allclose(one.truths(1000)[PAPER][0][0], exact, rtol=1e-13)


def test_error_table_by_hand():
    samples = np.array([[1.0, 3, 5, 7, 100], [0, 0, 0, 0, 5], [2, 2, 2, 2, 2]])
    one = truths.TestRecording(4, samples, 2.0, FIGURES, np.array([1.0, 1, 1]))
    estimates = np.array([[2.0, 0, 2], [6, 1, 3]])
    table = error_table(one, 2, estimates)
    assert table.recording.unique().tolist() == [4]
    shown = table.set_index(["truth", "window", "axis"])
    whole = 116 / 5
    assert shown.loc[(PAPER, 0, "x"), "error_dps"] == pytest.approx(2 - whole)
    assert shown.loc[(PAPER, 1, "x"), "error_dps"] == pytest.approx(6 - whole)
    assert shown.loc[(PAPER, 1, "y"), "error_dps"] == pytest.approx(1 - 1)
    assert shown.loc[(DISJOINT, 0, "x"), "error_dps"] == pytest.approx(2 - 112 / 3)
    assert shown.loc[(DISJOINT, 1, "x"), "error_dps"] == pytest.approx(6 - 104 / 3)
    assert shown.loc[(DISJOINT, 1, "z"), "error_dps"] == pytest.approx(1)
    assert shown.loc[(TRUE, 1, "y"), "error_dps"] == pytest.approx(0)
    assert shown.loc[(DISJOINT, 1, "y"), "truth_variance"] == pytest.approx(4 * 2 / 3)
    assert shown.loc[(PAPER, 1, "y"), "truth_variance"] == 0
    assert len(table) == 3 * 2 * 3


def view(curve, truth, windows):
    return curve[(curve.truth == truth) & (curve.windows == windows)].set_index("time_s")


def test_the_curve_is_that_of_brute_force():
    one = recording()
    curve = truths.running_mean_curve(one, 11)
    lengths = sorted({*range(2, 47, 2), 11, 47})  # every 0.25 s, the study's window and the whole
    for truth in (PAPER, DISJOINT, TRUE):
        shown = [n for n in lengths if truth != DISJOINT or n <= 0.75 * 47]
        first, everything = (view(curve, truth, windows) for windows in (FIRST, ALL))
        np.testing.assert_allclose(first.index, np.array(shown) / RATE_HZ)
        np.testing.assert_allclose(everything.index, np.array(shown) / RATE_HZ)
        for row, length in enumerate(shown):
            means, expected = brute_force(one, length)
            squares = (means - expected[truth]) ** 2
            if truth == DISJOINT:
                squares -= NOISE**2 * RATE_HZ / (47 - length)
            assert everything.sum_sq.iloc[row] == pytest.approx(squares.sum(), abs=1e-10)
            assert everything["count"].iloc[row] == 3 * (47 // length)
            assert first.sum_sq.iloc[row] == pytest.approx(squares[0].sum(), abs=1e-10)
            assert first["count"].iloc[row] == 3
    assert set(curve.recording) == {7}


@pytest.mark.parametrize("size", [9, 16, 47])
def test_a_point_of_the_curve_lies_exactly_at_the_window(size):
    one = recording()
    table = error_table(one, size, one.window_means(size))
    squares = table.error_dps[table.truth == PAPER] ** 2
    at_window = view(truths.running_mean_curve(one, size), PAPER, ALL).loc[size / RATE_HZ]
    assert at_window.sum_sq == pytest.approx(squares.sum(), rel=1e-12)
    assert at_window["count"] == len(squares)


def test_the_curve_ends_at_the_papers_truth_itself():
    curve = view(truths.running_mean_curve(recording(), 10), PAPER, FIRST)
    assert curve.index[-1] == 47 / RATE_HZ
    assert curve.sum_sq.iloc[-1] == pytest.approx(0, abs=1e-20)


@settings(max_examples=15, deadline=None)
@given(
    constant=st.floats(-1000, 1000),
    n=st.integers(12, 40),
    size=st.integers(1, 12),
    seed=st.integers(0, 99),
)
def test_a_constant_on_samples_and_truth_changes_no_error(constant, n, size, seed):
    one = recording(n, seed)
    shifted = recording(n, seed, true_bias=BIAS + constant, offset=constant)
    for make in (
        lambda r: error_table(r, size, r.window_means(size)).error_dps,
        lambda r: truths.running_mean_curve(r, size).sum_sq,
    ):
        np.testing.assert_allclose(make(shifted), make(one), atol=1e-8)


@settings(max_examples=10, deadline=None)
@given(axes=st.permutations(range(len(AXES))), seed=st.integers(0, 99))
def test_axes_do_not_mix(axes, seed):
    one = recording(30, seed)
    order = list(axes)
    swapped = truths.TestRecording(
        7, one.samples[order], RATE_HZ, tuple(FIGURES[i] for i in order), BIAS[order]
    )
    for truth, (value, variance) in one.truths(7).items():
        other, other_variance = swapped.truths(7)[truth]
        np.testing.assert_allclose(other, value[:, order], atol=1e-12)
        np.testing.assert_allclose(other_variance, variance[:, order])
