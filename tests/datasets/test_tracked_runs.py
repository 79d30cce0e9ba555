import os
import shutil
import signal
import sqlite3
import subprocess
import sys
from functools import partial
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import torch
from kedro.io import DatasetError
from mlflow import MlflowClient

from gyro_pipeline.conventions import InputError
from gyro_pipeline.datasets import tracked_runs
from gyro_pipeline.datasets.tracked_runs import TrackedRuns
from gyro_pipeline.tracking import EvaluatedRun, TrainedRun

STARTED_MS, ENDED_MS = 1_700_000_000_000, 1_700_000_060_000


@pytest.fixture(scope="session")
def new_store(tmp_path_factory):
    """An MLflow store without runs; making one takes seconds."""
    path = tmp_path_factory.mktemp("new_store") / "mlflow.db"
    with pytest.MonkeyPatch.context() as patch:
        patch.delenv("MLFLOW_TRACKING_URI", raising=False)
        assert TrackedRuns(str(path), "simulated").load() == []
    return path


@pytest.fixture
def store(tmp_path, new_store, monkeypatch):
    monkeypatch.delenv("MLFLOW_TRACKING_URI", raising=False)
    return Path(shutil.copy(new_store, tmp_path / "mlflow.db"))


def tracked(store, source="simulated", **only):
    return TrackedRuns(str(store), source, **only)


def params(**changes):
    given = {
        "study": "real2real",
        "sensor": "dot",
        "source": "simulated",
        "real_gyros": 3,
        "virtual_gyros": 0,
        "window_s": 10.0,
        "seed": 0,
        "fold": -1,
        "estimator": "cnn",
    }
    return given | changes


def trained(tags=None, started_ms=STARTED_MS, history=None, artifacts=None, **changes):
    given = params(**changes)
    tags = {"fingerprint": "f00d"} | (tags or {})
    return TrainedRun(
        given["study"], given, tags, started_ms, ENDED_MS, history, artifacts=artifacts or {}
    )


def history(epochs):
    epoch = np.arange(1, epochs + 1)
    return pd.DataFrame({"epoch": epoch, "train_loss": 1 / epoch, "val_loss": 0.5 + 1 / epoch})


def statuses(store, study="real2real"):
    """Status of every run of a study by its name, as MLflow itself has it."""
    client = MlflowClient(f"sqlite:///{store}")
    experiment = client.get_experiment_by_name(study).experiment_id
    return {run.info.run_name: run.info.status for run in client.search_runs([experiment])}


def test_a_trained_run_waits_for_its_evaluation(store):
    tracked(store).save(
        trained({"data_hash": "abc"}, history=history(3), artifacts={"history.csv": history(3)})
    )
    (run,) = tracked(store).load()
    assert not run.finished
    assert run.study == "real2real"
    assert run.started_ms == STARTED_MS
    assert run.params == {key: str(value) for key, value in params().items()}
    assert run.tags["data_hash"] == "abc"
    assert run.fingerprint == "f00d"
    assert run.metrics == {"train_loss": pytest.approx(1 / 3), "val_loss": pytest.approx(5 / 6)}
    assert statuses(store) == {"dot 3+0 10 s seed 0": "RUNNING"}


@pytest.mark.parametrize(
    ("changes", "name"),
    [
        ({"real_gyros": 12, "virtual_gyros": 24, "seed": 4}, "dot 12+24 10 s seed 4"),
        ({"fold": 7, "window_s": 2.5}, "dot 3+0 2.5 s seed 0 fold 7"),
        ({"estimator": "mean", "real_gyros": 0, "window_s": 30.0}, "dot mean 30 s"),
    ],
)
def test_the_name_of_a_run_tells_what_it_is(store, changes, name):
    tracked(store).save(trained(**changes))
    assert statuses(store) == {name: "RUNNING"}


@pytest.mark.parametrize(("epochs", "points"), [(7, 7), (50, 50), (120, 40), (1200, 50)])
def test_curves_are_thinned_and_keep_the_last_epoch(store, epochs, points):
    tracked(store).save(trained(history=history(epochs)))
    (run,) = tracked(store).load()
    client = MlflowClient(f"sqlite:///{store}")
    for name in ("train_loss", "val_loss"):
        curve = client.get_metric_history(run.run_id, name)
        steps = sorted(point.step for point in curve)
        assert len(steps) == points
        assert steps[-1] == epochs
        assert len(set(np.diff(steps))) == 1
        whole = history(epochs).set_index("epoch")[name]
        assert {p.step: p.value for p in curve} == pytest.approx(whole[steps].to_dict())
        assert {p.timestamp for p in curve} == {ENDED_MS}


def test_an_evaluated_run_is_finished_and_keeps_what_it_had(store):
    runs = tracked(store)
    runs.save(trained(history=history(3), artifacts={"history.csv": history(3)}))
    (waiting,) = runs.load()
    errors = pd.DataFrame({"recording": [81, 81], "error_dps": [1e-3, -2e-3]})
    metrics = {"test_rmse_dps": 1.25e-3, "time_saving_pct": -12.5}
    runs.save(
        EvaluatedRun(waiting.run_id, metrics, {"evaluated_with": "x1"}, {"errors.parquet": errors})
    )
    (run,) = tracked(store).load()
    assert run.finished
    assert run.run_id == waiting.run_id
    assert run.metrics == dict(waiting.metrics) | metrics
    assert run.tags["evaluated_with"] == "x1"
    assert run.fingerprint == "f00d"
    pd.testing.assert_frame_equal(run.load("errors.parquet"), errors)
    pd.testing.assert_frame_equal(run.load("history.csv"), history(3))
    info = MlflowClient(f"sqlite:///{store}").get_run(run.run_id).info
    assert (info.start_time, info.end_time) == (STARTED_MS, ENDED_MS)  # of the training


def test_a_second_evaluation_replaces_what_is_shown(store):
    """Also by a lower value: of equal times MLflow would show the larger one."""
    runs = tracked(store)
    runs.save(trained())
    (run,) = runs.load()
    for rmse, judged_with in ((2e-3, "first"), (1e-3, "second")):
        errors = pd.DataFrame({"error_dps": [rmse]})
        runs.save(
            EvaluatedRun(
                run.run_id,
                {"test_rmse_dps": rmse},
                {"evaluated_with": judged_with},
                {"errors.parquet": errors},
            )
        )
    (run,) = runs.load()
    assert run.metrics == {"test_rmse_dps": 1e-3}
    assert run.tags["evaluated_with"] == "second"
    assert run.load("errors.parquet").error_dps.tolist() == [1e-3]
    assert run.finished


def test_loading_narrows_to_study_sensor_and_source(store):
    everything = [
        (study, sensor, source)
        for study in ("real2real", "augmentation")
        for sensor in ("dot", "ng")
        for source in ("simulated", "published")
    ]
    for study, sensor, source in everything:
        tracked(store).save(trained(study=study, sensor=sensor, source=source))

    def found(**only):
        return sorted(
            (run.study, run.params["sensor"], run.params["source"])
            for run in tracked(store, **only).load()
        )

    assert found() == sorted(one for one in everything if one[2] == "simulated")
    assert found(source=None) == sorted(everything)
    assert found(source="published", sensor="ng") == [
        ("augmentation", "ng", "published"),
        ("real2real", "ng", "published"),
    ]
    assert found(study="augmentation", sensor="dot") == [("augmentation", "dot", "simulated")]
    assert found(study="input_channels") == []
    assert found(sensor="memsense") == []


def test_each_study_is_an_experiment_with_its_artifacts_beside_the_store(store):
    for study in ("real2real", "augmentation"):
        tracked(store).save(trained(study=study, artifacts={"history.csv": history(1)}))
    experiments = {e.name: e for e in MlflowClient(f"sqlite:///{store}").search_experiments()}
    assert {"real2real", "augmentation"} <= set(experiments)
    for study in ("real2real", "augmentation"):
        folder = store.parent / "mlruns" / study
        assert experiments[study].artifact_location == folder.as_uri()
        assert len(list(folder.rglob("history.csv"))) == 1


def test_runs_come_newest_first(store):
    for seed, started_ms in enumerate([2000, 3000, 1000]):
        tracked(store).save(trained(seed=seed, started_ms=started_ms))
    assert [run.params["seed"] for run in tracked(store).load()] == ["1", "0", "2"]


def test_all_runs_are_found_where_the_store_answers_in_pages(store):
    runs = tracked(store)
    for seed in range(5):
        runs.save(trained(seed=seed))
    runs._client.search_runs = partial(runs._client.search_runs, max_results=2)
    assert sorted(run.params["seed"] for run in runs.load()) == list("01234")


def test_a_store_without_runs_is_empty(store, tmp_path):
    assert tracked(store, study="real2real").load() == []
    assert tracked(store).exists()
    assert not tracked(tmp_path / "none.db").exists()


def test_new_runs_carry_the_provenance_and_their_own_tags_win(store):
    runs = tracked(store)
    runs.provenance |= {"kedro_run": "2024-09-01T00.00.00", "torch": "2.13.0"}
    runs.save(trained({"torch": "of the run itself"}))
    (run,) = tracked(store).load()
    assert run.tags["kedro_run"] == "2024-09-01T00.00.00"
    assert run.tags["torch"] == "of the run itself"


def test_artifacts_come_back_as_they_were(store):
    generator = np.random.default_rng(0)
    weights = {
        "architecture": {"gyroscopes": 3, "window": 1083},
        "scaling": {"centre": torch.rand(3, dtype=torch.float64), "input_scale": 1 / 3},
        "last": {"convolution.weight": torch.rand(8, 3, 10)},
        "best": None,
        "best_epoch": 17,
    }
    errors = pd.DataFrame(
        {
            "recording": [81, 82],
            "axis": ["x", "z"],
            "truth_variance": generator.normal(size=2),
            "error_dps": generator.normal(size=2).astype(np.float32),
        }
    )
    losses = pd.DataFrame({"epoch": range(1, 501), "train_loss": generator.lognormal(size=500)})
    given = {
        "weights.pt": weights,
        "errors.parquet": errors,
        "history.csv": losses,
        "notes.json": {"ceiling": [1 / 3, None, "deg/s"]},
    }
    tracked(store).save(trained(artifacts=given))
    (run,) = tracked(store).load()
    stored = run.load("weights.pt")
    for path in (("scaling", "centre"), ("last", "convolution.weight")):
        before, after = (tree[path[0]].pop(path[1]) for tree in (weights, stored))
        assert after.dtype == before.dtype
        assert torch.equal(after, before)
    assert stored == weights
    pd.testing.assert_frame_equal(run.load("errors.parquet"), errors, check_exact=True)
    pd.testing.assert_frame_equal(run.load("history.csv"), losses, check_exact=True)
    assert run.load("notes.json") == given["notes.json"]


def test_weights_that_could_run_code_are_not_loaded(store, tmp_path):
    tracked(store).save(trained(artifacts={"weights.pt": {"last": Path("/tmp")}}))
    (run,) = tracked(store).load()
    with pytest.raises(Exception, match="Weights only load failed"):
        run.load("weights.pt")


KILLED = """
import os, signal, sys
from gyro_pipeline.datasets import tracked_runs
from gyro_pipeline.datasets.tracked_runs import TrackedRuns
from gyro_pipeline.tracking import TrainedRun

class Fatal:
    def to_parquet(self, path):
        os.kill(os.getpid(), signal.SIGKILL)

runs = TrackedRuns(sys.argv[1], "simulated")
for seed, artifacts in enumerate([{}, {"errors.parquet": Fatal()}]):
    params = {"sensor": "dot", "source": "simulated", "real_gyros": 3, "virtual_gyros": 0,
              "window_s": 10, "seed": seed, "fold": -1, "estimator": "cnn"}
    runs.save(TrainedRun("real2real", params, {"fingerprint": "f00d"}, 1, 2, artifacts=artifacts))
"""


def test_of_a_killed_process_trained_runs_wait_and_half_written_ones_end(store):
    done = subprocess.run([sys.executable, "-c", KILLED, str(store)], check=False, timeout=120)
    assert done.returncode == -signal.SIGKILL
    waiting, half_written = "dot 3+0 10 s seed 0", "dot 3+0 10 s seed 1"
    assert statuses(store) == {waiting: "RUNNING", half_written: "RUNNING"}
    (run,) = tracked(store).load()
    assert run.params["seed"] == "0"
    assert not run.finished
    assert statuses(store) == {waiting: "KILLED", half_written: "KILLED"}
    tracked(store).save(EvaluatedRun(run.run_id, {"test_rmse_dps": 1e-3}, {}, {}))
    assert statuses(store) == {waiting: "FINISHED", half_written: "KILLED"}


def half_written(store, seed=0):
    """A run that this process could not write to its end; its id and owner."""
    with pytest.raises(DatasetError):
        tracked(store).save(trained(seed=seed, artifacts={"errors.parquet": "no table"}))
    client = MlflowClient(f"sqlite:///{store}")
    experiment = client.get_experiment_by_name("real2real").experiment_id
    newest, *_ = client.search_runs([experiment], f"params.seed = '{seed}'")
    return newest.info.run_id, newest.data.tags["process"].split()


def test_a_half_written_run_of_a_living_process_is_left_alone(store):
    half_written(store)
    assert tracked(store).load() == []
    assert statuses(store) == {"dot 3+0 10 s seed 0": "RUNNING"}


@pytest.mark.parametrize(
    ("change", "status"),
    [
        ({1: "{gone}"}, "KILLED"),
        ({2: "1.5"}, "KILLED"),  # another process got its number
        ({0: "elsewhere", 1: "{gone}"}, "RUNNING"),  # cannot be known from here
    ],
)
def test_whose_process_is_gone_is_told_by_host_number_and_start(store, change, status):
    run_id, owner = half_written(store)
    gone = subprocess.Popen([sys.executable, "-c", ""])
    gone.wait()
    for place, value in change.items():
        owner[place] = value.format(gone=gone.pid)
    MlflowClient(f"sqlite:///{store}").set_tag(run_id, "process", " ".join(owner))
    assert tracked(store).load() == []
    assert statuses(store) == {"dot 3+0 10 s seed 0": status}


def test_half_written_runs_end_whatever_is_loaded_and_however_many_there_are(store):
    for seed in range(3):
        run_id, owner = half_written(store, seed)
        owner[2] = "1.5"
        MlflowClient(f"sqlite:///{store}").set_tag(run_id, "process", " ".join(owner))
    runs = tracked(store, source="published", sensor="ng")
    runs._client.search_runs = partial(runs._client.search_runs, max_results=2)
    assert runs.load() == []
    assert set(statuses(store).values()) == {"KILLED"}


def damaged_in_the_middle(path):
    content = bytearray(path.read_bytes())
    content[8192 : 8192 + 40_000] = os.urandom(40_000)
    path.write_bytes(content)


def cut_short(path):
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def without_its_header(path):
    path.write_bytes(b"x" * 100 + path.read_bytes()[100:])


def no_sqlite(path):
    path.write_bytes(b"seed,rmse\n0,0.001\n" * 100)


def foreign(path):
    path.unlink()
    with sqlite3.connect(path) as connection:
        connection.execute("create table bookmarks (url text)")
        connection.execute("insert into bookmarks values ('https://example.org')")
    connection.close()


@pytest.mark.parametrize(
    ("spoil", "told"),
    [
        (damaged_in_the_middle, "damaged|not a readable SQLite file"),
        (cut_short, "damaged|not a readable SQLite file"),
        (without_its_header, "not a readable SQLite file"),
        (no_sqlite, "not a readable SQLite file"),
        (foreign, "expected an MLflow store, got an SQLite file with tables bookmarks"),
    ],
)
@pytest.mark.parametrize("use", [TrackedRuns.load, lambda runs: runs.save(trained())])
def test_a_file_that_is_no_sound_store_is_refused_and_left_as_it_is(store, spoil, told, use):
    tracked(store).save(trained())
    spoil(store)
    before = store.read_bytes()
    around = set(store.parent.iterdir())
    with pytest.raises(DatasetError) as caught:
        use(tracked(store))
    refused = caught.value.__cause__
    assert isinstance(refused, InputError)
    pytest.raises(InputError, refuse, refused).match(told)
    assert str(store) in str(refused)
    assert "move it away" in str(refused)
    assert store.read_bytes() == before
    assert set(store.parent.iterdir()) == around


def refuse(error):
    raise error


def test_an_mlflow_store_of_another_version_is_refused_and_left_as_it_is(store):
    with sqlite3.connect(store) as connection:
        connection.execute("update alembic_version set version_num = '123456789abc'")
    connection.close()
    before = store.read_bytes()
    with pytest.raises(DatasetError) as caught:
        tracked(store).load()
    assert isinstance(caught.value.__cause__, InputError)
    assert "mlflow db upgrade" in str(caught.value.__cause__)
    assert store.read_bytes() == before


INTERRUPTED = """
import os, signal, sqlite3, sys
connection = sqlite3.connect(sys.argv[1], isolation_level=None)
connection.execute("pragma cache_size = 1")  # what does not fit is written before the commit
connection.execute("begin")
for row in range(2000):
    connection.execute("insert into experiment_tags values (?, ?, 0)", (f"{row}", "x" * 500))
os.kill(os.getpid(), signal.SIGKILL)
"""


def test_a_store_whose_writer_was_killed_in_mid_write_is_not_taken_for_damaged(store):
    tracked(store).save(trained())
    done = subprocess.run([sys.executable, "-c", INTERRUPTED, str(store)], check=False, timeout=60)
    assert done.returncode == -signal.SIGKILL
    assert store.with_name("mlflow.db-journal").stat().st_size > 0
    (run,) = tracked(store).load()
    assert run.fingerprint == "f00d"
    with sqlite3.connect(store) as connection:  # what was half written is rolled back
        rows = connection.execute("select count(*) from experiment_tags where value like 'x%'")
        assert rows.fetchone() == (0,)
    connection.close()


def test_a_store_is_there_complete_or_not_at_all(tmp_path, monkeypatch):
    """Half made, as a kill would leave it, MLflow could not use it."""
    monkeypatch.delenv("MLFLOW_TRACKING_URI", raising=False)

    def interrupted(uri):
        half_made = Path(uri.removeprefix("sqlite:///"))
        assert half_made != tmp_path / "mlflow.db"
        half_made.write_bytes(b"half a store")
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(tracked_runs, "MlflowClient", interrupted)
        with pytest.raises(KeyboardInterrupt):
            tracked(tmp_path / "mlflow.db").load()
    assert list(tmp_path.iterdir()) == []


def test_a_store_that_is_not_there_is_made(new_store):
    """The fixture let the dataset make it."""
    assert set(new_store.parent.iterdir()) == {new_store}
    assert {e.name for e in MlflowClient(f"sqlite:///{new_store}").search_experiments()} == {
        "Default"
    }


def test_a_tracking_uri_of_the_environment_wins(store, new_store, tmp_path, monkeypatch):
    other = tmp_path / "elsewhere" / "runs.db"
    other.parent.mkdir()
    shutil.copy(new_store, other)
    monkeypatch.chdir(other.parent)  # where MLflow then keeps artifacts
    before = store.read_bytes()
    monkeypatch.setenv("MLFLOW_TRACKING_URI", f"sqlite:///{other}")
    tracked(store).save(trained(artifacts={"history.csv": history(2)}))
    (run,) = tracked(store).load()
    pd.testing.assert_frame_equal(run.load("history.csv"), history(2))
    assert statuses(other) == {"dot 3+0 10 s seed 0": "RUNNING"}
    assert store.read_bytes() == before
    assert tracked(tmp_path / "none.db").exists()
    monkeypatch.delenv("MLFLOW_TRACKING_URI")
    assert tracked(store).load() == []
