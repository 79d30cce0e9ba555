"""What people read: tables and figures, each in the formats they are used in."""

import base64
from html import escape
from pathlib import Path
from typing import Any

import matplotlib as mpl
import pandas as pd
from kedro.io import AbstractDataset
from kedro_datasets._typing import ImagePreview, TablePreview
from matplotlib import pyplot as plt
from matplotlib.figure import Figure

from gyro_pipeline.conventions import InputError, Missing
from gyro_pipeline.datasets.atomic import replacing
from gyro_pipeline.datasets.tables import preview_table, read_table, write_table

_PNG_DPI = 160
_WITHOUT_EXPONENT = 1e4
_SENTENCE = 40  # characters

_LONGEST = 35
_BROKEN = r"p{4cm}"
"""How LaTeX sets columns with texts of more characters than that."""

_LATEX = str.maketrans(
    {
        "\\": r"\textbackslash{}",
        "~": r"\textasciitilde{}",
        "^": r"\textasciicircum{}",
        **{character: "\\" + character for character in "&%$#_{}"},
        **{character: f"${character}$" for character in "<>|"},  # other glyphs in plain LaTeX
        **{character: f"{{{character}}}" for character in "[*"},  # read as an option after \\
        "\n": " ",
        "–": "--",
        "—": "---",
        "−": "$-$",
        "±": r"$\pm$",
        "×": r"$\times$",
        "·": r"$\cdot$",
        "√": r"$\surd$",
        "≤": r"$\leq$",
        "≥": r"$\geq$",
        "→": r"$\to$",
        "°": r"$^\circ$",
        "²": "$^2$",
        "σ": r"$\sigma$",
        "τ": r"$\tau$",
        "ρ": r"$\rho$",
        "…": r"\dots{}",
    }
)


class ReportTable(AbstractDataset[pd.DataFrame | Missing, pd.DataFrame | Missing]):
    """Writes a table as CSV with all digits, and as Markdown and LaTeX to be read.

    In the latter two, numbers have four significant digits and a missing value is a dash. LaTeX
    needs the package ``booktabs``.

    Args:
        filepath: Their common path, without a suffix.
        metadata: For other tools, such as Kedro-Viz.
    """

    def __init__(self, filepath: str, metadata: dict[str, Any] | None = None) -> None:
        self._csv, self._md, self._tex = _with_suffixes(filepath, ".csv", ".md", ".tex")
        self.metadata = metadata

    def load(self) -> pd.DataFrame | Missing:
        """Read the table, all digits of it; Missing where it was not made."""
        return read_table(self._csv) if self._csv.is_file() else Missing(())

    def save(self, data: pd.DataFrame | Missing) -> None:
        """Write the three files, or remove those of a result that can no longer be made.

        Args:
            data: The table; its index is not written.

        Raises:
            InputError: As the cause of Kedro's ``DatasetError``, a character that LaTeX lacks.
        """
        if isinstance(data, Missing):
            _remove(self._csv, self._md, self._tex)
            return
        markdown, latex = to_markdown(data), to_latex(data)
        with replacing(self._csv) as temporary:
            write_table(data, temporary)
        for path, text in ((self._md, markdown), (self._tex, latex)):
            with replacing(path) as temporary:
                temporary.write_text(text, encoding="utf-8")

    def preview(self, nrows: int = 40) -> TablePreview:
        """Show the first rows in Kedro-Viz.

        Args:
            nrows: How many.

        Returns:
            Columns and rows as Kedro-Viz takes them.
        """
        return preview_table(self._csv, nrows)

    def _exists(self) -> bool:
        return all(path.is_file() for path in (self._csv, self._md, self._tex))

    def _describe(self) -> dict[str, Any]:
        return {"filepath": str(self._csv.with_suffix(""))}


class ReportFigure(AbstractDataset[Figure | Missing, Path | Missing]):
    """Writes a figure as PNG and SVG; the same figure gives the same bytes.

    Args:
        filepath: Their common path, without a suffix.
        metadata: For other tools, such as Kedro-Viz.
    """

    def __init__(self, filepath: str, metadata: dict[str, Any] | None = None) -> None:
        self._png, self._svg = _with_suffixes(filepath, ".png", ".svg")
        self.metadata = metadata

    def load(self) -> Path | Missing:
        """Name the PNG file, to be shown elsewhere; Missing where it was not made."""
        return self._png if self._png.is_file() else Missing(())

    def save(self, data: Figure | Missing) -> None:
        """Write both files and close the figure, or remove those that can no longer be made.

        Args:
            data: The figure.
        """
        if isinstance(data, Missing):
            _remove(self._png, self._svg)
            return
        with mpl.rc_context({"svg.hashsalt": "gyro_pipeline"}):
            with replacing(self._png) as temporary:
                data.savefig(temporary, dpi=_PNG_DPI)
            with replacing(self._svg) as temporary:
                data.savefig(temporary, metadata={"Date": None})
        plt.close(data)

    def preview(self) -> ImagePreview:
        """Show the figure in Kedro-Viz.

        Returns:
            The PNG file in base 64.
        """
        return ImagePreview(base64.b64encode(self._png.read_bytes()).decode("ascii"))

    def _exists(self) -> bool:
        return self._png.is_file() and self._svg.is_file()

    def _describe(self) -> dict[str, Any]:
        return {"filepath": str(self._png.with_suffix(""))}


def to_markdown(table: pd.DataFrame) -> str:
    """Write a table as Markdown.

    Args:
        table: Its index is not written.

    Returns:
        Lines of a pipe table; numeric columns are aligned to the right.
    """
    rules = ["---:" if right else "---" for right in _numeric(table)]
    rows = [list(table.columns.map(str)), rules, *_texts(table)]
    cells = [[cell.replace("|", "\\|").replace("\n", " ") for cell in row] for row in rows]
    return "".join(f"| {' | '.join(row)} |\n" for row in cells)


def to_html(table: pd.DataFrame) -> str:
    """Write a table as HTML.

    Args:
        table: Its index is not written.

    Returns:
        A ``table`` with everything in it escaped. Cells of numeric columns have the class
        ``number``, sentences the class ``long``.
    """
    numeric = _numeric(table)

    def row(tag: str, texts: list[str]) -> str:
        classes = [
            "number" if right else "long" if len(text) > _SENTENCE else ""
            for right, text in zip(numeric, texts, strict=True)
        ]
        return "".join(
            f'<{tag} class="{kind}">{escape(text)}</{tag}>'
            if kind
            else f"<{tag}>{escape(text)}</{tag}>"
            for kind, text in zip(classes, texts, strict=True)
        )

    head = row("th", list(table.columns.map(str)))
    body = "\n".join(f"<tr>{row('td', texts)}</tr>" for texts in _texts(table))
    return f"<table>\n<thead><tr>{head}</tr></thead>\n<tbody>\n{body}\n</tbody>\n</table>"


def to_latex(table: pd.DataFrame) -> str:
    """Write a table as LaTeX.

    Args:
        table: Its index is not written.

    Returns:
        A ``tabular`` with the rules of the package ``booktabs``, for a plain article. Long texts
        are broken into lines.

    Raises:
        InputError: A character that a plain article cannot set.
    """
    rows = [list(table.columns.map(str)), *_texts(table)]
    long = [max(map(len, column)) > _LONGEST for column in zip(*rows, strict=True)]
    alignment = "".join(
        _BROKEN if broken else "r" if right else "l"
        for broken, right in zip(long, _numeric(table), strict=True)
    )
    head, *body = [" & ".join(_latex(cell) for cell in row) + r" \\" for row in rows]
    begin = rf"\begin{{tabular}}{{{alignment}}}"
    lines = [begin, r"\toprule", head, r"\midrule", *body, r"\bottomrule", r"\end{tabular}"]
    return "\n".join(lines) + "\n"


def _texts(table: pd.DataFrame) -> list[list[str]]:
    return [[_text(value) for value in row] for row in table.itertuples(index=False, name=None)]


def _text(value: Any) -> str:
    if pd.isna(value):
        return "–"
    if not isinstance(value, float):
        return str(value)
    return f"{value:.4g}" if abs(value) < _WITHOUT_EXPONENT else f"{value:.0f}"


def _latex(text: str) -> str:
    escaped = text.translate(_LATEX)
    if not escaped.isascii():
        unknown = sorted({character for character in escaped if not character.isascii()})
        raise InputError(f"{text!r}: no LaTeX form is known for {unknown}; write it in ASCII")
    return escaped


def _numeric(table: pd.DataFrame) -> list[bool]:
    return [pd.api.types.is_numeric_dtype(dtype) for dtype in table.dtypes]


def _with_suffixes(filepath: str, *suffixes: str) -> list[Path]:
    # not Path.with_suffix, which would cut a name such as "window_0.5s"
    return [Path(filepath + suffix) for suffix in suffixes]


def _remove(*paths: Path) -> None:
    for path in paths:
        path.unlink(missing_ok=True)
