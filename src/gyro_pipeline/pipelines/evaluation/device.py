"""What is known of a device that is tested: its noise, and how its bias scatters."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import pandas as pd
import xarray as xr

from gyro_pipeline.conventions import AXES, ORIGIN_REAL, TEST
from gyro_pipeline.physics.allan import SHORTEST_FIT_SAMPLES, NoiseFigures, fit_noise, mean_variance
from gyro_pipeline.physics.bias import fill_masked
from gyro_pipeline.physics.ceiling import joint_draws, spread_draws, turn_on_spread
from gyro_pipeline.physics.history import BiasHistory
from gyro_pipeline.physics.recording_model import RecordingModel
from gyro_pipeline.physics.reml import FEWEST_RECORDINGS, fit_recording_model

UNIT_SPREAD = 1.0
"""Standard deviation of the bias from unit to unit, deg/s: 0.7 to 1.9 on the public DOT files."""

_DRAWS = 400
_PLACE = ["imu", "recording"]


@dataclass(frozen=True)
class TestDevice:
    """What is known of the test IMU, per axis: drawn if simulated, else from its recordings.

    Of several unseen devices, the axes of one after the other.

    Attributes:
        imus: The IMUs that test, in order.
        noise: N, shape (axes,), deg/s sqrt(s).
        spread: Turn-on spread tau, shape (1 + draws, axes), deg/s: the estimate, then what the
            recordings allow; of an unseen device, that of units.
        unit_bias: Drawn prior mean, shape (axes,), deg/s; None on measured data.
        models: Of each axis, where its noise is not white or its bias warms up; drawn if simulated
            (a time constant is then that of the recording at hand), else fitted.
        joint: Covariance of the turn-on bias of all axes, (1 + draws, axes, axes), (deg/s)^2; None
            where few recordings do not tell, and of drawn values, where axes are independent.
        history: Variance of the next bias given the calibrations before it, (axes,), mean over
            the recordings that test, (deg/s)^2; None likewise.
    """

    imus: tuple[int, ...]
    noise: np.ndarray
    spread: np.ndarray
    unit_bias: np.ndarray | None
    models: tuple[RecordingModel, ...] | None = None
    joint: np.ndarray | None = None
    history: np.ndarray | None = None

    @property
    def figures(self) -> tuple[NoiseFigures, ...]:
        """N, B and K of each axis."""
        if self.models is not None:
            return tuple(model.noise for model in self.models)
        return tuple(NoiseFigures(float(white), 0.0, 0.0) for white in self.noise)


def describe_devices(
    recordings: xr.Dataset, bias: pd.DataFrame, allan: xr.Dataset, table: pd.DataFrame
) -> TestDevice:
    """What is known of the devices that test, from the recordings that do not test with them.

    Args:
        recordings: With the drawn values on simulated data.
        bias: Ground truth.
        allan: Allan variances.
        table: A windows table. A device is known if some fold in which it tests trains on it.
    """
    imus = sorted(table.imu[table.role == TEST].unique().tolist())
    places = table[table.origin == ORIGIN_REAL].drop_duplicates(["fold", "role", *_PLACE])
    learned = places[places.role != TEST]
    tests = places[places.role == TEST].groupby("imu").fold.unique()
    own = [learned[(learned.imu == imu) & learned.fold.isin(tests[imu])] for imu in imus]
    if len(imus) == 1 and len(own[0]):
        if recordings.attrs["simulated"]:
            return _describe_drawn(recordings, imus[0])
        of_imu = bias[bias.imu == imus[0]]
        means = of_imu.pivot(index="recording", columns="axis", values="bias_dps")
        tested = places.recording[places.role == TEST].unique()
        trained = means.loc[means.index.isin(own[0].recording)]
        return _describe_known(recordings, trained, means.loc[sorted(tested)], allan, imus[0])
    others = learned[learned.fold.isin(tests.explode())][_PLACE].drop_duplicates()
    return _describe_unseen(recordings, allan, sorted(map(tuple, others.to_numpy().tolist())), imus)


def training_labels(bias: pd.DataFrame, table: pd.DataFrame) -> dict[str, np.ndarray]:
    """Means of the tested device's training recordings in each fold, (n, axes), deg/s.

    Args:
        bias: Ground truth.
        table: A windows table.

    Returns:
        By fold, of those that test; empty where a fold has none, or several devices test.
    """
    places = table[table.origin == ORIGIN_REAL].drop_duplicates(["fold", "role", *_PLACE])
    tested = places.imu[places.role == TEST].unique().tolist()
    if len(tested) > 1:
        return {}
    means = bias[bias.imu == tested[0]].pivot(index="recording", columns="axis", values="bias_dps")
    own = places[(places.imu == tested[0]) & (places.role != TEST)]
    labels = {
        str(fold): means.loc[sorted(own.recording[own.fold == fold].unique())].to_numpy()
        for fold in places.fold[places.role == TEST].unique()
    }
    return labels if all(map(len, labels.values())) else {}


def _describe_unseen(
    recordings: xr.Dataset,
    allan: xr.Dataset,
    places: Sequence[tuple[int, int]],
    imus: Sequence[int],
) -> TestDevice:
    """Several devices, as one knows them who has never seen them.

    All that is known of their bias is the spread of units, for which that of the public DOT files
    is taken. It is so large that the ceiling is the running mean if the noise is white. Noise is
    that of all devices together, of which single ones have few recordings.

    Args:
        recordings: With the drawn values on simulated data.
        allan: Allan variances.
        places: IMU and number of the recordings to learn the noise from.
        imus: The devices.

    Returns:
        The axes of one IMU after those of another, in order. There is no interval.
    """
    if recordings.attrs["simulated"]:
        noise = recordings.true_noise.to_numpy()
        drawn = [_drawn_models(recordings.sel(imu=imu)) or () for imu in imus]
        models = tuple(_with_prior(model, 0.0, UNIT_SPREAD) for own in drawn for model in own)
    else:
        fits = _allan_fits(recordings, allan, [allan.sel(imu=i, recording=n) for i, n in places])
        noise = np.array([figures.white for figures in fits])
        fitted = _fitted_models(recordings, places) or ()
        own = tuple(_with_prior(model, float(model.mean[0]), UNIT_SPREAD) for model in fitted)
        models = own * len(imus)
    axes = np.tile(noise, len(imus))
    bias = np.zeros(axes.size) if recordings.attrs["simulated"] else None
    spread = np.full((1, axes.size), UNIT_SPREAD)
    return TestDevice(tuple(imus), axes, spread, bias, models or None)


def _with_prior(model: RecordingModel, mean: float, spread: float) -> RecordingModel:
    """A model with another prior of the bias, which is independent of the warm-up."""
    means, covariance = model.mean.copy(), np.diag(np.diag(model.covariance))
    means[0], covariance[0, 0] = mean, spread**2
    return replace(model, mean=means, covariance=covariance)


def _describe_drawn(recordings: xr.Dataset, imu: int) -> TestDevice:
    """A simulated IMU, of which everything is known."""
    return TestDevice(
        imus=(imu,),
        noise=recordings.true_noise.to_numpy(),
        spread=recordings.true_turn_on_spread.to_numpy()[None],
        unit_bias=recordings.true_unit_bias.sel(imu=imu).to_numpy(),
        models=_drawn_models(recordings.sel(imu=imu)),
    )


def _describe_known(
    recordings: xr.Dataset, means: pd.DataFrame, tested: pd.DataFrame, allan: xr.Dataset, imu: int
) -> TestDevice:
    """Noise and turn-on spread of an IMU.

    Args:
        recordings: Measured ones.
        means: Of the recordings to learn from, a row each; none of a hold-out's test ones.
        tested: Of those that test.
        allan: Allan variances.
        imu: Which.
    """
    labels = means.to_numpy()
    duration_s = recordings.sizes["sample"] / recordings.attrs["rate_hz"]
    numbers = means.index.tolist()
    variances = allan.sel(imu=imu, recording=numbers).load()
    fits = _allan_fits(recordings, allan, [variances.sel(recording=n) for n in numbers])
    noise = np.array([fit.white for fit in fits])
    models = _fitted_models(recordings, [(imu, number) for number in numbers])
    averaging = np.square(noise) / duration_s + _beyond_white(models, duration_s)
    spread = np.vstack([turn_on_spread(labels, averaging), spread_draws(labels, averaging, _DRAWS)])
    further = {} if models is None else {"history": _history(models, means, tested)}
    if len(labels) > len(AXES) and models is not None:
        further["joint"] = joint_draws(labels, averaging, _DRAWS)
    return TestDevice((imu,), noise, spread, None, models, **further)


def _history(
    models: Sequence[RecordingModel], means: pd.DataFrame, tested: pd.DataFrame
) -> np.ndarray:
    """Variance of a bias given the calibrations before it, mean over the tested ones, (axes,)."""
    variances = []
    for model, axis in zip(models, AXES, strict=True):
        fitted = BiasHistory.fit(means.index.to_numpy(), means[axis].to_numpy(), model)
        history = fitted.extended(tested.index.to_numpy(), tested[axis].to_numpy())
        priors = [history.prior(model, number) for number in tested.index.tolist()]
        variances.append(np.mean([prior.covariance[0, 0] for prior in priors]))
    return np.array(variances)


def _allan_fits(
    recordings: xr.Dataset, allan: xr.Dataset, chosen: Sequence[xr.Dataset]
) -> list[NoiseFigures]:
    """N, B and K of each axis from the Allan variances of some recordings."""
    variances, counts = (
        np.stack([one[name].to_numpy() for one in chosen])
        for name in ("allan_variance", "differences")
    )
    recording_s = recordings.sizes["sample"] / recordings.attrs["rate_hz"]
    durations_s = recording_s * (counts > 0).mean(axis=0)
    shortest_s, times_s = (
        SHORTEST_FIT_SAMPLES / recordings.attrs["rate_hz"],
        allan.time_s.to_numpy(),
    )
    mean = mean_variance(variances, counts[:, None])
    return [fit_noise(times_s, variance, durations_s, shortest_s) for variance in mean]


def _drawn_models(recordings: xr.Dataset) -> tuple[RecordingModel, ...] | None:
    """What each axis of an IMU was drawn from; None for white noise without a warm-up."""
    drawn = {
        name: float(recordings.get(f"true_{name}", 0.0)) for name in ("flicker", "random_walk")
    }
    warms_up = "true_amplitude" in recordings
    if not any(drawn.values()) and not warms_up:
        return None
    models = []
    for axis in recordings.axis.to_numpy():
        one = recordings.sel(axis=axis)
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
    recordings: xr.Dataset, places: Sequence[tuple[int, int]]
) -> tuple[RecordingModel, ...] | None:
    """Models of the axes; None of too few recordings.

    Args:
        recordings: All.
        places: IMU and number of those to fit to.
    """
    if len(places) < FEWEST_RECORDINGS:
        return None
    rates = [recordings.angular_rate.sel(imu=imu, recording=number) for imu, number in places]
    samples = np.stack(
        [fill_masked(one.transpose("axis", "sample").to_numpy()) for one in rates], 1
    )
    models = []
    for axis in samples:
        model = fit_recording_model(axis, float(recordings.attrs["rate_hz"]), warm_up=None)
        models.append(replace(model, covariance=np.diag(np.diag(model.covariance))))
    return tuple(models)


def _beyond_white(models: tuple[RecordingModel, ...] | None, duration_s: float) -> np.ndarray:
    """Variance by which recordings' means scatter beyond tau and N^2 / T, by axis."""
    if models is None:
        return np.zeros(len(AXES))
    return np.array([one.averaging_variance() - one.noise.white**2 / duration_s for one in models])
