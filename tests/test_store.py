"""A store that is described, and that finds its artifacts again after it was moved."""

import shutil

import pytest
from kedro.io import DatasetError
from mlflow import MlflowClient

from gyro_pipeline.conventions import InputError
from gyro_pipeline.datasets.tracked_runs import TrackedRuns
from gyro_pipeline.store import describe, main, relocate


def runs(folder):
    return TrackedRuns(str(folder / "mlflow.db"), "simulated_smoke", study="augmentation").load()


def test_after_a_move_the_artifacts_are_found_again(smoke, tmp_path, capsys):
    folder = tmp_path / "moved here"  # a space is written as %20
    folder.mkdir()
    shutil.copytree(smoke.project.folder / "mlruns", folder / "mlruns")
    shutil.copy(smoke.project.store, folder)
    relocate(folder / "mlflow.db", str(folder / "mlruns"))
    moved = folder.rename(tmp_path / "moved again")
    with pytest.raises(DatasetError, match=r"moved here.* type `python -m gyro_pipeline.store"):
        runs(moved)
    store = moved / "mlflow.db"
    before = describe(store)
    with pytest.raises(InputError, match="are not there; move them first"):
        relocate(store, str(moved / "nowhere"))
    assert describe(store).equals(before)
    main(["--store", str(store), "--artifacts-in", str(moved / "mlruns")])
    printed = capsys.readouterr().out
    (line,) = [line for line in printed.splitlines() if " augmentation " in line]
    _, _, count, _, size, *_ = line.split()
    assert int(count) >= len(smoke.runs) and float(size) > 0
    assert len(runs(moved)[0].load("errors.parquet")) > 0
    client = MlflowClient(f"sqlite:///{store}")
    assert "moved%20again/mlruns/" in client.search_logged_models(["1"])[0].artifact_location
    for run in client.search_runs(["1", "2", "3"]):
        assert "moved%20again/mlruns/" in run.info.artifact_uri
        assert run.info.artifact_uri.endswith(f"/{run.info.run_id}/artifacts")
    relocate(store, "mlflow-artifacts:")
    experiment = client.get_experiment_by_name("augmentation")
    assert experiment.artifact_location == "mlflow-artifacts:/augmentation"
    (run, *_) = client.search_runs([experiment.experiment_id])
    wanted = f"mlflow-artifacts:/augmentation/{run.info.run_id}/artifacts"
    assert run.info.artifact_uri == wanted
    assert describe(store)["artifacts MB"].isna().all()


def test_without_a_store_there_is_an_error_and_no_new_store(tmp_path):
    with pytest.raises(SystemExit, match="no such file; type --store FILE"):
        main(["--store", str(tmp_path / "mlflow.db")])
    assert list(tmp_path.iterdir()) == []
