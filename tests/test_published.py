"""The one reference file against the text of the paper, where that is at hand."""

import re

import pytest

PAPER = "rapid_gyroscope_calibration.tex"
SENSORS = {"SparkFan": "sparkfun", "DOT": "dot", "NG": "ng", "Memsense": "memsense"}
RESULTS = {
    "tab:three_gyro_results": "three_gyroscopes",
    "tab:mg_results": "multiple_gyroscopes",
    "tab:generalization": "generalization",
}


@pytest.fixture(scope="module")
def text(real_file):
    """Of the paper, in paper/ two folders above that of the real recordings."""
    folder = real_file("memsense_test_real.npy").parent.resolve().parents[1] / "paper"
    if not (folder / PAPER).is_file():
        pytest.skip(f"there is no {PAPER} in {folder}")
    return (folder / PAPER).read_text()


def table(text, label):
    """Cells of the rows of one table, without what only sets it."""
    (body,) = [
        part for part in re.findall(r"\\begin\{table\}(.*?)\\end\{table\}", text, re.S)
        if f"\\label{{{label}}}" in part
    ]  # fmt: skip
    body = re.sub(r"\\hline|\\multicolumn\{1\}\{c\|\}", "", body)
    cells = [[cell.strip(" \n{}") for cell in row.split("&")] for row in body.split(r"\\")]
    return [row for row in cells if re.fullmatch(r"[\d.]+|N/A", row[-1])]


@pytest.mark.parametrize("label", RESULTS)
def test_results_are_the_papers(text, parameters, label):
    rows = parameters("base").published.of_table(RESULTS[label])
    results = zip(table(text, label), rows, strict=True)
    for (approach, gyroscopes, saving, gain), row in results:
        if label == "tab:generalization":
            assert row.sensor == SENSORS[approach]
        else:
            assert row.approach.replace(" ", "") == approach.replace(" ", "")
            assert row.sensor == ("dot" if "DOT" in approach else "sparkfun")
        counts = [int(count) for count in re.findall(r"\d+", gyroscopes)]
        assert counts == [row.real_gyros] + [row.virtual_gyros] * (row.virtual_gyros > 0)
        stated = (row.time_saving_pct, row.accuracy_gain_pct)
        assert stated == (float(saving), float(gain))
        assert row.window_s == 10
        assert row.section.startswith("IV-G")


def test_specifications_and_hours_are_the_papers(text, parameters):
    published, specifications = parameters("base").published, table(text, "sensor_specifications")
    for (name, rate, *figures), row in zip(specifications, published.specifications, strict=True):
        assert row.name == name
        ends = [float(end) for end in rate.split("-")]
        assert row.rate_hz == (ends[0], ends[-1])
        stated = [row.noise_density_mdps_rthz, row.bias_stability_dph]
        assert stated == [None if cell == "N/A" else float(cell) for cell in figures]
    ours = [[row.dataset, row.train_h, row.test_h, row.total_h] for row in published.hours]
    assert [[float(cell) for cell in row] for row in table(text, "tab:dataset_in_hours")] == ours
    assert f"contain {sum(row.total_h for row in published.hours):.1f} hours" in text
