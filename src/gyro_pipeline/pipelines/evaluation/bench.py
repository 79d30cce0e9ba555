"""The test bench: one sensor, window and fold, on which every estimator is judged alike."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
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
    TRAIN,
    TRUE,
    InputError,
)
from gyro_pipeline.estimators import Estimator, RunningMean
from gyro_pipeline.parameters import Evaluation
from gyro_pipeline.physics.ceiling import (
    best_gain,
    best_saving,
    ceiling_rmse,
    oracle,
    pooled,
    running_mean_rmse,
)
from gyro_pipeline.physics.recording_model import (
    LinearEstimate,
    RecordingModel,
    best_linear,
    mean_squares,
)
from gyro_pipeline.pipelines.evaluation.device import TestDevice
from gyro_pipeline.protocol.recordings import present
from gyro_pipeline.protocol.scores import (
    Estimate,
    ResampledCurve,
    SquaredErrors,
    beats_oracle,
    clusters,
    coverage,
    curve_errors,
    equivalent_time,
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
from gyro_pipeline.protocol.windows import cut_windows, window_size, windows_at
from gyro_pipeline.tracking import metric_name

_CURVE_POINTS = 30  # of the expected running mean, to interpolate between


@dataclass(frozen=True)
class Bench:
    """Test recordings of the test IMU, or of several unseen ones, cut into windows of one length.

    Attributes:
        recordings: All recordings of the sensor, of one length.
        device: From :func:`describe_device`, or from :func:`describe_unseen` of the same IMUs.
        numbers: The test recordings; an IMU may lack some.
        window_s: Calibration time T0, seconds.
        evaluation: Resamples and seed of the intervals.
        imus: Whose recordings test, in order.
    """

    recordings: xr.Dataset
    device: TestDevice
    numbers: tuple[int, ...]
    window_s: float
    evaluation: Evaluation
    imus: tuple[int, ...] = (TEST_IMU,)

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
        """The test recordings with what is needed to judge an estimate."""
        known = "true_bias" in self.recordings
        places, there = product(self.imus, self.numbers), present(self.recordings)
        chosen = [
            self.recordings.sel(imu=imu, recording=number)
            for imu, number in places
            if there.sel(imu=imu, recording=number)
        ]
        tested = [
            TestRecording(
                number=int(one.recording),
                samples=one.angular_rate.to_numpy(),
                rate_hz=self.recordings.attrs["rate_hz"],
                noise=self.device.figures[self._axes(int(one.imu))],
                true_bias=one.true_bias.to_numpy() if known else None,
                imu=int(one.imu),
            )
            for one in chosen
        ]
        return [one for one in tested if len(one.starts(self.size))]

    @cached_property
    def _truths(self) -> list[dict[str, tuple[np.ndarray, np.ndarray]]]:
        """Of each test recording."""
        return [recording.truths(self.size) for recording in self.tested]

    def _axes(self, imu: int) -> slice:
        """Where the axes of an IMU are among those of ``device``."""
        first = len(AXES) * self.imus.index(imu)
        return slice(first, first + len(AXES))

    def errors(self, estimator: Estimator | Mapping[int, Estimator], imus: int = 1) -> pd.DataFrame:
        """Errors of an estimator in all windows against all truths.

        It is asked for the target that each truth is about.

        Args:
            estimator: Sees ``imus`` IMUs side by side, the test IMU first; or one for each IMU
                that is tested.
            imus: How many.

        Raises:
            InputError: If it gives no estimate for some window.
        """
        seen = self.recordings.angular_rate.isel(imu=slice(imus))
        parts = []
        for recording, truths in zip(self.tested, self._truths, strict=True):
            own = estimator[recording.imu] if isinstance(estimator, Mapping) else estimator
            samples = (
                recording.samples
                if imus == 1
                else np.concatenate(seen.sel(recording=recording.number).to_numpy())
            )
            starts = recording.starts(self.size)
            # those of the tested IMU, whatever IMUs beside it lost
            windows = windows_at(samples, self.size, starts).transpose(1, 0, 2)
            start_s = starts / self.recordings.attrs["rate_hz"]
            judged = {
                target: [
                    values[:, : len(AXES)]
                    for values in own.estimate(windows, target, start_s, recording.number)
                ]
                for target in (RECORDING_MEAN, BIAS)
            }
            parts += [
                error_columns(recording, truth, known, *judged[TARGET_OF[truth]])
                for truth, known in truths.items()
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
        return resampled_weights(self._clusters, *drawn)

    @cached_property
    def _clusters(self) -> int:
        return int(clusters(self.mean_errors).nunique())

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
        if self.device.unit_bias is None:
            return None
        parts = []
        for recording, truths in zip(self.tested, self._truths, strict=True):
            for truth, known in truths.items():
                best = self._best(recording, truth)
                sigma = np.full(best.shape, np.nan)
                parts.append(error_columns(recording, truth, known, best, sigma))
        return stacked(parts)

    def _best(self, recording: TestRecording, truth: str) -> np.ndarray:
        """Estimates by one who knows what was drawn, (windows, 3), deg/s."""
        device, size = self.device, self.size
        if device.models is None:
            assert device.unit_bias is not None
            means = recording.window_means(size)
            axes = self._axes(recording.imu)
            known = (device.unit_bias[axes], device.spread[0, axes], device.noise[0, axes])
            return oracle(means, *known, self.window_s, self.recording_s, truth)
        starts = recording.starts(size)
        windows = cut_windows(recording.samples, size, starts)
        estimates = [
            [
                self._line(model, axis, start, truth)(one[None])[0]
                for start, one in zip(starts.tolist(), rows, strict=True)
            ]
            for rows, (axis, model) in zip(windows, self._models(recording), strict=True)
        ]
        return np.stack(estimates, axis=-1)

    def _models(self, recording: TestRecording) -> list[tuple[int, RecordingModel]]:
        """The device's models for one recording: with the time constants of its power-on.

        Each with the number of its axis among those of ``device``.
        """
        assert self.device.models is not None
        axes = self._axes(recording.imu)
        models = self.device.models[axes]
        drawn = self.recordings.get("true_time_constant")
        if drawn is not None:
            constants_s = drawn.sel(imu=recording.imu, recording=recording.number)
            both = zip(models, constants_s.to_numpy().tolist(), strict=True)
            models = tuple(replace(model, time_constant_s=constant) for model, constant in both)
        return list(enumerate(models, axes.start))

    @cached_property
    def _distinct(self) -> dict[tuple[int, float], RecordingModel]:
        """All models that differ, by axis and time constant."""
        return {
            (axis, model.time_constant_s): model
            for recording in self.tested
            for axis, model in self._models(recording)
        }

    @cached_property
    def _lines(self) -> dict[tuple[int, float, int, str], LinearEstimate]:
        return {}

    def _line(self, model: RecordingModel, axis: int, start: int, truth: str) -> LinearEstimate:
        """The best linear estimate of a window under the model of its axis, worked out once."""
        key = axis, model.time_constant_s, start, truth
        if key not in self._lines:
            self._lines[key] = best_linear(model, start, self.size, truth)
        return self._lines[key]

    @property
    def ceiling_basis(self) -> str:
        """In words, what the ceilings are computed from."""
        if self.device.unit_bias is None:
            noise = "white noise" if self.device.models is None else "fitted N, B and K"
            return f"estimated from recordings, {noise}"
        if self.device.models is not None and len(self._distinct) > len(self.device.models):
            return (
                "drawn values, the time constant of each warm-up among them: nobody who must learn "
                "it from the window can come this far"
            )
        return "drawn values"

    def ceilings(self, truth: str, windows: str) -> dict[str, Estimate]:
        """What no estimator can be better than; exact, without an interval, on simulated data.

        On measured data the interval is that of the turn-on spread (if noise is white that of N,
        too). Nothing is returned for a truth whose own noise, taken off, leaves no square to take
        the root of.
        """
        if (truth, windows) not in self._ceilings:
            self._ceilings[truth, windows] = self._limits(truth, windows)
        return self._ceilings[truth, windows]

    @cached_property
    def _ceilings(self) -> dict[tuple[str, str], dict[str, Estimate]]:
        return {}

    def _limits(self, truth: str, windows: str) -> dict[str, Estimate]:
        best, mean = self._expected(truth, windows, self.size)
        lowest = with_interval(best)
        if (lowest.value if lowest.lo is None else lowest.lo) < 0 or mean.min() <= 0:
            return {}
        limit = np.sqrt(np.maximum(best, 0.0))
        ratio = limit / np.sqrt(mean)
        limits = {
            "ceiling_rmse_dps": with_interval(limit),
            "ceiling_accuracy_gain_pct": with_interval(100 * best_gain(ratio)),
        }
        if truth == PAPER:
            saving = self._expected_saving(windows, ratio, limit)
            limits["ceiling_time_saving_pct"] = with_interval(100 * saving)
        return limits

    def _expected(self, truth: str, windows: str, size: int) -> tuple[np.ndarray, np.ndarray]:
        """Mean squares of the best estimate and the running mean over axes and windows.

        For each of the device's resamples, (deg/s)^2.
        """
        device, attrs = self.device, self.recordings.attrs
        if device.models is None:
            times = size / attrs["rate_hz"], self.recording_s
            best = pooled(ceiling_rmse(device.noise, device.spread, *times, truth))
            return best**2, pooled(running_mean_rmse(device.noise, *times, truth)) ** 2
        starts = range(0, self.recordings.sizes["sample"] - size + 1, size)
        squares = [
            mean_squares(model, start, size, truth, covariances=device.priors(axis))
            for (axis, _), model in self._distinct.items()
            for start in (starts[:1] if windows == FIRST else starts)
        ]
        best, mean = np.mean(squares, axis=0)
        return best, mean

    def _expected_saving(self, windows: str, ratio: np.ndarray, limit: np.ndarray) -> np.ndarray:
        """1 - T0 / t*, where the running mean of t* is expected to be as good as the limit."""
        if self.device.models is None:
            return best_saving(ratio, self.window_s / self.recording_s)
        samples = self.recordings.sizes["sample"]
        sizes = np.unique(np.geomspace(self.size, samples, _CURVE_POINTS).astype(int))
        # of the whole recording it is 0, but for rounding
        curve = [np.maximum(self._expected(PAPER, windows, int(n))[1], 0.0) for n in sizes]
        reached = equivalent_time(sizes, np.sqrt(curve).T, limit)
        return np.where(np.isfinite(reached), 1 - self.size / reached, 0.0)

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
                    scores |= self.ceilings(truth, windows)
                for base, estimate in scores.items():
                    named = {"": estimate.value, "lo": estimate.lo, "hi": estimate.hi}
                    metrics |= {
                        metric_name(base, windows, weights, truth, bound): value
                        for bound, value in named.items()
                        if value is not None and np.isfinite(value)
                    }
                if self._oracles and self._clusters > 1:
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
    """Test recordings of a fold; for ``HOLD_OUT`` on several folds, those of all."""
    tests = roles[roles.role == TEST]
    if fold != HOLD_OUT:
        tests = tests[tests.fold == fold]
    return tuple(sorted(tests.recording.unique().tolist()))


def known_recordings(roles: pd.DataFrame) -> tuple[int, ...]:
    """Recordings the ceiling is learned from: all but a hold-out's test ones; in a k-fold all."""
    if (roles.fold == HOLD_OUT).all():
        roles = roles[roles.role != TEST]
    return tuple(sorted(roles.recording.unique().tolist()))


def known_places(roles: pd.DataFrame) -> list[tuple[int, int]]:
    """IMU and number of the recordings from which the noise of unseen devices is learned."""
    train = roles[roles.role == TRAIN]
    return sorted(set(zip(train.imu.tolist(), train.recording.tolist(), strict=True)))
