"""Input that cannot be used is refused before any training, and leaves nothing half written."""

import re
import sqlite3
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
import yaml

SAMPLES, RECORDINGS = 1300, 7


def good():
    """Recordings of one IMU."""
    shape = (RECORDINGS, 3, SAMPLES)
    return np.random.default_rng(0).normal(0, 0.05, shape).astype(np.float32)


def with_one(where, value):
    array = good()
    array[where] = value
    return array


@pytest.fixture(scope="module")
def mine(new_project):
    """A project whose Memsense logs are an array file."""

    def make(array, name="mine.npy", **only):
        project = new_project()
        folder = project.folder / "data/01_raw/mine"
        folder.mkdir(parents=True)
        np.save(folder / "mine.npy", array, allow_pickle=True)
        entry = {
            "type": "gyro_pipeline.datasets.array_logs.ArrayLogs",
            "sensor": "memsense",
            "sensors": "${globals:sensors}",
            "source": "${globals:source}",
            "path": "data/01_raw/mine",
            "files": {"all": name},
        }
        project.configure(
            "mine",
            globals={"source": "mine", "sensors": {"memsense": {"samples": SAMPLES}}},
            parameters={"only": {"sensor": "memsense", "real_gyros": 3} | only},
            catalog={"memsense.raw_logs.files": entry},
        )
        return project

    return make


def refused(project, pipeline="real2real", env="mine", **params):
    """Run a project that must fail, and give what it then says."""
    before = project.files(".")
    done = project.run_here(pipeline, env, **params)
    check_refusal(project, done, before)
    return done.output


def check_refusal(project, done, before):
    assert done.code != 0
    assert "error: " in done.output
    assert "Traceback" not in done.output
    assert not re.search("[1-9][0-9]* to fit", done.output)
    after = project.files(".")
    assert {name: after.get(name) for name in before if name != "terminal.log"} == {
        name: content for name, content in before.items() if name != "terminal.log"
    }
    new = [Path(name) for name in after if name not in before]
    assert not [path for path in new if path.name.startswith(".") and ".viz" not in path.parts]
    assert not [path for path in new if "mlruns" in path.parts]


# parameters


@pytest.mark.parametrize(
    ("params", "words"),
    [
        ({"trainin": {"epochs": 3}}, ["trainin: unknown key", "conf/base"]),
        ({"windows_s": [10, 60]}, ["windows_s", "60 s", "longer", "memsense, 52 s"]),
    ],
)
def test_parameters(new_project, params, words):
    output = refused(new_project(), env="smoke", **params)
    for word in words:
        assert word in output


@pytest.mark.parametrize(
    ("pipeline", "only"),
    [("augmentation", {"real_gyros": 6}), ("input_channels", {"seed": 1})],
)
def test_an_only_that_matches_nothing(new_project, pipeline, only):
    output = refused(new_project(), pipeline, env="smoke", only=only)
    assert "matches nothing" in output
    assert all(name in output for name in only)


# the catalog


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"patern": "*.npy"}, ["unexpected keyword argument 'patern'", "memsense.raw_logs.files"]),
        ({"files": None}, ["missing 1 required positional argument: 'files'"]),
    ],
)
def test_keys_of_a_catalog_entry(mine, change, words):
    project = mine(good())
    entries = yaml.safe_load((project.folder / "conf/mine/catalog.yml").read_text())
    entry = entries["memsense.raw_logs.files"] | change
    entry = {key: value for key, value in entry.items() if value is not None}
    project.configure("mine", catalog={"memsense.raw_logs.files": entry})
    output = refused(project)
    for word in ["error: catalog: ArrayLogs", *words]:
        assert word in output


# files of recordings


@pytest.mark.parametrize(
    ("array", "words"),
    [
        (good()[0], ["along 3 axes", "got float32 of shape (3, 1300)"]),
        (with_one((6, 2), 0.25), ["IMU 1 recording 7", "mine.npy recording 7", "stuck", "axis z"]),
        (good()[:, :2], ["(7, 2, 1300)", "gyroscopes in threes"]),
        (good()[..., :200], ["0 of 7 recordings", "too short", "8 s", "quality.least_s"]),
        (good()[..., :300], ["window of 30 s is 750 samples", "has 300", "windows_s"]),
    ],
    ids=["rank", "constant", "gyroscopes", "short", "window"],
)
def test_files(mine, array, words):
    output = refused(mine(array))
    assert "memsense" in output
    for word in words:
        assert word in output


def test_a_pickle_is_not_even_opened(mine, tmp_path):
    witness = tmp_path / "executed"

    class Trap:
        def __reduce__(self):
            return Path.touch, (witness,)

    output = refused(mine(np.array([Trap()])))
    assert "pickled objects" in output
    assert "never loaded" in output
    assert not witness.exists()


def test_a_file_that_is_not_there(mine):
    assert "memsense other.npy: no such file" in refused(mine(good(), name="other.npy"))


def test_more_gyroscopes_than_a_file_holds(mine):
    output = refused(mine(good(), real_gyros=6))
    assert "6 gyroscopes asked by real2real, the mine recordings hold 3" in output


# places


@pytest.mark.parametrize("layer", ["01_raw", "05_model_input"])
def test_a_file_in_place_of_a_data_folder(new_project, layer):
    project = new_project()
    (project.folder / "data" / layer).write_text("in the way")
    output = refused(project, env="smoke", only={"sensor": "ng"})
    assert f"data/{layer} is a file where a folder is needed; move it away" in output
    if layer != "01_raw":  # which is written before runs are planned
        assert set(project.files()) == {f"data/{layer}"}


def test_a_file_in_place_of_the_artifacts(mine):
    project = mine(good())
    (project.folder / "mlruns").write_text("in the way")
    assert "mlruns is a file where a folder is needed; move it away" in refused(project)


def foreign(store):
    store.unlink()
    with sqlite3.connect(store) as connection:
        connection.execute("create table books (title text)")
    connection.close()


# The same through the command line, where nothing stands between an error and the terminal.


CASES = {
    "key": (("--params=trainin.epochs=3",), "trainin: unknown key", None),
    "node": (("--nodes=bias_memsense",), "['ground_truth.bias_memsense']", None),
    "store": ((), "expected an MLflow store", foreign),
}
"""Arguments, what is said, and what is wrong with the project."""


@pytest.fixture(scope="module")
def commands(mine):
    """All cases, two at a time: most of what they do is to start."""

    def run(case):
        arguments, _, spoil = case
        project = mine(good())
        if spoil:
            spoil(project.store)
        before = project.files(".")
        done = project.kedro_run("--pipeline=real2real", "--env=mine", *arguments)
        return project, done, before

    with ThreadPoolExecutor(2) as pool:
        return dict(zip(CASES, pool.map(run, CASES.values()), strict=True))


@pytest.mark.parametrize("name", CASES)
def test_commands(commands, name):
    project, done, before = commands[name]
    check_refusal(project, done, before)
    assert done.code == 1
    assert CASES[name][1] in done.output
