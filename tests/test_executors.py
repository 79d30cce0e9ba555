"""Also a program (see the end of the file) that is killed from outside in some tests."""

import importlib
import io
import logging
import multiprocessing
import os
import re
import signal
import subprocess
import sys
import threading
import time
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace

import psutil
import pytest

from gyro_pipeline import executors
from gyro_pipeline.executors import available_cores, run_jobs
from gyro_pipeline.parameters import Execution

SERIAL = Execution(executor="serial", workers=None)
ALONE = Execution(executor="processes", workers=1)
PAIR = Execution(executor="processes", workers=2)
BOTH = pytest.mark.parametrize("execution", [SERIAL, PAIR], ids=["serial", "processes"])

LONG_S = 120.0
SOON_S = 30.0
"""Start-up of a worker on a busy machine included; a fraction of ``LONG_S``."""


@dataclass(frozen=True)
class Job:
    name: str
    work: float
    folder: str = ""


def square(job, report):
    report(job.work)
    return job.work**2


def started(job, report):
    """When, and in which process, it ran."""
    began = time.monotonic()
    time.sleep(0.01)
    return began, os.getpid()


def fails(job, report):
    if job.name == "bad":
        raise ArithmeticError("the loss is nan in epoch 7")
    sleeps(job, report)


def sleeps(job, report):
    """For as many seconds as it has work; tells in a file that it runs."""
    Path(job.folder, f"{os.getpid()}.pid").touch()
    time.sleep(job.work)


@pytest.fixture
def here(monkeypatch):
    """This file as a module that spawned workers can import, however pytest imported it."""
    monkeypatch.syspath_prepend(str(Path(__file__).parent))
    yield importlib.import_module(Path(__file__).stem)
    sys.modules.pop(Path(__file__).stem)


@pytest.fixture(autouse=True)
def no_terminal(monkeypatch):
    monkeypatch.setattr(sys, "stderr", io.StringIO())


@pytest.fixture(autouse=True)
def nothing_left_behind():
    yield
    assert multiprocessing.active_children() == []


def soon(condition, what):
    """Wait until a condition holds, but not for ever."""
    deadline = time.monotonic() + SOON_S
    while not condition():
        assert time.monotonic() < deadline, f"after {SOON_S:g} s: {what}"
        time.sleep(0.02)


def runs(process):
    """A zombie has ended; who reaps it depends on the machine."""
    try:
        return process.status() != psutil.STATUS_ZOMBIE
    except psutil.NoSuchProcess:
        return False


@BOTH
@pytest.mark.parametrize("at_once", [None, 1, 16])
def test_every_job_is_run_once_and_comes_back_with_its_result(here, execution, at_once):
    jobs = [here.Job(f"job {i}", float(i)) for i in range(1, 20)]
    results = dict(run_jobs(jobs, here.square, execution, "squares", at_once=at_once))
    assert results == {job: job.work**2 for job in jobs}


@pytest.mark.parametrize("execution", [SERIAL, ALONE], ids=["serial", "processes"])
def test_the_longest_jobs_start_first(here, execution):
    jobs = [here.Job(str(work), work) for work in (3.0, 1.0, 5.0, 2.0, 4.0)]
    results = list(run_jobs(jobs, here.started, execution, "sorted"))
    in_order = [job.work for job, _ in sorted(results, key=lambda one: one[1][0])]
    assert in_order == [5.0, 4.0, 3.0, 2.0, 1.0]


def test_processes_are_others_and_no_more_than_asked(here):
    jobs = [here.Job(str(i), 1.0) for i in range(6)]
    pids = {pid for _, (_, pid) in run_jobs(jobs, here.started, PAIR, "pids")}
    assert os.getpid() not in pids
    assert 1 <= len(pids) <= 2


def test_serial_runs_in_this_process(here):
    ((_, (_, pid)),) = run_jobs([here.Job("one", 1.0)], here.started, SERIAL, "pids")
    assert pid == os.getpid()


def test_no_jobs_need_no_workers():
    assert list(run_jobs([], square, PAIR, "nothing")) == []


def test_available_cores_are_those_this_process_may_use():
    if not hasattr(os, "sched_setaffinity"):
        pytest.skip("this system cannot bind a process to cores")
    mine = os.sched_getaffinity(0)
    assert available_cores() == len(mine)
    os.sched_setaffinity(0, {min(mine)})
    try:
        assert available_cores() == 1
    finally:
        os.sched_setaffinity(0, mine)


def test_serial_and_processes_train_identical_networks():
    """The jobs that the pipeline runs, each with another network to find."""
    import numpy as np  # noqa: PLC0415 - the program at the end needs none of these
    import torch  # noqa: PLC0415
    import xarray as xr  # noqa: PLC0415

    from gyro_pipeline.learning.examples import Device  # noqa: PLC0415
    from gyro_pipeline.learning.jobs import TrainingJob, run_training  # noqa: PLC0415
    from gyro_pipeline.parameters import Training  # noqa: PLC0415

    generator = np.random.default_rng(0)
    bias = generator.normal(size=(8, 3))
    rates = (bias[..., None] + generator.normal(size=(1, 8, 3, 90))).astype(np.float32)
    coords = {"imu": [1], "recording": np.arange(8), "axis": list("xyz")}
    recordings = xr.DataArray(rates, coords, ("imu", "recording", "axis", "sample"))
    starts = (np.array([0, 30, 60]),) * 8
    device = Device(recordings, (1,), tuple(range(8)), bias, starts)
    training = Training(
        centring="per_device",
        **{"channels": 4, "kernel": 6, "stride": 5, "pool": 2, "hidden": 8},
        **{"epochs": 3, "batch_size": 8, "learning_rate": 1e-3, "decay": 0.1, "decay_every": 2},
    )
    jobs = [TrainingJob(str(seed), [device], device, 30, training, seed) for seed in range(3)]

    def weights(execution):
        results = run_jobs(jobs, run_training, execution, "networks")
        return {job.name: trained.artifact["last"] for job, trained in results}

    serial, processes = weights(SERIAL), weights(PAIR)
    torch.use_deterministic_algorithms(False)
    assert set(serial) == set(processes) == {"0", "1", "2"}
    for name, state in serial.items():
        for key, value in state.items():
            assert torch.equal(value, processes[name][key]), (name, key)
    assert not torch.equal(serial["0"]["output.bias"], serial["1"]["output.bias"])


def test_a_failing_job_raises_at_once_and_ends_the_others(here, tmp_path):
    jobs = [here.Job("good", LONG_S, str(tmp_path)), here.Job("bad", 1.0)]
    began = time.monotonic()
    with pytest.raises(ArithmeticError, match="the loss is nan in epoch 7"):
        list(run_jobs(jobs, here.fails, PAIR, "failing"))
    assert time.monotonic() - began < SOON_S
    assert multiprocessing.active_children() == []


def test_a_failing_job_raises_in_this_process_too(here):
    with pytest.raises(ArithmeticError, match="the loss is nan in epoch 7"):
        list(run_jobs([here.Job("bad", 1.0)], here.fails, SERIAL, "failing"))


def test_who_stops_asking_ends_the_workers(here, tmp_path):
    """What Kedro does when saving a result fails."""
    jobs = [
        here.Job(name, work, str(tmp_path)) for name, work in (("long", LONG_S), ("short", 0.1))
    ]
    results = run_jobs(jobs, here.sleeps, PAIR, "stopped")
    assert next(results)[0].name == "short"
    soon(lambda: list(tmp_path.iterdir()), "the jobs have not started")
    workers = [psutil.Process(int(path.stem)) for path in tmp_path.iterdir()]
    began = time.monotonic()
    results.close()
    assert time.monotonic() - began < SOON_S
    assert not any(map(runs, workers))


@contextmanager
def signalled(folder, number):
    """Sends a signal to the worker that tells in ``folder`` that it runs."""

    def send():
        soon(lambda: list(folder.iterdir()), "the job has not started")
        os.kill(int(next(folder.iterdir()).stem), number)

    sender = threading.Thread(target=send)
    sender.start()
    yield
    sender.join()


def test_a_worker_that_is_killed_is_an_error_and_no_endless_wait(here, tmp_path):
    job = here.Job("long", LONG_S, str(tmp_path))
    with signalled(tmp_path, signal.SIGKILL):
        with pytest.raises(RuntimeError, match="terminated abruptly"):
            list(run_jobs([job], here.sleeps, ALONE, "killed"))


def test_workers_leave_an_interrupt_to_their_parent(here, tmp_path):
    job = here.Job("short", 0.5, str(tmp_path))
    with signalled(tmp_path, signal.SIGINT):
        assert [result for _, result in run_jobs([job], here.sleeps, ALONE, "kept")] == [None]


@pytest.fixture
def program(tmp_path):
    """This file as a program in a process group of its own, one worker at work and one idle."""
    process = subprocess.Popen(
        [sys.executable, __file__, str(tmp_path)],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        start_new_session=True,
        # A shell lets what it runs in the background ignore Ctrl-C, and children inherit that.
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )
    try:
        soon(lambda: len(list(tmp_path.glob("*.pid"))) == 2, "its workers have not started")
        yield process
    finally:
        process.kill()
        process.wait()


def test_workers_end_when_the_parent_is_killed(program):
    family = psutil.Process(program.pid).children(recursive=True)
    assert len(family) >= 2
    program.kill()
    soon(lambda: not any(map(runs, family)), f"still running: {list(filter(runs, family))}")


def test_an_interrupt_from_the_keyboard_leaves_no_process(program):
    family = psutil.Process(program.pid).children(recursive=True)
    os.killpg(program.pid, signal.SIGINT)  # a terminal tells the whole group
    output, _ = program.communicate(timeout=SOON_S)
    assert program.returncode == -signal.SIGINT
    assert output.decode().count("KeyboardInterrupt") == 1
    soon(lambda: not any(map(runs, family)), f"still running: {list(filter(runs, family))}")


def test_progress_lines_tell_what_is_done_and_what_is_left(monkeypatch, caplog):
    clock = SimpleNamespace(now=100.0)
    monkeypatch.setattr(executors, "time", SimpleNamespace(monotonic=lambda: clock.now))

    def train_one(job, report):
        for _ in range(4):
            clock.now += 20
            report(job.work / 4)

    with caplog.at_level(logging.INFO, executors.__name__):
        list(run_jobs([Job("a", 4e9), Job("b", 4e9)], train_one, SERIAL, "study dot"))
    assert caplog.messages[1:] == [
        # every 40 s, because 20 s are less than the half minute between lines
        "study dot: 0 of 2 jobs done, 25 %, 2 min 00 s left",
        "study dot: 0 of 2 jobs done, 50 %, 1 min 20 s left",
        "study dot: 1 of 2 jobs done, 75 %, 0 min 40 s left",
        "study dot: 1 of 2 jobs done, 100 %, 0 min 00 s left",
        "study dot: 2 jobs in 2 min 40 s",
    ]
    assert caplog.messages[0].startswith("study dot: 2 jobs on ")


def test_work_reported_by_workers_reaches_the_log(here, monkeypatch, caplog):
    monkeypatch.setattr(executors, "_LOG_EVERY_S", 0)
    jobs = [here.Job(str(i), 1e6) for i in range(4)]
    with caplog.at_level(logging.INFO, executors.__name__):
        list(run_jobs(jobs, here.square, PAIR, "study"))
    first, *between, last = caplog.messages
    assert first == "study: 4 jobs on 2 processes"
    pattern = r"study: \d of 4 jobs done, (\d+) %, .* left"
    shares = [int(re.fullmatch(pattern, line)[1]) for line in between]
    assert shares == sorted(shares)
    assert shares[-1] == 100
    assert re.fullmatch(r"study: 4 jobs in 0 min \d\d s", last)


def test_a_terminal_gets_a_bar_and_no_lines(monkeypatch, caplog):
    terminal = io.StringIO()
    terminal.isatty = lambda: True
    monkeypatch.setattr(sys, "stderr", terminal)
    monkeypatch.setattr(executors, "_LOG_EVERY_S", 0)
    with caplog.at_level(logging.INFO, executors.__name__):
        list(run_jobs([Job("a", 5.0), Job("b", 7.0)], square, SERIAL, "study"))
    assert "study 2/2: 100%" in terminal.getvalue()
    assert re.search(r"\| \d\d:\d\d, 0 min 00 s left", terminal.getvalue())
    assert [line for line in caplog.messages if " left" in line] == []


if __name__ == "__main__":
    pair = [Job("long", LONG_S, sys.argv[1]), Job("short", 0.01, sys.argv[1])]
    list(run_jobs(pair, sleeps, PAIR, "program"))
