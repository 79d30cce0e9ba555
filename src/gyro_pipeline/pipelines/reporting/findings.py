"""The findings: sentences that are computed from the results, whatever they are."""

from collections.abc import Sequence

import pandas as pd

from gyro_pipeline.conventions import ALL, FIRST
from gyro_pipeline.estimators import DEFAULT
from gyro_pipeline.parameters import PublishedResult
from gyro_pipeline.pipelines.reporting.exhibits import (
    BEATS_ORACLE_P,
    Material,
    beyond_ceiling,
    ends,
    from_to,
    label,
    where,
)
from gyro_pipeline.pipelines.reporting.results import CNN_BEST
from gyro_pipeline.scoring.scores import holm
from gyro_pipeline.studies import CNN, CONSTANT, MEAN

_RMSE, _CEILING, _ORACLE = "test_rmse_dps", "ceiling_rmse_dps", "oracle_rmse_dps"
_GAIN, _CEILING_GAIN, _ORACLE_GAIN = (
    f"{kind}accuracy_gain_pct" for kind in ("", "ceiling_", "oracle_")
)


def distinct(material: Material) -> pd.DataFrame:
    """Finished results, each once where studies share a training."""
    return material.finished.drop_duplicates(["estimator", "window_s", "sensor", "fingerprints"])


def answer(material: Material) -> list[str]:
    """The answer in at most three sentences."""
    rows = distinct(material)
    beyond = [claim for claim in material.claims if material.beyond_white_noise(claim)]
    sentences = [_networks(material, rows) or _estimators(rows)]
    sentences += [_published(material, beyond), _explanations(material, beyond)]
    return [sentence for sentence in sentences if sentence]


def findings(material: Material) -> list[str]:
    """Further findings, a sentence for each."""
    rows = distinct(material)
    networks = where(rows, estimator=CNN)
    sentences = [
        *(_ranked(float(str(window)), group) for window, group in networks.groupby("window_s")),
        _matched(material),
        _more_data(networks, "virtual_gyros", "virtual gyroscopes to the same real ones"),
        _more_data(where(networks, method=2), "real_gyros", "real gyroscopes"),
        _beyond_ceiling(rows),
        _prior_conflicts(rows),
        _oracle_check(rows),
    ]
    return [sentence for sentence in sentences if sentence]


def _networks(material: Material, rows: pd.DataFrame) -> str:
    """Accuracy gains of the network, a constant and the best linear predictor.

    The window is that of the published results, or else the shortest one.
    """
    networks = where(rows, estimator=CNN)
    if networks.empty:
        return ""
    published = networks.window_s[networks.window_s.isin([c.window_s for c in material.claims])]
    window_s = (published if len(published) else networks.window_s).min()
    chosen = where(rows, window_s=window_s)
    words = {
        CNN: f"Over all windows of {window_s:g} s, the gain in accuracy over the mean of the "
        "window is {} % for the paper's network",
        CONSTANT: "{} % for a constant, the mean of the device's training recordings",
        DEFAULT: f"{{}} % for the {label(DEFAULT)} predictor",
    }
    gains = {name: where(chosen, estimator=name)[_GAIN] for name in words}
    parts = [words[name].format(_range(gain)) for name, gain in gains.items() if len(gain)]
    if _ORACLE_GAIN in chosen and chosen[_ORACLE_GAIN].notna().any():
        oracle = _range(chosen[_ORACLE_GAIN].dropna())
        parts.append(f"{oracle} % for the oracle, which knows the drawn values")
    limit = _range(chosen[_CEILING_GAIN].dropna())
    parts.append(f"and {limit} % for the ceiling, the best expected under the noise model")
    return f"{'; '.join(parts)}."


def _estimators(rows: pd.DataFrame) -> str:
    """The best recommended estimator of a study without networks."""
    recommended = rows[rows.recommended.fillna(False).astype(bool)]
    recommended = recommended if len(recommended) else rows[rows.estimator != MEAN]
    if recommended.empty or _GAIN not in recommended:
        return ""
    window_s = recommended.window_s.min()
    best = where(recommended, window_s=window_s).sort_values(_RMSE).iloc[0]
    ratio, hi, lo = 1 - ends(best, _GAIN) / 100
    return (
        f"Over all windows of {window_s:g} s on {best.sensor} the error of {label(best.estimator)} "
        f"is {ratio:.2f} times that of the mean [{lo:.2f}, {hi:.2f}], the smallest of "
        f"{recommended.estimator.nunique()} recommended estimators; the ceiling is "
        f"{1 - best[_CEILING_GAIN] / 100:.2f}."
    )


def _published(material: Material, beyond: Sequence[PublishedResult]) -> str:
    """The number of published gains that white noise without drift does not allow."""
    if not material.claims:
        return ""
    return (
        f"{len(beyond)} of {len(material.claims)} published gains on these sensors "
        f"{'exceeds' if len(beyond) == 1 else 'exceed'} the gain that is expected at most in white "
        "noise without drift, even if the bias is known exactly: one minus the square root of the "
        "window's share of the recording."
    )


def _explanations(material: Material, beyond: Sequence[PublishedResult]) -> str:
    """Explanations of published gains beyond the ceiling, the simplest first."""
    if not beyond:
        return ""
    needed: dict[str, list[float]] = {}
    for claim in beyond:
        name = material.sensor_name(claim.sensor)
        needed.setdefault(name, []).extend(material.warm_up_needed_mdps(claim))
    sizes = "; ".join(f"{name} {from_to(a)}" for name, a in needed.items() if a)
    amount = ""
    if sizes:
        amount = (
            f" (needed at power-on: {sizes} thousandths of a deg/s, mdps, for time constants of 5 "
            "to 60 s)"
        )
    return (
        f"Possible explanations are a warm-up, which a constant could also correct{amount}; "
        "another truth than the mean of the recording; coloured noise; chance; or a leak between "
        f"training and test. {_test_of_warm_up(material, list(needed))}"
    )


def _test_of_warm_up(material: Material, names: Sequence[str]) -> str:
    """How to recognise a warm-up; on measured data, the largest warm-up that they allow."""
    allowed = material.warm_ups_allowed_mdps
    sizes = "; ".join(
        f"{from_to(allowed[name])} mdps ({name})" for name in allowed if name in names
    )
    if material.simulated or not sizes:
        return (
            "The mean rate against time after power-on, on measured data, bounds a warm-up, and so "
            "can exclude this explanation."
        )
    return f"These recordings allow a warm-up of at most {sizes}, by their 95 % intervals."


def _signs(rows: pd.DataFrame, name: str) -> tuple[int, int]:
    """The numbers of results whose whole interval is above 0, and below 0."""
    return (rows[f"{name}_lo"] > 0).sum(), (rows[f"{name}_hi"] < 0).sum()


def _ranked(window_s: float, networks: pd.DataFrame) -> str:
    better, worse = _signs(networks, _GAIN)
    has_oracle = _ORACLE in networks and networks[_ORACLE].notna().all()
    best = networks[_ORACLE if has_oracle else _CEILING]
    sentences = (
        f"At {window_s:g} s, {better} of {len(networks)} networks are better than the running mean "
        f"with their whole interval and {worse} are worse; A is {_range(networks[_GAIN])} "
        f"%. Their RMSE is {_range(networks[_RMSE] / best, '.2f')} times "
        f"{'that of the oracle on the same windows' if has_oracle else 'the expected ceiling'}."
    )
    key = f"less_{CONSTANT}_dps"
    if key in networks and networks[key].notna().any():
        paired = networks[networks[key].notna()]
        worse, better = _signs(paired, key)
        sentences += (
            f" In pairs on the same windows, {better} of {len(paired)} are better than the "
            f"constant with their whole interval and {worse} worse."
        )
    return sentences


def _matched(material: Material) -> str:
    """The number of published gains within the intervals of our results."""
    rows = [(claim, material.result(claim, CNN)) for claim in material.claims]
    pairs = [(claim, row) for claim, row in rows if not row.empty]
    if not pairs:
        return ""
    inside = sum(
        row[f"{_GAIN}_lo"] <= claim.accuracy_gain_pct <= row[f"{_GAIN}_hi"] for claim, row in pairs
    )
    return (
        f"{len(pairs)} published results have a training set that was run here; {inside} of them "
        "are within the 95 % interval of ours, over all windows."
    )


def _more_data(networks: pd.DataFrame, count: str, addition: str) -> str:
    """The change of A with a count while the rest of the training set stays, in pairs."""
    key = f"added_{count}_pct"
    pairs = networks[networks[key].notna()] if key in networks else networks[:0]
    if pairs.empty:
        return ""
    better, worse = _signs(pairs, key)
    half = (pairs[f"{key}_hi"] - pairs[f"{key}_lo"]).median() / 2
    return (
        f"Adding {addition} changes A by {_range(pairs[key], '+.0f')} points, in {len(pairs)} "
        "comparisons paired over the same windows, all seeds together: the 95 % interval is "
        f"±{half:.1f} points (median), above 0 in {better} and below 0 in {worse}; about one in 20 "
        "excludes 0 by chance."
    )


def _beyond_ceiling(rows: pd.DataFrame) -> str:
    flagged = [
        beyond_ceiling(row, ALL) or beyond_ceiling(row, FIRST) or pd.notna(row.beyond_ceiling)
        for _, row in rows.iterrows()
    ]
    if not any(flagged):
        return ""
    rows = rows[flagged].drop_duplicates(["estimator", "sensor", "window_s"])
    names = ", ".join(
        f"{label(row.estimator)} on {row.sensor} at {row.window_s:g} s"
        for _, row in rows.iterrows()
    )
    reason = (
        "The ceiling is the linear optimum, axis by axis, for exchangeable power-ons; correlated "
        "axes, biases that follow one another or other noise leave more to gain"
    )
    if _ORACLE_GAIN in rows and rows[_ORACLE_GAIN].notna().any():
        oracle = _range(rows[_ORACLE_GAIN].dropna())
        reason = f"The ceiling is an expected value; on these windows the oracle has {oracle} %"
    return f"Entire 95 % interval above the ceiling: {names}. {reason}."


def _prior_conflicts(rows: pd.DataFrame) -> str:
    """Results whose recordings contradict the prior, with the error of the mean."""
    conflicts = rows[rows.prior_conflict.notna()]
    sentences = [
        f"{label(row.estimator)} on {row.sensor} at {row.window_s:g} s: {row.prior_conflict}"
        for _, row in conflicts.iterrows()
    ]
    return f"The prior does not hold. {'. '.join(sentences)}." if sentences else ""


def _oracle_check(rows: pd.DataFrame) -> str:
    checked = rows[rows.beats_oracle_p.notna() & ~rows.estimator.isin([MEAN, CNN_BEST])]
    checked = checked.drop_duplicates("fingerprints")
    if checked.empty:
        return ""
    corrected = holm(checked.beats_oracle_p.tolist())
    beaten = int((corrected < BEATS_ORACLE_P).sum())
    verdict = "No estimator beats" if not beaten else f"DEFECT OF THE EVALUATION: {beaten} beat"
    return (
        f"{verdict} the oracle, which knows the drawn values, on the same windows significantly: "
        f"the smallest p value of {len(checked)} is {corrected.min():.2g} after Holm's correction. "
        "(With 48 comparisons and 20 recordings, a leak that halves the errors is detected in 94 % "
        "of cases if all recordings leak, in 0 % if half of them do.)"
    )


def _range(values: pd.Series | Sequence[float], form: str = ".0f") -> str:
    return from_to(values, lambda value: f"{value:{form}}".replace("-", "−"))
