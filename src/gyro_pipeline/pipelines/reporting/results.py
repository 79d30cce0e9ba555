"""From tracked runs to one row per result: folds and seeds pooled, with intervals."""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import groupby
from typing import Any

import numpy as np
import pandas as pd

from gyro_pipeline.conventions import ALL, FIRST, LAST, PAPER
from gyro_pipeline.parameters import Evaluation
from gyro_pipeline.protocol.scores import (
    Estimate,
    curve_errors,
    resampled_weights,
    score,
    squared_errors,
)
from gyro_pipeline.studies import MEAN, Cell, run_params
from gyro_pipeline.tracking import CURVE, ERRORS, StoredRun, metric_name

ROW = ["sensor", "source", "estimator", "method", "real_gyros", "virtual_gyros", "window_s"]
"""What names a result."""

CEILINGS = ["ceiling_rmse_dps", "ceiling_time_saving_pct", "ceiling_accuracy_gain_pct"]


def rows_of(cells: Sequence[Cell]) -> Iterator[list[Cell]]:
    """Cells that differ only in their seed: one row."""
    key = lambda cell: tuple(getattr(cell, name) for name in ROW)  # noqa: E731
    for _, group in groupby(cells, key):
        yield list(group)


def find_runs(
    cells: Sequence[Cell], runs: Sequence[StoredRun], settings: tuple[Any, ...]
) -> list[StoredRun]:
    """The newest finished run of every seed and fold of a row, made with the current settings.

    Args:
        cells: One per seed.
        runs: Finished ones count, newest first.
        settings: Training, splits and virtual-gyroscope parameters.

    Returns:
        All runs of the row, on one version of the data; empty if any is missing.
    """
    chosen: dict[tuple[int, int], StoredRun] = {}
    for cell in cells:
        for run in runs:
            if not run.finished or run.params["estimator"] != cell.estimator:
                continue
            fold, folds = int(run.params["fold"]), int(run.params["folds"])
            expected = run_params(replace(cell, fold=fold), folds, *settings)
            if {key: str(value) for key, value in expected.items()} == dict(run.params):
                chosen.setdefault((cell.seed, fold), run)
    if not chosen:
        return []
    newest = max(chosen.values(), key=lambda run: run.started_ms)
    found = [r for r in chosen.values() if r.tags["data_hash"] == newest.tags["data_hash"]]
    folds = 1 if cells[0].estimator == MEAN else int(newest.params["folds"])
    return found if len(found) == folds * len(cells) else []


def mean_row(mean: StoredRun) -> dict[str, Any]:
    """The result of the running mean, from its own run."""
    row: dict[str, Any] = {}
    for windows in (ALL, FIRST):
        for base in ["test_rmse_dps", *CEILINGS]:
            for bound in ("", "lo", "hi"):
                name = metric_name(base, windows, truth=PAPER, bound=bound)
                row[name] = mean.metrics.get(name)
    return row


def network_row(
    runs: Sequence[StoredRun], mean: StoredRun, window_s: float, evaluation: Evaluation
) -> dict[str, Any]:
    """One row of a table: errors of all folds and seeds pooled, judged at the last epoch.

    Args:
        runs: All seeds and folds.
        mean: The running mean on the same recordings.
        window_s: T0, seconds.
        evaluation: Resamples and seed of the intervals.

    Returns:
        Figures of merit for all and for first windows with intervals over recordings, the
        ceiling, and the standard deviation over seeds (None for one seed).
    """
    errors = {seed: _errors(group) for seed, group in _by_seed(runs)}
    mean_errors, curve = mean.load(ERRORS), mean.load(CURVE)
    resampled = resampled_weights(
        mean_errors.recording.nunique(), evaluation.resamples, evaluation.bootstrap_seed
    )
    row: dict[str, Any] = {"seeds": len(errors), "recordings": mean_errors.recording.nunique()}
    for windows in (ALL, FIRST):

        def scores(
            table: pd.DataFrame, weights: np.ndarray, windows: str = windows
        ) -> dict[str, Estimate]:
            return score(
                squared_errors(table, PAPER, windows),
                squared_errors(mean_errors, PAPER, windows),
                curve_errors(curve, PAPER, windows),
                window_s,
                weights,
            )

        pooled = scores(pd.concat(errors.values()), resampled)
        single = [scores(table, resampled[:1]) for table in errors.values()]
        for base, estimate in pooled.items():
            row[metric_name(base, windows)] = estimate.value
            row[metric_name(base, windows, bound="lo")] = estimate.lo
            row[metric_name(base, windows, bound="hi")] = estimate.hi
            values = [one[base].value for one in single]
            several = len(values) > 1 and np.isfinite(values).all()
            row[metric_name(base, windows) + "_seed_sd"] = (
                np.std(values, ddof=1) if several else None
            )
    ceilings = mean_row(mean)
    return row | {name: value for name, value in ceilings.items() if name.startswith("ceiling")}


def _errors(runs: Sequence[StoredRun]) -> pd.DataFrame:
    tables = pd.concat([run.load(ERRORS) for run in runs])
    return tables[tables.weights == LAST]


def _by_seed(runs: Sequence[StoredRun]) -> Iterator[tuple[str, list[StoredRun]]]:
    key = lambda run: run.params["seed"]  # noqa: E731
    for seed, group in groupby(sorted(runs, key=key), key):
        yield seed, list(group)
