"""The leak study's runs, pooled into one row per sensor, stride and way of training."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import pandas as pd

from gyro_pipeline.conventions import ALL, BEST, BEST_EPOCH_ON_TEST, LAST, PAPER
from gyro_pipeline.parameters import Sensor, Study, Training
from gyro_pipeline.pipelines.reporting.exhibits import LEAK_VARIANTS
from gyro_pipeline.pipelines.reporting.results import errors_of, planned_outcomes, with_ends
from gyro_pipeline.scoring.scorer import MISSING, Scorer, read_scores
from gyro_pipeline.scoring.scores import holm, paired_difference, squared_errors
from gyro_pipeline.studies import CONSTANT, MEAN, RunSpec
from gyro_pipeline.tracking import CURVE, SCORES, StoredRun

DETECTOR_PCT = 99
"""Confidence at which a network with shuffled labels must not beat the constant."""


def pool_leakage(
    study: Study, training: Training, sensors: dict[str, Any], **stored: Any
) -> dict[str, pd.DataFrame]:
    """Pool the leak study's runs into one row per sensor, stride and way of training.

    ``stored`` has the plan of each sensor, ``<sensor>_plan``, and its runs, ``<sensor>_runs``. The
    hop of the network, from ``study`` or ``training``, is a time where a sensor's rate is known.

    Returns:
        ``results``: sensor, stride and way of training; counts; scores over all test windows of all
        folds and seeds, with intervals over recordings; A of the constant; the mean square of the
        network less that of the constant, with the upper end of its 99 % interval; the p value
        against the oracle on simulated white noise, corrected over all rows; the ceiling; the
        stride in hops of the network; and run ids.
    """
    rows = []
    for sensor in [name.removesuffix("_plan") for name in stored if name.endswith("_plan")]:
        outcomes = planned_outcomes(stored[f"{sensor}_plan"], stored[f"{sensor}_runs"])
        runs = [(spec, run) for spec, run in outcomes.items() if isinstance(run, StoredRun)]
        rate_hz = Sensor(**sensors[sensor]).rate_hz
        hop_s = np.nan if rate_hz is None else study.training_of(training).hop / rate_hz
        for stride_s in dict.fromkeys(spec.window_stride_s for spec, _ in runs):
            of_stride = [(spec, run) for spec, run in runs if spec.window_stride_s == stride_s]
            rows += [row | {"hops": stride_s / hop_s} for row in _rows_of_stride(of_stride)]
    results = pd.DataFrame(rows)
    if results.empty:
        return {"results": results}
    checked = results.beats_oracle_p.notna()
    results.loc[checked, "beats_oracle_p"] = holm(results.beats_oracle_p[checked].tolist())
    return {"results": results}


def _rows_of_stride(stored: Sequence[tuple[RunSpec, StoredRun]]) -> list[dict[str, Any]]:
    """A row for each way of training, with its seeds pooled; none without mean and constant."""
    by_name = {spec.estimator: run for spec, run in stored}
    if not {MEAN, CONSTANT} <= by_name.keys():
        return []
    mean, constant, first = by_name[MEAN], by_name[CONSTANT], stored[0][0]
    scorer = Scorer(errors_of([mean]), mean.load(CURVE), first.window_s)
    shared = {
        name: getattr(first, name) for name in ("sensor", "source", "window_s", "window_stride_s")
    }
    rows = []
    for protocol, estimator in LEAK_VARIANTS:
        way = protocol, estimator
        runs = [run for spec, run in stored if (spec.protocol, spec.estimator) == way]
        if runs:
            epoch = BEST if protocol == BEST_EPOCH_ON_TEST else LAST
            name = {"estimator": estimator, "leak": protocol}
            rows.append(shared | name | _pooled(runs, epoch, scorer, constant))
    return rows


def _pooled(
    runs: Sequence[StoredRun], epoch: str, scorer: Scorer, constant: StoredRun
) -> dict[str, Any]:
    """Scores of a way of training at a stride, with its seeds pooled."""
    errors, constant_errors, view = errors_of(runs, epoch), errors_of([constant]), (PAPER, ALL)
    squares, of_constant = (squared_errors(table, *view) for table in (errors, constant_errors))
    gain = scorer.rmse_and_gain(of_constant, view)["accuracy_gain_pct"]
    difference = paired_difference(squares, of_constant, scorer.jackknife, DETECTOR_PCT)
    stored_scores = runs[0].load(SCORES)
    of_epoch, of_last = read_scores(stored_scores, epoch=epoch), read_scores(stored_scores)
    row: dict[str, Any] = {
        "simulated": runs[0].tags["simulated"] == "1",
        "windows": len(errors[["recording", "start"]].drop_duplicates()),
        "recordings": errors.recording.nunique(),
        "seeds": len(runs),
    }
    for name, estimate in scorer.scores(errors, view).items():
        row |= with_ends(name, estimate)
    row |= {
        "constant_accuracy_gain_pct": gain.value,
        "over_constant_dps2": difference.value,
        "over_constant_dps2_hi": difference.hi,
        "beats_oracle_p": of_epoch.get(("beats_oracle_p", ALL), MISSING).value,
    }
    for name in ("ceiling_time_saving_pct", "ceiling_accuracy_gain_pct"):
        row |= with_ends(name, of_last.get((name, ALL), MISSING))
    return row | {"run_ids": " ".join(run.run_id for run in runs)}
