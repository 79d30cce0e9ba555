"""The report of a source: its tables, its figures, and the page with them, as Markdown.

Modules that draw are imported where they are used, since every run imports this module.
"""

from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from itertools import product
from typing import Any

import pandas as pd
from jinja2 import Environment, PackageLoader, StrictUndefined

from gyro_pipeline.conventions import AXES
from gyro_pipeline.estimators import DEFAULT, ESTIMATORS, named_class
from gyro_pipeline.markup import escape, pipe_table
from gyro_pipeline.parameters import GroundTruth, Only, Published, Study
from gyro_pipeline.pipelines.reporting import tables
from gyro_pipeline.pipelines.reporting.exhibits import Exhibit, Material, label, where
from gyro_pipeline.pipelines.reporting.findings import answer, findings
from gyro_pipeline.pipelines.reporting.results import CNN_BEST, NOT_RUN, ROW, WARNINGS
from gyro_pipeline.studies import CNN, CONSTANT, LEAKAGE, MEAN

Tables = Mapping[str, Callable[[], pd.DataFrame]]
PAPER_STUDIES = ("augmentation", "real2real", "input_channels", tables.FIRST_WINDOWS)
"""Studies that repeat the paper's; any other one has a figure and a table for each sensor."""

_BASE = ("base", "local")
_OPTIONS = {
    "warm_up": "It models a warm-up.",
    "history": "Its prior follows from the earlier calibrations, in their order.",
    "fallback": "It allows for a wrong prior.",
    "noise": "Its N, B and K are those of the Allan fit.",
    "same_time": "There is a regression for each start of a window.",
    "shuffled": "The labels are shuffled, so it can learn nothing.",
}
"""What the fixed options of estimators mean."""
_COLUMNS = [*ROW, "study", "status", "run_ids", "fingerprints", "env", "simulated"]
_COLUMNS += ["recommended", "own_ceiling", "beats_oracle_p", *WARNINGS]
"""Columns that the table of results has even without a row."""


def write_report(
    source: str,
    only: Only,
    published: Published,
    ground_truth: GroundTruth,
    studies: dict[str, Any],
    sensors: dict[str, Any],
    earlier: Tables,
    **fresh: Tables,
) -> tuple[dict[str, pd.DataFrame], dict[str, Any], str]:
    """The tables by name, the figures by name, and the page of a source as Markdown.

    ``earlier`` has stored results and descriptions of this source, by ``<study or
    sensor>/<table>``, ``fresh`` those of this run, by study or sensor. Configured studies that were
    not run are listed.
    """
    stored = dict(earlier)
    for name, loaders in fresh.items():
        stored |= {f"{name}/{table}": load for table, load in loaders.items()}
    material = _material(source, published, stored)
    possible = {
        **_figures(material, ground_truth),
        "start_up": [tables.start_up(material)],
        "tables": _tables(material),
        "files": _files(material),
    }
    exhibits = {
        part: [exhibit for exhibit in candidates if exhibit is not None]
        for part, candidates in possible.items()
    }
    contents = [(exhibit.name, exhibit.content) for part in exhibits.values() for exhibit in part]
    page = _page().render(
        exhibits,
        material=material,
        source=material.source_name,
        smoke="smoke" in source,
        answer=answer(material),
        findings=findings(material),
        explained=_explained(material.finished.estimator),
        facts=_facts(material, only, fresh),
        missing=_missing(material, only, studies, sensors),
        runs=_runs(material),
    )
    return (
        {name: content for name, content in contents if isinstance(content, pd.DataFrame)},
        {name: content for name, content in contents if not isinstance(content, pd.DataFrame)},
        page,
    )


def _material(source: str, published: Published, stored: Tables) -> Material:
    def gathered(table: str, columns: Sequence[str]) -> pd.DataFrame:
        parts = [
            load()
            for address, load in stored.items()  # deeper ones are of commands with --params
            if address.partition("/")[2] == table and not address.startswith(f"{LEAKAGE}/")
        ]
        # tables of earlier versions, whose plain names meant first windows, have to be made again
        parts = [part for part in parts if len(part) and "test_rmse_dps_all" not in part]
        return pd.concat(parts, ignore_index=True) if parts else pd.DataFrame(columns=[*columns])

    results = gathered("results", _COLUMNS)
    leaks = stored.get(f"{LEAKAGE}/results", pd.DataFrame)
    return Material(
        source=source,
        published=published,
        results=results.reindex(columns=results.columns.union(_COLUMNS, sort=False)),
        curves=gathered("curves", ["study", "sensor"]),
        leaks=leaks(),
        sensors=gathered("description", ["sensor"]),
        quality=gathered("quality", []),
        signals=gathered("signals", ["sensor", "figure"]),
    )


def _tables(material: Material) -> list[Exhibit | None]:
    return [
        *(tables.paper_results(material, table) for table in tables.PAPER_TABLES),
        tables.trained_on_first_windows(material),
        *(tables.ratios(material, study, sensor) for study, sensor in _comparisons(material)),
        tables.sensor_specifications(material),
        tables.recording_quality(material),
        tables.dataset_hours(material),
        tables.leakage_results(material),
    ]


def _figures(material: Material, ground_truth: GroundTruth) -> dict[str, list[Exhibit | None]]:
    """The figures by their part of the page."""
    from gyro_pipeline.pipelines.reporting import figures, signals  # noqa: PLC0415

    drawn = [pair for pair in _comparisons(material) if pair[0] not in PAPER_STUDIES]
    others = [
        *(figures.estimators(material, study, sensor) for study, sensor in drawn),
        figures.saving_against_turn_on_spread(material),
        figures.input_channels(material),
        figures.training_data(material),
        figures.gyroscopes_10s(material),
        *(figures.augmentation(material, *row) for row in product(("sparkfun", "dot"), (3, 12))),
        signals.allan_deviation(material),
        signals.running_average(material, ground_truth),
        signals.calibrated_signal(material),
        signals.mg_convergence(material, ground_truth),
        figures.leakage_against_stride(material),
    ]
    return {
        "drift": [signals.drift(material)],
        "forest": [figures.forest(material)],
        "figures": others,
    }


def _files(material: Material) -> list[Exhibit | None]:
    """Tables that are too long for the page."""
    studies = material.results.study.unique().tolist()
    compared = dict.fromkeys(study for study, _ in _comparisons(material))
    return [
        *(tables.results_table(material, study) for study in studies),
        *(tables.comparison(material, study) for study in compared),
    ]


def _comparisons(material: Material) -> list[tuple[str, str]]:
    """Each study that compares estimators, or has a user's, with each of its sensors."""
    results = material.results
    rows = results[
        ~results.study.isin(PAPER_STUDIES) | ~results.estimator.isin([*ESTIMATORS, CNN_BEST])
    ]
    return [*rows[["study", "sensor"]].drop_duplicates().itertuples(index=False, name=None)]


def _explained(estimators: Iterable[str]) -> list[tuple[str, str]]:
    """Name and description of each estimator in the report, those of the first figure first."""
    present = {*estimators} - {CNN_BEST}
    order = dict.fromkeys([MEAN, CNN, CONSTANT, DEFAULT, *ESTIMATORS, *sorted(present)])
    return [(label(name), _description(name)) for name in order if name in present]


def _description(name: str) -> str:
    """The first sentence of the docstring of an estimator, and its fixed options."""
    first = " ".join((named_class(name).__doc__ or "No description.").split("\n\n")[0].split())
    _, options = ESTIMATORS.get(name, (name, {}))
    return " ".join([first, *(_OPTIONS[key] for key, value in options.items() if value)])


def _facts(material: Material, only: Only, fresh: Collection[str]) -> dict[str, str]:
    """How the numbers were made: data, networks, windows, code and environment."""
    rows = material.finished
    facts = {
        "Data": _data(material),
        "Recordings": "; ".join(
            f"{material.sensor_name(row.sensor)}: {row.imus} IMUs, "
            f"{row.all_recordings / len(AXES):.0f} "
            f"recordings used of {row.median_samples / row.rate_hz:.4g} s"
            for _, row in material.sensors.iterrows()
        ),
    }
    networks = where(rows, estimator=CNN).drop_duplicates("fingerprints")
    if len(networks):
        epochs = ", ".join(f"{count:.0f}" for count in sorted(networks.epochs.dropna().unique()))
        facts["Networks"] = f"{len(networks)}, of {epochs} epochs (the paper: 1200)"
        facts["Seeds"] = f"{networks.seeds.max():.0f}"
    if len(rows):
        facts |= {
            "Windows": ", ".join(f"{time_s:g}" for time_s in sorted(rows.window_s.unique())) + " s",
            "Trained": f"{rows.started.min()} to {rows.started.max()} UTC",
            "Code": "; ".join(sorted(rows.code.unique())),
            "Environment": ", ".join(sorted(rows.env.unique())),
        }
    filters = only.model_dump(exclude_none=True).items()
    facts["Narrowed to"] = ", ".join(f"{name}={value}" for name, value in filters)
    studies = material.results.study.unique()
    facts["From earlier runs"] = ", ".join(study for study in studies if study not in fresh)
    return {name: text for name, text in facts.items() if text}


def _data(material: Material) -> str:
    if material.simulated:
        return (
            f"Simulated recordings (source {material.source}): this program drew the biases and "
            "the noise, in place of the authors' files. Nothing was measured on a real sensor."
        )
    return f"Recordings measured on real sensors (source {material.source})."


def _missing(
    material: Material, only: Only, studies: Mapping[str, Any], sensors: Iterable[str]
) -> pd.DataFrame:
    """The fewest commands that make the missing results, and the results of each."""
    envs = {env for env in material.finished.env.dropna() if env not in _BASE}
    env = f" --env={envs.pop()}" if len(envs) == 1 else ""
    makes: dict[str, list[str]] = {}
    for name, settings in studies.items():
        study = Study.model_validate(settings)
        studied = [s for s in study.sensors_among(sensors) if only.sensor in (None, s)]
        rows = where(material.results, study=name)
        lacking, begun = int((rows.status == NOT_RUN).sum()), len(rows) > 0
        if not studied or (begun and not lacking) or not (begun or study.default):
            continue
        command = f"kedro run{'' if study.default else f' --pipeline={name}'}{env}"
        results = f"{lacking} of {len(rows)} results of {name}" if begun else f"the study {name}"
        makes.setdefault(command, []).append(results)
    table = {"Command": [*makes], "Makes": [", ".join(names) for names in makes.values()]}
    return pd.DataFrame(table)


def _runs(material: Material) -> list[dict[str, Any]]:
    """The number of results and runs of each study, and its experiment in MLflow."""
    return [
        {
            "study": study,
            "results": len(rows),
            "runs": rows.run_ids.str.split().explode().nunique(),
            "experiment": str(rows.experiment_id.iloc[0]),
        }
        for study, rows in material.finished.groupby("study", sort=False)
    ]


def _page() -> Any:
    environment = Environment(
        loader=PackageLoader("gyro_pipeline", "pipelines/reporting"),
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        autoescape=False,  # of HTML: what is rendered is Markdown, escaped by the filter below
    )
    environment.filters |= {"md": escape, "pipes": pipe_table}
    return environment.get_template("report.md.j2")
