"""Running pure jobs one after the other, in one process per core, or on a cluster."""

import logging
import os
import pickle
import signal
import threading
import time
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from contextlib import closing, contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Protocol, TypeVar

from joblib import Parallel, delayed, parallel_config
from joblib.externals.loky.process_executor import BrokenProcessPool
from tqdm import tqdm

from gyro_pipeline.conventions import InputError
from gyro_pipeline.parameters import Execution

logger = logging.getLogger(__name__)

_LOG_EVERY_S = 30
_POLL_S = 1.0
_AHEAD = 2
"""Jobs of each thread of a cluster that are given out before results are taken."""


class Job(Protocol):
    """What an executor needs to know of a job."""

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
    """Run ``function(job)`` for every job and yield results as they are there.

    The longest jobs start first, so that the last ones do not wait. Processes are started afresh,
    never forked (a fork after torch used threads can deadlock), and end with this one, however it
    ends.

    Args:
        jobs: Picklable, independent of each other.
        function: At module level.
        execution: ``serial``, ``dask``, or else processes; how many workers.
        label: Names the work in progress lines.
        noun: What the jobs are, for the same lines.
        at_once: How many short ones go to a process together.

    Yields:
        A job and its result.

    Raises:
        InputError: A process or the cluster was lost; what was yielded before is not.
    """
    ordered = sorted(jobs, key=lambda job: job.work, reverse=True)
    if not ordered:
        return
    if execution.executor == "dask":
        results = _on_cluster(ordered, function, execution, label)
    else:
        serial = execution.executor == "serial"
        workers = 1 if serial else min(execution.workers or available_cores(), len(ordered))
        logger.info("%s: %d %s on %d processes", label, len(ordered), noun, workers)
        results = _in_processes(ordered, function, workers, at_once)
    with closing(results):  # now, not when it is collected: it ends the workers
        for number, result in _shown(results, [job.work for job in ordered], label, noun):
            yield ordered[number], result


def available_cores() -> int:
    """Cores this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


Numbered = Generator[tuple[int, R], None, None]


def _shown(results: Numbered[R], works: Sequence[float], label: str, noun: str) -> Numbered[R]:
    """The results, with a bar on a terminal and a line every half minute elsewhere."""
    started = logged = time.monotonic()
    done = count = 0.0
    form = "{desc} {percentage:3.0f}%|{bar}| {elapsed}, {remaining} left"
    with tqdm(total=sum(works), desc=label, bar_format=form, disable=None) as bar:
        for count, (number, result) in enumerate(results, start=1):
            done += works[number]
            bar.update(works[number])
            if bar.disable and time.monotonic() - logged >= _LOG_EVERY_S:
                logged = time.monotonic()
                left_s = (logged - started) * (sum(works) / done - 1)
                told = label, count, len(works), noun, 100 * done / sum(works), _clock(left_s)
                logger.info("%s: %d of %d %s done, %.0f %%, about %s left", *told)
            yield number, result
    logger.info("%s: %d %s in %s", label, count, noun, _clock(time.monotonic() - started))


def _clock(seconds: float) -> str:
    return f"{int(seconds // 60)} min {int(seconds % 60):02d} s"


def _in_processes(
    jobs: Sequence[J], function: Callable[[J], R], workers: int, at_once: int
) -> Numbered[R]:
    calls = (delayed(_call)(function, number, job) for number, job in enumerate(jobs))
    start = {"initializer": _start_worker, "initargs": (os.getpid(),)} if workers > 1 else {}
    with parallel_config("loky" if workers > 1 else "sequential", **start), _no_interrupts():
        parallel = Parallel(
            workers, batch_size=at_once, return_as="generator_unordered", max_nbytes=None
        )
        results = parallel(calls)
    try:
        yield from results
    except BrokenProcessPool as error:
        raise InputError(
            "a worker process was killed, perhaps since memory ran out; try fewer, with "
            "--params=execution.workers=1; what has ended is stored, and not done again"
        ) from error
    finally:
        results.close()


def _call(function: Callable[[J], R], number: int, job: J) -> tuple[int, R]:
    return number, function(job)


@contextmanager
def _no_interrupts() -> Iterator[None]:
    """Processes that are started meanwhile leave Ctrl-C to this one."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _start_worker(parent: int) -> None:
    threading.Thread(target=_end_with, args=(parent,), daemon=True).start()


def _end_with(parent: int) -> None:
    while os.getppid() == parent:
        time.sleep(_POLL_S)
    os._exit(1)


def _on_cluster(
    jobs: Sequence[J], function: Callable[[J], R], execution: Execution, label: str
) -> Numbered[R]:
    """Results from the workers of a dask scheduler, a few jobs for each of them at a time.

    A job goes there as the name of a file and a number, and is repeated where a worker is lost, as
    it is pure. A result is handed out once.
    """
    with _connected(execution) as client, TemporaryDirectory(dir=execution.folder) as folder:
        path = Path(folder, "jobs.pkl")
        starts = _write(jobs, path)
        waiting, running = deque(range(len(jobs))), dict[Any, int]()
        while waiting or running:
            threads = sum(client.nthreads().values())
            while waiting and len(running) < _AHEAD * max(threads, 1):
                number = waiting.popleft()
                given = str(path), starts[number]
                running[client.submit(_call_written, function, *given, pure=False)] = number
            for future in _finished(client, [*running], label):
                yield running.pop(future), future.result()


def _write(jobs: Iterable[J], path: Path) -> list[int]:
    """Where in the file each job begins."""
    starts = []
    with path.open("wb") as file:
        for job in jobs:
            starts.append(file.tell())
            pickle.dump(job, file)
    return starts


def _call_written(function: Callable[[J], R], path: str, start: int) -> R:
    """On a worker."""
    try:
        with open(path, "rb") as file:
            file.seek(start)
            job = pickle.load(file)
    except FileNotFoundError as error:
        raise InputError(
            f"{error}; name a folder that all workers see: --params=execution.folder=FOLDER"
        ) from error
    return function(job)


@contextmanager
def _connected(execution: Execution) -> Iterator[Any]:
    """A client of the scheduler.

    Raises:
        InputError: There is none, or it is gone.
    """
    try:
        from distributed import CancelledError, Client, KilledWorker  # noqa: PLC0415
        from distributed.comm.core import CommClosedError  # noqa: PLC0415
    except ImportError as error:
        raise InputError(f"execution.executor dask: {error}; pip install -e .[cluster]") from error
    try:
        client = Client(execution.scheduler, timeout=_LOG_EVERY_S)
    except OSError as error:
        raise InputError(f"execution.scheduler: {error}; docs/cluster.md") from error
    with client:
        try:
            yield client
        except KilledWorker as error:
            raise InputError(f"a job was lost with every worker that had it: {error}") from error
        except (CancelledError, CommClosedError) as error:
            raise InputError(
                "the scheduler of the cluster is gone; start it, and this run again: what has "
                "ended is stored, and not done again"
            ) from error


def _finished(client: Any, futures: Sequence[Any], label: str) -> Iterable[Any]:
    """Those that have ended, of which there is at least one; meanwhile a line every half minute."""
    from distributed import wait  # noqa: PLC0415 - an extra

    while True:
        try:
            return wait(futures, timeout=_LOG_EVERY_S, return_when="FIRST_COMPLETED").done
        except TimeoutError:
            workers = len(client.nthreads())  # of a scheduler that answers
            logger.info("%s: %d jobs given out, %d workers", label, len(futures), workers)
