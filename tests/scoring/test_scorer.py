"""Scores over a view of the test windows, and the table in which they are stored."""

import numpy as np
import pandas as pd
import pytest

from gyro_pipeline.conventions import ALL, BEST, FIRST, LAST, PAPER, TRUE
from gyro_pipeline.scoring.scorer import Scorer, read_scores
from gyro_pipeline.scoring.scores import Estimate, squared_errors


def errors_of(scale):
    """Two windows of three axes in each of five recordings; the first window errs half as much."""
    rows = [
        (r, w, axis, scale * factor * (0.5 if w == 0 else 1) * (1 + r / 10))
        for r in range(5)
        for w in (0, 1)
        for axis, factor in zip("xyz", (1, 2, 3), strict=True)
    ]
    table = pd.DataFrame(rows, columns=["recording", "window", "axis", "error_dps"])
    return table.assign(truth=PAPER, truth_variance=0.0)


@pytest.fixture
def scorer():
    rows = [
        (r, PAPER, windows, time_s, 1 / time_s, 1)
        for r in range(5)
        for windows in (FIRST, ALL)
        for time_s in (1.0, 10.0, 40.0)
    ]
    columns = ["recording", "truth", "windows", "time_s", "sum_sq", "count"]
    return Scorer(errors_of(1.0), pd.DataFrame(rows, columns=columns), 10.0)


def test_errors_are_compared_with_the_means_of_the_same_windows_and_axes(scorer):
    errors = errors_of(0.25)
    errors.loc[errors.window == 0, "error_dps"] *= 2  # A is 50 % in first windows
    errors.loc[(errors.window == 0) & (errors.axis == "y"), "error_dps"] = 0.0
    assert scorer.scores(errors_of(0.25), (PAPER, ALL))["accuracy_gain_pct"].value == 75
    gains = scorer.gains_by_axis(errors, (PAPER, FIRST))
    assert [gains[f"accuracy_gain_pct_{axis}"].value for axis in "xyz"] == [50, 100, 50]
    squares = squared_errors(errors_of(0.5), PAPER, ALL)
    reference = scorer.rmse_and_gain(squares, (PAPER, ALL))
    assert reference["accuracy_gain_pct"].value == pytest.approx(50)
    rmse = np.sqrt((errors_of(0.5).error_dps ** 2).mean())
    assert reference["rmse_dps"].value == pytest.approx(rmse)
    assert scorer.weights.shape == (6, 5)


def test_stored_scores_are_read_by_truth_and_epoch():
    rows = [
        (LAST, PAPER, ALL, "a", 1.0, 0.5, 1.5),
        (LAST, PAPER, FIRST, "a", 2.0, None, np.nan),
        (BEST, PAPER, ALL, "a", 3.0, None, None),
        (LAST, TRUE, ALL, "a", 4.0, None, None),
    ]
    columns = ["weights", "truth", "windows", "score", "value", "lo", "hi"]
    table = pd.DataFrame(rows, columns=columns)
    assert read_scores(table) == {("a", ALL): Estimate(1, 0.5, 1.5), ("a", FIRST): Estimate(2)}
    assert read_scores(table, epoch=BEST) == {("a", ALL): Estimate(3)}
    assert read_scores(table, truth=TRUE) == {("a", ALL): Estimate(4)}


@pytest.mark.parametrize(
    ("gain", "ceiling", "above"),
    [
        ((70, 66, 74), (60, 55, 65), True),
        ((70, 64, 74), (60, 55, 65), False),
        ((70, 66, 74), (60, None, None), True),
        ((70, np.nan, np.nan), (60, 55, 65), False),
        ((70, None, None), (60, 55, 65), False),
        ((70, 66, 74), (np.nan, np.nan, np.nan), False),
    ],
)
def test_an_interval_lies_above_another_only_entirely(gain, ceiling, above):
    assert Estimate(*gain).lies_above(Estimate(*ceiling)) is above
