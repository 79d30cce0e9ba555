"""Nodes of the evaluation stage."""

import logging
from collections.abc import Iterator, Mapping
from itertools import groupby, product
from typing import Any

import numpy as np
import pandas as pd
import xarray as xr

from gyro_pipeline.conventions import ALL, AXES, FIRST, MDPS, PAPER, TEST, TRUE
from gyro_pipeline.estimators import ORIENTATION_NOTE
from gyro_pipeline.estimators.base import Estimator
from gyro_pipeline.fingerprints import code_hash, data_hash, fingerprint
from gyro_pipeline.pipelines.evaluation.bench import Bench
from gyro_pipeline.pipelines.evaluation.ceilings import PREMISE
from gyro_pipeline.pipelines.evaluation.device import TestDevice, describe_devices
from gyro_pipeline.scoring.scorer import MISSING, Scores, read_scores
from gyro_pipeline.scoring.truths import CURVE_STEP_S
from gyro_pipeline.studies import MEAN, RunSpec, possible_runs
from gyro_pipeline.tracking import (
    CURVE,
    ERRORS,
    EVALUATED_WITH,
    SCORES,
    EvaluatedRun,
    StoredRun,
    by_fingerprint,
)

logger = logging.getLogger(__name__)

_CONFLICT = 1e-3  # p value; small, as several axes, sensors and window lengths are tested

METRICS = {
    "rmse_mdps": ("test_rmse_dps", "value", ALL),
    "mean_rmse_mdps": ("mean_rmse_dps", "value", ALL),
    "ceiling_rmse_mdps": ("ceiling_rmse_dps", "value", ALL),
    "accuracy_gain_pct": ("accuracy_gain_pct", "value", ALL),
    "accuracy_gain_pct_lo": ("accuracy_gain_pct", "lo", ALL),
    "accuracy_gain_pct_hi": ("accuracy_gain_pct", "hi", ALL),
    "time_saving_pct": ("time_saving_pct", "value", ALL),
    "equivalent_time_s": ("equivalent_time_s", "value", ALL),
    "coverage_95_pct": ("coverage_95_pct", "value", ALL),
    "accuracy_gain_pct_first": ("accuracy_gain_pct", "value", FIRST),
    "time_saving_pct_first": ("time_saving_pct", "value", FIRST),
}
"""Score, column and windows of each metric of a run, at the last epoch for the paper's truth.

They are for MLflow only; the report pools the errors of all seeds.
"""


def evaluate(
    plan: pd.DataFrame,
    runs: list[StoredRun],
    recordings: xr.Dataset,
    windows: pd.DataFrame,
    bias: pd.DataFrame,
    allan: xr.Dataset,
) -> Iterator[EvaluatedRun]:
    """Evaluate every run of the plan that was not evaluated with this code and data before.

    Args:
        plan: The runs that the study needs.
        runs: The study's runs on this sensor.
        recordings: Real recordings.
        windows: The windows table.
        bias: Ground truth.
        allan: Allan variances.

    Yields:
        Metrics, scores and the errors of each window, to be added to the run.
    """
    truths = [
        data_hash(pd.util.hash_pandas_object(bias, index=False).to_numpy(), None),
        data_hash(allan.allan_variance.load().to_numpy(), None),
    ]
    evaluated_with = fingerprint([code_hash(__name__), truths])
    specs, stored = possible_runs(plan), by_fingerprint(runs)
    pending = {
        key: spec
        for key, spec in sorted(specs.items(), key=lambda item: _windows_of(item[1]))
        if not (stored[key].finished and stored[key].tags.get(EVALUATED_WITH) == evaluated_with)
    }
    tables = dict(iter(windows.groupby(_WINDOWS, observed=True)))
    devices: dict[str, TestDevice] = {}  # the same for most windows
    for chosen, group in groupby(pending, key=lambda key: _windows_of(pending[key])):
        table = tables[chosen]
        tested = _tested(table)
        if tested not in devices:
            devices[tested] = describe_devices(recordings, bias, allan, table)
        columns = ["fold", "imu", "recording", "start"]
        tests = table[table.role == TEST][columns].astype({"fold": str})
        bench = Bench(recordings, devices[tested], tests, float(table.window_s.iloc[0]))
        for key in group:
            yield _evaluate_run(stored[key], pending[key], bench, evaluated_with)
    label = recordings.attrs["sensor"]
    logger.info("%s: %d runs evaluated, %d skipped", label, len(pending), len(specs) - len(pending))


_WINDOWS = ["protocol", "window_s", "window_stride_s"]
"""Fields of a run, and columns of the windows table, that choose the windows."""


def _windows_of(spec: RunSpec) -> tuple[Any, ...]:
    return tuple(getattr(spec, name) for name in _WINDOWS)


def _tested(table: pd.DataFrame) -> str:
    """A key that is equal for windows tables whose tested devices have the same description."""
    roles = table[["fold", "role", "origin", "imu", "recording"]].drop_duplicates()
    return fingerprint(roles.astype(str).to_numpy().tolist())


def _evaluate_run(run: StoredRun, spec: RunSpec, bench: Bench, evaluated_with: str) -> EvaluatedRun:
    fits = {fold: run.load_fit(fold) for fold in bench.tests.fold.unique()}
    first = next(iter(fits.values()))
    imus = spec.real_imus if spec.method == 1 else 1
    errors, tables = [], []
    for epoch in first.variants():
        variants: Mapping[str, Estimator] = {f: fit.variants()[epoch] for f, fit in fits.items()}
        of_epoch = bench.errors(variants, imus)
        errors.append(of_epoch.assign(weights=epoch))
        tables.append(bench.scores(of_epoch, epoch))
    table = pd.concat(tables, ignore_index=True)
    scores = read_scores(table)
    metrics = _metrics(scores)
    # the store cannot remove metrics of an earlier evaluation that are missing now
    metrics |= {name: np.nan for name in METRICS if name in run.metrics and name not in metrics}
    artifacts = {ERRORS: pd.concat(errors, ignore_index=True), SCORES: table}
    if spec.estimator == MEAN:
        artifacts[CURVE] = bench.curve
    tags = {EVALUATED_WITH: evaluated_with, "ceiling": bench.ceilings.basis}
    tags |= {"recommended": str(first.recommended)} | _off_the_curve(metrics)
    own_ceiling = max(fit.own_ceiling for fit in fits.values())
    tags |= {"own_ceiling": own_ceiling} | ceiling_warning(table, own_ceiling)
    if first.uses_prior:
        tags |= {"uses_prior": ORIENTATION_NOTE} | _conflict(scores, metrics, run)
    logger.info(
        "%s %s: RMSE %.4f mdps in all windows, %.4f in the first",
        *(run.study, run.tags["mlflow.runName"], metrics["rmse_mdps"]),
        scores["test_rmse_dps", FIRST].value / MDPS,
    )
    return EvaluatedRun(run.run_id, metrics, tags, artifacts)


def _metrics(scores: Scores) -> dict[str, float]:
    """The metrics of a run for which a score exists."""
    values = {
        name: getattr(scores.get((score, windows)), end, None)
        for name, (score, end, windows) in METRICS.items()
    }
    return {
        name: value / (MDPS if name.endswith("_mdps") else 1)
        for name, value in values.items()
        if value is not None
    }


def ceiling_warning(table: pd.DataFrame, own_ceiling: str = "") -> dict[str, str]:
    """A warning where the interval of a result lies entirely beyond that of the ceiling.

    Args:
        table: Scores from :meth:`gyro_pipeline.pipelines.evaluation.bench.Bench.scores`.
        own_ceiling: The ceiling of what the estimator uses, as of ``Estimator``; that of one axis
            where it was not computed.

    Returns:
        The tag ``beyond_ceiling``; empty without such a result.
    """
    beyond = []
    for truth, windows in product((PAPER, TRUE), (FIRST, ALL)):
        scores = read_scores(table, truth)
        axis_wise = "ceiling_accuracy_gain_pct", windows
        own = f"ceiling_{own_ceiling}_accuracy_gain_pct", windows
        gain = scores.get(("accuracy_gain_pct", windows), MISSING)
        ceiling = scores.get(own, scores.get(axis_wise, MISSING))
        if gain.lies_above(ceiling):
            beyond.append(f"{windows} windows, truth {truth}")
    if not beyond:
        return {}
    return {
        "beyond_ceiling": f"{'; '.join(beyond)}: the interval of A lies wholly beyond the ceiling, "
        f"by chance, because its premise does not hold ({PREMISE}), or because test information "
        "has reached the training"
    }


def _conflict(scores: Scores, metrics: Mapping[str, float], run: StoredRun) -> dict[str, str]:
    """A warning where test recordings contradict the prior, with the error of the mean."""
    chances = {axis: scores.get((f"prior_p_{axis}", ALL), MISSING).value for axis in AXES}
    axes = {axis: p for axis, p in chances.items() if p < _CONFLICT}
    if not axes:
        return {}
    listed = ", ".join(f"{axis} (p = {p:.1g})" for axis, p in axes.items())
    text = (
        f"test recordings contradict the prior on {listed}: the sensor was turned, or its bias has "
        f"drifted. RMSE {metrics['rmse_mdps']:.3g} mdps; the running mean gives "
        f"{metrics['mean_rmse_mdps']:.3g}"
    )
    logger.warning("%s %s: %s", run.study, run.tags["mlflow.runName"], text)
    return {"prior_conflict": text}


def _off_the_curve(metrics: Mapping[str, float]) -> dict[str, str]:
    """The reason why a run has no equivalent time."""
    if "rmse_mdps" not in metrics or np.isfinite(metrics.get("equivalent_time_s", np.nan)):
        return {}
    worse = metrics["rmse_mdps"] > metrics["mean_rmse_mdps"]
    return {
        "equivalent_time_s": f"worse than the running mean of {CURVE_STEP_S:g} s, where the curve "
        "starts"
        if worse
        else "the running mean never gets there"
    }
