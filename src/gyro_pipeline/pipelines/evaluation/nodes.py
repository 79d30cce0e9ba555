"""Nodes of the evaluation stage."""

import logging
from collections.abc import Iterator, Mapping

import pandas as pd
import xarray as xr

from gyro_pipeline.conventions import ALL, AXES, BEST, FIRST, LAST, TEST_IMU
from gyro_pipeline.estimators import (
    ORIENTATION_NOTE,
    Estimator,
    averages,
    base,
    linear,
    networks,
    shrinkage,
    training,
)
from gyro_pipeline.fingerprints import code_hash, fingerprint
from gyro_pipeline.learning import perceptrons
from gyro_pipeline.learning.jobs import NetworkEstimator
from gyro_pipeline.parameters import Evaluation
from gyro_pipeline.physics import allan as allan_module
from gyro_pipeline.physics import bias as bias_module
from gyro_pipeline.physics import ceiling, history, recording_model, reml
from gyro_pipeline.pipelines.evaluation import bench as bench_module
from gyro_pipeline.pipelines.evaluation import device as device_module
from gyro_pipeline.pipelines.evaluation import folds
from gyro_pipeline.pipelines.evaluation.bench import (
    Bench,
    known_places,
    known_recordings,
    off_the_curve,
    test_recordings,
)
from gyro_pipeline.pipelines.evaluation.device import describe_device, describe_unseen
from gyro_pipeline.pipelines.evaluation.folds import Fitted, FittedToOthers
from gyro_pipeline.pipelines.evaluation.waiting import waiting
from gyro_pipeline.protocol import scores, truths, windows
from gyro_pipeline.studies import MEAN, NETWORKS
from gyro_pipeline.tracking import (
    CURVE,
    ERRORS,
    EVALUATED_WITH,
    WEIGHTS,
    EvaluatedRun,
    StoredRun,
    metric_name,
)

logger = logging.getLogger(__name__)

_CODE = (
    *(allan_module, bias_module, ceiling, recording_model, reml, history),
    *(averages, base, linear, networks, perceptrons, shrinkage, training),
    *(bench_module, device_module, folds, scores, truths, windows),
)


def evaluate(
    cells: pd.DataFrame,
    runs: list[StoredRun],
    recordings: xr.Dataset,
    bias: pd.DataFrame,
    allan: xr.Dataset,
    roles: pd.DataFrame,
    evaluation: Evaluation,
    virtual: xr.Dataset | None = None,
) -> Iterator[EvaluatedRun]:
    """Judge every run of the plan that was not judged this way before.

    Args:
        cells: The plan.
        runs: The study's trained runs on this sensor.
        recordings: Real recordings.
        bias: Their ground truth.
        allan: Their Allan variances.
        roles: Which recordings test, in each fold.
        evaluation: Resamples and seed of the intervals.
        virtual: Virtual recordings, where the study uses some.

    Yields:
        Metrics and per-window errors, to be added to each run.
    """
    judged_with = fingerprint([code_hash(_CODE), evaluation.model_dump()])
    fitted: Fitted | FittedToOthers
    if "imu" in roles:  # every IMU in turn is an unseen device
        imus = tuple(sorted(roles.fold.unique().tolist()))
        fitted = FittedToOthers(recordings, roles)
        device = describe_unseen(recordings, allan, known_places(roles), imus)
    else:
        imus, seed = (TEST_IMU,), evaluation.bootstrap_seed
        fitted = Fitted(recordings, roles, virtual)
        device = describe_device(recordings, bias, allan, known_recordings(roles), seed)
    benches: dict[tuple[float, int], Bench] = {}
    for cell, run in waiting(cells, runs, judged_with, recordings.attrs["sensor"]):
        key = cell["window_s"], cell["fold"]
        if key not in benches:
            numbers = test_recordings(roles, cell["fold"])
            benches[key] = Bench(recordings, device, numbers, key[0], evaluation, imus)
        yield _judge(run, benches[key], fitted, judged_with)


def _judge(
    run: StoredRun, bench: Bench, fitted: Fitted | FittedToOthers, judged_with: str
) -> EvaluatedRun:
    artifacts = {}
    name = run.params["estimator"]
    real_imus, virtual_imus = (
        int(run.params[gyros]) // len(AXES) for gyros in ("real_gyros", "virtual_gyros")
    )
    if name not in NETWORKS:
        judged: dict[str, Estimator | Mapping[int, Estimator]]
        judged = {LAST: fitted.estimator(name, real_imus, virtual_imus)}
    else:
        stored = run.load(WEIGHTS)
        judged = {which: NetworkEstimator(stored, which) for which in (LAST, BEST) if stored[which]}
    if name == MEAN:
        artifacts[CURVE] = bench.curve
    side_by_side = real_imus if run.params["method"] == "1" else 1
    metrics: dict[str, float] = {}
    tables = []
    for which, estimator in judged.items():
        errors = bench.errors(estimator, side_by_side)
        metrics |= bench.metrics(errors, which)
        tables.append(errors.assign(weights=which))
    artifacts[ERRORS] = pd.concat(tables, ignore_index=True)
    tags = {EVALUATED_WITH: judged_with, "ceiling": bench.ceiling_basis}
    tags |= off_the_curve(metrics)
    marked = judged[LAST]
    if isinstance(marked, Mapping):
        marked = next(iter(marked.values()))
    tags["recommended"] = str(marked.recommended)
    if marked.uses_prior:
        tags["uses_prior"] = ORIENTATION_NOTE
    logger.info(
        "%s %s: RMSE %.7f deg/s in the first window, %.6f in all (last epoch)",
        *(run.study, _title(run)),
        *(metrics[metric_name("test_rmse_dps", windows)] for windows in (FIRST, ALL)),
    )
    return EvaluatedRun(run.run_id, metrics, tags, artifacts)


def _title(run: StoredRun) -> str:
    return run.tags["mlflow.runName"]
