"""The figures of results: one function each, results in, a figure out."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator
from numpy.typing import ArrayLike, NDArray

from gyro_pipeline.conventions import ALL, FIRST, LEAVE_ONE_DEVICE_OUT, MDPS, PAPER, Missing
from gyro_pipeline.parameters import Published, PublishedResult
from gyro_pipeline.physics.ceiling import best_saving, ceiling_rmse, running_mean_rmse
from gyro_pipeline.pipelines.reporting.style import (
    CEILING,
    COLOURS,
    LOOK,
    MARKERS,
    estimator_look,
    share_legend,
)
from gyro_pipeline.pipelines.reporting.tables import measured_elsewhere, source_of
from gyro_pipeline.studies import CNN, MEAN

_TITLES = {ALL: "all windows (main result)", FIRST: "first window (the paper's way)"}
_TICKS_S = (1, 2, 5, 10, 20, 30, 60, 100)
_SHIFT = 0.11
"""Points of one window stand side by side: so much apart, relative to the time."""

_LEAST_SPAN = 2.5
"""Of an axis of errors, largest over smallest."""

_COMMON_SPREAD_MDPS = 10
"""Turn-on spread that is common for consumer parts."""

_SPREADS_MDPS = np.geomspace(0.03, 30, 200)
_SAVINGS_PCT = (-25.0, 100.0)
"""Savings outside are drawn at the edge, as arrows."""


def sparkfun_3_real(
    results: pd.DataFrame, curves: pd.DataFrame, published: Published
) -> Figure | Missing:
    """SparkFun, 3 real and virtual gyroscopes (paper, section IV-E, first figure)."""
    return _augmentation(results, curves, published, "sparkfun", 3)


def sparkfun_12_real(
    results: pd.DataFrame, curves: pd.DataFrame, published: Published
) -> Figure | Missing:
    """SparkFun, 12 real and virtual gyroscopes (paper, section IV-E, second figure)."""
    return _augmentation(results, curves, published, "sparkfun", 12)


def dot_3_real(
    results: pd.DataFrame, curves: pd.DataFrame, published: Published
) -> Figure | Missing:
    """Movella DOT, 3 real and virtual gyroscopes (paper, section IV-F, first figure)."""
    return _augmentation(results, curves, published, "dot", 3)


def dot_12_real(
    results: pd.DataFrame, curves: pd.DataFrame, published: Published
) -> Figure | Missing:
    """Movella DOT, 12 real and virtual gyroscopes (paper, section IV-F, second figure)."""
    return _augmentation(results, curves, published, "dot", 12)


def input_channels(results: pd.DataFrame, curves: pd.DataFrame) -> Figure | Missing:
    """Method 1, more gyroscopes as input channels, SparkFun (paper, section IV-C, figure)."""
    title = "sparkfun: Method 1, gyroscopes as input channels"
    return _on_curve(_of(results, "sparkfun"), curves, [], "real_gyros", title)


def training_data(
    results: pd.DataFrame, curves: pd.DataFrame, published: Published
) -> Figure | Missing:
    """Method 2, more gyroscopes as training data, SparkFun (paper, section IV-D, first figure)."""
    claims = published.of_networks("sparkfun", virtual_gyros=0)
    title = "sparkfun: Method 2, gyroscopes as training data"
    return _on_curve(_of(results, "sparkfun"), curves, claims, "real_gyros", title)


def gyroscopes_10s(results: pd.DataFrame, published: Published) -> Figure | Missing:
    """RMSE at 10 s against the number of gyroscopes (paper, section IV-D, second figure)."""
    claims = published.of_networks("sparkfun", virtual_gyros=0)
    window_s = claims[0].window_s
    shown = _of(results, "sparkfun").query("window_s == @window_s")
    if lacking := tuple(shown.missing.dropna()):
        return Missing(lacking)
    with LOOK():
        figure = Figure(figsize=(9.5, 4.2), layout="constrained")
        axes = figure.subplots(1, 2, sharey=True)
        for ax, windows in zip(axes, (ALL, FIRST), strict=True):
            _draw_bars(ax, shown, claims, windows)
        axes[0].set_ylabel("RMSE against the recording's mean [mdps]")
        share_legend(figure, axes, columns=4)
        figure.suptitle(
            f"sparkfun: Method 2, {window_s:g} s of calibration; {source_of(shown.iloc[0])}"
        )
    return figure


def saving_against_turn_on_spread(
    results: pd.DataFrame, elsewhere: pd.DataFrame, published: Published
) -> Figure | Missing:
    """What can be saved at 10 s against the turn-on spread, and what the networks save.

    A sensor's curve is the ceiling with its N and T and one spread on all axes. A network stands
    at the spread that gives its own ceiling: the sensor's, where its axes have one.

    Args:
        results: Networks on real recordings.
        elsewhere: On measured data of other sources.
        published: For the paper's savings and the number of gyroscopes they are for.
    """
    claims = published.of_table("generalization")
    window_s = claims[0].window_s
    shown = results[(results.window_s == window_s) & (results.estimator == CNN)]
    if lacking := tuple(shown.missing.dropna()):
        return Missing(lacking)
    with LOOK():
        figure = Figure(figsize=(9.5, 7.2), layout="constrained")
        axes = figure.subplots(2, 2, sharex=True, sharey=True).ravel()
        for ax, claim in zip(axes, claims, strict=True):
            own = shown[shown.sensor == claim.sensor].sort_values("real_gyros")
            _draw_savings(ax, own, measured_elsewhere(elsewhere, claim), claim)
        for ax in axes[::2]:
            ax.set_ylabel("time saving S, all windows [%]")
        for ax in axes[2:]:
            ax.set_xlabel("turn-on spread τ [mdps], points of a sensor side by side")
        share_legend(figure, axes, columns=3)
        figure.suptitle(f"What {window_s:g} s can save; {source_of(shown.iloc[0])}")
    return figure


def equal_spread(row: pd.Series, bound: str = "") -> float:
    """The turn-on spread tau that, on all axes, gives the ceiling of a result.

    It inverts rho^2 = r + (1 - r) q / (1 + q) with q = tau^2 T0 / N^2; see physics/ceiling.py.

    Args:
        row: A result.
        bound: ``_lo`` or ``_hi`` for an end of the ceiling gain's interval; tau falls with it.

    Returns:
        deg/s; 0 where the ceiling is that of a known bias.
    """
    rho = 1 - row[f"ceiling_accuracy_gain_pct{bound}"] / 100
    r = row.window_s / row.recording_s
    beta = np.clip((rho**2 - r) / (1 - r), 0, 1 - 1e-9)
    return float(_pooled_noise(row) * np.sqrt(beta / (1 - beta) / row.window_s))


def _pooled_noise(row: pd.Series) -> float:
    """N over all axes, deg/s sqrt(s), from the running mean that the ceiling is compared with."""
    mean = row.ceiling_rmse_dps / (1 - row.ceiling_accuracy_gain_pct / 100)
    return float(mean / np.sqrt(1 / row.window_s - 1 / row.recording_s))


def _best_saving_pct(row: pd.Series, spreads_dps: NDArray[np.float64]) -> NDArray[np.float64]:
    noise, times = _pooled_noise(row), (row.window_s, row.recording_s)
    limit = ceiling_rmse(noise, spreads_dps, *times, PAPER)
    rho = limit / running_mean_rmse(noise, *times, PAPER)
    return 100 * best_saving(rho, row.window_s / row.recording_s)


def estimators(results: pd.DataFrame, elsewhere: pd.DataFrame, sensor: str) -> Figure | Missing:
    """RMSE of all estimators against the window length.

    Args:
        results: From ``pool_results``.
        elsewhere: From ``pool_measured_elsewhere``.
        sensor: Whose.

    Returns:
        A row of panels for each source of the recordings.
    """
    own = _of(results, sensor)
    if lacking := tuple(own.missing.dropna()):
        return Missing(lacking)
    sources = [own, *(rows for _, rows in _of(elsewhere, sensor).groupby("source"))]
    with LOOK():
        figure = Figure(figsize=(10, 1.6 + 4 * len(sources)), layout="constrained")
        axes = figure.subplots(len(sources), 2, squeeze=False)
        for (left, right), rows in zip(axes, sources, strict=True):
            _draw_estimators(left, right, rows)
        share_legend(figure, axes.ravel(), columns=4)
        unseen = own.protocol.iloc[0] == LEAVE_ONE_DEVICE_OUT
        whose = f"{sensor}, unseen devices" if unseen else sensor
        figure.suptitle(f"{whose}: error against window length, all windows")
    return figure


def _draw_estimators(left: Axes, right: Axes, rows: pd.DataFrame) -> None:
    means = rows[rows.estimator == MEAN].set_index("window_s").sort_index()
    for place, (name, own) in enumerate(rows.groupby("estimator", sort=False)):
        rmse = own.set_index("window_s").test_rmse_dps_all.sort_index()
        look = estimator_look(str(name), bool(own.recommended.any()))
        shift = 1 + 0.015 * (place - rows.estimator.nunique() / 2)
        for ax, values in ((left, rmse / MDPS), (right, rmse / means.test_rmse_dps_all)):
            ax.plot(values.index * shift, values, **look)
    limit = means.ceiling_rmse_dps_all
    for ax, values in ((left, limit / MDPS), (right, limit / means.test_rmse_dps_all)):
        ax.plot(values.index, values, color=CEILING, lw=2, ls="--", label="ceiling")
        ax.set(xscale="log", yscale="log", xlabel="window length [s], points side by side")
        ax.set_xticks(means.index.tolist(), minor=False)
        low, high = ax.get_ylim()
        widen = max(np.sqrt(_LEAST_SPAN * low / high), 1)  # what differs by little must look so
        ax.set_ylim(low / widen, high * widen)
        ax.yaxis.set_major_locator(LogLocator(subs=(1, 1.5, 2, 3, 5, 7)))
        for axis in (ax.xaxis, ax.yaxis):
            axis.set_major_formatter("{x:g}")
        ax.minorticks_off()
    title = source_of(rows.iloc[0])
    left.set(title=title, ylabel="RMSE against the recording's mean [mdps]")
    right.set(title=title, ylabel="RMSE / RMSE of the running mean")


def _of(results: pd.DataFrame, sensor: str) -> pd.DataFrame:
    return results[results.sensor == sensor]


def _augmentation(
    results: pd.DataFrame, curves: pd.DataFrame, published: Published, sensor: str, real: int
) -> Figure | Missing:
    of_sensor = _of(results, sensor)
    shown = of_sensor[(of_sensor.real_gyros == real) | (of_sensor.estimator == MEAN)]
    claims = published.of_networks(sensor, real_gyros=real)
    title = f"{sensor}: {real} real gyroscopes and virtual ones"
    return _on_curve(shown, curves, claims, "virtual_gyros", title)


def _on_curve(
    shown: pd.DataFrame,
    curves: pd.DataFrame,
    claims: Sequence[PublishedResult],
    by: str,
    title: str,
) -> Figure | Missing:
    """Running-mean RMSE against its length, with the networks' points at theirs.

    Args:
        shown: The running mean and the networks of one sensor.
        curves: The running mean's, of all sensors.
        claims: The paper's results for the same networks.
        by: What the networks differ in, ``real_gyros`` or ``virtual_gyros``.
        title: Without the source.
    """
    if lacking := tuple(shown.missing.dropna()):
        return Missing(lacking)
    first = shown.iloc[0]
    curve = _of(curves, first.sensor)
    with LOOK():
        figure = Figure(figsize=(9.5, 4.8), layout="constrained")
        axes = figure.subplots(1, 2, sharey=True)
        for ax, windows in zip(axes, (ALL, FIRST), strict=True):
            _draw_panel(ax, shown, curve[curve.windows == windows], windows, claims, by)
        axes[0].set_ylabel("RMSE against the recording's mean [mdps]")
        share_legend(figure, axes, columns=3)
        figure.suptitle(f"{title}; {source_of(first)}")
    return figure


def _draw_panel(  # noqa: PLR0917 - what a panel shows
    ax: Axes,
    results: pd.DataFrame,
    curve: pd.DataFrame,
    windows: str,
    claims: Sequence[PublishedResult],
    by: str,
) -> None:
    suffix, kind = _suffix(windows), by.removesuffix("_gyros")
    ax.plot(curve.time_s, curve.rmse_dps / MDPS, color="black", lw=1.2, label="running mean")
    limits = results[results.estimator == MEAN].sort_values("window_s")
    ax.plot(
        limits.window_s,
        limits.ceiling_rmse_dps / MDPS,
        **_bar(CEILING),
        label="ceiling: expected of the best possible",
    )
    networks = results[results.estimator == CNN]
    sizes = sorted(networks[by].unique())
    for i, size in enumerate(sizes):
        rows = networks[networks[by] == size]
        shift = 1 + _SHIFT * (i - (len(sizes) - 1) / 2)
        rmse, lo, hi = (rows[f"test_rmse_dps{suffix}{end}"] / MDPS for end in ("", "_lo", "_hi"))
        ax.errorbar(
            rows.window_s * shift,
            rmse,
            yerr=_reach(rmse, lo, hi),
            fmt=MARKERS[i],
            color=COLOURS[i],
            capsize=2.5,
            ms=5,
            label=f"network, {size} {kind}, 95 % interval",
        )
        for claim in [claim for claim in claims if getattr(claim, by) == size][:1]:
            mean = rows[rows.window_s == claim.window_s][f"mean_rmse_dps{suffix}"] / MDPS
            ax.plot(
                claim.window_s * shift,
                mean * (1 - claim.accuracy_gain_pct / 100),
                **_hollow(COLOURS[i], MARKERS[i]),
                label=f"published, {size} {kind}",
            )
    _time_axis(ax, float(curve.time_s.max()))
    ax.set(yscale="log", title=_TITLES[windows])
    ax.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
    ax.yaxis.set_major_formatter("{x:g}")
    # The curve against the recording's own mean ends at 0, which has no logarithm.
    ax.set_ylim(0.08, 1.5 * (curve.rmse_dps / MDPS)[curve.time_s >= _TICKS_S[0]].max())


def _draw_bars(
    ax: Axes, shown: pd.DataFrame, claims: Sequence[PublishedResult], windows: str
) -> None:
    suffix = _suffix(windows)
    networks = shown[shown.estimator == CNN].sort_values("real_gyros")
    places = np.arange(len(networks))
    rmse, lo, hi = (networks[f"test_rmse_dps{suffix}{end}"] / MDPS for end in ("", "_lo", "_hi"))
    ax.bar(
        places,
        rmse,
        0.6,
        yerr=_reach(rmse, lo, hi),
        color=COLOURS[0],
        capsize=3,
        label="network, 95 % interval",
    )
    mean = float(networks[f"mean_rmse_dps{suffix}"].iloc[0]) / MDPS
    ax.axhline(mean, color="black", lw=1.5, label="model-based: running mean")
    limit = float(networks.ceiling_rmse_dps.iloc[0]) / MDPS
    ax.axhline(limit, color=CEILING, ls="--", lw=1.5, label="ceiling: expected of the best")
    gains = {claim.real_gyros: claim.accuracy_gain_pct for claim in claims}
    known = [i for i, gyros in enumerate(networks.real_gyros) if gyros in gains]
    stated = [mean * (1 - gains[networks.real_gyros.iloc[i]] / 100) for i in known]
    ax.plot(known, stated, **_hollow(COLOURS[1], "D"), mew=1.8, label="published")
    ax.set_xticks(places, networks.real_gyros.astype(str).tolist())
    ax.set(xlabel="gyroscopes in the training set", title=_TITLES[windows])
    ax.set_axisbelow(True)
    ax.grid(False, axis="x")


def _draw_savings(
    ax: Axes, own: pd.DataFrame, others: Sequence[pd.Series], claim: PublishedResult
) -> None:
    curve = _best_saving_pct(own.iloc[0], _SPREADS_MDPS * MDPS)
    ax.plot(_SPREADS_MDPS, curve, color=CEILING, lw=1.5, label="ceiling")
    ax.axhline(
        claim.time_saving_pct,
        color="black",
        ls=":",
        label="the paper's saving",
    )
    ax.axvline(
        _COMMON_SPREAD_MDPS, color="grey", ls="--", lw=1, label="common for consumer parts: 10 mdps"
    )
    for i, (_, row) in enumerate(own.iterrows()):
        shift = 1 + 0.14 * (i - (len(own) - 1) / 2)
        label = f"network, {row.real_gyros} real, 95 % interval"
        _draw_saving(ax, row, shift, COLOURS[i], MARKERS[i], label)
    for row in others:
        split = "k-fold" if row.folds > 1 else "hold-out"
        label = f"network, {row.real_gyros} real, source {source_of(row)}, {split}"
        _draw_saving(ax, row, 1, "black", "*", label)
    ax.set(
        xscale="log",
        xlim=(_SPREADS_MDPS[0], _SPREADS_MDPS[-1]),
        ylim=_SAVINGS_PCT,
        title=f"{claim.sensor}; the paper's with {claim.real_gyros} gyroscopes",
    )
    ax.xaxis.set_major_formatter("{x:g}")


def _draw_saving(  # noqa: PLR0917 - what a point shows
    ax: Axes, row: pd.Series, shift: float, colour: str, marker: str, label: str
) -> None:
    spreads = np.array([equal_spread(row, bound) for bound in ("", "_hi", "_lo")]) / MDPS
    x = np.clip(spreads * shift, _SPREADS_MDPS[0], _SPREADS_MDPS[-1])
    saving, lo, hi = (
        float(np.clip(row[f"time_saving_pct_{ALL}{end}"], *_SAVINGS_PCT))
        for end in ("", "_lo", "_hi")
    )
    outside = {_SAVINGS_PCT[0]: "v", _SAVINGS_PCT[1]: "^"}
    ax.errorbar(
        x[0],
        saving,
        yerr=_reach([saving], [lo], [hi]),
        xerr=_reach(x[:1], x[1:2], x[2:]),
        fmt=outside.get(saving, marker),
        color=colour,
        capsize=2.5,
        ms=9 if marker == "*" else 5,
        clip_on=False,
        label=label,
    )


def _reach(values: ArrayLike, lo: ArrayLike, hi: ArrayLike) -> NDArray[np.float64]:
    """Lengths of error bars, shape (2, n); a bootstrap interval need not hold its value."""
    given = np.asarray(values, np.float64)
    lengths = [given - np.asarray(lo, np.float64), np.asarray(hi, np.float64) - given]
    return np.maximum(lengths, 0.0)


def _suffix(windows: str) -> str:
    return "" if windows == FIRST else f"_{windows}"


def _time_axis(ax: Axes, recording_s: float) -> None:
    ax.set(
        xscale="log",
        xlabel="calibration time [s], points of a window side by side",
        xlim=(1, 1.02 * recording_s),
    )
    ax.set_xticks([t for t in _TICKS_S if t <= recording_s], minor=False)
    ax.xaxis.set_major_formatter("{x:g}")
    ax.minorticks_off()


def _bar(colour: str) -> dict[str, Any]:
    return {"color": colour, "marker": "_", "ms": 30, "mew": 2, "ls": ""}


def _hollow(colour: str, marker: str) -> dict[str, Any]:
    return {"color": colour, "marker": marker, "ms": 9, "mfc": "none", "ls": ""}
