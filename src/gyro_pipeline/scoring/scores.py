"""From squared errors to RMSE, time saving and accuracy gain, with intervals over recordings.

Squared errors are pooled over windows, axes and recordings; signed errors are never averaged
first, which would make even the running mean look several times better.

Intervals are jackknife-t intervals (Tukey 1958; Efron & Stein 1981, Annals of Statistics 9): every
figure is computed again without each recording in turn, since windows and axes of one recording
share its history, and its standard error follows from how much these differ. Positive figures, such
as the ratio of two RMSEs, have it in the logarithm. How often they hold the truth:
benchmarks/coverage.py.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import pandas as pd
import scipy

from gyro_pipeline.conventions import FIRST

CONFIDENCE_PCT = 95


@dataclass(frozen=True)
class SquaredErrors:
    """Sums of squared errors by recording, and how many squares each sum holds.

    Attributes:
        sums: (deg/s)^2, shape (recordings,) or (recordings, times).
        counts: Same shape.
        exact: Whether the truth is; otherwise its own noise was taken off, and sums may be
            negative.
    """

    sums: np.ndarray
    counts: np.ndarray
    exact: bool = True

    def mean(self, weights: np.ndarray) -> np.ndarray:
        """Pooled mean square for each weighting of the recordings, (deg/s)^2.

        Args:
            weights: From :func:`leave_one_out`, shape (n, recordings).

        Returns:
            Shape (n,) or (n, times).
        """
        with np.errstate(invalid="ignore"):  # recordings of which every such window was dropped
            return (weights @ self.sums) / (weights @ self.counts)


@dataclass(frozen=True)
class Estimate:
    """A value with its 95 % interval; the ends are None where the data carry no interval."""

    value: float
    lo: float | None = None
    hi: float | None = None


def clusters(table: pd.DataFrame) -> pd.Series:
    """What intervals leave out as a whole: recordings, or devices where several are tested.

    Windows of a recording share its history, and recordings of an unseen device its prior.

    Args:
        table: Errors or curves; their columns ``recording`` and, if there, ``imu``.
    """
    several = "imu" in table and table.imu.nunique() > 1
    return table.imu if several else table.recording


def squared_errors(errors: pd.DataFrame, truth: str, windows: str) -> SquaredErrors:
    """Squares of the chosen errors by recording (or device, see :func:`clusters`), in order.

    Args:
        errors: Columns ``recording, window, truth, error_dps, truth_variance``; several runs of
            the same windows (seeds, folds) may be concatenated.
        truth: One of the truths.
        windows: ``first`` or ``all``.
    """
    chosen = (errors.truth == truth).to_numpy(bool)
    if windows == FIRST:
        chosen = chosen & (errors.window.to_numpy() == 0)
    variance = errors.truth_variance.to_numpy()[chosen]
    squares = errors.error_dps.to_numpy()[chosen] ** 2 - variance
    _, places = np.unique(clusters(errors).to_numpy()[chosen], return_inverse=True)
    counts = np.bincount(places)
    # summed like the running-mean curve, which has the same sums at the window
    sums = [squares[places == place].sum() for place in range(counts.size)]
    return SquaredErrors(np.array(sums), counts, exact=not variance.any())


@dataclass(frozen=True)
class Curve:
    """Squared errors of the running mean against its length.

    Attributes:
        times_s: Shape (times,), increasing, seconds.
        squares: With shapes (recordings, times).
    """

    times_s: np.ndarray
    squares: SquaredErrors

    def of(self, weights: np.ndarray) -> "WeightedCurve":
        """The curve for each weighting of the recordings, from :func:`leave_one_out`."""
        squares = np.maximum(np.nan_to_num(self.squares.mean(weights)), 0.0)
        return WeightedCurve(self.times_s, np.sqrt(squares), self.squares.counts.sum(axis=0))


@dataclass(frozen=True)
class WeightedCurve:
    """RMSE of the running mean against its length, for each weighting of the recordings.

    Attributes:
        times_s: Shape (times,), increasing, seconds.
        rmse: Shape (n, times), deg/s; the first row is that of all recordings.
        counts: Of squares at each time, shape (times,).
    """

    times_s: np.ndarray
    rmse: np.ndarray
    counts: np.ndarray

    @cached_property
    def falling(self) -> np.ndarray:
        """RMSE of all recordings, made to fall strictly but for stretches at its ends, (times,).

        A measured curve is rough, and its first crossing of a level may be chance. Neighbours that
        do not fall are pooled (isotonic regression), and the middles of the pools are joined by
        lines.
        """
        given = self.rmse[0] ** 2, self.counts.astype(float)
        fit = scipy.optimize.isotonic_regression(given[0], weights=given[1], increasing=False)
        middles = (fit.blocks[:-1] + fit.blocks[1:] - 1) / 2
        squares = np.interp(np.arange(given[0].size), middles, fit.x[fit.blocks[:-1]])
        return np.asarray(np.sqrt(squares))

    def equivalent_time(self, window_s: float, rmse: np.ndarray) -> Estimate:
        """When the running mean is as good as an estimator (t* of the paper, section IV-C).

        The RMSE is moved by as much as the curve is where it is made to fall, so t* of the running
        mean itself is T0. The interval holds the times at which both RMSEs may be equal, given how
        much their ratio at t* depends on single recordings.

        Args:
            window_s: T0, seconds.
            rmse: Of the estimator for the same weightings, shape (n,), deg/s.

        Returns:
            Seconds; -inf where the curve starts at or below that level, inf where it never gets
            there.
        """
        measured, falling = (
            float(np.interp(window_s, self.times_s, row)) for row in (self.rmse[0], self.falling)
        )
        level = rmse[0] * (falling / measured if measured else 1.0)
        time_s = self._reached(level)
        if not np.isfinite(time_s):
            return Estimate(time_s)
        at_time = np.array([np.interp(time_s, self.times_s, row) for row in self.rmse])
        with np.errstate(divide="ignore", invalid="ignore"):  # at the end of a recording both are 0
            off = with_interval(rmse / at_time, positive=True)
        if off.lo is None or off.hi is None:
            return Estimate(time_s)
        ends = (self._reached(level * end / off.value) for end in (off.hi, off.lo))
        return Estimate(time_s, *ends)

    def _reached(self, level: float) -> float:
        if level >= self.falling[0]:
            return -np.inf
        if level < self.falling[-1]:
            return np.inf
        return float(np.interp(-level, -self.falling, self.times_s))


def curve_errors(curve: pd.DataFrame, truth: str, windows: str) -> Curve:
    """The chosen running-mean curve by recording (or device, see :func:`clusters`), in order.

    Args:
        curve: From :func:`gyro_pipeline.scoring.truths.running_mean_curve`, concatenated.
        truth: One of the truths.
        windows: ``first`` or ``all``.
    """
    chosen = curve[(curve.truth == truth) & (curve.windows == windows)]
    sums = chosen.groupby([clusters(chosen).rename("cluster"), "time_s"])[["sum_sq", "count"]].sum()
    table = sums.unstack("time_s")
    squares = SquaredErrors(table["sum_sq"].to_numpy(), table["count"].to_numpy())
    return Curve(table["sum_sq"].columns.to_numpy(float), squares)


def leave_one_out(recordings: int) -> np.ndarray:
    """Weights of a jackknife over recordings: all of them, then all but each in turn.

    Returns:
        Shape (1 + recordings, recordings); only the first row for a single recording, which carries
        no interval.
    """
    plain = np.ones((1, recordings))
    return plain if recordings == 1 else np.concatenate([plain, 1 - np.eye(recordings)])


def with_interval(
    values: np.ndarray, confidence_pct: float = CONFIDENCE_PCT, positive: bool = False
) -> Estimate:
    """A figure with its jackknife-t interval.

    Args:
        values: Shape (1 + n,): of all recordings, and without each of them (:func:`leave_one_out`).
        confidence_pct: Another confidence than 95 %.
        positive: Whether to take the interval in the logarithm, as of a ratio or an RMSE.

    Returns:
        The ends are None where a value is not finite, or not positive.
    """
    value, n = float(values[0]), len(values) - 1
    with np.errstate(divide="ignore", invalid="ignore"):
        scaled = np.log(values) if positive else values
    if not (n and np.isfinite(scaled).all()):
        return Estimate(value)
    error = np.sqrt((n - 1) * scaled[1:].var())
    reach = scipy.stats.t.ppf(0.5 + confidence_pct / 200, n - 1) * error
    ends = scaled[0] + np.array([-reach, reach])
    lo, hi = np.exp(ends) if positive else ends
    return Estimate(value, float(lo), float(hi))


def gain_pct(ratio: Estimate) -> Estimate:
    """The accuracy gain A in percent from a ratio of RMSEs."""
    ends = [None if end is None else 100 * (1 - end) for end in (ratio.hi, ratio.lo)]
    return Estimate(100 * (1 - ratio.value), *ends)


def score(
    errors: SquaredErrors,
    mean_errors: SquaredErrors,
    curve: WeightedCurve,
    window_s: float,
    weights: np.ndarray,
) -> dict[str, Estimate]:
    """The paper's figures of merit, each with its interval over recordings.

    Args:
        errors: Of the estimator judged.
        mean_errors: Of the running mean on the same windows.
        curve: Of the running mean, for the same weights.
        window_s: T0, seconds.
        weights: From :func:`leave_one_out`.

    Returns:
        ``test_mse_dps2`` always; ``test_rmse_dps``, ``mean_rmse_dps``, ``accuracy_gain_pct``,
        ``equivalent_time_s`` and ``time_saving_pct`` where their squares are positive. A truth
        whose own noise was taken off can leave a negative square: it is reported, not clipped.
        Time and saving are -inf for an estimator worse than the curve's first point, and inf for
        one that the running mean never reaches.
    """
    mse, mean_mse = errors.mean(weights), mean_errors.mean(weights)
    scores = {"test_mse_dps2": with_interval(mse, positive=errors.exact)}
    for squares in (mse, mean_mse) if not errors.exact else ():
        lowest = with_interval(squares)
        if (lowest.value if lowest.lo is None else lowest.lo) < 0:
            return scores
    # leaving one out of a truth with its noise taken off may leave no mean to compare with
    rmse, mean_rmse = (np.sqrt(np.maximum(square, 0.0)) for square in (mse, mean_mse))
    scores["test_rmse_dps"] = with_interval(rmse, positive=True)
    scores["mean_rmse_dps"] = with_interval(mean_rmse, positive=True)
    ratio = np.divide(rmse, mean_rmse, out=np.full_like(rmse, np.inf), where=mean_rmse > 0)
    scores["accuracy_gain_pct"] = gain_pct(with_interval(ratio, positive=True))
    time = curve.equivalent_time(window_s, rmse)
    scores["equivalent_time_s"] = time
    ends = [end if end is None else _saving_pct(end, window_s) for end in (time.lo, time.hi)]
    scores["time_saving_pct"] = Estimate(_saving_pct(time.value, window_s), *ends)
    return scores


def _saving_pct(time_s: float, window_s: float) -> float:
    return 100 * (1 - window_s / time_s) if np.isfinite(time_s) else time_s


def paired_difference(
    errors: SquaredErrors,
    reference: SquaredErrors,
    weights: np.ndarray,
    confidence_pct: float = CONFIDENCE_PCT,
) -> Estimate:
    """Mean square of an estimator less that of a reference on the same windows, (deg/s)^2.

    Args:
        errors: Of the estimator.
        reference: Of what it is compared with, for the same recordings.
        weights: From :func:`leave_one_out`; recordings are left out of both together.
        confidence_pct: Of the interval.

    Returns:
        Negative where the estimator is better, significantly so if the upper end is below 0.
    """
    return with_interval(errors.mean(weights) - reference.mean(weights), confidence_pct)


def rmse_difference(
    errors: SquaredErrors, reference: SquaredErrors, weights: np.ndarray
) -> Estimate:
    """RMSE of an estimator less that of another on the same windows, paired over recordings.

    Args:
        errors: Of the estimator; negative differences are in its favour.
        reference: Of the other one, in the same order of recordings.
        weights: From :func:`leave_one_out`.

    Returns:
        deg/s.
    """
    return with_interval(np.sqrt(errors.mean(weights)) - np.sqrt(reference.mean(weights)))


def gain_difference(
    errors: SquaredErrors, reference: SquaredErrors, mean: SquaredErrors, weights: np.ndarray
) -> Estimate:
    """By how much A of an estimator exceeds that of another, paired over recordings.

    Args:
        errors: Of the estimator, all seeds together.
        reference: Of the other one on the same windows.
        mean: Of the running mean on these.
        weights: From :func:`leave_one_out`.

    Returns:
        Percentage points.
    """
    own, other = (np.sqrt(one.mean(weights)) for one in (errors, reference))
    return with_interval(100 * (other - own) / np.sqrt(mean.mean(weights)))


def coverage(errors: pd.DataFrame, truth: str, sigmas: float) -> float:
    """Fraction of all windows whose error is within so many stated standard deviations.

    Args:
        errors: Columns ``truth, error_dps, sigma_dps``.
        truth: One of the truths that are exact; the noise of another would widen the errors.
        sigmas: How many.

    Returns:
        From 0 to 1; NaN where no standard deviation is stated.
    """
    chosen = errors[(errors.truth == truth) & errors.sigma_dps.notna()]
    return float((chosen.error_dps.abs() < sigmas * chosen.sigma_dps).mean())


def prior_conflict(trained: np.ndarray, tested: np.ndarray) -> np.ndarray:
    """How probable the means of tested recordings are, if they are drawn like those that train.

    Both scatter about one mean. The squares of the tested ones about the mean of the others,
    weighted by what is not known of it, over the others' variance, are an F variate.

    Args:
        trained: Means of training recordings, (n, axes), at least 2.
        tested: Of tested ones, (k, axes).

    Returns:
        p values, (axes,), 1 where n is too small. Small ones say that the prior is wrong: a sensor
        that was turned, or a bias that moved on.
    """
    n, k = len(trained), len(tested)
    variance = trained.var(axis=0, ddof=1) if n > 1 else np.zeros(trained.shape[1])
    if not variance.all():
        return np.ones(trained.shape[1])
    off = tested - trained.mean(axis=0)
    # the inverse of I + 1 1' / n is I - 1 1' / (n + k)
    squares = np.sum(off**2, axis=0) - np.sum(off, axis=0) ** 2 / (n + k)
    return np.asarray(scipy.stats.f.sf(squares / k / variance, k, n - 1))


def beats_oracle(errors: SquaredErrors, oracle: SquaredErrors) -> float:
    """One-sided p value that an estimator is better than the oracle on the same windows.

    Paired over recordings: under the null the mean square of the oracle is not the larger one.

    Returns:
        Small values speak against the evaluation: nothing honest can beat the oracle.
    """
    difference = errors.sums / errors.counts - oracle.sums / oracle.counts
    if np.ptp(difference) == 0:
        return 1.0
    return float(scipy.stats.ttest_1samp(difference, 0.0, alternative="less").pvalue)


def holm(p_values: Sequence[float]) -> np.ndarray:
    """Holm's step-down correction for the number of checks; shape as given."""
    p = np.asarray(p_values, dtype=float)
    order = np.argsort(p)
    steps = np.maximum.accumulate(p[order] * np.arange(len(p), 0, -1))
    corrected = np.empty_like(p)
    corrected[order] = np.minimum(steps, 1.0)
    return corrected
