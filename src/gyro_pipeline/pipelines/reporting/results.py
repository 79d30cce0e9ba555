"""Results from tracked runs: a row for each, with seeds pooled and intervals.

RMSE, S and A are computed from the stored errors of the windows, so that seeds are pooled.
Ceilings, oracle, constant, coverage and p values are read from the scores of the evaluation.
"""

import logging
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from functools import cache, cached_property
from itertools import groupby, product
from typing import Any

import numpy as np
import pandas as pd

from gyro_pipeline.conventions import ALL, AXES, BEST, FIRST, LAST, PAPER
from gyro_pipeline.estimators import DEFAULT
from gyro_pipeline.parameters import Only, Study
from gyro_pipeline.scoring.scorer import MISSING, Scorer, read_scores
from gyro_pipeline.scoring.scores import (
    Estimate,
    gain_difference,
    paired_difference,
    squared_errors,
)
from gyro_pipeline.studies import (
    CNN,
    CONSTANT,
    LEFT_OUT,
    MEAN,
    RunSpec,
    run_specs,
    study_rows,
)
from gyro_pipeline.tracking import CURVE, ERRORS, FINGERPRINT, SCORES, StoredRun, by_fingerprint

logger = logging.getLogger(__name__)

ROW = ["sensor", "source", "estimator", "method", "real_gyros", "virtual_gyros", "window_s"]
"""Columns that identify a result."""

NOT_RUN = "not run"
"""Status of a result without a finished run; a finished result has no status."""

CNN_BEST = "cnn_best"
"""The paper's network at its best validation epoch, if that was stored."""

CEILINGS = ["ceiling_rmse_dps", "ceiling_time_saving_pct", "ceiling_accuracy_gain_pct"]
CEILINGS += [f"ceiling_{name}_rmse_dps" for name in ("joint", "history")]
CEILINGS += [f"ceiling_{name}_accuracy_gain_pct" for name in ("joint", "history")]
BOUND_GAINS = ["oracle_accuracy_gain_pct", "constant_accuracy_gain_pct"]
"""A of the constant and, on simulated data, of the oracle on the same windows."""

OTHERS = ["coverage_1sigma_pct", "coverage_2sigma_pct", "beats_oracle_p"]
OTHERS += [f"prior_p_{axis}" for axis in AXES]
OTHERS += [f"turn_on_correlation_{axes}" for axes in ("xy", "xz", "yz")]
WARNINGS = ["beyond_ceiling", "prior_conflict"]
"""Tags of a run with a warning in words."""

COMPARED_WITH = (MEAN, DEFAULT, CONSTANT)
"""Estimators that every other one is compared with, in pairs over recordings."""

PAIRED_COUNTS = ("virtual_gyros", "real_gyros")
"""Counts of training gyroscopes whose effect on A is compared in pairs."""

_OF_THE_MEAN = ["test_rmse_dps", "oracle_rmse_dps", "constant_rmse_dps"]
_OF_THE_MEAN += [*BOUND_GAINS, *CEILINGS]
_CURVES = ["study", "sensor", "windows", "time_s", "rmse_dps"]


def column(name: str, windows: str) -> str:
    """Name of a column of results, as of metrics: the plain name of the score for all windows."""
    return f"{name}_{FIRST}" if windows == FIRST else name


def with_ends(name: str, estimate: Estimate) -> dict[str, float | None]:
    """Columns with an estimate, under its name, and with the ends of its interval."""
    return {name: estimate.value, f"{name}_lo": estimate.lo, f"{name}_hi": estimate.hi}


def pool_results(  # noqa: PLR0913, PLR0917 - a node's arguments are its datasets
    study: Study, source: str, windows_s: list[float], seeds: list[int], only: Only, **stored: Any
) -> dict[str, pd.DataFrame]:
    """Pool the planned runs of a study into one row per result.

    ``stored`` has the plan of each sensor, ``<sensor>_plan``, and its runs, ``<sensor>_runs``.

    Returns:
        ``results``, a row per estimator, sensor, window and training set, whose ``status`` says
        why there is no result; and ``curves`` of the running mean, with columns ``study,
        sensor, windows, time_s, rmse_dps``.
    """
    sensors = [name.removesuffix("_plan") for name in stored if name.endswith("_plan")]
    plan = pd.concat([stored[f"{sensor}_plan"] for sensor in sensors])
    runs = [run for sensor in sensors for run in stored[f"{sensor}_runs"] if run.finished]
    outcomes = planned_outcomes(plan, runs)
    results: list[dict[str, Any]] = []
    curves = [pd.DataFrame(columns=_CURVES)]
    for sensor in sensors:
        specs = study_rows(study, sensor, source, windows_s, seeds, only)
        cells = [
            Cell([spec for spec in specs if spec.window_s == window_s], study, outcomes)
            for window_s in dict.fromkeys(spec.window_s for spec in specs)
        ]
        results += [row for cell in cells for row in cell.results()]
        curves += [cell.curves() for cell in cells if cell.mean is not None][-1:]
    unused = len({run.fingerprint for run in runs} - {*plan[FINGERPRINT]})
    if unused:
        logger.info(
            "%s: %d finished runs with other settings or data are in the store and not used",
            *(study.experiment, unused),
        )
    return {"results": pd.DataFrame(results), "curves": pd.concat(curves[1:] or curves)}


def planned_outcomes(
    plan: pd.DataFrame, runs: Sequence[StoredRun]
) -> dict[RunSpec, StoredRun | str]:
    """The run of each planned spec, or why there is none; of several runs the first counts."""
    finished = [replace(run, load=cache(run.load)) for run in runs if run.finished]
    newest = by_fingerprint(finished)
    outcomes: dict[RunSpec, StoredRun | str] = {}
    for row in plan.fillna({LEFT_OUT: ""}).to_dict("records"):
        outcomes[RunSpec.of_row(row)] = row[LEFT_OUT] or newest.get(row[FINGERPRINT], NOT_RUN)
    return outcomes


@dataclass(frozen=True, eq=False)
class Cell:
    """The results of a sensor and window length, which share a running mean."""

    rows: Sequence[RunSpec]  # of the study, one for every seed, the running mean first
    study: Study
    outcomes: Mapping[RunSpec, StoredRun | str]  # from planned_outcomes

    @cached_property
    def _rows(self) -> list[tuple[RunSpec, list[StoredRun], str]]:
        """Each result by its first seed, with the runs of all seeds, or none and the reason."""
        rows = []
        for _, group in groupby(self.rows, lambda row: [getattr(row, name) for name in ROW]):
            seeds = list(group)
            # rows whose estimator uses the same part of the training set share a run
            needed = run_specs(seeds, self.study.unseen_devices)
            outcomes = [self.outcomes.get(spec, NOT_RUN) for spec in needed]
            runs = [outcome for outcome in outcomes if isinstance(outcome, StoredRun)]
            problem = next((outcome for outcome in outcomes if isinstance(outcome, str)), "")
            rows.append((seeds[0], [] if problem else runs, problem))
        return rows

    @cached_property
    def mean(self) -> StoredRun | None:
        """The run of the running mean; None if it is missing."""
        _, runs, _ = self._rows[0]
        return runs[0] if runs else None

    @cached_property
    def _errors_compared(self) -> dict[str, pd.DataFrame]:
        return {
            name: errors_of(runs)
            for name in COMPARED_WITH
            for spec, runs, _ in self._rows
            if runs and spec.estimator == name
        }

    @cached_property
    def _scorer(self) -> Scorer:
        assert self.mean is not None
        errors, curve = self._errors_compared[MEAN], self.mean.load(CURVE)
        return Scorer(errors, curve, self.rows[0].window_s)

    def results(self) -> list[dict[str, Any]]:
        """A result for each row; all need the running mean, which they are compared with."""
        results = []
        for spec, runs, problem in self._rows:
            name = {key: getattr(spec, key) for key in ("study", "protocol", *ROW)}
            if not runs or self.mean is None:
                results.append(name | {"status": problem or NOT_RUN, "run_ids": None})
                continue
            results.append(name | self._result(spec, runs) | self._added(spec, runs))
            if spec.estimator == CNN and all(len(errors_of([run], BEST)) for run in runs):
                results.append(results[-1] | self._pooled(runs, BEST) | {"estimator": CNN_BEST})
        return results

    def curves(self) -> pd.DataFrame:
        """RMSE of the running mean against its length, for first and for all windows."""
        parts, spec = [], self.rows[0]
        for windows in (FIRST, ALL):
            curve = self._scorer.curves[PAPER, windows]
            points = {"windows": windows, "time_s": curve.times_s, "rmse_dps": curve.rmse[0]}
            parts.append(pd.DataFrame(points))
        return pd.concat(parts).assign(study=spec.study, sensor=spec.sensor)[_CURVES]

    def _result(self, spec: RunSpec, runs: Sequence[StoredRun]) -> dict[str, Any]:
        """A row of results; ceilings, oracle and constant are those of the running mean."""
        assert self.mean is not None
        tags, scores = runs[0].tags, read_scores(runs[0].load(SCORES))
        row = mean_row(self.mean)
        row |= own_ceiling(row, tags.get("own_ceiling", ""))
        if spec.estimator != MEAN:
            row |= self._pooled(runs)
        elif DEFAULT in self._errors_compared:
            row |= self._differences(runs)
        return row | {
            **{name: scores.get((name, ALL), MISSING).value for name in OTHERS},
            **{
                name: next((run.tags[name] for run in runs if run.tags.get(name)), None)
                for name in WARNINGS
            },
            "simulated": tags["simulated"] == "1",
            "recommended": tags.get("recommended") == "True",
            "uses_prior": "uses_prior" in tags,
            "own_ceiling": tags.get("own_ceiling", ""),
            "folds": int(runs[0].params["folds"]),
            "status": None,
            "run_ids": " ".join(run.run_id for run in runs),
            "fingerprints": " ".join(sorted(run.fingerprint for run in runs)),
            **_provenance(runs),
        }

    def _pooled(self, runs: Sequence[StoredRun], epoch: str = LAST) -> dict[str, Any]:
        """Scores of all seeds pooled, with intervals over recordings.

        Squared errors are averaged over seeds; ``_seed_sd`` is the standard deviation of the scores
        of single seeds, None for one seed.
        """
        errors = [errors_of([run], epoch) for run in runs]
        places = self._errors_compared[MEAN].reindex(columns=["imu", "recording"], fill_value=0)
        row: dict[str, Any] = {"seeds": len(errors), "recordings": len(places.drop_duplicates())}
        for windows in (ALL, FIRST):
            pooled = self._scores(pd.concat(errors), windows)
            single = [self._scores(table, windows) for table in errors] if len(errors) > 1 else []
            for base, estimate in pooled.items():
                name = column(base, windows)
                row |= with_ends(name, estimate)
                values = [scores[base].value for scores in single]
                spread = np.std(values, ddof=1) if values and np.isfinite(values).all() else None
                row[f"{name}_seed_sd"] = spread
        return row | self._differences(runs, epoch)

    def _scores(self, errors: pd.DataFrame, windows: str) -> dict[str, Estimate]:
        view = PAPER, windows
        return self._scorer.scores(errors, view) | self._scorer.gains_by_axis(errors, view)

    def _added(self, spec: RunSpec, runs: Sequence[StoredRun]) -> dict[str, Any]:
        """A less the A with the fewest gyroscopes, all else equal: ``added_<count>_pct``.

        Differences are over all windows, paired over recordings, with all seeds together.
        """
        row: dict[str, Any] = {}
        for count in PAIRED_COUNTS if spec.estimator == CNN else ():
            without: dict[str, Any] = {count: 0}
            similar = [
                (getattr(row_spec, count), row_runs)
                for row_spec, row_runs, _ in self._rows
                if row_runs and replace(row_spec, **without) == replace(spec, **without)
            ]
            fewest, base_runs = min(similar, key=lambda pair: pair[0])
            if getattr(spec, count) > fewest:
                more, base = (squared_errors(errors_of(r), PAPER, ALL) for r in (runs, base_runs))
                mean = self._scorer.mean_squares[PAPER, ALL]
                change = gain_difference(more, base, mean, self._scorer.jackknife)
                row |= with_ends(f"added_{count}_pct", change)
        return row

    def _differences(self, runs: Sequence[StoredRun], epoch: str = LAST) -> dict[str, Any]:
        """Errors less those of the references on the same windows, paired over recordings.

        ``less_<name>_dps`` is a difference of RMSEs against the mean of the recording, and
        ``less_<name>_dps2_<truth>`` a difference of mean squares against another truth: less the
        noise of that truth, a mean square may be negative.
        """
        table = errors_of(runs, epoch)
        row: dict[str, Any] = {}
        for truth in table.truth.unique():
            squares = squared_errors(table, truth, ALL)
            for name, errors in self._errors_compared.items():
                pair = squares, squared_errors(errors, truth, ALL)
                difference = paired_difference(*pair, self._scorer.jackknife, root=truth == PAPER)
                key = f"less_{name}_dps" + ("" if truth == PAPER else f"2_{truth}")
                row |= with_ends(key, difference)
        return row


def _provenance(runs: Sequence[StoredRun]) -> dict[str, Any]:
    """Where, when and with which code runs were made, and whether files were uncommitted."""
    tags, newest = runs[0].tags, max(run.started_ms for run in runs)
    commit = tags.get("mlflow.source.git.commit", "")[:12] or "unknown"
    changed = " with uncommitted changes" if tags.get("git_dirty") == "True" else ""
    versions = f"gyro-pipeline {tags.get('gyro-pipeline')}, torch {tags.get('torch')}"
    return {
        "experiment_id": runs[0].experiment_id,
        "env": tags.get("kedro_env"),
        "started": f"{datetime.fromtimestamp(newest / 1000, UTC):%Y-%m-%d %H:%M}",
        "code": f"commit {commit}{changed}, {versions}",
        "epochs": runs[0].params.get("epochs"),
    }


def mean_row(mean: StoredRun) -> dict[str, Any]:
    """Errors and ceilings of a window length, from the run of its running mean."""
    row: dict[str, Any] = {"recording_s": float(mean.load(CURVE).time_s.max())}
    scores = read_scores(mean.load(SCORES))
    for windows, name in product((ALL, FIRST), _OF_THE_MEAN):
        row |= with_ends(column(name, windows), scores.get((name, windows), MISSING))
    return row


def own_ceiling(row: Mapping[str, Any], kind: str) -> dict[str, Any]:
    """The RMSE and A of the ceiling of what an estimator uses, if it was computed.

    Args:
        row: A row with all ceilings.
        kind: ``joint`` or ``history``; empty for the windows of one axis, as the row has it.
    """
    return {
        column(f"ceiling_{score}", windows) + end: value
        for windows, score, end in product(
            (ALL, FIRST), ("rmse_dps", "accuracy_gain_pct"), ("", "_lo", "_hi")
        )
        if (value := row.get(column(f"ceiling_{kind}_{score}", windows) + end)) is not None
    }


def errors_of(runs: Iterable[StoredRun], epoch: str = LAST) -> pd.DataFrame:
    """Errors of runs, one after the other, at the last or best epoch."""
    table = pd.concat([run.load(ERRORS) for run in runs])
    return table[table.weights == epoch]
