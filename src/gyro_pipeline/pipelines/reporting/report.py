"""The report's content: what was run, tables, figures, what follows, and how each was made."""

from collections.abc import Iterable, Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import pandas as pd

from gyro_pipeline.conventions import AXES, Missing
from gyro_pipeline.parameters import Only, Published, Sensor, SimulatedSensor
from gyro_pipeline.pipelines.reporting.captions import CAPTIONS, FURTHER, Caption
from gyro_pipeline.pipelines.reporting.findings import compare, find
from gyro_pipeline.studies import CNN, MEAN
from gyro_pipeline.tracking import FINGERPRINT, StoredRun

Reasons = tuple[str, ...]
Part = pd.DataFrame | Path | Missing | list[StoredRun] | Reasons
_BASE = ("base", "local")
_RESULTS = "_results"
_LONG = "_comparison"
"""Ends the names of tables that are too long for a page; what it shows is drawn from them."""
_FEW = 6
"""So many missing commands are named where the table or figure would be."""


def write_report(
    source: str,
    only: Only,
    sensors: dict[str, Any],
    published: Published,
    folder: dict[str, pd.DataFrame | Path],
    **made: Part,
) -> tuple[dict[str, Any], Reasons]:
    """Gather what the report shows.

    Args:
        source: Where the logs come from.
        only: What the run was narrowed to.
        sensors: All of them, as configured.
        published: What the paper states.
        folder: Tables and figures of this source, also those that other runs left there.
        **made: By its address, what this run gave: results, also those measured elsewhere, the
            studies' runs, tables, figures, and their gaps.

    Returns:
        Variables of the report's templates, and the commands that make what is missing.
    """
    results = _results(made, ".reporting.results")
    elsewhere = _results(made, ".reporting.measured_elsewhere")
    runs = {run.run_id: run for part in made.values() if isinstance(part, list) for run in part}
    used = [runs[run_id] for ids in results.run_ids.dropna() for run_id in ids.split()]
    known_sensors = {name: Sensor(**sensor) for name, sensor in sensors.items()}
    networks = _networks(results, runs)
    fresh = {_place(address): part for address, part in made.items()}
    shown = folder | fresh
    env = _env(used)
    whole = [place for place in shown if place.startswith("tables/") and place.endswith(_RESULTS)]
    known = {*CAPTIONS, *whole}
    further = [place for place in folder if place not in known and not place.endswith(_LONG)]
    narrowed = ", ".join(f"{k}={v}" for k, v in only.model_dump(exclude_none=True).items())

    first = dict[str, str]()  # what said a text first

    def items(places: Iterable[str]) -> list[dict[str, Any]]:
        return [
            _item(place, shown, env, first) | {"earlier": place not in fresh} for place in places
        ]

    content = {
        "source": source,
        "smoke": "smoke" in source,
        "simulated": bool(used) and all(run.tags["simulated"] == "1" for run in used),
        "facts": _facts(
            source, narrowed, used, known_sensors, results, sorted(set(elsewhere.source))
        ),
        "tables": items(p for p in CAPTIONS if p.startswith("tables/")),
        "figures": items(p for p in CAPTIONS if p.startswith("figures/")),
        "results": items(whole),
        "comparison": compare(networks, known_sensors),
        "findings": find(networks, used, published, known_sensors),
        "further": items(further),
        "narrowed": narrowed,
        "studies": [
            _study(name, own, elsewhere[elsewhere.study == name], runs, env, narrowed)
            for name, own in results.groupby("study", sort=False)
        ],
    }
    gaps = [reason for part in made.values() if isinstance(part, tuple) for reason in part]
    return content, tuple(dict.fromkeys(gaps))


def _results(made: Mapping[str, Part], kind: str) -> pd.DataFrame:
    """Of all studies, with the column ``study``."""
    parts = [
        part.assign(study=address.split(".", maxsplit=1)[0])
        for address, part in made.items()
        if address.endswith(kind) and isinstance(part, pd.DataFrame)
    ]
    return pd.concat(parts, ignore_index=True)


def _networks(results: pd.DataFrame, runs: Mapping[str, StoredRun]) -> pd.DataFrame:
    """Results of networks that were made; what studies share counts once."""
    networks = results[results.missing.isna() & (results.estimator == CNN)]
    trainings = networks.run_ids.map(
        lambda ids: " ".join(sorted(runs[run_id].tags[FINGERPRINT] for run_id in ids.split()))
    )
    return networks[~trainings.duplicated()]


def _place(address: str) -> str:
    """``augmentation.reporting.tables.results`` is kept as ``tables/augmentation_results``."""
    study, _, rest = address.partition("reporting.")
    kind, _, name = rest.partition(".")
    return f"{kind}/{study.replace('.', '_')}{name}"


def _env(runs: Iterable[StoredRun]) -> str:
    """What a command needs to make these runs again."""
    envs = {run.tags["kedro_env"] for run in runs}
    return "".join(f" --env={env}" for env in envs if env not in _BASE and len(envs) == 1)


def _facts(
    source: str,
    narrowed: str,
    runs: Sequence[StoredRun],
    sensors: Mapping[str, Sensor],
    results: pd.DataFrame,
    elsewhere: Sequence[str],
) -> list[tuple[str, str]]:
    """What was run, in plain words."""
    if not runs:
        none = "no finished run with the current settings is there"
        advice = "Commands below need the `--env` of this report, if it has one."
        return [("Data", f"Source `{source}`; {none}. {advice}")]
    networks = {run.tags[FINGERPRINT]: run for run in runs if run.params["estimator"] == CNN}
    others = [run for run in runs if run.params["estimator"] not in (CNN, MEAN)]

    def of(name: str, some: Iterable[StoredRun]) -> str:
        values = sorted({float(run.params[name]) for run in some})
        return ", ".join(f"{value:g}" for value in values)

    trained = networks.values()
    fitted = {run.params["estimator"] for run in others}

    used = {name: sensors[name] for name in sensors if name in {r.params["sensor"] for r in runs}}
    started = [datetime.fromtimestamp(run.started_ms / 1000, UTC) for run in runs]
    simulated = all(run.tags["simulated"] == "1" for run in runs)
    facts = {
        "Data": _data(source, runs),
        "Recordings": _recordings(used) if simulated else _lengths(results),
        "Networks": f"{len(networks)} trained, of {of('epochs', trained)} epochs (the paper: 1200)",
        "Seeds": of("seed", trained),
        "Windows": f"{of('window_s', trained)} s",
        "Estimators": f"{len(fitted)} besides the mean and the network, "
        f"windows of {of('window_s', others)} s",
        "Trained": f"{min(started):%Y-%m-%d %H:%M} to {max(started):%Y-%m-%d %H:%M} UTC",
        "Code": _code(runs),
        "Environment": ", ".join(f"`{e}`" for e in sorted({r.tags["kedro_env"] for r in runs})),
    }
    for name in ("Networks", "Seeds", "Windows") if not networks else ():
        del facts[name]
    if not others:
        del facts["Estimators"]
    if narrowed:
        facts["Narrowed to"] = f"`only`: {narrowed}"
    if elsewhere:
        facts["Beside them"] = f"results on measured recordings of {', '.join(elsewhere)}"
    return [*facts.items()]


def _data(source: str, runs: Iterable[StoredRun]) -> str:
    if all(run.tags["simulated"] == "1" for run in runs):
        return (
            f"Simulated recordings (source `{source}`): this program drew the biases and the "
            "noise, in place of the authors' files. Nothing here was measured on a real sensor."
        )
    return f"Recordings measured on real sensors (source `{source}`)."


def _lengths(results: pd.DataFrame) -> str:
    """Of measured recordings, whose number and length the configuration does not know."""
    lengths = results[results.missing.isna()].groupby("sensor", sort=False).recording_s.first()
    return ", ".join(f"{name}: {length:.4g} s each" for name, length in lengths.items())


def _recordings(sensors: Mapping[str, Sensor]) -> str:
    """How many hours were simulated."""
    simulated = {name: SimulatedSensor(**one.model_dump()) for name, one in sensors.items()}
    seconds = [
        len(AXES)
        * (one.imus * one.train_recordings + one.recordings - one.train_recordings)
        * one.recording_s
        for one in simulated.values()
    ]
    each = ", ".join(
        f"{name} {one.imus} × {one.recordings} of {one.recording_s:g} s"
        for name, one in simulated.items()
    )
    return (
        f"{sum(seconds) / 3600:.1f} h: training recordings of every gyroscope, test recordings of "
        f"IMU 1 (IMUs × recordings: {each})"
    )


def _code(runs: Sequence[StoredRun]) -> str:
    """Commits and versions; a commit says little where files had been changed since."""
    commits = {
        f"`{run.tags.get('mlflow.source.git.commit', '')[:12] or 'unknown'}`"
        + (" with uncommitted changes" if run.tags["git_dirty"] == "True" else "")
        for run in runs
    }
    versions = {f"gyro-pipeline {r.tags['gyro-pipeline']}, torch {r.tags['torch']}" for r in runs}
    return f"commit {', '.join(sorted(commits))}; {'; '.join(sorted(versions))}"


def _item(place: str, shown: Mapping[str, Part], env: str, first: dict[str, str]) -> dict[str, Any]:
    """A table or figure with its title, caption and the commands that make it."""
    caption = CAPTIONS.get(place) or FURTHER.get(place) or _plain_caption(place)
    part, gap = shown.get(place), shown.get(_gap(place))
    command = f"kedro run --pipeline={caption.pipeline}" if caption.pipeline else ""
    missing = gap if isinstance(gap, tuple) and 0 < len(gap) <= _FEW else (command,)
    made = isinstance(part, pd.DataFrame | Path)
    text = caption.text
    if made and place in CAPTIONS and first.setdefault(text, caption.title) != caption.title:
        text = f"To be read like “{first[text]}”."
    section = f" Paper, section {caption.section}." if caption.section else ""
    return {
        "anchor": place.replace("/", "-"),
        "title": caption.title,
        "caption": text + section,
        "command": command and command + env,
        "made": made,
        "missing": [one + env for one in missing],
        "table": _narrow(part) if isinstance(part, pd.DataFrame) else None,
        "figure": part if isinstance(part, Path) else None,
    }


def _gap(place: str) -> str:
    """Where it is kept what a table or figure lacks."""
    kind, name = place.split("/", maxsplit=1)
    return f"gaps/{name}" + ("_figure" if kind == "figures" else "")


def _narrow(table: pd.DataFrame) -> pd.DataFrame:
    """Without what the page says elsewhere (source, section, runs), and columns of dashes."""
    said = ["Runs", "runs", "Section"]
    said += [name for name in ("Source", "source") if name in table and table[name].nunique() == 1]
    said += [str(name) for name in table if (table[name] == "–").all()]
    return table.drop(columns=said, errors="ignore")


def _plain_caption(place: str) -> Caption:
    """Of a table or figure that is known by its file name only."""
    name = place.split("/", maxsplit=1)[1]
    study = name.removesuffix(_RESULTS)
    title = name.replace("_", " ")
    if study == name:
        return Caption(title[:1].upper() + title[1:], "", "")
    return Caption(f"All results of the study {study}", "", study)


def _study(
    name: Any,
    results: pd.DataFrame,
    elsewhere: pd.DataFrame,
    runs: Mapping[str, StoredRun],
    env: str,
    narrowed: str,
) -> dict[str, Any]:
    """Which command and which runs made the results of a study, and what is missing."""
    own = [(row, "") for _, row in results[results.missing.isna()].iterrows()]
    others = [(row, f" ({row.source})") for _, row in elsewhere.iterrows()]
    return {
        "name": name,
        "command": f"kedro run --pipeline={name}{env}",
        "rows": [
            {"label": _label(row) + where, "runs": [runs[one] for one in row.run_ids.split()]}
            for row, where in own + others
        ],
        # of a run that was narrowed on purpose, nothing is
        "missing": [] if narrowed else [command + env for command in results.missing.dropna()],
    }


def _label(row: pd.Series) -> str:
    if row.estimator == MEAN:
        return f"{row.sensor}, running mean, {row.window_s:g} s"
    if row.estimator != CNN:
        gain = f"A {row.accuracy_gain_pct_all:.0f} %"
        return f"{row.sensor}, {row.estimator}, {row.window_s:g} s: {gain}"
    virtual = f" + {row.virtual_gyros} virtual" if row.virtual_gyros else ""
    channels = ", as input channels" if row.method == 1 else ""
    return (
        f"{row.sensor}, {row.real_gyros} real{virtual}{channels}, {row.window_s:g} s: "
        f"A {row.accuracy_gain_pct_all:.0f} %"
    )
