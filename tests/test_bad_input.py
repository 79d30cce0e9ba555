"""Input that cannot be used is refused before any training, and leaves nothing half written."""

import re
import sqlite3
from pathlib import Path

import numpy as np
import pytest

FILES, FOLDER = "memsense.raw_logs.files", "data/01_raw/mine"
ENVIRONMENT = {
    "globals": "{source: mine, sensors: {memsense: {samples: 1300}}}",
    "parameters": "only: {sensor: memsense, real_gyros: 3}",
    "catalog": f"""{FILES}:
  type: gyro_pipeline.datasets.array_logs.ArrayLogs
  sensor: memsense
  sensors: ${{globals:sensors}}
  source: ${{globals:source}}
  path: {FOLDER}
  files: {{all: mine.npy}}
""",
}


@pytest.fixture
def mine(new_project):
    """Makes projects whose Memsense logs are an array file: ``mine(more_of_the_entry, ...)``."""

    def made(entry="", samples=1300, stuck=None):
        """Seven recordings of one IMU, of which the last may have a stuck axis."""
        project = new_project()
        rates = np.random.default_rng(0).normal(0, 0.05, (7, 3, samples)).astype(np.float32)
        rates[6, 2] = rates[6, 2] if stuck is None else stuck
        (project.folder / FOLDER).mkdir(parents=True)
        np.save(project.folder / FOLDER / "mine.npy", rates)
        (project.folder / "conf/mine").mkdir()
        for name, text in ENVIRONMENT.items():
            more = entry if name == "catalog" else ""
            (project.folder / f"conf/mine/{name}.yml").write_text(text + more)
        return project

    return made


def refused(project, words, pipeline="real2real", env="mine", run=None, **params):
    """Run a project, which must fail, say these words, and leave all files as they were."""
    before = project.files(".")
    done = run() if run else project.run_here(pipeline, env, **params)
    assert done.code == 1
    assert "error: " in done.output
    assert "Traceback" not in done.output
    assert not re.search("[1-9][0-9]* to fit", done.output)
    for word in words:
        assert word in done.output
    after = project.files(".")
    after.pop(project.log.name, None)
    assert {name: after.get(name) for name in before} == before
    new = [Path(name) for name in after if name not in before]
    assert not [path for path in new if path.name.startswith(".") and ".viz" not in path.parts]
    assert not [path for path in new if "mlruns" in path.parts]


def test_files(mine):
    words = ["memsense", "IMU 1 recording 7", "mine.npy recording 7", "stuck", "axis z"]
    refused(mine(stuck=0.25), words)
    words = ["memsense", "window of 30 s is 750 samples", "has 300", "windows_s"]
    refused(mine(samples=300), words)


def test_entries_and_parameters(mine):
    words = ["error: catalog: ArrayLogs", "unexpected keyword argument 'patern'", FILES]
    refused(mine("  patern: '*.npy'\n"), words)
    project, words = mine(), ["matches nothing", "real_gyros"]
    refused(project, words, "augmentation", env="smoke", only={"real_gyros": 6})
    (project.folder / "mlruns").write_text("in the way")
    refused(project, ["mlruns is a file where a folder is needed; move it away"])


def test_on_the_command_line_nothing_stands_between_an_error_and_the_terminal(mine):
    project, command = mine(), ["--pipeline=real2real", "--env=mine"]
    named = "--nodes=bias_memsense"
    words = ["['ground_truth.bias_memsense']"]
    refused(project, words, run=lambda: project.command(*command, named))
    typed = "--params=trainin.epochs=3"
    refused(project, ["trainin: unknown key"], run=lambda: project.kedro_run(*command, typed))


def test_a_run_store_of_another_version(mine):
    project = mine()
    with sqlite3.connect(project.store) as connection:
        connection.execute("update alembic_version set version_num = 'not yet known'")
    connection.close()
    refused(project, ["mlflow.db", "mlflow db upgrade"])
