"""How figures look."""

from collections.abc import Iterable
from functools import partial
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import ArrayLike, NDArray

# Okabe and Ito's palette: distinct for all common kinds of colour vision.
COLOURS = ("#0072B2", "#E69F00", "#009E73", "#CC79A7", "#56B4E9", "#D3B300")
CEILING = "#D55E00"
MARKERS = ("o", "s", "^", "D", "v", "P")

LOOK = partial(mpl.rc_context, {"font.size": 9, "axes.grid": True, "grid.alpha": 0.3})
"""Context in which a figure is drawn."""

_FAMILIES = {
    "black": ("mean", "median", "trimmed_mean"),
    COLOURS[0]: (
        *("best_linear", "best_linear_allan", "best_linear_warm_up", "best_linear_history"),
        "best_linear_fallback",
    ),
    COLOURS[1]: ("training_mean", "last_calibration"),
    COLOURS[2]: ("empirical_bayes", "empirical_bayes_pooled"),
    COLOURS[3]: ("ridge", "ridge_same_time"),
    COLOURS[4]: ("residual_network",),
    COLOURS[5]: ("cnn", "cnn_best", "window_mean_network", "single_gyroscope"),
    "#882255": ("tcn", "lstm"),
}
"""Estimators that share a colour; they differ in their markers. Others are grey."""


def estimator_look(name: str, recommended: bool) -> dict[str, Any]:
    """How an estimator's line is drawn: relatives in one colour, recommended ones filled."""
    families = [(c, names.index(name)) for c, names in _FAMILIES.items() if name in names]
    colour, place = families[0] if families else ("grey", 0)
    return {
        "color": colour,
        "marker": MARKERS[place],
        "ms": 5,
        "mfc": colour if recommended else "white",
        "lw": 1.2 if place == 0 else 0.7,
        "ls": "-" if place == 0 else ":",
    }


def share_legend(figure: Figure, axes: Iterable[Axes], columns: int) -> None:
    """One legend below all panels; what several panels show is named once."""
    named: dict[str, Artist] = {}
    for ax in axes:
        for handle, label in zip(*ax.get_legend_handles_labels(), strict=True):
            named.setdefault(str(label), handle)
    place: Any = {"loc": "outside lower center", "ncols": columns, "frameon": False}
    figure.legend(list(named.values()), list(named), **place)


def reach(values: ArrayLike, lo: ArrayLike, hi: ArrayLike) -> NDArray[np.float64]:
    """Lengths of error bars, shape (2, n); none where there is no interval."""
    given = np.asarray(values, np.float64)
    lengths = [given - np.asarray(lo, np.float64), np.asarray(hi, np.float64) - given]
    return np.maximum(np.nan_to_num(lengths), 0.0)


def plain_ticks(ax: Axes) -> None:
    """Numbers of logarithmic axes as people write them."""
    for axis in (ax.xaxis, ax.yaxis):
        axis.set_major_formatter("{x:g}")
    ax.minorticks_off()
