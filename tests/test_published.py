"""The one reference file against the text of the paper, where that is at hand."""

import os
import re
from pathlib import Path

import pytest

PAPER = "rapid_gyroscope_calibration.tex"
SENSORS = {"SparkFan": "sparkfun", "DOT": "dot", "NG": "ng", "Memsense": "memsense"}


@pytest.fixture(scope="module")
def text():
    data = os.environ.get("GYRO_PIPELINE_REAL_DATA")
    if not data:
        pytest.skip("GYRO_PIPELINE_REAL_DATA is not set; the paper would lie beside that folder")
    path = Path(data).resolve().parents[1] / "paper" / PAPER
    if not path.is_file():
        pytest.skip(f"no {PAPER} in paper/ two folders above GYRO_PIPELINE_REAL_DATA, {data}")
    return path.read_text()


@pytest.fixture(scope="module")
def published(parameters):
    return parameters("base").published


def table(text, label):
    """Cells of the rows of one table, without what only sets it."""
    (body,) = [
        part for part in re.findall(r"\\begin\{table\}(.*?)\\end\{table\}", text, re.S)
        if f"\\label{{{label}}}" in part
    ]  # fmt: skip
    body = re.sub(r"\\hline|\\multicolumn\{1\}\{c\|\}", "", body)
    cells = [[cell.strip(" \n{}") for cell in row.split("&")] for row in body.split(r"\\")]
    return [row for row in cells if re.fullmatch(r"[\d.]+|N/A", row[-1])]


def number(cell):
    return None if cell == "N/A" else float(cell)


@pytest.mark.parametrize(
    ("label", "name"),
    [
        ("tab:three_gyro_results", "three_gyroscopes"),
        ("tab:mg_results", "multiple_gyroscopes"),
        ("tab:generalization", "generalization"),
    ],
)
def test_results_are_the_papers(text, published, label, name):
    theirs = table(text, label)
    ours = published.of_table(name)
    assert len(theirs) == len(ours)
    for (approach, gyroscopes, saving, gain), row in zip(theirs, ours, strict=True):
        if name == "generalization":
            assert SENSORS[approach] == row.sensor
        else:
            assert approach.replace(" ", "") == row.approach.replace(" ", "")
            assert row.sensor == ("dot" if "DOT" in approach else "sparkfun")
        counts = [int(count) for count in re.findall(r"\d+", gyroscopes)]
        assert counts == [row.real_gyros] + [row.virtual_gyros] * (row.virtual_gyros > 0)
        stated = (row.time_saving_pct, row.accuracy_gain_pct)
        assert stated == (float(saving), float(gain))
        assert row.window_s == 10
        assert row.section.startswith("IV-G")


def test_specifications_are_the_papers(text, published):
    theirs = table(text, "sensor_specifications")
    assert len(theirs) == len(published.specifications)
    for (name, rate, density, stability), row in zip(theirs, published.specifications, strict=True):
        assert name == row.name
        ends = [float(end) for end in rate.split("-")]
        assert row.rate_hz == (ends[0], ends[-1])
        assert row.noise_density_mdps_rthz == number(density)
        assert row.bias_stability_dph == number(stability)


def test_hours_are_the_papers(text, published):
    theirs = table(text, "tab:dataset_in_hours")
    ours = [[row.dataset, row.train_h, row.test_h, row.total_h] for row in published.hours]
    assert [[float(cell) for cell in row] for row in theirs] == ours
    total = sum(row.total_h for row in published.hours)
    assert f"contain {total:.1f} hours" in text


@pytest.mark.parametrize("quoted", ["400 recordings", "6.83 hours", "100 recordings"])
def test_what_the_notes_speak_of_is_in_the_paper(text, published, quoted):
    assert quoted in text
    assert any(quoted.removesuffix("ours") in row.note for row in published.hours)


def test_the_sections_are_the_papers(text, published):
    results = text.index(r"\section{Analysis and Results}")
    sections = re.findall(r"\\subsection\{(.*?)\}", text[results:])
    letters = dict(zip("ABCDEFG", sections, strict=True))
    assert letters["A"] == "Dataset"
    assert letters["G"] == "Summary"
    rows = [*published.results, *published.specifications, *published.hours]
    assert {row.section.split(",")[0] for row in rows} == {"IV-A", "IV-G"}


def test_every_row_names_its_section(published):
    rows = [*published.results, *published.specifications, *published.hours]
    assert len(rows) == 10 + 4 + 6
    for row in rows:
        assert row.section
