"""A run that is stopped at any moment, by any means, is simply started again."""

import os
import re
import signal
import time

import psutil
import pytest

PATIENCE_S = 300
SENSOR = "dot"
ONLY = f"--params=only.sensor={SENSOR},only.real_gyros=3"
COMMAND = ("--pipeline=augmentation", "--env=smoke", ONLY)
TRAINED = "select count(*) from tags where key = 'trained'"
FINISHED = "select count(*) from runs where status = 'FINISHED'"
RUNS, SOME = 7, 2
WAYS = [(signal.SIGKILL, TRAINED, SOME), (signal.SIGINT, FINISHED, 1)]


def stop(project, how, query, at_least):
    """Start the run and stop it at so much progress: what it said, and the runs that are left."""
    process = project.start(*COMMAND)
    try:
        deadline = time.monotonic() + PATIENCE_S
        while process.poll() is None and project.count(query) < at_least:
            assert time.monotonic() < deadline, "nothing happened"
            time.sleep(0.01)
        assert process.poll() is None, project.log.read_text()
        workers = psutil.Process(process.pid).children(recursive=True)
        if how == signal.SIGINT:  # Ctrl-C reaches all that the terminal runs
            os.killpg(process.pid, how)
        else:
            os.kill(process.pid, how)
        assert process.wait(PATIENCE_S) != 0
    finally:
        process.kill()
    _, survivors = psutil.wait_procs(workers, timeout=30)
    for worker in survivors:  # to be found, not to be left behind
        worker.kill()
    assert survivors == []
    return project.log.read_text(), project.runs("augmentation")


def trained(runs):
    return {run.info.run_id: run for run in runs if "trained" in run.data.tags}


def finished(runs):
    return [run for run in runs if run.info.status == "FINISHED"]


def number(words, output):
    """The count in front of some words."""
    return int(re.search(rf"(\d+) {words}", output)[1])


def test_what_was_made_is_not_made_again_and_ends_as_if_nothing_had_stopped_it(smoke, new_project):
    """Killed while it trains, and interrupted while it evaluates."""
    project = new_project()
    project.amend("smoke", **smoke.changes)
    stops = [stop(project, *way) for way in WAYS]
    done = project.command(*COMMAND)
    assert done.code == 0, done.output
    killed, interrupted = (runs for _, runs in stops)
    assert SOME <= len(trained(killed)) < RUNS == len(trained(interrupted))
    assert finished(killed) == []
    assert 1 <= len(finished(interrupted)) < RUNS
    for run in finished(interrupted):
        kept = {path.name for path in project.artifacts(run).iterdir()}
        assert {"errors.parquet", "scores.csv"} <= kept
        assert {"rmse_mdps", "accuracy_gain_pct"} <= set(run.data.metrics)
    assert number(r"skipped \(made before\)", stops[1][0]) == len(trained(killed))
    assert number("to fit", stops[1][0]) == RUNS - len(trained(killed))
    assert number("to fit", done.output) == 0
    assert number("runs evaluated", done.output) == RUNS - len(finished(interrupted))

    runs = project.runs("augmentation")
    by_id = {run.info.run_id: run.data.tags for run in runs}
    for run_id, run in (trained(killed) | trained(interrupted)).items():
        for tag in ("trained", "process", "kedro_run"):
            assert by_id[run_id][tag] == run.data.tags[tag]
    assert len(finished(runs)) == len(runs)
    again = {run.data.tags["fingerprint"]: run for run in runs}
    place = {"sensor": SENSOR, "real_gyros": "3"}.items()
    undisturbed = [run for run in smoke.runs if place <= run.data.params.items()]
    assert len(runs) == len(again) == len(undisturbed) == RUNS
    for run in undisturbed:
        twin = again[run.data.tags["fingerprint"]]
        assert twin.data.params == run.data.params
        assert twin.data.metrics == pytest.approx(run.data.metrics, rel=1e-4)
        if run.data.params["estimator"] == "cnn":
            assert project.weights(twin) == smoke.project.weights(run)
