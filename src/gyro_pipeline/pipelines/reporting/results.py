"""From tracked runs to one row per result: seeds pooled, with intervals."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache, cached_property
from itertools import groupby
from typing import Any

import numpy as np
import pandas as pd

from gyro_pipeline.conventions import ALL, BEST, FIRST, LAST, PAPER
from gyro_pipeline.estimators import DEFAULT, estimator_class
from gyro_pipeline.parameters import Evaluation, Splits, Study, Training, VirtualGyros
from gyro_pipeline.protocol.scores import (
    Estimate,
    SquaredErrors,
    WeightedCurve,
    clusters,
    curve_errors,
    leave_one_out,
    paired_difference,
    rmse_difference,
    score,
    squared_errors,
)
from gyro_pipeline.studies import CNN, MEAN, RunSpec, run_params, run_spec
from gyro_pipeline.tracking import CURVE, ERRORS, SCORES, StoredRun

ROW = ["sensor", "source", "estimator", "method", "real_gyros", "virtual_gyros", "window_s"]
"""What names a result."""

CNN_BEST = "cnn_best"
"""In a comparison of estimators: the paper's network at its best validation epoch."""

COVERAGES = ["coverage_1sigma_pct", "coverage_2sigma_pct"]

CEILINGS = ["ceiling_rmse_dps", "ceiling_time_saving_pct", "ceiling_accuracy_gain_pct"]


def column(score_name: str, windows: str = FIRST, bound: str = "") -> str:
    """Name of a column of results.

    Args:
        score_name: Such as ``test_rmse_dps``.
        windows: ``first`` or ``all``; the latter is named.
        bound: ``lo`` or ``hi`` for an end of the 95 % interval.
    """
    return "_".join([score_name, *([ALL] if windows == ALL else []), *([bound] if bound else [])])


@dataclass(frozen=True)
class Settings:
    """What the runs of a study must have been made with.

    Attributes:
        study, training, splits, virtual_gyros: The parameters.
        evaluation: Resamples and seed of the intervals.
    """

    study: Study
    training: Training
    splits: Splits
    virtual_gyros: VirtualGyros
    evaluation: Evaluation

    def spec(self, row: RunSpec) -> RunSpec:
        """The run that makes a row."""
        return run_spec(row, self.study.unseen_devices)

    def params(self, row: RunSpec) -> dict[str, str]:
        """Parameters of the run that makes a row, as the store has them, but how many folds."""
        spec = self.spec(row)
        made = run_params(spec, self.study, self.training, self.splits, self.virtual_gyros)
        return {name: str(value) for name, value in made.items() if name != "folds"}


def pool(
    rows: Iterable[Sequence[RunSpec]],
    runs: Sequence[StoredRun],
    settings: Settings,
    fingerprints: Mapping[RunSpec, str] | None = None,
) -> tuple[list[dict[str, Any]], dict[str, StoredRun]]:
    """Results of some rows.

    Args:
        rows: From :func:`rows_of`; the running mean of a window before others.
        runs: Finished ones count, newest first.
        settings: What they must have been made with.
        fingerprints: Of runs, by the last plans.

    Returns:
        A result for each row, with ``missing``, the command that makes it where its runs are not
        all there; and a run of the running mean by sensor.
    """
    evaluation = settings.evaluation
    results: list[dict[str, Any]] = []
    means: dict[tuple[str, float], RunningMeans] = {}
    defaults: dict[tuple[str, float], pd.DataFrame] = {}
    run_of = Finder(runs, settings, fingerprints)
    of_rows = [(row, run_of(row)) for row in rows]
    for seeds, found in of_rows:
        if found and seeds[0].estimator == DEFAULT:
            defaults[seeds[0].sensor, seeds[0].window_s] = _errors(found)
    for seeds, stored in of_rows:
        spec = seeds[0]
        key = spec.sensor, spec.window_s
        found = [replace(run, load=cache(run.load)) for run in stored]
        row = {name: getattr(spec, name) for name in ROW} | {"missing": None, "run_ids": None}
        if not found or (spec.estimator != MEAN and key not in means):
            results.append(row | {"missing": command_for(seeds)})
            continue
        if spec.estimator == MEAN:
            means[key] = RunningMeans(found[0], evaluation)
            row |= mean_row(found[0])
            if key in defaults:
                row |= differences(found, {DEFAULT: defaults[key]}, evaluation)
        else:
            row |= network_row(found, means[key], spec.window_s)
            if key in defaults:
                references = {MEAN: means[key].errors, DEFAULT: defaults[key]}
                row |= differences(found, references, evaluation)
        scores = scores_of(found[0])
        row |= {name: scores.get((name, ALL, "value")) for name in COVERAGES}
        tags = found[0].tags
        row["simulated"] = tags["simulated"] == "1"
        row["recommended"] = tags.get("recommended") == "True"
        row["uses_prior"] = "uses_prior" in tags
        row["folds"] = int(found[0].params["folds"])
        row["run_ids"] = " ".join(run.run_id for run in found)
        results.append(row)
        best = [best_epoch(run) for run in found if spec.estimator == CNN]
        if key in defaults and best and all(len(run.load(ERRORS)) for run in best):
            figures = network_row(best, means[key], spec.window_s)
            less = differences(best, references, evaluation)
            results.append(row | figures | less | {"estimator": CNN_BEST})
    return results, {sensor: mean.run for (sensor, _), mean in reversed(means.items())}


def scores_of(run: StoredRun) -> dict[tuple[str, str, str], float]:
    """Scores of a run at the last epoch against the paper's truth.

    Returns:
        By score, windows, and ``value``, ``lo`` or ``hi``; those that are there.
    """
    table = run.load(SCORES)
    table = table[(table.truth == PAPER) & (table.weights == LAST)]
    return {
        (row.score, row.windows, end): float(getattr(row, end))
        for row in table.itertuples()
        for end in ("value", "lo", "hi")
        if pd.notna(getattr(row, end))
    }


def best_epoch(run: StoredRun) -> StoredRun:
    """The run as if its weights at the best validation epoch had been its last ones."""
    errors = run.load(ERRORS)
    errors = errors[errors.weights == BEST].assign(weights=LAST)
    return replace(run, load={ERRORS: errors}.__getitem__)


def command_for(row: Sequence[RunSpec]) -> str:
    """The command that makes the runs of a row."""
    spec = row[0]
    only = {"sensor": spec.sensor, "window_s": f"{spec.window_s:g}"}
    if estimator_class(spec.estimator).uses in ("real", "all"):
        only |= {"real_gyros": str(spec.real_gyros), "virtual_gyros": str(spec.virtual_gyros)}
    if len(row) == 1 and estimator_class(spec.estimator).seeded:
        only["seed"] = str(spec.seed)
    params = ",".join(f"only.{key}={value}" for key, value in only.items())
    return f"kedro run --pipeline={spec.study} --params={params}"


def rows_of(specs: Sequence[RunSpec]) -> Iterator[list[RunSpec]]:
    """Specs that differ only in their seed: one row."""
    key = lambda spec: tuple(getattr(spec, name) for name in ROW)  # noqa: E731
    for _, group in groupby(specs, key):
        yield list(group)


class Finder:
    """Finds the finished runs that make rows: by their fingerprints, where a plan has them.

    Rows that the last plan left out, as a run was narrowed, are made by the newest runs with the
    parameters of today.

    Args:
        runs: Finished ones count, newest first.
        settings: What they must have been made with.
        planned: Fingerprints by the last plans.
    """

    def __init__(
        self,
        runs: Sequence[StoredRun],
        settings: Settings,
        planned: Mapping[RunSpec, str] | None = None,
    ) -> None:
        self._settings, self._planned = settings, planned or {}
        self._by_fingerprint = {run.fingerprint: run for run in reversed(runs) if run.finished}
        self._runs: dict[frozenset[tuple[str, str]], StoredRun] = {}
        for run in runs:
            if run.finished:
                params = {(key, value) for key, value in run.params.items() if key != "folds"}
                self._runs.setdefault(frozenset(params), run)

    def __call__(self, row: Sequence[RunSpec]) -> list[StoredRun]:
        """The runs of all seeds of a row; none if any is missing, or of other data."""
        specs = dict.fromkeys(self._settings.spec(one) for one in row)
        found = [run for spec in specs if (run := self._find(spec)) is not None]
        alike = len({run.tags["data_hash"] for run in found}) == 1
        return found if alike and len(found) == len(specs) else []

    def _find(self, spec: RunSpec) -> StoredRun | None:
        params = self._settings.params(spec)
        if spec in self._planned:
            planned = self._by_fingerprint.get(self._planned[spec])
            # the plan may be older than the settings; those of the splits may change nothing
            asked = {key: value for key, value in params.items() if key not in Splits.model_fields}
            if planned is None or asked.items() <= planned.params.items():
                return planned
        return self._runs.get(frozenset(params.items()))


def why_unused(run: StoredRun, specs: Sequence[RunSpec], settings: Settings) -> str:
    """Why a finished run that no result uses is not used.

    Args:
        run: It.
        specs: All rows of its study.
        settings: The current ones.
    """
    fields = {name: run.params.get(name) for name in RunSpec.names()}
    for spec in specs:
        expected = settings.params(spec)
        if all(expected[name] == value for name, value in fields.items()):
            changed = [
                f"{key} {run.params.get(key)}, now {expected.get(key)}"
                for key in sorted({*run.params, *expected} - {"folds"})
                if run.params.get(key) != expected.get(key)
            ]
            if changed:
                return "other settings: " + "; ".join(changed)
            return "a newer run, other data, or a result that is not complete"
    return "not in the study's grid"


def mean_row(mean: StoredRun) -> dict[str, Any]:
    """The result of the running mean, from its own run."""
    row: dict[str, Any] = {"recording_s": float(mean.load(CURVE).time_s.max())}
    scores, ends = scores_of(mean), {"value": "", "lo": "lo", "hi": "hi"}
    for windows in (ALL, FIRST):
        for name in ["test_rmse_dps", *CEILINGS]:
            for end, bound in ends.items():
                row[column(name, windows, bound)] = scores.get((name, windows, end))
    return row


@dataclass(frozen=True, eq=False)
class RunningMeans:
    """The running mean of one window, which all rows of that window are held against.

    Attributes:
        run: Its run.
        evaluation: Resamples and seed of the intervals.
    """

    run: StoredRun
    evaluation: Evaluation

    @cached_property
    def errors(self) -> pd.DataFrame:
        """Its errors."""
        return _errors([self.run])

    @cached_property
    def weights(self) -> np.ndarray:
        """Of recordings, or devices, in each resample."""
        return _resampled(self.errors, self.evaluation)

    @cached_property
    def squares(self) -> dict[str, SquaredErrors]:
        """Squared errors for all and for first windows."""
        return {windows: squared_errors(self.errors, PAPER, windows) for windows in (ALL, FIRST)}

    @cached_property
    def curves(self) -> dict[str, WeightedCurve]:
        """Its RMSE against its length, likewise."""
        curve = self.run.load(CURVE)
        curves = {windows: curve_errors(curve, PAPER, windows) for windows in (ALL, FIRST)}
        return {windows: curve.of(self.weights) for windows, curve in curves.items()}

    def scores(self, errors: pd.DataFrame, windows: str, window_s: float) -> dict[str, Estimate]:
        """Figures of merit of others' errors in the same windows."""
        own, reference = squared_errors(errors, PAPER, windows), self.squares[windows]
        return score(own, reference, self.curves[windows], window_s, self.weights)


def _resampled(errors: pd.DataFrame, evaluation: Evaluation) -> np.ndarray:
    return leave_one_out(clusters(errors).nunique())


def network_row(runs: Sequence[StoredRun], mean: RunningMeans, window_s: float) -> dict[str, Any]:
    """One row of a table: errors of all seeds pooled, networks at the last epoch.

    Args:
        runs: All seeds.
        mean: The running mean on the same recordings.
        window_s: T0, seconds.

    Returns:
        Figures of merit for all and for first windows, each with its interval over recordings of
        the squared errors averaged over seeds; the ceiling; T as ``recording_s``; and the standard
        deviation over the seeds' own figures (None for one seed).
    """
    errors = {seed: _errors(group) for seed, group in _by_seed(runs)}
    tested = mean.errors.get("imu", pd.Series(0, mean.errors.index))
    places = pd.DataFrame({"imu": tested, "recording": mean.errors.recording}).drop_duplicates()
    row: dict[str, Any] = {"seeds": len(errors), "recordings": len(places)}
    for windows in (ALL, FIRST):
        pooled = mean.scores(pd.concat(errors.values()), windows, window_s)
        of_seeds = errors.values() if len(errors) > 1 else ()
        single = [mean.scores(table, windows, window_s) for table in of_seeds]
        for base, estimate in pooled.items():
            row[column(base, windows)] = estimate.value
            row[column(base, windows, "lo")] = estimate.lo
            row[column(base, windows, "hi")] = estimate.hi
            values = [one[base].value for one in single]
            several = len(values) > 1 and np.isfinite(values).all()
            row[column(base, windows) + "_seed_sd"] = np.std(values, ddof=1) if several else None
    limits = mean_row(mean.run)
    return row | {k: v for k, v in limits.items() if k.startswith(("ceiling", "recording_s"))}


def differences(
    runs: Sequence[StoredRun], references: Mapping[str, pd.DataFrame], evaluation: Evaluation
) -> dict[str, Any]:
    """Errors less those of other estimators on all the same windows, paired over recordings.

    Args:
        runs: All seeds of the row.
        references: Errors by the names of the others.
        evaluation: Resamples and seed of the intervals.

    Returns:
        ``less_<name>_dps``, of the RMSEs against the mean of the recording, and
        ``less_<name>_dps2_<truth>``, of the mean squares against the other truths, whose own noise
        may leave none to take the root of. Each with its interval, ``_lo`` and ``_hi``.
    """
    table = _errors(runs)
    weights = _resampled(table, evaluation)
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


def _errors(runs: Sequence[StoredRun]) -> pd.DataFrame:
    tables = pd.concat([run.load(ERRORS) for run in runs])
    return tables[tables.weights == LAST]


def _by_seed(runs: Sequence[StoredRun]) -> Iterator[tuple[str, list[StoredRun]]]:
    key = lambda run: run.params["seed"]  # noqa: E731
    for seed, group in groupby(sorted(runs, key=key), key):
        yield seed, list(group)
