"""The test bench: the test windows of a sensor, on which all estimators are judged alike."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import combinations, product

import numpy as np
import pandas as pd
import xarray as xr
from numpy.typing import ArrayLike

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
from gyro_pipeline.physics.bias import windows_at
from gyro_pipeline.physics.ceiling import oracle
from gyro_pipeline.physics.recording_model import LinearEstimate, RecordingModel, best_linear
from gyro_pipeline.physics.turn_on import bias_correlation
from gyro_pipeline.pipelines.evaluation.ceilings import Ceilings
from gyro_pipeline.pipelines.evaluation.device import TestDevice
from gyro_pipeline.scoring.scorer import Scorer, View, squares_by_view
from gyro_pipeline.scoring.scores import (
    Estimate,
    SquaredErrors,
    beats_oracle,
    coverage,
    prior_conflict,
    squared_errors,
)
from gyro_pipeline.scoring.truths import (
    TestRecording,
    error_columns,
    running_mean_curve,
    stack_columns,
)
from gyro_pipeline.windows import window_size

SCORE_COLUMNS = ["weights", "truth", "windows", "score", "value", "lo", "hi"]
"""Columns of a table of scores."""

SIGMAS = {"coverage_1sigma_pct": 1.0, "coverage_2sigma_pct": 2.0, "coverage_95_pct": 1.959964}
"""Numbers of standard deviations within which errors are counted."""

TARGETS = (RECORDING_MEAN, BIAS)

EstimatesByTruth = Callable[[str], tuple[np.ndarray, ArrayLike]]
"""Biases and sigma of the windows of a recording, (windows, 3), deg/s, for each truth."""


@dataclass(frozen=True)
class Bench:
    """The test windows of a sensor, of one length, on which all estimators are judged alike."""

    recordings: xr.Dataset  # all recordings of the sensor, of one length
    device: TestDevice  # the tested IMUs
    tests: pd.DataFrame  # test rows of the windows table: fold, imu, recording, start
    window_s: float  # calibration time T0, seconds

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
    def test_recordings(self) -> list[TestRecording]:
        """The test recordings, with their noise and starts of windows."""
        simulated, recordings = "true_bias" in self.recordings, []
        for key, rows in self.tests.groupby(["imu", "recording"]):
            imu, number = map(int, map(str, key))
            recording = self.recordings.sel(imu=imu, recording=number)
            recordings.append(
                TestRecording(
                    number=number,
                    samples=recording.angular_rate.to_numpy(),
                    rate_hz=self.recordings.attrs["rate_hz"],
                    noise=self.device.figures[self._axes(imu)],
                    true_bias=recording.true_bias.to_numpy() if simulated else None,
                    imu=imu,
                    starts=np.unique(rows.start.to_numpy()),
                )
            )
        return recordings

    @cached_property
    def _truths(self) -> list[dict[str, tuple[np.ndarray, np.ndarray]]]:
        """The truths of each test recording."""
        return [recording.truths(recording.starts, self.size) for recording in self.test_recordings]

    def _axes(self, imu: int) -> slice:
        """Position of the axes of an IMU among those of ``device``."""
        first = len(AXES) * self.device.imus.index(imu)
        return slice(first, first + len(AXES))

    def errors(self, estimators: Mapping[str, Estimator], imus: int = 1) -> pd.DataFrame:
        """Errors in all test windows against all truths, each estimated by the fit of its fold.

        The target of an estimate is that of the truth.

        Args:
            estimators: The fit of each fold.
            imus: Number of IMUs side by side, the tested one first.

        Raises:
            InputError: The estimate of a window is NaN.
        """
        fits = {fold: self._with_calibrations(str(fold), fit) for fold, fit in estimators.items()}

        def estimates(recording: TestRecording) -> EstimatesByTruth:
            by_target = self._estimates(fits, recording, imus)
            return lambda truth: by_target[TARGET_OF[truth]]

        errors = self._table(estimates)
        for number in errors.recording[errors.error_dps.isna()].unique():
            raise InputError(
                f"{self.recordings.attrs['sensor']} recording {number}: expected an estimate for "
                f"every window of {self.window_s:g} s, got NaN; bring more training recordings or "
                "leave the estimator out of the study"
            )
        return errors

    def _table(self, estimates_of: Callable[[TestRecording], EstimatesByTruth]) -> pd.DataFrame:
        """Errors of the estimates for each test recording against all truths."""
        parts = []
        for recording, truths in zip(self.test_recordings, self._truths, strict=True):
            estimates = estimates_of(recording)
            parts += [
                error_columns(recording, truth, value, *estimates(truth))
                for truth, value in truths.items()
            ]
        return stack_columns(parts)

    def _with_calibrations(self, fold: str, estimator: Estimator) -> Estimator:
        """The fit of a fold, which may use a test recording as a calibration of later ones."""
        numbers = np.unique(self.tests.recording[self.tests.fold == fold])
        if len(self.device.imus) > 1:
            return estimator
        means = {recording.number: recording.mean for recording in self.test_recordings}
        return estimator.with_calibrations(numbers, np.stack([means[n] for n in numbers.tolist()]))

    def _estimates(
        self, estimators: Mapping[str, Estimator], recording: TestRecording, imus: int
    ) -> dict[str, tuple[np.ndarray, np.ndarray]]:
        """Biases and sigma of the windows of a recording, (windows, 3), by target."""
        samples = recording.samples
        if imus > 1:
            rates = self.recordings.angular_rate.isel(imu=slice(imus))
            samples = np.concatenate(rates.sel(recording=recording.number).to_numpy())
        rows = self._rows(recording)
        shape = (len(recording.starts), len(AXES))
        estimates = {t: (np.full(shape, np.nan), np.full(shape, np.nan)) for t in TARGETS}
        for fold, in_fold in rows.groupby("fold", observed=True):
            starts = np.sort(in_fold.start.to_numpy())
            positions = np.searchsorted(recording.starts, starts)
            # windows count also where the IMUs beside the tested one lost samples
            windows = windows_at(samples, self.size, starts).transpose(1, 0, 2)
            starts_s = starts / self.recordings.attrs["rate_hz"]
            for target, arrays in estimates.items():
                results = estimators[str(fold)].estimate(
                    windows, target, starts_s, recording.number
                )
                for array, result in zip(arrays, results, strict=True):
                    array[positions] = result[:, : len(AXES)]
        return estimates

    @cached_property
    def mean_errors(self) -> pd.DataFrame:
        """Errors of the running mean."""
        folds = map(str, self.tests.fold.unique())
        return self.errors(dict.fromkeys(folds, RunningMean()))

    @cached_property
    def _bounds(self) -> dict[str, dict[View, SquaredErrors]]:
        """Squared errors of the oracle and the constant, if they exist."""
        tables = {"oracle": self.oracle_errors, "constant": self.constant_errors}
        return {n: squares_by_view(errors) for n, errors in tables.items() if errors is not None}

    @cached_property
    def curve(self) -> pd.DataFrame:
        """The running-mean curve of every test recording."""
        curves = [running_mean_curve(recording, self.size) for recording in self.test_recordings]
        return pd.concat(curves, ignore_index=True)

    @cached_property
    def _scorer(self) -> Scorer:
        return Scorer(self.mean_errors, self.curve, self.window_s)

    @cached_property
    def oracle_errors(self) -> pd.DataFrame | None:
        """Errors of the best possible estimator for each truth; None on measured data."""
        if self.device.unit_bias is None:
            return None
        return self._table(lambda r: lambda truth: (self._oracle_estimates(r, truth), np.nan))

    @cached_property
    def constant_errors(self) -> pd.DataFrame | None:
        """Errors of the mean of the training recordings; None for unseen devices."""
        if not self.device.labels:
            return None

        def constants(recording: TestRecording) -> EstimatesByTruth:
            rows = self._rows(recording).sort_values("start").drop_duplicates("start")
            biases = np.stack([self.device.labels[fold].mean(axis=0) for fold in rows.fold])
            return lambda _: (biases, np.nan)

        return self._table(constants)

    @cached_property
    def prior_p(self) -> dict[str, float]:
        """P values by axis that the tested recordings have the distribution of the training ones.

        The least p value of all folds is corrected for their number.
        """
        if not self.device.labels:
            return {}
        means = {
            (recording.imu, recording.number): recording.mean for recording in self.test_recordings
        }
        p_values = []
        for fold, rows in self.tests.groupby("fold", observed=True):
            keys = rows[["imu", "recording"]].drop_duplicates().itertuples(index=False, name=None)
            of_fold = np.stack([means[key] for key in keys])
            p_values.append(prior_conflict(self.device.labels[str(fold)], of_fold))
        least = np.minimum(len(p_values) * np.min(p_values, axis=0), 1.0)
        return dict(zip(AXES, least.tolist(), strict=True))

    def _rows(self, recording: TestRecording) -> pd.DataFrame:
        """Test windows of a recording."""
        tests = self.tests
        return tests[(tests.imu == recording.imu) & (tests.recording == recording.number)]

    def _oracle_estimates(self, recording: TestRecording, truth: str) -> np.ndarray:
        """Estimates of the oracle, which knows the drawn values, (windows, 3), deg/s."""
        device, size = self.device, self.size
        if device.models is None:
            assert device.unit_bias is not None
            means = recording.window_means(recording.starts, size)
            axes = self._axes(recording.imu)
            prior = device.unit_bias[axes], device.spread[0, axes], device.noise[axes]
            return oracle(means, *prior, self.window_s, self.recording_s, truth)
        starts = recording.starts
        windows = windows_at(recording.samples, size, starts)
        estimates = [
            [
                self._line(model, axis, start, truth)(window[None])[0]
                for start, window in zip(starts.tolist(), rows, strict=True)
            ]
            for rows, (axis, model) in zip(windows, self._models(recording), strict=True)
        ]
        return np.stack(estimates, axis=-1)

    def _models(self, recording: TestRecording) -> list[tuple[int, RecordingModel]]:
        """The models of the device, with the time constants of a recording.

        Each comes with the number of its axis among those of ``device``.
        """
        assert self.device.models is not None
        axes = self._axes(recording.imu)
        models = self.device.models[axes]
        time_constants = self.recordings.get("true_time_constant")
        if time_constants is not None:
            constants_s = time_constants.sel(imu=recording.imu, recording=recording.number)
            pairs = zip(models, constants_s.to_numpy().tolist(), strict=True)
            models = tuple(replace(model, time_constant_s=constant) for model, constant in pairs)
        return list(enumerate(models, axes.start))

    @cached_property
    def _distinct_models(self) -> dict[tuple[int, float], RecordingModel]:
        """All distinct models, by axis and time constant."""
        if self.device.models is None:
            return {}
        return {
            (axis, model.time_constant_s): model
            for recording in self.test_recordings
            for axis, model in self._models(recording)
        }

    @cached_property
    def _lines(self) -> dict[tuple[int, float, int, str], LinearEstimate]:
        return {}

    def _line(self, model: RecordingModel, axis: int, start: int, truth: str) -> LinearEstimate:
        """The best linear estimate of a window under the model of its axis, cached."""
        key = axis, model.time_constant_s, start, truth
        if key not in self._lines:
            self._lines[key] = best_linear(model, start, self.size, truth)
        return self._lines[key]

    @cached_property
    def ceilings(self) -> Ceilings:
        """The least expected errors."""
        distinct = [(axis, model) for (axis, _), model in self._distinct_models.items()]
        samples, rate_hz = self.recordings.sizes["sample"], self.recordings.attrs["rate_hz"]
        return Ceilings(self.device, distinct, self.size, samples, rate_hz)

    def scores(self, errors: pd.DataFrame, epoch: str) -> pd.DataFrame:
        """All finite scores of a table of errors.

        Args:
            errors: Errors from :meth:`errors`.
            epoch: ``last``, or ``best`` for a network.

        Returns:
            Columns ``weights, truth, windows, score, value, lo, hi``: the epoch of the weights of
            a network, the score, and the ends of its 95 % interval, None without an interval.
        """
        rows = []
        for truth, windows in product(errors.truth.unique(), (FIRST, ALL)):
            scores = self._scores(errors, (truth, windows))
            if epoch == LAST:
                scores |= self.ceilings.of(truth, windows)
                scores |= self._scores_of_bounds((truth, windows))
            rows += [
                (epoch, truth, windows, name, *_finite(estimate))
                for name, estimate in scores.items()
                if np.isfinite(estimate.value)
            ]
        return pd.DataFrame(rows, columns=SCORE_COLUMNS)

    def _scores(self, errors: pd.DataFrame, view: View) -> dict[str, Estimate]:
        """Scores over some windows, against one truth."""
        scores, (truth, windows) = self._scorer.scores(errors, view), view
        if truth != DISJOINT:
            scores |= self._scorer.gains_by_axis(errors, view)
        if windows == ALL and truth != DISJOINT and errors.sigma_dps.notna().any():
            for name, sigmas in SIGMAS.items():
                scores[name] = Estimate(100 * coverage(errors, truth, sigmas))
        if "oracle" in self._bounds and len(self._scorer.jackknife) > 1:
            oracle_squares = self._bounds["oracle"][view]
            p = beats_oracle(squared_errors(errors, *view), oracle_squares)
            scores["beats_oracle_p"] = Estimate(p)
        if view == (PAPER, ALL):
            scores |= {f"prior_p_{axis}": Estimate(p) for axis, p in self.prior_p.items()}
            scores |= self._turn_on_correlations()
        return scores

    def _scores_of_bounds(self, view: View) -> dict[str, Estimate]:
        """Scores of the oracle and the constant on the same windows."""
        return {
            f"{name}_{score}": estimate
            for name, squares in self._bounds.items()
            if view[0] != DISJOINT
            for score, estimate in self._scorer.rmse_and_gain(squares[view], view).items()
        }

    def _turn_on_correlations(self) -> dict[str, Estimate]:
        """Correlations of the turn-on bias between axes; none where an axis has no spread."""
        if self.device.biases is None:
            return {}
        scores = {}
        for i, j in combinations(range(len(AXES)), 2):
            biases, errors = (values[..., [i, j]] for values in self.device.biases)
            if correlation := bias_correlation(biases, errors):
                scores[f"turn_on_correlation_{AXES[i]}{AXES[j]}"] = Estimate(*correlation)
        return scores


def _finite(estimate: Estimate) -> list[float | None]:
    values = (estimate.value, estimate.lo, estimate.hi)
    return [value if value is not None and np.isfinite(value) else None for value in values]
