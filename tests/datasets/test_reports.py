import base64
import inspect
import os

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
import pytest
from kedro.io import DatasetError

from gyro_pipeline.conventions import Missing
from gyro_pipeline.datasets.reports import ReportFigure, ReportTable, to_html, to_latex, to_markdown

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
    return ReportTable(str(tmp_path / "new" / "window_0.5s"))


def test_markdown():
    assert to_markdown(TABLE) == (
        "| row_name | RMSE, mdps | n | samples |\n"
        "| --- | ---: | ---: | ---: |\n"
        "| 3 real & 12_virtual | 1.585 | 1 | 13000 |\n"
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


def test_latex_breaks_long_texts_into_lines():
    table = pd.DataFrame({"runs": ["0123abcd " * 5], "note": ["short"], "n": [1]})
    assert to_latex(table).startswith("\\begin{tabular}{p{4cm}lr}\n")


def test_latex_of_symbols():
    text = to_latex(pd.DataFrame({"τ ± σ": ["a\\b~c^d", "{$#} < √2 → 4²"]}))
    assert "$\\tau$ $\\pm$ $\\sigma$ \\\\" in text
    assert "a\\textbackslash{}b\\textasciitilde{}c\\textasciicircum{}d" in text
    assert "\\{\\$\\#\\} $<$ $\\surd$2 $\\to$ 4$^2$" in text


def test_characters_that_latex_lacks_are_refused_before_anything_is_written(report, tmp_path):
    with pytest.raises(DatasetError, match="'a☃': no LaTeX form is known for"):
        report.save(pd.DataFrame({"a☃": [1]}))
    assert os.listdir(tmp_path) == []


def test_a_table_is_written_in_three_formats_and_read_with_all_digits(report, tmp_path):
    report.save(TABLE)
    assert sorted(os.listdir(tmp_path / "new")) == [
        f"window_0.5s{suffix}" for suffix in (".csv", ".md", ".tex")
    ]
    pd.testing.assert_frame_equal(report.load(), TABLE, check_exact=True)
    assert (tmp_path / "new" / "window_0.5s.md").read_text() == to_markdown(TABLE)
    assert (tmp_path / "new" / "window_0.5s.tex").read_text() == to_latex(TABLE)
    assert report.preview(1)["data"] == [["3 real & 12_virtual", 1.58541234, 1, 13000.0]]


def test_a_missing_table_removes_the_outdated_files_and_no_others(report, tmp_path):
    report.save(TABLE)
    other = ReportTable(str(tmp_path / "new" / "window_0.5"))
    other.save(TABLE)
    report.save(Missing(("dot, 12 real",)))
    assert not report.exists()
    assert other.exists()
    assert len(os.listdir(tmp_path / "new")) == 3
    report.save(Missing(("dot, 12 real",)))  # nothing there is fine too


def drawn():
    figure, axes = plt.subplots()
    axes.plot([1, 2, 4], label="running mean")
    axes.legend()
    return figure


def test_a_figure_is_written_with_the_same_bytes_each_time_and_closed(tmp_path):
    for name in ("a", "b"):
        figure = drawn()
        ReportFigure(str(tmp_path / name)).save(figure)
        assert not plt.fignum_exists(figure.number)
    assert sorted(os.listdir(tmp_path)) == ["a.png", "a.svg", "b.png", "b.svg"]
    for suffix in ("png", "svg"):
        content = (tmp_path / f"a.{suffix}").read_bytes()
        assert content == (tmp_path / f"b.{suffix}").read_bytes()
        assert len(content) > 1000
    height, width = plt.imread(tmp_path / "a.png").shape[:2]
    assert (width, height) == (1024, 768)  # 6.4 by 4.8 inches at 160 dpi
    assert b"<dc:date>" not in (tmp_path / "a.svg").read_bytes()


def test_a_missing_figure_removes_the_outdated_files(tmp_path):
    report = ReportFigure(str(tmp_path / "a"))
    report.save(drawn())
    assert report.exists()
    report.save(Missing(("dot, 12 real",)))
    assert os.listdir(tmp_path) == []


def test_a_figure_is_previewed_and_names_its_file(tmp_path):
    report = ReportFigure(str(tmp_path / "a"))
    report.save(drawn())
    assert base64.b64decode(report.preview()) == (tmp_path / "a.png").read_bytes()
    assert report.load() == tmp_path / "a.png"


def test_what_was_not_made_is_missing(report, tmp_path):
    assert report.load() == ReportFigure(str(tmp_path / "a")).load() == Missing(())


def test_html_escapes_what_would_be_read_as_markup():
    text = to_html(pd.DataFrame({"<b>": ["a & b", "<script>"], "n": [1.5, np.nan]}))
    assert text == (
        "<table>\n"
        '<thead><tr><th>&lt;b&gt;</th><th class="number">n</th></tr></thead>\n'
        "<tbody>\n"
        '<tr><td>a &amp; b</td><td class="number">1.5</td></tr>\n'
        '<tr><td>&lt;script&gt;</td><td class="number">–</td></tr>\n'
        "</tbody>\n</table>"
    )


def test_previews_are_announced_as_kedro_viz_looks_for_them():
    announced = {
        kind: inspect.signature(kind.preview).return_annotation.__name__
        for kind in (ReportTable, ReportFigure)
    }
    assert announced == {ReportTable: "TablePreview", ReportFigure: "ImagePreview"}
