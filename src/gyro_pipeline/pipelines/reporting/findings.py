"""What follows from the results: sentences computed from them, whatever they are."""

from collections.abc import Mapping, Sequence

import numpy as np
import pandas as pd

from gyro_pipeline.conventions import ALL, MDPS
from gyro_pipeline.parameters import Published, PublishedResult, Sensor
from gyro_pipeline.physics.ceiling import best_gain, pooled
from gyro_pipeline.pipelines.reporting.results import column, scores_of
from gyro_pipeline.protocol.scores import holm
from gyro_pipeline.studies import MEAN
from gyro_pipeline.tracking import FINGERPRINT, StoredRun

_RMSE = column("test_rmse_dps", ALL)
_GAIN = column("accuracy_gain_pct", ALL)
_CEILING = column("ceiling_rmse_dps", ALL)
_CEILING_GAIN = column("ceiling_accuracy_gain_pct", ALL)
_SIGNIFICANT = 0.001
"""Of the oracle check after Holm's correction; tests/test_ceiling.py holds the same."""

_CELL = ["sensor", "window_s"]
_TRAINED_ON = ["method", "real_gyros", "virtual_gyros"]


def compare(networks: pd.DataFrame, sensors: Mapping[str, Sensor]) -> pd.DataFrame:
    """Networks between the running mean and the ceiling, in mdps.

    Args:
        networks: Results of networks that were made.
        sensors: As configured.

    Returns:
        A row per sensor and window: RMSE over all windows.
    """
    rows = []
    for (sensor, window_s), group in networks.groupby(_CELL, sort=False):
        rmse = group[_RMSE] / MDPS
        row = {"Sensor": sensor, "Window s": window_s}
        row |= {"Running mean": group[column("mean_rmse_dps", ALL)].iloc[0] / MDPS}
        row |= {"Constant, expected": _constant(group, sensors[str(sensor)]) / MDPS}
        row |= {"Networks, worst": rmse.max(), "Networks, best": rmse.min()}
        row |= {"Ceiling": group[_CEILING].iloc[0] / MDPS, "Networks": len(group)}
        rows.append(row)
    columns = ["Running mean", "Constant, expected", "Networks, worst", "Networks, best", "Ceiling"]
    return pd.DataFrame(rows).round(dict.fromkeys(columns, 3))


def find(
    networks: pd.DataFrame,
    runs: Sequence[StoredRun],
    published: Published,
    sensors: Mapping[str, Sensor],
) -> list[str]:
    """Say what the results mean, each sentence from the numbers at hand.

    Args:
        networks: Results of networks that were made, each training once.
        runs: Those that the results were made from.
        published: The paper's results.
        sensors: As configured.

    Returns:
        One paragraph each, without those for which there is nothing to count.
    """
    told = [_beyond_any_ceiling(published.results, sensors)]
    if not networks.empty:
        told += [_beyond_this_ceiling(networks, published.results)]
        for window_s, of_window in networks.groupby("window_s"):
            told += [_ranked(float(str(window_s)), of_window, sensors)]
        told += [
            _more_data(networks, "virtual_gyros", "virtual gyroscopes to the same real ones"),
            _more_data(networks[networks.method == 2], "real_gyros", "real gyroscopes"),  # noqa: PLR2004
        ]
    told += [_oracle_check(runs)]
    return [paragraph for paragraph in told if paragraph]


def _beyond_any_ceiling(published: Sequence[PublishedResult], sensors: Mapping[str, Sensor]) -> str:
    lengths = {
        name: sensor.recording_s
        for name, sensor in sensors.items()
        if sensor.recording_s is not None
    }
    known = [one for one in published if one.sensor in lengths]
    limits = [100 * best_gain(np.sqrt(one.window_s / lengths[one.sensor])) for one in known]
    beyond = sum(one.accuracy_gain_pct > a for one, a in zip(known, limits, strict=True))
    names = dict.fromkeys(one.sensor for one in known)
    listed = ", ".join(f"{lengths[name]:g} s on {name}" for name in names)
    return (
        f"{beyond} of {len(known)} published results exceed the limit A = 1 − √(T0/T), with T = "
        f"{listed}. It holds for white noise even if the bias is known exactly, and no training "
        "set can move it."
    )


def _beyond_this_ceiling(networks: pd.DataFrame, published: Sequence[PublishedResult]) -> str:
    claims = pd.DataFrame([one.model_dump() for one in published])
    ours = networks[(networks.method == 2) | (networks.real_gyros == 3)]  # noqa: PLR2004
    both = claims.merge(ours, on=[*_CELL, "real_gyros", "virtual_gyros"], suffixes=("", "_first"))
    if both.empty:
        return ""
    claimed = both.accuracy_gain_pct
    bound = both[f"{_CEILING_GAIN}_hi"].astype(float).fillna(both[_CEILING_GAIN])
    inside = (both[f"{_GAIN}_lo"] <= claimed) & (claimed <= both[f"{_GAIN}_hi"])
    return (
        f"{len(both)} published results have a training set that was run here. Beyond the ceiling "
        f"on these data: {(claimed > bound.round()).sum()}. Within the 95 % interval of ours: "
        f"{inside.sum()}."
    )


def _ranked(window_s: float, networks: pd.DataFrame, sensors: Mapping[str, Sensor]) -> str:
    better, worse = (networks[f"{_GAIN}_lo"] > 0).sum(), (networks[f"{_GAIN}_hi"] < 0).sum()
    ratio = networks[_RMSE] / networks[_CEILING]
    told = (
        f"At {window_s:g} s, {better} of {len(networks)} networks are better than the running mean "
        f"with their whole interval and {worse} are worse with it; A is {_range(networks[_GAIN])} "
        f"%. Their RMSE is {_range(ratio, '.2f')} times the ceiling."
    )
    constants = [
        _constant(networks[networks.sensor == sensor], sensors[str(sensor)])
        for sensor in networks.sensor
    ]
    known = np.isfinite(constants)
    if known.any():
        below = (networks[_RMSE][known] < np.array(constants)[known]).sum()
        told += (
            f" {below} of {known.sum()} are better than what is expected of a constant, the "
            "device's known mean, returned without looking at the window."
        )
    return told


def _more_data(networks: pd.DataFrame, count: str, what: str) -> str:
    """How A changes with one count while the rest of the training set stays."""
    same = [name for name in [*_CELL, *_TRAINED_ON] if name != count]
    fewest = networks.groupby(same)[count].transform("min")
    base, more = networks[networks[count] == fewest], networks[networks[count] > fewest]
    pairs = more.merge(base, on=same, suffixes=("", "_base"))
    if pairs.empty:
        return ""
    change = pairs[_GAIN] - pairs[f"{_GAIN}_base"]
    half = (pairs[f"{_GAIN}_hi"] - pairs[f"{_GAIN}_lo"]).median() / 2
    return (
        f"Adding {what} changes A by {_range(change, '+.0f')} points, in {len(pairs)} comparisons; "
        f"the 95 % interval of A itself is ±{half:.0f} points (median)."
    )


def _oracle_check(runs: Sequence[StoredRun]) -> str:
    others = [run for run in runs if run.params["estimator"] != MEAN]
    key = ("beats_oracle_p", ALL, "value")
    different = {run.tags[FINGERPRINT]: run for run in others}  # studies share some runs
    scores = {name: scores_of(run) for name, run in different.items()}
    checked = [of_run[key] for of_run in scores.values() if key in of_run]
    if not checked:
        return ""
    corrected = holm(checked)
    beaten = int((corrected < _SIGNIFICANT).sum())
    verdict = "No estimator beats" if not beaten else f"DEFECT OF THE EVALUATION: {beaten} beat"
    return (
        f"{verdict} the best possible estimator on the same windows significantly: the smallest p "
        f"value of {len(checked)} is {corrected.min():.2g} after Holm's correction."
    )


def _constant(networks: pd.DataFrame, sensor: Sensor) -> float:
    """RMSE expected of the device's own mean on simulated white noise, else NaN; deg/s.

    The bias of a power-on and the averaging of the truth scatter about it: tau^2 + N^2 / T.
    """
    if sensor.simulated is None or sensor.recording_s is None or not networks.simulated.all():
        return np.nan
    if sensor.simulated.flicker_mdps:
        return np.nan
    tau, noise = (
        MDPS * np.asarray(values)
        for values in (sensor.simulated.turn_on_spread_mdps, sensor.simulated.noise_mdps_rts)
    )
    return float(pooled(np.sqrt(tau**2 + noise**2 / sensor.recording_s)))


def _range(values: pd.Series, form: str = ".0f") -> str:
    lowest, highest = (
        f"{value:{form}}".replace("-", "−") for value in (values.min(), values.max())
    )
    return lowest if lowest == highest else f"{lowest} to {highest}"
