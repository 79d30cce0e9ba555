"""``kedro run --pipeline=leakage`` on the smoke environment; no other run has any of it."""

from pathlib import Path

import pandas as pd
import pytest
from kedro.framework.startup import bootstrap_project

from gyro_pipeline import pipeline_registry

ROOT = Path(__file__).parents[1]
FEW = {"strides_s": [10], "folds": 2, "training": {"steps": 4}, "recordings": 4}
REPORT = "data/08_reporting/simulated_smoke"
WRITTEN = {
    *(f"tables/leakage_results.{ending}" for ending in ("csv", "md", "tex")),
    *(f"figures/leakage_accuracy_against_stride.{ending}" for ending in ("png", "svg")),
}
WAYS = {
    ("k_fold", "mean"): 3,  # of fits: two folds, and all recordings
    ("k_fold", "training_mean"): 3,
    ("k_fold", "cnn"): 3,
    ("k_fold", "cnn_shuffled"): 3,
    ("window_split", "cnn"): 2,
    ("test_in_training", "cnn"): 1,
    ("best_epoch_on_test", "cnn"): 2,
}


@pytest.fixture(scope="module")
def project(new_project):
    return new_project()


def run(project, pipeline="leakage", study=FEW, **params):
    given = {"execution": {"executor": "serial"}, "evaluation": {"resamples": 100}}
    return project.run_here(pipeline, "smoke", studies={"leakage": study}, **given | params)


@pytest.fixture(scope="module")
def first(project):
    done = run(project)
    return done, project.runs("leakage"), project.files()


def test_each_way_of_training_is_one_finished_run_that_says_what_it_is(first):
    done, runs, files = first
    assert done.code == 0, done.output
    ways = {(one.data.params["protocol"], one.data.params["estimator"]): one for one in runs}
    assert len(runs) == len(ways)
    fits = {way: one.data.tags["fits"].count(";") for way, one in ways.items()}
    assert fits == WAYS
    for (protocol, _), one in ways.items():
        assert one.info.status == "FINISHED"
        assert one.data.params["window_stride_s"] == "10.0"
        assert protocol in one.info.run_name
        assert protocol in one.data.tags["mlflow.note.content"]
    leaks = [path for path in files if path.startswith(REPORT) and "leakage_" in path]
    assert {"/".join(path.split("/")[-2:]) for path in leaks} == WRITTEN
    (results,) = [path for path in files if path.endswith("leakage/results.csv")]
    assert len(files[results].splitlines()) == 1 + 5


def test_a_second_run_trains_nothing_and_another_stride_only_its_own(project, first):
    again = run(project)
    assert again.code == 0, again.output
    assert "leakage memsense: 7 runs planned, 7 skipped (made before), 0 shared" in again.output
    assert "memsense: 0 runs evaluated, 7 skipped" in again.output
    more = run(project, study=FEW | {"strides_s": [10, 20]})
    assert more.code == 0, more.output
    assert "14 runs planned, 7 skipped (made before)" in more.output
    paths = (project.folder / REPORT).rglob("tables/leakage_results.csv")
    table = pd.read_csv(max(paths, key=lambda path: path.stat().st_mtime))
    assert table["Window stride s"].tolist() == [10, 20]


def test_a_study_on_the_same_recordings_shares_nothing_with_it(project, first):
    only = {"sensor": "memsense", "real_gyros": 3, "window_s": 10}
    done = run(project, "real2real", only=only, training={"epochs": 2})
    assert done.code == 0, done.output
    assert "3 runs planned, 0 skipped (made before), 0 shared with another study" in done.output
    (page,) = [path for path in project.files(REPORT) if "only" in path and path.endswith("t.md")]
    assert "on purpose" not in project.files(REPORT)[page].decode()


def test_an_only_without_its_sensor_is_refused(project):
    done = run(project, only={"sensor": "dot"})
    assert done.code != 0
    assert "only={'sensor': 'dot'} matches nothing in leakage" in done.output


def test_no_other_pipeline_has_any_of_its_nodes(monkeypatch, parameters):
    bootstrap_project(ROOT)
    monkeypatch.setattr(pipeline_registry, "_selected", parameters("base"))
    registered = pipeline_registry.register_pipelines()
    own = {node.name for node in registered["leakage"].nodes if "leakage" in node.name}
    assert own
    for name, pipeline in registered.items():
        found = {node.name for node in pipeline.nodes if "leakage" in node.name}
        assert found == (own if name == "leakage" else set()), name
