"""The tables of the report: a function for each, with its caption."""

import logging
from typing import Any

import numpy as np
import pandas as pd

from gyro_pipeline.conventions import ALL, AXES, DISJOINT, FIRST, MDPS, PAPER, TRUE
from gyro_pipeline.estimators import DEFAULT, ESTIMATORS, ORIENTATION_NOTE
from gyro_pipeline.parameters import PublishedHours, PublishedResult, PublishedSpecification
from gyro_pipeline.pipelines.reporting.exhibits import (
    BEATS_ORACLE_P,
    LEAK_VARIANTS,
    STUDIES_OF,
    Exhibit,
    Material,
    bracketed,
    ends,
    from_to,
    gyroscopes,
    interval,
    label,
    percent,
    remark,
    split,
    where,
)
from gyro_pipeline.pipelines.reporting.recordings import SIGMAS_MDPS
from gyro_pipeline.pipelines.reporting.results import (
    BOUND_GAINS,
    CEILINGS,
    OTHERS,
    PAIRED_COUNTS,
    ROW,
    WARNINGS,
    column,
)
from gyro_pipeline.studies import CNN, CNN_SHUFFLED, CONSTANT, MEAN, RESIDUAL_NETWORK

logger = logging.getLogger(__name__)

FIRST_WINDOWS = "first_windows"
"""The study whose networks are trained on first windows."""

PAPER_TABLES = {
    "three_gyroscopes": "Three real gyroscopes",
    "multiple_gyroscopes": "Twelve real gyroscopes",
    "generalization": "The four sensors",
}
"""Titles of the result tables of the paper."""

_HOUR_S = 3600
_CEILING, _ORACLE = "ceiling", "oracle, on the same windows"
_OWN_CEILINGS = {
    "joint": "ceiling, jointly over axes",
    "history": "ceiling, with earlier calibrations",
}
_ORACLE_A = "Oracle A %"
_WARM_UP = "Warm-up needed mdps"
_DEFAULT_A = f"{label(DEFAULT).capitalize()} A %"
_AT_DATASHEET = "At the datasheet's rate h"
_SUMMARY = (
    "Windows of 10 s; S and A in percent, over all windows, with 95 % intervals over recordings. "
    "The paper's way is over the first window of each recording, and scatters more. Ceilings are "
    "those of white noise without drift or, if fitted, of the noise of the recordings. They are "
    "expected values: an A above the ceiling may be there by chance if its interval contains it. "
    "The oracle, which knows the drawn values, is judged on the same windows as the network. "
    "The warm-up needed is the amplitude that would raise the ceiling of first "
    "windows to the published A, for time constants of 5 to 60 s and the paper's lengths of "
    "recordings. S of "
    "the ceiling, A of each axis, seeds and runs are in the CSV files. Paper, section IV-G."
)


# results beside the paper's


def paper_results(material: Material, table: str) -> Exhibit | None:
    """A result table of the paper, one of ``PAPER_TABLES``, with our results beside it."""
    study = STUDIES_OF[table]
    if where(material.results, study=study).empty:
        return None
    claims = material.published.of_table(table)
    results = pd.DataFrame(_result_row(material, claim) for claim in claims)
    columns = ["Sensor", "Gyroscopes", "Published S/A %", "S %", "A %", "Constant A %", _DEFAULT_A]
    columns += ["Ceiling A %", *[_ORACLE_A] * material.simulated, "Paper's way A %", _WARM_UP]
    columns += ["Note"] if results["Note"].notna().any() else []
    caption = f"{_SUMMARY} The table compares {len(results)} published results with ours."
    return Exhibit(f"{study}_{table}", PAPER_TABLES[table], caption, results, columns)


def trained_on_first_windows(material: Material) -> Exhibit | None:
    """Networks trained on all and on first windows, beside a constant, for a bias that warms up."""
    if where(material.results, study=FIRST_WINDOWS).empty:
        return None
    rows = []
    for claim in material.claims:
        for study, trained in (("augmentation", ALL), (FIRST_WINDOWS, FIRST)):
            row = material.result(claim, CNN, study)
            if claim.table != "generalization" and row.get("real_gyros") == claim.real_gyros:
                rows.append(_first_and_all(material, claim, row, trained))
    if not rows:
        return None
    caption = (
        "The paper's network, trained on all windows and on first windows; judged over the first "
        "window of each recording, the paper's way, and over all windows; A in percent, with 95 % "
        "intervals. If a bias settles after power-on, a constant gains as much in first windows as "
        "the network does. The ceiling is that of the drawn noise and warm-up."
    )
    title = "Trained on all and on first windows, beside a constant"
    return Exhibit("first_windows", title, caption, pd.DataFrame(rows))


def _first_and_all(
    material: Material, claim: PublishedResult, row: pd.Series, trained: str
) -> dict[str, Any]:
    kinds = {"Network": "", "Constant": "constant_", "Oracle": "oracle_", "Ceiling": "ceiling_"}
    return {
        "Sensor": material.sensor_name(claim.sensor),
        "Gyroscopes": gyroscopes(row),
        "Trained on": f"{trained} windows",
        "Published A %": f"{claim.accuracy_gain_pct:.0f}",
    } | {
        f"{name} A %, {windows} windows": interval(row, f"{kind}accuracy_gain_pct", windows)
        for windows in (FIRST, ALL)
        for name, kind in kinds.items()
    }


def _result_row(material: Material, claim: PublishedResult) -> dict[str, Any]:
    row, residual, constant, default = (
        material.result(claim, name) for name in (CNN, RESIDUAL_NETWORK, CONSTANT, DEFAULT)
    )
    published = _published(claim)
    if not row.empty and row.real_gyros < claim.real_gyros:
        published += f" ({gyroscopes(claim)})"
    runs = [ids for ids in (row.get("run_ids"), residual.get("run_ids")) if ids is not None]
    return {
        "Approach": claim.approach,
        "Sensor": claim.sensor,
        "Source": material.source_name,
        "Split": split(row),
        "Gyroscopes": gyroscopes(claim if row.empty else row),
        "Published S/A %": published,
        "S %": interval(row, "time_saving_pct"),
        "A %": interval(row, "accuracy_gain_pct"),
        "Paper's way S %": interval(row, "time_saving_pct", FIRST),
        "Paper's way A %": interval(row, "accuracy_gain_pct", FIRST),
        "Residual network S %": interval(residual, "time_saving_pct"),
        "Residual network A %": interval(residual, "accuracy_gain_pct"),
        "Constant A %": interval(constant, "accuracy_gain_pct"),
        _DEFAULT_A: interval(default, "accuracy_gain_pct"),
        "Ceiling S %": interval(row, "ceiling_time_saving_pct"),
        "Ceiling A %": interval(row, "ceiling_accuracy_gain_pct"),
        _ORACLE_A: interval(row, "oracle_accuracy_gain_pct"),
        "Paper's way ceiling A %": interval(row, "ceiling_accuracy_gain_pct", FIRST),
        _WARM_UP: _warm_up(material, claim),
        "Seeds": row.get("seeds"),
        "Spread of S over seeds": _spread(row, "time_saving_pct"),
        "Spread of A over seeds": _spread(row, "accuracy_gain_pct"),
        "Recordings": row.get("recordings"),
        "Section": claim.section,
        "Runs": _short(" ".join(runs)) or None,
        "Note": material.status(claim) if row.empty else remark(row),
    }


def _published(claim: PublishedResult) -> str:
    return f"{claim.time_saving_pct:.0f}/{claim.accuracy_gain_pct:.0f}"


def _warm_up(material: Material, claim: PublishedResult) -> str:
    if not material.beyond_white_noise(claim):
        return "none"
    amplitudes_mdps = material.warm_up_needed_mdps(claim)
    return from_to(amplitudes_mdps) if amplitudes_mdps else "–"


def _spread(row: pd.Series, base: str) -> str:
    spread = row.get(f"{base}_seed_sd")
    return "–" if pd.isna(spread) else f"{spread:.1f}"


def _short(run_ids: str) -> str:
    """Run ids, cut to the first digits that are enough to find a run."""
    return " ".join(run_id[:8] for run_id in run_ids.split())


# all results of a study


def results_table(material: Material, study: str) -> Exhibit:
    """All results of a study in mdps and percent, which are also logged."""
    rows = where(material.results, study=study)
    # the same runs, where an estimator uses the same part of several training sets
    copies = rows.duplicated(["sensor", "estimator", "window_s", "run_ids"]) & rows.run_ids.notna()
    rows = rows[~copies]
    table = rows[ROW].drop(columns="source").assign(source=material.source_name)
    for windows in (ALL, FIRST):
        table[f"RMSE {windows} mdps"] = _scaled(rows, column("test_rmse_dps", windows), 3, MDPS)
        for short, base in (("S", "time_saving_pct"), ("A", "accuracy_gain_pct")):
            table[f"{short} {windows} %"] = _scaled(rows, column(base, windows), 0)
        ceiling = _scaled(rows, column("ceiling_rmse_dps", windows), 3, MDPS)
        table[f"ceiling {windows} mdps"] = ceiling
    logger.info("results\n%s", table.to_string(index=False, na_rep="–"))
    more = [f"accuracy_gain_pct_{axis}" for axis in AXES] + CEILINGS[-2:] + BOUND_GAINS
    for base in more:
        short = base.replace("accuracy_gain_pct", "A").replace("_", " ")
        table[f"{short} {ALL} %"] = _scaled(rows, base, 0)
    added = [f"added_{count}_pct{end}" for count in PAIRED_COUNTS for end in ("", "_lo", "_hi")]
    for name in [name for name in (*added, *OTHERS, *WARNINGS) if name in rows]:
        table[name.replace("_", " ")] = rows[name]
    table["split"] = [split(row) for _, row in rows.iterrows()]
    table["status"], table["runs"] = rows.status, rows.run_ids.map(_short, na_action="ignore")
    return Exhibit(f"{study}_results", f"All results of {study}", "", table, ())


def _scaled(rows: pd.DataFrame, name: str, digits: int, unit: float = 1.0) -> pd.Series:
    values = rows.get(name, pd.Series(np.nan, rows.index)).astype(float)
    return (values / unit).round(digits) + 0.0  # no "-0"


def comparison(material: Material, study: str) -> Exhibit | None:
    """Compare the estimators of a study over all windows against the mean of the recording.

    The table has differences of RMSEs on the same windows, with 95 % intervals over recordings; a
    negative one favours the estimator of the row. Against the samples outside the window, truth
    (b), and the drawn bias, truth (c), they are differences of mean squares.
    """
    results = where(material.finished, study=study).copy()
    if results.empty:
        return None
    results["rank"] = results.estimator.map({name: i for i, name in enumerate(ESTIMATORS)})
    groups = results.sort_values("rank", kind="stable").groupby(["sensor", "window_s"])
    table = pd.DataFrame(
        _comparison_row(material, row, group) for _, group in groups for _, row in group.iterrows()
    ).round({"Within ±1σ %": 1, "Within ±2σ %": 1})
    return Exhibit(f"{study}_comparison", f"{study}: estimators compared", "", table, ())


def _comparison_row(material: Material, row: pd.Series, group: pd.DataFrame) -> dict[str, Any]:
    mean = group[group.estimator == MEAN].test_rmse_dps.iloc[0]
    return {
        "Sensor": row.sensor,
        "Source": material.source_name,
        "Window s": row.window_s,
        "Estimator": row.estimator,
        "Training set": gyroscopes(row),
        "Recommended": "yes" if row.recommended else "no",
        "Stored prior": "yes" if row.uses_prior else "no",
        "RMSE mdps": round(row.test_rmse_dps / MDPS, 3),
        "RMSE / running mean's": round(row.test_rmse_dps / mean, 3),
        "Less running mean mdps": _difference(row, MEAN),
        f"Less {DEFAULT} mdps": _difference(row, DEFAULT),
        **{
            f"Less {name.replace('_', ' ')}, {text} mdps²": _difference(row, name, truth)
            for truth, text in ((DISJOINT, "outside"), (TRUE, "true bias"))
            for name in (MEAN, DEFAULT)
        },
        "Ceiling mdps": round(row.ceiling_rmse_dps / MDPS, 3),
        "Oracle mdps": round(ends(row, "oracle_rmse_dps")[0] / MDPS, 3),
        "Within ±1σ %": row.coverage_1sigma_pct,
        "Within ±2σ %": row.coverage_2sigma_pct,
        "Recordings": group.recordings.max(),
        "Split": split(row),
        "Note": remark(row),
        "Runs": _short(row.run_ids),
    }


def _difference(row: pd.Series, name: str, truth: str = PAPER) -> str:
    key, unit = f"less_{name}_dps", MDPS
    if truth != PAPER:
        key, unit = f"less_{name}_dps2_{truth}", MDPS**2
    return "–" if name == row.estimator else bracketed(ends(row, key) / unit, "{:+.3f}".format)


def ratios(material: Material, study: str, sensor: str) -> Exhibit | None:
    """Errors of a sensor's estimators relative to the running mean, by window length."""
    rows = where(material.finished, study=study, sensor=sensor)
    if rows.empty:
        return None
    table: dict[str, dict[str, str]] = {}
    for window_s, group in rows.sort_values("window_s").groupby("window_s"):
        mean = where(group, estimator=MEAN).iloc[0]
        texts = {"running mean, RMSE in mdps": f"{mean.test_rmse_dps / MDPS:.3f}"}
        for _, row in group[group.estimator != MEAN].iterrows():
            texts[in_full(row, rows)] = _ratio(row, "accuracy_gain_pct")
        table[f"{float(str(window_s)):g} s"] = texts | _limits(mean, group)
    errors = pd.DataFrame(table)
    limits = (_CEILING, *_OWN_CEILINGS.values(), _ORACLE)
    last = [name for name in limits if name in errors.index]
    errors = errors.reindex([*errors.index.drop(last), *last]).fillna("–")
    errors = errors.rename_axis("Estimator").reset_index()
    columns = [*errors.columns]
    errors.insert(1, "Source", material.source_name)
    errors = errors.assign(Split=split(rows.iloc[0]))
    priors = rows[rows.uses_prior.astype(bool)].estimator.map(label).unique()
    unseen = " No estimator has seen the device that it is tested on; intervals are over devices."
    caption = (
        "RMSE over all windows against the mean of the recording, relative to that of the running "
        "mean over the same window, with 95 % intervals. A gain is one whose interval lies below "
        f"1; of {len(rows) - len(table)} comparisons about one in 20 excludes the true ratio by "
        "chance. The ceiling is that of white noise without drift or, if fitted, of the noise of "
        f"the recordings. `tables/{study}_comparison.csv` has differences, coverage and the other "
        f"truths. Each of {', '.join(priors)} {ORIENTATION_NOTE}."
    ) + unseen * ("device" in split(rows.iloc[0]))
    title = f"{material.sensor_name(sensor)}, {study.replace('_', ' ')}: error relative to the mean"
    return Exhibit(f"{study}_{sensor}", title, caption, errors, columns)


def _limits(mean: pd.Series, group: pd.DataFrame) -> dict[str, str]:
    """The ratios of the ceilings that estimators use, and of the oracle."""
    names = {"ceiling": _CEILING}
    names |= {
        f"ceiling_{kind}": name
        for kind, name in _OWN_CEILINGS.items()
        if (group.own_ceiling == kind).any()
    }
    names |= {"oracle": _ORACLE} if pd.notna(mean.get("oracle_accuracy_gain_pct")) else {}
    return {name: _ratio(mean, f"{base}_accuracy_gain_pct") for base, name in names.items()}


def in_full(row: pd.Series, rows: pd.DataFrame) -> str:
    """Name of an estimator, with its training set if it has several, and if it is recommended."""
    alike = rows[(rows.estimator == row.estimator) & (rows.window_s == row.window_s)]
    trained = f", {gyroscopes(row)}" if alike.run_ids.nunique() > 1 else ""
    return label(row.estimator) + trained + (" (recommended)" if row.recommended else "")


def _ratio(row: pd.Series, gain: str) -> str:
    """The error relative to the running mean, 1 - A, with its interval."""
    value, hi, lo = 1 - ends(row, gain) / 100
    return bracketed((value, lo, hi), "{:.3f}".format)


# sensors


def start_up(material: Material) -> Exhibit | None:
    """Seconds at rest until the bias is known to 1 and 0.5 mdps."""
    if material.sensors.empty:
        return None
    rows = material.sensors
    methods = {"mean": "mean", "history": "with history", "ceiling": "ceiling"}
    table = pd.DataFrame({
        "Sensor": rows.sensor.map(material.sensor_name),
        "Turn-on spread mdps": (rows.spread_dps / MDPS)
        .map("{:.2g}".format, na_action="ignore")
        .fillna("–"),
        **{
            f"{words}, σ = {sigma:g} mdps": rows[f"{method}_s_at_{sigma:g}"].map(_seconds)
            for sigma in SIGMAS_MDPS
            for method, words in methods.items()
        },
        "Earlier calibrations": rows.history_recordings,
    })  # fmt: skip
    caption = (
        "Seconds at rest after a power-on until the standard deviation of the bias, pooled over "
        "the axes of IMU 1, is 1 or 0.5 mdps. *Mean*: the average of the samples alone. *With "
        "history*: combined with the earlier calibrations of the device, whose number is in the "
        "last column. *Ceiling*: as if the mean of all calibrations were known exactly. 0 s: the "
        "earlier calibrations alone suffice. Computed from N, B and K of the recordings, for a "
        "device without warm-up, in the same orientation, with independent power-ons."
    )
    return Exhibit("start_up", "Seconds of rest that a start-up takes", caption, table)


def _seconds(value: float) -> str:
    if np.isnan(value):
        return "–"
    if np.isinf(value):
        return "longer than a recording"
    return f"{value:.0f} s" if value >= 10 or value == 0 else f"{value:.1f} s"  # noqa: PLR2004


def sensor_specifications(material: Material) -> Exhibit | None:
    """Datasheet values beside measured ones (section IV-A, table of specifications)."""
    if material.sensors.empty:
        return None
    fields = [*PublishedSpecification.model_fields]
    sheets = pd.DataFrame(map(dict, material.published.specifications), columns=fields)
    sheets = sheets.set_index("sensor")
    rows = sheets.add_prefix("sheet_").join(material.sensors.set_index("sensor"), how="outer")
    rows = rows.reindex([*dict.fromkeys([*sheets.index, *material.sensors.sensor])])
    density = rows.sheet_noise_density_mdps_rthz.astype(float)
    # a one-sided density ND: N = ND / sqrt(2), sigma = ND sqrt(rate / 2)
    table = pd.DataFrame({
        "Sensor": rows.index.to_series().map(material.sensor_name),
        "Source": material.source_name,
        "Gyroscopes": len(AXES) * rows.imus,
        "Datasheet rate Hz": rows.sheet_rate_hz.map(_rates, na_action="ignore"),
        "Rate Hz": rows.rate_hz.round(1),
        "Datasheet noise density mdps/√Hz": density,
        "Datasheet N mdps√s": density / np.sqrt(2),
        "N mdps√s": _rms(rows, "white_dps_rts", 1 / MDPS),
        "Datasheet σ mdps": density * np.sqrt(rows.rate_hz / 2),
        "σ mdps": _rms(rows, "sample_sigma_dps", 1 / MDPS),
        "Datasheet B deg/h": rows.sheet_bias_stability_dph,
        "B deg/h": _rms(rows, "instability_dps", _HOUR_S),
        "Section": rows.sheet_section,
    })  # fmt: skip
    caption = (
        "Datasheet values beside those measured in the recordings: the root mean square over "
        "gyroscopes, with the smallest and the largest value. N is the white noise: the mean of t "
        "seconds scatters by N/√t. B is the bias instability. Paper, section IV-A."
    )
    hidden = ("Source", "Datasheet noise density mdps/√Hz", "Section")
    columns = [name for name in table.columns.astype(str) if name not in hidden]
    name, title = "sensor_specifications", "Sensors: datasheets and recordings"
    return Exhibit(name, title, caption, table, columns)


def _rates(rates_hz: tuple[float, float]) -> str:
    return "–".join(f"{rate:g}" for rate in dict.fromkeys(rates_hz))


def _rms(rows: pd.DataFrame, name: str, factor: float) -> pd.Series:
    """Root mean square over gyroscopes, with the smallest and the largest."""
    values = rows[[name, f"{name}_min", f"{name}_max"]] * factor
    texts = values.apply(lambda row: "{:.3g} [{:.3g}, {:.3g}]".format(*row), axis=1)
    return texts.where(rows.imus.notna(), "not read")


def dataset_hours(material: Material) -> Exhibit | None:
    """Hours of all datasets, from counts of samples (section IV-A, table of hours)."""
    if not {row.sensor for row in material.published.hours} & set(material.described):
        return None
    hours = material.published.hours
    table = pd.DataFrame(_hours(material, claim) for claim in hours)
    virtual = np.array([claim.virtual for claim in hours])
    sums = [
        _sum("real", table[~virtual]),
        _sum("virtual", table[virtual]),
        _sum("all", table) | {"Note": "the paper's total includes the virtual recordings"},
    ]
    table = pd.concat([table, pd.DataFrame(sums)], ignore_index=True)
    table = table.drop(columns=["_lo", "_hi"])
    caption = (
        "Training recordings count for every gyroscope, test recordings for the three of IMU 1. "
        "In a k-fold each recording does both, and counts once in the total. Paper, section IV-A."
    )
    columns = ["Dataset", "Sensor", "Gyroscopes", "Training recordings", "Test recordings", "T s"]
    columns += ["Total h", "Paper's total h", "Note"]
    return Exhibit("dataset_hours", "Hours of the datasets", caption, table, columns)


def _hours(material: Material, claim: PublishedHours) -> dict[str, Any]:
    row = material.described.get(claim.sensor, pd.Series())
    prefix = "virtual_" if claim.virtual else ""
    head = {"Dataset": str(claim.dataset), "Sensor": claim.sensor}
    tail = {
        "Paper's train h": claim.train_h,
        "Paper's test h": claim.test_h,
        "Paper's total h": claim.total_h,
        "Section": claim.section,
        "Note": claim.note or None,
    }
    if pd.isna(row.get(f"{prefix}all_samples")):
        return head | tail | {"Note": "not made"}
    train, test, total = (
        row[f"{prefix}{part}_samples"] / _HOUR_S for part in ("train", "test", "all")
    )
    slowest_hz, fastest_hz = material.sheets[claim.sensor].rate_hz
    fast, slow = total / fastest_hz, total / slowest_hz
    return head | {
        "Source": f"{'virtual, from ' if claim.virtual else ''}{material.source_name}",
        "Gyroscopes": int(row[f"{prefix}gyroscopes"]),
        "Training recordings": int(row[f"{prefix}train_recordings"]),
        "Test recordings": int(row[f"{prefix}test_recordings"]),
        "T s": round(row[f"{prefix}median_samples"] / row.rate_hz, 2),
        "Train h": round(train / row.rate_hz, 2),
        "Test h": round(test / row.rate_hz, 2),
        "Total h": round(total / row.rate_hz, 2),
        _AT_DATASHEET: from_to((fast, slow), "{:.2f}".format),
        **tail,
        "_lo": fast,
        "_hi": slow,
    }


def _sum(dataset: str, rows: pd.DataFrame) -> dict[str, Any]:
    numbers = rows.select_dtypes("number").drop(columns="T s")
    total = {str(name): round(values.sum(), 2) for name, values in numbers.items()}
    hours = from_to((total["_lo"], total["_hi"]), "{:.2f}".format)
    return {"Dataset": dataset, **total, _AT_DATASHEET: hours}


def recording_quality(material: Material) -> Exhibit | None:
    """Results of the quality control of the raw logs."""
    if material.quality.empty:
        return None
    caption = (
        "Quality control of the raw logs, and the recordings with findings. Of each recording, the "
        "longest stretch without a gap is kept, and brief damage in it is masked. Rows count from "
        "0."
    )
    title = "Recordings: kept, repaired, rejected"
    return Exhibit("recording_quality", title, caption, material.quality)


# the leak study


def leakage_results(material: Material) -> Exhibit | None:
    """S and A of each way of training in the leak study, a row for each stride."""
    if material.leaks.empty:
        return None
    groups = material.leaks.groupby(["sensor", "window_stride_s"], sort=False)
    rows = [_leak_row(material, group.set_index(["leak", "estimator"])) for _, group in groups]
    table = pd.DataFrame(rows)
    logger.info("leak study, S/A %%\n%s", table.to_string(index=False, na_rep="–"))
    caption = (
        "None of these is a result: test information was let into the training, each time in a "
        "different way, beside the split by recording of the same windows. This shows that a leak "
        "suffices to pass the ceiling, not that anybody had one. S and A are over the test windows "
        "of each way of training, in percent, with 95 % intervals of A over recordings."
    )
    columns = ["Sensor", "Window stride s", *(f"{name} S/A %" for name in LEAK_VARIANTS.values())]
    columns += ["Constant A %", "Ceiling S/A %", "Published S/A %"]
    title = "Trained with leaks on purpose: S and A"
    return Exhibit("leakage_results", title, caption, table, columns)


def _leak_row(material: Material, ways: pd.DataFrame) -> dict[str, Any]:
    first, texts = ways.iloc[0], ways.apply(_saving_and_gain, axis=1, kind="")
    claim = published_claim(material, first)
    shuffled = ways[ways.index.get_level_values("estimator") == CNN_SHUFFLED]
    p_values = ways.beats_oracle_p.dropna()
    leaking = [LEAK_VARIANTS[way] for way in p_values.index[p_values < BEATS_ORACLE_P]]
    return {
        "Sensor": first.sensor,
        "Source": material.source_name,
        "Window stride s": first.window_stride_s,
        "Windows": first.windows,
        "Recordings": first.recordings,
        **{f"{name} S/A %": texts.get(way) for way, name in LEAK_VARIANTS.items()},
        "Constant A %": percent(first.constant_accuracy_gain_pct),
        "Ceiling S/A %": _saving_and_gain(first, "ceiling_"),
        "Published S/A %": claim and _published(claim),
        "Shuffled beats the constant": "yes"
        if (shuffled.over_constant_dps2_hi < 0).any()
        else "no",
        "Beats the oracle": "; ".join(leaking) or ("none" if len(p_values) else "not known"),
    }


def _saving_and_gain(row: pd.Series, kind: str) -> str:
    """S/A, with the interval of A if there is one."""
    gain = f"{kind}accuracy_gain_pct"
    return f"{percent(row[f'{kind}time_saving_pct'])}/{interval(row, gain)}"


def published_claim(material: Material, row: pd.Series) -> PublishedResult | None:
    """The published result for real gyroscopes of a sensor alone."""
    claims = material.published.of_networks(row.sensor, virtual_gyros=0)
    return next((claim for claim in claims if claim.window_s == row.window_s), None)
