import os

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd

from gyro_pipeline.datasets.reports import ReportFigure, ReportTable

TABLE = pd.DataFrame({"row_name": ["3 real & 12_virtual", "[1.2, 3.4] | 50 %"]})
TABLE[["RMSE, mdps", "n", "samples"]] = [1.58541234, 1, 13000.0], [np.nan, 20, 1494.0]
TABLE = TABLE.astype({"n": int})


def test_a_table_is_written_in_three_formats_and_read_with_all_digits(tmp_path):
    report = ReportTable(str(tmp_path / "new" / "window_0.5s.csv"))
    report.save(TABLE)
    names = [f"window_0.5s.{kind}" for kind in ("csv", "md", "tex")]
    assert sorted(os.listdir(tmp_path / "new")) == names
    pd.testing.assert_frame_equal(report.load(), TABLE, check_exact=True)
    assert (tmp_path / "new" / "window_0.5s.md").read_text() == (
        "| row_name | RMSE, mdps | n | samples |\n"
        "| --- | ---: | ---: | ---: |\n"
        "| 3 real \\& 12_virtual | 1.585 | 1 | 13000 |\n"
        "| [1.2, 3.4] \\| 50 % | – | 20 | 1494 |\n"
    )
    assert (tmp_path / "new" / "window_0.5s.tex").read_text() == (
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
    formulas = ["=1+1", "+cmd|x", "-1+cmd|'x'!A0", "@sum(1)", "\tx"]  # of a spreadsheet
    texts = ["-37 [-50, 3]", "+0.123 [-0.1, +0.2]", "-5", "a=b"]
    report.save(pd.DataFrame({"=File": formulas + texts}))
    table = report.load()
    assert table.columns.tolist() == ["'=File"]
    assert table["'=File"].tolist() == [f"'{text}" for text in formulas] + texts


def test_a_figure_is_written_with_the_same_bytes_each_time(tmp_path):
    for name in ("a", "b"):
        figure, axes = plt.subplots()
        axes.plot([1, 2, 4], label="running mean")
        axes.legend()
        report = ReportFigure(str(tmp_path / f"{name}.png"))
        report.save(figure)
        assert report.load() == tmp_path / f"{name}.png"
    for suffix in ("png", "svg"):
        content = (tmp_path / f"a.{suffix}").read_bytes()
        assert content == (tmp_path / f"b.{suffix}").read_bytes()
        assert len(content) > 1000
