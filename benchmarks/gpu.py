"""How fast a GPU trains the studies: one batched model against plain loops on the same GPU.

    python benchmarks/gpu.py          # where there is a GPU
    python benchmarks/gpu.py --try    # a few small trainings on the processor: does it run at all

All data are random and of the right shape. What is measured: benchmarks/README.md.
"""

import argparse
import sys
import tempfile
import time
from collections.abc import Callable, Hashable, Sequence
from dataclasses import replace
from pathlib import Path

import pandas as pd
import torch
from kedro.config import OmegaConfigLoader
from torch import Tensor
from training import (  # type: ignore[import-not-found]
    BATCH,
    STUDY_SEEDS,
    TensorBatches,
    engine_way,
    loop_way,
    loss,
    machine,
    study_jobs,
)

from gyro_pipeline.learning.batched import Learner, train_together
from gyro_pipeline.learning.examples import Examples
from gyro_pipeline.learning.jobs import TrainingJob, initial_network, prepared, shuffling
from gyro_pipeline.learning.network import Architecture, CalibrationNetwork
from gyro_pipeline.learning.trainer import TorchEngine
from gyro_pipeline.learning.trainings import TrainingBatch, free_memory, in_batches
from gyro_pipeline.parameters import Parameters
from gyro_pipeline.settings import CONFIG_LOADER_ARGS
from gyro_pipeline.studies import Cell

SENSOR, WINDOW_S = "sparkfun", 10
"""Of the comparison: its augmentation study, six cells of equal sizes."""
FEW, MORE = 4, 20
"""Epochs that are timed for the studies; the difference is what an epoch costs."""

Cells = dict[Hashable, tuple[Examples, Examples | None]]
Trial = Callable[[], tuple[float, list[float]]]
"""Train all networks anew: seconds, and the loss that each has reached on its examples."""


def main() -> None:
    """Compare, then extrapolate the studies."""
    arguments = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    arguments.add_argument("--try", action="store_true", dest="tiny", help="small, on any machine")
    arguments.add_argument("--repetitions", type=int, default=5)
    arguments.add_argument("--epochs", type=int, default=10, help="of the comparison")
    options = arguments.parse_args()
    if not (torch.cuda.is_available() or options.tiny):
        sys.exit("there is no GPU here, so there is nothing to time; --try runs it small anyway")
    device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
    env = "smoke" if options.tiny else "base"
    loader = OmegaConfigLoader(str(Path(__file__).parents[1] / "conf"), env, **CONFIG_LOADER_ARGS)
    parameters = Parameters(**loader["parameters"])
    print(machine())
    print(f"device:    {described(device)}")
    with tempfile.TemporaryDirectory() as folder:
        jobs = study_jobs(parameters, Path(folder))
        batches = compared_batches(jobs, device)
        print(f"\n{len(batches)} batches, {batches[0].jobs[0].architecture}")
        compare(batches, device, options.repetitions, options.epochs)
        extrapolate(jobs, device)


def described(device: torch.device) -> str:
    """Name, memory and CUDA's version."""
    if device.type == "cpu":
        return "the processor: these times say nothing about a GPU"
    about = torch.cuda.get_device_properties(device)
    return f"{about.name}, {about.total_memory / 2**30:.0f} GiB, CUDA {torch.version.cuda}"


def seconds() -> float:
    """The clock, when all that was asked of the GPU is done."""
    if torch.cuda.is_available():
        torch.cuda.synchronize()
    return time.perf_counter()


def seeded(jobs: list[TrainingJob]) -> list[TrainingJob]:
    """Every job with every seed, of one cell."""
    return [
        replace(job, seed=seed, cell=job.name, name=f"{job.name}, seed {seed}")
        for job in jobs
        for seed in range(STUDY_SEEDS)
    ]


# ----------------------------------------------------------------- against loops on the same GPU


def compared_batches(jobs: dict[Cell, TrainingJob], device: torch.device) -> list[TrainingBatch]:
    wanted = [
        job
        for cell, job in jobs.items()
        if (cell.study, cell.sensor, cell.window_s) == ("augmentation", SENSOR, WINDOW_S)
    ]
    return in_batches(seeded(wanted), device, free_memory(device) / 2)


def compare(
    batches: list[TrainingBatch], device: torch.device, repetitions: int, epochs: int
) -> None:
    """Ways take turns within a repetition; all train the same networks in the same orders."""
    jobs = [job for batch in batches for job in batch.jobs]
    cells = prepared_cells(jobs)
    ways = {
        "plain loop": looping(jobs, device, cells, epochs, plain_run),
        "packed loop": looping(jobs, device, cells, epochs, packed_run),
        "batched": at_once(batches, cells, epochs),
    }
    for trial in ways.values():
        trial()
    rows, reached = [], {}
    for _ in range(repetitions):
        timed = {}
        for way, trial in ways.items():
            timed[way], reached[way] = trial()
        rows.append(timed)
    steps = epochs * sum(-(-job.windows // BATCH) for job in jobs)
    table = pd.DataFrame(rows)
    ratios = table.rdiv(table["plain loop"], axis=0)
    for way, times in table.items():
        r = ratios[way]
        off = max(abs(a - b) for a, b in zip(reached[way], reached["plain loop"], strict=True))
        print(
            f"{way:12} {1e6 * times.median() / steps:8.1f} us a step of one network, "
            f"{r.median():6.2f} x the plain loop ({r.min():.2f} to {r.max():.2f}), "
            f"losses differ by at most {off:.1g}",
            flush=True,
        )


def prepared_cells(jobs: Sequence[TrainingJob]) -> Cells:
    """Training and validation examples of each cell, in memory."""
    cells = {job.cell: job for job in jobs}
    return {cell: prepared(job)[:2] for cell, job in cells.items()}


def looping(
    jobs: list[TrainingJob],
    device: torch.device,
    cells: Cells,
    epochs: int,
    run: Callable[[CalibrationNetwork, Examples, TrainingJob, int], float],
) -> Trial:
    """One network after the other, examples on the device, no validation."""

    def trial() -> tuple[float, list[float]]:
        total, reached = 0.0, []
        for job in jobs:
            examples = cells[job.cell][0]
            network = initial_network(job.architecture, job.seed).to(device)
            total += run(network, examples, job, epochs)
            reached.append(loss_of(network, examples, device))
        return total, reached

    return trial


def plain_run(
    network: CalibrationNetwork, examples: Examples, job: TrainingJob, epochs: int
) -> float:
    x, y = on_device(network, examples)
    return loop_way(network, TensorBatches(x, y, job.seed), seconds)(epochs)


def packed_run(
    network: CalibrationNetwork, examples: Examples, job: TrainingJob, epochs: int
) -> float:
    arrays = examples.inputs, examples.targets
    return engine_way(network, TorchEngine, *arrays, job.seed, seconds)(epochs)


def at_once(batches: Sequence[TrainingBatch], cells: Cells, epochs: int) -> Trial:
    """Copying to the device and validation are timed as well."""

    def trial() -> tuple[float, list[float]]:
        total, reached = 0.0, []
        for batch in batches:
            schedule = batch.jobs[0].settings.model_copy(update={"epochs": epochs})
            learners = [
                Learner(
                    initial_network(job.architecture, job.seed),
                    *cells[job.cell],
                    shuffling(job.seed),
                )
                for job in batch.jobs
            ]
            started = seconds()
            results = train_together(learners, schedule, batch.device, lambda: None)
            total += seconds() - started
            for job, trained in zip(batch.jobs, results, strict=True):
                network = CalibrationNetwork(job.architecture)
                network.load_state_dict(trained.last)
                examples = cells[job.cell][0]
                reached.append(loss_of(network.to(batch.device), examples, batch.device))
        return total, reached

    return trial


def on_device(network: CalibrationNetwork, examples: Examples) -> tuple[Tensor, Tensor]:
    """Plain windows and targets, where the network is."""
    device = network.output.bias.device
    windows = unpacked(torch.from_numpy(examples.inputs), network.architecture)
    return windows.to(device), torch.from_numpy(examples.targets).to(device)


def unpacked(packed: Tensor, a: Architecture) -> Tensor:
    """Windows (n, gyroscopes, samples) without the samples that no output sees."""
    blocks = packed[:, :, : a.gyroscopes * a.stride].unflatten(2, (a.gyroscopes, a.stride))
    return blocks.transpose(1, 2).flatten(2).contiguous()


def loss_of(network: CalibrationNetwork, examples: Examples, device: torch.device) -> float:
    return loss(network, *on_device(network, examples))


# ------------------------------------------------------------------------------- the studies


def extrapolate(jobs: dict[Cell, TrainingJob], device: torch.device) -> None:
    """Prepare every batch, and time few and some more epochs of it."""
    rows = []
    for study, sensor in dict.fromkeys((cell.study, cell.sensor) for cell in jobs):
        of_node = [
            job for cell, job in jobs.items() if (cell.study, cell.sensor) == (study, sensor)
        ]
        for batch in in_batches(seeded(of_node), device, free_memory(device) / 2):
            started = seconds()
            cells = prepared_cells(batch.jobs)
            preparation_s = seconds() - started
            few, more = (at_once([batch], cells, epochs)()[0] for epochs in (FEW, MORE))
            epoch_s, epochs = (more - few) / (MORE - FEW), batch.jobs[0].settings.epochs
            once_s = preparation_s + few - FEW * epoch_s
            rows.append(
                {
                    "study": study,
                    "sensor": sensor,
                    "S": batch.jobs[0].window,
                    "networks": len(batch.jobs),
                    "once_s": once_s,
                    "epoch_ms": 1e3 * epoch_s,
                    "minutes": (once_s + epochs * epoch_s) / 60,
                }
            )
    table = pd.DataFrame(rows)
    print("\n" + table.round(2).to_string(index=False))
    print(f"the three studies, {table.networks.sum()} networks: {table.minutes.sum():.1f} minutes")


if __name__ == "__main__":
    main()
