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


def share_legend(figure: Figure, axes: Iterable[Axes], columns: int) -> None:
    """One legend below all panels; what several panels show is named once."""
    named: dict[str, Artist] = {}
    for ax in axes:
        for handle, label in zip(*ax.get_legend_handles_labels(), strict=True):
            named.setdefault(str(label), handle)
    place: Any = {"loc": "outside lower center", "ncols": columns, "frameon": False}
    figure.legend(list(named.values()), list(named), **place)
