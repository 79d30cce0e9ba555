"""Fitting many estimators: in one process per core, and networks many at once on a GPU."""

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
from gyro_pipeline.estimators.training import TrainingSet
from gyro_pipeline.executors import run_jobs
from gyro_pipeline.parameters import Execution, Training

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class FitJob:
    """An estimator to fit.

    Attributes:
        key: Whatever tells the caller which run it is of.
        name: Of that run, for messages.
        fold: Of the windows table.
        estimator: As in :data:`gyro_pipeline.estimators.ESTIMATORS`, or of one's own.
        settings: Sizes and schedule, of a network.
        seed: Likewise.
        training: What to fit it to.
    """

    key: str
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


@dataclass(frozen=True)
class Failure:
    """Why there is no fit; and the way to an error that nobody foresaw, else empty."""

    reason: str
    trace: str = ""


def run_fits(
    jobs: Sequence[FitJob], execution: Execution, label: str
) -> Iterator[tuple[FitJob, Fit]]:
    """Fit all estimators and yield each when it is fitted.

    Args:
        jobs: Independent of each other.
        execution: Which executor. ``batched``, and ``auto`` where there is a GPU, trains networks
            many at once; all else is fitted in processes.
        label: Names the work in progress lines.

    Yields:
        A job and its result.

    Raises:
        InputError: Some cannot be fitted, after all others were; the message says which.
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
            "fitted); leave it out of the study, or mend it and start again"
        )


def _attempts(
    jobs: Sequence[FitJob], execution: Execution, label: str
) -> Iterator[tuple[FitJob, Fit | Failure]]:
    """Each job with its fit, or with why there is none."""
    networks = [job for job in jobs if _is_network(job)]
    if networks:
        from gyro_pipeline.learning import fused, trainings  # noqa: PLC0415 - take PyTorch

        device = trainings.batch_device(execution.executor)
        if device is None:
            fused.available()  # compiled, or said why not, before the workers need it
        else:
            yield from _trained_together(networks, device, label)
            jobs = [job for job in jobs if not _is_network(job)]
    for group, fits in run_jobs(_groups(jobs), _fit_group, execution, label, "fits"):
        yield from zip(group.jobs, fits, strict=True)


def _trained_together(
    jobs: Sequence[FitJob], device: Any, label: str
) -> Iterator[tuple[FitJob, Fit | Failure]]:
    """Networks that are trained many at once."""
    from gyro_pipeline.learning.trainings import run_trainings  # noqa: PLC0415 - takes PyTorch

    estimators: list[Any] = [job.make() for job in jobs]
    trainings = [each.job(job.training) for each, job in zip(estimators, jobs, strict=True)]
    for number, trained in run_trainings(trainings, device, label):
        if isinstance(trained, Exception):
            yield jobs[number], Failure(str(trained))
        else:
            estimator = estimators[number].trained(trained)
            yield jobs[number], Fit(estimator, trained.started, time.time(), trained.engine)


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


def _fit_group(group: _Group) -> list[Fit | Failure]:
    return [_fit(job) for job in group.jobs]


def _fit(job: FitJob) -> Fit | Failure:
    """A fit, or why there is none: others go on."""
    started = time.time()
    try:
        estimator = job.make().fit(job.training)
    except (InputError, FloatingPointError) as error:
        return Failure(str(error))
    except Exception as error:  # of a stranger's estimator it may be any
        return Failure(repr(error), f"\n{traceback.format_exc()}")
    return Fit(estimator, started, time.time(), estimator.engine)


def _is_network(job: FitJob) -> bool:
    """Whether it can be trained in a batch; a subclass may differ in anything."""
    return estimator_class(job.estimator).__module__ == f"{__package__}.nn_module"
