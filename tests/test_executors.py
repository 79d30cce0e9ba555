"""Also a program (see the end of the file) that is killed from outside in some tests."""

import importlib
import io
import logging
import os
import signal
import subprocess
import sys
import threading
import time
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import psutil
import pytest

from gyro_pipeline import executors
from gyro_pipeline.conventions import InputError
from gyro_pipeline.executors import run_jobs
from gyro_pipeline.parameters import Execution

SERIAL = Execution(executor="serial", workers=None)
PAIR = Execution(executor="processes", workers=2)
pytestmark = pytest.mark.slow
LONG_S = 120.0
SOON_S = 60.0
"""Start-up of a worker on a busy machine included; a fraction of ``LONG_S``."""


@dataclass(frozen=True)
class Job:
    name: str
    work: float
    folder: str = ""


def square(job):
    return time.monotonic(), os.getpid(), job.work**2


def fails(job):
    if job.name == "bad":
        raise ArithmeticError("the loss is nan in epoch 7")


def sleeps(job):
    """For as many seconds as it has work; tells in a file that it runs, and how often it did."""
    with Path(job.folder, f"{os.getpid()}.pid").open("a") as file:
        file.write(f"{job.name}\n")
    time.sleep(job.work)
    return job.name


@pytest.fixture
def here(monkeypatch):
    """This file as a module that workers can import, however pytest imported it."""
    monkeypatch.syspath_prepend(str(Path(__file__).parent))
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(Path(__file__).parent), *sys.path]))
    yield importlib.import_module(Path(__file__).stem)
    sys.modules.pop(Path(__file__).stem)


@pytest.fixture(autouse=True)
def no_terminal(monkeypatch):
    monkeypatch.setattr(sys, "stderr", io.StringIO())


def soon(condition, told):
    """Wait until a condition holds, but not for ever."""
    deadline = time.monotonic() + SOON_S
    while not condition():
        assert time.monotonic() < deadline, f"after {SOON_S:g} s: {told}"
        time.sleep(0.05)


def runs(process):
    """A zombie has ended; who reaps it depends on the machine."""
    try:
        return process.status() != psutil.STATUS_ZOMBIE
    except psutil.NoSuchProcess:
        return False


@pytest.mark.parametrize("execution", [SERIAL, PAIR], ids=["serial", "processes"])
def test_every_job_is_run_once_the_longest_first_where_it_was_asked_for(here, execution, caplog):
    caplog.set_level(logging.INFO, executors.__name__)
    jobs = [here.Job(f"job {i}", float(i % 7 + 0.1 * i)) for i in range(1, 20)]
    for at_once in (1, 16):
        results = list(run_jobs(jobs, here.square, execution, "study", at_once=at_once))
        assert sorted(job.name for job, _ in results) == sorted(job.name for job in jobs)
        assert all(value == job.work**2 for job, (_, _, value) in results)
        pids = {pid for _, (_, pid, _) in results}
        assert (pids == {os.getpid()}) == (execution is SERIAL)
        assert len(pids) <= 2
    if execution is SERIAL:
        works = [job.work for job, _ in results]
        assert works == sorted(works, reverse=True)
    assert caplog.messages[0] == f"study: 19 jobs on {1 + (execution is PAIR)} processes"
    jobs = [here.Job("good", 2.0), here.Job("bad", 1.0)]
    with pytest.raises(ArithmeticError, match="the loss is nan in epoch 7"):
        list(run_jobs(jobs, here.fails, execution, "failing"))


def test_who_stops_asking_ends_the_workers(here, tmp_path):
    """What Kedro does when saving a result fails."""
    names = ("long", LONG_S), ("short", 0.1)
    jobs = [here.Job(name, work, str(tmp_path)) for name, work in names]
    results = run_jobs(jobs, here.sleeps, PAIR, "stopped")
    assert next(results)[0].name == "short"
    workers = [psutil.Process(int(path.stem)) for path in tmp_path.iterdir()]
    results.close()
    soon(lambda: not any(map(runs, workers)), "workers still run")


@contextmanager
def signalled(folder, number):
    """Sends a signal to a worker that tells in ``folder`` that it runs the long job."""

    def at_work():
        return [path.stem for path in folder.glob("*.pid") if "long" in path.read_text()]

    def send():
        soon(at_work, "the job has not started")
        os.kill(int(at_work()[0]), number)

    sender = threading.Thread(target=send)
    sender.start()
    yield
    sender.join()


def test_a_worker_that_is_killed_is_an_error_and_no_endless_wait(here, tmp_path):
    jobs = [here.Job("long", LONG_S, str(tmp_path)), here.Job("short", 0.1, str(tmp_path))]
    with signalled(tmp_path, signal.SIGKILL):
        with pytest.raises(InputError, match="a worker process was killed.*execution.workers=1"):
            list(run_jobs(jobs, here.sleeps, PAIR, "killed"))


def test_a_stopped_worker_is_named_and_can_continue(here, tmp_path, monkeypatch, caplog):
    monkeypatch.setattr(executors, "_LOG_EVERY_S", 0.1)
    jobs = [here.Job("long", 1.0, str(tmp_path)), here.Job("short", 0.1, str(tmp_path))]

    def resume():
        soon(lambda: "kill -CONT " in caplog.text, "the stopped worker is not named")
        os.kill(int(caplog.text.partition("kill -CONT ")[2].split()[0]), signal.SIGCONT)

    user = threading.Thread(target=resume)
    user.start()
    with signalled(tmp_path, signal.SIGSTOP):
        results = [result for _, result in run_jobs(jobs, here.sleeps, PAIR, "stopped")]
    user.join()
    assert sorted(results) == ["long", "short"]


@pytest.fixture
def program(tmp_path):
    """This file as a program in a process group of its own, with workers at work."""
    told = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT, "start_new_session": True}
    # A shell lets what it runs in the background ignore Ctrl-C, and children inherit that.
    told["preexec_fn"] = lambda: signal.signal(signal.SIGINT, signal.SIG_DFL)
    process = subprocess.Popen([sys.executable, __file__, str(tmp_path)], **told)
    try:
        soon(lambda: len(list(tmp_path.glob("*.pid"))) == 2, "its workers have not started")
        yield process
    finally:
        process.kill()
        process.wait()


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGINT])
def test_workers_end_with_their_parent_and_leave_ctrl_c_to_it(program, number):
    family = psutil.Process(program.pid).children(recursive=True)
    assert len(family) >= 2
    if number == signal.SIGINT:
        os.killpg(program.pid, number)  # a terminal tells the whole group
        output, _ = program.communicate(timeout=SOON_S)
        assert program.returncode == -signal.SIGINT
        assert output.decode().count("KeyboardInterrupt") == 1
    else:
        program.kill()
    soon(lambda: not any(map(runs, family)), f"still running: {list(filter(runs, family))}")


@pytest.fixture
def cluster(here, tmp_path):
    """A scheduler and two workers, each a process of its own, as docs/cluster.md starts them."""
    pytest.importorskip("distributed", reason="the extra [cluster] is not installed")
    started, address = [], tmp_path / "scheduler.json"

    def start(*command):
        where = {"cwd": tmp_path, "stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
        process = subprocess.Popen([sys.executable, "-m", *command], **where)
        started.append(process)
        return process

    settings = "--host 127.0.0.1 --port 0 --no-dashboard --scheduler-file".split()
    scheduler = start("distributed.cli.dask_scheduler", *settings, str(address))
    soon(address.exists, "no scheduler")
    settings = "--nthreads 1 --no-dashboard --no-nanny --scheduler-file".split()
    workers = [start("distributed.cli.dask_worker", *settings, str(address)) for _ in range(2)]
    yield scheduler, workers, importlib.import_module("json").loads(address.read_text())["address"]
    for process in started:
        process.kill()
        process.wait()


def on(address):
    return Execution(executor="dask", workers=None, scheduler=address)


def test_a_cluster_gives_what_processes_give_also_where_a_worker_is_killed(here, tmp_path, cluster):
    _, workers, address = cluster
    jobs = [here.Job(f"job {i}", 0.5, str(tmp_path)) for i in range(8)]
    jobs.append(here.Job("long", 3.0, str(tmp_path)))
    with signalled(tmp_path, signal.SIGKILL):
        results = [result for _, result in run_jobs(jobs, here.sleeps, on(address), "cluster")]
    assert sorted(results) == sorted(job.name for job in jobs)  # none lost, none twice
    assert sum(worker.poll() is not None for worker in workers) == 1
    begun = [line for path in tmp_path.glob("*.pid") for line in path.read_text().splitlines()]
    assert begun.count("long") == 2


def test_a_scheduler_that_is_killed_or_not_there_is_an_error(here, tmp_path, cluster, monkeypatch):
    scheduler, _, address = cluster
    jobs = [here.Job("long", LONG_S, str(tmp_path)), here.Job("short", 0.1, str(tmp_path))]
    results = run_jobs(jobs, here.sleeps, on(address), "cluster")
    assert next(results)[1] == "short"
    scheduler.kill()
    with pytest.raises(InputError, match="the scheduler of the cluster is gone; start it"):
        next(results)
    monkeypatch.setattr(executors, "_LOG_EVERY_S", 1)
    with pytest.raises(InputError, match="execution.scheduler: .*docs/cluster.md"):
        list(run_jobs(jobs, here.sleeps, on("tcp://127.0.0.1:9"), "cluster"))


if __name__ == "__main__":
    pair = [Job("long", LONG_S, sys.argv[1]), Job("longer", 2 * LONG_S, sys.argv[1])]
    list(run_jobs(pair, sleeps, PAIR, "program"))
