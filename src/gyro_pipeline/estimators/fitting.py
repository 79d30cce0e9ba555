"""Fitting many estimators: in one process per core, and networks many at once on a GPU."""

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property

from gyro_pipeline.conventions import InputError
from gyro_pipeline.estimators import estimator_class, make_estimator
from gyro_pipeline.estimators.base import Estimator
from gyro_pipeline.estimators.training import TrainingSet
from gyro_pipeline.executors import run_jobs
from gyro_pipeline.parameters import Execution, Training


@dataclass(frozen=True)
class FitJob:
    """An estimator to fit.

    Attributes:
        name: Whatever tells the caller which run it is of.
        fold: Of the windows table.
        estimator: As in :data:`gyro_pipeline.estimators.ESTIMATORS`, or of one's own.
        settings: Sizes and schedule, of a network.
        seed: Likewise.
        training: What to fit it to.
    """

    name: str
    fold: str
    estimator: str
    settings: Training
    seed: int
    training: TrainingSet

    def make(self) -> Estimator:
        """The estimator, yet to be fitted."""
        return make_estimator(self.estimator, self.settings, self.seed)

    @cached_property
    def work(self) -> float:
        """Estimated cost, in training samples of three gyroscopes of a network."""
        return self.make().work(self.training)


@dataclass(frozen=True)
class Fit:
    """A fitted estimator, when its fit started and ended (seconds since 1970), and on what."""

    estimator: Estimator
    started: float
    ended: float
    engine: str


def run_fits(
    jobs: Sequence[FitJob], execution: Execution, label: str
) -> Iterator[tuple[FitJob, Fit]]:
    """Fit all estimators and yield each when it is fitted.

    Args:
        jobs: Independent of each other.
        execution: Which executor. ``batched``, and ``auto`` where there is a GPU, trains the
            networks of the paper many at once; all else is fitted in processes.
        label: Names the work in progress lines.

    Yields:
        A job and its result.

    Raises:
        InputError: One cannot be fitted; the message says which.
    """
    networks = [job for job in jobs if _is_paper_network(job)]
    if networks:
        from gyro_pipeline.learning import fused, trainings  # noqa: PLC0415 - take PyTorch

        if trainings.batch_device(execution.executor) is None:
            fused.available()  # compiled, or said why not, before the workers need it
        else:
            yield from _run_batched(networks, execution, label)
            jobs = [job for job in jobs if not _is_paper_network(job)]
    groups = _groups(jobs)
    for group, fits in run_jobs(groups, _fit_group, execution, label, "fits"):
        yield from zip(group.jobs, fits, strict=True)


def fit_job(job: FitJob, report: Callable[[float], None]) -> Fit:
    """Fit one estimator.

    Raises:
        InputError: It cannot be fitted.
    """
    started = time.time()
    with _explained(job):
        estimator = job.make().fit(job.training, report)
    return Fit(estimator, started, time.time(), estimator.engine)


@contextmanager
def _explained(job: FitJob) -> Iterator[None]:
    """Say which estimator cannot be fitted, to what, and what to do."""
    try:
        yield
    except InputError as error:
        raise InputError(
            f"{job.fold}: {job.estimator} cannot be fitted: {error}; bring more recordings or "
            "leave it out of the study"
        ) from error


def _run_batched(
    jobs: Sequence[FitJob], execution: Execution, label: str
) -> Iterator[tuple[FitJob, Fit]]:
    """Train networks of the paper many at once."""
    from gyro_pipeline.estimators.paper_network import PaperNetwork  # noqa: PLC0415
    from gyro_pipeline.learning.trainings import run_trainings  # noqa: PLC0415

    networks, trainings = [], []
    for job in jobs:
        network = job.make()
        assert isinstance(network, PaperNetwork)
        with _explained(job):
            network.check(job.training)
        networks.append(network)
        trainings.append(network.job(job.training))
    for number, trained in run_trainings(trainings, execution.executor, label):
        network = networks[number].trained(trained)
        yield jobs[number], Fit(network, trained.started, time.time(), trained.engine)


@dataclass(frozen=True)
class _Group:
    """Jobs of one estimator and recordings, whose windows differ: they share what they work out."""

    jobs: Sequence[FitJob]

    @property
    def work(self) -> float:
        return sum(job.work for job in self.jobs)


def _groups(jobs: Sequence[FitJob]) -> list[_Group]:
    """Each seeded job on its own; others together where they learn from the same recordings."""
    groups: dict[object, list[FitJob]] = {}
    for job in jobs:
        alone = estimator_class(job.estimator).seeded
        recordings = job.training.recordings_key
        key = id(job) if alone else (job.estimator, job.training.device, recordings)
        groups.setdefault(key, []).append(job)
    return [_Group(group) for group in groups.values()]


def _fit_group(group: _Group, report: Callable[[float], None]) -> list[Fit]:
    return [fit_job(job, report) for job in group.jobs]


def _is_paper_network(job: FitJob) -> bool:
    """Whether it can be trained in a batch; a subclass may differ in anything."""
    kind = estimator_class(job.estimator)
    return (kind.__module__, kind.__name__) == (f"{__package__}.paper_network", "PaperNetwork")
