"""A run that is stopped at any moment, by any means, is simply started again."""

import os
import re
import signal
import time
from dataclasses import dataclass

import psutil
import pytest

PATIENCE_S = 300
SENSOR = "dot"
COMMAND = ("--pipeline=augmentation", "--env=smoke", f"--params=only.sensor={SENSOR}")
TRAINED = "select count(*) from tags where key = 'trained'"
FINISHED = "select count(*) from runs where status = 'FINISHED'"
RUNS, SOME, MOST = 18, 4, 10


@dataclass(frozen=True)
class Stopped:
    """What there was right after a run had been stopped."""

    code: int
    output: str
    survivors: list
    runs: list

    @property
    def trained(self):
        return {run.info.run_id: run for run in self.runs if "trained" in run.data.tags}

    @property
    def finished(self):
        return [run for run in self.runs if run.info.status == "FINISHED"]


def stop(project, how, query, at_least):
    """Start the run, stop it when the store shows so much progress, and look around."""
    log = project.folder / "terminal.log"
    process = project.start(*COMMAND, log=log)
    try:
        deadline = time.monotonic() + PATIENCE_S
        while process.poll() is None and project.count(query) < at_least:
            assert time.monotonic() < deadline, "nothing happened"
            time.sleep(0.01)
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
    return Stopped(code, log.read_text(), survivors, project.runs("augmentation"))


def number(words, output):
    """The count in front of some words."""
    return int(re.search(rf"(\d+) {words}", output)[1])


@pytest.fixture(scope="module")
def stops(new_project):
    """Killed while it trains, interrupted while it trains on, and killed while it evaluates."""
    project = new_project()
    ways = [(signal.SIGKILL, TRAINED, SOME), (signal.SIGINT, TRAINED, MOST)]
    ways.append((signal.SIGKILL, FINISHED, 3))
    return project, [stop(project, *way) for way in ways]


@pytest.fixture(scope="module")
def completed(stops):
    project, _ = stops
    done = project.kedro_run(*COMMAND)
    return done, project.runs("augmentation")


def test_a_stopped_run_fails_takes_its_workers_along_and_looks_finished_nowhere(stops):
    project, (killed, interrupted, evaluating) = stops
    for one in (killed, interrupted, evaluating):
        assert one.code != 0, one.output
        assert one.survivors == []
        for run in one.finished:
            kept = {path.name for path in project.artifacts(run).iterdir()}
            assert {"errors.parquet", "scores.csv"} <= kept
            assert {"rmse_mdps", "accuracy_gain_pct"} <= set(run.data.metrics)
    assert SOME <= len(killed.trained) < MOST <= len(interrupted.trained) < RUNS
    assert killed.finished == interrupted.finished == []
    assert len(evaluating.trained) == RUNS
    assert 3 <= len(evaluating.finished) < RUNS


def test_what_was_made_is_not_made_again(stops, completed):
    _, (killed, interrupted, evaluating) = stops
    done, runs = completed
    assert done.code == 0, done.output
    for before, after in ((killed, interrupted), (interrupted, evaluating)):
        assert number(r"skipped \(made before\)", after.output) == len(before.trained)
        assert number("to fit", after.output) == RUNS - len(before.trained)
    assert number("to fit", done.output) == 0
    assert number("runs evaluated", done.output) == RUNS - len(evaluating.finished)
    by_id = {run.info.run_id: run.data.tags for run in runs}
    for one in (killed, interrupted, evaluating):
        for run_id, run in one.trained.items():
            for tag in ("trained", "process", "kedro_run"):
                assert by_id[run_id][tag] == run.data.tags[tag]


def test_in_the_end_every_run_is_there_once_as_if_nothing_had_stopped_it(stops, completed, smoke):
    project, _ = stops
    _, runs = completed
    assert {run.info.status for run in runs} == {"FINISHED"}
    again = {run.data.tags["fingerprint"]: run for run in runs}
    undisturbed = [run for run in smoke.runs if run.data.params["sensor"] == SENSOR]
    assert len(runs) == len(again) == len(undisturbed) == RUNS
    for run in undisturbed:
        twin = again[run.data.tags["fingerprint"]]
        assert twin.data.params == run.data.params
        assert twin.data.metrics == pytest.approx(run.data.metrics, rel=1e-4)
        if run.data.params["estimator"] == "cnn":
            assert project.weights(twin) == smoke.project.weights(run)
