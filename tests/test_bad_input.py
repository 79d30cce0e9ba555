"""Input that cannot be used is refused before any training, and leaves nothing half written."""

import re
import sqlite3
from pathlib import Path

import numpy as np
import pytest

SAMPLES, RECORDINGS = 1300, 7
FILES = "memsense.raw_logs.files"


def good():
    """Recordings of one IMU."""
    shape = (RECORDINGS, 3, SAMPLES)
    return np.random.default_rng(0).normal(0, 0.05, shape).astype(np.float32)


def with_one(where, value):
    array = good()
    array[where] = value
    return array


@pytest.fixture
def mine(new_project):
    """A project whose Memsense logs are an array file."""

    def make(array=None, entry=(), **only):
        project = new_project()
        folder = project.folder / "data/01_raw/mine"
        folder.mkdir(parents=True)
        np.save(folder / "mine.npy", good() if array is None else array, allow_pickle=True)
        given = {
            "type": "gyro_pipeline.datasets.array_logs.ArrayLogs",
            "sensor": "memsense",
            "sensors": "${globals:sensors}",
            "source": "${globals:source}",
            "path": "data/01_raw/mine",
            "files": {"all": "mine.npy"},
        } | dict(entry)
        project.configure(
            "mine",
            globals={"source": "mine", "sensors": {"memsense": {"samples": SAMPLES}}},
            parameters={"only": {"sensor": "memsense", "real_gyros": 3} | only},
            catalog={FILES: {key: value for key, value in given.items() if value is not None}},
        )
        return project

    return make


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


@pytest.mark.parametrize(
    ("pipeline", "params", "words"),
    [
        ("real2real", {"trainin": {"epochs": 3}}, ["trainin: unknown key", "conf/base"]),
        ("augmentation", {"only": {"real_gyros": 6}}, ["matches nothing", "real_gyros"]),
    ],
)
def test_parameters(new_project, pipeline, params, words):
    refused(new_project(), words, pipeline, env="smoke", **params)


@pytest.mark.parametrize(
    ("entry", "words"),
    [
        ({"patern": "*.npy"}, ["unexpected keyword argument 'patern'", FILES]),
    ],
)
def test_keys_of_a_catalog_entry(mine, entry, words):
    refused(mine(entry=entry), ["error: catalog: ArrayLogs", *words])


@pytest.mark.parametrize(
    ("array", "words"),
    [
        (good()[0], ["along 3 axes", "got float32 of shape (3, 1300)"]),
        (with_one((6, 2), 0.25), ["IMU 1 recording 7", "mine.npy recording 7", "stuck", "axis z"]),
        (good()[..., :200], ["0 of 7 recordings", "too short", "8 s", "quality.least_s"]),
        (good()[..., :300], ["window of 30 s is 750 samples", "has 300", "windows_s"]),
    ],
    ids=["rank", "constant", "short", "window"],
)
def test_files(mine, array, words):
    refused(mine(array), ["memsense", *words])


def test_a_pickle_is_not_even_opened(mine, tmp_path):
    witness = tmp_path / "executed"

    class Trap:
        def __reduce__(self):
            return Path.touch, (witness,)

    refused(mine(np.array([Trap()])), ["pickled objects", "never loaded"])
    assert not witness.exists()


def test_what_is_not_there(mine):
    refused(mine(entry={"files": {"all": "other.npy"}}), ["memsense other.npy: no such file"])
    words = ["real2real needs 6 gyroscopes, the mine recordings hold 3"]
    refused(mine(real_gyros=6), words)


@pytest.mark.parametrize("place", ["data/05_model_input", "mlruns"])
def test_a_file_in_place_of_a_folder(new_project, place):
    project = new_project()
    (project.folder / place).write_text("in the way")
    words = [f"{place} is a file where a folder is needed; move it away"]
    refused(project, words, env="smoke", only={"sensor": "ng"})
    if place == "data/05_model_input":
        assert set(project.files()) == {place}


def damage(store):
    content = bytearray(store.read_bytes())
    content[12288:163840] = bytes(151552)
    store.write_bytes(content)


def foreign(store):
    store.unlink()
    with sqlite3.connect(store) as connection:
        connection.execute("create table books (title text)")
    connection.close()


def of_another_version(store):
    with sqlite3.connect(store) as connection:
        connection.execute("update alembic_version set version_num = 'not yet known'")
    connection.close()


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (damage, ["malformed", "move it away"]),
        (foreign, ["expected an MLflow store", "tables books", "move it away"]),
        (of_another_version, ["mlflow db upgrade"]),
    ],
    ids=["damaged", "foreign", "version"],
)
def test_run_stores(mine, spoil, words):
    project = mine()
    spoil(project.store)
    refused(project, ["mlflow.db", *words])


def test_on_the_command_line_nothing_stands_between_an_error_and_the_terminal(mine):
    project, command = mine(), ["--pipeline=real2real", "--env=mine"]
    words, wrong = ["['ground_truth.bias_memsense']"], "--nodes=bias_memsense"
    refused(project, words, run=lambda: project.command(*command, wrong))
    words, wrong = ["trainin: unknown key"], "--params=trainin.epochs=3"
    refused(project, words, run=lambda: project.kedro_run(*command, wrong))
