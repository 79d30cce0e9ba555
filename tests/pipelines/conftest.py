"""A sensor small enough to plan, train and evaluate its whole grid in a second."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pandas as pd
import pytest
import xarray as xr

from gyro_pipeline.parameters import (
    Evaluation,
    Execution,
    Grid,
    Only,
    Splits,
    Study,
    Training,
    VirtualGyros,
)
from gyro_pipeline.pipelines.ground_truth.nodes import measure_allan_variance, measure_bias
from gyro_pipeline.pipelines.training.nodes import plan, train
from gyro_pipeline.pipelines.virtual_gyros.nodes import synthesise
from gyro_pipeline.tracking import StoredRun, TrainedRun

NOISE, SPREAD = 0.003, 0.002
RATE_HZ, SAMPLES = 20.0, 1040
SERIAL = Execution(executor="serial", workers=None)


@dataclass(frozen=True)
class World:
    """All that the training and evaluation stages take."""

    recordings: xr.Dataset
    allan: xr.Dataset
    bias: pd.DataFrame
    roles: pd.DataFrame
    virtual: xr.Dataset
    training: Training
    splits: Splits
    virtual_gyros: VirtualGyros
    evaluation: Evaluation
    study: Study
    windows_s: Sequence[float] = (10.0,)
    seeds: Sequence[int] = (0,)
    only: Only = field(default_factory=Only)

    def plan(self) -> pd.DataFrame:
        names = "study recordings roles windows_s seeds only training virtual".split()
        return plan(**{name: getattr(self, name) for name in names})

    def train(
        self,
        tracked: Sequence[StoredRun] = (),
        cells: Any = None,
        execution: Execution = SERIAL,
    ) -> list[TrainedRun]:
        names = "recordings bias roles training splits virtual_gyros virtual".split()
        given = {name: getattr(self, name) for name in names}
        cells = self.plan() if cells is None else cells
        return list(train(cells=cells, tracked=list(tracked), execution=execution, **given))


@pytest.fixture(scope="session")
def world(
    make_recordings: Callable[..., xr.Dataset],
    make_roles: Callable[..., pd.DataFrame],
    parameters: Callable[..., Any],
) -> World:
    """Two IMUs with 14 measured recordings, eight of which train, and eight virtual IMUs."""
    generator = np.random.default_rng(5)
    bias = generator.uniform(-1, 1, (2, 1, 3)) + generator.normal(0, SPREAD, (2, 14, 3))
    recordings = make_recordings(bias, SAMPLES, RATE_HZ, NOISE)
    roles = make_roles(14, test=4, validation=2)
    p = parameters(
        virtual_gyros={"recordings": 6, "train_recordings": 5},
        training={"epochs": 3, "stride": 5, "pool": 2, "channels": 2, "hidden": 4},
        evaluation={"resamples": 100},
    )
    allan = measure_allan_variance(recordings)
    table = measure_bias(recordings, allan, p.ground_truth)
    return World(
        recordings=recordings,
        allan=allan,
        bias=table,
        roles=roles,
        virtual=synthesise(recordings, table, roles, p.virtual_gyros),
        training=p.training,
        splits=p.splits,
        virtual_gyros=p.virtual_gyros,
        evaluation=p.evaluation,
        study=study_of("augmentation", real_gyros=[3, 6], virtual_gyros=[0, 6]),
    )


def study_of(name: str, **grid: Any) -> Study:
    return Study(experiment=name, sensors={"sparkfun": Grid(**{"method": 2, **grid})})


@pytest.fixture(scope="session")
def make_study() -> Callable[..., Study]:
    """A study of one sensor: ``make_study(name, real_gyros=[...])``."""
    return study_of


@pytest.fixture(scope="session")
def as_stored() -> Callable[..., StoredRun]:
    """What a store gives back of a trained run."""

    def make(trained: TrainedRun, run_id: str, **changes: Any) -> StoredRun:
        artifacts: Mapping[str, Any] = trained.artifacts
        given: dict[str, Any] = {
            "run_id": run_id,
            "experiment_id": "1",
            "study": trained.study,
            "finished": False,
            "started_ms": trained.started_ms,
            "params": {key: str(value) for key, value in trained.params.items()},
            "tags": {**trained.tags, "mlflow.runName": run_id},
            "metrics": {},
            "load": artifacts.__getitem__,
        }
        return StoredRun(**given | changes)

    return make


@pytest.fixture(scope="session")
def trained(world: World) -> list[TrainedRun]:
    """The whole grid of the small world, trained."""
    return world.train()


@pytest.fixture(scope="session")
def stored(trained: list[TrainedRun], as_stored: Callable[..., StoredRun]) -> list[StoredRun]:
    """The same as the store gives it, waiting for its evaluation."""
    return [as_stored(run, f"run{number}") for number, run in enumerate(trained)]


@pytest.fixture(scope="session")
def make_bias(parameters: Callable[..., Any]) -> Callable[..., pd.DataFrame]:
    """The ground truth of recordings, from their Allan variances."""
    return lambda recordings, allan: measure_bias(recordings, allan, parameters().ground_truth)
