"""A run that is stopped at any moment, by any means, is simply started again."""

import os
import re
import signal
import time
from dataclasses import dataclass

import psutil
import pytest
from mlflow import MlflowClient

PATIENCE_S = 300
SENSOR = "dot"
COMMAND = ("--pipeline=augmentation", "--env=smoke", f"--params=only.sensor={SENSOR}")
TRAINED = "select count(*) from tags where key = 'trained'"
FINISHED = "select count(*) from runs where status = 'FINISHED'"
RUNS = 26
SOME, MOST = 17, 22  # of them; 14 are without a network, and wait for nothing


@dataclass(frozen=True)
class Stopped:
    """What there was right after a run had been stopped."""

    code: int
    output: str
    survivors: list
    trained: dict
    unfinished: int
    fake: list


def stop(project, how, query, at_least):
    """Start the run, stop it when the store shows so much progress, and look around."""
    log = project.folder / "terminal.log"
    process = project.start(*COMMAND, log=log)
    try:
        wait_until(lambda: process.poll() is not None or project.count(query) >= at_least)
        assert process.poll() is None, log.read_text()
        workers = psutil.Process(process.pid).children(recursive=True)
        if how == signal.SIGINT:  # Ctrl-C reaches all that the terminal runs
            os.killpg(process.pid, how)
        else:
            os.kill(process.pid, how)
        code = process.wait(PATIENCE_S)
    finally:
        process.kill()
    _, survivors = psutil.wait_procs(workers, timeout=30)
    for worker in survivors:  # to be found, not to be left behind
        worker.kill()
    runs = project.runs("augmentation")
    trained = {run.info.run_id: run for run in runs if "trained" in run.data.tags}
    unfinished = [run for run in runs if run.info.status != "FINISHED"]
    return Stopped(code, log.read_text(), survivors, trained, len(unfinished), suspicious(project))


def wait_until(condition):
    deadline = time.monotonic() + PATIENCE_S
    while not condition():
        assert time.monotonic() < deadline, "nothing happened"
        time.sleep(0.01)


def suspicious(project):
    """Runs that look finished, or trained, without holding what such a run holds."""
    found = []
    for run in project.runs("augmentation"):
        kept = {path.name for path in project.artifacts(run).glob("*")}
        needed = set()
        if "trained" in run.data.tags and run.data.params["estimator"] == "cnn":
            needed |= {"weights.pt", "history.csv"}
        if run.info.status == "FINISHED":
            needed |= {"errors.parquet", "test_rmse_dps", "test_rmse_dps_all", "trained"}
        if not needed <= kept | set(run.data.metrics) | set(run.data.tags):
            found.append(run.info.run_id)
    return found


def numbers(words, output):
    """The counts in front of some words."""
    return [int(number) for number in re.findall(rf"(\d+) {words}", output)]


@pytest.fixture(scope="module")
def project(new_project):
    return new_project()


@pytest.fixture(scope="module")
def killed_training(project):
    return stop(project, signal.SIGKILL, TRAINED, at_least=SOME)


@pytest.fixture(scope="module")
def interrupted(project, killed_training):
    return stop(project, signal.SIGINT, TRAINED, at_least=MOST)


@pytest.fixture(scope="module")
def killed_evaluating(project, interrupted):
    return stop(project, signal.SIGKILL, FINISHED, at_least=3)


@pytest.fixture(scope="module")
def half_written(project, killed_evaluating):
    """What a kill between two steps of writing one run leaves."""
    client = MlflowClient(f"sqlite:///{project.store}")
    run = next(iter(killed_evaluating.trained.values()))
    fingerprint = run.data.tags["fingerprint"]
    made = client.create_run(
        run.info.experiment_id,
        tags={"process": run.data.tags["process"], "fingerprint": fingerprint},
    )
    client.log_param(made.info.run_id, "estimator", "cnn")
    return made.info.run_id


@pytest.fixture(scope="module")
def completed(project, half_written):
    done = project.kedro_run(*COMMAND)
    return done, project.runs("augmentation")


@pytest.fixture(params=["killed_training", "interrupted", "killed_evaluating"])
def stopped(request):
    return request.getfixturevalue(request.param)


def test_a_stopped_run_fails_and_takes_its_workers_along(stopped):
    assert stopped.code != 0
    assert stopped.survivors == []


def test_nothing_looks_finished_that_is_not(stopped):
    assert stopped.unfinished > 0
    assert stopped.fake == []


def test_the_stops_hit_where_they_should(killed_training, interrupted, killed_evaluating):
    assert SOME <= len(killed_training.trained) < MOST <= len(interrupted.trained) < RUNS
    for early in (killed_training, interrupted):
        assert "FINISHED" not in {run.info.status for run in early.trained.values()}
    assert len(killed_evaluating.trained) == RUNS
    statuses = [run.info.status for run in killed_evaluating.trained.values()]
    assert 3 <= statuses.count("FINISHED") < RUNS


def test_only_what_was_missing_is_trained(killed_training, interrupted, killed_evaluating):
    before = len(killed_training.trained)
    assert sum(numbers("skipped \\(trained before\\)", interrupted.output)) == before
    left = RUNS - len(interrupted.trained)
    trained = numbers("to train", killed_evaluating.output)
    means_left = sum(numbers("runs planned", killed_evaluating.output)) - RUNS
    assert means_left == 0
    assert sum(trained) == left


def test_what_was_trained_is_evaluated_and_not_trained_again(
    killed_training, interrupted, killed_evaluating, completed
):
    done, runs = completed
    assert done.code == 0, done.output
    assert numbers("to train", done.output) == [0]
    finished = {run.info.run_id: run for run in runs if run.info.status == "FINISHED"}
    for stopped in (killed_training, interrupted, killed_evaluating):
        for run_id, run in stopped.trained.items():
            for tag in ("trained", "process", "kedro_run"):
                assert finished[run_id].data.tags[tag] == run.data.tags[tag]
    judged = sum(numbers("runs evaluated", done.output))
    statuses = [run.info.status for run in killed_evaluating.trained.values()]
    assert judged == RUNS - statuses.count("FINISHED")


def test_in_the_end_every_cell_is_there_once(project, completed, half_written):
    _, runs = completed
    assert suspicious(project) == []
    by_status = {status: [] for status in ("FINISHED", "KILLED")}
    for run in runs:
        by_status[run.info.status].append(run)
    fingerprints = [run.data.tags["fingerprint"] for run in by_status["FINISHED"]]
    assert len(fingerprints) == len(set(fingerprints)) == RUNS
    assert half_written in {run.info.run_id for run in by_status["KILLED"]}


def test_the_grid_is_the_one_of_an_uninterrupted_run(completed, smoke):
    _, runs = completed
    again = {r.data.tags["fingerprint"]: r for r in runs if r.info.status == "FINISHED"}
    runs = [run for run in smoke.runs if run.data.params["sensor"] == SENSOR]
    assert len(runs) == RUNS
    for run in runs:
        twin = again[run.data.tags["fingerprint"]]
        assert twin.data.params == run.data.params
        assert smoke.project.weights(twin) == smoke.project.weights(run)
        assert twin.data.metrics == pytest.approx(run.data.metrics, rel=1e-4)
