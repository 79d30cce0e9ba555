"""From squared errors to RMSE, time saving and accuracy gain, with intervals over recordings.

Squared errors are pooled over windows, axes and recordings; signed errors are never averaged
first, which would make even the running mean look several times better. Intervals resample whole
recordings, since windows and axes of one recording share its history.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd

from gyro_pipeline.conventions import FIRST

CONFIDENCE_PCT = 95


@dataclass(frozen=True)
class SquaredErrors:
    """Sums of squared errors by recording, and how many squares each sum holds.

    Attributes:
        sums: (deg/s)^2, shape (recordings,) or (recordings, times).
        counts: Same shape.
    """

    sums: np.ndarray
    counts: np.ndarray

    def mean(self, weights: np.ndarray) -> np.ndarray:
        """Pooled mean square for each weighting of the recordings, (deg/s)^2.

        Args:
            weights: Shape (resamples, recordings).

        Returns:
            Shape (resamples,) or (resamples, times).
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
    """What intervals resample as a whole: recordings, or devices where several are tested.

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
    squares = errors.error_dps.to_numpy()[chosen] ** 2 - errors.truth_variance.to_numpy()[chosen]
    _, places = np.unique(clusters(errors).to_numpy()[chosen], return_inverse=True)
    counts = np.bincount(places)
    # summed like the running-mean curve, which has the same sums at the window
    sums = [squares[places == place].sum() for place in range(counts.size)]
    return SquaredErrors(np.array(sums), counts)


@dataclass(frozen=True)
class Curve:
    """Squared errors of the running mean against its length.

    Attributes:
        times_s: Shape (times,), increasing, seconds.
        squares: With shapes (recordings, times).
    """

    times_s: np.ndarray
    squares: SquaredErrors

    def of(self, weights: np.ndarray) -> "ResampledCurve":
        """The curve for each weighting of the recordings, (resamples, recordings)."""
        return ResampledCurve(self.times_s, np.sqrt(np.maximum(self.squares.mean(weights), 0.0)))


@dataclass(frozen=True)
class ResampledCurve:
    """RMSE of the running mean against its length, for each resample of the recordings.

    Attributes:
        times_s: Shape (times,), increasing, seconds.
        rmse: Shape (resamples, times), deg/s.
    """

    times_s: np.ndarray
    rmse: np.ndarray


def curve_errors(curve: pd.DataFrame, truth: str, windows: str) -> Curve:
    """The chosen running-mean curve by recording (or device, see :func:`clusters`), in order.

    Args:
        curve: From :func:`gyro_pipeline.protocol.truths.running_mean_curve`, concatenated.
        truth: One of the truths.
        windows: ``first`` or ``all``.
    """
    chosen = curve[(curve.truth == truth) & (curve.windows == windows)]
    sums = chosen.groupby([clusters(chosen).rename("cluster"), "time_s"])[["sum_sq", "count"]].sum()
    table = sums.unstack("time_s")
    squares = SquaredErrors(table["sum_sq"].to_numpy(), table["count"].to_numpy())
    return Curve(table["sum_sq"].columns.to_numpy(float), squares)


def resampled_weights(recordings: int, resamples: int, seed: int) -> np.ndarray:
    """Weights of a bootstrap over recordings: first row the data themselves, then resamples.

    Returns:
        Shape (1 + resamples, recordings); only the first row for a single recording, which
        carries no interval.
    """
    plain = np.ones((1, recordings))
    if recordings == 1:
        return plain
    draws = np.random.default_rng(seed).multinomial(
        recordings, np.full(recordings, 1 / recordings), size=resamples
    )
    return np.concatenate([plain, draws])


def with_interval(values: np.ndarray, confidence_pct: float = CONFIDENCE_PCT) -> Estimate:
    """The first value, with the central 95 % of the others as its interval.

    Args:
        values: Shape (1 + resamples,), may hold infinities.
        confidence_pct: Another confidence than 95 %.
    """
    if len(values) == 1:
        return Estimate(float(values[0]))
    tails = 0.5 + np.array([-confidence_pct, confidence_pct]) / 200
    # "inverted_cdf" never interpolates, so that infinities stay what they are.
    lo, hi = np.quantile(values[1:], tails, method="inverted_cdf")
    return Estimate(float(values[0]), float(lo), float(hi))


def equivalent_time(times_s: np.ndarray, curves: np.ndarray, levels: np.ndarray) -> np.ndarray:
    """First time at which the running mean is as good as a level, linearly interpolated.

    Args:
        times_s: Shape (times,), increasing.
        curves: RMSE of the running mean, shape (n, times), deg/s.
        levels: RMSE to reach, shape (n,), deg/s.

    Returns:
        Shape (n,), seconds; -inf where the curve starts at or below the level, inf where it never
        gets there (t* of the paper, section IV-C).
    """
    reached = curves <= levels[:, None]
    after = reached.argmax(axis=1)
    before = np.maximum(after - 1, 0)
    rows = np.arange(len(levels))
    high, low = curves[rows, before], curves[rows, after]
    with np.errstate(invalid="ignore", divide="ignore"):
        fraction = np.where(high > low, (high - levels) / (high - low), 0.0)
    times = times_s[before] + fraction * (times_s[after] - times_s[before])
    return np.where(~reached.any(axis=1), np.inf, np.where(after == 0, -np.inf, times))


def score(
    errors: SquaredErrors,
    mean_errors: SquaredErrors,
    curve: ResampledCurve,
    window_s: float,
    weights: np.ndarray,
) -> dict[str, Estimate]:
    """The paper's figures of merit, each with its interval over recordings.

    Args:
        errors: Of the estimator judged.
        mean_errors: Of the running mean on the same windows.
        curve: Of the running mean, for the same weights.
        window_s: T0, seconds.
        weights: From :func:`resampled_weights`.

    Returns:
        ``test_mse_dps2`` always; ``test_rmse_dps``, ``mean_rmse_dps``, ``accuracy_gain_pct``,
        ``equivalent_time_s`` and ``time_saving_pct`` where their squares are positive. A truth
        whose own noise was taken off can leave a negative square: it is reported, not clipped.
        Time and saving are -inf for an estimator worse than the curve's first point, and inf for
        one that the running mean never reaches.
    """
    mse, mean_mse = errors.mean(weights), mean_errors.mean(weights)
    scores = {"test_mse_dps2": with_interval(mse)}
    lowest = [s.lo if s.lo is not None else s.value for s in map(with_interval, (mse, mean_mse))]
    if min(lowest) < 0:
        return scores
    rmse, mean_rmse = (np.sqrt(np.maximum(square, 0.0)) for square in (mse, mean_mse))
    scores["test_rmse_dps"] = with_interval(rmse)
    scores["mean_rmse_dps"] = with_interval(mean_rmse)
    times = equivalent_time(curve.times_s, curve.rmse, rmse)
    savings = np.where(np.isfinite(times), 1 - window_s / times, times)
    scores["equivalent_time_s"] = with_interval(times)
    scores["time_saving_pct"] = with_interval(100 * savings)
    # A rare resample of a truth with its noise taken off leaves no mean to compare with.
    ratio = np.divide(rmse, mean_rmse, out=np.full_like(rmse, np.inf), where=mean_rmse > 0)
    scores["accuracy_gain_pct"] = with_interval(100 * (1 - ratio))
    return scores


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
        weights: From :func:`resampled_weights`; recordings are drawn for both together.
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
        weights: From :func:`resampled_weights`.

    Returns:
        deg/s.
    """
    return with_interval(np.sqrt(errors.mean(weights)) - np.sqrt(reference.mean(weights)))


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


def beats_oracle(errors: SquaredErrors, oracle: SquaredErrors) -> float:
    """One-sided p value that an estimator is better than the oracle on the same windows.

    Paired over recordings: under the null the mean square of the oracle is not the larger one.

    Returns:
        Small values speak against the evaluation: nothing honest can beat the oracle.
    """
    difference = errors.sums / errors.counts - oracle.sums / oracle.counts
    if np.ptp(difference) == 0:
        return 1.0
    from scipy import stats  # noqa: PLC0415 - it starts slowly

    return float(stats.ttest_1samp(difference, 0.0, alternative="less").pvalue)


def holm(p_values: Sequence[float]) -> np.ndarray:
    """Holm's step-down correction for the number of checks; shape as given."""
    p = np.asarray(p_values, dtype=float)
    order = np.argsort(p)
    steps = np.maximum.accumulate(p[order] * np.arange(len(p), 0, -1))
    corrected = np.empty_like(p)
    corrected[order] = np.minimum(steps, 1.0)
    return corrected
