"""A sensor small enough to plan, train and evaluate its whole grid in a second."""

import copy
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
import pandas as pd
import pytest
import xarray as xr

from gyro_pipeline.parameters import Execution, Grid, Only, Splits, Study, Training, VirtualGyros
from gyro_pipeline.pipelines.evaluation.nodes import evaluate
from gyro_pipeline.pipelines.ground_truth.nodes import measure_allan_variance, measure_bias
from gyro_pipeline.pipelines.training.nodes import plan_runs, train
from gyro_pipeline.pipelines.virtual_gyros.nodes import synthesise
from gyro_pipeline.pipelines.windowed_splits.nodes import cut_to_common_length, split_windows
from gyro_pipeline.studies import possible_runs
from gyro_pipeline.tracking import FINGERPRINT, StoredRun

NOISE, SPREAD = 0.003, 0.002
RATE_HZ, SAMPLES = 20.0, 1040
SERIAL = Execution(executor="serial", workers=None)


@dataclass(frozen=True)
class World:
    """Recordings of one sensor and a study; each stage runs on what the one before it makes."""

    raw: xr.Dataset
    allan: xr.Dataset
    raw_bias: pd.DataFrame
    study: Study
    training: Training
    splits: Splits
    virtual_gyros: VirtualGyros
    windows_s: Sequence[float] = (10.0,)
    seeds: Sequence[int] = (0,)
    only: Only = field(default_factory=Only)

    @cached_property
    def _cut(self):
        return cut_to_common_length(self.raw, self.raw_bias, quality_of(self.raw))

    @property
    def recordings(self):
        """All of one length."""
        return self._cut[0]

    @property
    def bias(self):
        """The ground truth of these."""
        return self._cut[1]

    @cached_property
    def virtual(self):
        """Virtual recordings, where the study uses some."""
        if not any(self.study.grid_of("sparkfun").virtual_gyros):
            return None
        return synthesise(self.raw, self.raw_bias, self.virtual_gyros)

    @cached_property
    def windows(self):
        given = self.study, self.recordings, self._cut[2], self.splits, list(self.windows_s)
        return split_windows(*given, self.only, self.virtual)

    @cached_property
    def plan(self):
        given = self.study, self.recordings, self.windows, list(self.windows_s), list(self.seeds)
        return plan_runs(*given, self.only, self.training, self.virtual)

    @property
    def specs(self):
        """The runs that can be made, by fingerprint."""
        return possible_runs(self.plan)

    @property
    def fingerprints(self):
        """By estimator, gyroscopes, window, seed and method."""
        names = ["estimator", "real_gyros", "virtual_gyros", "window_s", "seed", "method"]
        rows = self.plan[names].itertuples(index=False, name=None)
        return dict(zip(rows, self.plan[FINGERPRINT], strict=True))

    def train(self, tracked=(), execution=SERIAL):
        given = self.study, self.plan, list(tracked), self.recordings, self.windows, self.training
        settings = self.splits, self.virtual_gyros, execution
        return list(train(*given, *settings, self.virtual))

    def evaluate(self, runs):
        given = self.plan, list(runs), self.recordings, self.windows, self.bias
        return list(evaluate(*given, self.allan))

    def judged(self):
        """All runs, trained and evaluated, by estimator, the last of each."""
        runs = stored_runs(self.train())
        names = {run.run_id: run.params["estimator"] for run in runs}
        return {names[run.run_id]: run for run in self.evaluate(runs)}


def quality_of(recordings):
    """What the raw-logs stage says of recordings, which it found five rows into their files."""
    rows = recordings["samples"].to_dataframe().reset_index()
    stop = rows.samples.where(rows.samples > 0) + 5
    files = [f"{i}_{n}.csv" for i, n in zip(rows.imu, rows.recording, strict=True)]
    return rows[["imu", "recording"]].assign(file=files, start=stop * 0 + 5, stop=stop)


def stored_runs(fitted, **changes):
    """What a store gives back of some fits: each run with those of its folds that are there."""
    by_run = {}
    for fit in fitted:
        by_run.setdefault(fit.run.fingerprint, {})[fit.fold] = fit
    runs = []
    for number, (key, fits) in enumerate(by_run.items()):
        identity = next(iter(fits.values())).run
        estimators = {fold: copy.copy(fit.estimator) for fold, fit in fits.items()}
        for estimator in estimators.values():
            estimator.losses = None  # which is an artifact of its own
        history = [fit.estimator.losses for fit in fits.values() if fit.is_model]
        run = StoredRun(
            **{"run_id": f"run{number}", "experiment_id": "1", "study": identity.study},
            **{"finished": False, "trained": set(fits) == set(identity.folds), "started_ms": 0},
            params={name: str(value) for name, value in identity.params.items()},
            tags={**identity.tags, FINGERPRINT: key, "mlflow.runName": identity.name},
            metrics={"train_loss": 0.0} if history and history[0] is not None else {},
            fits=frozenset(fits),
            load={"history.csv": history[0] if history else None}.__getitem__,
            load_fit=estimators.__getitem__,
        )
        runs.append(replace(run, **changes))
    return runs


def study_of(name, estimators=("cnn",), **grid):
    settings = Grid(**{"method": 2, "real_gyros": [3], **grid})
    return Study(experiment=name, estimators=list(estimators), sensors={"sparkfun": settings})


as_stored = pytest.fixture(lambda: stored_runs, scope="session")
make_quality = pytest.fixture(lambda: quality_of, scope="session")
make_study = pytest.fixture(lambda: study_of, scope="session")
"""A study of one sensor: ``make_study(name, estimators, real_gyros=[...])``."""


@pytest.fixture(scope="session")
def make_bias(parameters):
    """The ground truth of recordings, from their Allan variances."""
    return lambda recordings, allan: measure_bias(recordings, allan, parameters().ground_truth)


@pytest.fixture(scope="session")
def make_world(parameters, make_bias):
    """A world of some recordings: ``make_world(recordings, study=...)``."""
    p = parameters(
        virtual_gyros={"recordings": 6, "train_recordings": 5},
        training={"epochs": 3, "stride": 5, "pool": 2, "channels": 2, "hidden": 4},
    )
    settings = ("training", "splits", "virtual_gyros")

    def make(recordings, **changes):
        allan = measure_allan_variance(recordings)
        given = {name: getattr(p, name) for name in settings} | {"study": study_of("some")}
        return World(recordings, allan, make_bias(recordings, allan), **given | changes)

    return make


@pytest.fixture(scope="session")
def world(make_recordings, make_world):
    """Two IMUs with 14 measured recordings, of which 8 train and 4 test, and 8 virtual IMUs."""
    generator = np.random.default_rng(5)
    bias = generator.uniform(-1, 1, (2, 1, 3)) + generator.normal(0, SPREAD, (2, 14, 3))
    recordings = make_recordings(bias, SAMPLES, RATE_HZ, NOISE, split=(8, 2, 4))
    study = study_of("augmentation", real_gyros=[3, 6], virtual_gyros=[0, 6])
    return make_world(recordings, study=study)


@pytest.fixture(scope="session")
def fitted(world):
    """The whole grid of the small world."""
    return world.train()


@pytest.fixture(scope="session")
def stored(fitted):
    """The same as the store gives it, waiting for its evaluation."""
    return stored_runs(fitted)
