"""Trainings on a GPU, in batches that fit its memory."""

import logging
import time
from collections.abc import Callable, Hashable, Iterator, Sequence
from dataclasses import dataclass
from itertools import groupby

import psutil
import torch

from gyro_pipeline.executors import run_jobs
from gyro_pipeline.learning.batched import Learner, obstacle, train_together
from gyro_pipeline.learning.examples import Examples, Scaling
from gyro_pipeline.learning.jobs import (
    RECORDING_WORK,
    TrainedNetwork,
    TrainingJob,
    initial_network,
    prepared,
    run_training,
    shuffling,
    stored,
)
from gyro_pipeline.learning.packing import packed_shape
from gyro_pipeline.parameters import Execution

logger = logging.getLogger(__name__)

_SHARE = 0.5
"""Of the free memory that is planned for."""
_STEP = 20
"""What a step keeps of a window, in sizes of that window. The paper's network needs 5 to 10."""


@dataclass(frozen=True)
class TrainingBatch:
    """Jobs of equal sizes, schedules and numbers of windows, to be trained at once on a device."""

    jobs: Sequence[TrainingJob]
    device: torch.device

    @property
    def work(self) -> float:
        """Estimated cost, as if they were trained one by one."""
        return sum(job.work for job in self.jobs)


def batch_device(executor: str) -> torch.device | None:
    """Where many networks are trained at once; None where they are trained in processes.

    Args:
        executor: ``auto`` is ``batched`` where there is a GPU.
    """
    cuda = torch.cuda.is_available()
    if executor == "batched" or (executor == "auto" and cuda):
        return torch.device("cuda" if cuda else "cpu")
    return None


def run_trainings(
    jobs: Sequence[TrainingJob], executor: str, label: str
) -> Iterator[tuple[int, TrainedNetwork]]:
    """Train networks in batches, in this process.

    Args:
        jobs: Independent of each other.
        executor: As for :func:`batch_device`, which must have a device for it.
        label: Names the work in progress lines.

    Yields:
        The number of a job and its result, when its batch is finished.
    """
    device = batch_device(executor)
    assert device is not None
    numbers = {id(job): number for number, job in enumerate(jobs)}
    batches = in_batches(jobs, device, _SHARE * free_memory(device))
    serial = Execution(executor="serial", workers=1)
    for batch, results in run_jobs(batches, train_batch, serial, label, "batches of networks"):
        for job, trained in zip(batch.jobs, results, strict=True):
            yield numbers[id(job)], trained


def in_batches(
    jobs: Sequence[TrainingJob], device: torch.device, memory: float
) -> list[TrainingBatch]:
    """Jobs that can be trained step by step together, as many as fit the memory.

    Args:
        jobs: Any.
        device: Where they will be trained.
        memory: Bytes that a batch may take. A training that takes more is a batch of its own.
    """

    def sizes(job: TrainingJob) -> str:
        watched = job.validation.windows if job.validation else 0
        return f"{job.architecture} {job.settings} {job.windows} {watched}"

    batches = []
    for _, group in groupby(sorted(jobs, key=lambda job: (sizes(job), str(_cell(job)))), sizes):
        same = list(group)
        count = max(1, int(memory / _bytes(same[0])))
        parts = (same[first : first + count] for first in range(0, len(same), count))
        batches += [TrainingBatch(part, device) for part in parts]
    return batches


def train_batch(batch: TrainingBatch, report: Callable[[float], None]) -> list[TrainedNetwork]:
    """Train the networks of a batch; the examples of a cell are prepared once for all its seeds.

    Networks that cannot be trained at once are trained one by one; the log says why.

    Args:
        batch: What to train, and where.
        report: Told the work done, of a training once it is prepared, and of all after every epoch.
    """
    started, first, device = time.time(), batch.jobs[0], batch.device
    networks = [initial_network(job.architecture, job.seed) for job in batch.jobs]
    if reason := obstacle(networks[0], packed_shape(first.architecture), device):
        logger.info("%s: trained one by one: %s", type(networks[0]).__name__, reason)
        return [run_training(job, report) for job in batch.jobs]
    examples, learners = dict[Hashable, tuple[Examples, Examples | None, Scaling]](), []
    for job, network in zip(batch.jobs, networks, strict=True):
        if _cell(job) not in examples:
            examples[_cell(job)] = prepared(job)
        training, validation, _ = examples[_cell(job)]
        learners.append(Learner(network, training, validation, shuffling(job.seed)))
        report(job.recordings * RECORDING_WORK)
    epoch_work = sum(job.epoch_work for job in batch.jobs)
    results = train_together(learners, first.settings, device, lambda: report(epoch_work))
    artifacts = [
        stored(job.architecture, examples[_cell(job)][2], trained)
        for job, trained in zip(batch.jobs, results, strict=True)
    ]
    return [
        TrainedNetwork(artifact, trained.history, started, f"batched {device.type}")
        for artifact, trained in zip(artifacts, results, strict=True)
    ]


def free_memory(device: torch.device) -> float:
    """Free bytes."""
    if device.type == "cuda":
        return float(torch.cuda.mem_get_info(device)[0])
    return float(psutil.virtual_memory().available)


def _bytes(job: TrainingJob) -> float:
    """Estimate of what a training takes: its examples, and what a step keeps."""
    blocks, width = packed_shape(job.architecture)
    examples = job.windows + (job.validation.windows if job.validation else 0)
    return 4.0 * blocks * width * (2 * examples + _STEP * job.settings.batch_size)


def _cell(job: TrainingJob) -> Hashable:
    return id(job) if job.cell is None else job.cell
