"""The test bench: one sensor, window and fold, on which every estimator is judged alike."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import product

import numpy as np
import pandas as pd
import xarray as xr

from gyro_pipeline.conventions import (
    ALL,
    AXES,
    BEST,
    BIAS,
    DISJOINT,
    FIRST,
    HOLD_OUT,
    LAST,
    PAPER,
    RECORDING_MEAN,
    TARGET_OF,
    TEST,
    TEST_IMU,
    TRUE,
    InputError,
)
from gyro_pipeline.estimators import Estimator, RunningMean
from gyro_pipeline.parameters import Evaluation
from gyro_pipeline.physics.allan import SHORTEST_FIT_SAMPLES, fit_noise
from gyro_pipeline.physics.ceiling import (
    best_gain,
    best_saving,
    ceiling_rmse,
    oracle,
    pooled,
    running_mean_rmse,
    turn_on_spread,
)
from gyro_pipeline.protocol.scores import (
    Estimate,
    ResampledCurve,
    SquaredErrors,
    beats_oracle,
    coverage,
    curve_errors,
    resampled_weights,
    score,
    squared_errors,
    with_interval,
)
from gyro_pipeline.protocol.truths import (
    CURVE_STEP_S,
    TestRecording,
    error_columns,
    running_mean_curve,
    stacked,
)
from gyro_pipeline.protocol.windows import cut_windows, window_size
from gyro_pipeline.tracking import metric_name

_CEILING_RESAMPLES = 400


@dataclass(frozen=True)
class TestDevice:
    """What is known of the test IMU, per axis: drawn if simulated, else from its recordings.

    Attributes:
        noise: N, shape (resamples, 3), deg/s sqrt(s); the first row is the estimate itself.
        spread: Turn-on spread tau, same shape, deg/s.
        unit_bias: Drawn prior mean, shape (3,), deg/s; None on measured data.
        white: Whether the ceiling is the exact limit, so that beating it is a defect.
    """

    noise: np.ndarray
    spread: np.ndarray
    unit_bias: np.ndarray | None
    white: bool


def describe_device(
    recordings: xr.Dataset, bias: pd.DataFrame, allan: xr.Dataset, numbers: Sequence[int], seed: int
) -> TestDevice:
    """Noise and turn-on spread of the test IMU, with a bootstrap over the recordings used.

    Args:
        recordings: With the drawn values on simulated data.
        bias: Ground truth.
        allan: Allan variances.
        numbers: Recordings to learn from; none of a hold-out's test recordings.
        seed: Of the bootstrap.
    """
    if recordings.attrs["simulated"]:
        return TestDevice(
            noise=recordings.true_noise.to_numpy()[None],
            spread=recordings.true_turn_on_spread.to_numpy()[None],
            unit_bias=recordings.true_unit_bias.sel(imu=TEST_IMU).to_numpy(),
            white=float(recordings.true_flicker) == 0,
        )
    duration_s = recordings.sizes["sample"] / recordings.attrs["rate_hz"]
    means = bias[bias.imu == TEST_IMU].pivot(index="recording", columns="axis", values="bias_dps")
    variances = allan.allan_variance.sel(imu=TEST_IMU, recording=list(numbers))
    variances = variances.transpose("recording", "axis", "time_s").to_numpy()
    generator = np.random.default_rng(seed)
    draws = generator.integers(len(numbers), size=(_CEILING_RESAMPLES, len(numbers)))
    noise, spread = [], []
    for chosen in [np.arange(len(numbers)), *draws]:
        shortest_s = SHORTEST_FIT_SAMPLES / recordings.attrs["rate_hz"]
        fits = [
            fit_noise(allan.time_s.to_numpy(), variance, duration_s, shortest_s)
            for variance in variances[chosen].mean(axis=0)
        ]
        noise.append([fit.white for fit in fits])
        values = means.loc[list(numbers)].to_numpy()[chosen]
        spread.append(turn_on_spread(values, np.array(noise[-1]), duration_s))
    return TestDevice(np.array(noise), np.array(spread), None, white=False)


@dataclass(frozen=True)
class Bench:
    """Test recordings of the test IMU, cut into windows of one length.

    Attributes:
        recordings: All recordings of the sensor.
        device: From :func:`describe_device`.
        numbers: The test recordings.
        window_s: Calibration time T0, seconds.
        evaluation: Resamples and seed of the intervals.
    """

    recordings: xr.Dataset
    device: TestDevice
    numbers: tuple[int, ...]
    window_s: float
    evaluation: Evaluation

    @cached_property
    def size(self) -> int:
        """Samples of a window."""
        attrs, samples = self.recordings.attrs, self.recordings.sizes["sample"]
        return window_size(self.window_s, attrs["rate_hz"], samples, attrs["sensor"])

    @property
    def recording_s(self) -> float:
        """T, seconds."""
        return self.recordings.sizes["sample"] / self.recordings.attrs["rate_hz"]

    @cached_property
    def tested(self) -> list[TestRecording]:
        """The test IMU's recordings with what is needed to judge an estimate."""
        chosen = self.recordings.sel(imu=TEST_IMU, recording=list(self.numbers))
        known = "true_bias" in chosen
        return [
            TestRecording(
                number=int(one.recording),
                samples=one.angular_rate.to_numpy(),
                rate_hz=chosen.attrs["rate_hz"],
                noise=self.device.noise[0],
                true_bias=one.true_bias.to_numpy() if known else None,
            )
            for one in (chosen.sel(recording=number) for number in self.numbers)
        ]

    def errors(self, estimator: Estimator, imus: int = 1) -> pd.DataFrame:
        """Errors of an estimator on IMU 1, in all windows against all truths.

        It is asked for the target that each truth is about.

        Args:
            estimator: Sees ``imus`` IMUs side by side, the test IMU first.
            imus: How many.

        Raises:
            InputError: If it gives no estimate for some window.
        """
        seen = self.recordings.angular_rate.sel(imu=slice(TEST_IMU, TEST_IMU + imus - 1))
        parts = []
        for recording in self.tested:
            samples = (
                recording.samples
                if imus == 1
                else np.concatenate(seen.sel(recording=recording.number).to_numpy())
            )
            windows = cut_windows(samples, self.size)
            windows = windows.transpose(1, 0, 2)
            start_s = np.arange(len(windows)) * self.size / self.recordings.attrs["rate_hz"]
            judged = {
                target: [
                    values[:, : len(AXES)]
                    for values in estimator.estimate(windows, target, start_s, recording.number)
                ]
                for target in (RECORDING_MEAN, BIAS)
            }
            parts += [
                error_columns(recording, self.size, truth, *judged[TARGET_OF[truth]])
                for truth in recording.truths(self.size)
            ]
        errors = stacked(parts)
        for number in errors.recording[errors.error_dps.isna()].unique():
            raise InputError(
                f"{self.recordings.attrs['sensor']} recording {number}: expected an estimate for "
                f"every window of {self.window_s:g} s, got NaN; bring more training recordings or "
                "leave the estimator out of the study"
            )
        return errors

    @cached_property
    def mean_errors(self) -> pd.DataFrame:
        """Errors of the running mean."""
        return self.errors(RunningMean())

    @cached_property
    def _means(self) -> dict[tuple[str, str], SquaredErrors]:
        """Squares of the running mean's errors by truth and windows."""
        return _by_view(self.mean_errors)

    @cached_property
    def _oracles(self) -> dict[tuple[str, str], SquaredErrors]:
        """The same of the best possible estimator; empty where it is not known."""
        return {} if self.oracle_errors is None else _by_view(self.oracle_errors)

    @cached_property
    def _resampled(self) -> np.ndarray:
        """Weights of the recordings in each resample."""
        drawn = self.evaluation.resamples, self.evaluation.bootstrap_seed
        return resampled_weights(len(self.numbers), *drawn)

    @cached_property
    def curve(self) -> pd.DataFrame:
        """The running-mean curve of every test recording."""
        curves = [running_mean_curve(recording, self.size) for recording in self.tested]
        return pd.concat(curves, ignore_index=True)

    @cached_property
    def curves(self) -> dict[tuple[str, str], ResampledCurve]:
        """The same by truth and windows, for every resample."""
        views = product(self.curve.truth.unique(), (FIRST, ALL))
        return {view: curve_errors(self.curve, *view).of(self._resampled) for view in views}

    @cached_property
    def oracle_errors(self) -> pd.DataFrame | None:
        """Errors of the best possible estimator for each truth; None where it is not known."""
        if self.device.unit_bias is None or not self.device.white:
            return None
        known = (self.device.unit_bias, self.device.spread[0], self.device.noise[0])
        parts = []
        for recording in self.tested:
            means = recording.window_sums(self.size) / self.size
            for truth in recording.truths(self.size):
                best = oracle(means, *known, self.window_s, self.recording_s, truth)
                sigma = np.full(best.shape, np.nan)
                parts.append(error_columns(recording, self.size, truth, best, sigma))
        return stacked(parts)

    @property
    def ceiling_basis(self) -> str:
        """In words, what the ceilings are computed from."""
        if self.device.unit_bias is None:
            return "estimated from recordings, white noise"
        return "drawn values" if self.device.white else "drawn values, without the flicker noise"

    def ceilings(self, truth: str) -> dict[str, Estimate]:
        """What no estimator can be better than; exact, without an interval, on simulated data."""
        times = (self.window_s, self.recording_s)
        limit = pooled(ceiling_rmse(self.device.noise, self.device.spread, *times, truth))
        mean = pooled(running_mean_rmse(self.device.noise, *times, truth))
        ceilings = {
            "ceiling_rmse_dps": with_interval(limit),
            "ceiling_accuracy_gain_pct": with_interval(100 * best_gain(limit / mean)),
        }
        if truth == PAPER:
            saving = best_saving(limit / mean, self.window_s / self.recording_s)
            ceilings["ceiling_time_saving_pct"] = with_interval(100 * saving)
        return ceilings

    def metrics(self, errors: pd.DataFrame, weights: str) -> dict[str, float]:
        """All figures of merit of one set of errors, by metric name; only finite ones.

        Args:
            errors: From :meth:`errors`.
            weights: ``last`` or ``best``; part of the names.
        """
        metrics: dict[str, float] = {}
        for truth in errors.truth.unique():
            if truth != DISJOINT and errors.sigma_dps.notna().any():
                for sigmas in (1, 2):
                    name = metric_name(f"coverage_{sigmas}sigma", ALL, weights, truth)
                    metrics[name] = coverage(errors, truth, sigmas)
            for windows in (FIRST, ALL):
                own, mean = squared_errors(errors, truth, windows), self._means[truth, windows]
                curve = self.curves[truth, windows]
                scores = score(own, mean, curve, self.window_s, self._resampled)
                if weights == LAST:
                    scores |= self.ceilings(truth)
                for base, estimate in scores.items():
                    named = {"": estimate.value, "lo": estimate.lo, "hi": estimate.hi}
                    metrics |= {
                        metric_name(base, windows, weights, truth, bound): value
                        for bound, value in named.items()
                        if value is not None and np.isfinite(value)
                    }
                if self._oracles and len(self.numbers) > 1:
                    p = beats_oracle(own, self._oracles[truth, windows])
                    metrics[metric_name("beats_oracle_p", windows, weights, truth)] = p
        return metrics


def _by_view(errors: pd.DataFrame) -> dict[tuple[str, str], SquaredErrors]:
    views = product(errors.truth.unique(), (FIRST, ALL))
    return {view: squared_errors(errors, *view) for view in views}


def off_the_curve(metrics: Mapping[str, float]) -> dict[str, str]:
    """In words, every equivalent time that is no time, by metric name.

    Args:
        metrics: From :meth:`Bench.metrics`, which holds finite values only.
    """
    notes = {}
    for view in product((FIRST, ALL), (LAST, BEST), (PAPER, DISJOINT, TRUE)):
        rmse, mean, time = (
            metric_name(base, *view)
            for base in ("test_rmse_dps", "mean_rmse_dps", "equivalent_time_s")
        )
        if rmse in metrics and time not in metrics:
            worse = metrics[rmse] > metrics[mean]
            notes[time] = (
                f"worse than the running mean of {CURVE_STEP_S:g} s, where the curve starts"
                if worse
                else "the running mean never gets there"
            )
    return notes


def test_recordings(roles: pd.DataFrame, fold: int) -> tuple[int, ...]:
    """Test recordings of a fold; for ``HOLD_OUT`` on a k-fold, those of all folds."""
    tests = roles[roles.role == TEST]
    if fold != HOLD_OUT:
        tests = tests[tests.fold == fold]
    return tuple(sorted(tests.recording.tolist()))


def known_recordings(roles: pd.DataFrame) -> tuple[int, ...]:
    """Recordings the ceiling is learned from: all but a hold-out's test ones; in a k-fold all."""
    if (roles.fold == HOLD_OUT).all():
        roles = roles[roles.role != TEST]
    return tuple(sorted(roles.recording.unique().tolist()))
