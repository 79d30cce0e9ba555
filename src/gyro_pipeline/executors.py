"""Running pure jobs one after the other, or in one process per core."""

import heapq
import logging
import multiprocessing
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from itertools import islice
from typing import Any, Protocol, TypeVar

import numpy as np
from tqdm import tqdm

from gyro_pipeline.parameters import Execution

logger = logging.getLogger(__name__)

Report = Callable[[float], None]
_POLL_S = 0.2
_LOG_EVERY_S = 30
_START = "forkserver" if "forkserver" in multiprocessing.get_all_start_methods() else "spawn"
_IMPORTED = "gyro_pipeline.learning.jobs"
"""By the server of processes, which forks them with it: they take milliseconds, not seconds."""
_AHEAD = 4
"""So many jobs per worker are handed out before results are taken, which bounds both."""


class Job(Protocol):
    """What an executor needs to know of a job."""

    @property
    def work(self) -> float:
        """Estimated cost, in the unit that the job reports."""


J = TypeVar("J", bound=Job)
R = TypeVar("R")


def run_jobs(
    jobs: Sequence[J],
    function: Callable[[J, Report], R],
    execution: Execution,
    label: str,
    what: str = "jobs",
    at_once: int | None = None,
) -> Iterator[tuple[J, R]]:
    """Run ``function(job, report)`` for every job and yield results as they finish.

    The longest jobs start first, so that the last ones do not wait. Processes are forked by one
    that only imports (a fork after torch used threads can deadlock), or spawned where there is no
    such server, and end with this one, however it ends.

    Args:
        jobs: Picklable, independent of each other.
        function: At module level; calls ``report`` with the work done since its last call.
        execution: ``serial``, or else processes; how many workers.
        label: Names the work in progress lines.
        what: What the jobs are, for the same lines.
        at_once: How many go to a process together, as handing out a short one costs as much as it
            takes; to processes that are spawned without PyTorch. None: one by one, to such as have
            it.

    Yields:
        A job and its result. However slowly they are asked for, no more than a few wait in memory.
    """
    ordered = sorted(jobs, key=lambda job: job.work, reverse=True)
    if not ordered:
        return
    serial = execution.executor == "serial"
    workers = 1 if serial else min(execution.workers or available_cores(), len(ordered))
    progress = _Progress(label, len(ordered), [job.work for job in ordered], workers, what)
    logger.info("%s: %d %s on %d processes", label, len(ordered), what, workers)
    if serial:
        results = _run_serially(ordered, function, progress)
    else:
        results = _run_in_processes(ordered, function, workers, progress, at_once)
    yield from _watched(results, progress)


def available_cores() -> int:
    """Cores this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


class _Plan:
    """How long it takes workers to do works, each taking the next one when it has none.

    Time is in units of work: one worker does a unit in a unit of time. At the end, when there are
    fewer works left than workers, the same work takes longer.
    """

    def __init__(self, works: Sequence[float], workers: int) -> None:
        ends = [0.0] * workers
        for work in works:
            heapq.heapreplace(ends, ends[0] + work)
        self._times = np.array([0.0, *sorted(ends)])
        self._works = np.minimum.outer(self._times, ends).sum(1)
        self.end = float(self._times[-1])

    def time(self, done: float) -> float:
        """When so much work is done by all workers."""
        return float(np.interp(done, self._works, self._times))


class _Progress:
    """A bar on a terminal, a plain line every half minute elsewhere; both from the work done.

    Time left is what the plan has left, at the pace since every worker has reported work: what came
    before, processes that start and import, does not come again. A pace of late would jump with
    every preparation, which is reported only when it is done.
    """

    def __init__(
        self,
        label: str,
        jobs: int,
        works: Sequence[float],
        workers: int,
        what: str,
    ) -> None:
        self._label, self._jobs, self._plan = label, jobs, _Plan(works, workers)
        self._what = what
        self._finished, self._done = 0, 0.0
        self._started = self._logged = time.monotonic()
        self._paced_from: tuple[float, float] | None = None  # the clock's time and the plan's
        self._bar = tqdm(
            total=self._plan.end,
            bar_format="{desc}{percentage:3.0f}%|{bar}| {elapsed}{postfix}",
            dynamic_ncols=True,
            desc=f"{label} 0/{jobs}",
            disable=not sys.stderr.isatty(),
        )

    def advance(self, work: float) -> None:
        """Note work done since this was last called."""
        self.advance_to(self._done + work)

    def advance_to(self, done: float, all_at_work: bool = True) -> None:
        """Note all work done so far, and whether every worker has had its part in it."""
        before, self._done = self._plan.time(self._done), done
        at, now = self._plan.time(done), time.monotonic()
        if self._paced_from is None and all_at_work:
            self._paced_from = now, at
        self._bar.set_postfix_str(f"{self._left()} left", refresh=False)
        self._bar.update(at - before)
        if self._bar.disable and now - self._logged >= _LOG_EVERY_S:
            self._logged = now
            self._log()

    def one_finished(self) -> None:
        """Count a job."""
        self._finished += 1
        self._bar.set_description(f"{self._label} {self._finished}/{self._jobs}")

    def close(self) -> None:
        """Say how long it took."""
        self._bar.close()
        if self._finished:
            seconds = time.monotonic() - self._started
            logger.info("%s: %d %s in %s", self._label, self._finished, self._what, _clock(seconds))

    def seconds_left(self) -> float | None:
        """At the pace so far; None before there is one."""
        at = self._plan.time(self._done)
        if self._paced_from is None or at <= self._paced_from[1]:
            return None
        then, was = self._paced_from
        return (self._plan.end - at) * (time.monotonic() - then) / (at - was)

    def _left(self) -> str:
        seconds = self.seconds_left()
        return "unknown" if seconds is None else _clock(seconds)

    def _log(self) -> None:
        logger.info(
            "%s: %d of %d %s done, %.0f %%, %s left",
            *(self._label, self._finished, self._jobs, self._what),
            *(100 * self._plan.time(self._done) / self._plan.end, self._left()),
        )


def _watched(results: Generator[R, None, None], progress: _Progress) -> Iterator[R]:
    """The same results, counted."""
    try:
        for result in results:
            progress.one_finished()
            yield result
    finally:
        results.close()  # now, not when it is collected: it ends the workers
        progress.close()


def _clock(seconds: float) -> str:
    return f"{int(seconds // 60)} min {int(seconds % 60):02d} s"


def _run_serially(
    jobs: Sequence[J], function: Callable[[J, Report], R], progress: _Progress
) -> Generator[tuple[J, R], None, None]:
    for job in jobs:
        yield job, function(job, progress.advance)


def _run_in_processes(
    jobs: Sequence[J],
    function: Callable[[J, Report], R],
    workers: int,
    progress: _Progress,
    at_once: int | None,
) -> Generator[tuple[J, R], None, None]:
    context = multiprocessing.get_context("spawn" if at_once else _START)
    context.set_forkserver_preload([_IMPORTED])
    done, at_work = context.Value("d", 0.0), context.Value("i", 0)
    shared = (done, at_work)
    pool = ProcessPoolExecutor(workers, context, initializer=_start_worker, initargs=shared)
    try:
        count = at_once or 1
        parts = (jobs[first : first + count] for first in range(0, len(jobs), count))
        pending = dict[Future[list[R]], Sequence[J]]()
        while True:
            for part in islice(parts, _AHEAD * workers - len(pending)):
                pending[pool.submit(_call, function, part)] = part
            if not pending:
                break
            finished, _ = wait(pending, timeout=_POLL_S, return_when=FIRST_COMPLETED)
            progress.advance_to(done.value, at_work.value >= workers)
            for future in finished:
                yield from zip(pending.pop(future), future.result(), strict=True)
    except BaseException:  # also an interrupt, or a consumer that stops asking
        for worker in multiprocessing.active_children():
            worker.terminate()
        raise
    finally:
        pool.shutdown(cancel_futures=True)


_done: Any = None
"""In a worker: work done by all workers, shared with the parent."""
_at_work: Any = None
"""How many workers have reported work; None in one that has."""


def _start_worker(done: Any, at_work: Any) -> None:
    global _done, _at_work  # noqa: PLW0603 - the one way to hand a worker what cannot be pickled
    _done, _at_work = done, at_work
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the parent's to handle
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


def _call(function: Callable[[J, Report], R], jobs: Sequence[J]) -> list[R]:
    return [function(job, _report) for job in jobs]


def _report(work: float) -> None:
    global _at_work  # noqa: PLW0603
    with _done.get_lock():
        _done.value += work
    if _at_work is not None:
        with _at_work.get_lock():
            _at_work.value += 1
        _at_work = None
