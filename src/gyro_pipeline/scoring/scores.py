"""RMSE, time saving and accuracy gain from squared errors, with intervals over recordings.

Squared errors are pooled over windows, axes and recordings. Signed errors are never averaged
first, as this would make even the running mean look several times better.

Intervals are jackknife-t intervals (Tukey 1958; Efron & Stein 1981, Annals of Statistics 9). Every
figure is computed again without each recording in turn, since the windows and axes of a recording
share its history; the scatter of these values gives the standard error. Intervals of positive
figures, such as a ratio of two RMSEs, are computed in the logarithm. benchmarks/coverage.py
measures how often they contain the truth.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Self

import numpy as np
import pandas as pd
import scipy

from gyro_pipeline.conventions import FIRST

CONFIDENCE_PCT = 95


@dataclass(frozen=True)
class SquaredErrors:
    """Sums of squared errors by recording.

    Attributes:
        sums: (deg/s)^2, shape (recordings,) or (recordings, times).
        counts: Number of squares in each sum, same shape.
        exact: Whether the truth is exact; otherwise the variance of its noise was subtracted, and
            sums may be negative.
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
        with np.errstate(invalid="ignore"):  # recordings whose windows were all dropped
            return (weights @ self.sums) / (weights @ self.counts)


@dataclass(frozen=True)
class Estimate:
    """A value with its 95 % interval; the ends are None where the data do not allow an interval."""

    value: float
    lo: float | None = None
    hi: float | None = None

    def lies_above(self, other: "Estimate") -> bool:
        """Whether the entire interval lies above that of another estimate."""
        lo, value, hi = np.array([self.lo, other.value, other.hi], float)
        return bool(lo > (value if np.isnan(hi) else hi))


def clusters(table: pd.DataFrame) -> pd.Series:
    """The units that a jackknife leaves out: recordings, or devices where several are tested.

    Windows of a recording share its history, and recordings of an unseen device share its prior.

    Args:
        table: Errors or curves, with the column ``recording`` and, optionally, ``imu``.
    """
    several = "imu" in table and table.imu.nunique() > 1
    return table.imu if several else table.recording


def squared_errors(errors: pd.DataFrame, truth: str, windows: str) -> SquaredErrors:
    """Squared errors by recording (or device, see :func:`clusters`), in order.

    Args:
        errors: Columns ``recording, truth, error_dps, truth_variance`` and ``window``, the position
            among the windows of the recording that test; several runs of the same windows (seeds,
            folds) may be concatenated.
        truth: Name of the truth.
        windows: ``first`` or ``all``.
    """
    chosen = (errors.truth == truth).to_numpy(bool)
    if windows == FIRST:
        chosen = chosen & (errors.window.to_numpy() == 0)
    variance = errors.truth_variance.to_numpy()[chosen]
    squares = errors.error_dps.to_numpy()[chosen] ** 2 - variance
    _, cluster = np.unique(clusters(errors).to_numpy()[chosen], return_inverse=True)
    counts = np.bincount(cluster)
    # summed in the same order as the running-mean curve, so that both agree at the window
    sums = [squares[cluster == index].sum() for index in range(counts.size)]
    return SquaredErrors(np.array(sums), counts, exact=not variance.any())


@dataclass(frozen=True)
class WeightedCurve:
    """RMSE of the running mean against its length, for each weighting of the recordings.

    Attributes:
        times_s: Shape (times,), increasing, seconds.
        rmse: Shape (n, times), deg/s; the first row is for all recordings.
        counts: Number of squares at each time, shape (times,).
    """

    times_s: np.ndarray
    rmse: np.ndarray
    counts: np.ndarray

    @classmethod
    def of(cls, times_s: np.ndarray, errors: SquaredErrors, weights: np.ndarray) -> Self:
        """The curve of squared errors by recording and time, for weights of the recordings.

        Args:
            times_s: Shape (times,), increasing, seconds.
            errors: Sums and counts of shape (recordings, times).
            weights: From :func:`leave_one_out`, shape (n, recordings).
        """
        squares = np.maximum(np.nan_to_num(errors.mean(weights)), 0.0)
        return cls(times_s, np.sqrt(squares), errors.counts.sum(axis=0))

    @cached_property
    def falling(self) -> np.ndarray:
        """A monotone fit to the RMSE of all recordings, strictly falling but at its ends, (times,).

        A measured curve is rough, and its first crossing of a level may be chance. Neighbours that
        do not fall are pooled (isotonic regression), and lines join the centres of the pools.
        """
        measured, counts = self.rmse[0] ** 2, self.counts.astype(float)
        fit = scipy.optimize.isotonic_regression(measured, weights=counts, increasing=False)
        centres = (fit.blocks[:-1] + fit.blocks[1:] - 1) / 2
        squares = np.interp(np.arange(measured.size), centres, fit.x[fit.blocks[:-1]])
        return np.asarray(np.sqrt(squares))

    def equivalent_time(self, window_s: float, rmse: np.ndarray) -> Estimate:
        """Time at which the running mean is as good as an estimator (t* of the paper, IV-C).

        The RMSE is scaled by the ratio of the monotone to the measured curve at T0, so that t* of
        the running mean itself is T0. The interval contains the times at which both RMSEs may be
        equal, given how much their ratio at t* depends on single recordings.

        Args:
            window_s: T0, seconds.
            rmse: RMSE of the estimator for the same weightings, shape (n,), deg/s.

        Returns:
            Seconds; -inf where the curve starts at or below the estimator's level, inf where it
            never reaches it.
        """
        measured, falling = (
            float(np.interp(window_s, self.times_s, row)) for row in (self.rmse[0], self.falling)
        )
        level = rmse[0] * (falling / measured if measured else 1.0)
        time_s = self._crossing_time(level)
        if not np.isfinite(time_s):
            return Estimate(time_s)
        mean_rmse = np.array([np.interp(time_s, self.times_s, row) for row in self.rmse])
        with np.errstate(divide="ignore", invalid="ignore"):  # at the end of a recording both are 0
            ratio = with_interval(rmse / mean_rmse, positive=True)
        if ratio.lo is None or ratio.hi is None:
            return Estimate(time_s)
        ends = (self._crossing_time(level * end / ratio.value) for end in (ratio.hi, ratio.lo))
        return Estimate(time_s, *ends)

    def _crossing_time(self, level: float) -> float:
        if level >= self.falling[0]:
            return -np.inf
        if level < self.falling[-1]:
            return np.inf
        return float(np.interp(-level, -self.falling, self.times_s))


def weighted_curve(
    curve: pd.DataFrame, truth: str, windows: str, weights: np.ndarray
) -> WeightedCurve:
    """The running-mean curve, for weights of the recordings (or devices, see :func:`clusters`).

    Args:
        curve: From :func:`gyro_pipeline.scoring.truths.running_mean_curve`, concatenated.
        truth: Name of the truth.
        windows: ``first`` or ``all``.
        weights: From :func:`leave_one_out`.
    """
    chosen = curve[(curve.truth == truth) & (curve.windows == windows)]
    sums = chosen.groupby([clusters(chosen).rename("cluster"), "time_s"])[["sum_sq", "count"]].sum()
    table = sums.unstack("time_s")
    errors = SquaredErrors(table["sum_sq"].to_numpy(), table["count"].to_numpy())
    return WeightedCurve.of(table["sum_sq"].columns.to_numpy(float), errors, weights)


def leave_one_out(recordings: int) -> np.ndarray:
    """Weights of a jackknife over recordings: all of them, then all but each in turn.

    Returns:
        Shape (1 + recordings, recordings); only the first row for a single recording, which allows
        no interval.
    """
    plain = np.ones((1, recordings))
    return plain if recordings == 1 else np.concatenate([plain, 1 - np.eye(recordings)])


def with_interval(
    values: np.ndarray, confidence_pct: float = CONFIDENCE_PCT, positive: bool = False
) -> Estimate:
    """A figure with its jackknife-t interval.

    Args:
        values: Shape (1 + n,): for all recordings, then without each (:func:`leave_one_out`).
        confidence_pct: Confidence of the interval, percent.
        positive: Whether to compute the interval in the logarithm, as for a ratio or an RMSE.

    Returns:
        The first value; the ends are None where a value is not finite, or its logarithm is not.
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
        errors: Squared errors of the estimator.
        mean_errors: Squared errors of the running mean on the same windows.
        curve: Curve of the running mean, for the same weights.
        window_s: T0, seconds.
        weights: From :func:`leave_one_out`.

    Returns:
        ``test_mse_dps2`` always; ``test_rmse_dps``, ``mean_rmse_dps``, ``accuracy_gain_pct``,
        ``equivalent_time_s`` and ``time_saving_pct`` where the mean squares are positive. A mean
        square can be negative if the variance of the truth was subtracted: it is reported, not
        clipped. Time and saving are -inf for an estimator worse than the curve's first point, and
        inf for one that the running mean never reaches.
    """
    mse, mean_mse = errors.mean(weights), mean_errors.mean(weights)
    scores = {"test_mse_dps2": with_interval(mse, positive=errors.exact)}
    for squares in (mse, mean_mse) if not errors.exact else ():
        lowest = with_interval(squares)
        if (lowest.value if lowest.lo is None else lowest.lo) < 0:
            return scores
    # without one recording, a mean square less the variance of the truth may be negative
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
    root: bool = False,
) -> Estimate:
    """Mean squared error, or RMSE, of an estimator minus that of a reference on the same windows.

    Args:
        errors: Squared errors of the estimator.
        reference: Squared errors of the reference, for the same recordings.
        weights: From :func:`leave_one_out`; a recording is left out of both at once.
        confidence_pct: Confidence of the interval, percent.
        root: Whether RMSEs are compared, deg/s, rather than mean squares, (deg/s)^2.

    Returns:
        Negative where the estimator is better, significantly so if both ends are.
    """
    squares, of_reference = (each.mean(weights) for each in (errors, reference))
    difference = np.sqrt(squares) - np.sqrt(of_reference) if root else squares - of_reference
    return with_interval(difference, confidence_pct)


def gain_difference(
    errors: SquaredErrors, reference: SquaredErrors, mean: SquaredErrors, weights: np.ndarray
) -> Estimate:
    """Accuracy gain A of an estimator minus that of a reference, paired over recordings.

    Args:
        errors: Squared errors of the estimator, all seeds together.
        reference: Squared errors of the reference on the same windows.
        mean: Squared errors of the running mean on the same windows.
        weights: From :func:`leave_one_out`.

    Returns:
        Percentage points.
    """
    rmse, reference_rmse = (np.sqrt(squares.mean(weights)) for squares in (errors, reference))
    return with_interval(100 * (reference_rmse - rmse) / np.sqrt(mean.mean(weights)))


def coverage(errors: pd.DataFrame, truth: str, sigmas: float) -> float:
    """Fraction of all windows whose error is within a multiple of the stated standard deviation.

    Args:
        errors: Columns ``truth, error_dps, sigma_dps``.
        truth: Name of an exact truth; the noise of other truths would widen the errors.
        sigmas: The multiple.

    Returns:
        From 0 to 1; NaN where no standard deviation is stated.
    """
    chosen = errors[(errors.truth == truth) & errors.sigma_dps.notna()]
    return float((chosen.error_dps.abs() < sigmas * chosen.sigma_dps).mean())


def prior_conflict(trained: np.ndarray, tested: np.ndarray) -> np.ndarray:
    """F test of whether tested recordings have the same mean bias as training recordings.

    Under the null hypothesis all means scatter about a common mean. The squared deviations of the
    tested means from the mean of the training means, weighted by the inverse of their covariance,
    over the training variance, follow an F distribution.

    Args:
        trained: Means of the training recordings, (n, axes), at least 2.
        tested: Means of the tested recordings, (k, axes).

    Returns:
        p values, (axes,); 1 where n is too small. Small values say that the prior is wrong, e.g.
        because the sensor was turned or its bias has drifted.
    """
    n, k = len(trained), len(tested)
    variance = trained.var(axis=0, ddof=1) if n > 1 else np.zeros(trained.shape[1])
    if not variance.all():
        return np.ones(trained.shape[1])
    deviations = tested - trained.mean(axis=0)
    # the inverse of I + 1 1' / n is I - 1 1' / (n + k)
    squares = np.sum(deviations**2, axis=0) - np.sum(deviations, axis=0) ** 2 / (n + k)
    return np.asarray(scipy.stats.f.sf(squares / k / variance, k, n - 1))


def beats_oracle(errors: SquaredErrors, oracle: SquaredErrors) -> float:
    """One-sided p value of a t test that an estimator beats the oracle, paired over recordings.

    Returns:
        Small values cast doubt on the evaluation: without a leak, no estimator beats the oracle.
    """
    difference = errors.sums / errors.counts - oracle.sums / oracle.counts
    if np.ptp(difference) == 0:
        return 1.0
    return float(scipy.stats.ttest_1samp(difference, 0.0, alternative="less").pvalue)


def holm(p_values: Sequence[float]) -> np.ndarray:
    """Correct p values by Holm's step-down procedure for multiple tests; same shape."""
    p = np.asarray(p_values, dtype=float)
    order = np.argsort(p)
    steps = np.maximum.accumulate(p[order] * np.arange(len(p), 0, -1))
    corrected = np.empty_like(p)
    corrected[order] = np.minimum(steps, 1.0)
    return corrected
