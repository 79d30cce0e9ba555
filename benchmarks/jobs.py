"""The cost of a job besides its work: 400 empty jobs in processes and on a local cluster.

    python benchmarks/jobs.py      # the cluster needs pip install -e .[cluster]

Prints milliseconds a job, by the clock and of this process, with two workers each, once they run.
"""

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

from gyro_pipeline.executors import run_jobs
from gyro_pipeline.parameters import Execution

JOBS, WORKERS = 400, 2


@dataclass(frozen=True)
class Empty:
    """A job without any work."""

    work: float = 1.0


def nothing(_job: Empty) -> None:
    """Do nothing."""


@contextmanager
def cluster() -> Iterator[Execution]:
    """A scheduler and workers, each in its own process."""
    from distributed import LocalCluster  # noqa: PLC0415 - an extra

    with LocalCluster(n_workers=WORKERS, threads_per_worker=1, dashboard_address=None) as local:
        yield Execution(executor="dask", scheduler=local.scheduler_address, workers=None)


def measure(name: str, execution: Execution) -> None:
    """Run the jobs twice, since the first run starts the workers, and print the second."""
    for _ in range(2):
        clock, cpu = time.perf_counter(), time.process_time()
        results = list(run_jobs([Empty()] * JOBS, nothing, execution, name))
        assert len(results) == JOBS
    each = [1e3 * (now() - then) / JOBS for now, then in
            ((time.perf_counter, clock), (time.process_time, cpu))]  # fmt: skip
    print(f"{name:<12} {each[0]:6.2f} ms by the clock, {each[1]:6.2f} ms of this process")


def main() -> None:
    measure("processes", Execution(executor="processes", workers=WORKERS))
    try:
        with cluster() as execution:
            measure("dask", execution)
    except ImportError:
        print("dask         not installed")


if __name__ == "__main__":
    main()
