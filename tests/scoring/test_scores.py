"""Squares, intervals, equivalent times, figures of merit, and checks of estimators."""

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
from scipy import stats

from gyro_pipeline.conventions import ALL, BEST, DISJOINT, FIRST, LAST, PAPER, TRUE
from gyro_pipeline.scoring import scores as scoring
from gyro_pipeline.scoring.scorer import read_scores

PLAIN = np.ones((1, 1))


def errors_table(*rows):
    columns = ["recording", "window", "truth", "error_dps", "truth_variance"]
    return pd.DataFrame(rows, columns=columns)


def squares(values):
    """Of recordings whose every error is squared and summed: shape (recordings, errors)."""
    values = np.atleast_2d(np.asarray(values, float))
    return scoring.SquaredErrors((values**2).sum(axis=1), np.full(len(values), values.shape[1]))


def curve_of(times_s, rmse, recordings=1):
    sums = np.tile(np.square(rmse), (recordings, 1))
    squares = scoring.SquaredErrors(sums, np.ones_like(sums))
    weights = scoring.leave_one_out(recordings)
    return scoring.WeightedCurve.of(np.array(times_s, float), squares, weights)


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
    everything = scoring.squared_errors(table, PAPER, ALL)
    assert everything.sums.tolist() == [4, 10]  # in order of recording
    assert everything.counts.tolist() == [1, 2]
    assert scoring.squared_errors(table, PAPER, FIRST).sums.tolist() == [4, 9]
    disjoint = scoring.squared_errors(table, DISJOINT, ALL)
    np.testing.assert_allclose(disjoint.sums, [3.5 + 0.01 - 0.5, 0.5])
    assert scoring.squared_errors(table, TRUE, FIRST).sums.tolist() == [49]


def test_of_several_devices_whole_devices_are_resampled_and_else_recordings():
    table = errors_table((1, 0, PAPER, 1.0, 0), (2, 0, PAPER, 2.0, 0), (1, 0, PAPER, 3.0, 0))
    one, several = table.assign(imu=2), table.assign(imu=[2, 2, 3])
    assert scoring.squared_errors(one, PAPER, ALL).sums.tolist() == [1 + 9, 4]
    assert scoring.squared_errors(several, PAPER, ALL).sums.tolist() == [1 + 4, 9]
    curve = several.rename(columns={"error_dps": "sum_sq"})
    curve = curve.assign(time_s=1.0, windows=ALL, count=3)
    by_device = scoring.weighted_curve(curve, PAPER, ALL, np.eye(2))
    np.testing.assert_allclose(by_device.rmse**2, [[3 / 6], [3 / 3]])
    by_recording = scoring.weighted_curve(curve.assign(imu=2), PAPER, ALL, np.eye(2))
    np.testing.assert_allclose(by_recording.rmse**2, [[4 / 6], [2 / 3]])


def test_a_curve_is_of_one_truth_and_of_the_chosen_windows():
    rows = [
        (5, PAPER, ALL, 2.0, 1.0, 3),
        (5, PAPER, ALL, 1.0, 4.0, 6),
        (3, PAPER, ALL, 1.0, 8.0, 6),
        (3, PAPER, ALL, 2.0, 5.0, 3),
        (3, PAPER, FIRST, 1.0, 70.0, 3),
        (3, TRUE, ALL, 1.0, 90.0, 3),
    ]
    columns = ["recording", "truth", "windows", "time_s", "sum_sq", "count"]
    weights = scoring.leave_one_out(2)
    curve = scoring.weighted_curve(pd.DataFrame(rows, columns=columns), PAPER, ALL, weights)
    assert curve.times_s.tolist() == [1, 2]
    np.testing.assert_allclose(curve.rmse**2, [[12 / 12, 6 / 6], [4 / 6, 1 / 3], [8 / 6, 5 / 3]])
    assert curve.counts.tolist() == [12, 6]


def test_an_interval_is_that_of_students_t_where_recordings_weigh_alike():
    values = np.random.default_rng(0).normal(3, 1, 12)
    weights = scoring.leave_one_out(12)
    found = scoring.with_interval(scoring.SquaredErrors(values, np.ones(12)).mean(weights))
    expected = stats.ttest_1samp(values, 0).confidence_interval(0.95)
    np.testing.assert_allclose([found.value, found.lo, found.hi], [values.mean(), *expected])
    squares_of = np.exp(scoring.SquaredErrors(values, np.ones(12)).mean(weights))
    of_logarithm = scoring.with_interval(squares_of, positive=True)
    np.testing.assert_allclose([of_logarithm.lo, of_logarithm.hi], np.exp([found.lo, found.hi]))
    wide, narrow = scoring.with_interval(squares_of, 99), scoring.with_interval(squares_of, 90)
    assert wide.lo < narrow.lo < narrow.hi < wide.hi


def test_what_is_not_finite_and_a_single_recording_carry_no_interval():
    single = scoring.with_interval(squares([[3.0, 4.0]]).mean(scoring.leave_one_out(1)))
    assert (single.value, single.lo, single.hi) == (12.5, None, None)
    for values in ([1.0, np.inf, 2.0], [1.0, 0.0, 2.0]):
        assert scoring.with_interval(np.array(values), positive=True).lo is None


def test_intervals_cover_although_windows_of_a_recording_are_alike():
    """Ten windows repeat their recording's error: an interval over windows would cover 45 %."""
    generator, covered, studies = np.random.default_rng(8), 0, 400
    for _ in range(studies):
        errors = np.repeat(generator.normal(size=(20, 1)), 10, axis=1)
        rmse = np.sqrt(squares(errors).mean(scoring.leave_one_out(20)))
        found = scoring.with_interval(rmse, positive=True)
        covered += found.lo <= 1 <= found.hi
    assert 0.92 < covered / studies < 0.98  # 91 % by the percentile bootstrap


def test_equivalent_time_by_hand():
    for level, time_s in (
        (6.0, 1.5),  # half-way from 8 to 4
        (4.0, 2.0),  # a point of the curve
        (2.5, 3.0),  # half-way from 4 to 1
        (1.0, 4.0),
        (0.9, np.inf),  # never reached
        (8.0, -np.inf),  # as good from the start: the curve cannot tell since when
    ):
        curve = curve_of([1, 2, 4], [8, 4, 1])
        assert curve.equivalent_time(2.0, np.array([level])).value == pytest.approx(time_s)


def test_a_rough_curve_is_made_to_fall_so_that_the_mean_saves_no_time_on_itself():
    rough = scoring.WeightedCurve(np.arange(1.0, 7), np.array([[9, 3, 5, 6, 2, 1.0]]), np.ones(6))
    assert (np.diff(rough.falling) < 0).all()
    pooled = np.sqrt((9 + 25 + 36) / 3)  # of the second to the fourth, in whose middle it stands
    np.testing.assert_allclose(rough.falling[[0, 2, 4, 5]], [9, pooled, 2, 1])
    for window_s, rmse in ((2.0, 3.0), (3.0, 5.0), (4.0, 6.0)):
        assert rough.equivalent_time(window_s, np.array([rmse])).value == pytest.approx(window_s)


def test_one_recording_by_hand():
    curve = curve_of([1, 2, 5, 10, 20], [8, 5**0.5, 2, 1, 0.5])
    errors, of_mean = squares([[0.6, 0.8, 0.5**0.5, 0.5**0.5]]), squares([[3, 1]])
    scores = scoring.score(errors, of_mean, curve, 2.0, PLAIN)
    # RMSE sqrt(2 / 4) against sqrt(10 / 2); the curve falls from 1 to 0.5 between 10 and 20 s
    rmse, mean = np.sqrt(0.5), np.sqrt(5)
    time_s = 10 + 10 * (1 - rmse) / 0.5
    values = {name: estimate.value for name, estimate in scores.items()}
    expected = {"test_mse_dps2": 0.5, "test_rmse_dps": rmse, "mean_rmse_dps": mean}
    expected |= {"equivalent_time_s": time_s, "time_saving_pct": 100 * (1 - 2 / time_s)}
    assert values == pytest.approx(expected | {"accuracy_gain_pct": 100 * (1 - rmse / mean)})
    assert all(estimate.lo is None and estimate.hi is None for estimate in scores.values())
    for wrong, off in ((9.0, -np.inf), (0.1, np.inf)):  # off the curve
        scores = scoring.score(squares([wrong]), squares([2.0]), curve, 5.0, PLAIN)
        assert scores["equivalent_time_s"].value == scores["time_saving_pct"].value == off
        assert scores["accuracy_gain_pct"].value == pytest.approx(100 * (1 - wrong / 2))


def test_intervals_hold_the_value_and_pair_the_estimator_with_the_mean():
    generator = np.random.default_rng(1)
    mean = np.exp(generator.normal(size=(25, 1)))  # errors differ much by recording
    curve = curve_of([1, 2, 5, 10], [9, 3, 1, 0.1], recordings=25)
    weights = scoring.leave_one_out(25)
    scores = scoring.score(squares(0.5 * mean), squares(mean), curve, 2.0, weights)
    rmse = scores["test_rmse_dps"]
    assert rmse.lo < 0.8 * rmse.value < 1.2 * rmse.value < rmse.hi
    # Half the error in every recording is half of it whichever are left out.
    gain = scores["accuracy_gain_pct"]
    np.testing.assert_allclose([gain.lo, gain.value, gain.hi], 50)
    saving, time = scores["time_saving_pct"], scores["equivalent_time_s"]
    for end in ("lo", "value", "hi"):
        assert getattr(saving, end) == pytest.approx(100 * (1 - 2 / getattr(time, end)))


def test_without_a_positive_square_there_is_no_root_and_nothing_is_clipped():
    table = errors_table(*((r, 0, DISJOINT, 0.1 * r, 0.2) for r in range(1, 6)))
    negative, sure = scoring.squared_errors(table, DISJOINT, ALL), squares(np.ones((5, 1)))
    uncertain = scoring.SquaredErrors(np.array([1.0, -0.9, 1.0, -0.9, 0]), np.ones(5), exact=False)
    weights = scoring.leave_one_out(5)
    curve = curve_of([1, 2], [2, 1], recordings=5)
    scores = scoring.score(negative, replace(sure, exact=False), curve, 1.0, weights)
    assert set(scores) == {"test_mse_dps2"}
    mse = scores["test_mse_dps2"]
    assert mse.value == pytest.approx(np.mean([0.01, 0.04, 0.09, 0.16, 0.25]) - 0.2)
    assert mse.lo < mse.value < mse.hi
    for pair in ((uncertain, sure), (replace(sure, exact=False), uncertain)):
        assert set(scoring.score(*pair, curve, 1.0, weights)) == {"test_mse_dps2"}
    assert "test_rmse_dps" in scoring.score(sure, sure, curve, 1.0, weights)


def test_the_check_is_one_sided_and_counts_every_recording_once():
    generator = np.random.default_rng(0)
    a, b = (squares(generator.normal(size=(40, 6))) for _ in range(2))
    assert scoring.beats_oracle(a, b) + scoring.beats_oracle(b, a) == pytest.approx(1)
    ten_windows_each = scoring.SquaredErrors(10 * a.sums, 10 * a.counts)
    assert scoring.beats_oracle(ten_windows_each, b) == pytest.approx(scoring.beats_oracle(a, b))
    better = scoring.SquaredErrors(0.5 * b.sums, b.counts)
    assert scoring.beats_oracle(better, b) < 1e-6
    assert scoring.beats_oracle(b, better) > 0.999
    assert scoring.beats_oracle(b, b) == 1


def test_holm_by_hand():
    # in order 0.005 * 4, 0.01 * 3, 0.03 * 2, and 0.04 * 1, raised to the one before
    np.testing.assert_allclose(scoring.holm([0.01, 0.04, 0.03, 0.005]), [0.03, 0.06, 0.06, 0.02])
    np.testing.assert_allclose(scoring.holm([0.7, 0.6]), [1.0, 1.0])
    np.testing.assert_allclose(scoring.holm([0.02]), [0.02])


def test_a_difference_is_paired_over_recordings():
    generator = np.random.default_rng(3)
    hard = generator.uniform(0.1, 10, (30, 1))  # what makes a recording hard for both
    worse = squares(hard * [1.1, -1.1])
    better, weights = squares(hard * [1, -1]), scoring.leave_one_out(30)
    less = scoring.paired_difference(better, worse, weights, root=True)
    whole = np.sqrt((hard**2).mean())
    assert less.value == pytest.approx(-0.1 * whole)
    assert -0.15 * whole < less.lo < less.value < less.hi < -0.05 * whole
    own = scoring.paired_difference(worse, worse, weights, root=True)
    assert own.value == own.lo == own.hi == 0
    square = scoring.paired_difference(better, worse, weights, 99)
    assert square.value == pytest.approx((1 - 1.1**2) * (hard**2).mean())
    assert square.lo < square.value < square.hi < 0
    gain = scoring.gain_difference(better, worse, squares(2 * hard), weights)
    np.testing.assert_allclose([gain.lo, gain.value, gain.hi], 5)  # points, of each recording alike


def test_a_prior_that_test_recordings_contradict_is_found_and_others_are_not():
    generator = np.random.default_rng(5)
    trained, tested = generator.normal(0, 1, (1000, 12, 3)), generator.normal(0, 1, (1000, 6, 3))
    pairs = zip(trained, tested, strict=True)
    chances = np.array([scoring.prior_conflict(*pair) for pair in pairs])
    for level in (0.01, 0.05, 0.5):
        assert (chances < level).mean() == pytest.approx(level, abs=0.015)
    turned = scoring.prior_conflict(trained[0], tested[0] + [-6, 6, 0])
    assert (turned[:2] < 1e-3).all()
    assert turned[2] == chances[0, 2]
    alone = scoring.prior_conflict(trained[0, :1], tested[0])
    assert (alone == 1).all()  # one recording has no scatter


def test_coverage_counts_the_errors_within_the_stated_deviations():
    table = errors_table(*((1, 0, PAPER, error, 0.0) for error in (0.5, -0.9, 1.5, 3.0)))
    table = pd.concat([table, table.assign(truth=TRUE, error_dps=0.0)])
    table["sigma_dps"] = 1.0
    assert scoring.coverage(table, PAPER, 1) == 0.5
    assert scoring.coverage(table, PAPER, 2) == 0.75
    assert scoring.coverage(table, TRUE, 1) == 1
    assert np.isnan(scoring.coverage(table.assign(sigma_dps=np.nan), PAPER, 1))


def test_stored_scores_are_read_by_truth_and_epoch():
    rows = [
        (LAST, PAPER, ALL, "a", 1.0, 0.5, 1.5),
        (LAST, PAPER, FIRST, "a", 2.0, None, np.nan),
        (BEST, PAPER, ALL, "a", 3.0, None, None),
        (LAST, TRUE, ALL, "a", 4.0, None, None),
    ]
    columns = ["weights", "truth", "windows", "score", "value", "lo", "hi"]
    table, estimate = pd.DataFrame(rows, columns=columns), scoring.Estimate
    assert read_scores(table) == {("a", ALL): estimate(1, 0.5, 1.5), ("a", FIRST): estimate(2)}
    assert read_scores(table, epoch=BEST) == {("a", ALL): estimate(3)}
    assert read_scores(table, truth=TRUE) == {("a", ALL): estimate(4)}


def test_an_interval_lies_above_another_only_entirely():
    for gain, ceiling, above in (
        ((70, 66, 74), (60, 55, 65), True),
        ((70, 64, 74), (60, 55, 65), False),
        ((70, 66, 74), (60, None, None), True),
        ((70, np.nan, np.nan), (60, 55, 65), False),
        ((70, None, None), (60, 55, 65), False),
        ((70, 66, 74), (np.nan, np.nan, np.nan), False),
    ):
        assert scoring.Estimate(*gain).lies_above(scoring.Estimate(*ceiling)) is above, gain
