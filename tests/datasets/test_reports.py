import os

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
import pytest

from gyro_pipeline.datasets.reports import ReportFigure, ReportTable, to_latex
from gyro_pipeline.markup import pipe_table

TABLE = pd.DataFrame(
    {
        "row_name": ["3 real & 12_virtual", "[1.2, 3.4] | 50 %"],
        "RMSE, mdps": [1.58541234, np.nan],
        "n": [1, 20],
        "samples": [13000.0, 1494.0],
    }
)


@pytest.fixture
def report(tmp_path):
    return ReportTable(str(tmp_path / "new" / "window_0.5s.csv"))


def test_markdown_shows_texts_as_they_are():
    assert pipe_table(TABLE) == (
        "| row_name | RMSE, mdps | n | samples |\n"
        "| --- | ---: | ---: | ---: |\n"
        "| 3 real \\& 12_virtual | 1.585 | 1 | 13000 |\n"
        "| [1.2, 3.4] \\| 50 % | – | 20 | 1494 |\n"
    )


def test_latex_escapes_what_would_be_read_as_commands():
    assert to_latex(TABLE) == (
        "\\begin{tabular}{lrrr}\n"
        "\\toprule\n"
        "row\\_name & RMSE, mdps & n & samples \\\\\n"
        "\\midrule\n"
        "3 real \\& 12\\_virtual & 1.585 & 1 & 13000 \\\\\n"
        # a bare [ after \\ would be an optional length
        "{[}1.2, 3.4] $|$ 50 \\% & -- & 20 & 1494 \\\\\n"
        "\\bottomrule\n"
        "\\end{tabular}\n"
    )


def test_latex_of_symbols():
    text = to_latex(pd.DataFrame({"τ ± σ": ["a\\b~c^d", "{$#} < √2 → 4²"]}))
    assert "$\\tau$ $\\pm$ $\\sigma$ \\\\" in text
    assert "a\\textbackslash{}b\\textasciitilde{}c\\textasciicircum{}d" in text
    assert "\\{\\$\\#\\} $<$ $\\surd$2 $\\to$ 4$^2$" in text


def test_a_table_is_written_in_three_formats_and_read_with_all_digits(report, tmp_path):
    report.save(TABLE)
    assert sorted(os.listdir(tmp_path / "new")) == [
        f"window_0.5s{suffix}" for suffix in (".csv", ".md", ".tex")
    ]
    pd.testing.assert_frame_equal(report.load(), TABLE, check_exact=True)
    assert (tmp_path / "new" / "window_0.5s.md").read_text() == pipe_table(TABLE)
    assert (tmp_path / "new" / "window_0.5s.tex").read_text() == to_latex(TABLE)


def test_no_text_is_a_formula_of_a_spreadsheet_and_intervals_stay_as_they_are(report):
    formulas = ["=1+1", "+cmd|x", "-1+cmd|'x'!A0", "@sum(1)", "\tx"]
    texts = ["-37 [-50, 3]", "+0.123 [-0.1, +0.2]", "-5", "a=b"]
    report.save(pd.DataFrame({"=File": formulas + texts}))
    table = report.load()
    assert table.columns.tolist() == ["'=File"]
    assert table["'=File"].tolist() == [f"'{text}" for text in formulas] + texts


def drawn():
    figure, axes = plt.subplots()
    axes.plot([1, 2, 4], label="running mean")
    axes.legend()
    return figure


def test_a_figure_is_written_with_the_same_bytes_each_time(tmp_path):
    for name in ("a", "b"):
        figure = drawn()
        report = ReportFigure(str(tmp_path / f"{name}.png"))
        report.save(figure)
        assert report.load() == tmp_path / f"{name}.png"
    assert sorted(os.listdir(tmp_path)) == ["a.png", "a.svg", "b.png", "b.svg"]
    for suffix in ("png", "svg"):
        content = (tmp_path / f"a.{suffix}").read_bytes()
        assert content == (tmp_path / f"b.{suffix}").read_bytes()
        assert len(content) > 1000
    height, width = plt.imread(tmp_path / "a.png").shape[:2]
    assert (width, height) == (1024, 768)  # 6.4 by 4.8 inches at 160 dpi
    assert b"<dc:date>" not in (tmp_path / "a.svg").read_bytes()
