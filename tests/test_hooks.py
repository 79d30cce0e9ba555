import sys
from types import SimpleNamespace

import pytest
from kedro.io import DataCatalog
from kedro.runner import ParallelRunner, SequentialRunner

from gyro_pipeline.conventions import InputError
from gyro_pipeline.datasets.tracked_runs import TrackedRuns
from gyro_pipeline.hooks import Provenance
from gyro_pipeline.session import Session

PARALLEL = object.__new__(ParallelRunner)  # one that is made starts a process


def test_ways_to_run_that_cannot_end_well_are_refused():
    for options, words in (
        ({"only_missing_outputs": True}, "--only-missing-outputs: .* type kedro run without it"),
        ({"runner": PARALLEL}, "ParallelRunner: .*execution.workers=N"),
        ({"runner": SequentialRunner(is_async=True)}, "--async: .* type kedro run without it"),
    ):
        with pytest.raises(InputError, match=words):
            object.__new__(Session).run(**options)


def test_new_runs_are_marked_with_who_made_them_by_which_command(tmp_path, monkeypatch):
    runs = TrackedRuns(str(tmp_path / "mlflow.db"))
    monkeypatch.setattr(sys, "argv", ["/usr/bin/kedro", "run", "--params=a b"])
    monkeypatch.setenv("LOGNAME", "gauss")
    pipeline = SimpleNamespace(datasets=lambda: {"dot.training.runs"})
    run_params = {"project_path": str(tmp_path), "run_id": "1", "env": None}
    Provenance().before_pipeline_run(run_params, pipeline, DataCatalog({"dot.training.runs": runs}))
    assert runs.provenance["mlflow.user"] == "gauss"
    assert runs.provenance["mlflow.source.name"] == "kedro run '--params=a b'"
    assert runs.provenance["kedro_env"] == "base"
