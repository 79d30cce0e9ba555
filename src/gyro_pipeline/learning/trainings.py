"""Trainings on a GPU, in batches that fit its memory."""

import logging
import time
from collections.abc import Hashable, Iterator, Sequence
from itertools import groupby

import psutil
import torch

from gyro_pipeline.learning.batched import Learner, obstacle, train_together
from gyro_pipeline.learning.examples import Examples, Scaling
from gyro_pipeline.learning.jobs import (
    TrainedNetwork,
    TrainingJob,
    artifact_of,
    prepare_examples,
    run_training,
    shuffling,
)

logger = logging.getLogger(__name__)

_SHARE = 0.5
"""Share of the free memory that a batch may take."""
_STEP = 20
"""Memory of a step for each window, in sizes of a window; the paper's network needs 5 to 10."""


def batch_device(executor: str) -> torch.device | None:
    """The device on which networks are trained in batches; None to train them in processes.

    Args:
        executor: ``auto`` means ``batched`` if there is a GPU.
    """
    cuda = torch.cuda.is_available()
    if executor == "batched" or (executor == "auto" and cuda):
        return torch.device("cuda" if cuda else "cpu")
    return None


def run_trainings(
    jobs: Sequence[TrainingJob], device: torch.device, label: str
) -> Iterator[tuple[int, TrainedNetwork | Exception]]:
    """Train networks in batches, in this process.

    Args:
        jobs: Independent trainings.
        device: Device to train on.
        label: Name of the work in progress lines.

    Yields:
        The number of a job and its result or error, when its batch is finished.
    """
    numbers = {id(job): number for number, job in enumerate(jobs)}
    batches = in_batches(jobs, _SHARE * free_memory(device))
    for count, batch in enumerate(batches, start=1):
        title = f"{label}: batch {count} of {len(batches)}, {len(batch)} networks"
        logger.info("%s", title)
        try:
            results: Sequence[TrainedNetwork | Exception] = train_batch(batch, device, title)
        except Exception as error:  # one network's error, or a lack of memory, must not stop others
            logger.info("%s: trained one by one: %s", title, error)
            results = [_attempt(job) for job in batch]
        for job, trained in zip(batch, results, strict=True):
            yield numbers[id(job)], trained


def in_batches(jobs: Sequence[TrainingJob], memory: float) -> list[list[TrainingJob]]:
    """Group jobs of equal designs, schedules and numbers of windows into batches.

    Args:
        jobs: Trainings of any kind.
        memory: Bytes that a batch may take; a training that takes more is a batch alone.
    """

    def sizes(job: TrainingJob) -> str:
        return f"{job.design} {job.settings} {job.windows} {job.validation_windows}"

    batches = []
    for _, group in groupby(sorted(jobs, key=lambda job: (sizes(job), str(_cell(job)))), sizes):
        members = list(group)
        count = max(1, int(memory / _bytes(members[0])))
        batches += [members[first : first + count] for first in range(0, len(members), count)]
    return batches


def train_batch(
    batch: Sequence[TrainingJob], device: torch.device, label: str = ""
) -> list[TrainedNetwork]:
    """Train the networks of a batch; seeds of a cell share their examples.

    Networks that cannot be trained together are trained one by one, and the log says why.

    Args:
        batch: A batch from :func:`in_batches`.
        device: Device to train on.
        label: See :func:`gyro_pipeline.learning.batched.train_together`.
    """
    started, first = time.time(), batch[0]
    networks = [job.design.build(job.seed) for job in batch]
    if reason := obstacle(networks[0], first.design.layout.shape, device):
        logger.info("%s: trained one by one: %s", type(networks[0]).__name__, reason)
        return [run_training(job) for job in batch]
    examples: dict[Hashable, tuple[Examples, Examples | None, Scaling]] = {}
    for job in batch:
        if _cell(job) not in examples:
            examples[_cell(job)] = prepare_examples(job)
    learners = [
        Learner(network, *examples[_cell(job)][:2], shuffling(job.seed))
        for job, network in zip(batch, networks, strict=True)
    ]
    results = train_together(learners, first.settings, device, label)
    engine = f"batched {device.type}"
    return [
        TrainedNetwork(
            artifact_of(job.design, examples[_cell(job)][2], trained),
            trained.losses,
            started,
            engine,
        )
        for job, trained in zip(batch, results, strict=True)
    ]


def _attempt(job: TrainingJob) -> TrainedNetwork | Exception:
    try:
        return run_training(job)
    except Exception as error:  # a user's network may raise any
        return error


def free_memory(device: torch.device) -> float:
    """Free memory of a device, bytes."""
    if device.type == "cuda":
        return float(torch.cuda.mem_get_info(device)[0])
    return float(psutil.virtual_memory().available)


def _bytes(job: TrainingJob) -> float:
    """Estimated memory of a training: its examples, and the tensors of a step."""
    rows, columns = job.design.layout.shape
    examples = job.windows + job.validation_windows
    return 4.0 * rows * columns * (2 * examples + _STEP * job.settings.batch_size)


def _cell(job: TrainingJob) -> Hashable:
    return id(job) if job.cell is None else job.cell
