"""Fit many estimators: in a process per core, or networks in batches on a GPU."""

import logging
import time
import traceback
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

from gyro_pipeline.conventions import InputError
from gyro_pipeline.estimators import estimator_class, make_estimator
from gyro_pipeline.estimators.base import Estimator
from gyro_pipeline.estimators.training_set import TrainingSet
from gyro_pipeline.executors import run_jobs
from gyro_pipeline.parameters import Execution, Training

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class FitJob:
    """An estimator to fit.

    Attributes:
        key: Fingerprint of the run that the fit belongs to.
        name: Name of the run, for messages.
        fold: Fold of the windows table.
        estimator: Name, as for :func:`gyro_pipeline.estimators.entry`.
        settings: Sizes and schedule of a network.
        seed: Seed of a network.
        training_set: What it is fitted to.
    """

    key: str
    name: str
    fold: str
    estimator: str
    settings: Training
    seed: int
    training_set: TrainingSet

    def make(self) -> Estimator:
        """The estimator, not fitted yet."""
        return make_estimator(self.estimator, self.settings, self.seed)

    @cached_property
    def work(self) -> float:
        """Estimated cost, in training samples of three gyroscopes of a network."""
        return self.make().work(self.training_set)


@dataclass(frozen=True)
class Fit:
    """A fitted estimator, with the start and end of its fit, seconds since 1970."""

    estimator: Estimator
    started: float
    ended: float


@dataclass(frozen=True)
class Failure:
    """The reason why a fit failed, and the traceback of an unexpected error."""

    reason: str
    trace: str = ""


def run_fits(
    jobs: Sequence[FitJob], execution: Execution, label: str
) -> Iterator[tuple[FitJob, Fit]]:
    """Fit all estimators and yield each when it is fitted.

    Args:
        jobs: Independent fits.
        execution: The executor. ``batched``, and ``auto`` if there is a GPU, trains networks in
            batches; everything else is fitted in processes.
        label: Name of the work in progress lines.

    Yields:
        A job and its result.

    Raises:
        InputError: Some fits failed; it is raised after all others and names the first.
    """
    failures = []
    for job, fit in _attempts(jobs, execution, label):
        if isinstance(fit, Fit):
            yield job, fit
        else:
            failures.append(f"{job.name}, {job.fold}: cannot be fitted: {fit.reason}")
            logger.error("%s%s", failures[-1], fit.trace)
    if failures:
        raise InputError(
            f"{failures[0]} ({len(failures)} failed, the other {len(jobs) - len(failures)} are "
            "fitted); leave it out of the study, or correct it and start again"
        )


def _attempts(
    jobs: Sequence[FitJob], execution: Execution, label: str
) -> Iterator[tuple[FitJob, Fit | Failure]]:
    """Each job with its fit or its failure."""
    networks = [job for job in jobs if _is_network(job)]
    if networks:
        from gyro_pipeline.learning import fused, trainings  # noqa: PLC0415 - take PyTorch

        device = trainings.batch_device(execution.executor)
        if device is None:
            fused.available()  # compiles it, or logs why not, before the workers start
        else:
            yield from _train_in_batches(networks, device, label)
            jobs = [job for job in jobs if not _is_network(job)]
    for group, fits in run_jobs(_groups(jobs), _fit_group, execution, label, "fits"):
        yield from zip(group.jobs, fits, strict=True)


def _train_in_batches(
    jobs: Sequence[FitJob], device: Any, label: str
) -> Iterator[tuple[FitJob, Fit | Failure]]:
    """Train networks in batches on a device."""
    from gyro_pipeline.learning.trainings import run_trainings  # noqa: PLC0415 - takes PyTorch

    estimators: list[Any] = [job.make() for job in jobs]
    trainings = [e.job(job.training_set) for e, job in zip(estimators, jobs, strict=True)]
    for number, trained in run_trainings(trainings, device, label):
        if isinstance(trained, Exception):
            yield jobs[number], _failure(trained)
        else:
            estimator = estimators[number].trained(trained)
            yield jobs[number], Fit(estimator, trained.started, time.time())


@dataclass(frozen=True)
class _Group:
    """Jobs that one process fits, since they share intermediate results."""

    jobs: Sequence[FitJob]

    @property
    def work(self) -> float:
        return sum(job.work for job in self.jobs)


def _groups(jobs: Sequence[FitJob]) -> list[_Group]:
    """A group for each seeded job, and one for all other jobs with the same recordings."""
    groups: dict[object, list[FitJob]] = {}
    for job in jobs:
        recordings = job.training_set.recordings_key
        seeded = estimator_class(job.estimator).seeded
        key = id(job) if seeded else (job.estimator, job.training_set.device, recordings)
        groups.setdefault(key, []).append(job)
    return [_Group(group) for group in groups.values()]


def _fit_group(group: _Group) -> list[Fit | Failure]:
    return [_fit(job) for job in group.jobs]


def _fit(job: FitJob) -> Fit | Failure:
    """Fit an estimator; a failure must not stop the other fits."""
    started = time.time()
    try:
        estimator = job.make().fit(job.training_set)
    except Exception as error:  # a user's estimator may raise any
        return _failure(error)
    return Fit(estimator, started, time.time())


def _failure(error: Exception) -> Failure:
    if isinstance(error, (InputError, FloatingPointError)):
        return Failure(str(error))
    return Failure(repr(error), "\n" + "".join(traceback.format_exception(error)))


def _is_network(job: FitJob) -> bool:
    """Whether a job trains a network in the way of this package, so that it can be batched."""
    return estimator_class(job.estimator).__module__ == f"{__package__}.nn_module"
