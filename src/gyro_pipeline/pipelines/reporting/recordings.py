"""The description of a sensor by its recordings: noise, drift and hours, as tables."""

from collections.abc import Iterator
from typing import Any

import numpy as np
import pandas as pd
import xarray as xr
from numpy.typing import NDArray

from gyro_pipeline.conventions import AXES, MDPS, NOISE_COLUMNS, TEST, InputError
from gyro_pipeline.logs import KEPT, REJECTED, REPAIRED
from gyro_pipeline.parameters import GroundTruth
from gyro_pipeline.physics.allan import FLICKER_FLOOR, SHORTEST_FIT_SAMPLES
from gyro_pipeline.physics.bias import fill_masked, settling_time_s
from gyro_pipeline.physics.recording_model import block_edges, block_means
from gyro_pipeline.physics.turn_on import turn_on_spread
from gyro_pipeline.physics.warm_up import LAST, fit_common_warm_up, settling
from gyro_pipeline.recordings import iterate_recordings, tested_imu

SIGMAS_MDPS = (1.0, 0.5)
"""Standard deviations of the bias for which the time of a start-up is computed."""

GYROSCOPES = (1, 4, 10)
"""Numbers of gyroscopes that the paper averages in its figure of convergence."""

_DRIFT_POINTS = 24  # per recording; with many more, noise would hide the drift
WARM_UPS_S = (5.0, 20.0, 60.0)
"""Time constants of the warm-ups whose amplitudes recordings bound."""
_FITTED_S = (*WARM_UPS_S, 7.0, 10.0, 14.0, 30.0, 40.0)
"""Time constants of which the most significant one is drawn."""

_CHANCE = 0.05  # of a warm-up that is drawn where there is none
_WORST_FIRST = (REJECTED, REPAIRED, KEPT)
_MAX_ROWS = 20  # recordings of a sensor with a row in the quality table
_POINTS = 1300  # of a running mean; more would not be visible


def describe(  # noqa: PLR0913, PLR0917 - a node's arguments are its datasets
    recordings: xr.Dataset,
    bias: pd.DataFrame,
    noise: pd.DataFrame,
    allan: xr.Dataset,
    quality: pd.DataFrame,
    ground_truth: GroundTruth,
    virtual: xr.Dataset | None = None,
) -> dict[str, pd.DataFrame]:
    """Describe a sensor by its recordings, angular rates in deg/s.

    Returns:
        ``description``, one row; ``quality``, the table of the report; and ``signals``, the lines
        of figures: ``figure, line, x, y, lo, hi, sensor``.
    """
    row = {name: recordings.attrs[name] for name in ("sensor", "source", "rate_hz")}
    row |= {"simulated": bool(recordings.attrs["simulated"]), "imus": recordings.sizes["imu"]}
    row |= _counts(recordings, virtual) | _noise(noise) | start_up(recordings, bias, noise)
    drifts, bounds = drift(recordings)
    signals = [
        *_signals(recordings, bias, ground_truth.tolerance_mdps * MDPS),
        *_allan_lines(allan, noise),
        drifts,
    ]
    return {
        "description": pd.DataFrame([row | bounds]),
        "quality": recording_quality(quality),
        "signals": pd.concat(signals, ignore_index=True).assign(sensor=row["sensor"]),
    }


def drift(recordings: xr.Dataset) -> tuple[pd.DataFrame, dict[str, float]]:
    """Mean rate against time after power-on, over all recordings of the tested IMU.

    Each recording is centred by the mean of its last quarter, so that only changes within a
    recording are left: a warm-up that all power-ons share stands out, noise averages out.

    The shortest tenth of the recordings is left out.

    Returns:
        Lines for each axis: times ``x``, seconds, the mean ``y``, deg/s, with its 95 % interval
        over recordings, ``lo`` and ``hi``, NaN for a single recording; and the warm-up fitted with
        the most significant time constant, if it is significant at the 5 % level. Then, as
        ``warm_up_bound_dps_<time constant>``, the largest amplitude of any axis that the 95 %
        interval allows.
    """
    recordings = recordings.sel(imu=[tested_imu(recordings)])
    lengths = recordings["samples"].to_numpy()
    length = int(np.quantile(lengths[lengths > 0], 0.1, method="lower"))
    rate_hz = recordings.attrs["rate_hz"]
    edges = block_edges(length, round(rate_hz))
    means = np.stack([
        block_means(fill_masked(samples[:, :length].astype(float)), edges)
        for _, _, samples in iterate_recordings(recordings)
        if samples.shape[-1] >= length
    ])  # fmt: skip
    blocks_hz = means.shape[-1] * rate_hz / length
    coarse = block_means(means, block_edges(means.shape[-1], means.shape[-1] // _DRIFT_POINTS))
    drifts = settling(coarse, coarse.shape[-1] * rate_hz / length)
    fits = {time_s: fit_common_warm_up(means, blocks_hz, time_s) for time_s in _FITTED_S}
    bounds = {f"warm_up_bound_dps_{t:g}": float(fits[t].bound.max()) for t in WARM_UPS_S}
    lines = [
        _line("drift", axis, drifts.time_s, rate, half)
        for axis, rate, half in zip(AXES, drifts.rate, drifts.half, strict=True)
    ]
    time_s = min(fits, key=lambda t: fits[t].p.prod())
    if fits[time_s].p.min() * len(AXES) * len(fits) < _CHANCE:
        decay = np.exp(-drifts.time_s / time_s)
        decay -= decay[drifts.time_s >= drifts.time_s[-1] * (1 - LAST)].mean()
        for axis, amplitude in zip(AXES, fits[time_s].amplitude, strict=True):
            name = f"{axis}, warm-up of {time_s:g} s"
            lines.append(_line("drift", name, drifts.time_s, amplitude * decay))
    return pd.concat(lines, ignore_index=True), bounds


def start_up(recordings: xr.Dataset, bias: pd.DataFrame, noise: pd.DataFrame) -> dict[str, float]:
    """Seconds at rest after which the bias of the tested IMU is known, pooled over its axes.

    The mean of t seconds has the variance N^2/t + (0.664 B)^2 + K^2 t/3. It is combined with the
    mean of earlier calibrations, about which the bias scatters by the turn-on spread; for the
    ceiling this mean is known exactly. There is no warm-up, and power-ons are exchangeable.

    Returns:
        ``spread_dps`` and ``white_dps_rts`` of each axis, and ``<method>_s_at_<sigma>`` of the
        methods mean, history and ceiling: 0 if the history alone suffices, infinite if it takes
        longer than a recording, NaN if the noise is unknown.
    """
    rate_hz, own = recordings.attrs["rate_hz"], noise[noise.imu == tested_imu(recordings)]
    white, flicker, walk = own.set_index("axis").loc[list(AXES), list(NOISE_COLUMNS)].T.to_numpy()
    recording_s = float(recordings["samples"].max()) / rate_hz
    averaging = white**2 / recording_s
    spread, count = _turn_on_spread(recordings, bias, averaging)
    times_s = np.geomspace(1 / rate_hz, recording_s, 4000)[:, None]
    mean = white**2 / times_s + FLICKER_FLOOR * flicker**2 + walk**2 * times_s / 3
    priors = {
        "mean": np.full(len(AXES), np.inf),
        "history": spread**2 + (spread**2 + averaging) / count,
        "ceiling": spread**2,
    }
    row = {"spread_dps": float(np.sqrt(np.mean(spread**2))), "history_recordings": count}
    row |= {f"spread_dps_{axis}": value for axis, value in zip(AXES, spread, strict=True)}
    row |= {f"white_dps_rts_{axis}": value for axis, value in zip(AXES, white, strict=True)}
    for method, prior in priors.items():
        with np.errstate(divide="ignore"):
            variance = (1 / (1 / mean + 1 / prior)).mean(axis=1)
        for sigma in SIGMAS_MDPS:
            reached = variance <= (sigma * MDPS) ** 2
            time_s = times_s[reached.argmax(), 0] if reached.any() else np.inf
            time_s = 0.0 if prior.mean() <= (sigma * MDPS) ** 2 else float(time_s)
            row[f"{method}_s_at_{sigma:g}"] = np.nan if np.isnan(variance).any() else time_s
    return row


def _turn_on_spread(
    recordings: xr.Dataset, bias: pd.DataFrame, averaging: NDArray[np.float64]
) -> tuple[NDArray[np.float64], int]:
    """Spread of the tested IMU, (axes,), deg/s, and the number of recordings that it is from."""
    training = bias[bias.imu == tested_imu(recordings)]
    if "split" in recordings.coords:
        held_out = recordings.recording[recordings.split == TEST].to_numpy()
        training = training[~training.recording.isin(held_out)]
    means = training.pivot(index="recording", columns="axis", values="bias_dps")[list(AXES)]
    if "true_turn_on_spread" in recordings:
        return recordings.true_turn_on_spread.to_numpy(), len(means)
    try:
        return turn_on_spread(means.to_numpy(), averaging), len(means)
    except InputError:  # a single recording
        return np.full(len(AXES), np.nan), len(means)


def recording_quality(table: pd.DataFrame) -> pd.DataFrame:
    """Count the recordings that were kept, repaired and rejected, and list those with findings.

    Of a table with a row per IMU and recording, it makes a row for the sensor, and below it the
    recordings with findings, the worst first.
    """
    sensor, used = table.sensor.iloc[0], (table.stop - table.start).dropna()
    noted = table[(table.outcome != KEPT) | table.findings.notna()]
    noted = noted.sort_values(
        "outcome", key=lambda word: word.map(_WORST_FIRST.index), kind="stable"
    )
    counts = [f"{(table.outcome == word).sum()} {word}" for word in _WORST_FIRST[::-1]]
    rows: list[dict[str, Any]] = [
        {
            "Sensor": sensor,
            "IMU": f"all {table.imu.nunique()}",
            "Recording": f"all {len(table)}",
            "File": None,
            "Outcome": ", ".join(counts),
            "Rows used": _lengths(used) if len(used) else "none",
            "Findings": f"in {len(noted)} recordings" if len(noted) else "none",
        }
    ]
    rows += [_quality_row(row) for _, row in noted.head(_MAX_ROWS).iterrows()]
    if len(noted) > _MAX_ROWS:
        rest = f"in {len(noted) - _MAX_ROWS} further recordings"
        rows.append({"Sensor": sensor, "Findings": rest})
    return pd.DataFrame(rows)


def _lengths(rows: pd.Series) -> str:
    """The number of rows in the shortest and in the longest recording."""
    lowest, highest = f"{rows.min():.0f}", f"{rows.max():.0f}"
    return f"{lowest} of each" if lowest == highest else f"{lowest} to {highest}"


def _quality_row(row: pd.Series) -> dict[str, Any]:
    used = "none" if pd.isna(row.stop) else f"{row.start:.0f} to {row.stop - 1:.0f}"
    return {
        "Sensor": row.sensor,
        "IMU": str(row.imu),
        "Recording": str(row.recording),
        "File": row.file,
        "Outcome": row.outcome,
        "Rows used": f"{used} of {row.rows}",
        "Findings": row.findings,
    }


def _noise(noise: pd.DataFrame) -> dict[str, float]:
    """Root mean square over gyroscopes, with the smallest and the largest."""
    row: dict[str, float] = {}
    for name, values in noise[["sample_sigma_dps", *NOISE_COLUMNS]].items():
        row[f"{name}"] = float(np.sqrt((values**2).mean()))
        row |= {f"{name}_min": float(values.min()), f"{name}_max": float(values.max())}
    return row


def _counts(recordings: xr.Dataset, virtual: xr.Dataset | None) -> dict[str, float]:
    """Numbers of gyroscopes, recordings and samples that train, test, or do either.

    Training recordings, including those for validation, count for every gyroscope, test recordings
    for the three of the tested IMU; in a k-fold all recordings do both, virtual ones only train.
    """
    samples = recordings["samples"].load()
    train = samples > 0
    test = train & (train.imu == tested_imu(recordings))
    if "split" in recordings.coords:
        train, test = train & (recordings.split != TEST), test & (recordings.split == TEST)
    kinds = {"": (samples, train, test)}
    if virtual is not None:
        samples = virtual["samples"].load()
        train = (samples > 0) & (virtual.recording <= virtual.attrs["train_recordings"])
        kinds["virtual_"] = samples, train, xr.zeros_like(train)
    row: dict[str, float] = {}
    for kind, (samples, train, test) in kinds.items():
        row[f"{kind}gyroscopes"] = len(AXES) * int(train.any("recording").sum())
        row[f"{kind}median_samples"] = float(samples.where(samples > 0).median())
        for name, part in (("train", train), ("test", test), ("all", train | test)):
            row[f"{kind}{name}_recordings"] = len(AXES) * int(part.sum())
            row[f"{kind}{name}_samples"] = len(AXES) * int((samples * part).sum())
    return row


def _allan_lines(allan: xr.Dataset, noise: pd.DataFrame) -> Iterator[pd.DataFrame]:
    """Lines with the Allan deviation of each gyroscope, and with the fit of N, B and K over all."""
    times_s = allan.time_s.to_numpy()
    counts = allan.differences.fillna(0)
    variance = allan.allan_variance.weighted(counts).mean("recording")
    for imu in allan.imu.to_numpy().tolist():
        for axis in AXES:
            deviation = np.sqrt(variance.sel(imu=imu, axis=axis).to_numpy())
            yield _line("allan", f"IMU {imu}, axis {axis}", times_s, deviation)
    white, flicker, walk = (noise[list(NOISE_COLUMNS)] ** 2).mean().to_numpy()
    fitted_s = times_s[SHORTEST_FIT_SAMPLES * times_s[0] <= times_s]
    model = white / fitted_s + FLICKER_FLOOR * flicker + walk * fitted_s / 3
    yield _line("allan", "fit of N, B, K", fitted_s, np.sqrt(model))


def _signals(
    recordings: xr.Dataset, bias: pd.DataFrame, tolerance_dps: float
) -> Iterator[pd.DataFrame]:
    """Lines of the paper's figures of signals, from the first recording of the tested IMU."""
    rate_hz, first = recordings.attrs["rate_hz"], bias[bias.imu == tested_imu(recordings)]
    row = first[first.axis == AXES[0]].sort_values("recording").iloc[0]
    rates = recordings.angular_rate.sel(recording=row.recording).transpose("imu", "axis", "sample")
    lengths = recordings["samples"].sel(recording=row.recording).to_numpy()
    samples = rates.to_numpy()[lengths > 0, :, : lengths[lengths > 0].min()].astype(np.float64)
    samples = fill_masked(samples.reshape(-1, samples.shape[-1])).astype(np.float64)
    times_s, means = _running_mean(samples, rate_hz)
    yield _line("signal", "raw", np.arange(samples.shape[-1]) / rate_hz, samples[0])
    label = f"IMU {row.imu}, axis {row.axis}, recording {row.recording}"
    yield _line("running average", label, times_s, means[0])
    settled_s = float(settling_time_s(samples[0], rate_hz, tolerance_dps))
    yield _line("bias", label, np.array([settled_s]), samples[:1].mean(axis=1))
    means -= samples.mean(axis=1, keepdims=True)
    centred = samples - samples.mean(axis=1, keepdims=True)
    for count in (count for count in GYROSCOPES if count <= len(means)):
        settled_s = float(settling_time_s(centred[:count].mean(axis=0), rate_hz, tolerance_dps))
        average = means[:count].mean(axis=0)
        yield _line(f"convergence {count}", f"settled at {settled_s:.1f} s", times_s, average)
    for single in means[: max(GYROSCOPES)]:
        yield _line("convergence", "each alone", times_s, single)


def _line(
    figure: str,
    line: str,
    x: NDArray[np.float64],
    y: NDArray[np.float64],
    half: float | NDArray[np.float64] = np.nan,
) -> pd.DataFrame:
    """A line of a figure, with an interval of y ± half."""
    ends = {"lo": y - half, "hi": y + half}
    return pd.DataFrame({"figure": figure, "line": line, "x": x, "y": y, **ends})


def _running_mean(
    samples: NDArray[np.float64], rate_hz: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Times, (points,), seconds, and the mean of all samples up to each, (..., points)."""
    step = max(1, samples.shape[-1] // _POINTS)
    counts = np.arange(step, samples.shape[-1] + 1, step)
    return counts / rate_hz, np.cumsum(samples, axis=-1)[..., counts - 1] / counts
