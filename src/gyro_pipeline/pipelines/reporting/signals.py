"""The figures of signals: one function each, stored recordings in, a figure out."""

from typing import Any

import numpy as np
import pandas as pd
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator
from numpy.typing import NDArray

from gyro_pipeline.conventions import AXES, MDPS
from gyro_pipeline.parameters import GroundTruth, Published
from gyro_pipeline.physics.allan import FLICKER_FLOOR, SHORTEST_FIT_SAMPLES
from gyro_pipeline.physics.bias import fill_masked, settling_time_s
from gyro_pipeline.pipelines.reporting.style import CEILING, COLOURS, LOOK, share_legend
from gyro_pipeline.pipelines.reporting.tables import source_name

_GYROSCOPES = (1, 4, 10)
_FROM_S = 1.0
"""A running mean of less is mostly off the figure."""

_POINTS = 1300
"""More points of a running mean would not be seen."""

_HOUR_S = 3600


def running_average(
    recordings: xr.Dataset, bias: pd.DataFrame, ground_truth: GroundTruth
) -> Figure:
    """Running average of one gyroscope until it has converged (paper, section II, first figure).

    Args:
        recordings: Of the sensor shown; its first recording of IMU 1's first axis is taken.
        bias: Their ground truth, for the bias and the settling time.
        ground_truth: The tolerance.
    """
    one = _first(bias)
    times_s, means = _running_mean(_samples(recordings, one), recordings.attrs["rate_hz"])
    value, tolerance = one.bias_dps / MDPS, ground_truth.tolerance_mdps
    with LOOK():
        figure = Figure(figsize=(8.5, 4.2), layout="constrained")
        ax = figure.subplots()
        ax.plot(times_s, means / MDPS, color=COLOURS[0], label="running average")
        ax.axhline(value, color="black", lw=1, label="ground truth: mean of the recording")
        ax.axhspan(
            value - tolerance,
            value + tolerance,
            color=COLOURS[2],
            alpha=0.2,
            lw=0,
            label=f"± {tolerance:g} mdps",
        )
        ax.axvline(
            one.settling_time_s,
            color=CEILING,
            ls="--",
            label=f"stays within from {one.settling_time_s:.1f} s on",
        )
        _limit(ax, (means / MDPS)[times_s >= _FROM_S] - value, tolerance, value)
        ax.set(xlim=(0, times_s[-1]), xlabel="time [s]", ylabel="angular rate [mdps]")
        share_legend(figure, [ax], columns=2)
        figure.suptitle(f"Running average of one gyroscope: {_name(recordings, one)}")
    return figure


def calibrated_signal(recordings: xr.Dataset, bias: pd.DataFrame) -> Figure:
    """Raw and calibrated signal of the same gyroscope (paper, section II, second figure).

    Args:
        recordings: As for :func:`running_average`.
        bias: Their ground truth.
    """
    one = _first(bias)
    samples = _samples(recordings, one)
    times_s = np.arange(len(samples)) / recordings.attrs["rate_hz"]
    with LOOK():
        figure = Figure(figsize=(8.5, 4.2), layout="constrained")
        ax = figure.subplots()
        # as pixels also in the SVG, which would hold every sample otherwise
        style: dict[str, Any] = {"lw": 0.4, "rasterized": True}
        ax.plot(times_s, samples, color=COLOURS[0], label="raw", **style)
        ax.plot(times_s, samples - one.bias_dps, color=COLOURS[2], label="calibrated", **style)
        ax.axhline(one.bias_dps, color=COLOURS[1], lw=2, label="bias")
        ax.axhline(0, color="black", lw=1)
        ax.set(xlim=(0, times_s[-1]), xlabel="time [s]", ylabel="angular rate [deg/s]")
        share_legend(figure, [ax], columns=3)
        for line in figure.legends[0].get_lines():
            line.set_linewidth(2)
        figure.suptitle(f"Raw and calibrated signal: {_name(recordings, one)}")
    return figure


def mg_convergence(recordings: xr.Dataset, bias: pd.DataFrame, ground_truth: GroundTruth) -> Figure:
    """Running average over several gyroscopes (paper, section III-A, figure of MG convergence).

    Each gyroscope is centred by its own ground truth before they are averaged: biases of several
    deg/s would hide everything else.

    Args:
        recordings: Of the sensor shown; its first recording is taken.
        bias: Their ground truth.
        ground_truth: The tolerance.
    """
    one, rate_hz = _first(bias), recordings.attrs["rate_hz"]
    rates = recordings.angular_rate.sel(recording=one.recording).transpose("imu", "axis", "sample")
    lengths = recordings["samples"].sel(recording=one.recording).to_numpy()
    samples = rates.to_numpy()[lengths > 0, :, : lengths[lengths > 0].min()].astype(np.float64)
    samples = fill_masked(samples.reshape(-1, samples.shape[-1]))
    centred = samples - samples.mean(axis=1, keepdims=True)
    counts = [count for count in _GYROSCOPES if count <= len(centred)]
    tolerance = ground_truth.tolerance_mdps
    with LOOK():
        figure = Figure(figsize=(9.5, 3.6), layout="constrained")
        axes = figure.subplots(1, len(counts), sharex=True, sharey=True, squeeze=False)[0]
        for ax, count in zip(axes, counts, strict=True):
            for gyroscope in centred[:count]:
                times_s, alone = _running_mean(gyroscope, rate_hz)
                ax.plot(times_s, alone / MDPS, color="grey", lw=0.5, alpha=0.6, label="each alone")
            together = centred[:count].mean(axis=0)
            times_s, means = _running_mean(together, rate_hz)
            ax.plot(times_s, means / MDPS, color=COLOURS[0], lw=1.8, label="average of all")
            ax.axhspan(
                -tolerance,
                tolerance,
                color=COLOURS[2],
                alpha=0.2,
                lw=0,
                label=f"± {tolerance:g} mdps; settled: stays within from then on",
            )
            settled = float(settling_time_s(together, rate_hz, tolerance * MDPS))
            plural = "s" if count > 1 else ""
            ax.set(
                title=f"{count} gyroscope{plural}, settled at {settled:.1f} s",
                xlabel="time [s]",
                xlim=(0, times_s[-1]),
            )
        _, alone = _running_mean(centred, rate_hz)
        _limit(axes[0], (alone / MDPS)[:, times_s >= 2 * _FROM_S], tolerance)
        axes[0].set_ylabel("running average less ground truth [mdps]")
        share_legend(figure, axes, columns=3)
        figure.suptitle(
            f"Running average of several gyroscopes: {one.sensor} recording {one.recording}; "
            f"{_source(recordings)}"
        )
    return figure


def allan_deviation(published: Published, **stored: Any) -> Figure:
    """Allan deviation of every gyroscope, and the fitted N, B and K (IEEE Std 952).

    Args:
        published: Names the sensors, and their stated noise density.
        **stored: ``<sensor>_recordings``, ``<sensor>_allan`` and ``<sensor>_noise`` of each.
    """
    with LOOK():
        figure = Figure(figsize=(9.5, 7.2), layout="constrained")
        axes = figure.subplots(2, 2, sharex=True, sharey=True).ravel()
        for ax, sheet in zip(axes, published.specifications, strict=True):
            recordings, allan, noise = (
                stored[f"{sheet.sensor}_{name}"] for name in ("recordings", "allan", "noise")
            )
            _draw_allan(ax, allan, noise)
            if sheet.noise_density_mdps_rthz is not None:
                stated = sheet.noise_density_mdps_rthz / np.sqrt(2)
                ax.plot(
                    allan.time_s,
                    stated / np.sqrt(allan.time_s),
                    color="black",
                    ls=":",
                    label="white noise of the datasheet",
                )
            ax.set_title(f"{sheet.name}; {_source(recordings)}")
        for ax in axes[::2]:
            ax.set_ylabel("Allan deviation [mdps]")
        for ax in axes[2:]:
            ax.set_xlabel("averaging time [s]")
        share_legend(figure, axes, columns=3)
        figure.suptitle("Overlapping Allan deviation; N, B and K over all gyroscopes")
    return figure


def _draw_allan(ax: Axes, allan: xr.Dataset, noise: pd.DataFrame) -> None:
    times_s = allan.time_s.to_numpy()
    counts = allan.differences.fillna(0)
    variance = allan.allan_variance.weighted(counts).mean("recording")
    for one in variance.stack(gyroscope=("imu", "axis")).transpose("gyroscope", "time_s"):
        deviation = np.sqrt(one.to_numpy()) / MDPS
        ax.plot(times_s, deviation, color=COLOURS[0], lw=0.7, alpha=0.6, label="each gyroscope")
    columns = ["white_dps_rts", "instability_dps", "random_walk_dps_per_rts"]
    squares = (noise[columns] ** 2).mean()
    white, instability, walk = np.sqrt(squares)
    fitted_s = times_s[SHORTEST_FIT_SAMPLES * times_s[0] <= times_s]
    model = white**2 / fitted_s + FLICKER_FLOOR * instability**2 + walk**2 * fitted_s / 3
    ax.plot(fitted_s, np.sqrt(model) / MDPS, color=CEILING, ls="--", lw=1.5, label="fit of N, B, K")
    ax.text(
        0.04,
        0.06,
        f"N = {white / MDPS:.2f} mdps·√s\nB = {instability * _HOUR_S:.2g} deg/h\n"
        f"K = {walk / MDPS:.2g} mdps/√s",
        transform=ax.transAxes,
    )
    ax.set(xscale="log", yscale="log")
    ax.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
    for axis in (ax.xaxis, ax.yaxis):
        axis.set_major_formatter("{x:g}")
    ax.minorticks_off()


def _first(bias: pd.DataFrame) -> pd.Series:
    """The first axis of the first IMU, in its first recording."""
    own = bias[(bias.imu == bias.imu.min()) & (bias.axis == AXES[0])]
    return own.sort_values("recording").iloc[0]


def _samples(recordings: xr.Dataset, one: pd.Series) -> NDArray[np.float64]:
    """All samples of its own length; masked ones are their mean."""
    chosen = recordings.sel(imu=one.imu, recording=one.recording, axis=one.axis)
    samples = chosen.angular_rate.to_numpy()[: int(chosen["samples"])]
    return fill_masked(samples).astype(np.float64)


def _running_mean(
    samples: NDArray[np.float64], rate_hz: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Times in s, shape (points,), and the mean of all samples until then, shape (..., points)."""
    step = max(1, samples.shape[-1] // _POINTS)
    counts = np.arange(step, samples.shape[-1] + 1, step)
    return counts / rate_hz, np.cumsum(samples, axis=-1)[..., counts - 1] / counts


def _limit(ax: Axes, shown: NDArray[np.float64], tolerance: float, middle: float = 0.0) -> None:
    """Leave out what the running mean does at the very first, when it scatters most."""
    half = max(3 * tolerance, 1.1 * float(np.abs(shown).max()))
    ax.set_ylim(middle - half, middle + half)


def _name(recordings: xr.Dataset, one: pd.Series) -> str:
    return (
        f"{one.sensor} IMU {one.imu}, axis {one.axis}, recording {one.recording}; "
        f"{_source(recordings)}"
    )


def _source(recordings: xr.Dataset) -> str:
    return source_name(recordings.attrs["source"], bool(recordings.attrs["simulated"]))
