import numpy as np
import pandas as pd
import pytest

from gyro_pipeline.conventions import ALL, DISJOINT, FIRST, MDPS, PAPER, TRUE
from gyro_pipeline.physics.ceiling import best_gain, best_saving, ceiling_rmse, running_mean_rmse
from gyro_pipeline.protocol.scores import (
    Curve,
    SquaredErrors,
    beats_oracle,
    coverage,
    curve_errors,
    equivalent_time,
    holm,
    paired_difference,
    resampled_weights,
    rmse_difference,
    score,
    squared_errors,
    with_interval,
)

PLAIN = np.ones((1, 1))


def errors_table(*rows):
    columns = ["recording", "window", "truth", "error_dps", "truth_variance"]
    return pd.DataFrame(rows, columns=columns)


def squares(values):
    """Of recordings whose every error is squared and summed: shape (recordings, errors)."""
    values = np.atleast_2d(np.asarray(values, float))
    return SquaredErrors((values**2).sum(axis=1), np.full(len(values), values.shape[1]))


def curve_of(times_s, rmse, recordings=1):
    sums = np.tile(np.square(rmse), (recordings, 1))
    return Curve(np.array(times_s, float), SquaredErrors(sums, np.ones_like(sums)))


def scored(errors, mean_errors, curve, window_s, weights):
    """The scores with the curve resampled alike."""
    return score(errors, mean_errors, curve.of(weights), window_s, weights)


# squares


def test_squared_errors_by_hand():
    table = errors_table(
        (9, 0, PAPER, 3.0, 0.0),
        (9, 1, PAPER, -1.0, 0.0),
        (2, 0, PAPER, 2.0, 0.0),
        (2, 0, DISJOINT, 2.0, 0.5),
        (2, 1, DISJOINT, 0.1, 0.5),
        (9, 0, DISJOINT, 1.0, 0.5),
        (9, 0, TRUE, 7.0, 0.0),
    )
    everything = squared_errors(table, PAPER, ALL)
    assert everything.sums.tolist() == [4, 10]  # in order of recording
    assert everything.counts.tolist() == [1, 2]
    assert squared_errors(table, PAPER, FIRST).sums.tolist() == [4, 9]
    disjoint = squared_errors(table, DISJOINT, ALL)
    np.testing.assert_allclose(disjoint.sums, [3.5 + 0.01 - 0.5, 0.5])
    assert squared_errors(table, TRUE, FIRST).sums.tolist() == [49]


def test_signed_errors_are_never_averaged():
    table = errors_table((1, 0, PAPER, 1.0, 0), (1, 1, PAPER, -1.0, 0), (2, 0, PAPER, 1.0, 0))
    assert squared_errors(table, PAPER, ALL).mean(np.ones((1, 2))).tolist() == [1.0]


def test_recordings_weigh_by_their_squares():
    pooled = SquaredErrors(np.array([8.0, 3.0]), np.array([4, 1]))
    weights = np.array([[1, 1], [2, 0], [0, 2]])
    np.testing.assert_allclose(pooled.mean(weights), [11 / 5, 2, 3])


def test_of_several_devices_whole_devices_are_resampled_and_else_recordings():
    table = errors_table((1, 0, PAPER, 1.0, 0), (2, 0, PAPER, 2.0, 0), (1, 0, PAPER, 3.0, 0))
    one, several = table.assign(imu=2), table.assign(imu=[2, 2, 3])
    assert squared_errors(one, PAPER, ALL).sums.tolist() == [1 + 9, 4]
    assert squared_errors(several, PAPER, ALL).sums.tolist() == [1 + 4, 9]
    curve = several.rename(columns={"error_dps": "sum_sq"})
    curve = curve.assign(time_s=1.0, windows=ALL, count=3)
    assert curve_errors(curve, PAPER, ALL).squares.sums.tolist() == [[3], [3]]
    assert curve_errors(curve.assign(imu=2), PAPER, ALL).squares.sums.tolist() == [[4], [2]]


def test_curve_errors_choose_truth_and_windows():
    columns = ["recording", "truth", "windows", "time_s", "sum_sq", "count"]
    rows = [
        (5, PAPER, ALL, 2.0, 1.0, 3),
        (5, PAPER, ALL, 1.0, 4.0, 6),
        (3, PAPER, ALL, 1.0, 8.0, 6),
        (3, PAPER, ALL, 2.0, 5.0, 3),
        (3, PAPER, FIRST, 1.0, 70.0, 3),
        (3, TRUE, ALL, 1.0, 90.0, 3),
    ]
    curve = curve_errors(pd.DataFrame(rows, columns=columns), PAPER, ALL)
    assert curve.times_s.tolist() == [1, 2]
    assert curve.squares.sums.tolist() == [[8, 5], [4, 1]]
    assert curve.squares.counts.tolist() == [[6, 3], [6, 3]]
    np.testing.assert_allclose(curve.squares.mean(np.ones((1, 2))), [[1.0, 1.0]])


# intervals


def test_resamples_redraw_whole_recordings():
    weights = resampled_weights(20, 300, seed=4)
    assert weights.shape == (301, 20)
    assert (weights[0] == 1).all()
    assert (weights.sum(axis=1) == 20).all()
    assert weights[1:].std() == pytest.approx(np.sqrt(0.95), rel=0.05)  # multinomial
    np.testing.assert_array_equal(weights, resampled_weights(20, 300, seed=4))
    assert not np.array_equal(weights, resampled_weights(20, 300, seed=5))


def test_an_interval_holds_the_central_95_percent_of_the_resamples():
    found = with_interval(np.array([500.5, *np.random.default_rng(0).permutation(999)]))
    assert found.value == 500.5
    assert (found.lo, found.hi) == (24, 974)  # 24 of the 999 lie below, and 24 above


def test_infinite_resamples_are_ends_of_the_interval():
    found = with_interval(np.array([1.0, *[-np.inf] * 10, *range(80), *[np.inf] * 10]))
    assert (found.lo, found.hi) == (-np.inf, np.inf)


def test_a_single_recording_carries_no_interval():
    weights = resampled_weights(1, 500, seed=0)
    assert weights.tolist() == [[1]]
    found = with_interval(squares([[3.0, 4.0]]).mean(weights))
    assert (found.value, found.lo, found.hi) == (12.5, None, None)


def test_the_interval_covers_although_windows_of_a_recording_are_alike():
    # 10 windows repeat their recording's error: an interval over windows would cover about 45 %.
    generator, covered, studies = np.random.default_rng(8), 0, 400
    weights = resampled_weights(30, 400, seed=2)
    for _ in range(studies):
        errors = np.repeat(generator.normal(size=(30, 1)), 10, axis=1)
        found = with_interval(np.sqrt(squares(errors).mean(weights)))
        covered += found.lo <= 1 <= found.hi
    # The percentile bootstrap of 30 recordings falls a little short of 95 %.
    assert 0.82 < covered / studies < 0.98


# equivalent time

TIMES = np.array([1.0, 2.0, 4.0])


@pytest.mark.parametrize(
    ("level", "time_s"),
    [
        (6.0, 1.5),  # half-way from 8 to 4
        (4.0, 2.0),  # a point of the curve
        (2.5, 3.0),  # half-way from 4 to 1
        (1.0, 4.0),
        (0.9, np.inf),  # never reached
        (8.0, -np.inf),  # as good from the start: the curve cannot tell since when
        (9.0, -np.inf),
    ],
)
def test_equivalent_time_by_hand(level, time_s):
    curve = np.array([[8.0, 4.0, 1.0]])
    assert equivalent_time(TIMES, curve, np.array([level])).tolist() == pytest.approx([time_s])


def test_equivalent_time_is_the_first_of_several():
    curve = np.array([[8.0, 2.0, 5.0, 1.0]])
    times = np.array([1.0, 2.0, 3.0, 4.0])
    assert equivalent_time(times, curve, np.array([5.0])).tolist() == [1.5]


def test_equivalent_times_of_several_curves_do_not_mix():
    curves = np.array([[8.0, 4.0, 1.0], [1.0, 1.0, 1.0], [3.0, 3.0, 2.0], [9.0, 9.0, 9.0]])
    levels = np.array([6.0, 2.0, 2.5, 2.0])
    expected = [1.5, -np.inf, 3.0, np.inf]
    assert equivalent_time(TIMES, curves, levels).tolist() == expected


# figures of merit


def test_one_recording_by_hand():
    curve = curve_of([1, 2, 5, 10, 20], [8, 4, 2, 1, 0.5])
    scores = scored(squares([[0.6, 0.8, 0.5**0.5, 0.5**0.5]]), squares([[3, 1]]), curve, 2.0, PLAIN)
    # RMSE sqrt(2 / 4) against sqrt(10 / 2); the curve falls from 1 to 0.5 between 10 and 20 s
    rmse, mean = np.sqrt(0.5), np.sqrt(5)
    time_s = 10 + 10 * (1 - rmse) / 0.5
    values = {name: estimate.value for name, estimate in scores.items()}
    assert values == pytest.approx(
        {
            "test_mse_dps2": 0.5,
            "test_rmse_dps": rmse,
            "mean_rmse_dps": mean,
            "equivalent_time_s": time_s,
            "time_saving_pct": 100 * (1 - 2 / time_s),
            "accuracy_gain_pct": 100 * (1 - rmse / mean),
        }
    )
    assert all(estimate.lo is None and estimate.hi is None for estimate in scores.values())


def test_worse_than_the_mean_is_a_negative_saving_and_gain():
    scores = scored(squares([4.0]), squares([2.0]), curve_of([1, 2, 5], [8, 4, 2]), 5.0, PLAIN)
    assert scores["equivalent_time_s"].value == 2
    assert scores["time_saving_pct"].value == pytest.approx(-150)
    assert scores["accuracy_gain_pct"].value == pytest.approx(-100)


@pytest.mark.parametrize(("rmse", "off"), [(9.0, -np.inf), (0.5, np.inf)])
def test_off_the_curve_there_is_a_gain_but_no_time(rmse, off):
    scores = scored(squares([rmse]), squares([2.0]), curve_of([1, 2, 5], [8, 4, 2]), 5.0, PLAIN)
    assert scores["equivalent_time_s"].value == off
    assert scores["time_saving_pct"].value == off
    assert scores["accuracy_gain_pct"].value == pytest.approx(100 * (1 - rmse / 2))


def test_intervals_hold_the_value_and_pair_the_estimator_with_the_mean():
    generator = np.random.default_rng(1)
    mean = np.exp(generator.normal(size=(25, 1)))  # errors differ much by recording
    scores = scored(
        squares(0.5 * mean),
        squares(mean),
        curve_of([1, 2, 5, 10], [9, 3, 1, 0.1], recordings=25),
        2.0,
        resampled_weights(25, 400, seed=0),
    )
    rmse = scores["test_rmse_dps"]
    assert rmse.lo < 0.8 * rmse.value < 1.2 * rmse.value < rmse.hi
    # Half the error in every recording is half of it in every resample of them.
    gain = scores["accuracy_gain_pct"]
    np.testing.assert_allclose([gain.lo, gain.value, gain.hi], 50)
    saving, time = scores["time_saving_pct"], scores["equivalent_time_s"]
    for end in ("lo", "value", "hi"):
        assert getattr(saving, end) == pytest.approx(100 * (1 - 2 / getattr(time, end)))


N, TAU = 3.3 * MDPS, 0.31 * MDPS
WINDOW_S, RECORDING_S = 10.0, 87.0
RHO = ceiling_rmse(N, TAU, WINDOW_S, RECORDING_S, PAPER) / running_mean_rmse(
    N, WINDOW_S, RECORDING_S, PAPER
)


def test_on_the_closed_form_curve_the_ceiling_scores_its_closed_form():
    times_s = np.arange(0.25, RECORDING_S + 0.01, 0.25)
    curve = curve_of(times_s, running_mean_rmse(N, times_s, RECORDING_S, PAPER))
    mean = running_mean_rmse(N, WINDOW_S, RECORDING_S, PAPER)
    scores = scored(squares([RHO * mean]), squares([mean]), curve, WINDOW_S, PLAIN)
    saving = 100 * best_saving(RHO, WINDOW_S / RECORDING_S)
    assert scores["time_saving_pct"].value == pytest.approx(saving, abs=0.01)
    assert scores["accuracy_gain_pct"].value == pytest.approx(100 * best_gain(RHO))


def test_a_negative_mean_square_is_reported_not_clipped():
    table = errors_table(*((r, 0, DISJOINT, 0.1 * r, 0.2) for r in range(1, 6)))
    negative = squared_errors(table, DISJOINT, ALL)
    curve = curve_of([1, 2], [2, 1], recordings=5)
    weights = resampled_weights(5, 300, seed=0)
    scores = scored(negative, squares(np.ones((5, 1))), curve, 1.0, weights)
    assert set(scores) == {"test_mse_dps2"}
    mse = scores["test_mse_dps2"]
    assert mse.value == pytest.approx(np.mean([0.01, 0.04, 0.09, 0.16, 0.25]) - 0.2)
    assert mse.lo < mse.value < mse.hi
    assert mse.lo > -0.2  # no square can be less than zero before its truth's variance


def test_there_is_no_root_where_the_lower_end_is_negative():
    uncertain = SquaredErrors(np.array([1.0, -0.9, 1.0, -0.9]), np.ones(4))
    sure = squares(np.ones((4, 1)))
    curve, weights = curve_of([1, 2], [2, 1], 4), resampled_weights(4, 300, seed=0)
    scores = scored(uncertain, sure, curve, 1.0, weights)
    assert set(scores) == {"test_mse_dps2"}
    assert scores["test_mse_dps2"].lo < 0 < scores["test_mse_dps2"].value
    assert set(scored(sure, uncertain, curve, 1.0, weights)) == {"test_mse_dps2"}
    assert "test_rmse_dps" in scored(sure, sure, curve, 1.0, weights)


# the leak check


def test_the_check_is_one_sided_and_counts_every_recording_once():
    generator = np.random.default_rng(0)
    a, b = (squares(generator.normal(size=(40, 6))) for _ in range(2))
    assert beats_oracle(a, b) + beats_oracle(b, a) == pytest.approx(1)
    ten_windows_each = SquaredErrors(10 * a.sums, 10 * a.counts)
    assert beats_oracle(ten_windows_each, b) == pytest.approx(beats_oracle(a, b))
    better = SquaredErrors(0.5 * b.sums, b.counts)
    assert beats_oracle(better, b) < 1e-6
    assert beats_oracle(b, better) > 0.999
    assert beats_oracle(b, b) == 1


def test_holm_by_hand():
    # in order 0.005 * 4, 0.01 * 3, 0.03 * 2, and 0.04 * 1, raised to the one before
    np.testing.assert_allclose(holm([0.01, 0.04, 0.03, 0.005]), [0.03, 0.06, 0.06, 0.02])
    np.testing.assert_allclose(holm([0.7, 0.6]), [1.0, 1.0])
    np.testing.assert_allclose(holm([0.02]), [0.02])


# pairs of estimators, and stated standard deviations


def test_a_difference_is_paired_over_recordings():
    generator = np.random.default_rng(3)
    hard = generator.uniform(0.1, 10, (30, 1))  # what makes a recording hard for both
    worse = squares(hard * [1.1, -1.1])
    less = rmse_difference(squares(hard * [1, -1]), worse, resampled_weights(30, 500, 1))
    whole = np.sqrt((hard**2).mean())
    assert less.value == pytest.approx(-0.1 * whole)
    assert -0.15 * whole < less.lo < less.value < less.hi < -0.05 * whole
    own = rmse_difference(worse, worse, resampled_weights(30, 500, 1))
    assert own.value == own.lo == own.hi == 0
    square = paired_difference(squares(hard * [1, -1]), worse, resampled_weights(30, 500, 1), 99)
    assert square.value == pytest.approx((1 - 1.1**2) * (hard**2).mean())
    assert square.lo < square.value < square.hi < 0


def test_coverage_counts_the_errors_within_the_stated_deviations():
    errors = [0.5, -0.9, 1.5, 3.0]
    table = errors_table(*((1, w, PAPER, e, 0.0) for w, e in enumerate(errors)))
    table = pd.concat([table, table.assign(truth=TRUE, error_dps=0.0)])
    table["sigma_dps"] = 1.0
    assert coverage(table, PAPER, 1) == 0.5
    assert coverage(table, PAPER, 2) == 0.75
    assert coverage(table, TRUE, 1) == 1
    assert np.isnan(coverage(table.assign(sigma_dps=np.nan), PAPER, 1))
