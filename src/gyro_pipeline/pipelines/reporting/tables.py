"""The paper's tables: one function each, results or stored data in, a table out."""

import logging
from collections.abc import Sequence
from typing import Any

import numpy as np
import pandas as pd
import xarray as xr

from gyro_pipeline.conventions import (
    ALL,
    DISJOINT,
    FIRST,
    LEAVE_ONE_DEVICE_OUT,
    MDPS,
    PAPER,
    TEST,
    TRUE,
    InputError,
    Missing,
)
from gyro_pipeline.estimators import DEFAULT, ESTIMATORS
from gyro_pipeline.parameters import (
    Published,
    PublishedHours,
    PublishedResult,
    PublishedSpecification,
)
from gyro_pipeline.protocol.recordings import tested_imu
from gyro_pipeline.studies import CNN, MEAN, RESIDUAL_NETWORK

logger = logging.getLogger(__name__)

_HOUR_S = 3600
_AT_DATASHEET = "At the datasheet's rate h"
_MEAN_MDPS = "running mean, RMSE in mdps"
_KEYS = ["sensor", "real_gyros", "virtual_gyros", "window_s"]


# results


def results_table(results: pd.DataFrame, elsewhere: pd.DataFrame) -> pd.DataFrame | Missing:
    """All results of a study that can be made, in mdps and percent; also printed.

    Args:
        results: From ``pool_results``, which keeps every figure and its interval.
        elsewhere: From ``pool_measured_elsewhere``.
    """
    own = results[results.missing.isna()]
    if own.empty:
        return Missing(tuple(results.missing))
    made = pd.concat([part for part in (own, elsewhere) if len(part)], ignore_index=True)
    columns = ["sensor", "estimator", "method", "real_gyros", "virtual_gyros", "window_s"]
    table = made[columns].copy()
    for windows in (ALL, FIRST):
        suffix = "" if windows == FIRST else f"_{windows}"
        table[f"RMSE {windows} mdps"] = (made[f"test_rmse_dps{suffix}"] / MDPS).round(3)
        for short, base in (("S", "time_saving_pct"), ("A", "accuracy_gain_pct")):
            if base + suffix in made:
                table[f"{short} {windows} %"] = made[base + suffix].round(0) + 0.0  # no "-0"
    table["ceiling mdps"] = (made.ceiling_rmse_dps / MDPS).round(3)
    table.insert(1, "source", [source_of(row) for _, row in made.iterrows()])
    logger.info("results\n%s", table.to_string(index=False, na_rep="–"))
    return table.assign(split=made.apply(_split, axis=1), runs=made.run_ids.map(_short))


def comparison(results: pd.DataFrame, elsewhere: pd.DataFrame) -> pd.DataFrame | Missing:
    """Estimators side by side, over all windows against the mean of the recording.

    Differences are of RMSEs on the same windows, with 95 % intervals over recordings; negative ones
    are in favour of the row's estimator. Against the samples outside the window, truth (b), and the
    drawn bias, truth (c), they are of mean squares.

    Args:
        results: From ``pool_results``.
        elsewhere: From ``pool_measured_elsewhere``.

    Returns:
        A row per sensor, source, window and estimator.
    """
    own = results[results.missing.isna()]
    if own.empty:
        return Missing(tuple(results.missing))
    made = pd.concat([part for part in (own, elsewhere) if len(part)], ignore_index=True)
    made["rank"] = made.estimator.map({name: i for i, name in enumerate(ESTIMATORS)})
    made = made.sort_values(["sensor", "simulated", "source", "window_s", "rank"])
    groups = made.groupby(["sensor", "source", "window_s"], sort=False)
    rows = [_compared(row, group) for _, group in groups for _, row in group.iterrows()]
    columns = ["Within ±1σ %", "Within ±2σ %"]
    return pd.DataFrame(rows).round(dict.fromkeys(columns, 1))


def _compared(row: pd.Series, group: pd.DataFrame) -> dict[str, Any]:
    mean = group[group.estimator == MEAN].test_rmse_dps_all.iloc[0]
    return {
        "Sensor": row.sensor,
        "Source": source_of(row),
        "Window s": row.window_s,
        "Estimator": row.estimator,
        "Recommended": "yes" if row.recommended else "no",
        "Stored prior": "yes" if row.uses_prior else "no",
        "RMSE mdps": round(row.test_rmse_dps_all / MDPS, 3),
        "RMSE / running mean's": round(row.test_rmse_dps_all / mean, 3),
        "Less running mean mdps": _difference(row, MEAN),
        f"Less {DEFAULT} mdps": _difference(row, DEFAULT),
        **{
            f"Less {name.replace('_', ' ')}, {text} mdps²": _difference(row, name, truth)
            for truth, text in ((DISJOINT, "outside"), (TRUE, "true bias"))
            for name in (MEAN, DEFAULT)
        },
        "Ceiling mdps": round(row.ceiling_rmse_dps_all / MDPS, 3),
        "Within ±1σ %": row.coverage_1sigma_pct,
        "Within ±2σ %": row.coverage_2sigma_pct,
        "Recordings": int(group.recordings.max()),
        "Split": _split(row),
        "Runs": _short(row.run_ids),
    }


def ratios(results: pd.DataFrame, elsewhere: pd.DataFrame, sensor: str) -> pd.DataFrame | Missing:
    """Errors of a sensor's estimators relative to the running mean, by window length.

    Over all windows, against the mean of the recording, with 95 % intervals over recordings.

    Args:
        results: From ``pool_results``.
        elsewhere: From ``pool_measured_elsewhere``.
        sensor: Whose.

    Returns:
        A row per source and estimator, and one for its ceiling; a column per window.
    """
    own, others = (table[table.sensor == sensor] for table in (results, elsewhere))
    made = own[own.missing.isna()]
    if made.empty:
        return Missing(tuple(own.missing))
    sources = [made, *(rows for _, rows in others.groupby("source"))]
    return pd.concat([_ratios(rows) for rows in sources], ignore_index=True)


def _ratios(rows: pd.DataFrame) -> pd.DataFrame:
    """Of one source."""
    names = sorted(rows.estimator.unique(), key=[*ESTIMATORS, *rows.estimator].index)
    table: dict[str, dict[str, str]] = {}
    for window_s, group in rows.sort_values("window_s").groupby("window_s"):
        named = {row.estimator: row for _, row in group.iterrows()}
        mean = named[MEAN]
        shown = {_MEAN_MDPS: f"{mean.test_rmse_dps_all / MDPS:.3f}"}
        for name in (name for name in names if name in named and name != MEAN):
            shown[_marked(named[name])] = _ratio(named[name], "accuracy_gain_pct_all")
        shown["ceiling"] = _ratio(mean, "ceiling_accuracy_gain_pct_all")
        table[f"{window_s:g} s"] = shown
    made = pd.DataFrame(table).fillna("–").rename_axis("Estimator").reset_index()
    made.insert(1, "Source", source_of(rows.iloc[0]))
    return made.assign(Split=_split(rows.iloc[0]))


def _marked(row: pd.Series) -> str:
    """An estimator's name, and whether it is a recommended one."""
    return row.estimator.replace("_", " ") + (" (recommended)" if row.recommended else "")


def _ratio(row: pd.Series, gain: str) -> str:
    """One less an accuracy gain, whose interval turns round; 1 is the running mean."""
    gains = [row.get(f"{gain}{end}") for end in ("", "_lo", "_hi")]
    value, hi, lo = (1 - np.array(gains, np.float64) / 100).tolist()
    if pd.isna(value):
        return "–"
    return f"{value:.3f}" if pd.isna(lo) else f"{value:.3f} [{lo:.3f}, {hi:.3f}]"


def _difference(row: pd.Series, name: str, truth: str = PAPER) -> str:
    key, unit = f"less_{name}_dps", MDPS
    if truth != PAPER:
        key, unit = f"less_{name}_dps2_{truth}", MDPS**2
    value, lo, hi = (row.get(key + end) for end in ("", "_lo", "_hi"))
    if value is None or pd.isna(value) or name == row.estimator:
        return "–"
    ends = (
        "" if lo is None or hi is None or pd.isna(lo) else f" [{lo / unit:+.3f}, {hi / unit:+.3f}]"
    )
    return f"{value / unit:+.3f}{ends}"


def three_gyroscopes(results: pd.DataFrame, published: Published) -> pd.DataFrame | Missing:
    """The paper's summary with three real gyroscopes (section IV-G, table of three gyroscopes)."""
    return _result_table(results, published.of_table("three_gyroscopes"))


def multiple_gyroscopes(results: pd.DataFrame, published: Published) -> pd.DataFrame | Missing:
    """The paper's summary with twelve real gyroscopes (section IV-G, table of MG results)."""
    return _result_table(results, published.of_table("multiple_gyroscopes"))


def generalization(
    results: pd.DataFrame, elsewhere: pd.DataFrame, published: Published
) -> pd.DataFrame | Missing:
    """The four sensors (section IV-G, table of generalization), measured data of others below.

    Args:
        results: Of the report's own source.
        elsewhere: On measured data of other sources; per source and sensor the row with the most
            gyroscopes that the paper's row does not exceed.
        published: The paper's.
    """
    return _result_table(results, published.of_table("generalization"), elsewhere)


def find_result(
    results: pd.DataFrame, published: PublishedResult, estimator: str = CNN
) -> pd.Series:
    """Our result for a published one.

    Raises:
        InputError: If its study has none.
    """
    match = np.all([results[key] == getattr(published, key) for key in _KEYS], axis=0)
    match &= results.estimator == estimator
    if not match.any():
        raise InputError(
            f"published result {published.approach!r} of {published.sensor} is no row of its "
            "study; correct published or studies under conf/base/parameters"
        )
    return results[match].iloc[0]


def measured_elsewhere(
    elsewhere: pd.DataFrame, published: PublishedResult, estimator: str = CNN
) -> list[pd.Series]:
    """For each other source the result that comes closest to a published one in gyroscopes."""
    alike = elsewhere[
        (elsewhere.estimator == estimator)
        & (elsewhere.sensor == published.sensor)
        & (elsewhere.window_s == published.window_s)
        & (elsewhere.virtual_gyros == published.virtual_gyros)
        & (elsewhere.real_gyros <= published.real_gyros)
    ].sort_values("real_gyros")
    return [rows.iloc[-1] for _, rows in alike.groupby("source")]


def source_of(row: pd.Series) -> str:
    """Where a result's recordings come from, and whether they are simulated or measured."""
    return source_name(row.source, bool(row.simulated))


def source_name(source: str, simulated: bool) -> str:
    """The same, where the name does not say it already."""
    kind = "simulated" if simulated else "measured"
    return source if kind in source else f"{source} ({kind})"


def _result_table(
    results: pd.DataFrame,
    wanted: Sequence[PublishedResult],
    elsewhere: pd.DataFrame | None = None,
) -> pd.DataFrame | Missing:
    # a study may do without the second
    estimators = [one for one in (CNN, RESIDUAL_NETWORK) if one in {CNN, *results.estimator}]
    ours = {one: [find_result(results, row, one) for row in wanted] for one in estimators}
    lacking = tuple(row.missing for rows in ours.values() for row in rows if pd.notna(row.missing))
    if lacking:
        return Missing(lacking)
    rows = []
    for place, published in enumerate(wanted):
        found = {one: [ours[one][place]] for one in estimators}
        if elsewhere is not None:
            for one in estimators:
                found[one] += measured_elsewhere(elsewhere, published, one)
        residual = {row.source: row for row in found.get(RESIDUAL_NETWORK, [])}
        rows += [_result_row(published, row, residual.get(row.source)) for row in found[CNN]]
    return pd.DataFrame(rows)


def _result_row(
    published: PublishedResult, row: pd.Series, residual: pd.Series | None
) -> dict[str, Any]:
    theirs, ours = _gyroscopes(published), _gyroscopes(row)
    claim = f"{published.time_saving_pct:.0f}/{published.accuracy_gain_pct:.0f}"
    return {
        "Approach": published.approach,
        "Sensor": row.sensor,
        "Source": source_of(row),
        "Split": _split(row),
        "Gyroscopes": ours,
        "Published S/A %": claim if theirs == ours else f"{claim} ({theirs})",
        "S %": _interval(row, "time_saving_pct", ALL),
        "A %": _interval(row, "accuracy_gain_pct", ALL),
        "Paper's way S %": _interval(row, "time_saving_pct", FIRST),
        "Paper's way A %": _interval(row, "accuracy_gain_pct", FIRST),
        "Residual network S %": _interval(residual, "time_saving_pct", ALL),
        "Residual network A %": _interval(residual, "accuracy_gain_pct", ALL),
        "Ceiling S %": _interval(row, "ceiling_time_saving_pct", FIRST),
        "Ceiling A %": _interval(row, "ceiling_accuracy_gain_pct", FIRST),
        "Seeds": int(row.seeds),
        "Spread of S over seeds": _spread(row, "time_saving_pct"),
        "Spread of A over seeds": _spread(row, "accuracy_gain_pct"),
        "Recordings": int(row.recordings),
        "Section": published.section,
        "Runs": _short(" ".join(one.run_ids for one in (row, residual) if one is not None)),
    }


def _gyroscopes(row: Any) -> str:
    virtual = f" + {row.virtual_gyros:.0f} virtual" if row.virtual_gyros else ""
    return f"{row.real_gyros:.0f} real{virtual}"


def _split(row: pd.Series) -> str:
    if row.get("protocol") == LEAVE_ONE_DEVICE_OUT:
        return f"leave-one-device-out, {row.folds:.0f} devices"
    return "hold-out" if row.folds == 1 else f"k-fold, {row.folds:.0f} folds"


def _interval(row: pd.Series | None, base: str, windows: str) -> str:
    if row is None:
        return "–"
    suffix = "" if windows == FIRST else f"_{windows}"
    value, lo, hi = (row[f"{base}{suffix}{end}"] for end in ("", "_lo", "_hi"))
    ends = "" if pd.isna(lo) else f" [{percent(lo)}, {percent(hi)}]"
    return f"{percent(value)}{ends}"


def percent(value: float) -> str:
    """A saving is unbounded off the ends of the running-mean curve."""
    if np.isinf(value):
        return "never reached" if value > 0 else "off the curve"
    return f"{round(value)}"


def _spread(row: pd.Series, base: str) -> str:
    spread = row[f"{base}_{ALL}_seed_sd"]
    return "–" if pd.isna(spread) else f"{spread:.1f}"


def _short(run_ids: str) -> str:
    """The first digits of each run id are enough to find it."""
    return " ".join(run_id[:8] for run_id in run_ids.split())


# stored data


def sensor_specifications(published: Published, **stored: Any) -> pd.DataFrame:
    """The datasheets beside what the recordings show (section IV-A, table of specifications).

    Args:
        published: What the manufacturers state, as the paper has it.
        **stored: For each sensor its ``<sensor>_recordings``, for their rate and source, and
            ``<sensor>_noise``, a row of N, sigma and B per gyroscope.
    """
    return pd.DataFrame(
        _specification(row, stored[f"{row.sensor}_recordings"], stored[f"{row.sensor}_noise"])
        for row in published.specifications
    )


def _specification(
    sheet: PublishedSpecification, recordings: xr.Dataset, noise: pd.DataFrame
) -> dict[str, Any]:
    density, rate_hz = sheet.noise_density_mdps_rthz, recordings.attrs["rate_hz"]
    stated = density is not None
    return {
        "Sensor": sheet.name,
        "Source": source_name(recordings.attrs["source"], bool(recordings.attrs["simulated"])),
        "Gyroscopes": len(noise),
        "Datasheet rate Hz": "–".join(f"{rate:g}" for rate in dict.fromkeys(sheet.rate_hz)),
        "Rate Hz": round(rate_hz, 1),
        "Datasheet noise density mdps/√Hz": density,
        # a one-sided density ND: N = ND / sqrt(2), sigma = ND sqrt(rate / 2)
        "Datasheet N mdps√s": density / np.sqrt(2) if stated else None,
        "N mdps√s": _rms(noise.white_dps_rts / MDPS),
        "Datasheet σ mdps": density * np.sqrt(rate_hz / 2) if stated else None,
        "σ mdps": _rms(noise.sample_sigma_dps / MDPS),
        "Datasheet B deg/h": sheet.bias_stability_dph,
        "B deg/h": _rms(noise.instability_dps * _HOUR_S),
        "Section": sheet.section,
    }


def _rms(values: pd.Series) -> str:
    """Root mean square over gyroscopes, with the smallest and the largest."""
    return f"{np.sqrt((values**2).mean()):.3g} [{values.min():.3g}, {values.max():.3g}]"


def dataset_hours(published: Published, **stored: Any) -> pd.DataFrame:
    """Hours of all datasets, from counts (section IV-A, table of hours).

    Training recordings count for every gyroscope, test recordings for the three of IMU 1, as the
    paper's own hours do. In a k-fold each recording does both, and counts once in the total.

    Args:
        published: The paper's hours, and how they are read where it contradicts itself.
        **stored: ``<sensor>_recordings``, or ``<sensor>_virtual``.
    """
    rates = {sheet.sensor: sheet.rate_hz for sheet in published.specifications}
    table = pd.DataFrame(_hours(row, rates[row.sensor], stored) for row in published.hours)
    virtual = np.array([row.virtual for row in published.hours])
    sums = [
        _sum("real", table[~virtual], ""),
        _sum("virtual", table[virtual], ""),
        _sum("all", table, "the paper calls all of it recorded; the virtual part is not"),
    ]
    return pd.concat([table, pd.DataFrame(sums)], ignore_index=True).drop(columns=["_lo", "_hi"])


def _hours(
    published: PublishedHours, rate_hz: tuple[float, float], stored: dict[str, Any]
) -> dict[str, Any]:
    sensor = published.sensor
    if published.virtual:
        recordings = stored[f"{sensor}_virtual"]
        train = _gyroscope_recordings(recordings) & (
            recordings.recording <= _train_recordings(recordings, sensor)
        )
        test = xr.zeros_like(train)
    else:
        recordings = stored[f"{sensor}_recordings"]
        train, test = _counted(recordings)
    samples, used_hz = recordings["samples"].load(), recordings.attrs["rate_hz"]
    source = source_name(recordings.attrs["source"], bool(recordings.attrs["simulated"]))
    parts = (train, test, train | test)
    counts = [int(part.sum()) for part in parts]
    totals = [int((samples * part).sum()) for part in parts]
    hours = [total / used_hz / _HOUR_S for total in totals]
    fast, slow = (totals[2] / rate / _HOUR_S for rate in reversed(rate_hz))
    return {
        "Dataset": str(published.dataset),
        "Sensor": sensor,
        "Source": f"virtual, from {source}" if published.virtual else source,
        "Gyroscopes": int(train.any("recording").sum()),
        "Training recordings": counts[0],
        "Test recordings": counts[1],
        "T s": round(float(samples.where(samples > 0).median()) / used_hz, 2),
        "Train h": round(hours[0], 2),
        "Test h": round(hours[1], 2),
        "Total h": round(hours[2], 2),
        _AT_DATASHEET: _range(fast, slow),
        "Paper's train h": published.train_h,
        "Paper's test h": published.test_h,
        "Paper's total h": published.total_h,
        "Section": published.section,
        "Note": published.note or None,
        "_lo": fast,
        "_hi": slow,
    }


def _train_recordings(virtual: xr.Dataset, sensor: str) -> int:
    """How many virtual recordings train, as their file says."""
    if "train_recordings" not in virtual.attrs:
        raise InputError(
            f"virtual recordings of {sensor}: expected the attribute train_recordings, got a file "
            "without it, of an older version; make it anew: kedro run --pipeline=virtual_gyros "
            f"--params=only.sensor={sensor}"
        )
    return int(virtual.attrs["train_recordings"])


def _gyroscope_recordings(recordings: xr.Dataset) -> xr.DataArray:
    """Whether a gyroscope has a recording: (imu, recording, axis)."""
    there = recordings["samples"].load() > 0
    return there.expand_dims({"axis": recordings.axis.to_numpy()}).transpose(
        "imu", "recording", "axis"
    )


def _counted(recordings: xr.Dataset) -> tuple[xr.DataArray, xr.DataArray]:
    """Which recordings of which gyroscopes train (validation included), and which test.

    Without a split, in a k-fold, all of them do both.
    """
    there = _gyroscope_recordings(recordings)
    tested = there & (there.imu == tested_imu(recordings))
    if "split" not in recordings.coords:
        return there, tested
    held_out = recordings.split == TEST
    return there & ~held_out, tested & held_out


def _sum(name: str, rows: pd.DataFrame, note: str) -> dict[str, Any]:
    total: dict[str, Any] = {
        column: round(rows[column].sum(), 2)
        for column in rows.select_dtypes("number").columns.astype(str)
        if column != "T s"
    }
    total[_AT_DATASHEET] = _range(total["_lo"], total["_hi"])
    return {"Dataset": name, "Note": note or None} | total


def _range(low: float, high: float) -> str:
    return f"{low:.2f}" if np.isclose(low, high) else f"{low:.2f} to {high:.2f}"
