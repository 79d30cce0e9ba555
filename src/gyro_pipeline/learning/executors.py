"""Running pure jobs one after the other, or in one process per core."""

import logging
import multiprocessing
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, ProcessPoolExecutor, wait
from typing import Any, Protocol, TypeVar

from tqdm import tqdm

from gyro_pipeline.parameters import Execution

logger = logging.getLogger(__name__)

Report = Callable[[float], None]
_POLL_S = 0.2
_LOG_EVERY_S = 30


class Job(Protocol):
    """What an executor needs to know of a job."""

    @property
    def work(self) -> float:
        """Estimated cost, in the unit that the job reports."""


J = TypeVar("J", bound=Job)
R = TypeVar("R")


def run_jobs(
    jobs: Sequence[J], function: Callable[[J, Report], R], execution: Execution, label: str
) -> Iterator[tuple[J, R]]:
    """Run ``function(job, report)`` for every job and yield results as they finish.

    The longest jobs start first, so that the last ones do not wait. Processes are spawned (a fork
    after torch used threads can deadlock) and end with this one, however it ends.

    Args:
        jobs: Picklable, independent of each other.
        function: At module level; calls ``report`` with the work done since its last call.
        execution: Which executor, and how many workers.
        label: Names the work in progress lines.

    Yields:
        A job and its result.
    """
    ordered = sorted(jobs, key=lambda job: job.work, reverse=True)
    if not ordered:
        return
    serial = execution.executor == "serial"
    workers = 1 if serial else min(execution.workers or available_cores(), len(ordered))
    progress = _Progress(label, len(ordered), sum(job.work for job in ordered), workers)
    run = _run_serially if serial else _run_in_processes
    try:
        for job, result in run(ordered, function, workers, progress):
            progress.one_finished()
            yield job, result
    finally:
        progress.close()


def available_cores() -> int:
    """Cores this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


class _Progress:
    """A bar on a terminal, a plain line every half minute elsewhere; both from the work done."""

    def __init__(self, label: str, jobs: int, work: float, workers: int) -> None:
        self._label, self._jobs, self._work = label, jobs, work
        self._finished, self._done = 0, 0.0
        self._started = self._logged = time.monotonic()
        logger.info("%s: %d trainings on %d processes", label, jobs, workers)
        self._bar = tqdm(
            total=work,
            unit=" samples",
            unit_scale=True,
            smoothing=0.05,
            dynamic_ncols=True,
            desc=f"{label} 0/{jobs}",
            disable=not sys.stderr.isatty(),
        )

    def advance_to(self, done: float) -> None:
        self._bar.update(done - self._done)
        self._done = done
        if self._bar.disable and time.monotonic() - self._logged >= _LOG_EVERY_S:
            self._log()

    def one_finished(self) -> None:
        self._finished += 1
        self._bar.set_description(f"{self._label} {self._finished}/{self._jobs}")

    def close(self) -> None:
        self._bar.close()
        if self._finished:
            seconds = time.monotonic() - self._started
            logger.info("%s: %d trainings in %s", self._label, self._finished, _clock(seconds))

    def _log(self) -> None:
        self._logged = time.monotonic()
        rate = self._done / (self._logged - self._started)
        left = _clock((self._work - self._done) / rate) if rate else "unknown"
        logger.info(
            "%s: %d of %d trainings done, %.0f %%, %.0f million samples/s, %s left",
            *(self._label, self._finished, self._jobs),
            *(100 * self._done / self._work, rate / 1e6, left),
        )


def _clock(seconds: float) -> str:
    return f"{int(seconds // 60)} min {int(seconds % 60):02d} s"


def _run_serially(
    jobs: Sequence[J], function: Callable[[J, Report], R], workers: int, progress: _Progress
) -> Iterator[tuple[J, R]]:
    done = 0.0

    def report(work: float) -> None:
        nonlocal done
        done += work
        progress.advance_to(done)

    for job in jobs:
        yield job, function(job, report)


def _run_in_processes(
    jobs: Sequence[J], function: Callable[[J, Report], R], workers: int, progress: _Progress
) -> Iterator[tuple[J, R]]:
    spawn = multiprocessing.get_context("spawn")
    done = spawn.Value("d", 0.0)
    pool = ProcessPoolExecutor(workers, spawn, initializer=_start_worker, initargs=(done,))
    try:
        pending = {pool.submit(_call, function, job): job for job in jobs}
        while pending:
            finished, _ = wait(pending, timeout=_POLL_S, return_when=FIRST_COMPLETED)
            progress.advance_to(done.value)
            for future in finished:
                yield pending.pop(future), future.result()
    except BaseException:  # also an interrupt, or a consumer that stops asking
        for worker in multiprocessing.active_children():
            worker.terminate()
        raise
    finally:
        pool.shutdown(cancel_futures=True)


_done: Any = None
"""In a worker: work done by all workers, shared with the parent."""


def _start_worker(done: Any) -> None:
    global _done  # noqa: PLW0603 - the one way to hand a worker what cannot be pickled
    _done = done
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the parent's to handle
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


def _call(function: Callable[[J, Report], R], job: J) -> R:
    return function(job, _report)


def _report(work: float) -> None:
    with _done.get_lock():
        _done.value += work
