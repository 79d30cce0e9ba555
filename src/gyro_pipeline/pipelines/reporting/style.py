"""How figures look."""

from collections.abc import Iterable
from functools import partial
from typing import Any

import matplotlib as mpl
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure

# Okabe and Ito's palette: distinct for all common kinds of colour vision.
COLOURS = ("#0072B2", "#E69F00", "#009E73", "#CC79A7")
CEILING = "#D55E00"
MARKERS = ("o", "s", "^", "D")

LOOK = partial(mpl.rc_context, {"font.size": 9, "axes.grid": True, "grid.alpha": 0.3})
"""Context in which a figure is drawn."""


_FAMILIES = {
    "black": ("mean", "median", "trimmed_mean"),
    COLOURS[0]: (
        *("best_linear", "best_linear_allan", "best_linear_warm_up"),
        "best_linear_history",
    ),
    COLOURS[1]: ("training_mean", "last_calibration"),
    COLOURS[2]: ("empirical_bayes", "empirical_bayes_pooled"),
    COLOURS[3]: ("ridge", "ridge_same_time"),
    "#56B4E9": ("residual_network",),
    "#D3B300": ("cnn", "cnn_best", "window_mean_network"),
}
"""Estimators that share a colour; they differ in their markers."""

_UNKNOWN = "grey"


def estimator_look(name: str, recommended: bool) -> dict[str, Any]:
    """How an estimator's line is drawn: relatives in one colour, recommended ones filled.

    Args:
        name: As in ``ESTIMATORS``; others are grey.
        recommended: Whether it is one of these.
    """
    found = [(c, names.index(name)) for c, names in _FAMILIES.items() if name in names]
    colour, place = found[0] if found else (_UNKNOWN, 0)
    return {
        "color": colour,
        "marker": MARKERS[place],
        "ms": 5,
        "mfc": colour if recommended else "white",
        "lw": 1.2 if place == 0 else 0.7,
        "ls": "-" if place == 0 else ":",
        "label": name.replace("_", " ") + (" (recommended)" if recommended else ""),
    }


def share_legend(figure: Figure, axes: Iterable[Axes], columns: int) -> None:
    """One legend below all panels; what several panels show is named once."""
    named: dict[str, Artist] = {}
    for ax in axes:
        for handle, label in zip(*ax.get_legend_handles_labels(), strict=True):
            named.setdefault(str(label), handle)
    place: Any = {"loc": "outside lower center", "ncols": columns, "frameon": False}
    figure.legend(list(named.values()), list(named), **place)
