"""The figures of results: a function for each, with its caption."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator
from numpy.typing import NDArray

from gyro_pipeline.conventions import ALL, FIRST, MDPS, PAPER
from gyro_pipeline.estimators import DEFAULT, ORIENTATION_NOTE
from gyro_pipeline.parameters import PublishedResult
from gyro_pipeline.physics.ceiling import best_saving, ceiling_rmse, running_mean_rmse
from gyro_pipeline.pipelines.reporting.exhibits import (
    LEAK_VARIANTS,
    Exhibit,
    Material,
    ends,
    gyroscopes,
    label,
    where,
)
from gyro_pipeline.pipelines.reporting.results import column
from gyro_pipeline.pipelines.reporting.style import (
    CEILING,
    COLOURS,
    MARKERS,
    estimator_look,
    grid_shape,
    panels,
    plain_ticks,
    reach,
)
from gyro_pipeline.pipelines.reporting.tables import in_full, published_claim
from gyro_pipeline.studies import CNN, CONSTANT, MEAN

_TICKS_S = (1, 2, 5, 10, 20, 30, 60, 100)
_SHIFT = 0.11  # relative distance between the points of a window, which stand side by side
_MIN_SPAN = 2.5  # ratio of the ends of an axis of errors
_COMMON_SPREAD_MDPS = 10  # typical turn-on spread of consumer parts
_SPREADS_MDPS = np.geomspace(0.03, 30, 200)
_SAVINGS_PCT = (-25.0, 100.0)  # savings outside are drawn at the edge, as arrows
_ERROR = "RMSE against the recording's mean [mdps]"
_SECTIONS = {"sparkfun": "IV-E", "dot": "IV-F"}  # of the paper, on virtual gyroscopes
_GAINS_PCT = (-30.0, 102.0)
_ON_THE_SAME_WINDOWS = (("constant", "grey", "s"), ("oracle", CEILING, "x"))
_ON_CURVE = (
    "Left: all windows, the main result. Right: the first window of each recording, the paper's "
    "way. The line is the running mean against its length. Filled markers are the networks with "
    "95 % intervals, hollow ones the error that a published gain would mean on these data, bars "
    "the ceiling: the expected error of the best estimator under the noise model. Beside them "
    "stand the errors of a constant and, on simulated data, of the oracle on the same windows. "
    "Lower is better."
)


def forest(material: Material) -> Exhibit | None:
    """Published accuracy gains beside ours with intervals, a row for each."""
    claims = material.claims
    if all(material.result(claim, CNN).empty for claim in claims):
        return None
    names = [f"{material.sensor_name(claim.sensor)}, {gyroscopes(claim)}" for claim in claims]
    title = f"Published and ours, windows of 10 s; {material.source_name}"
    with _two_panels(title, (10.5, 1.9 + 0.42 * len(claims)), columns=6) as (figure, axes):
        for windows, ax in axes.items():
            for row, claim in enumerate(claims):
                _draw_claim(ax, material, claim, row, windows)
            ax.axvline(0, color="black", lw=1)
            ax.set(xlim=_GAINS_PCT, xlabel="accuracy gain A [%]")
            ax.grid(False, axis="y")
            ax.set_yticks(range(len(claims)), names)
            ax.set_ylim(len(claims) - 0.5, -0.5)
        axes[ALL].set_ylabel("tested sensor, gyroscopes in training")
    caption = (
        "A row for each published result. A, the accuracy gain, says how much smaller the error is "
        "than that of the mean of the same window: 0 is the running mean, 100 no error. Bars are "
        "95 % intervals over recordings. The ceiling is expected of the best estimator under white "
        "noise without drift or, if drawn or fitted, under the noise and warm-up of the "
        "recordings. The oracle, which knows the drawn values, is judged on the same windows as "
        "the others."
    )
    return Exhibit("forest", "The paper's ten rows and ours", caption, figure)


@contextmanager
def _two_panels(
    title: str, size: tuple[float, float], columns: int
) -> Iterator[tuple[Figure, dict[str, Axes]]]:
    """A figure with a panel for all windows and one for first windows, which are its keys."""
    with panels(title, size, (1, 2), columns, sharey=True) as (figure, (left, right)):
        left.set_title("all windows (main result)")
        right.set_title("first window (the paper's way)")
        yield figure, {ALL: left, FIRST: right}


def _draw_claim(
    ax: Axes, material: Material, claim: PublishedResult, row: int, windows: str
) -> None:
    gain = "accuracy_gain_pct"
    styles = [
        (CNN, COLOURS[0], "o", -0.3),
        (CONSTANT, COLOURS[1], "s", -0.1),
        (DEFAULT, COLOURS[2], "^", 0.1),
    ]
    for name, colour, marker, shift in styles:
        value, lo, hi = ends(material.result(claim, name), gain, windows)
        if np.isnan(value):
            continue
        shown, outside = max(value, _GAINS_PCT[0] + 2), value < _GAINS_PCT[0]
        ax.errorbar(
            [shown], [row + shift],
            xerr=None if outside else reach([value], [lo], [hi]),
            fmt="<" if outside else marker, color=colour, ms=4.5, capsize=2, lw=1.2,
            label=label(name),
        )  # fmt: skip
    network = material.result(claim, CNN)
    if network.empty:
        ax.text(2, row, material.status(claim), color="grey", va="center", fontsize=8)
    limit, lo, hi = ends(network, f"ceiling_{gain}", windows)
    if not np.isnan(limit):
        span = (lo, hi) if not np.isnan(lo) else (limit - 0.4, limit + 0.4)
        ax.fill_betweenx([row - 0.42, row + 0.42], *span, color=CEILING, alpha=0.35, lw=0)
        ax.plot([limit] * 2, [row - 0.42, row + 0.42], color=CEILING, lw=1.8, label="ceiling")
    oracle, _, _ = ends(network, f"oracle_{gain}", windows)
    if not np.isnan(oracle):
        ax.plot(oracle, row + 0.3, "x", color=CEILING, ms=6, mew=1.6, label="oracle")
    ax.plot(claim.accuracy_gain_pct, row, "D", mfc="none", mec="black", ms=7, label="published")


# the paper's figures


def augmentation(material: Material, sensor: str, real: int) -> Exhibit | None:
    """Real and virtual gyroscopes of SparkFun or DOT (paper, sections IV-E and IV-F, figures)."""
    rows = where(material.finished, study="augmentation", sensor=sensor)
    rows = rows[(rows.real_gyros == real) | (rows.estimator == MEAN)]
    claims = material.published.of_networks(sensor, real_gyros=real)
    title = f"{material.sensor_name(sensor)}: {real} real gyroscopes and virtual ones"
    words = (f"augmentation_{sensor}_{real}_real", title, _SECTIONS[sensor])
    return _on_curve(material, rows, claims, "virtual_gyros", words)


def input_channels(material: Material) -> Exhibit | None:
    """Method 1, more gyroscopes as input channels (paper, section IV-C, figure)."""
    rows = where(material.finished, study="input_channels", sensor="sparkfun")
    title = "Method 1: more gyroscopes as input channels"
    words = ("input_channels_input_channels", title, "IV-C")
    return _on_curve(material, rows, [], "real_gyros", words)


def training_data(material: Material) -> Exhibit | None:
    """Method 2, more gyroscopes as training data (paper, section IV-D, first figure)."""
    rows = where(material.finished, study="real2real", sensor="sparkfun")
    claims = material.published.of_networks("sparkfun", virtual_gyros=0)
    words = ("real2real_training_data", "Method 2: more gyroscopes as training data", "IV-D")
    return _on_curve(material, rows, claims, "real_gyros", words)


def _on_curve(
    material: Material,
    rows: pd.DataFrame,
    claims: Sequence[PublishedResult],
    by: str,
    words: tuple[str, str, str],
) -> Exhibit | None:
    """RMSE of the running mean against its length, and of the networks at theirs.

    Networks of a study on a sensor differ in the count ``by``, ``real_gyros`` or ``virtual_gyros``.
    ``words`` are the name, the title and the section of the paper.
    """
    if where(rows, estimator=CNN).empty:
        return None
    name, title, section = words
    study, sensor = rows[["study", "sensor"]].iloc[0]
    curves = where(material.curves, study=study, sensor=sensor)
    heading = f"{title}; {material.source_name}"
    with _two_panels(heading, (9.5, 4.8), columns=3) as (figure, axes):
        for windows, ax in axes.items():
            _draw_curve(ax, rows, where(curves, windows=windows), windows, claims, by)
    return Exhibit(name, title, f"{_ON_CURVE} Paper, section {section}.", figure)


def _draw_curve(  # noqa: PLR0917 - contents of a panel
    ax: Axes,
    results: pd.DataFrame,
    curve: pd.DataFrame,
    windows: str,
    claims: Sequence[PublishedResult],
    by: str,
) -> None:
    kind = by.removesuffix("_gyros")
    ax.plot(curve.time_s, curve.rmse_dps / MDPS, color="black", lw=1.2, label="running mean")
    limits = where(results, estimator=MEAN).sort_values("window_s")
    bars = limits[column("ceiling_rmse_dps", windows)] / MDPS
    ax.plot(limits.window_s, bars, "_", color=CEILING, ms=30, mew=2, label="ceiling")
    _draw_on_the_same_windows(ax, limits, windows)
    networks = where(results, estimator=CNN)
    sizes = sorted(networks[by].unique())
    for i, size in enumerate(sizes):
        rows = networks[networks[by] == size]
        shift = 1 + _SHIFT * (i - (len(sizes) - 1) / 2)
        base = column("test_rmse_dps", windows)
        rmse, lo, hi = (rows[f"{base}{end}"] / MDPS for end in ("", "_lo", "_hi"))
        ax.errorbar(
            rows.window_s * shift, rmse, yerr=reach(rmse, lo, hi),
            fmt=MARKERS[i], color=COLOURS[i], capsize=2.5, ms=5,
            label=f"network, {size} {kind}, 95 % interval",
        )  # fmt: skip
        for claim in [claim for claim in claims if getattr(claim, by) == size][:1]:
            means = rows[rows.window_s == claim.window_s][column("mean_rmse_dps", windows)] / MDPS
            ax.plot(
                [claim.window_s * shift] * len(means), means * (1 - claim.accuracy_gain_pct / 100),
                MARKERS[i], color=COLOURS[i], ms=9, mfc="none", label=f"published, {size} {kind}",
            )  # fmt: skip
    _time_axis(ax, float(curve.time_s.max()))
    ax.set(yscale="log", ylabel=_ERROR if windows == ALL else None)
    ax.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
    ax.yaxis.set_major_formatter("{x:g}")
    # The error of the mean of the whole recording is 0, which has no logarithm.
    ax.set_ylim(0.08, 1.5 * (curve.rmse_dps / MDPS)[curve.time_s >= _TICKS_S[0]].max())


def _draw_on_the_same_windows(ax: Axes, limits: pd.DataFrame, windows: str) -> None:
    """The errors of a constant and the oracle, beside those of the networks."""
    for name, colour, marker in _ON_THE_SAME_WINDOWS:
        errors = limits.get(column(f"{name}_rmse_dps", windows))
        if errors is not None and errors.notna().any():
            ax.plot(limits.window_s * 1.25, errors / MDPS, marker, color=colour, label=name)


def _time_axis(ax: Axes, recording_s: float) -> None:
    ax.set(
        xscale="log",
        xlabel="calibration time [s], points of a window side by side",
        xlim=(1, 1.02 * recording_s),
    )
    ax.set_xticks([t for t in _TICKS_S if t <= recording_s], minor=False)
    ax.xaxis.set_major_formatter("{x:g}")
    ax.minorticks_off()


def gyroscopes_10s(material: Material) -> Exhibit | None:
    """RMSE at 10 s against the number of gyroscopes (paper, section IV-D, second figure)."""
    claims = material.published.of_networks("sparkfun", virtual_gyros=0)
    rows = where(material.finished, study="real2real", sensor="sparkfun", estimator=CNN)
    rows = rows[rows.window_s == claims[0].window_s] if claims else rows[:0]
    if rows.empty:
        return None
    title = "Method 2: error at 10 s against the number of gyroscopes"
    heading = f"{title}; {material.source_name}"
    with _two_panels(heading, (9.5, 4.2), columns=4) as (figure, axes):
        for windows, ax in axes.items():
            _draw_bars(ax, rows.sort_values("real_gyros"), claims, windows)
    caption = "Left: all windows, the main result. Right: the paper's way. Lower is better."
    caption += " Paper, section IV-D."
    return Exhibit("real2real_gyroscopes_10s", title, caption, figure)


def _draw_bars(
    ax: Axes, networks: pd.DataFrame, claims: Sequence[PublishedResult], windows: str
) -> None:
    x, base = np.arange(len(networks)), column("test_rmse_dps", windows)
    rmse, lo, hi = (networks[f"{base}{end}"] / MDPS for end in ("", "_lo", "_hi"))
    bars: dict[str, Any] = {"yerr": reach(rmse, lo, hi), "color": COLOURS[0], "capsize": 3}
    ax.bar(x, rmse, 0.6, label="network, 95 % interval", **bars)
    mean = float(networks[column("mean_rmse_dps", windows)].iloc[0]) / MDPS
    ax.axhline(mean, color="black", lw=1.5, label="model-based: running mean")
    limit = float(networks[column("ceiling_rmse_dps", windows)].iloc[0]) / MDPS
    ax.axhline(limit, color=CEILING, ls="--", lw=1.5, label="ceiling")
    for name, colour, _ in _ON_THE_SAME_WINDOWS:
        error, _, _ = ends(networks.iloc[0], f"{name}_rmse_dps", windows)
        if not np.isnan(error):
            ax.axhline(error / MDPS, color=colour, ls=":", lw=1.5, label=name)
    gains_pct = {claim.real_gyros: claim.accuracy_gain_pct for claim in claims}
    errors = mean * (1 - networks.real_gyros.map(gains_pct) / 100)
    ax.plot(x, errors, "D", color=COLOURS[1], ms=9, mfc="none", mew=1.8, label="published")
    ax.set_xticks(x, networks.real_gyros.astype(str).tolist())
    ax.set(xlabel="gyroscopes in the training set", ylabel=_ERROR if windows == ALL else None)
    ax.set_axisbelow(True)
    ax.grid(False, axis="x")


# what can be saved


def saving_against_turn_on_spread(material: Material) -> Exhibit | None:
    """The possible time saving at 10 s against the turn-on spread, and that of the networks.

    The curve of a sensor is the ceiling with its N and T and the same spread on all axes. A network
    stands at the spread that gives its ceiling: that of the sensor, if its axes share one.
    """
    rows = where(material.finished, study="real2real", estimator=CNN)
    claims = material.published.of_table("generalization")
    rows = rows[rows.window_s.isin([claim.window_s for claim in claims])]
    claims = [claim for claim in claims if (rows.sensor == claim.sensor).any()]
    if not claims:
        return None
    title, (high, wide) = f"What 10 s can save; {material.source_name}", grid_shape(len(claims))
    size = (9.5, 1.2 + 3 * high)
    with panels(title, size, (high, wide), sharex=True, sharey=True) as (figure, axes):
        for ax, claim in zip(axes, claims, strict=False):
            _draw_savings(ax, where(rows, sensor=claim.sensor).sort_values("real_gyros"), claim)
        for ax in axes[::wide]:
            ax.set_ylabel("time saving S, all windows [%]")
        for ax in axes[-wide:]:
            ax.set_xlabel("turn-on spread τ [mdps], points of a sensor side by side")
    caption = (
        "The turn-on spread τ is the change of the bias from one power-on to the next; it decides "
        "how much can be gained. The line is the ceiling of a sensor with that spread under white "
        "noise without drift, markers are the savings of the networks with 95 % intervals."
    )
    name = "real2real_saving_against_turn_on_spread"
    return Exhibit(name, "What can be saved, against the turn-on spread", caption, figure)


def equal_spread(row: pd.Series, bound: str = "") -> float:
    """The turn-on spread tau that, on all axes, gives the ceiling of a result.

    It inverts rho^2 = r + (1 - r) q / (1 + q) with q = tau^2 T0 / N^2; see physics/ceiling.py.

    Args:
        row: A result.
        bound: ``_lo`` or ``_hi`` for an end of the ceiling gain's interval; tau falls with it.

    Returns:
        deg/s; 0 where the ceiling is that of a known bias.
    """
    rho = 1 - row[column("ceiling_accuracy_gain_pct", FIRST) + bound] / 100
    r = row.window_s / row.recording_s
    beta = np.clip((rho**2 - r) / (1 - r), 0, 1 - 1e-9)
    return float(_pooled_noise(row) * np.sqrt(beta / (1 - beta) / row.window_s))


def _pooled_noise(row: pd.Series) -> float:
    """N over all axes, deg/s sqrt(s), from the running mean that the ceiling is compared with."""
    rmse, gain_pct = (row[column(f"ceiling_{n}", FIRST)] for n in ("rmse_dps", "accuracy_gain_pct"))
    mean = rmse / (1 - gain_pct / 100)
    return float(mean / np.sqrt(1 / row.window_s - 1 / row.recording_s))


def _best_saving_pct(row: pd.Series, spreads_dps: NDArray[np.float64]) -> NDArray[np.float64]:
    noise, times = _pooled_noise(row), (row.window_s, row.recording_s)
    limit = ceiling_rmse(noise, spreads_dps, *times, PAPER)
    rho = limit / running_mean_rmse(noise, *times, PAPER)
    return 100 * best_saving(rho, row.window_s / row.recording_s)


def _draw_savings(ax: Axes, rows: pd.DataFrame, claim: PublishedResult) -> None:
    curve = _best_saving_pct(rows.iloc[0], _SPREADS_MDPS * MDPS)
    ax.plot(_SPREADS_MDPS, curve, color=CEILING, lw=1.5, label="ceiling")
    ax.axhline(claim.time_saving_pct, color="black", ls=":", label="published saving")
    common = f"common for consumer parts: {_COMMON_SPREAD_MDPS} mdps"
    ax.axvline(_COMMON_SPREAD_MDPS, color="grey", ls="--", lw=1, label=common)
    for i, (_, row) in enumerate(rows.iterrows()):
        shift = 1 + 0.14 * (i - (len(rows) - 1) / 2)
        _draw_saving(ax, row, shift, COLOURS[i], MARKERS[i])
    ax.set(xscale="log", xlim=(_SPREADS_MDPS[0], _SPREADS_MDPS[-1]), ylim=_SAVINGS_PCT)
    ax.set_title(f"{claim.sensor}; published with {claim.real_gyros} gyroscopes")
    ax.xaxis.set_major_formatter("{x:g}")


def _draw_saving(ax: Axes, row: pd.Series, shift: float, colour: str, marker: str) -> None:
    spreads = np.array([equal_spread(row, bound) for bound in ("", "_hi", "_lo")]) / MDPS
    x = np.clip(spreads * shift, _SPREADS_MDPS[0], _SPREADS_MDPS[-1])
    saving, lo, hi = (
        float(np.clip(value, *_SAVINGS_PCT)) for value in ends(row, "time_saving_pct", ALL)
    )
    outside = {_SAVINGS_PCT[0]: "v", _SAVINGS_PCT[1]: "^"}
    ax.errorbar(
        x[0], saving, yerr=reach([saving], [lo], [hi]), xerr=reach(x[:1], x[1:2], x[2:]),
        fmt=outside.get(saving, marker), color=colour, capsize=2.5, ms=5, clip_on=False,
        label=f"network, {row.real_gyros} real, 95 % interval",
    )  # fmt: skip


# estimators


def estimators(material: Material, study: str, sensor: str) -> Exhibit | None:
    """RMSE of all estimators of a study against the window length, with the ceiling."""
    rows = where(material.finished, study=study, sensor=sensor)
    if rows.empty:
        return None
    title = f"{material.sensor_name(sensor)}, {study.replace('_', ' ')}: error against window"
    heading = f"{title}, all windows; {material.source_name}"
    with panels(heading, (10, 5.6), (1, 2), columns=4) as (figure, (left, right)):
        _draw_estimators(left, right, rows)
    caption = (
        "Left: error over all windows. Right: the same relative to the running mean. Related "
        "estimators share a colour, filled markers are the recommended estimators. The dashed line "
        "is the ceiling, on measured data an estimate. Lower is better. Estimators in black need "
        f"no training recordings; every other one {ORIENTATION_NOTE}."
    )
    return Exhibit(f"{study}_{sensor}", title, caption, figure)


def _draw_estimators(left: Axes, right: Axes, rows: pd.DataFrame) -> None:
    means = where(rows, estimator=MEAN).set_index("window_s").sort_index()
    names = pd.Series([in_full(row, rows) for _, row in rows.iterrows()], rows.index)
    groups = rows.groupby(names, sort=False)
    for number, (name, results) in enumerate(groups):
        rmse = results.drop_duplicates("window_s").set_index("window_s").test_rmse_dps.sort_index()
        look = estimator_look(results.estimator.iloc[0], bool(results.recommended.any()), number)
        shift = 1 + 0.015 * (number - groups.ngroups / 2)
        ratio = rmse / means.test_rmse_dps.reindex(rmse.index)
        for ax, values in ((left, rmse / MDPS), (right, ratio)):
            ax.plot(values.index * shift, values, label=name, **look)
    limit = means.ceiling_rmse_dps.astype(float)
    for ax, values in ((left, limit / MDPS), (right, limit / means.test_rmse_dps)):
        dash = "--" if len(values) > 1 else "_"
        ax.plot(values.index, values, dash, color=CEILING, lw=2, ms=30, mew=2, label="ceiling")
    if "oracle_rmse_dps" in means and means.oracle_rmse_dps.notna().any():
        oracle = means.oracle_rmse_dps.astype(float)
        for ax, values in ((left, oracle / MDPS), (right, oracle / means.test_rmse_dps)):
            ax.plot(values.index, values, "x", color=CEILING, label="oracle")
    for ax in (left, right):
        ax.set(xscale="log", yscale="log", xlabel="window length [s], points side by side")
        ax.set_xticks(means.index.tolist(), minor=False)
        low, high = ax.get_ylim()
        widen = max(np.sqrt(_MIN_SPAN * low / high), 1)  # small differences must look small
        ax.set_ylim(low / widen, high * widen)
        ax.yaxis.set_major_locator(LogLocator(subs=(1, 1.5, 2, 3, 5, 7)))
        plain_ticks(ax)
    left.set_ylabel("RMSE against the recording's mean [mdps]")
    right.set_ylabel("RMSE / RMSE of the running mean")


# the leak study


def leakage_against_stride(material: Material) -> Exhibit | None:
    """A against the window stride, for the split by recording and for each leak."""
    if material.leaks.empty:
        return None
    sensors = list(dict.fromkeys(material.leaks.sensor))
    with panels(None, (9.5, 1.2 + 4.4 * len(sensors)), (len(sensors), 1)) as (figure, axes):
        for ax, sensor in zip(axes, sensors, strict=True):
            _draw_leaks(ax, material, where(material.leaks, sensor=sensor))
    caption = (
        "Windows whose starts differ by a whole number of hops of the network look almost the same "
        "to it. Split at random, they are near-duplicates that can be learned by heart."
    )
    title = "Trained with leaks on purpose: accuracy gain against the window stride"
    return Exhibit("leakage_accuracy_against_stride", title, caption, figure)


def _draw_leaks(ax: Axes, material: Material, results: pd.DataFrame) -> None:
    first, strides = results.iloc[0], np.sort(results.window_stride_s.unique())
    styles = [*zip(COLOURS, MARKERS, strict=True)]
    for i, ((leak, estimator), name) in enumerate(LEAK_VARIANTS.items()):
        rows = where(results, leak=leak, estimator=estimator).sort_values("window_stride_s")
        gain, lo, hi = (rows[f"accuracy_gain_pct{end}"] for end in ("", "_lo", "_hi"))
        ax.errorbar(
            np.searchsorted(strides, rows.window_stride_s) + 0.09 * (i - len(LEAK_VARIANTS) // 2),
            gain, yerr=reach(gain, lo, hi), color=styles[i][0], marker=styles[i][1],
            ls=":" if estimator != CNN else "-", lw=1, ms=5, capsize=2.5, label=name,
        )  # fmt: skip
    limit, claim = first.ceiling_accuracy_gain_pct, published_claim(material, first)
    ax.axhline(limit, color=CEILING, ls="--", label="ceiling")
    ax.axhline(0, color="black", lw=1, label="running mean")
    if claim is not None:
        words = f"published, {claim.real_gyros} gyroscopes"
        ax.axhline(claim.accuracy_gain_pct, color="black", ls=":", label=words)
    hops = results.drop_duplicates("window_stride_s").set_index("window_stride_s").hops
    ax.set_xticks(np.arange(len(strides)), [_stride_label(s, hops[s]) for s in strides])
    ax.grid(False, axis="x")
    ax.set(
        xlabel="window stride [s], ways of one stride side by side",
        ylabel="accuracy gain A in the test windows [%]",
        title=f"{first.sensor}, {first.window_s:g} s windows of {first.recordings} recordings; "
        f"{material.source_name}; 95 % intervals",
    )


def _stride_label(stride_s: float, hops: float) -> str:
    if np.isnan(hops):
        return f"{stride_s:g}"
    whole = abs(hops - round(hops)) < 0.01  # noqa: PLR2004 - a rounding error
    return f"{stride_s:g}\n{'= ' if whole else ''}{hops:.3g} hop{'s' if hops > 1.01 else ''}"  # noqa: PLR2004
