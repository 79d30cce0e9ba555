"""A store that is described, and that finds its artifacts again after it was moved."""

import shutil

import pytest
from kedro.io import DatasetError
from mlflow import MlflowClient

from gyro_pipeline.conventions import InputError
from gyro_pipeline.datasets.tracked_runs import TrackedRuns
from gyro_pipeline.store import describe, main, relocate


@pytest.fixture
def moved(smoke, tmp_path):
    """The store of a smoke run in another folder; what it still says lies in a third, gone."""
    folder = tmp_path / "moved here"  # a space is written as %20
    folder.mkdir()
    shutil.copytree(smoke.project.folder / "mlruns", folder / "mlruns")
    shutil.copy(smoke.project.store, folder)
    relocate(folder / "mlflow.db", str(folder / "mlruns"))
    return folder.rename(tmp_path / "moved again")


def runs(folder):
    return TrackedRuns(str(folder / "mlflow.db"), "simulated_smoke", study="augmentation").load()


def test_after_a_move_the_artifacts_are_found_again(moved):
    with pytest.raises(DatasetError, match=r"moved here.* type `python -m gyro_pipeline.store"):
        runs(moved)
    told = relocate(moved / "mlflow.db", str(moved / "mlruns"))
    found = runs(moved)
    assert told >= len(found)
    assert len(found[0].load("errors.parquet")) > 0
    model = MlflowClient(f"sqlite:///{moved / 'mlflow.db'}").search_logged_models(["1"])[0]
    assert "moved%20again/mlruns/" in model.artifact_location
    for run in MlflowClient(f"sqlite:///{moved / 'mlflow.db'}").search_runs(["1", "2", "3"]):
        assert "moved%20again/mlruns/" in run.info.artifact_uri
        assert run.info.artifact_uri.endswith(f"/{run.info.run_id}/artifacts")


def test_a_store_can_be_told_that_a_server_has_its_artifacts(moved):
    relocate(moved / "mlflow.db", "mlflow-artifacts:")
    client = MlflowClient(f"sqlite:///{moved / 'mlflow.db'}")
    experiment = client.get_experiment_by_name("augmentation")
    assert experiment.artifact_location == "mlflow-artifacts:/augmentation"
    (run, *_) = client.search_runs([experiment.experiment_id])
    wanted = f"mlflow-artifacts:/augmentation/{run.info.run_id}/artifacts"
    assert run.info.artifact_uri == wanted
    assert describe(moved / "mlflow.db")["artifacts MB"].isna().all()


def test_a_folder_without_the_artifacts_is_refused_and_nothing_is_changed(moved):
    before = describe(moved / "mlflow.db")
    with pytest.raises(InputError, match="are not there; move them first"):
        relocate(moved / "mlflow.db", str(moved / "nowhere"))
    assert describe(moved / "mlflow.db").equals(before)


def test_what_a_store_holds_is_printed(moved, smoke, capsys):
    main(["--store", str(moved / "mlflow.db"), "--artifacts-in", str(moved / "mlruns")])
    printed = capsys.readouterr().out
    (line,) = [line for line in printed.splitlines() if " augmentation " in line]
    _, _, count, deleted, size, *_ = line.split()
    assert int(count) >= len(smoke.runs)
    assert int(deleted) >= 0
    assert float(size) > 0
    assert " MB" in printed.splitlines()[-1]


def test_without_a_store_there_is_an_error_and_no_new_store(tmp_path):
    with pytest.raises(SystemExit, match="no such file; type --store FILE"):
        main(["--store", str(tmp_path / "mlflow.db")])
    assert list(tmp_path.iterdir()) == []
