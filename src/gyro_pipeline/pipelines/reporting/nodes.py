"""Nodes of the reporting stage: tracked runs to results, and what a report lacks."""

import logging
from collections.abc import Callable, Iterable
from functools import wraps
from typing import Any

import pandas as pd

from gyro_pipeline.conventions import InputError, Missing
from gyro_pipeline.parameters import Evaluation, Only, Splits, Study, Training, VirtualGyros
from gyro_pipeline.pipelines.reporting.results import (
    ROW,
    Finder,
    Settings,
    pool,
    pooled_curve,
    rows_of,
    why_unused,
)
from gyro_pipeline.studies import LEFT_OUT, RunSpec, planned, run_spec, study_rows
from gyro_pipeline.tracking import StoredRun

logger = logging.getLogger(__name__)

Reasons = tuple[str, ...]

_CURVES = ["sensor", "windows", "time_s", "rmse_dps"]
_UNUSED = ["run_id", *RunSpec.names(), "why"]


def pool_results(  # noqa: PLR0913, PLR0917 - a node's arguments are its datasets
    study: Study,
    source: str,
    windows_s: list[float],
    seeds: list[int],
    training: Training,
    splits: Splits,
    virtual_gyros: VirtualGyros,
    evaluation: Evaluation,
    **stored: Any,
) -> tuple[pd.DataFrame, pd.DataFrame, pd.DataFrame]:
    """Pool the study's tracked runs into one row per result.

    Args:
        study: Its whole grid, whatever ``only`` says: older runs count as long as their settings
            are the current ones.
        source: Only runs on logs from there.
        windows_s: Calibration times, seconds.
        seeds: All of them make up a row.
        training: Hyper-parameters that a run must have been made with.
        splits: Likewise.
        virtual_gyros: Likewise.
        evaluation: Resamples and seed of the intervals.
        **stored: For each sensor its runs, ``<sensor>_runs``, and the last plan of them,
            ``<sensor>_plan``, which says what cannot be made.

    Returns:
        Results, a row per estimator, sensor, window and training set, ``missing`` holding the
        command that makes what is missing (else none); running-mean curves with columns
        ``sensor, windows, time_s, rmse_dps``; and the finished runs that no result uses, with
        columns ``run_id``, those of a run's spec, and ``why``.
    """
    runs = [run for name, own in stored.items() if name.endswith("_runs") for run in own]
    settings = Settings(study, training, splits, virtual_gyros, evaluation)
    sensors = [name.removesuffix("_runs") for name in stored if name.endswith("_runs")]
    plans = [
        part
        for name, part in stored.items()
        if name.endswith("_plan") and isinstance(part, pd.DataFrame)
    ]
    left_out = _left_out(plans)
    fingerprints = {spec: key for plan in plans for key, spec in planned(plan).items()}
    specs = [
        spec
        for spec in _specs(study, sensors, source, windows_s, seeds)
        if run_spec(spec, study.unseen_devices) not in left_out
    ]
    results, means = pool(rows_of(specs), runs, settings, fingerprints)
    used = {run_id for row in results for run_id in (row["run_ids"] or "").split()}
    unused = [
        {"run_id": run.run_id, "why": why_unused(run, specs, settings)} | dict(run.params)
        for run in runs
        if run.finished and run.run_id not in used
    ]
    if unused:
        logger.info(
            "%s: %d older runs with other settings or data are in the store and not used",
            *(study.experiment, len(unused)),
        )
    curves = [pd.DataFrame(columns=_CURVES), *map(pooled_curve, means.values())]
    return (
        pd.DataFrame(results).assign(protocol=study.protocol),
        pd.concat(curves[1:] or curves),
        pd.DataFrame(unused, columns=_UNUSED),
    )


def pool_measured_elsewhere(  # noqa: PLR0913, PLR0917 - a node's arguments are its datasets
    study: Study,
    source: str,
    windows_s: list[float],
    seeds: list[int],
    training: Training,
    splits: Splits,
    virtual_gyros: VirtualGyros,
    evaluation: Evaluation,
    all_runs: list[StoredRun],
) -> pd.DataFrame:
    """Results on measured data of other sources, as far as they are there.

    Args:
        study: Its grid.
        source: The report's own, which is left out.
        windows_s: Calibration times, seconds.
        seeds: Those of them that were trained make up a row.
        training: Hyper-parameters that a run must have been made with.
        splits: Likewise.
        virtual_gyros: Likewise.
        evaluation: Resamples and seed of the intervals.
        all_runs: The study's runs on logs from anywhere.

    Returns:
        Rows like those of :func:`pool_results`, none of them missing; often no row at all.
    """
    runs = [run for run in all_runs if run.tags["simulated"] == "0"]
    settings = Settings(study, training, splits, virtual_gyros, evaluation)
    results, run_of = [], Finder(runs, settings)
    for other in sorted({run.params["source"] for run in runs} - {source}):
        sensors = study.sensors_among({run.params["sensor"] for run in runs})
        rows = []
        for row in rows_of(_specs(study, sensors, other, windows_s, seeds)):
            made = [spec for spec in row if run_of([spec])]
            rows += [made] if made and run_of(made) else []
        results += [row for row in pool(rows, runs, settings)[0] if row["run_ids"]]
    columns = None if results else [*ROW, "missing", "run_ids"]
    return pd.DataFrame(results, columns=columns).assign(protocol=study.protocol)


def or_missing(make: Callable[..., Any]) -> Callable[..., Any]:
    """Make a table or figure a node: what it makes, and the commands that make what it lacks.

    Args:
        make: Returns the table or figure, or :class:`Missing` where it finds no run for a result.
            It is not called if an input is Missing, a recording that is not there.
    """

    @wraps(make)
    def node(*inputs: Any, **named: Any) -> tuple[Any, Reasons]:
        given = [*inputs, *named.values()]
        lacking = [reason for one in given if isinstance(one, Missing) for reason in one.reasons]
        made = Missing(tuple(lacking)) if lacking else make(*inputs, **named)
        return made, made.reasons if isinstance(made, Missing) else ()

    return node


def missing_results(results: pd.DataFrame) -> Reasons:
    """Commands that make the results of a study that are not there."""
    return tuple(results.missing.dropna())


def refuse_gaps(only: Only, *reasons: Reasons) -> None:
    """Fail once all that can be written is written, naming the commands that make the rest.

    Args:
        only: A run that was narrowed on purpose does not fail.
        *reasons: What each table and figure lacks.

    Raises:
        InputError: If a run or a recording is missing.
    """
    commands = dict.fromkeys(command for missing in reasons for command in missing)
    if not commands:
        return
    if only != Only():
        logger.info(
            "narrowed by only: %d results or recordings are not there yet; "
            "`kedro run --pipeline=reporting` lists them",
            len(commands),
        )
        return
    raise InputError(
        f"{len(commands)} results or recordings are not there, or were made with other settings; "
        "tables and figures that need them were not made. Run (with this report's --env, if it has "
        "one)\n  " + "\n  ".join(commands)
    )


def _specs(
    study: Study, sensors: Iterable[str], source: str, windows_s: list[float], seeds: list[int]
) -> list[RunSpec]:
    return [
        spec
        for sensor in sensors
        for spec in study_rows(study, sensor, source, windows_s, seeds, Only())
    ]


def _left_out(plans: Iterable[pd.DataFrame]) -> set[RunSpec]:
    """Runs that cannot be made, by the last plans."""
    return {
        RunSpec(**{name: row[name] for name in RunSpec.names()})
        for plan in plans
        for row in plan[plan[LEFT_OUT].notna()].to_dict("records")
    }
