"""The leak study's table and figure, from its own runs alone."""

import logging
from collections.abc import Sequence
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from gyro_pipeline.conventions import (
    ALL,
    BEST,
    BEST_EPOCH_ON_TEST,
    K_FOLD,
    LAST,
    PAPER,
    TEST_IN_TRAINING,
    WINDOW_SPLIT,
)
from gyro_pipeline.parameters import (
    Evaluation,
    Published,
    PublishedResult,
    Sensor,
    Study,
    Training,
)
from gyro_pipeline.pipelines.reporting.results import scores_of
from gyro_pipeline.pipelines.reporting.style import CEILING, COLOURS, LOOK, MARKERS, share_legend
from gyro_pipeline.pipelines.reporting.tables import percent, source_of
from gyro_pipeline.protocol.scores import (
    curve_errors,
    holm,
    leave_one_out,
    paired_difference,
    score,
    squared_errors,
)
from gyro_pipeline.studies import CNN, CNN_SHUFFLED, CONSTANT, MEAN, RunSpec, planned
from gyro_pipeline.tracking import CURVE, ERRORS, SCORES, StoredRun

logger = logging.getLogger(__name__)

WAYS = {
    (K_FOLD, CNN): "Honest split",
    (K_FOLD, CNN_SHUFFLED): "Honest, labels shuffled",
    (WINDOW_SPLIT, CNN): "Windows split at random",
    (TEST_IN_TRAINING, CNN): "Test windows in training",
    (BEST_EPOCH_ON_TEST, CNN): "Honest split, epoch chosen on test",
}
"""What tables and figures call each way of training, in their order."""

DETECTOR_PCT = 99
"""Confidence at which a network with shuffled labels must not beat the constant."""

ONE_SIDED = 0.001
"""A p value against the oracle below this, corrected for the number of checks, is a leak."""

_SHIFT = 0.09
"""Between the points of one stride."""

_WHOLE = 0.01
"""So near to a whole number of hops, a stride is one."""

_CEILINGS = ("ceiling_time_saving_pct", "ceiling_accuracy_gain_pct")


def pool_leakage(evaluation: Evaluation, **stored: Any) -> pd.DataFrame:
    """Pool the leak study's runs into one row per sensor, stride and way of training.

    Args:
        evaluation: Resamples and seed of the intervals.
        **stored: For each sensor its plan, ``<sensor>_plan``, and its runs, ``<sensor>_runs``.

    Returns:
        What names a row; its counts; its figures of merit over all test windows of all folds and
        seeds, with intervals over recordings; A of the constant; by how much the network's mean
        square exceeds the constant's, with the upper end of its 99 % interval; the p value against
        the oracle, corrected over all rows, on simulated white noise; the ceiling; and run ids.
    """
    rows = []
    for sensor in [name.removesuffix("_plan") for name in stored if name.endswith("_plan")]:
        runs = {run.fingerprint: run for run in reversed(stored[f"{sensor}_runs"])}
        made = [(spec, runs[key]) for key, spec in planned(stored[f"{sensor}_plan"]).items()]
        for stride_s in dict.fromkeys(spec.window_stride_s for spec, _ in made):
            of_stride = [(spec, run) for spec, run in made if spec.window_stride_s == stride_s]
            rows += _rows_of_stride(of_stride, evaluation)
    results = pd.DataFrame(rows)
    checked = results.beats_oracle_p.notna()
    results.loc[checked, "beats_oracle_p"] = holm(results.beats_oracle_p[checked].tolist())
    return results


def _rows_of_stride(
    made: Sequence[tuple[RunSpec, StoredRun]], evaluation: Evaluation
) -> list[dict[str, Any]]:
    """A row for each way of training: all its seeds pooled."""
    by_name = {spec.estimator: run for spec, run in made}
    mean, constant = by_name[MEAN], _errors(by_name[CONSTANT])
    ways = dict.fromkeys((spec.protocol, spec.estimator) for spec, _ in made)
    rows = []
    for protocol, estimator in (way for way in ways if way in WAYS):
        own = [
            (spec, run)
            for spec, run in made
            if (spec.protocol, spec.estimator) == (protocol, estimator)
        ]
        spec, runs = own[0][0], [run for _, run in own]
        rows.append(
            {
                "sensor": spec.sensor,
                "source": spec.source,
                "window_s": spec.window_s,
                "window_stride_s": spec.window_stride_s,
                "leak": protocol,
                "estimator": estimator,
            }
            | _pooled(
                runs, BEST if protocol == BEST_EPOCH_ON_TEST else LAST, mean, constant, evaluation
            )
        )
    return rows


def _errors(run: StoredRun, weights: str = LAST) -> pd.DataFrame:
    """Errors in the test windows against the mean of the recording, an order for all runs."""
    errors = run.load(ERRORS)
    errors = errors[(errors.weights == weights) & (errors.truth == PAPER)]
    return errors.sort_values(["recording", "start", "axis"], ignore_index=True)


def _pooled(
    runs: Sequence[StoredRun],
    weights_of: str,
    mean: StoredRun,
    constant: pd.DataFrame,
    evaluation: Evaluation,
) -> dict[str, Any]:
    """All seeds of one way of training at one stride."""
    errors = pd.concat([_errors(run, weights_of) for run in runs], ignore_index=True)
    recordings, first = errors.recording.nunique(), runs[0]
    weights = leave_one_out(recordings)
    row: dict[str, Any] = {
        "simulated": first.tags["simulated"] == "1",
        "windows": len(errors.groupby(["recording", "start"])),
        "recordings": recordings,
        "seeds": len(runs),
    }
    ours, of_mean, of_constant = (
        squared_errors(table, PAPER, ALL) for table in (errors, _errors(mean), constant)
    )
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


def _oracle_p(run: StoredRun, weights: str) -> float | None:
    scores = run.load(SCORES)
    chosen = scores[
        (scores.score == "beats_oracle_p")
        & (scores.windows == ALL)
        & (scores.truth == PAPER)
        & (scores.weights == weights)
    ]
    return float(chosen.value.iloc[0]) if len(chosen) else None


def results_table(results: pd.DataFrame, published: Published) -> pd.DataFrame:
    """The leak study: S and A of each way of training, side by side for each stride.

    Args:
        results: From :func:`pool_leakage`.
        published: The paper's claim for the sensor, beside them.
    """
    rows = [
        _table_row(group.set_index(["leak", "estimator"]), published)
        for _, group in results.groupby(["sensor", "window_stride_s"], sort=False)
    ]
    table = pd.DataFrame(rows)
    logger.info("leak study, S/A %%\n%s", table.to_string(index=False, na_rep="–"))
    return table


def _table_row(ways: pd.DataFrame, published: Published) -> dict[str, Any]:
    first = ways.iloc[0]
    row: dict[str, Any] = {
        "Sensor": first.sensor,
        "Source": source_of(first),
        "Window stride s": first.window_stride_s,
        "Windows": first.windows,
        "Recordings": first.recordings,
    }
    for way, name in WAYS.items():
        row[f"{name} S/A %"] = _saving_and_gain(ways, way)
    shuffled = ways[ways.index.get_level_values("estimator") == CNN_SHUFFLED]
    better = bool((shuffled.over_constant_dps2_hi < 0).any())
    caught = ways.beats_oracle_p.dropna()
    beating = [WAYS[way] for way in caught.index[caught < ONE_SIDED]]
    return row | {
        "Constant A %": percent(first.constant_accuracy_gain_pct),
        "Ceiling S/A %": _pair(first, *_CEILINGS),
        "Published S/A %": _claim(first, published),
        "Shuffled beats the constant": "yes" if better else "no",
        "Beats the oracle": "; ".join(beating) or ("none" if len(caught) else "not known"),
    }


def accuracy_against_stride(
    results: pd.DataFrame,
    published: Published,
    study: Study,
    training: Training,
    sensors: dict[str, Any],
) -> Figure:
    """A against the window stride, for the honest split and for each leak.

    Args:
        results: From :func:`pool_leakage`.
        published: The paper's gain.
        study: Its network's hop.
        training: What the study does not change.
        sensors: Their rates, by which the hop is a time, where they are known.
    """
    names = list(dict.fromkeys(results.sensor))
    with LOOK():
        figure = Figure(figsize=(9.5, 1.2 + 4.4 * len(names)), layout="constrained")
        axes = figure.subplots(len(names), 1, squeeze=False)[:, 0]
        for ax, sensor in zip(axes, names, strict=True):
            rate_hz = Sensor(**sensors[sensor]).rate_hz
            hop_s = np.nan if rate_hz is None else study.training_of(training).hop / rate_hz
            _draw(ax, results[results.sensor == sensor], published, hop_s)
        share_legend(figure, axes, columns=3)
    return figure


def _draw(ax: Axes, results: pd.DataFrame, published: Published, hop_s: float) -> None:
    first, strides = results.iloc[0], np.sort(results.window_stride_s.unique())
    styles = [*zip(COLOURS, MARKERS, strict=True), ("grey", "x")]
    ways = sorted(WAYS.items(), key=lambda way: way[0][1] == CNN_SHUFFLED)  # it comes last
    for i, ((leak, estimator), name) in enumerate(ways):
        rows = results[(results.leak == leak) & (results.estimator == estimator)]
        rows = rows.sort_values("window_stride_s")
        gain, lo, hi = (rows[f"accuracy_gain_pct{end}"] for end in ("", "_lo", "_hi"))
        ax.errorbar(
            np.searchsorted(strides, rows.window_stride_s) + _SHIFT * (i - len(ways) // 2),
            gain,
            yerr=np.maximum([gain - lo, hi - gain], 0),
            color=styles[i][0],
            marker=styles[i][1],
            ls=":" if estimator == CNN_SHUFFLED else "-",
            lw=1,
            ms=5,
            capsize=2.5,
            label=name,
        )
    limit, claim = first.ceiling_accuracy_gain_pct, _claimed(first, published)
    ax.axhline(limit, color=CEILING, ls="--", label="ceiling: expected of the best possible")
    ax.axhline(0, color="black", lw=1, label="running mean")
    if claim is not None:
        label = f"published, {claim.real_gyros} gyroscopes"
        ax.axhline(claim.accuracy_gain_pct, color="black", ls=":", label=label)
    ax.set_xticks(np.arange(len(strides)), [_stride_label(s, hop_s) for s in strides])
    ax.grid(False, axis="x")
    ax.set(
        xlabel="window stride [s], ways of one stride side by side",
        ylabel="accuracy gain A in the test windows [%]",
        title=f"{first.sensor}, {first.window_s:g} s windows of {first.recordings} recordings; "
        f"{source_of(first)}; 95 % intervals",
    )


def _stride_label(stride_s: float, hop_s: float) -> str:
    hops = stride_s / hop_s
    if np.isnan(hops):
        return f"{stride_s:g}"
    whole = abs(hops - round(hops)) < _WHOLE
    return f"{stride_s:g}\n{'= ' if whole else ''}{hops:.3g} hop{'s' if hops > 1 + _WHOLE else ''}"


def _saving_and_gain(ways: pd.DataFrame, way: tuple[str, str]) -> str | None:
    if way not in ways.index:
        return None
    return _pair(ways.loc[[way]].iloc[0], "time_saving_pct", "accuracy_gain_pct")


def _pair(row: pd.Series, saving: str, gain: str) -> str:
    """S/A, with the interval of A where there is one."""
    lo, hi = row[f"{gain}_lo"], row[f"{gain}_hi"]
    ends = "" if pd.isna(lo) else f" [{percent(lo)}, {percent(hi)}]"
    return f"{percent(row[saving])}/{percent(row[gain])}{ends}"


def _claimed(row: pd.Series, published: Published) -> PublishedResult | None:
    """The paper's result on real gyroscopes of this sensor."""
    claims = published.of_networks(row.sensor, virtual_gyros=0)
    return next((claim for claim in claims if claim.window_s == row.window_s), None)


def _claim(row: pd.Series, published: Published) -> str | None:
    claim = _claimed(row, published)
    if claim is None:
        return None
    return f"{claim.time_saving_pct:.0f}/{claim.accuracy_gain_pct:.0f}"
