"""The leak study's runs, pooled into one row per sensor, stride and way of training."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import pandas as pd

from gyro_pipeline.conventions import ALL, BEST, BEST_EPOCH_ON_TEST, LAST, PAPER
from gyro_pipeline.parameters import Sensor, Study, Training
from gyro_pipeline.pipelines.reporting.results import errors_of, scores_of
from gyro_pipeline.pipelines.reporting.tables import WAYS
from gyro_pipeline.scoring.scores import (
    curve_errors,
    holm,
    leave_one_out,
    paired_difference,
    score,
    squared_errors,
)
from gyro_pipeline.studies import CONSTANT, MEAN, RunSpec, planned
from gyro_pipeline.tracking import CURVE, SCORES, StoredRun

DETECTOR_PCT = 99
"""Confidence at which a network with shuffled labels must not beat the constant."""

_CEILINGS = ("ceiling_time_saving_pct", "ceiling_accuracy_gain_pct")


def pool_leakage(
    study: Study, training: Training, sensors: dict[str, Any], **stored: Any
) -> dict[str, pd.DataFrame]:
    """Pool the leak study's runs into one row per sensor, stride and way of training.

    Args:
        study: Its network's hop.
        training: What the study does not change.
        sensors: Their rates, by which the hop is a time, where they are known.
        **stored: For each sensor its plan, ``<sensor>_plan``, and its runs, ``<sensor>_runs``.

    Returns:
        ``results``: what names a row; its counts; its figures of merit over all test windows of all
        folds and seeds, with intervals over recordings; A of the constant; by how much the
        network's mean square exceeds the constant's, with the upper end of its 99 % interval; the
        p value against the oracle, corrected over all rows, on simulated white noise; the ceiling;
        the stride in hops of the network; and run ids.
    """
    rows = []
    for sensor in [name.removesuffix("_plan") for name in stored if name.endswith("_plan")]:
        runs = {run.fingerprint: run for run in reversed(stored[f"{sensor}_runs"])}
        made = [(spec, runs[key]) for key, spec in planned(stored[f"{sensor}_plan"]).items()]
        rate_hz = Sensor(**sensors[sensor]).rate_hz
        hop_s = np.nan if rate_hz is None else study.training_of(training).hop / rate_hz
        for stride_s in dict.fromkeys(spec.window_stride_s for spec, _ in made):
            of_stride = [(spec, run) for spec, run in made if spec.window_stride_s == stride_s]
            of_ways = _rows_of_stride(of_stride)
            rows += [row | {"hops": stride_s / hop_s} for row in of_ways]
    results = pd.DataFrame(rows)
    checked = results.beats_oracle_p.notna()
    results.loc[checked, "beats_oracle_p"] = holm(results.beats_oracle_p[checked].tolist())
    return {"results": results}


def _rows_of_stride(made: Sequence[tuple[RunSpec, StoredRun]]) -> list[dict[str, Any]]:
    """A row for each way of training: all its seeds pooled."""
    by_name = {spec.estimator: run for spec, run in made}
    rows = []
    for way in WAYS:
        own = [(spec, run) for spec, run in made if (spec.protocol, spec.estimator) == way]
        if not own:
            continue
        names = ("sensor", "source", "window_s", "window_stride_s", "estimator")
        row = {name: getattr(own[0][0], name) for name in names} | {"leak": own[0][0].protocol}
        weights = BEST if own[0][0].protocol == BEST_EPOCH_ON_TEST else LAST
        runs = [run for _, run in own]
        rows.append(row | _pooled(runs, weights, by_name[MEAN], by_name[CONSTANT]))
    return rows


def _pooled(
    runs: Sequence[StoredRun], weights_of: str, mean: StoredRun, constant: StoredRun
) -> dict[str, Any]:
    """All seeds of one way of training at one stride."""
    errors, first = _ordered(runs, weights_of), runs[0]
    recordings = errors.recording.nunique()
    weights = leave_one_out(recordings)
    row: dict[str, Any] = {
        "simulated": first.tags["simulated"] == "1",
        "windows": len(errors.groupby(["recording", "start"])),
        "recordings": recordings,
        "seeds": len(runs),
    }
    tables = errors, _ordered([mean]), _ordered([constant])
    ours, of_mean, of_constant = (squared_errors(table, PAPER, ALL) for table in tables)
    curve = curve_errors(mean.load(CURVE), PAPER, ALL).of(weights)
    window_s = float(first.params["window_s"])
    for name, estimate in score(ours, of_mean, curve, window_s, weights).items():
        row |= {name: estimate.value, f"{name}_lo": estimate.lo, f"{name}_hi": estimate.hi}
    plain = weights[:1]
    ratio = np.sqrt(of_constant.mean(plain) / of_mean.mean(plain))[0]
    row["constant_accuracy_gain_pct"] = 100 * (1 - ratio)
    difference = paired_difference(ours, of_constant, weights, DETECTOR_PCT)
    row |= {"over_constant_dps2": difference.value, "over_constant_dps2_hi": difference.hi}
    row["beats_oracle_p"] = _oracle_p(first, weights_of)
    scores = scores_of(first)
    for name in _CEILINGS:
        for end, bound in (("value", ""), ("lo", "_lo"), ("hi", "_hi")):
            row[name + bound] = scores.get((name, ALL, end))
    return row | {"run_ids": " ".join(run.run_id for run in runs)}


def _ordered(runs: Sequence[StoredRun], weights: str = LAST) -> pd.DataFrame:
    """Errors against the mean of the recording, each run's in an order that all have."""
    tables = [errors_of([run], weights).query("truth == @PAPER") for run in runs]
    return pd.concat([table.sort_values(["recording", "start", "axis"]) for table in tables])


def _oracle_p(run: StoredRun, weights: str) -> float | None:
    scores = run.load(SCORES).set_index(["score", "windows", "truth", "weights"]).value
    value = scores.get(("beats_oracle_p", ALL, PAPER, weights))
    return None if value is None else float(value)
