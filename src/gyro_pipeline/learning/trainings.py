"""Many trainings at once, in batches that fit the memory of a GPU."""

import os
import time
from collections.abc import Callable, Hashable, Iterator, Sequence
from dataclasses import dataclass
from itertools import groupby

import psutil
import torch

from gyro_pipeline.executors import run_batches
from gyro_pipeline.learning import batched
from gyro_pipeline.learning.batched import Learner, train_together
from gyro_pipeline.learning.examples import Examples, Scaling
from gyro_pipeline.learning.jobs import (
    TrainedNetwork,
    TrainingJob,
    initial_network,
    prepared,
    shuffling,
    stored,
)
from gyro_pipeline.learning.packing import packed_shape

_SHARE = 0.8
"""Of the free memory that is planned for; the rest is for what the estimate does not know."""
_RECORDING = 10
"""What reading, scaling and packing one costs, in steps: a guess, no GPU has timed it yet."""


def batch_device(executor: str) -> torch.device | None:
    """Where many networks are trained at once; None where they are trained one by one.

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
    """Train all networks in batches, in this process.

    Args:
        jobs: Independent of each other.
        executor: As for :func:`batch_device`, which must have a device for it.
        label: Names the work in progress lines.

    Yields:
        The number of a job and its result, as it is finished.
    """
    device = batch_device(executor)
    assert device is not None
    numbers = {id(job): number for number, job in enumerate(jobs)}
    batches = in_batches(jobs, device, free_memory(device))
    for job, trained in run_batches(batches, train_batch, label, "trainings"):
        yield numbers[id(job)], trained


@dataclass(frozen=True)
class TrainingBatch:
    """Jobs with networks and schedules of the same sizes, to be trained at once."""

    jobs: Sequence[TrainingJob]
    device: torch.device

    @property
    def size(self) -> int:
        """How many trainings."""
        return len(self.jobs)

    @property
    def cells(self) -> dict[Hashable, TrainingJob]:
        """One job of each cell: its examples are those of all its seeds."""
        return {_cell(job): job for job in self.jobs}

    @property
    def work(self) -> float:
        """Estimated cost, in steps of all networks at once."""
        return max(map(_steps, self.jobs)) + _RECORDING * sum(
            job.recordings for job in self.cells.values()
        )


def in_batches(
    jobs: Sequence[TrainingJob], device: torch.device, memory: float
) -> list[TrainingBatch]:
    """Jobs of the same sizes together, in batches that fit the memory.

    Args:
        jobs: Any.
        device: Where they will be trained.
        memory: Bytes that a batch may take. A training that takes more is a batch of its own.

    Returns:
        The longest batches first; cells of similar length are in the same one.
    """
    batches = []
    for _, same in groupby(sorted(jobs, key=_order), key=_sizes):
        batch: list[TrainingJob] = []
        for job in same:
            if batch and estimated_bytes([*batch, job]) > memory:
                batches.append(TrainingBatch(batch, device))
                batch = []
            batch.append(job)
        batches.append(TrainingBatch(batch, device))
    return sorted(batches, key=lambda batch: batch.work, reverse=True)


def train_batch(
    batch: TrainingBatch, report: Callable[[float], None]
) -> Iterator[tuple[TrainingJob, TrainedNetwork]]:
    """Train the networks of a batch together; the examples of a cell are prepared once.

    Args:
        batch: What to train, and where.
        report: Told the work done, after every recording that is prepared and every chunk of steps.

    Yields:
        A job and its result.
    """
    started, scalings = time.time(), list[Scaling]()
    os.environ.setdefault("CUBLAS_WORKSPACE_CONFIG", ":4096:8")  # cuBLAS repeats itself with this

    def examples() -> Iterator[tuple[Examples, Examples | None]]:
        for job in batch.cells.values():
            training, validation, scaling = prepared(job, lambda: report(_RECORDING))
            scalings.append(scaling)
            yield training, validation

    numbers = {cell: number for number, cell in enumerate(batch.cells)}
    learners = [
        Learner(
            initial_network(job.architecture, job.seed), numbers[_cell(job)], shuffling(job.seed)
        )
        for job in batch.jobs
    ]
    schedule, engine = batch.jobs[0].settings, f"batched {batch.device.type}"
    for number, trained in train_together(learners, examples(), schedule, batch.device, report):
        job = batch.jobs[number]
        artifact = stored(job.architecture, scalings[numbers[_cell(job)]], trained)
        yield job, TrainedNetwork(artifact, trained.history, started, engine)


def free_memory(device: torch.device) -> float:
    """Bytes that a batch may take of what is free."""
    if device.type == "cuda":
        torch.cuda.empty_cache()  # what PyTorch keeps for itself is free as well
        return _SHARE * torch.cuda.mem_get_info(device)[0]
    return _SHARE * psutil.virtual_memory().available


def estimated_bytes(jobs: Sequence[TrainingJob]) -> float:
    """Upper estimate of what it takes on the device to train these jobs at once."""
    architecture, batch_size = jobs[0].architecture, jobs[0].settings.batch_size
    blocks, width = packed_shape(architecture)
    taps = -(-architecture.kernel // architecture.stride)
    weights = sum(value.numel() for value in initial_network(architecture, 0).parameters())
    # Of a window: its copy; the convolution's outputs by tap, their sum, maxima and gradients; of a
    # product, its kernel and the gradient of that.
    window = blocks * width + 8 * blocks * taps * architecture.channels
    window += 2 * width * taps * architecture.channels + 8 * architecture.hidden
    # Twice, as a step and a validation are captured with memory of their own.
    network = 2 * (batch_size * window + 12 * weights) + 2 * batched.CHUNK * batch_size
    cells = {_cell(job): job for job in jobs}.values()
    # Twice, as the cells' examples are joined on the device.
    examples = 2 * sum(_examples(job) for job in cells) * (blocks * width + architecture.gyroscopes)
    return 4.0 * (len(jobs) * network + examples)


def _steps(job: TrainingJob) -> int:
    epochs = len(job.settings.learning_rates(job.windows))
    return epochs * -(-job.windows // job.settings.batch_size)


def _examples(job: TrainingJob) -> int:
    """Training and validation windows."""
    return job.windows + (job.validation.windows if job.validation else 0)


def _sizes(job: TrainingJob) -> str:
    """What networks that are trained at once have in common."""
    return f"{job.architecture} {job.settings}"


def _order(job: TrainingJob) -> tuple[str, int, str]:
    return _sizes(job), -job.windows, str(_cell(job))


def _cell(job: TrainingJob) -> Hashable:
    return id(job) if job.cell is None else job.cell
