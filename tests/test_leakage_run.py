"""``kedro run --pipeline=leakage`` on the smoke environment; no other run has any of it."""

from collections import Counter
from pathlib import Path

import pandas as pd
import pytest
from kedro.framework.startup import bootstrap_project

from gyro_pipeline import pipeline_registry
from gyro_pipeline.conventions import LEAKS

ROOT = Path(__file__).parents[1]
SERIAL = {"executor": "serial"}
FEW = {"strides_s": [10], "folds": 2, "steps": 4, "recordings": 4}
REPORT = "data/08_reporting/simulated_smoke"
WRITTEN = {
    *(f"{REPORT}/tables/leakage_results.{ending}" for ending in ("csv", "md", "tex")),
    *(f"{REPORT}/figures/leakage_accuracy_against_stride.{ending}" for ending in ("png", "svg")),
}


@pytest.fixture(scope="module")
def project(new_project):
    return new_project()


def run(project, pipeline="leakage", **params):
    given = {"leakage": FEW, "execution": SERIAL, "evaluation": {"resamples": 100}} | params
    return project.run_here(pipeline, "smoke", **given)


@pytest.fixture(scope="module")
def first(project):
    done = run(project)
    return done, project.runs("leakage"), project.files()


def test_it_ends_well_with_one_run_for_each_training(first):
    done, runs, _ = first
    assert done.code == 0, done.output
    assert {one.info.status for one in runs} == {"FINISHED"}
    ways = Counter((one.data.params["leak"], one.data.params["estimator"]) for one in runs)
    assert sum(ways.values()) == len(runs) == 4 * 2 + 1
    assert {leak for leak, _ in ways} == set(LEAKS)
    assert ways["none", "cnn_shuffled"] == 2


def test_every_run_is_marked_as_what_it_is(first):
    for one in first[1]:
        assert one.data.params["study"] == "leakage"
        assert one.data.params["window_stride_s"] == "10.0"
        assert f"leak {one.data.params['leak']}" in one.data.tags["mlflow.runName"]
        assert not any(name.startswith("beats_oracle") for name in one.data.metrics)


def test_the_table_and_the_figure_are_written_and_nothing_of_other_studies(first):
    files = first[2]
    assert {path for path in files if path.startswith(REPORT)} == WRITTEN
    results = "data/07_model_output/simulated_smoke/leakage_results.csv"
    assert len(files[results].splitlines()) == 1 + 5


def test_a_second_run_trains_nothing(project, first):
    again = run(project)
    assert again.code == 0, again.output
    assert "leakage memsense: 9 runs planned, 9 skipped (trained before), 0 shared" in again.output
    assert "leakage memsense: 0 runs evaluated, 9 skipped" in again.output
    assert len(project.runs("leakage")) == len(first[1])


def test_another_stride_trains_only_its_own(project, first):
    more = run(project, leakage=FEW | {"strides_s": [10, 20]})
    assert more.code == 0, more.output
    assert "18 runs planned, 9 skipped (trained before)" in more.output
    table = pd.read_csv(project.folder / REPORT / "tables/leakage_results.csv")
    assert table["Window stride s"].tolist() == [10, 20]


def test_a_study_on_the_same_recordings_shares_nothing_with_it(project, first):
    only = {"sensor": "memsense", "real_gyros": 3, "window_s": 10}
    done = run(project, "real2real", only=only, training={"epochs": 2})
    assert done.code == 0, done.output
    assert "3 runs planned, 0 skipped (trained before), 0 shared with another study" in done.output
    for path, content in project.files(REPORT).items():
        if "leakage" not in path:
            assert b"leak" not in content, path


def test_an_only_without_its_sensor_is_refused(project):
    done = run(project, only={"sensor": "dot"})
    assert done.code != 0
    assert "only={'sensor': 'dot'} matches nothing in leakage" in done.output


def test_no_other_pipeline_has_any_of_its_nodes(monkeypatch, parameters):
    bootstrap_project(ROOT)
    monkeypatch.setattr(pipeline_registry, "_selected", parameters("base"))
    registered = pipeline_registry.register_pipelines()
    own = {node.name for node in registered["leakage"].nodes if "leakage" in node.name}
    assert len(own) == 6
    for name, pipeline in registered.items():
        found = {node.name for node in pipeline.nodes if "leakage" in node.name}
        assert found == (own if name == "leakage" else set())
