"""Nodes of the reporting stage: tracked runs to results, and what a report lacks."""

import logging
from collections.abc import Callable
from functools import wraps
from typing import Any

import pandas as pd

from gyro_pipeline.conventions import InputError, Missing
from gyro_pipeline.parameters import Evaluation, Only, Splits, Study, Training, VirtualGyros
from gyro_pipeline.pipelines.reporting.results import (
    ROW,
    find_runs,
    pool,
    pooled_curve,
    rows_of,
    why_unused,
)
from gyro_pipeline.studies import Cell, study_cells
from gyro_pipeline.tracking import StoredRun

logger = logging.getLogger(__name__)

Reasons = tuple[str, ...]

_CURVES = ["sensor", "windows", "time_s", "rmse_dps"]
_UNUSED = ["run_id", *Cell.names(), "why"]


def pool_results(  # noqa: PLR0913, PLR0917 - a node's arguments are its datasets
    study: Study,
    source: str,
    windows_s: list[float],
    seeds: list[int],
    training: Training,
    splits: Splits,
    virtual_gyros: VirtualGyros,
    evaluation: Evaluation,
    *tracked: list[StoredRun],
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
        *tracked: Runs by sensor.

    Returns:
        Results, a row per estimator, sensor, window and training set, ``missing`` holding the
        command that makes what is missing (else none); running-mean curves with columns
        ``sensor, windows, time_s, rmse_dps``; and the finished runs that no result uses, with
        columns ``run_id``, the fields of a cell, and ``why``.
    """
    runs = [run for sensor_runs in tracked for run in sensor_runs]
    settings = (training, splits, virtual_gyros)
    cells = _cells(study, source, windows_s, seeds)
    results, means = pool(rows_of(cells), runs, settings, evaluation)
    used = {run_id for row in results for run_id in (row["run_ids"] or "").split()}
    unused = [
        {"run_id": run.run_id, "why": why_unused(run, cells, settings)} | dict(run.params)
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
    settings = (training, splits, virtual_gyros)
    results = []
    for other in sorted({run.params["source"] for run in runs} - {source}):
        rows = []
        for row in rows_of(_cells(study, other, windows_s, seeds)):
            trained = [cell for cell in row if find_runs([cell], runs, settings)]
            rows += [trained] if find_runs(trained, runs, settings) else []
        results += [row for row in pool(rows, runs, settings, evaluation)[0] if row["run_ids"]]
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


def _cells(study: Study, source: str, windows_s: list[float], seeds: list[int]) -> list[Cell]:
    return [
        cell
        for sensor in study.sensors
        for cell in study_cells(study, sensor, source, windows_s, seeds, Only())
    ]
