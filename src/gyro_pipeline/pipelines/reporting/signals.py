"""The figures of recordings: a function for each, drawn from the tables of ``describe``."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator

from gyro_pipeline.conventions import AXES, MDPS
from gyro_pipeline.parameters import GroundTruth
from gyro_pipeline.pipelines.reporting.exhibits import Exhibit, Material, where
from gyro_pipeline.pipelines.reporting.recordings import GYROSCOPES, WARM_UPS_S
from gyro_pipeline.pipelines.reporting.style import (
    CEILING,
    COLOURS,
    grid_shape,
    panels,
    plain_ticks,
)

_FROM_S = 1.0  # a shorter running mean is mostly off the figure
_HOUR_S = 3600
_TOLERANCE = "The band is the tolerance around the mean of the recording, which counts as truth."


def drift(material: Material) -> Exhibit | None:
    """Mean rate against time after power-on, over all recordings of each tested IMU."""
    lines = where(material.signals, figure="drift")
    if lines.empty:
        return None
    title = f"Mean rate against time after power-on; {material.source_name}"
    with _sensor_panels(material, title, columns=4, sharey=False) as (figure, axes):
        for ax, sensor in axes:
            rows = where(lines, sensor=sensor)
            for axis, colour in zip(AXES, COLOURS, strict=False):
                line = where(rows, line=axis)
                ax.plot(line.x, line.y / MDPS, color=colour, lw=1.4, label=f"axis {axis}")
                band = line.lo / MDPS, line.hi / MDPS
                ax.fill_between(line.x, *band, color=colour, alpha=0.18, lw=0)
            for axis, colour in zip(AXES, COLOURS, strict=False):
                fit = rows[rows.line.str.startswith(f"{axis},")]
                if len(fit):
                    ax.plot(
                        fit.x, fit.y / MDPS, color=colour, ls="--", lw=1, label="fitted warm-up"
                    )
            ax.axhline(0, color="black", lw=0.8)
            ax.set(title=material.sensor_name(sensor), xlabel="time after power-on [s]")
            ax.set_ylabel("mean rate less its end [mdps]")
    caption = (
        "The mean over all recordings of the tested IMU, each centred by its last quarter, with "
        "its 95 % interval. A line at 0 is a bias that does not move; a line that starts off 0 is "
        "a warm-up, which any estimator that knows the device, even a constant, can correct. White "
        "noise without drift, the premise of the ceiling, means a line at 0. Dashed is a fitted "
        f"warm-up, if it is significant. {_bounds(material)}"
    )
    return Exhibit("drift", "Does the rate drift after power-on?", caption, figure)


def _bounds(material: Material) -> str:
    """The largest warm-up amplitude that recordings allow, by sensor and time constant."""
    if not material.warm_ups_allowed_mdps:
        return "Single recordings do not bound the amplitude of a warm-up."
    times_s = "/".join(f"{time_s:g}" for time_s in WARM_UPS_S)
    sizes = ", ".join(
        "/".join(f"{bound:.2g}" for bound in bounds) + f" mdps ({name})"
        for name, bounds in material.warm_ups_allowed_mdps.items()
    )
    return (
        f"The 95 % intervals allow an amplitude of at most {sizes} for time constants of {times_s} "
        "s, on the worst axis."
    )


def allan_deviation(material: Material) -> Exhibit | None:
    """Allan deviation of every gyroscope, and the fitted N, B and K (IEEE Std 952)."""
    lines = where(material.signals, figure="allan")
    if lines.empty:
        return None
    title = f"Overlapping Allan deviation; {material.source_name}"
    with _sensor_panels(material, title, columns=3, sharey=True) as (figure, axes):
        for ax, sensor in axes:
            rows, sheet = where(lines, sensor=sensor), material.sheets.get(sensor)
            _draw_allan(ax, rows, material.described[sensor])
            if sheet is not None and sheet.noise_density_mdps_rthz is not None:
                times_s = np.sort(rows.x.unique())
                stated = sheet.noise_density_mdps_rthz / np.sqrt(2) / np.sqrt(times_s)
                ax.plot(times_s, stated, "k:", label="white noise of the datasheet")
            ax.set(title=material.sensor_name(sensor), xlabel="averaging time [s]")
            ax.set_ylabel("Allan deviation [mdps]")
    caption = (
        "The scatter of averages against their length. White noise falls as 1/√t; flicker (B) and "
        "random walk (K) bend the curve upwards. The dashed line is the fit over all gyroscopes."
    )
    return Exhibit("allan_deviation", "Allan deviation of every gyroscope", caption, figure)


def _draw_allan(ax: Axes, lines: Any, row: pd.Series) -> None:
    fit = lines.line.str.startswith("fit")
    for _, gyroscope in lines[~fit].groupby("line"):
        ax.plot(gyroscope.x, gyroscope.y / MDPS, color=COLOURS[0], lw=0.7, alpha=0.6,
                label="each gyroscope")  # fmt: skip
    ax.plot(lines.x[fit], lines.y[fit] / MDPS, color=CEILING, ls="--", label="fit of N, B, K")
    text = (
        f"N = {row.white_dps_rts / MDPS:.2f} mdps·√s\nB = {row.instability_dps * _HOUR_S:.2g} "
        f"deg/h\nK = {row.random_walk_dps_per_rts / MDPS:.2g} mdps/√s"
    )
    ax.text(0.04, 0.06, text, transform=ax.transAxes)
    ax.set(xscale="log", yscale="log")
    ax.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
    plain_ticks(ax)


def running_average(material: Material, ground_truth: GroundTruth) -> Exhibit | None:
    """Running average of one gyroscope until it has converged (paper, section II)."""
    lines = _example_lines(material)
    if lines.empty:
        return None
    mean, settled = (where(lines, figure=name) for name in ("running average", "bias"))
    settled_s, bias = float(settled.x.iloc[0]), float(settled.y.iloc[0]) / MDPS
    tolerance = ground_truth.tolerance_mdps
    title = "Running average of one gyroscope"
    heading = f"{title}: {_gyroscope(material, mean)}"
    with panels(heading, (8.5, 4.2), columns=2) as (figure, (ax,)):
        ax.plot(mean.x, mean.y / MDPS, color=COLOURS[0], label="running average")
        ax.axhline(bias, color="black", lw=1, label="ground truth: mean of the recording")
        _band(ax, bias, tolerance, f"± {tolerance:g} mdps")
        label = f"stays within from {settled_s:.1f} s on"
        ax.axvline(settled_s, color=CEILING, ls="--", label=label)
        _set_limits(ax, (mean.y[mean.x >= _FROM_S] / MDPS - bias).to_numpy(), tolerance, bias)
        ax.set(xlim=(0, mean.x.max()), xlabel="time [s]", ylabel="angular rate [mdps]")
    caption = f"{_TOLERANCE} Paper, section II."
    return Exhibit("running_average", title, caption, figure)


def calibrated_signal(material: Material) -> Exhibit | None:
    """Raw and calibrated signal of the same gyroscope (paper, section II, second figure)."""
    lines = _example_lines(material)
    if lines.empty:
        return None
    raw, mean, settled = (
        where(lines, figure=name) for name in ("signal", "running average", "bias")
    )
    bias = float(settled.y.iloc[0])
    title = f"Raw and calibrated signal: {_gyroscope(material, mean)}"
    with panels(title, (8.5, 4.2)) as (figure, (ax,)):
        # as pixels also in the SVG, which would hold every sample otherwise
        style: dict[str, Any] = {"lw": 0.4, "rasterized": True}
        ax.plot(raw.x, raw.y, color=COLOURS[0], label="raw", **style)
        ax.plot(raw.x, raw.y - bias, color=COLOURS[2], label="calibrated", **style)
        ax.axhline(bias, color=COLOURS[1], lw=2, label="bias")
        ax.axhline(0, color="black", lw=1)
        ax.set(xlim=(0, raw.x.max()), xlabel="time [s]", ylabel="angular rate [deg/s]")
    for handle in figure.legends[0].get_lines():
        handle.set_linewidth(2)
    caption = "Calibrated is the raw signal less the bias. Paper, section II."
    title = "Raw and calibrated signal of the same gyroscope"
    return Exhibit("calibrated_signal", title, caption, figure)


def mg_convergence(material: Material, ground_truth: GroundTruth) -> Exhibit | None:
    """Running average over several gyroscopes (paper, section III-A, figure of MG convergence)."""
    lines = _example_lines(material)
    if lines.empty:
        return None
    tolerance = ground_truth.tolerance_mdps
    together = {count: where(lines, figure=f"convergence {count}") for count in GYROSCOPES}
    together = {count: line for count, line in together.items() if len(line)}
    times_s = together[1].x
    alone = np.reshape(where(lines, figure="convergence").y / MDPS, (-1, len(times_s)))
    title, sensor = "Running average of several gyroscopes", lines.sensor.iloc[0]
    heading = f"{title}: {material.sensor_name(sensor)}; {material.source_name}"
    shape = (1, len(together))
    with panels(heading, (9.5, 3.6), shape, sharex=True, sharey=True) as (figure, axes):
        for ax, (count, line) in zip(axes, together.items(), strict=True):
            for single in alone[:count]:
                ax.plot(line.x, single, color="grey", lw=0.5, alpha=0.6, label="each alone")
            ax.plot(line.x, line.y / MDPS, color=COLOURS[0], lw=1.8, label="average of all")
            _band(ax, 0, tolerance, f"± {tolerance:g} mdps; settled: stays within from then on")
            plural = "s" if count > 1 else ""
            ax.set(title=f"{count} gyroscope{plural}, {line.line.iloc[0]}", xlabel="time [s]")
            ax.set_xlim(0, line.x.max())
        _set_limits(axes[0], alone[:, times_s >= 2 * _FROM_S], tolerance)
        axes[0].set_ylabel("running average less ground truth [mdps]")
    caption = (
        "Each gyroscope is centred by its bias before averaging: biases of several deg/s would "
        f"hide everything else. {_TOLERANCE} Paper, section III-A."
    )
    return Exhibit("mg_convergence", title, caption, figure)


def _example_lines(material: Material) -> pd.DataFrame:
    """The lines of SparkFun or, without it, of the first sensor."""
    lines = where(material.signals, sensor="sparkfun")
    first = material.signals.sensor.head(1)
    return lines if len(lines) else material.signals[material.signals.sensor.isin(first)]


@contextmanager
def _sensor_panels(
    material: Material, title: str, columns: int, sharey: bool
) -> Iterator[tuple[Figure, list[tuple[Axes, str]]]]:
    """A figure with a panel for every sensor."""
    sensors = material.signals.sensor.unique().tolist()
    shape = grid_shape(len(sensors))
    with panels(title, (9.5, 1.2 + 3 * shape[0]), shape, columns, sharey=sharey) as (figure, axes):
        for ax in axes[len(sensors) :]:
            ax.remove()
        yield figure, list(zip(axes, sensors, strict=False))


def _gyroscope(material: Material, line: pd.DataFrame) -> str:
    """The sensor, gyroscope and recording of a line, for titles."""
    sensor = material.sensor_name(line.sensor.iloc[0])
    return f"{sensor} {line.line.iloc[0]}; {material.source_name}"


def _band(ax: Axes, middle: float, tolerance: float, words: str) -> None:
    ends = middle - tolerance, middle + tolerance
    ax.axhspan(*ends, color=COLOURS[2], alpha=0.2, lw=0, label=words)


def _set_limits(ax: Axes, values: np.ndarray, tolerance: float, middle: float = 0.0) -> None:
    """Fit the y axis to values, from which the scatter of the first moments is left out."""
    half = max(3 * tolerance, 1.1 * float(np.abs(values).max()))
    ax.set_ylim(middle - half, middle + half)
