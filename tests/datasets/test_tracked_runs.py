import json
import logging
import os
import shutil
import signal
import sqlite3
import subprocess
import sys
from functools import partial
from importlib import import_module
from pathlib import Path
from unittest.mock import Mock

import mlflow
import numpy as np
import pandas as pd
import psutil
import pytest
from kedro.io import DatasetError
from mlflow import MlflowClient

from gyro_pipeline.conventions import InputError
from gyro_pipeline.datasets import run_store
from gyro_pipeline.datasets.tracked_runs import TrackedRuns, run_link
from gyro_pipeline.store import relocate
from gyro_pipeline.tracking import EvaluatedRun, FittedRun, RunIdentity

STARTED_MS, ENDED_MS = 1_700_000_000_000, 1_700_000_060_000
NAME = "dot constant 3+0 10 s seed 0"
MODEL = "hold-out"
WINDOWS = np.random.default_rng(0).normal(0, 0.05, (2, 3, 40))
PARAMS = {
    **{"study": "real2real", "sensor": "dot", "source": "simulated", "real_gyros": 3},
    **{"virtual_gyros": 0, "window_s": 10.0, "seed": 0, "estimator": "constant"},
}
sys.path.insert(0, str(Path(__file__).with_name("outside")))
Constant = import_module("constant").Constant
pytestmark = pytest.mark.slow
KILLED = """
import os, signal, sys
sys.path.insert(0, sys.argv[2])
from test_tracked_runs import MODEL, Constant, fitted, tracked

class Fatal(Constant):
    def save(self, folder):
        os.kill(os.getpid(), signal.SIGKILL)

runs = tracked(sys.argv[1])
runs.save(fitted(seed=0))
for fold, estimator in (("fold 0", Constant(0.5)), ("fold 1", Fatal())):
    runs.save(fitted(fold=fold, folds=("fold 0", "fold 1", MODEL), seed=1, estimator=estimator))
"""
APPLY = """
import sys
import mlflow, numpy
mlflow.set_tracking_uri(sys.argv[1])
for uri in sys.argv[2:]:
    print(*mlflow.pyfunc.load_model(uri).predict(numpy.zeros((1, 3, 9)))["bias_dps"][0])
"""


@pytest.fixture
def store(tmp_path, made_once):
    """An MLflow store without runs; making one takes seconds."""
    empty = made_once("store", lambda folder: run_store.make_store(folder / "mlflow.db"))
    return Path(shutil.copy(empty / "mlflow.db", tmp_path))


def tracked(store, source="simulated", **only):
    return TrackedRuns(str(store), source, **only)


def fitted(tags=None, fold=MODEL, folds=(MODEL,), estimator=None, **changes):
    given = PARAMS | changes
    name, key = f"dot constant 3+0 10 s seed {given['seed']}", f"f00d{given['seed']}"
    note = "It was trained on this and tested on that."
    run = RunIdentity(given["study"], key, given, tags or {}, folds, name, note)
    dataset = {"name": "dot", "digest": "abc", "source": "simulated", "recordings": "83"}
    made = estimator or Constant(), STARTED_MS, ENDED_MS, fold == MODEL, WINDOWS, dataset
    return FittedRun(run, fold, *made)


def history(epochs):
    epoch = np.arange(1, epochs + 1)
    return pd.DataFrame({"epoch": epoch, "train_loss": 1 / epoch, "val_loss": 0.5 + 1 / epoch})


def statuses(store):
    """Status of every run of the study by its name, as MLflow itself has it."""
    client = MlflowClient(f"sqlite:///{store}")
    experiment = client.get_experiment_by_name("real2real").experiment_id
    return {run.info.run_name: run.info.status for run in client.search_runs([experiment])}


def test_a_fitted_run_waits_and_has_what_a_user_of_mlflow_looks_for(store, monkeypatch):
    runs = tracked(store)
    runs.provenance |= {"kedro_run": "2024-09-01T00.00.00", "data_hash": "of another"}
    runs.save(fitted({"data_hash": "abc"}, estimator=Constant(0.25, history(3))))
    (run,) = tracked(store).load()
    assert (run.trained, run.finished, run.study) == (True, False, "real2real")
    assert (run.tags["kedro_run"], run.tags["data_hash"]) == ("2024-09-01T00.00.00", "abc")
    assert (run.started_ms, run.fingerprint, run.fits) == (STARTED_MS, "f00d0", {MODEL})
    assert run.params == {key: str(value) for key, value in PARAMS.items()}
    assert run.load_fit(MODEL).bias == 0.25
    assert run.metrics == {"train_loss": pytest.approx(1 / 3), "val_loss": pytest.approx(5 / 6)}
    pd.testing.assert_frame_equal(run.load("history.csv"), history(3), check_exact=True)
    assert statuses(store) == {NAME: "RUNNING"}
    client = MlflowClient(f"sqlite:///{store}")
    shown = client.get_run(run.run_id)
    assert shown.data.tags["mlflow.note.content"] == "It was trained on this and tested on that."
    assert shown.data.tags["recommended"] == "True"
    (dataset,) = shown.inputs.dataset_inputs
    assert (dataset.dataset.name, dataset.dataset.digest) == ("dot", "abc")
    (model,) = shown.outputs.model_outputs
    assert client.get_logged_model(model.model_id).status == "READY"
    monkeypatch.setenv("MLFLOW_TRACKING_URI", f"sqlite:///{store}")
    model = mlflow.pyfunc.load_model(model_uri(run))
    estimates = model.predict(WINDOWS)
    np.testing.assert_array_equal(estimates["bias_dps"], np.full((2, 3), 0.25))
    np.testing.assert_array_equal(estimates["sigma_dps"], np.full((2, 3), 0.5))
    later = model.predict(WINDOWS, params={"target": "recording_mean", "start_s": [1.0, 2.0]})
    np.testing.assert_array_equal(later["bias_dps"][:, 0], [1.25, 2.25])
    requirements = Path(mlflow.pyfunc.get_model_dependencies(model_uri(run)))
    assert "gyro-pipeline==" in requirements.read_text()


def model_uri(run):
    return f"runs:/{run.run_id}/model"


def test_the_model_of_a_class_from_outside_brings_its_code(store, tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(tmp_path / "code")
    source = Path(sys.modules["constant"].__file__).read_text()
    importing = "import theirs_file\nclass Constant(theirs_file.Constant):\n    pass\n"
    texts = {"theirs_file": source, "theirs_folder/inner": source, "theirs_importing": importing}
    for name, text in texts.items():
        file = tmp_path / "code" / f"{name}.py"
        file.parent.mkdir(exist_ok=True)
        file.write_text(text)
    for seed, module in enumerate(("theirs_folder.inner", "theirs_importing")):
        kind = import_module(module).Constant
        tracked(store).save(fitted(estimator=kind(float(seed)), seed=seed))
    models = [model_uri(run) for run in tracked(store).load()]
    command = [sys.executable, "-c", APPLY, f"sqlite:///{store}", *models]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=120)
    said = {line.split()[0] for line in done.stdout.splitlines()}
    assert said == {"0.0", "1.0"}, done.stderr


def test_loading_narrows_to_study_sensor_and_source_also_where_the_store_answers_in_pages(store):
    names = ("study", "sensor", "source")
    everything = [("augmentation", "dot", "simulated"), ("real2real", "dot", "simulated")]
    everything.append(("real2real", "ng", "published"))
    for one in everything:
        tracked(store).save(fitted(**dict(zip(names, one, strict=True))))

    def found(**only):
        runs = tracked(store, **only)
        runs._client.search_runs = partial(runs._client.search_runs, max_results=1)
        return sorted(tuple(run.params[name] for name in names) for run in runs.load())

    assert found() == everything[:2]
    assert found(source=None) == everything
    assert found(source=None, sensor="ng") == everything[2:]
    assert found(study="augmentation") == everything[:1]
    assert found(study="input_channels") == []


def test_an_evaluated_run_is_finished_and_keeps_what_it_had(store):
    runs = tracked(store)
    runs.save(fitted(estimator=Constant(0, history(3))))
    (waiting,) = runs.load()
    errors = pd.DataFrame({"recording": [81, 81], "error_dps": [1e-3, -2e-3]})
    metrics = {"test_rmse_dps": 1.25e-3, "time_saving_pct": -12.5}
    # what replaces an evaluation is shown, also by a lower value: MLflow would show the larger one
    for more, judged_with in ((1, "x0"), (0, "x1")):
        shown = {name: value + more for name, value in metrics.items()}
        tags, artifacts = {"evaluated_with": judged_with}, {"errors.parquet": errors + more}
        runs.save(EvaluatedRun(waiting.run_id, shown, tags, artifacts))
    (run,) = tracked(store).load()
    assert run.finished
    assert (run.run_id, run.fingerprint) == (waiting.run_id, "f00d0")
    assert run.metrics == dict(waiting.metrics) | metrics
    assert run.tags["evaluated_with"] == "x1"
    pd.testing.assert_frame_equal(run.load("errors.parquet"), errors)
    pd.testing.assert_frame_equal(run.load("history.csv"), history(3))
    info = MlflowClient(f"sqlite:///{store}").get_run(run.run_id).info
    assert (info.start_time, info.end_time) == (STARTED_MS, ENDED_MS)  # of the training


def test_after_a_kill_trained_runs_are_evaluated_and_others_continued(store):
    command = [sys.executable, "-c", KILLED, str(store), str(Path(__file__).parent)]
    done = subprocess.run(command, check=False, timeout=120)
    assert done.returncode == -signal.SIGKILL
    waiting, unfinished = NAME, NAME.replace("seed 0", "seed 1")
    assert statuses(store) == {waiting: "RUNNING", unfinished: "RUNNING"}
    runs = {run.params["seed"]: run for run in tracked(store).load()}
    assert statuses(store) == {waiting: "KILLED", unfinished: "KILLED"}
    assert [runs[seed].trained for seed in "01"] == [True, False]
    assert runs["1"].fits == {"fold 0"}
    assert runs["1"].load_fit("fold 0").bias == 0.5
    tracked(store).save(EvaluatedRun(runs["0"].run_id, {"rmse_mdps": 1.0}, {}, {}))
    again = tracked(store)
    for fold in ("fold 1", MODEL):
        again.save(fitted(fold=fold, folds=("fold 0", "fold 1", MODEL), seed=1))
    assert statuses(store) == {waiting: "FINISHED", unfinished: "RUNNING"}
    continued = next(run for run in tracked(store).load() if run.params["seed"] == "1")
    assert continued.run_id == runs["1"].run_id
    assert continued.trained
    assert continued.fits == {"fold 0", "fold 1", MODEL}
    assert [continued.load_fit(fold).bias for fold in ("fold 0", MODEL)] == [0.5, 0]


def unfinished(store, seed=0, **owner):
    """A run that lacks a fit, and the owner it is left with: host, pid, started, written."""
    tracked(store).save(fitted(fold="fold 0", folds=("fold 0", MODEL), seed=seed))
    client = MlflowClient(f"sqlite:///{store}")
    experiment = client.get_experiment_by_name("real2real").experiment_id
    newest, *_ = client.search_runs([experiment], f"params.seed = '{seed}'")
    names = "host", "pid", "started", "written"
    before = dict(zip(names, newest.data.tags["process"].split(), strict=True))
    client.set_tag(newest.info.run_id, "process", " ".join((before | owner).values()))
    return newest.info.run_id


def test_whose_process_is_gone_is_told_by_host_number_and_start(store):
    ended = subprocess.Popen([sys.executable, "-c", ""])
    ended.wait()
    gone, parent = str(ended.pid), psutil.Process(os.getppid())
    cases = [
        ({"pid": str(parent.pid), "started": str(parent.create_time())}, "RUNNING"),
        ({"pid": gone}, "KILLED"),
        ({"started": "1.5"}, "KILLED"),  # another process got its number
        ({"host": "elsewhere", "pid": gone}, "RUNNING"),  # cannot be known from here ...
        ({"host": "elsewhere", "written": "1700000000"}, "KILLED"),  # ... but is long silent
    ]
    left = [unfinished(store, seed, **owner) for seed, (owner, _) in enumerate(cases)]
    killed = {run_id for run_id, (_, status) in zip(left, cases, strict=True) if status == "KILLED"}
    assert tracked(store, source="published").load() == []
    names = [NAME.replace("seed 0", f"seed {seed}") for seed in range(len(cases))]
    assert statuses(store) == dict(zip(names, (status for _, status in cases), strict=True))
    assert {run.run_id for run in tracked(store).load()} == killed
    tracked(store).save(fitted())
    (mine,) = (run for run in tracked(store).load() if run.params["seed"] == "0")
    assert mine.run_id != left[0]


def test_a_fit_that_cannot_be_written_is_not_taken_for_stored(store):
    unwritable = Constant()
    unwritable.save = Mock(side_effect=InputError("not to be written"))
    with pytest.raises(DatasetError, match="not to be written"):
        tracked(store).save(fitted(estimator=unwritable))
    (run,) = tracked(store).load()
    assert (run.fits, run.trained) == (set(), False)
    tracked(store).save(fitted(estimator=Constant(3)))
    (run,) = tracked(store).load()
    assert run.load_fit(MODEL).bias == 3


def test_runs_of_an_older_layout_are_counted_once_and_never_read(store, caplog):
    client = MlflowClient(f"sqlite:///{store}")
    experiment = client.create_experiment("real2real")
    for number in range(3):
        client.create_run(experiment, tags={"fingerprint": f"f00d{number}", "trained": "1"})
    client.create_run(experiment, tags={"mlflow.note.content": "of somebody else"})
    tracked(store).save(fitted())
    with caplog.at_level(logging.WARNING):
        for _ in range(2):
            assert len(tracked(store, study="real2real").load()) == 1
    assert caplog.messages == ["3 runs of an older layout are not read"]


def foreign(path):
    path.unlink()
    with sqlite3.connect(path) as connection:
        connection.execute("create table bookmarks (url text)")
        connection.execute("insert into bookmarks values ('https://example.org')")
    connection.close()


@pytest.mark.parametrize(
    ("spoil", "told"),
    [
        (lambda path: os.truncate(path, 50_000), "damaged|not a readable SQLite file"),
        (foreign, "expected an MLflow store, got an SQLite file with tables bookmarks"),
    ],
)
def test_a_file_that_is_no_sound_store_is_refused_and_left_as_it_is(store, spoil, told):
    tracked(store).save(fitted())
    spoil(store)
    before, around = store.read_bytes(), set(store.parent.iterdir())
    for use in (TrackedRuns.load, lambda runs: runs.save(fitted())):
        with pytest.raises(DatasetError, match=told) as caught:
            use(tracked(store))
        assert isinstance(caught.value.__cause__, InputError)
        assert f"{store}" in str(caught.value) and "move it away" in str(caught.value)
        assert store.read_bytes() == before
        assert set(store.parent.iterdir()) == around


def test_a_store_is_there_complete_or_not_at_all(tmp_path, monkeypatch):
    """Half made, as a kill would leave it, MLflow could not use it."""
    monkeypatch.delenv("MLFLOW_TRACKING_URI", raising=False)

    def interrupted(uri):
        half_made = Path(uri.removeprefix("sqlite:///"))
        assert half_made != tmp_path / "mlflow.db"
        half_made.write_bytes(b"half a store")
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(run_store, "MlflowClient", interrupted)
        with pytest.raises(KeyboardInterrupt):
            tracked(tmp_path / "mlflow.db").load()
    assert list(tmp_path.iterdir()) == []


def evaluated(store, seed=0, trained=False):
    """A finished run with its history, scores and errors."""
    runs = tracked(store)
    if not trained:
        runs.save(fitted(estimator=Constant(seed, history(3)), seed=seed))
    run = next(run for run in runs.load() if run.params["seed"] == str(seed))
    artifacts = dict.fromkeys(("errors.parquet", "scores.csv"), pd.DataFrame({"error_dps": [seed]}))
    given = {"rmse_mdps": 1.0 + seed}, {"evaluated_with": "x"}, artifacts
    runs.save(EvaluatedRun(run.run_id, *given))
    return run.run_id


def flip(path):
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    path.write_bytes(content)


@pytest.mark.parametrize(
    ("name", "damage", "again"),
    [("scores.csv", Path.unlink, "evaluated"), ("estimator.pkl", flip, "trained")],
)
def test_a_damaged_artifact_sets_its_run_back_and_no_other(store, name, damage, again, caplog):
    run_id, other = evaluated(store), evaluated(store, seed=1)
    (model,) = MlflowClient(f"sqlite:///{store}").get_run(run_id).outputs.model_outputs
    (path,) = (p for p in store.parent.rglob(name) if {run_id, model.model_id} & {*p.parts})
    damage(path)
    runs = {run.run_id: run for run in tracked(store).load()}
    broken = runs[run_id]
    assert runs[other].finished
    assert f"run {run_id}: damaged or missing: " in caplog.text
    assert f"it is {again} again" in caplog.text
    assert not broken.finished
    assert "evaluated_with" not in broken.tags
    assert broken.trained == (again == "evaluated")
    assert evaluated(store, trained=broken.trained) == run_id
    assert all(run.finished for run in tracked(store).load())


def test_an_artifact_that_is_damaged_after_its_run_was_loaded_is_refused(store):
    run_id = evaluated(store)
    (run,) = tracked(store).load()
    flip(next(store.parent.rglob("errors.parquet")))
    with pytest.raises(InputError, match=f"run {run_id}: .* type the same command again"):
        run.load("errors.parquet")
    assert not tracked(store).load()[0].finished


def test_edited_values_of_a_run_are_told(store):
    run_id = evaluated(store)

    def edit(table, key):
        with sqlite3.connect(store) as connection:
            connection.execute(f"update {table} set value = '7' where key = '{key}'")
        connection.close()

    edit("latest_metrics", "rmse_mdps")
    assert not tracked(store).load()[0].finished
    edit("params", "seed")
    with pytest.raises(DatasetError, match=f"mlflow runs delete --run-id {run_id}"):
        tracked(store).load()


def test_artifacts_without_their_store_are_no_new_beginning(store):
    evaluated(store)
    for spoil in (lambda: store.write_bytes(b""), store.unlink):
        spoil()
        with pytest.raises(DatasetError, match="artifacts of 1 runs; put the store back"):
            tracked(store).load()
        assert not store.exists() or not store.stat().st_size


def test_what_two_projects_train_at_once_is_stored_once(store, monkeypatch, tmp_path):
    monkeypatch.setenv("MLFLOW_TRACKING_URI", f"sqlite:///{store}")
    monkeypatch.chdir(tmp_path)
    one, other = tracked(tmp_path / "one.db"), tracked(tmp_path / "other.db")
    folds = ("fold 0", MODEL)
    for runs in (one, other):
        runs.save(fitted(fold="fold 0", folds=folds))
        running = MlflowClient().search_runs(["1"], "attributes.status = 'RUNNING'")
        MlflowClient().set_tag(running[0].info.run_id, "process", "elsewhere 1 1 99999999999")
    for runs in (one, other):
        runs.save(fitted(folds=folds))
    assert len(one.load()) == 1


def test_fits_without_a_server_are_stored_once_it_answers(store, monkeypatch, tmp_path, caplog):
    monkeypatch.setenv("MLFLOW_TRACKING_URI", f"sqlite:///{store}")
    monkeypatch.chdir(tmp_path)  # where this store puts its artifacts
    runs, folds = tracked(tmp_path / "mlflow.db", study="real2real"), ("fold 0", "fold 1", MODEL)
    runs.check_reachable()
    runs.save(fitted(fold="fold 0", folds=folds))
    with monkeypatch.context() as away:
        away.setenv("MLFLOW_TRACKING_URI", "http://127.0.0.1:9")
        server = tracked(tmp_path / "mlflow.db", study="real2real")
        with pytest.raises(InputError, match="http://127.0.0.1:9: .* does not answer"):
            server.check_reachable()
        server.save(fitted(fold="fold 1", folds=folds))
        server.save(fitted(folds=folds))
        assert caplog.text.count("does not answer; fits are kept in") == 1
        with pytest.raises(DatasetError, match="does not answer"):
            server.load()
    (run,) = TrackedRuns(str(tmp_path / "mlflow.db")).load()  # of all studies
    assert run.trained and run.fits == set(folds)
    assert (unsaved := tmp_path / "data/06_models/unsaved_fits").exists()
    assert not [*unsaved.rglob("*.pkl")]
    assert len(runs.load()) == 1


def test_a_link_opens_the_runs_of_a_study_best_first(store):
    runs = tracked(store, study="real2real", sensor="dot")
    assert run_link([runs]) is None
    runs.save(fitted())
    address = "http://127.0.0.1:5000/#/experiments/1/runs?workflowType=machine_learning"
    assert run_link([runs]) == f"{address}&viewStateShareKey=runs_simulated_dot"
    tags = MlflowClient(f"sqlite:///{store}").get_experiment("1").tags
    view = json.loads(tags["mlflow.sharedViewState.runs_simulated_dot"])
    wanted = "tags.layout = '3' and params.source = 'simulated' and params.sensor = 'dot'"
    assert view["searchFilter"] == wanted
    assert view["orderByKey"] == "metrics.`accuracy_gain_pct`"


def test_artifacts_are_never_written_to_where_a_copy_is_from(store, tmp_path):
    tracked(store).save(fitted())
    copy = tmp_path / "a copy" / "mlflow.db"
    shutil.copytree(store.parent / "mlruns", copy.parent / "mlruns")
    shutil.copy(store, copy)
    for use in (TrackedRuns.load, lambda runs: runs.save(fitted(seed=1))):
        with pytest.raises(DatasetError, match="--artifacts-in mlruns"):
            use(tracked(copy))
    relocate(copy, str(copy.parent / "mlruns"))
    tracked(copy).save(fitted(seed=1))
    shutil.rmtree(store.parent / "mlruns")
    assert [run.load_fit(MODEL).bias for run in tracked(copy).load()] == [0, 0]
