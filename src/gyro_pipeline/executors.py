"""Runs pure jobs one after the other, in one process per core, or on a cluster."""

import logging
import os
import pickle
import signal
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from contextlib import closing, contextmanager, suppress
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Protocol, TypeVar

import psutil
from joblib import Parallel, cpu_count, delayed, parallel_config
from joblib.externals.loky.backend.resource_tracker import ensure_running
from joblib.externals.loky.process_executor import BrokenProcessPool
from tqdm import tqdm

from gyro_pipeline.conventions import InputError
from gyro_pipeline.parameters import Execution

logger = logging.getLogger(__name__)

_LOG_EVERY_S = 30
_POLL_S = 1.0
_AHEAD = 2
"""Jobs per thread of a cluster that are submitted before results are collected."""


class Job(Protocol):
    """The interface of a job."""

    @property
    def work(self) -> float:
        """Estimated cost, in any unit."""


J = TypeVar("J", bound=Job)
R = TypeVar("R")


def run_jobs(
    jobs: Sequence[J],
    function: Callable[[J], R],
    execution: Execution,
    label: str,
    noun: str = "jobs",
    at_once: int = 1,
) -> Iterator[tuple[J, R]]:
    """Run ``function(job)`` for every job and yield results as they become available.

    The longest jobs start first, so that none of them runs alone at the end. Processes are spawned,
    never forked (a fork after torch used threads can deadlock), and end with this process, however
    it ends.

    Args:
        jobs: Picklable jobs, independent of each other.
        function: A function at module level.
        execution: The executor (``serial``, ``dask``, or else processes) and number of workers.
        label: Name of the work in progress messages.
        noun: Name of the jobs in progress messages.
        at_once: Number of short jobs that are sent to a process together.

    Yields:
        A job and its result.

    Raises:
        InputError: A process or the cluster was lost; earlier results remain valid.
    """
    ordered = sorted(jobs, key=lambda job: job.work, reverse=True)
    if not ordered:
        return
    if execution.executor == "dask":
        results = _on_cluster(ordered, function, execution, label)
    else:
        serial = execution.executor == "serial"
        workers = 1 if serial else min(execution.workers or cpu_count(), len(ordered))
        logger.info("%s: %d %s on %d processes", label, len(ordered), noun, workers)
        results = _in_processes(ordered, function, workers, at_once)
    with closing(results):  # at once rather than by garbage collection, since it ends the workers
        for number, result in _with_progress(results, [job.work for job in ordered], label, noun):
            yield ordered[number], result


Numbered = Generator[tuple[int, R], None, None]


def _with_progress(
    results: Numbered[R], works: Sequence[float], label: str, noun: str
) -> Numbered[R]:
    """Show progress: a bar on a terminal, elsewhere a line every half minute."""
    started = logged = time.monotonic()
    done = count = 0.0
    form = "{desc} {percentage:3.0f}%|{bar}| {elapsed}, {remaining} left"
    hidden = None if sys.stderr else True  # None: unless it is a terminal
    with tqdm(total=sum(works), desc=label, bar_format=form, disable=hidden) as bar:
        for count, (number, result) in enumerate(results, start=1):
            done += works[number]
            bar.update(works[number])
            if bar.disable and time.monotonic() - logged >= _LOG_EVERY_S:
                logged = time.monotonic()
                left_s = (logged - started) * (sum(works) / done - 1)
                values = label, count, len(works), noun, 100 * done / sum(works), _clock(left_s)
                logger.info("%s: %d of %d %s done, %.0f %%, about %s left", *values)
            yield number, result
    logger.info("%s: %d %s in %s", label, count, noun, _clock(time.monotonic() - started))


def _clock(seconds: float) -> str:
    return f"{int(seconds // 60)} min {int(seconds % 60):02d} s"


def _in_processes(
    jobs: Sequence[J], function: Callable[[J], R], workers: int, at_once: int
) -> Numbered[R]:
    calls = (delayed(_call)(function, number, job) for number, job in enumerate(jobs))
    ensure_running()  # unblocks Ctrl-C, which is blocked below
    start = {"initializer": _start_worker, "initargs": (os.getpid(),)} if workers > 1 else {}
    with parallel_config("loky" if workers > 1 else "sequential", **start), _no_interrupts():
        parallel = Parallel(
            workers, batch_size=at_once, return_as="generator_unordered", max_nbytes=None
        )
        results = parallel(calls)
    try:
        with _warnings_of_suspended_workers():
            yield from results
    except BrokenProcessPool as error:
        raise InputError(
            "a worker process was killed, perhaps because memory ran out; type the same command "
            "with --params=execution.workers=1; finished work is stored and not repeated"
        ) from error
    finally:
        results.close()


def _call(function: Callable[[J], R], number: int, job: J) -> tuple[int, R]:
    return number, function(job)


@contextmanager
def _no_interrupts() -> Iterator[None]:
    """Let processes that start inside the block ignore Ctrl-C, which this process handles."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


@contextmanager
def _warnings_of_suspended_workers() -> Iterator[None]:
    """Warn about suspended workers, for which the run would otherwise wait silently."""

    def watch() -> None:
        while not done.wait(_LOG_EVERY_S):
            for worker in psutil.Process().children():
                with suppress(psutil.Error):
                    if worker.status() == psutil.STATUS_STOPPED:
                        text = "process %d was stopped, and this run waits for it: kill -CONT %d"
                        logger.warning(text, worker.pid, worker.pid)

    done = threading.Event()
    threading.Thread(target=watch, daemon=True).start()
    try:
        yield
    finally:
        done.set()


def _start_worker(parent: int) -> None:
    threading.Thread(target=_end_with, args=(parent,), daemon=True).start()


def _end_with(parent: int) -> None:
    while os.getppid() == parent:
        time.sleep(_POLL_S)
    os._exit(1)


def _on_cluster(
    jobs: Sequence[J], function: Callable[[J], R], execution: Execution, label: str
) -> Numbered[R]:
    """Run jobs on the workers of a dask scheduler, with a few jobs per worker at a time.

    A job is sent as a file name and an offset, and is repeated, as it is pure, when its worker is
    lost. Each result is yielded once.
    """
    with _connected(execution) as client, TemporaryDirectory(dir=execution.folder) as folder:
        path = Path(folder, "jobs.pkl")
        starts = _write(jobs, path)
        waiting, running = deque(range(len(jobs))), dict[Any, int]()
        while waiting or running:
            threads = sum(client.nthreads().values())
            while waiting and len(running) < _AHEAD * max(threads, 1):
                number = waiting.popleft()
                job = str(path), starts[number]
                running[client.submit(_call_from_file, function, *job, pure=False)] = number
            for future in _wait(client, [*running], label):
                yield running.pop(future), future.result()


def _write(jobs: Iterable[J], path: Path) -> list[int]:
    """Write jobs to a file and return the offset of each."""
    starts = []
    with path.open("wb") as file:
        for job in jobs:
            starts.append(file.tell())
            pickle.dump(job, file)
    return starts


def _call_from_file(function: Callable[[J], R], path: str, start: int) -> R:
    """Run a job from a file; this runs on a worker."""
    try:
        with open(path, "rb") as file:
            file.seek(start)
            job = pickle.load(file)
    except FileNotFoundError as error:
        raise InputError(
            f"{error}; name a folder that all workers can read: --params=execution.folder=FOLDER"
        ) from error
    return function(job)


@contextmanager
def _connected(execution: Execution) -> Iterator[Any]:
    """Connect to the scheduler.

    Raises:
        InputError: The scheduler does not answer, or the connection was lost.
    """
    try:
        from distributed import CancelledError, Client, KilledWorker  # noqa: PLC0415
        from distributed.comm.core import CommClosedError  # noqa: PLC0415
    except ImportError as error:
        raise InputError(f"execution.executor dask: {error}; pip install -e .[cluster]") from error
    try:
        client = Client(execution.scheduler, timeout=_LOG_EVERY_S)
    except OSError as error:
        raise InputError(f"execution.scheduler: {error}; see docs/cluster.md") from error
    with client:
        try:
            yield client
        except KilledWorker as error:
            raise InputError(f"every worker that ran this job died: {error}") from error
        except (CancelledError, CommClosedError) as error:
            raise InputError(
                "the scheduler of the cluster is gone; start it, then this run again: finished "
                "work is stored and not repeated"
            ) from error


def _wait(client: Any, futures: Sequence[Any], label: str) -> Iterable[Any]:
    """Wait for at least one future, with a line every half minute, and return all finished ones."""
    from distributed import wait  # noqa: PLC0415 - an extra

    while True:
        try:
            return wait(futures, timeout=_LOG_EVERY_S, return_when="FIRST_COMPLETED").done
        except TimeoutError:
            workers = len(client.nthreads())  # raises if the scheduler does not answer
            logger.info("%s: %d jobs submitted, %d workers", label, len(futures), workers)
