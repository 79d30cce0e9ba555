"""The style of figures."""

from collections.abc import Iterator
from contextlib import contextmanager
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

PLOT_STYLE: Any = {"font.size": 9, "axes.grid": True, "grid.alpha": 0.3}

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


def estimator_look(name: str, recommended: bool, number: int) -> dict[str, Any]:
    """Style of the line of an estimator: a colour per family, filled markers if recommended.

    Estimators without a family, such as those of a sweep, are grey with the marker of ``number``.
    """
    families = [(c, names.index(name)) for c, names in _FAMILIES.items() if name in names]
    colour, member = families[0] if families else ("grey", number % len(MARKERS))
    return {
        "color": colour,
        "marker": MARKERS[member],
        "ms": 5,
        "mfc": colour if recommended else "white",
        "lw": 1.2 if member == 0 else 0.7,
        "ls": "-" if member == 0 else ":",
    }


@contextmanager
def panels(
    title: str | None,
    size: tuple[float, float],
    shape: tuple[int, int] = (1, 1),
    columns: int = 3,
    **shared: Any,
) -> Iterator[tuple[Figure, list[Axes]]]:
    """A figure whose panels are drawn in this context, and share the legend above them.

    Args:
        title: Title of the figure.
        size: Width and height, inches.
        shape: Rows and columns of panels.
        columns: Most columns of the legend, which has each label once.
        **shared: ``sharex`` and ``sharey`` of ``Figure.subplots``.
    """
    with mpl.rc_context(PLOT_STYLE):
        figure = Figure(figsize=size, layout="constrained")
        axes = figure.subplots(*shape, squeeze=False, **shared).ravel().tolist()
        yield figure, axes
        handles: dict[str, Artist] = {}
        for ax in axes:
            for handle, label in zip(*ax.get_legend_handles_labels(), strict=True):
                handles.setdefault(str(label), handle)
        fitting = int(size[0] / (0.5 + 0.08 * max(map(len, handles), default=0)))  # by inches
        columns = max(1, min(columns, fitting))
        layout: Any = {"loc": "outside upper center", "ncols": columns, "frameon": False}
        layout |= {"title": title, "title_fontsize": "large"}
        figure.legend(list(handles.values()), list(handles), **layout)


def grid_shape(count: int) -> tuple[int, int]:
    """Rows and columns of panels, at most two side by side."""
    return -(-count // 2), min(2, count)


def reach(values: ArrayLike, lo: ArrayLike, hi: ArrayLike) -> NDArray[np.float64]:
    """Lengths of error bars, shape (2, n); 0 where there is no interval."""
    centres = np.asarray(values, np.float64)
    lengths = [centres - np.asarray(lo, np.float64), np.asarray(hi, np.float64) - centres]
    return np.maximum(np.nan_to_num(lengths), 0.0)


def plain_ticks(ax: Axes) -> None:
    """Write the numbers of logarithmic axes without exponents."""
    for axis in (ax.xaxis, ax.yaxis):
        axis.set_major_formatter("{x:g}")
    ax.minorticks_off()
