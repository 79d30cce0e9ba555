"""The test bench: one sensor, window and fold, on which every estimator is judged alike."""

from collections.abc import Mapping, Sequence
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
    TRUE,
    InputError,
)
from gyro_pipeline.estimators import Estimator, RunningMean
from gyro_pipeline.parameters import Evaluation
from gyro_pipeline.physics.allan import SHORTEST_FIT_SAMPLES, NoiseFigures, fit_noise
from gyro_pipeline.physics.ceiling import (
    best_gain,
    best_saving,
    ceiling_rmse,
    oracle,
    pooled,
    running_mean_rmse,
    turn_on_spread,
)
from gyro_pipeline.physics.recording_model import (
    LinearEstimate,
    RecordingModel,
    best_linear,
    mean_squares,
)
from gyro_pipeline.physics.reml import FEWEST_RECORDINGS, fit_recording_model
from gyro_pipeline.protocol.scores import (
    Estimate,
    ResampledCurve,
    SquaredErrors,
    beats_oracle,
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
from gyro_pipeline.protocol.windows import cut_windows, window_size
from gyro_pipeline.tracking import metric_name

_CEILING_RESAMPLES = 400
_CURVE_POINTS = 30  # of the expected running mean, to interpolate between


@dataclass(frozen=True)
class TestDevice:
    """What is known of the test IMU, per axis: drawn if simulated, else from its recordings.

    Attributes:
        noise: N, shape (resamples, 3), deg/s sqrt(s); the first row is the estimate itself.
        spread: Turn-on spread tau, same shape, deg/s.
        unit_bias: Drawn prior mean, shape (3,), deg/s; None on measured data.
        models: Of each axis, where its noise is not white or its bias warms up; drawn if simulated
            (a time constant is then that of the recording at hand), else fitted.
    """

    noise: np.ndarray
    spread: np.ndarray
    unit_bias: np.ndarray | None
    models: tuple[RecordingModel, ...] | None = None

    @property
    def figures(self) -> tuple[NoiseFigures, ...]:
        """N, B and K of each axis."""
        if self.models is not None:
            return tuple(model.noise for model in self.models)
        return tuple(NoiseFigures(float(white), 0.0, 0.0) for white in self.noise[0])

    def priors(self, axis: int) -> np.ndarray:
        """Covariances of the model's prior for each of ``spread``, (resamples, k, k)."""
        assert self.models is not None
        covariances = np.repeat(self.models[axis].covariance[None], len(self.spread), axis=0)
        covariances[:, 0, 0] = self.spread[:, axis] ** 2
        return covariances


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
            models=_drawn_models(recordings),
        )
    duration_s = recordings.sizes["sample"] / recordings.attrs["rate_hz"]
    means = bias[bias.imu == TEST_IMU].pivot(index="recording", columns="axis", values="bias_dps")
    variances = allan.allan_variance.sel(imu=TEST_IMU, recording=list(numbers))
    variances = variances.transpose("recording", "axis", "time_s").to_numpy()
    models = _fitted_models(recordings, numbers)
    beyond_white = _beyond_white(models, duration_s)
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
        averaging = np.square(noise[-1]) / duration_s + beyond_white
        spread.append(turn_on_spread(values, averaging))
    return TestDevice(np.array(noise), np.array(spread), None, models)


def _drawn_models(recordings: xr.Dataset) -> tuple[RecordingModel, ...] | None:
    """What each axis of the test IMU was drawn from; None for white noise without a warm-up."""
    drawn = {
        name: float(recordings.get(f"true_{name}", 0.0)) for name in ("flicker", "random_walk")
    }
    warms_up = "true_amplitude" in recordings
    if not any(drawn.values()) and not warms_up:
        return None
    models = []
    for axis in recordings.axis.to_numpy():
        one = recordings.sel(imu=TEST_IMU, axis=axis)
        noise = NoiseFigures(float(one.true_noise), drawn["flicker"], drawn["random_walk"])
        mean, spread = [float(one.true_unit_bias)], [float(one.true_turn_on_spread)]
        if warms_up:
            mean.append(float(one.true_amplitude_mean))
            spread.append(float(one.true_amplitude_spread))
        covariance = np.diag(np.square(spread))
        place = recordings.sizes["sample"], float(recordings.attrs["rate_hz"])
        models.append(RecordingModel(*place, noise, np.array(mean), covariance))
    return tuple(models)


def _fitted_models(
    recordings: xr.Dataset, numbers: Sequence[int]
) -> tuple[RecordingModel, ...] | None:
    """Models of the test IMU's axes; None of too few recordings."""
    if len(numbers) < FEWEST_RECORDINGS:
        return None
    rates = recordings.angular_rate.sel(imu=TEST_IMU, recording=list(numbers))
    rates = rates.transpose("axis", "recording", "sample").to_numpy()
    models = []
    for axis in rates:
        model = fit_recording_model(axis, float(recordings.attrs["rate_hz"]), warm_up=None)
        models.append(replace(model, covariance=np.diag(np.diag(model.covariance))))
    return tuple(models)


def _beyond_white(models: tuple[RecordingModel, ...] | None, duration_s: float) -> np.ndarray:
    """Variance by which recordings' means scatter beyond tau and N^2 / T, by axis."""
    if models is None:
        return np.zeros(len(AXES))
    return np.array([one.averaging_variance() - one.noise.white**2 / duration_s for one in models])


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
                noise=self.device.figures,
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
        if self.device.unit_bias is None:
            return None
        parts = []
        for recording in self.tested:
            for truth in recording.truths(self.size):
                best = self._best(recording, truth)
                sigma = np.full(best.shape, np.nan)
                parts.append(error_columns(recording, self.size, truth, best, sigma))
        return stacked(parts)

    def _best(self, recording: TestRecording, truth: str) -> np.ndarray:
        """Estimates by one who knows what was drawn, (windows, 3), deg/s."""
        device, size = self.device, self.size
        if device.models is None:
            assert device.unit_bias is not None
            means = recording.window_sums(size) / size
            known = (device.unit_bias, device.spread[0], device.noise[0])
            return oracle(means, *known, self.window_s, self.recording_s, truth)
        windows = cut_windows(recording.samples, size)
        estimates = [
            [
                self._line(model, axis, i * size, truth)(one[None])[0]
                for i, one in enumerate(windows[axis])
            ]
            for axis, model in enumerate(self._models(recording.number))
        ]
        return np.stack(estimates, axis=-1)

    def _models(self, number: int) -> tuple[RecordingModel, ...]:
        """The device's models for one recording: with the time constants of its power-on."""
        models, drawn = self.device.models, self.recordings.get("true_time_constant")
        assert models is not None
        if drawn is None:
            return models
        constants_s = drawn.sel(imu=TEST_IMU, recording=number).to_numpy().tolist()
        both = zip(models, constants_s, strict=True)
        return tuple(replace(model, time_constant_s=constant) for model, constant in both)

    @cached_property
    def _distinct(self) -> dict[tuple[int, float], RecordingModel]:
        """All models that differ, by axis and time constant."""
        return {
            (axis, model.time_constant_s): model
            for number in self.numbers
            for axis, model in enumerate(self._models(number))
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
