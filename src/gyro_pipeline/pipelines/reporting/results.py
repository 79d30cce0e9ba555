"""From tracked runs to one row per result: folds and seeds pooled, with intervals."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import cache
from itertools import groupby
from typing import Any

import numpy as np
import pandas as pd

from gyro_pipeline.conventions import ALL, BEST, FIRST, HOLD_OUT, LAST, PAPER
from gyro_pipeline.estimators import DEFAULT
from gyro_pipeline.parameters import Evaluation
from gyro_pipeline.protocol.scores import (
    Estimate,
    curve_errors,
    paired_difference,
    resampled_weights,
    rmse_difference,
    score,
    squared_errors,
)
from gyro_pipeline.studies import CNN, MEAN, RESIDUAL_NETWORK, Cell, run_params
from gyro_pipeline.tracking import CURVE, ERRORS, StoredRun, metric_name

ROW = ["sensor", "source", "estimator", "method", "real_gyros", "virtual_gyros", "window_s"]
"""What names a result."""

CNN_BEST = "cnn_best"
"""In a comparison of estimators: the paper's network at its best validation epoch."""

COVERAGES = [metric_name(f"coverage_{sigmas}sigma", ALL) for sigmas in (1, 2)]

CEILINGS = ["ceiling_rmse_dps", "ceiling_time_saving_pct", "ceiling_accuracy_gain_pct"]


def pool(
    rows: Iterable[Sequence[Cell]],
    runs: Sequence[StoredRun],
    settings: tuple[Any, ...],
    evaluation: Evaluation,
) -> tuple[list[dict[str, Any]], dict[str, StoredRun]]:
    """Results of some rows.

    Args:
        rows: From :func:`rows_of`; the running mean of a window before its networks.
        runs: Finished ones count, newest first.
        settings: Training, splits and virtual-gyroscope parameters.
        evaluation: Resamples and seed of the intervals.

    Returns:
        A result for each row, with ``missing``, the command that makes it where its runs are not
        all there; and a run of the running mean by sensor.
    """
    results: list[dict[str, Any]] = []
    means: dict[tuple[str, float], StoredRun] = {}
    defaults: dict[tuple[str, float], pd.DataFrame] = {}
    found_rows = [(cells, find_runs(cells, runs, settings)) for cells in rows]
    for cells, found in found_rows:
        if found and cells[0].estimator == DEFAULT:
            defaults[cells[0].sensor, cells[0].window_s] = _errors(found)
    for cells, stored in found_rows:
        cell = cells[0]
        key = cell.sensor, cell.window_s
        found = [replace(run, load=cache(run.load)) for run in stored]
        row = {name: getattr(cell, name) for name in ROW} | {"missing": None, "run_ids": None}
        if not found or (cell.estimator != MEAN and key not in means):
            results.append(row | {"missing": command_for(cells)})
            continue
        if cell.estimator == MEAN:
            means[key] = found[0]
            row |= mean_row(found[0])
            if key in defaults:
                row |= differences(found, {DEFAULT: defaults[key]}, evaluation)
        else:
            row |= network_row(found, means[key], cell.window_s, evaluation)
            if key in defaults:
                references = {MEAN: _errors([means[key]]), DEFAULT: defaults[key]}
                row |= differences(found, references, evaluation)
        row |= {name: found[0].metrics.get(name) for name in COVERAGES}
        row["simulated"] = found[0].tags["simulated"] == "1"
        row["folds"] = int(found[0].params["folds"])
        row["run_ids"] = " ".join(run.run_id for run in found)
        results.append(row)
        if key in defaults and cell.estimator == CNN:
            best = [best_epoch(run) for run in found]
            scores = network_row(best, means[key], cell.window_s, evaluation)
            less = differences(best, references, evaluation)
            results.append(row | scores | less | {"estimator": CNN_BEST})
    return results, {sensor: mean for (sensor, _), mean in reversed(means.items())}


def best_epoch(run: StoredRun) -> StoredRun:
    """The run as if its weights at the best validation epoch had been its last ones."""
    errors = run.load(ERRORS)
    errors = errors[errors.weights == BEST].assign(weights=LAST)
    return replace(run, load={ERRORS: errors}.__getitem__)


def command_for(cells: Sequence[Cell]) -> str:
    """The command that makes the runs of a row."""
    cell = cells[0]
    only = {"sensor": cell.sensor, "window_s": f"{cell.window_s:g}"}
    if cell.estimator in (CNN, RESIDUAL_NETWORK):
        only |= {"real_gyros": str(cell.real_gyros), "virtual_gyros": str(cell.virtual_gyros)}
    if len(cells) == 1 and cell.estimator == CNN:
        only["seed"] = str(cell.seed)
    params = ",".join(f"only.{key}={value}" for key, value in only.items())
    return f"kedro run --pipeline={cell.study} --params={params}"


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
    folds = int(newest.params["folds"]) if cells[0].estimator == CNN else 1
    return found if len(found) == folds * len(cells) else []


def why_unused(run: StoredRun, cells: Sequence[Cell], settings: tuple[Any, ...]) -> str:
    """Why a finished run that no result uses is not used.

    Args:
        run: It.
        cells: All of its study.
        settings: The current ones, as in :func:`find_runs`.
    """
    cell = _cell(run.params)
    expected = run_params(cell, int(run.params["folds"]), *settings)
    changed = [
        f"{key} {run.params.get(key)}, now {expected.get(key)}"
        for key in sorted({*run.params, *expected})
        if run.params.get(key) != (str(expected[key]) if key in expected else None)
    ]
    if changed:
        return "other settings: " + "; ".join(changed)
    if replace(cell, fold=HOLD_OUT) not in cells:
        return "not in the study's grid"
    return "a newer run, other data, or a result that is not complete"


def mean_row(mean: StoredRun) -> dict[str, Any]:
    """The result of the running mean, from its own run."""
    row: dict[str, Any] = {"recording_s": float(mean.load(CURVE).time_s.max())}
    for windows in (ALL, FIRST):
        for base in ["test_rmse_dps", *CEILINGS]:
            for bound in ("", "lo", "hi"):
                name = metric_name(base, windows, truth=PAPER, bound=bound)
                row[name] = mean.metrics.get(name)
    return row


def network_row(
    runs: Sequence[StoredRun], mean: StoredRun, window_s: float, evaluation: Evaluation
) -> dict[str, Any]:
    """One row of a table: errors of all folds and seeds pooled, networks at the last epoch.

    Args:
        runs: All seeds and folds.
        mean: The running mean on the same recordings.
        window_s: T0, seconds.
        evaluation: Resamples and seed of the intervals.

    Returns:
        Figures of merit for all and for first windows, each with its interval over recordings of
        the squared errors averaged over seeds; the ceiling; T as ``recording_s``; and the standard
        deviation over the seeds' own figures (None for one seed).
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
                curve_errors(curve, PAPER, windows).of(weights),
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
    limits = mean_row(mean)
    return row | {k: v for k, v in limits.items() if k.startswith(("ceiling", "recording_s"))}


def differences(
    runs: Sequence[StoredRun], references: Mapping[str, pd.DataFrame], evaluation: Evaluation
) -> dict[str, Any]:
    """Errors less those of other estimators on all the same windows, paired over recordings.

    Args:
        runs: All seeds and folds of the row.
        references: Errors by the names of the others.
        evaluation: Resamples and seed of the intervals.

    Returns:
        ``less_<name>_dps``, of the RMSEs against the mean of the recording, and
        ``less_<name>_dps2_<truth>``, of the mean squares against the other truths, whose own noise
        may leave none to take the root of. Each with its interval, ``_lo`` and ``_hi``.
    """
    table = _errors(runs)
    weights = resampled_weights(
        table.recording.nunique(), evaluation.resamples, evaluation.bootstrap_seed
    )
    row: dict[str, Any] = {}
    for truth in table.truth.unique():
        own = squared_errors(table, truth, ALL)
        for name, errors in references.items():
            other = squared_errors(errors, truth, ALL)
            if truth == PAPER:
                less, key = rmse_difference(own, other, weights), f"less_{name}_dps"
            else:
                less, key = paired_difference(own, other, weights), f"less_{name}_dps2_{truth}"
            row |= {key + end: value for end, value in _ends(less).items()}
    return row


def _ends(estimate: Estimate) -> dict[str, float | None]:
    return {"": estimate.value, "_lo": estimate.lo, "_hi": estimate.hi}


def pooled_curve(mean: StoredRun) -> pd.DataFrame:
    """RMSE of the running mean against its length, for first and for all windows.

    Args:
        mean: Its run.

    Returns:
        Columns ``sensor, windows, time_s, rmse_dps``.
    """
    parts = []
    table = mean.load(CURVE)
    for windows in (FIRST, ALL):
        curve = curve_errors(table, PAPER, windows)
        mse = curve.squares.mean(np.ones((1, len(curve.squares.sums))))[0]
        parts.append(
            pd.DataFrame({"windows": windows, "time_s": curve.times_s, "rmse_dps": np.sqrt(mse)})
        )
    pooled = pd.concat(parts)
    pooled.insert(0, "sensor", mean.params["sensor"])
    return pooled


def _cell(params: Mapping[str, str]) -> Cell:
    """The cell that a run is of; parameters of stored runs are texts."""
    given: dict[str, Any] = {name: params[name] for name in Cell.names()}
    whole = ("method", "real_gyros", "virtual_gyros", "seed", "fold")
    return Cell(
        **given
        | {name: int(given[name]) for name in whole}
        | {"window_s": float(given["window_s"])}
    )


def _errors(runs: Sequence[StoredRun]) -> pd.DataFrame:
    tables = pd.concat([run.load(ERRORS) for run in runs])
    return tables[tables.weights == LAST]


def _by_seed(runs: Sequence[StoredRun]) -> Iterator[tuple[str, list[StoredRun]]]:
    key = lambda run: run.params["seed"]  # noqa: E731
    for seed, group in groupby(sorted(runs, key=key), key):
        yield seed, list(group)
