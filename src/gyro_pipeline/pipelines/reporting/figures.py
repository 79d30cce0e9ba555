"""How the figures look: results in, a matplotlib figure out."""

from collections.abc import Sequence
from typing import Any

import matplotlib as mpl
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator

from gyro_pipeline.conventions import ALL, FIRST, MDPS
from gyro_pipeline.parameters import Published
from gyro_pipeline.studies import CNN, MEAN

# Okabe and Ito's palette: distinct for all common kinds of colour vision.
_COLOURS = ("#0072B2", "#E69F00", "#009E73", "#CC79A7")
_MARKERS = ("o", "s", "^", "D")
_TITLES = {ALL: "all windows (main result)", FIRST: "first window (the paper's way)"}
_TICKS_S = (1, 2, 5, 10, 20, 30, 60, 100)
_SHIFT = 0.11
"""Points of one window stand side by side: so much apart, relative to the time."""


def draw_augmentation(
    results: pd.DataFrame, curves: pd.DataFrame, published: Sequence[Published]
) -> Figure:
    """Running-mean RMSE against its length, with the networks' points at theirs.

    Args:
        results: The running mean and the networks of one sensor and number of real gyroscopes.
        curves: The running mean's, of that sensor.
        published: The paper's results for the same networks.
    """
    with mpl.rc_context({"font.size": 9, "axes.grid": True, "grid.alpha": 0.3}):
        figure = Figure(figsize=(9.5, 4.4), layout="constrained")
        axes = figure.subplots(1, 2, sharey=True)
        for ax, windows in zip(axes, (ALL, FIRST), strict=True):
            _draw_panel(ax, results, curves[curves.windows == windows], windows, published)
        axes[0].set_ylabel("RMSE against the recording's mean [mdps]")
        handles, labels = axes[0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside lower center", ncols=3, frameon=False)
        first = results.iloc[0]
        real = results.real_gyros.max()
        figure.suptitle(
            f"{first.sensor}: {real} real gyroscopes and virtual ones "
            f"({'simulated' if first.simulated else 'measured'} data, source {first.source!r})"
        )
    return figure


def _draw_panel(
    ax: Axes,
    results: pd.DataFrame,
    curve: pd.DataFrame,
    windows: str,
    published: Sequence[Published],
) -> None:
    suffix = "" if windows == FIRST else f"_{windows}"
    ax.plot(curve.time_s, curve.rmse_dps / MDPS, color="black", lw=1.2, label="running mean")
    limits = results[results.estimator == MEAN].sort_values("window_s")
    ax.plot(
        limits.window_s,
        limits.ceiling_rmse_dps / MDPS,
        **_bar("#D55E00"),
        label="ceiling: expected of the best possible",
    )
    networks = results[results.estimator == CNN]
    sizes = sorted(networks.virtual_gyros.unique())
    for i, virtual in enumerate(sizes):
        rows = networks[networks.virtual_gyros == virtual]
        shift = 1 + _SHIFT * (i - (len(sizes) - 1) / 2)
        rmse, lo, hi = (rows[f"test_rmse_dps{suffix}{end}"] / MDPS for end in ("", "_lo", "_hi"))
        ax.errorbar(
            rows.window_s * shift,
            rmse,
            yerr=[rmse - lo, hi - rmse],
            fmt=_MARKERS[i],
            color=_COLOURS[i],
            capsize=2.5,
            ms=5,
            label=f"network, {virtual} virtual, 95 % interval",
        )
        for claim in (claim for claim in published if claim.virtual_gyros == virtual):
            mean = rows[rows.window_s == claim.window_s][f"mean_rmse_dps{suffix}"] / MDPS
            ax.plot(
                claim.window_s * shift,
                mean * (1 - claim.accuracy_gain_pct / 100),
                **_hollow(_COLOURS[i], _MARKERS[i]),
                label=f"published, {virtual} virtual",
            )
    _time_axis(ax, float(curve.time_s.max()))
    ax.set(yscale="log", title=_TITLES[windows])
    ax.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
    ax.yaxis.set_major_formatter("{x:g}")
    # The curve against the recording's own mean ends at 0, which has no logarithm.
    ax.set_ylim(bottom=0.08)


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
