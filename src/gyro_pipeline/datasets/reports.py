"""Writes the tables, the figures and the page of a report."""

import base64
import re
import unicodedata
from collections.abc import MutableMapping, Sequence
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import unquote

import pandas as pd
from jinja2 import Environment, PackageLoader
from kedro.io import AbstractDataset, DatasetError
from markdown_it import MarkdownIt
from markdown_it.renderer import RendererHTML
from markdown_it.token import Token

from gyro_pipeline.datasets.atomic import replacing
from gyro_pipeline.datasets.tables import read_table, write_table
from gyro_pipeline.markup import pipe_table, plain

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_PNG_DPI = 160
_LONGEST = 35
_WRAPPED = r"p{4cm}"
"""LaTeX format of columns with texts of more characters than ``_LONGEST``."""

_FORMULA = re.compile(r"[=@\t\r]|[+-](?![\d.,\s\[\]+\-%/]*$)")
"""A text that a spreadsheet would take for a formula; it never does so with digits and signs."""

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


class _ReportFile(AbstractDataset[Any, Any]):
    """Base of the datasets of a report.

    Args:
        filepath: The main file; other formats are beside it.
        metadata: For other tools, such as Kedro-Viz.
    """

    def __init__(self, filepath: str, metadata: dict[str, Any] | None = None) -> None:
        self._path = Path(filepath)
        self.metadata = metadata

    def _exists(self) -> bool:
        return self._path.is_file()

    def _describe(self) -> dict[str, Any]:
        return {"filepath": str(self._path)}


class ReportTable(_ReportFile):
    """Writes a table as CSV with all digits, and as Markdown and LaTeX for readers.

    In the latter two, numbers have four significant digits and a missing value is a dash. LaTeX
    needs the package ``booktabs``; characters without a LaTeX form become question marks. In the
    CSV file a text that a spreadsheet would take for a formula begins with an apostrophe.
    """

    def load(self) -> pd.DataFrame:
        """Read the table with all digits."""
        return read_table(self._path)

    def save(self, data: pd.DataFrame) -> None:
        """Write the three files.

        Args:
            data: The table; its index is not written.
        """
        texts = {".md": pipe_table(data), ".tex": to_latex(data)}
        with replacing(self._path) as temporary:
            write_table(data.map(_no_formula).rename(columns=_no_formula), temporary)
        for suffix, text in texts.items():
            _write_text(self._path.with_name(self._path.stem + suffix), text)


class ReportFigure(_ReportFile):
    """Writes a figure as PNG and SVG; the same figure gives the same bytes."""

    def load(self) -> Path:
        """Path of the PNG file."""
        return self._path

    def save(self, data: "Figure") -> None:
        """Write both files."""
        import matplotlib as mpl  # noqa: PLC0415 - imported slowly, and needed for drawing only

        with mpl.rc_context({"svg.hashsalt": "gyro_pipeline"}):
            with replacing(self._path) as temporary:
                data.savefig(temporary, dpi=_PNG_DPI)
            with replacing(self._path.with_name(f"{self._path.stem}.svg")) as temporary:
                data.savefig(temporary, metadata={"Date": None})


class ReportPage(_ReportFile):
    """Writes a report as Markdown and as a self-contained HTML file, and a list of all reports.

    Args:
        filepath: The HTML file, in the folder of its source; the Markdown file is beside it.
        all_reports: An HTML file above these folders, with links to the reports in all of them.
        metadata: For other tools, such as Kedro-Viz.
    """

    def __init__(
        self, filepath: str, all_reports: str, metadata: dict[str, Any] | None = None
    ) -> None:
        super().__init__(filepath, metadata)
        self._all = Path(all_reports)

    def load(self) -> str:
        """Read the Markdown."""
        return self._path.with_suffix(".md").read_text(encoding="utf-8")

    def save(self, data: str) -> None:
        """Write the report in both formats, and update the list of all reports.

        Args:
            data: The page as Markdown. Pictures are files beside it.
        """
        _write_text(self._path.with_suffix(".md"), data)
        _write_text(self._path, to_html(data, self._path.parent))
        root, name = self._all.parent, self._path.name
        folders = sorted(page.parent.relative_to(root).as_posix() for page in root.rglob(name))
        lines = [f"- [{folder}]({folder}/{name})" for folder in folders if folder != "."]
        page = "# Rapid gyroscope calibration: all reports\n\n" + "\n".join(lines) + "\n"
        _write_text(self._all, to_html(page, root))

    def _exists(self) -> bool:
        return self._path.is_file() and self._path.with_suffix(".md").is_file()


def _write_text(path: Path, text: str) -> None:
    with replacing(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def to_html(markdown: str, folder: Path) -> str:
    """Convert Markdown to a page that needs no other file.

    HTML in the text is shown literally.

    Args:
        markdown: The text. It begins with a heading, the title of the page.
        folder: Folder of the pictures.

    Raises:
        DatasetError: A picture does not exist.
    """
    parser = MarkdownIt("commonmark", {"html": False}).enable("table")
    parser.add_render_rule("image", _embed_picture)
    parser.add_render_rule("table_open", lambda *_: '<div class="wide" tabindex="0">\n<table>\n')
    parser.add_render_rule("table_close", lambda *_: "</table>\n</div>\n")
    tokens = parser.parse(markdown)
    headings = [
        (opening, text.content)
        for opening, text in zip(tokens, tokens[1:], strict=False)
        if opening.type == "heading_open"
    ]
    for opening, text in headings:
        opening.attrSet("id", re.sub(r"\W+", "-", text.lower()).strip("-"))
    body = parser.renderer.render(tokens, parser.options, {"folder": folder})
    contents = [(opening.attrGet("id"), text) for opening, text in headings if opening.tag == "h2"]
    environment = Environment(
        loader=PackageLoader("gyro_pipeline", "datasets"), autoescape=True, trim_blocks=True
    )
    title = re.sub(r"\\(?=\W)", "", headings[0][1]) if headings else "Report"
    page = environment.get_template("page.html.j2")
    return page.render(title=title, body=body, contents=contents)


def _embed_picture(
    renderer: RendererHTML,
    tokens: Sequence[Token],
    index: int,
    options: Any,
    env: MutableMapping[str, Any],
) -> str:
    """Render a picture as a data address."""
    name, caption = unquote(str(tokens[index].attrGet("src"))), tokens[index].content
    path = Path(env["folder"]) / name
    if ":" in name or not path.is_file():
        raise DatasetError(f"{path}: no such picture")
    content = base64.b64encode(path.read_bytes()).decode("ascii")
    return f'<img src="data:image/png;base64,{content}" alt="Figure: {escape(caption)}">'


def to_latex(table: pd.DataFrame) -> str:
    """Format a table, without its index, as a LaTeX ``tabular`` with the rules of ``booktabs``.

    Long texts are broken into lines.
    """
    texts, formats = table.map(plain).reset_index(drop=True), ""
    for name, values in table.items():
        long = max(map(len, [str(name), *texts[name]])) > _LONGEST
        numeric = pd.api.types.is_numeric_dtype(values)
        formats += _WRAPPED if long else "r" if numeric else "l"
    texts = texts.map(_latex).rename(columns=lambda name: _latex(str(name)))
    return texts.to_latex(index=False, escape=False, column_format=formats)


def _latex(text: str) -> str:
    letters = (
        unicodedata.normalize("NFKD", character)[0] if character.isalpha() else character
        for character in text
        if not unicodedata.combining(character)
    )
    supported = (c if c.isascii() or ord(c) in _LATEX else "?" for c in letters)
    return "".join(supported).translate(_LATEX)


def _no_formula(value: Any) -> Any:
    return f"'{value}" if isinstance(value, str) and _FORMULA.match(value) else value
