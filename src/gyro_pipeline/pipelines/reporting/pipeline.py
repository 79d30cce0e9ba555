"""Wiring of the reporting stage."""

from collections.abc import Callable, Mapping, Sequence
from itertools import product
from typing import Any

import pandas as pd
from kedro.pipeline import Node, Pipeline

from gyro_pipeline.pipelines.reporting import figures, leakage, signals, tables
from gyro_pipeline.pipelines.reporting.nodes import (
    missing_results,
    or_missing,
    pool_measured_elsewhere,
    pool_results,
    refuse_gaps,
)
from gyro_pipeline.pipelines.reporting.quality import recording_quality
from gyro_pipeline.pipelines.reporting.report import write_report
from gyro_pipeline.studies import LEAKAGE

_Function = Callable[..., Any]
_Makers = Mapping[str, Mapping[_Function, Sequence[str]]]

TABLES: _Makers = {
    "augmentation": {
        tables.three_gyroscopes: ["results", "published"],
        tables.multiple_gyroscopes: ["results", "published"],
    },
    "real2real": {tables.generalization: ["results", "measured_elsewhere", "published"]},
    "estimators": {tables.comparison: ["results", "measured_elsewhere"]},
    "unseen_devices": {tables.comparison: ["results", "measured_elsewhere"]},
    "networks": {tables.comparison: ["results", "measured_elsewhere"]},
    "sweep": {tables.comparison: ["results", "measured_elsewhere"]},
}
FIGURES: _Makers = {
    "augmentation": {
        figures.sparkfun_3_real: ["results", "curves", "published"],
        figures.sparkfun_12_real: ["results", "curves", "published"],
        figures.dot_3_real: ["results", "curves", "published"],
        figures.dot_12_real: ["results", "curves", "published"],
    },
    "real2real": {
        figures.training_data: ["results", "curves", "published"],
        figures.gyroscopes_10s: ["results", "published"],
        figures.saving_against_turn_on_spread: ["results", "measured_elsewhere", "published"],
    },
    "input_channels": {figures.input_channels: ["results", "curves"]},
}
"""The tables and figures that each study carries, and what they are made from."""

OF_EACH_SENSOR = {"tables": tables.ratios, "figures": figures.estimators}
"""What studies that compare estimators have for each of their sensors, named after it."""

COMPARED = ("estimators", "unseen_devices", "networks", "sweep")

_SHOWN = "sparkfun"
"""Whose signals the figures of signals show."""


def create_pipeline(
    studies: Mapping[str, Sequence[str]],
    sensors: Sequence[str] = (),
    virtual: Sequence[str] = (),
    inspected: Sequence[str] = (),
) -> Pipeline:
    """Tables and figures of some studies, and of the recordings.

    Args:
        studies: All sensors of each study.
        sensors: Those whose recordings the report describes; none in a single study's report.
        virtual: Those that have virtual gyroscopes.
        inspected: Those whose raw logs may have been read.
    """
    nodes = [_quality_node(inspected)] if inspected else []
    for study, studied in studies.items():
        nodes += _study_nodes(study, studied)
    if sensors:
        nodes += _recording_nodes(sensors, virtual)
    made = [output for node in nodes for output in node.outputs]
    parts = ("results", "measured_elsewhere", "tables.", "figures.", "gaps.")
    shown = [name for name in made if name.partition("reporting.")[2].startswith(parts)]
    shown += [f"{study}.reporting.all_runs" for study in studies]
    given = {name: f"params:{name}" for name in ("source", "only", "sensors", "published")}
    scope = "all" if sensors else "_".join(studies)
    end = [
        Node(
            write_report,
            given | {"folder": "reporting.folder"} | {name: name for name in shown},
            ["reporting.report", "reporting.gaps.all"],
            name=f"write_report_of_{scope}",
            namespace="reporting",
        ),
        Node(
            refuse_gaps,
            ["params:only", "reporting.gaps.all"],
            None,
            name=f"refuse_gaps_in_{scope}",
            namespace="reporting",
        ),
    ]
    return Pipeline([*nodes, *end])


def create_leakage_pipeline(sensors: Sequence[str]) -> Pipeline:
    """Table and figure of the leak study, which no other report shows."""
    stage, pooled = f"{LEAKAGE}.reporting", f"{LEAKAGE}.reporting.results"
    stored = {f"{sensor}_plan": f"{LEAKAGE}.{sensor}.training.plan" for sensor in sensors}
    stored |= {f"{sensor}_runs": f"{LEAKAGE}.{sensor}.evaluation.runs" for sensor in sensors}
    given = {name: f"params:{name}" for name in ("published", "training", "sensors")}
    given |= {"study": f"params:studies.{LEAKAGE}"}
    makers: dict[_Function, tuple[dict[str, str], str]] = {
        leakage.pool_leakage: (stored | {"evaluation": "params:evaluation"}, pooled),
        leakage.results_table: (
            {"results": pooled, "published": given["published"]},
            f"{stage}.tables.results",
        ),
        leakage.accuracy_against_stride: (
            {"results": pooled} | given,
            f"{stage}.figures.accuracy_against_stride",
        ),
    }
    return Pipeline(
        [
            Node(function, *wired, name=f"{function.__name__}_{LEAKAGE}", namespace="reporting")
            for function, wired in makers.items()
        ]
    )


def _study_nodes(study: str, sensors: Sequence[str]) -> list[Node]:
    stage = f"{study}.reporting"
    parts = "source windows_s seeds training splits virtual_gyros evaluation".split()
    settings = {"study": f"params:studies.{study}"} | {name: f"params:{name}" for name in parts}
    stored = {f"{sensor}_runs": f"{study}.{sensor}.evaluation.runs" for sensor in sensors}
    stored |= {f"{sensor}_plan": f"{study}.{sensor}.training.plan" for sensor in sensors}
    pooled = [f"{stage}.{name}" for name in ("results", "curves", "unused")]
    elsewhere = f"{stage}.measured_elsewhere"
    nodes = [
        Node(
            pool_results,
            settings | stored,
            pooled,
            name=f"pool_{study}",
            namespace="reporting",
        ),
        Node(
            pool_measured_elsewhere,
            settings | {"all_runs": f"{stage}.all_runs"},
            elsewhere,
            name=f"pool_measured_elsewhere_{study}",
            namespace="reporting",
        ),
        Node(
            missing_results,
            pooled[0],
            f"{stage}.gaps.missing_results",
            name=f"missing_results_{study}",
            namespace="reporting",
        ),
        _made(tables.results_table, [pooled[0], elsewhere], f"{stage}.tables.results", study),
    ]
    for kind, makers in (("tables", TABLES), ("figures", FIGURES)):
        for function, wanted in makers.get(study, {}).items():
            inputs = ["params:published" if w == "published" else f"{stage}.{w}" for w in wanted]
            nodes.append(_made(function, inputs, f"{stage}.{kind}.{function.__name__}", study))
    if study in COMPARED:
        inputs = [pooled[0], elsewhere]
        for (kind, make), sensor in product(OF_EACH_SENSOR.items(), sensors):
            function = _of_sensor(make, sensor)
            nodes.append(_made(function, inputs, f"{stage}.{kind}.{sensor}", f"{kind}_{study}"))
    return nodes


def _of_sensor(make: _Function, sensor: str) -> _Function:
    """A function of a sensor's results as one that knows the sensor, and has its name."""

    def made(results: pd.DataFrame, elsewhere: pd.DataFrame) -> Any:
        return make(results, elsewhere, sensor)

    made.__name__, made.__doc__ = sensor, make.__doc__
    return made


def _recording_nodes(sensors: Sequence[str], virtual: Sequence[str]) -> list[Node]:
    recordings = {f"{sensor}_recordings": f"{sensor}.raw_logs.recordings" for sensor in sensors}
    noise = {f"{sensor}_noise": f"{sensor}.ground_truth.noise" for sensor in sensors}
    allan = {f"{sensor}_allan": f"{sensor}.ground_truth.allan" for sensor in sensors}
    drawn = {f"{sensor}_virtual": f"{sensor}.virtual_gyros.recordings" for sensor in virtual}
    published = {"published": "params:published"}
    signal = {"recordings": f"{_SHOWN}.raw_logs.recordings", "bias": f"{_SHOWN}.ground_truth.bias"}
    settled = signal | {"ground_truth": "params:ground_truth"}
    made: list[tuple[str, _Function, dict[str, str]]] = [
        ("tables", tables.sensor_specifications, published | recordings | noise),
        ("tables", tables.dataset_hours, published | recordings | drawn),
        ("figures", signals.running_average, settled),
        ("figures", signals.calibrated_signal, signal),
        ("figures", signals.mg_convergence, settled),
        ("figures", signals.allan_deviation, published | recordings | allan | noise),
    ]
    return [
        _made(function, inputs, f"reporting.{kind}.{function.__name__}")
        for kind, function, inputs in made
    ]


def _quality_node(sensors: Sequence[str]) -> Node:
    """It shows what there is, so it is no part of :func:`_made`."""
    name = recording_quality.__name__
    return Node(
        recording_quality,
        {f"{sensor}_quality": f"{sensor}.raw_logs.quality" for sensor in sensors},
        [f"reporting.tables.{name}", f"reporting.gaps.{name}"],
        name=name,
        namespace="reporting",
    )


def _made(
    function: _Function, inputs: list[str] | dict[str, str], output: str, study: str = ""
) -> Node:
    """A table or figure, and what it lacks."""
    name = function.__name__
    place, kind, _ = output.rsplit(".", maxsplit=2)
    return Node(
        or_missing(function),
        inputs,
        [output, f"{place}.gaps.{name}" + ("_figure" if kind == "figures" else "")],
        name=f"{name}_{study}" if study else name,
        namespace="reporting",
    )
