"""The test bench: windows of a sensor that test, on which every estimator is judged alike."""

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
    BIAS,
    DISJOINT,
    FIRST,
    LAST,
    PAPER,
    RECORDING_MEAN,
    TARGET_OF,
    InputError,
)
from gyro_pipeline.estimators.averages import RunningMean
from gyro_pipeline.estimators.base import Estimator
from gyro_pipeline.parameters import Evaluation
from gyro_pipeline.physics.bias import windows_at
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
    TestRecording,
    error_columns,
    running_mean_curve,
    stacked,
)
from gyro_pipeline.protocol.windows import cut_windows, window_size

SCORES = ["weights", "truth", "windows", "score", "value", "lo", "hi"]
"""Columns of a table of scores."""

SIGMAS = {"coverage_1sigma_pct": 1.0, "coverage_2sigma_pct": 2.0, "coverage_95_pct": 1.959964}
"""Of stated standard deviations, within how many an error is counted."""

TARGETS = (RECORDING_MEAN, BIAS)
_CURVE_POINTS = 30  # of the expected running mean, to interpolate between


@dataclass(frozen=True)
class Bench:
    """The windows of a sensor that test, of one length, on which every estimator is judged alike.

    Attributes:
        recordings: All recordings of the sensor, of one length.
        device: What is known of the IMUs that test, from :func:`describe_devices`.
        tests: The rows of the windows table that test: ``fold, imu, recording, start``.
        window_s: Calibration time T0, seconds.
        evaluation: Resamples and seed of the intervals.
    """

    recordings: xr.Dataset
    device: TestDevice
    tests: pd.DataFrame
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
        """The recordings that test, with what is needed to judge an estimate."""
        drawn, tested = "true_bias" in self.recordings, []
        for place, rows in self.tests.groupby(["imu", "recording"]):
            imu, number = map(int, map(str, place))
            recording = self.recordings.sel(imu=imu, recording=number)
            tested.append(
                TestRecording(
                    number=number,
                    samples=recording.angular_rate.to_numpy(),
                    rate_hz=self.recordings.attrs["rate_hz"],
                    noise=self.device.figures[self._axes(imu)],
                    true_bias=recording.true_bias.to_numpy() if drawn else None,
                    imu=imu,
                    tested=np.unique(rows.start.to_numpy()),
                )
            )
        return tested

    @cached_property
    def _truths(self) -> list[dict[str, tuple[np.ndarray, np.ndarray]]]:
        """The truths of each recording that tests."""
        return [recording.truths(recording.tested, self.size) for recording in self.tested]

    def _axes(self, imu: int) -> slice:
        """Where the axes of an IMU are among those of ``device``."""
        first = len(AXES) * self.device.imus.index(imu)
        return slice(first, first + len(AXES))

    def errors(self, estimators: Mapping[str, Estimator], imus: int = 1) -> pd.DataFrame:
        """Errors in all windows that test against all truths, each estimated by its fold's fit.

        The estimator is asked for the target that each truth is about.

        Args:
            estimators: The fit of each fold.
            imus: IMUs that it sees side by side, the tested one first.

        Raises:
            InputError: There is no estimate for some window.
        """
        parts = []
        for recording, truths in zip(self.tested, self._truths, strict=True):
            estimates = self._estimates(estimators, recording, imus)
            parts += [
                error_columns(recording, truth, value, *estimates[TARGET_OF[truth]])
                for truth, value in truths.items()
            ]
        errors = stacked(parts)
        for number in errors.recording[errors.error_dps.isna()].unique():
            raise InputError(
                f"{self.recordings.attrs['sensor']} recording {number}: expected an estimate for "
                f"every window of {self.window_s:g} s, got NaN; bring more training recordings or "
                "leave the estimator out of the study"
            )
        return errors

    def _estimates(
        self, estimators: Mapping[str, Estimator], recording: TestRecording, imus: int
    ) -> dict[str, tuple[np.ndarray, np.ndarray]]:
        """Biases and sigma (windows, 3) of a recording's windows, by target."""
        samples = recording.samples
        if imus > 1:
            seen = self.recordings.angular_rate.isel(imu=slice(imus))
            samples = np.concatenate(seen.sel(recording=recording.number).to_numpy())
        rows = self.tests[
            (self.tests.imu == recording.imu) & (self.tests.recording == recording.number)
        ]
        shape = (len(recording.tested), len(AXES))
        estimates = {t: (np.full(shape, np.nan), np.full(shape, np.nan)) for t in TARGETS}
        for fold, own in rows.groupby("fold", observed=True):
            starts = np.sort(own.start.to_numpy())
            places = np.searchsorted(recording.tested, starts)
            # whatever the IMUs beside the tested one lost
            windows = windows_at(samples, self.size, starts).transpose(1, 0, 2)
            when = starts / self.recordings.attrs["rate_hz"], recording.number
            for target, of_target in estimates.items():
                found = estimators[str(fold)].estimate(windows, target, *when)
                for values, estimated in zip(of_target, found, strict=True):
                    values[places] = estimated[:, : len(AXES)]
        return estimates

    @cached_property
    def mean_errors(self) -> pd.DataFrame:
        """Errors of the running mean."""
        mean = RunningMean()
        return self.errors(dict.fromkeys(map(str, self.tests.fold.unique()), mean))

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
            means = recording.window_means(recording.tested, size)
            axes = self._axes(recording.imu)
            known = (device.unit_bias[axes], device.spread[0, axes], device.noise[0, axes])
            return oracle(means, *known, self.window_s, self.recording_s, truth)
        starts = recording.tested
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

    def scores(self, errors: pd.DataFrame, weights: str) -> pd.DataFrame:
        """All figures of merit of one set of errors; only finite ones.

        Args:
            errors: From :meth:`errors`.
            weights: ``last`` or ``best``, of a network.

        Returns:
            Columns ``weights, truth, windows, score, value, lo, hi``; the ends are those of the
            95 % interval, None where there is none.
        """
        rows = []
        for truth, windows in product(errors.truth.unique(), (FIRST, ALL)):
            own, mean = squared_errors(errors, truth, windows), self._means[truth, windows]
            curve = self.curves[truth, windows]
            scores = score(own, mean, curve, self.window_s, self._resampled)
            if weights == LAST:
                scores |= self.ceilings(truth, windows)
            if windows == ALL and truth != DISJOINT and errors.sigma_dps.notna().any():
                for name, sigmas in SIGMAS.items():
                    scores[name] = Estimate(100 * coverage(errors, truth, sigmas))
            if self._oracles and self._clusters > 1:
                p = beats_oracle(own, self._oracles[truth, windows])
                scores["beats_oracle_p"] = Estimate(p)
            rows += [
                (weights, truth, windows, name, *_finite(estimate))
                for name, estimate in scores.items()
                if np.isfinite(estimate.value)
            ]
        return pd.DataFrame(rows, columns=SCORES)


def _finite(estimate: Estimate) -> list[float | None]:
    values = (estimate.value, estimate.lo, estimate.hi)
    return [value if value is not None and np.isfinite(value) else None for value in values]


def _by_view(errors: pd.DataFrame) -> dict[tuple[str, str], SquaredErrors]:
    views = product(errors.truth.unique(), (FIRST, ALL))
    return {view: squared_errors(errors, *view) for view in views}
