"""Nodes of the reporting stage: one function per table and figure."""

import logging
from collections.abc import Sequence
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from gyro_pipeline.conventions import ALL, FIRST, MDPS, PAPER, InputError, Missing
from gyro_pipeline.parameters import (
    Evaluation,
    Only,
    Published,
    Splits,
    Study,
    Training,
    VirtualGyros,
)
from gyro_pipeline.pipelines.reporting.figures import draw_augmentation
from gyro_pipeline.pipelines.reporting.results import (
    ROW,
    find_runs,
    mean_row,
    network_row,
    rows_of,
)
from gyro_pipeline.protocol.scores import curve_errors
from gyro_pipeline.studies import MEAN, Cell, study_cells
from gyro_pipeline.tracking import CURVE, StoredRun

logger = logging.getLogger(__name__)

Reasons = tuple[str, ...]


def pool_results(  # noqa: PLR0913 - a node's arguments are its datasets
    study: Study,
    source: str,
    windows_s: list[float],
    seeds: list[int],
    training: Training,
    splits: Splits,
    virtual_gyros: VirtualGyros,
    evaluation: Evaluation,
    *tracked: list[StoredRun],
) -> tuple[pd.DataFrame, pd.DataFrame]:
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
        command that makes what is missing (else none); and running-mean curves with columns
        ``sensor, windows, time_s, rmse_dps``.
    """
    runs = [run for sensor_runs in tracked for run in sensor_runs]
    settings = (training, splits, virtual_gyros)
    rows: list[dict[str, Any]] = []
    curves = []
    for sensor in study.sensors:
        cells = study_cells(study, sensor, source, windows_s, seeds, Only())
        means: dict[float, StoredRun] = {}
        for row_cells in rows_of(cells):
            cell = row_cells[0]
            found = find_runs(row_cells, runs, settings)
            row = {name: getattr(cell, name) for name in ROW} | {"missing": None, "run_ids": None}
            if not found or (cell.estimator != MEAN and cell.window_s not in means):
                rows.append(row | {"missing": command_for(row_cells)})
                continue
            if cell.estimator == MEAN:
                means[cell.window_s] = found[0]
                if len(means) == 1:
                    curves.append(_pooled_curve(found[0], sensor))
                row |= mean_row(found[0])
            else:
                row |= network_row(found, means[cell.window_s], cell.window_s, evaluation)
            row["simulated"] = found[0].tags["simulated"] == "1"
            row["run_ids"] = " ".join(run.run_id for run in found)
            rows.append(row)
    columns = ["sensor", "windows", "time_s", "rmse_dps"]
    none = pd.DataFrame(columns=columns)
    return pd.DataFrame(rows), pd.concat(curves)[columns] if curves else none


def command_for(cells: Sequence[Cell]) -> str:
    """The command that makes the runs of a row."""
    cell = cells[0]
    only = {"sensor": cell.sensor, "window_s": f"{cell.window_s:g}"}
    if cell.estimator != MEAN:
        only |= {"real_gyros": str(cell.real_gyros), "virtual_gyros": str(cell.virtual_gyros)}
    if len(cells) == 1 and cell.estimator != MEAN:
        only["seed"] = str(cell.seed)
    params = ",".join(f"only.{key}={value}" for key, value in only.items())
    return f"kedro run --pipeline={cell.study} --params={params}"


def results_table(results: pd.DataFrame) -> tuple[pd.DataFrame | Missing, Reasons]:
    """All results of a study that can be made, in mdps and percent; also printed.

    Args:
        results: From :func:`pool_results`, which keeps every figure and its interval.
    """
    reasons = tuple(results.missing.dropna())
    made = results[results.missing.isna()]
    if made.empty:
        return Missing(reasons), reasons
    table = made[
        ["sensor", "estimator", "method", "real_gyros", "virtual_gyros", "window_s"]
    ].copy()
    for windows in (ALL, FIRST):
        suffix = "" if windows == FIRST else f"_{windows}"
        table[f"RMSE {windows} mdps"] = (made[f"test_rmse_dps{suffix}"] / MDPS).round(3)
        for short, base in (("S", "time_saving_pct"), ("A", "accuracy_gain_pct")):
            if base + suffix in made:
                table[f"{short} {windows} %"] = made[base + suffix].round(0) + 0.0  # no "-0"
    table["ceiling mdps"] = (made.ceiling_rmse_dps / MDPS).round(3)
    logger.info("%s\n%s", _source(made.iloc[0]), table.to_string(index=False, na_rep="–"))
    table.insert(1, "source", [_source(row) for _, row in made.iterrows()])
    return table.assign(runs=made.run_ids.map(_short)), reasons


def three_gyroscopes(
    results: pd.DataFrame, published: list[dict[str, Any]]
) -> tuple[pd.DataFrame | Missing, Reasons]:
    """The paper's summary with three real gyroscopes (section IV-G, table of three gyroscopes)."""
    return _published_table(results, published, "three_gyroscopes")


def multiple_gyroscopes(
    results: pd.DataFrame, published: list[dict[str, Any]]
) -> tuple[pd.DataFrame | Missing, Reasons]:
    """The paper's summary with twelve real gyroscopes (section IV-G, table of MG results)."""
    return _published_table(results, published, "multiple_gyroscopes")


def sparkfun_3_real(
    results: pd.DataFrame, curves: pd.DataFrame, published: list[dict[str, Any]]
) -> tuple[Figure | Missing, Reasons]:
    """SparkFun, 3 real and virtual gyroscopes (paper, section IV-E, first figure)."""
    return _augmentation_figure(results, curves, published, "sparkfun", 3)


def sparkfun_12_real(
    results: pd.DataFrame, curves: pd.DataFrame, published: list[dict[str, Any]]
) -> tuple[Figure | Missing, Reasons]:
    """SparkFun, 12 real and virtual gyroscopes (paper, section IV-E, second figure)."""
    return _augmentation_figure(results, curves, published, "sparkfun", 12)


def dot_3_real(
    results: pd.DataFrame, curves: pd.DataFrame, published: list[dict[str, Any]]
) -> tuple[Figure | Missing, Reasons]:
    """Movella DOT, 3 real and virtual gyroscopes (paper, section IV-F, first figure)."""
    return _augmentation_figure(results, curves, published, "dot", 3)


def dot_12_real(
    results: pd.DataFrame, curves: pd.DataFrame, published: list[dict[str, Any]]
) -> tuple[Figure | Missing, Reasons]:
    """Movella DOT, 12 real and virtual gyroscopes (paper, section IV-F, second figure)."""
    return _augmentation_figure(results, curves, published, "dot", 12)


def refuse_gaps(only: Only, *reasons: Reasons) -> None:
    """Fail once all that can be written is written, naming the commands that make the rest.

    Args:
        only: A run that was narrowed on purpose does not fail.
        *reasons: Missing runs of each table and figure.

    Raises:
        InputError: If a run is missing.
    """
    commands = dict.fromkeys(command for missing in reasons for command in missing)
    if not commands:
        return
    if only != Only():
        logger.info(
            "narrowed by only: %d results of the whole studies have no runs yet; "
            "`kedro run --pipeline=reporting` lists them",
            len(commands),
        )
        return
    raise InputError(
        f"{len(commands)} results have no finished runs with the current settings; tables and "
        "figures that need them were not made. Run (with this report's --env, if it has one)\n  "
        + "\n  ".join(commands)
    )


def _published_table(
    results: pd.DataFrame, published: list[dict[str, Any]], table: str
) -> tuple[pd.DataFrame | Missing, Reasons]:
    wanted = [Published(**row) for row in published if row["table"] == table]
    found = [_find(results, row) for row in wanted]
    reasons = tuple(row.missing for row in found if pd.notna(row.missing))
    if reasons:
        return Missing(reasons), reasons
    return pd.DataFrame([_published_row(p, row) for p, row in zip(wanted, found, strict=True)]), ()


def _published_row(published: Published, row: pd.Series) -> dict[str, Any]:
    virtual = f" + {published.virtual_gyros} virtual" if published.virtual_gyros else ""
    seed_sd = row["accuracy_gain_pct_all_seed_sd"]
    return {
        "Approach": published.approach,
        "Sensor": row.sensor,
        "Source": _source(row),
        "Gyroscopes": f"{published.real_gyros} real{virtual}",
        "Published S/A %": f"{published.time_saving_pct:.0f}/{published.accuracy_gain_pct:.0f}",
        "S %": _interval(row, "time_saving_pct", ALL),
        "A %": _interval(row, "accuracy_gain_pct", ALL),
        "Paper's way S %": _interval(row, "time_saving_pct", FIRST),
        "Paper's way A %": _interval(row, "accuracy_gain_pct", FIRST),
        "Ceiling S %": _interval(row, "ceiling_time_saving_pct", FIRST),
        "Ceiling A %": _interval(row, "ceiling_accuracy_gain_pct", FIRST),
        "Seeds": int(row.seeds),
        "Spread of A over seeds": "–" if pd.isna(seed_sd) else f"{seed_sd:.1f}",
        "Recordings": int(row.recordings),
        "Runs": _short(row.run_ids),
    }


def _interval(row: pd.Series, base: str, windows: str) -> str:
    suffix = "" if windows == FIRST else f"_{windows}"
    value, lo, hi = (row[f"{base}{suffix}{end}"] for end in ("", "_lo", "_hi"))
    ends = "" if pd.isna(lo) else f" [{_percent(lo)}, {_percent(hi)}]"
    return f"{_percent(value)}{ends}"


def _percent(value: float) -> str:
    """A saving is unbounded off the ends of the running-mean curve."""
    if np.isinf(value):
        return "never reached" if value > 0 else "off the curve"
    return f"{round(value)}"


def _short(run_ids: str) -> str:
    """The first digits of each run id are enough to find it."""
    return " ".join(run_id[:8] for run_id in run_ids.split())


def _source(row: pd.Series) -> str:
    marked = "simulated" in row.source or not row.simulated
    return row.source if marked else f"{row.source} (simulated)"


def _find(results: pd.DataFrame, published: Published) -> pd.Series:
    keys = ["sensor", "real_gyros", "virtual_gyros", "window_s"]
    match = np.all([results[key] == getattr(published, key) for key in keys], axis=0)
    if not match.any():
        raise InputError(
            f"published result {published.approach!r} of {published.sensor} is no cell of its "
            "study; correct published or studies under conf/base/parameters"
        )
    return results[match].iloc[0]


def _augmentation_figure(
    results: pd.DataFrame,
    curves: pd.DataFrame,
    published: list[dict[str, Any]],
    sensor: str,
    real: int,
) -> tuple[Figure | Missing, Reasons]:
    of_sensor = results[results.sensor == sensor]
    shown = of_sensor[of_sensor.real_gyros.isin([0, real])]  # 0: the running mean
    reasons = tuple(shown.missing.dropna())
    if reasons:
        return Missing(reasons), reasons
    claims = [Published(**row) for row in published]
    claims = [p for p in claims if (p.sensor, p.real_gyros) == (sensor, real)]
    claims = list({p.virtual_gyros: p for p in claims if p.table.endswith("gyroscopes")}.values())
    return draw_augmentation(shown, curves[curves.sensor == sensor], claims), ()


def _pooled_curve(mean: StoredRun, sensor: str) -> pd.DataFrame:
    parts = []
    table = mean.load(CURVE)
    for windows in (FIRST, ALL):
        curve = curve_errors(table, PAPER, windows)
        mse = curve.squares.mean(np.ones((1, len(curve.squares.sums))))[0]
        parts.append(
            pd.DataFrame({"windows": windows, "time_s": curve.times_s, "rmse_dps": np.sqrt(mse)})
        )
    return pd.concat(parts).assign(sensor=sensor)
