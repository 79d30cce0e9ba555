"""The description of tested devices: their noise, and the spread of their bias."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import pandas as pd
import xarray as xr

from gyro_pipeline.conventions import AXES, ORIGIN_REAL, TEST
from gyro_pipeline.physics.allan import NoiseFigures, fit_axes
from gyro_pipeline.physics.bias import fill_masked
from gyro_pipeline.physics.history import BiasHistory
from gyro_pipeline.physics.recording_model import RecordingModel, fitted_biases
from gyro_pipeline.physics.reml import FEWEST_RECORDINGS, fit_recording_model
from gyro_pipeline.physics.turn_on import (
    axes_are_correlated,
    joint_draws,
    spread_draws,
    turn_on_spread,
)

UNIT_SPREAD = 1.0
"""Standard deviation of the bias from unit to unit, deg/s; 0.7 to 1.9 on the public DOT files."""

_DRAWS = 400
_KEYS = ["imu", "recording"]


@dataclass(frozen=True)
class TestDevice:
    """The tested IMU, axis by axis: the drawn values if simulated, else from its recordings.

    The axes of several unseen devices follow one another.
    """

    imus: tuple[int, ...]  # the tested IMUs, in order
    noise: np.ndarray  # N, (axes,), deg/s sqrt(s)
    # Turn-on spread tau, (1 + draws, axes), deg/s: the estimate, then draws of its uncertainty; for
    # an unseen device, the spread of units.
    spread: np.ndarray
    unit_bias: np.ndarray | None  # drawn prior mean, (axes,), deg/s; None on measured data
    # The model of each axis, if its noise is not white or its bias warms up: drawn if simulated
    # (with the time constant of a single recording), else fitted.
    models: tuple[RecordingModel, ...] | None = None
    # Means of the training recordings by test fold, (n, axes), deg/s; empty for unseen devices, and
    # if a fold has none.
    labels: Mapping[str, np.ndarray] = field(default_factory=dict)
    # Biases of the training recordings, (n, axes), deg/s, and the variances of their errors,
    # (axes,); None with few recordings, and on simulated data, where axes are independent.
    biases: tuple[np.ndarray, np.ndarray] | None = None
    # Covariance of the turn-on bias of all axes, (1 + draws, axes, axes), (deg/s)^2; None unless
    # the biases are correlated.
    joint: np.ndarray | None = None
    # Variance of the bias given earlier calibrations, mean over the test recordings, (1 + draws,
    # axes), (deg/s)^2; None with few recordings, and on simulated data.
    given_earlier: np.ndarray | None = None

    @property
    def figures(self) -> tuple[NoiseFigures, ...]:
        """N, B and K of each axis."""
        if self.models is not None:
            return tuple(model.noise for model in self.models)
        return tuple(NoiseFigures(float(white), 0.0, 0.0) for white in self.noise)


def describe_devices(
    recordings: xr.Dataset, bias: pd.DataFrame, allan: xr.Dataset, table: pd.DataFrame
) -> TestDevice:
    """Describe the tested devices by the recordings that do not test in the same folds.

    Args:
        recordings: Recordings, with the drawn values on simulated data.
        bias: Ground truth.
        allan: Allan variances.
        table: A windows table. A device is known if a fold in which it tests trains on it.
    """
    imus = sorted(table.imu[table.role == TEST].unique().tolist())
    rows = table[table.origin == ORIGIN_REAL].drop_duplicates(["fold", "role", *_KEYS])
    learning = rows[rows.role != TEST]
    tests = rows[rows.role == TEST].groupby("imu").fold.unique()
    training = [learning[(learning.imu == imu) & learning.fold.isin(tests[imu])] for imu in imus]
    if len(imus) == 1 and len(training[0]):
        means = bias[bias.imu == imus[0]].pivot(
            index="recording", columns="axis", values="bias_dps"
        )
        if recordings.attrs["simulated"]:
            device = _describe_drawn(recordings, imus[0])
        else:
            numbers = rows.recording[rows.role == TEST].unique()
            trained = means.loc[means.index.isin(training[0].recording)]
            tested = means.loc[sorted(numbers)]
            device = _describe_known(recordings, trained, tested, allan, imus[0])
        return replace(device, labels=_labels(means, training[0], tests[imus[0]]))
    keys = learning[learning.fold.isin(tests.explode())][_KEYS].drop_duplicates()
    return _describe_unseen(recordings, allan, sorted(map(tuple, keys.to_numpy().tolist())), imus)


def _labels(
    means: pd.DataFrame, training: pd.DataFrame, folds: Iterable[str]
) -> dict[str, np.ndarray]:
    """Means of the training recordings of each fold; empty if a fold has none."""
    numbers = {fold: sorted(training.recording[training.fold == fold].unique()) for fold in folds}
    labels = {str(fold): means.loc[chosen].to_numpy() for fold, chosen in numbers.items()}
    return labels if all(map(len, labels.values())) else {}


def _describe_unseen(
    recordings: xr.Dataset, allan: xr.Dataset, keys: Sequence[tuple[int, int]], imus: Sequence[int]
) -> TestDevice:
    """Describe several devices without their recordings.

    The prior of their bias is the spread of units on the public DOT files. It is so large that the
    ceiling is the running mean if the noise is white. The noise is fitted to all devices together,
    since single ones have few recordings.

    Args:
        recordings: Recordings, with the drawn values on simulated data.
        allan: Allan variances.
        keys: IMU and number of the recordings to fit the noise to.
        imus: The devices.

    Returns:
        A description without intervals, in which the axes of IMUs follow one another.
    """
    if recordings.attrs["simulated"]:
        noise = recordings.true_noise.to_numpy()
        by_imu = [_drawn_models(recordings.sel(imu=imu)) or () for imu in imus]
        models = tuple(_with_prior(model, 0.0, UNIT_SPREAD) for axes in by_imu for model in axes)
    else:
        fits = _allan_fits(recordings, allan, [allan.sel(imu=i, recording=n) for i, n in keys])
        noise = np.array([figures.white for figures in fits])
        fitted = _fitted_models(_samples(recordings, keys), float(recordings.attrs["rate_hz"]))
        models = len(imus) * tuple(
            _with_prior(model, float(model.mean[0]), UNIT_SPREAD) for model in fitted
        )
    axes = np.tile(noise, len(imus))
    bias = np.zeros(axes.size) if recordings.attrs["simulated"] else None
    spread = np.full((1, axes.size), UNIT_SPREAD)
    return TestDevice(tuple(imus), axes, spread, bias, models or None)


def _with_prior(model: RecordingModel, mean: float, spread: float) -> RecordingModel:
    """A model with another prior of the bias, independent of the warm-up."""
    means, covariance = model.mean.copy(), np.diag(np.diag(model.covariance))
    means[0], covariance[0, 0] = mean, spread**2
    return replace(model, mean=means, covariance=covariance)


def _describe_drawn(recordings: xr.Dataset, imu: int) -> TestDevice:
    """Describe a simulated IMU by its drawn values."""
    return TestDevice(
        imus=(imu,),
        noise=recordings.true_noise.to_numpy(),
        spread=recordings.true_turn_on_spread.to_numpy()[None],
        unit_bias=recordings.true_unit_bias.sel(imu=imu).to_numpy(),
        models=_drawn_models(recordings.sel(imu=imu)),
    )


def _describe_known(
    recordings: xr.Dataset, means: pd.DataFrame, tests: pd.DataFrame, allan: xr.Dataset, imu: int
) -> TestDevice:
    """Describe a measured IMU by its recordings.

    Args:
        recordings: Measured recordings.
        means: Means of the training recordings, a row each.
        tests: Means of the test recordings.
        allan: Allan variances.
        imu: Number of the IMU.
    """
    labels = means.to_numpy()
    rate_hz = float(recordings.attrs["rate_hz"])
    duration_s, numbers = recordings.sizes["sample"] / rate_hz, means.index.tolist()
    variances = allan.sel(imu=imu, recording=numbers).load()
    fits = _allan_fits(recordings, allan, [variances.sel(recording=n) for n in numbers])
    noise = np.array([fit.white for fit in fits])
    samples = _samples(recordings, [(imu, number) for number in numbers])
    models = _fitted_models(samples, rate_hz) or None
    averaging = np.square(noise) / duration_s + _beyond_white(models, duration_s)
    spread = np.vstack([turn_on_spread(labels, averaging), spread_draws(labels, averaging, _DRAWS)])
    joint = given_earlier = biases = None
    if models is not None:
        given_earlier = _given_earlier(models, means, tests)
        biases = fitted_biases(models, samples)
        joint = joint_draws(*biases, _DRAWS) if axes_are_correlated(biases[0]) else None
    device = TestDevice((imu,), noise, spread, None, models, biases=biases)
    return replace(device, joint=joint, given_earlier=given_earlier)


def _given_earlier(
    models: Sequence[RecordingModel], means: pd.DataFrame, tests: pd.DataFrame
) -> np.ndarray:
    """Variance of a bias given the calibrations before it, mean over test recordings.

    Returns:
        The estimate, then draws of its uncertainty, (1 + draws, axes), (deg/s)^2.
    """
    by_axis = []
    for seed, (model, axis) in enumerate(zip(models, AXES, strict=True)):
        history = BiasHistory.fit(means.index.to_numpy(), means[axis].to_numpy(), model)
        drawn = history.draws(_DRAWS, seed)
        by_axis.append(np.hstack([_next_variance(h, model, tests[axis]) for h in (history, drawn)]))
    return np.stack(by_axis, axis=1)


def _next_variance(history: BiasHistory, model: RecordingModel, tests: pd.Series) -> np.ndarray:
    """Variance of a test recording's bias given the calibrations before it, mean over tests."""
    extended = history.extended(tests.index.to_numpy(), tests.to_numpy())
    biases = [extended.next_bias(number) for number in tests.index.tolist()]
    of_any = np.full_like(history.step, model.covariance[0, 0])
    return np.asarray(np.mean([of_any if bias is None else bias[1] for bias in biases], axis=0))


def _allan_fits(
    recordings: xr.Dataset, allan: xr.Dataset, chosen: Sequence[xr.Dataset]
) -> list[NoiseFigures]:
    """N, B and K of each axis from the Allan variances of some recordings."""
    variances, counts = (
        np.stack([part[name].to_numpy() for part in chosen])
        for name in ("allan_variance", "differences")
    )
    rate_hz, times_s = recordings.attrs["rate_hz"], allan.time_s.to_numpy()
    durations_s = recordings.sizes["sample"] / rate_hz * (counts > 0).mean(axis=0)
    return fit_axes(times_s, variances, counts[:, None], durations_s, rate_hz)


def _drawn_models(recordings: xr.Dataset) -> tuple[RecordingModel, ...] | None:
    """The models that the axes of an IMU were drawn from; None for white noise without warm-up."""
    flicker, walk = (
        float(recordings.get(f"true_{name}", 0.0)) for name in ("flicker", "random_walk")
    )
    warms_up = "true_amplitude" in recordings
    if not (flicker or walk or warms_up):
        return None
    models = []
    for axis in recordings.axis.to_numpy():
        values = recordings.sel(axis=axis)
        noise = NoiseFigures(float(values.true_noise), flicker, walk)
        mean, spread = [float(values.true_unit_bias)], [float(values.true_turn_on_spread)]
        if warms_up:
            mean.append(float(values.true_amplitude_mean))
            spread.append(float(values.true_amplitude_spread))
        covariance = np.diag(np.square(spread))
        samples, rate_hz = recordings.sizes["sample"], float(recordings.attrs["rate_hz"])
        models.append(RecordingModel(samples, rate_hz, noise, np.array(mean), covariance))
    return tuple(models)


def _samples(recordings: xr.Dataset, keys: Sequence[tuple[int, int]]) -> np.ndarray:
    """Samples of recordings by IMU and number, (axes, n, samples), deg/s; no NaN."""
    rates = [recordings.angular_rate.sel(imu=imu, recording=number) for imu, number in keys]
    return np.stack([fill_masked(r.transpose("axis", "sample").to_numpy()) for r in rates], axis=1)


def _fitted_models(samples: np.ndarray, rate_hz: float) -> tuple[RecordingModel, ...]:
    """Models of the axes, fitted to recordings (axes, n, samples); none with too few of them."""
    if samples.shape[1] < FEWEST_RECORDINGS:
        return ()
    models = [fit_recording_model(axis, rate_hz, warm_up=None) for axis in samples]
    return tuple(replace(m, covariance=np.diag(np.diag(m.covariance))) for m in models)


def _beyond_white(models: tuple[RecordingModel, ...] | None, duration_s: float) -> np.ndarray:
    """Variance of the means of recordings beyond tau^2 and N^2 / T, (axes,)."""
    if models is None:
        return np.zeros(len(AXES))
    return np.array([m.averaging_variance() - m.noise.white**2 / duration_s for m in models])
