"""The scorer of a set of test windows, and the table in which scores are stored."""

from dataclasses import dataclass
from functools import cached_property
from itertools import product

import numpy as np
import pandas as pd

from gyro_pipeline.conventions import ALL, AXES, FIRST, LAST, PAPER
from gyro_pipeline.scoring.scores import (
    Estimate,
    SquaredErrors,
    WeightedCurve,
    clusters,
    gain_pct,
    leave_one_out,
    score,
    squared_errors,
    weighted_curve,
    with_interval,
)

MISSING = Estimate(np.nan)
"""The estimate of a score that does not exist."""

View = tuple[str, str]
"""What errors are scored over: a truth, and ``first`` or ``all`` windows."""

Scores = dict[tuple[str, str], Estimate]
"""Scores against one truth, by name and windows."""


@dataclass(frozen=True, eq=False)
class Scorer:
    """Scores estimators on the same test windows, relative to the running mean.

    Attributes:
        mean_errors: Errors of the running mean, as :func:`squared_errors` takes them.
        curve: From :func:`gyro_pipeline.scoring.truths.running_mean_curve`, concatenated.
        window_s: T0, seconds.
    """

    mean_errors: pd.DataFrame
    curve: pd.DataFrame
    window_s: float

    @cached_property
    def jackknife(self) -> np.ndarray:
        """Weights of recordings, or devices: all of them, then all but each in turn."""
        return leave_one_out(int(clusters(self.mean_errors).nunique()))

    @cached_property
    def mean_squares(self) -> dict[View, SquaredErrors]:
        """Squared errors of the running mean by truth and windows."""
        return squares_by_view(self.mean_errors)

    @cached_property
    def curves(self) -> dict[View, WeightedCurve]:
        """The running-mean curve by truth and windows, with each recording left out in turn."""
        views = product(self.curve.truth.unique(), (FIRST, ALL))
        return {view: weighted_curve(self.curve, *view, self.jackknife) for view in views}

    def scores(self, errors: pd.DataFrame, view: View) -> dict[str, Estimate]:
        """The figures of merit of an estimator, see :func:`score`."""
        squares, mean = squared_errors(errors, *view), self.mean_squares[view]
        return score(squares, mean, self.curves[view], self.window_s, self.jackknife)

    def gains_by_axis(self, errors: pd.DataFrame, view: View) -> dict[str, Estimate]:
        """A of each axis, ``accuracy_gain_pct_<axis>``."""
        return {
            f"accuracy_gain_pct_{axis}": self._gain(
                squared_errors(errors[errors.axis == axis], *view),
                squared_errors(self.mean_errors[self.mean_errors.axis == axis], *view),
            )
            for axis in AXES
        }

    def rmse_and_gain(self, squares: SquaredErrors, view: View) -> dict[str, Estimate]:
        """``rmse_dps`` and ``accuracy_gain_pct`` of a reference with an exact truth."""
        rmse = with_interval(np.sqrt(squares.mean(self.jackknife)), positive=True)
        gain = self._gain(squares, self.mean_squares[view])
        return {"rmse_dps": rmse, "accuracy_gain_pct": gain}

    def _gain(self, squares: SquaredErrors, mean: SquaredErrors) -> Estimate:
        with np.errstate(divide="ignore", invalid="ignore"):
            ratio = np.sqrt(squares.mean(self.jackknife) / mean.mean(self.jackknife))
        return gain_pct(with_interval(ratio, positive=True))


def squares_by_view(errors: pd.DataFrame) -> dict[View, SquaredErrors]:
    """Squared errors by truth and windows."""
    views = product(errors.truth.unique(), (FIRST, ALL))
    return {view: squared_errors(errors, *view) for view in views}


def read_scores(table: pd.DataFrame, truth: str = PAPER, epoch: str = LAST) -> Scores:
    """Scores against a truth, by name and windows.

    Args:
        table: Columns ``weights, truth, windows, score, value, lo, hi``.
        truth: Name of the truth.
        epoch: ``last`` or ``best``, as in the column ``weights``.
    """
    chosen = table[(table.truth == truth) & (table.weights == epoch)]
    rows = chosen[["score", "windows", "value", "lo", "hi"]].itertuples(index=False, name=None)
    return {
        (name, windows): Estimate(value, *(None if pd.isna(end) else float(end) for end in ends))
        for name, windows, value, *ends in rows
    }
