"""The test bench: windows of a sensor that test, on which every estimator is judged alike."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import combinations, product

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
from gyro_pipeline.physics.bias import windows_at
from gyro_pipeline.physics.ceiling import oracle
from gyro_pipeline.physics.recording_model import LinearEstimate, RecordingModel, best_linear
from gyro_pipeline.pipelines.evaluation.ceilings import Ceilings
from gyro_pipeline.pipelines.evaluation.device import TestDevice
from gyro_pipeline.scoring.scores import (
    Estimate,
    SquaredErrors,
    WeightedCurve,
    beats_oracle,
    clusters,
    coverage,
    curve_errors,
    gain_pct,
    leave_one_out,
    prior_conflict,
    score,
    squared_errors,
    with_interval,
)
from gyro_pipeline.scoring.truths import TestRecording, error_columns, running_mean_curve, stacked
from gyro_pipeline.windows import cut_windows, window_size

SCORES = ["weights", "truth", "windows", "score", "value", "lo", "hi"]
"""Columns of a table of scores."""

SIGMAS = {"coverage_1sigma_pct": 1.0, "coverage_2sigma_pct": 2.0, "coverage_95_pct": 1.959964}
"""Of stated standard deviations, within how many an error is counted."""

TARGETS = (RECORDING_MEAN, BIAS)
_FEWEST_CORRELATED = 5


@dataclass(frozen=True)
class Bench:
    """The windows of a sensor that test, of one length, on which every estimator is judged alike.

    Attributes:
        recordings: All recordings of the sensor, of one length.
        device: What is known of the IMUs that test, from :func:`describe_devices`.
        tests: The rows of the windows table that test: ``fold, imu, recording, start``.
        window_s: Calibration time T0, seconds.
        labels: Means of the device's training recordings in each fold, (n, axes), deg/s; none of
            unseen devices.
    """

    recordings: xr.Dataset
    device: TestDevice
    tests: pd.DataFrame
    window_s: float
    labels: Mapping[str, np.ndarray] = field(default_factory=dict)

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
        told = {fold: self._told(str(fold), fit) for fold, fit in estimators.items()}
        parts = []
        for recording, truths in zip(self.tested, self._truths, strict=True):
            estimates = self._estimates(told, recording, imus)
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

    def _told(self, fold: str, estimator: Estimator) -> Estimator:
        """The fit of a fold, told of the recordings that test there: past ones to later ones."""
        numbers = np.unique(self.tests.recording[self.tests.fold == fold])
        if len(self.device.imus) > 1:
            return estimator
        means = {recording.number: recording.mean for recording in self.tested}
        return estimator.with_calibrations(numbers, np.stack([means[n] for n in numbers.tolist()]))

    def _estimates(
        self, estimators: Mapping[str, Estimator], recording: TestRecording, imus: int
    ) -> dict[str, tuple[np.ndarray, np.ndarray]]:
        """Biases and sigma (windows, 3) of a recording's windows, by target."""
        samples = recording.samples
        if imus > 1:
            seen = self.recordings.angular_rate.isel(imu=slice(imus))
            samples = np.concatenate(seen.sel(recording=recording.number).to_numpy())
        rows = self._rows(recording)
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
    def _references(self) -> dict[str, dict[tuple[str, str], SquaredErrors]]:
        """Squares of the oracle's and the constant's errors on these windows, if they are known."""
        known = {"oracle": self.oracle_errors, "constant": self.constant_errors}
        return {name: _by_view(errors) for name, errors in known.items() if errors is not None}

    @cached_property
    def _weights(self) -> np.ndarray:
        """Of the recordings, leaving one out in turn."""
        return leave_one_out(int(clusters(self.mean_errors).nunique()))

    @cached_property
    def curve(self) -> pd.DataFrame:
        """The running-mean curve of every test recording."""
        curves = [running_mean_curve(recording, self.size) for recording in self.tested]
        return pd.concat(curves, ignore_index=True)

    @cached_property
    def curves(self) -> dict[tuple[str, str], WeightedCurve]:
        """The same by truth and windows, leaving one recording out in turn."""
        views = product(self.curve.truth.unique(), (FIRST, ALL))
        return {view: curve_errors(self.curve, *view).of(self._weights) for view in views}

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

    @cached_property
    def constant_errors(self) -> pd.DataFrame | None:
        """Errors of the mean of the training recordings; None of devices that none is of."""
        if not self.labels:
            return None
        parts = []
        for recording, truths in zip(self.tested, self._truths, strict=True):
            rows = self._rows(recording).sort_values("start").drop_duplicates("start")
            constants = np.stack([self.labels[fold].mean(axis=0) for fold in rows.fold])
            none = np.full(constants.shape, np.nan)
            parts += [
                error_columns(recording, truth, known, constants, none)
                for truth, known in truths.items()
            ]
        return stacked(parts)

    @cached_property
    def prior_p(self) -> dict[str, float]:
        """How probable the tested recordings are, by axis, if they are like those that train.

        The least of all folds, corrected for their number.
        """
        if not self.labels:
            return {}
        means = {(one.imu, one.number): one.mean for one in self.tested}
        chances = []
        for fold, rows in self.tests.groupby("fold", observed=True):
            places = rows[["imu", "recording"]].drop_duplicates().itertuples(index=False, name=None)
            tested = np.stack([means[place] for place in places])
            chances.append(prior_conflict(self.labels[str(fold)], tested))
        least = np.minimum(len(chances) * np.min(chances, axis=0), 1.0)
        return dict(zip(AXES, least.tolist(), strict=True))

    def _rows(self, recording: TestRecording) -> pd.DataFrame:
        """Windows of a recording that test."""
        own = (self.tests.imu == recording.imu) & (self.tests.recording == recording.number)
        return self.tests[own]

    def _best(self, recording: TestRecording, truth: str) -> np.ndarray:
        """Estimates by one who knows what was drawn, (windows, 3), deg/s."""
        device, size = self.device, self.size
        if device.models is None:
            assert device.unit_bias is not None
            means = recording.window_means(recording.tested, size)
            axes = self._axes(recording.imu)
            known = (device.unit_bias[axes], device.spread[0, axes], device.noise[axes])
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
        if self.device.models is None:
            return {}
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

    @cached_property
    def ceilings(self) -> Ceilings:
        """What can be expected of the best."""
        distinct = [(axis, model) for (axis, _), model in self._distinct.items()]
        samples, rate_hz = self.recordings.sizes["sample"], self.recordings.attrs["rate_hz"]
        return Ceilings(self.device, distinct, self.size, samples, rate_hz)

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
            scores = score(own, mean, curve, self.window_s, self._weights)
            if weights == LAST:
                scores |= self.ceilings.of(truth, windows) | self._realised(truth, windows)
            if truth != DISJOINT:
                scores |= self._gains_by_axis(errors, truth, windows)
            if windows == ALL and truth != DISJOINT and errors.sigma_dps.notna().any():
                for name, sigmas in SIGMAS.items():
                    scores[name] = Estimate(100 * coverage(errors, truth, sigmas))
            if "oracle" in self._references and len(self._weights) > 1:
                p = beats_oracle(own, self._references["oracle"][truth, windows])
                scores["beats_oracle_p"] = Estimate(p)
            if (truth, windows) == (PAPER, ALL):
                scores |= {f"prior_p_{axis}": Estimate(p) for axis, p in self.prior_p.items()}
                scores |= self._turn_on_correlations()
            rows += [
                (weights, truth, windows, name, *_finite(estimate))
                for name, estimate in scores.items()
                if np.isfinite(estimate.value)
            ]
        return pd.DataFrame(rows, columns=SCORES)

    def _realised(self, truth: str, windows: str) -> dict[str, Estimate]:
        """What the oracle and the constant reach on the same windows."""
        scores, mean = {}, self._means[truth, windows].mean(self._weights)
        for name, squares in self._references.items() if truth != DISJOINT else ():
            square = squares[truth, windows].mean(self._weights)
            ratio = with_interval(np.sqrt(square / mean), positive=True)
            scores[f"{name}_rmse_dps"] = with_interval(np.sqrt(square), positive=True)
            scores[f"{name}_accuracy_gain_pct"] = gain_pct(ratio)
        return scores

    def _gains_by_axis(self, errors: pd.DataFrame, truth: str, windows: str) -> dict[str, Estimate]:
        """A of each axis."""
        scores = {}
        for axis in AXES:
            own, mean = (
                squared_errors(table[table.axis == axis], truth, windows).mean(self._weights)
                for table in (errors, self.mean_errors)
            )
            with np.errstate(divide="ignore", invalid="ignore"):
                ratio = with_interval(np.sqrt(own / mean), positive=True)
            scores[f"accuracy_gain_pct_{axis}"] = gain_pct(ratio)
        return scores

    def _turn_on_correlations(self) -> dict[str, Estimate]:
        """Of the means of training recordings, between axes, with intervals (Fisher 1915)."""
        labels = max(self.labels.values(), key=len, default=np.empty(0))
        if len(labels) < _FEWEST_CORRELATED:
            return {}
        scores, half = {}, 1.96 / np.sqrt(len(labels) - 3)
        for (i, first), (j, second) in combinations(enumerate(AXES), 2):
            value = float(np.corrcoef(labels[:, i], labels[:, j])[0, 1])
            lo, hi = np.tanh(np.arctanh(value) + half * np.array([-1, 1]))
            scores[f"turn_on_correlation_{first}{second}"] = Estimate(value, float(lo), float(hi))
        return scores


def _finite(estimate: Estimate) -> list[float | None]:
    values = (estimate.value, estimate.lo, estimate.hi)
    return [value if value is not None and np.isfinite(value) else None for value in values]


def _by_view(errors: pd.DataFrame) -> dict[tuple[str, str], SquaredErrors]:
    views = product(errors.truth.unique(), (FIRST, ALL))
    return {view: squared_errors(errors, *view) for view in views}
