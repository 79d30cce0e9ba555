"""How the sizes that the paper leaves open were chosen: on validation recordings, small and fast.

    kedro run --pipeline=real2real --params=only.sensor=sparkfun,only.real_gyros=3   # the data
    python benchmarks/network_sizes.py

Trains every candidate on SparkFun's 10 s windows of 3 and of 12 real gyroscopes, each with some
seeds, and prints the RMSE on the validation recordings in units of the targets' own spread (1.0
is a constant), at the last and at the best epoch, and the time of an optimiser step. No test
recording is read.
"""

import argparse
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
from kedro.framework.session import KedroSession
from kedro.framework.startup import bootstrap_project

from gyro_pipeline.conventions import HOLD_OUT
from gyro_pipeline.estimators import make_estimator
from gyro_pipeline.executors import run_jobs
from gyro_pipeline.learning.jobs import TrainingJob, run_training
from gyro_pipeline.parameters import Only, Parameters
from gyro_pipeline.pipelines.training.nodes import TrainingSets
from gyro_pipeline.pipelines.windowed_splits.nodes import cut_to_common_length, split_windows
from gyro_pipeline.studies import CNN, study_rows

CANDIDATES = [  # channels, kernel, stride, pool, hidden
    (8, 10, 5, 4, 32),
    (8, 10, 10, 4, 32),
    (8, 20, 10, 4, 32),
    (8, 25, 25, 4, 32),
    (8, 10, 10, 8, 32),
    (16, 25, 5, 4, 64),
    (16, 20, 20, 4, 64),
    (32, 10, 10, 4, 64),
]
DATA = ("raw_logs.recordings", "ground_truth.bias")
NAMES = ("channels", "kernel", "stride", "pool", "hidden")


def main() -> None:
    """Train all candidates and print the table."""
    arguments = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    arguments.add_argument("--epochs", type=int, default=1200)
    arguments.add_argument("--seeds", type=int, default=3)
    options = arguments.parse_args()
    project = Path(__file__).parents[1]
    bootstrap_project(project)
    with KedroSession.create(project) as session:
        context = session.load_context()
        parameters = Parameters(**context.config_loader["parameters"])
        load = context.catalog.load
        recordings, bias = (load(f"sparkfun.{name}") for name in DATA)
        alike, _, contents = cut_to_common_length(
            recordings, bias, load("sparkfun.raw_logs.quality")
        )
    study = parameters.studies["real2real"]
    windows = split_windows(study, alike, contents, parameters.splits, [10.0], Only())
    sets = TrainingSets(windows, alike, None)
    rows = study_rows(study, "sparkfun", parameters.source, [10.0], [0], Only())
    jobs = []
    for sizes in CANDIDATES:
        changes = dict(zip(NAMES, sizes, strict=True)) | {"epochs": options.epochs}
        training = parameters.training.model_copy(update=changes)
        for row in (row for row in rows if row.estimator == CNN and row.real_gyros in (3, 12)):
            for seed in range(options.seeds):
                job = make_estimator(CNN, training, seed).job(sets.of(row)[HOLD_OUT])
                jobs.append(replace(job, cell=row.real_gyros))
    rows = [
        _row(job, result) for job, result in run_jobs(jobs, timed, parameters.execution, "sizes")
    ]
    table = pd.DataFrame(rows).groupby([*NAMES, "real"]).mean().unstack("real").round(3)
    print(table.to_string())  # noqa: T201 - a program for a terminal


def timed(job: TrainingJob):  # noqa: ANN201, D103
    started = time.perf_counter()
    return run_training(job), time.perf_counter() - started


def _row(job: TrainingJob, result: tuple) -> dict[str, float]:
    network, seconds = result
    losses = network.losses.val_loss
    steps = job.settings.epochs * -(-job.windows // job.settings.batch_size)
    sizes = {name: job.design.options[name] for name in NAMES}
    return sizes | {
        "real": job.cell,
        "last": float(np.sqrt(losses.iloc[-1])),
        "best": float(np.sqrt(losses.min())),
        "step_ms": 1e3 * seconds / steps,
    }


if __name__ == "__main__":
    main()
