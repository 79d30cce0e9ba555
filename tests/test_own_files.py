"""A user's own device: a folder of files in, biases with their standard errors out."""

import re
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import yaml

from gyro_pipeline.parameters import ReaderOptions

BIAS, NOISE, RATE_HZ = (0.7, -0.4, 0.15), 0.05, 100
HEADER = "time (s),gx (rad/s),gy (rad/s),gz (rad/s)"
FOLDER = "data/01_raw/mine"
ENVIRONMENT = {
    "globals": "source: mine\nsensors: {device: {}}\n",
    "parameters": "only: {sensor: device}\n",
    "catalog": """\
device.raw_logs.files:
  type: gyro_pipeline.datasets.file_logs.FileLogs
  sensor: device
  source: ${globals:source}
  path: data/01_raw/mine
""",
}


@pytest.fixture
def project(new_project):
    """A project with files of 60 s of a device at rest, in rad/s, and the environment ``mine``."""
    made, rows = new_project(), 60 * RATE_HZ
    (made.folder / FOLDER).mkdir(parents=True)
    for seed, name in enumerate(("still_1.csv", "still_2.csv", "still_10.csv")):
        rates = np.deg2rad(np.random.default_rng(seed).normal(BIAS, NOISE, (rows, 3)))
        table = np.column_stack([np.arange(rows) / RATE_HZ, rates])
        np.savetxt(made.folder / FOLDER / name, table, "%.9g", ",", header=HEADER, comments="")
    (made.folder / "conf/mine").mkdir()
    for kind, text in ENVIRONMENT.items():
        (made.folder / f"conf/mine/{kind}.yml").write_text(text)
    return made


def check(done, recordings):
    """The table on the terminal: IMU, recording, then value and error of each axis."""
    assert done.code == 0, done.output
    rows = re.findall(r"^ +(\d+) +(\d+) +(.*±.*)$", done.output, re.MULTILINE)
    assert [(int(imu), int(number)) for imu, number, _ in rows] == recordings
    expected_error = NOISE / np.sqrt(RATE_HZ * 60)
    for *_, row in rows:
        pairs = np.array(re.findall(r"(-?\d+\.\d+) ± (\d+\.\d+)", row), float)
        np.testing.assert_allclose(pairs[:, 0], BIAS, rtol=0, atol=5 * expected_error)
        np.testing.assert_allclose(pairs[:, 1], expected_error, rtol=0.25)


def test_eight_lines_and_one_command_are_enough_and_without_an_environment_one_line(project):
    assert sum(len(text.splitlines()) for text in ENVIRONMENT.values()) <= 8
    done = project.command("--pipeline=ground_truth", "--env=mine")
    check(done, [(1, 1), (1, 2), (1, 3)])
    assert "still_1.csv is 1, still_2.csv is 2, still_10.csv is 3" in done.output
    assert "data/03_primary/mine/device/bias.csv" in done.output
    assert "data/02_intermediate/mine/device/quality.csv" in done.output
    assert len(pd.read_csv(project.folder / "data/03_primary/mine/device/bias.csv")) == 3 * 3
    for env, params, words in (
        ("base", {"logs": FOLDER, "only": {"sensor": "ng"}}, "logs of --params.*--env=logs"),
        ("mine", {"reader": {"units": "deg/s"}}, f"reader of --params.*not used.*{FOLDER}"),
        ("mine", {"only": {"sensor": "devise"}}, "only.sensor: unknown sensor 'devise'.*device"),
    ):
        done = project.run_here("ground_truth", env, **params)
        assert done.code == 1
        assert "Traceback" not in done.output
        assert done.output.count("error: ") == 1
        assert re.search(words, done.output, re.DOTALL)
    (project.folder / FOLDER / "notes.txt").write_text("still_2 is the one on the concrete floor\n")
    arguments = f"--params=logs={FOLDER},reader.units=rad/s"
    done = project.command("--pipeline=ground_truth", "--env=logs", arguments)
    check(done, [(1, 2), (1, 3), (1, 4)])
    assert "rejected: IMU 1 recording 1, notes.txt: " in done.output


def test_documented_options_are_options_of_the_reader():
    table = (Path(__file__).parents[1] / "docs/your_data.md").read_text().split("| `reader` |")[1]
    rows = table.split("\n\n")[0].splitlines()[2:]
    options = [found for row in rows for found in re.findall(r"`([a-z_]+: .*?)`", row)]
    assert options
    for example in options:
        given = yaml.safe_load(f"{{{example}}}")
        assert ReaderOptions(**given).model_fields_set == set(given)
