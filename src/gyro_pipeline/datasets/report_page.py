"""The report: one page made from all that the reporting stage made."""

import base64
import os
import re
from collections.abc import Mapping
from html import escape
from pathlib import Path
from typing import Any

import pandas as pd
from jinja2 import Environment, PackageLoader, StrictUndefined
from kedro.io import AbstractDataset, DatasetError
from markupsafe import Markup

from gyro_pipeline.datasets.atomic import replacing
from gyro_pipeline.datasets.reports import to_html, to_markdown
from gyro_pipeline.datasets.tables import read_table

_CODE = re.compile(r"`([^`]+)`")


class ReportPage(AbstractDataset[Mapping[str, Any], None]):
    """Writes a report as one HTML file that needs no other, and as Markdown beside the figures.

    What is saved are the variables of ``templates/report.html.j2`` and ``report.md.j2``: texts,
    in which backticks mark code, tables as data frames, and figures as paths of PNG files.

    Args:
        filepath: Path of both files, without a suffix.
        metadata: For other tools, such as Kedro-Viz.
    """

    def __init__(self, filepath: str, metadata: dict[str, Any] | None = None) -> None:
        self._html, self._md = Path(filepath + ".html"), Path(filepath + ".md")
        self.metadata = metadata

    def load(self) -> None:
        """Refuse: a report is not read back."""
        raise DatasetError(f"{self._html}: a report is only written; open it in a browser")

    def save(self, data: Mapping[str, Any]) -> None:
        """Write both files.

        Args:
            data: Variables of the templates.
        """
        templates = _templates(self._html.parent)
        for path in (self._html, self._md):
            text = templates.get_template(f"report{path.suffix}.j2").render(data)
            with replacing(path) as temporary:
                temporary.write_text(text, encoding="utf-8")

    def _exists(self) -> bool:
        return self._html.is_file() and self._md.is_file()

    def _describe(self) -> dict[str, Any]:
        return {"filepath": str(self._html)}


class ReportFolder(AbstractDataset[Any, dict[str, pd.DataFrame | Path]]):
    """All tables and figures in a folder, whichever study or program left them there.

    Args:
        path: It has a folder ``tables`` with CSV files and a folder ``figures`` with PNG files.
        metadata: For other tools, such as Kedro-Viz.
    """

    def __init__(self, path: str, metadata: dict[str, Any] | None = None) -> None:
        self._path = Path(path)
        self.metadata = metadata

    def load(self) -> dict[str, pd.DataFrame | Path]:
        """Read the tables and name the figures.

        Returns:
            Both by folder and name, such as ``tables/augmentation_results``.
        """
        found: dict[str, pd.DataFrame | Path] = {}
        for path in sorted(self._path.glob("tables/[!.]*.csv")):
            found[f"tables/{path.stem}"] = read_table(path)
        for path in sorted(self._path.glob("figures/[!.]*.png")):
            found[f"figures/{path.stem}"] = path
        return found

    def save(self, data: Any) -> None:
        """Refuse: its tables and figures are datasets of their own."""
        raise DatasetError(f"{self._path}: tables and figures are saved one by one")

    @staticmethod
    def state() -> str:
        """Nothing: whoever puts something there makes the report anew."""
        return ""

    def _exists(self) -> bool:
        return self._path.is_dir()

    def _describe(self) -> dict[str, Any]:
        return {"path": str(self._path)}


def _templates(folder: Path) -> Environment:
    environment = Environment(
        loader=PackageLoader("gyro_pipeline", "datasets/templates"),
        autoescape=lambda name: name is not None and name.endswith(".html.j2"),
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters |= {
        "code": lambda text: Markup(_CODE.sub(r"<code>\1</code>", escape(text))),
        "table": lambda table: Markup(to_html(table)),
        "pipes": to_markdown,
        "embedded": _embedded,
        "relative": lambda path: Path(os.path.relpath(path, folder)).as_posix(),
    }
    return environment


def _embedded(png: Path) -> str:
    """A picture as an address that holds it."""
    return "data:image/png;base64," + base64.b64encode(png.read_bytes()).decode("ascii")
