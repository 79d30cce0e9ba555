"""Wiring of the reporting stage."""

from collections.abc import Mapping, Sequence
from typing import Any

from kedro.pipeline import Node, Pipeline

from gyro_pipeline.pipelines.reporting.leakage import pool_leakage
from gyro_pipeline.pipelines.reporting.nodes import write_report
from gyro_pipeline.pipelines.reporting.recordings import describe
from gyro_pipeline.pipelines.reporting.results import pool_results
from gyro_pipeline.studies import LEAKAGE

REPORT = ["reporting.tables", "reporting.figures", "reporting.report"]


def create_pipeline(
    studies: Mapping[str, Sequence[str]], sensors: Sequence[str], virtual: Sequence[str]
) -> Pipeline:
    """The report of some studies, and of the recordings that they use.

    Args:
        studies: The sensors of each study.
        sensors: Sensors whose recordings the report describes.
        virtual: Sensors with virtual gyroscopes.
    """
    nodes = [_pooled(study, studied) for study, studied in studies.items() if studied]
    nodes += [_described(sensor, sensor in virtual) for sensor in sensors]
    settings = "source only published ground_truth studies sensors".split()
    inputs = {name: f"params:{name}" for name in settings} | {"earlier": "reporting.earlier"}
    inputs |= {output.split(".")[0]: output for node in nodes for output in node.outputs}
    report = _node(write_report, inputs, REPORT, "_".join(studies))
    return Pipeline([*nodes, report])


def _pooled(study: str, sensors: Sequence[str]) -> Node:
    inputs = {f"{sensor}_plan": f"{study}.{sensor}.training.plan" for sensor in sensors}
    inputs |= {f"{sensor}_runs": f"{study}.{sensor}.evaluation.runs" for sensor in sensors}
    pool: Any = pool_leakage if study == LEAKAGE else pool_results
    settings = "training sensors" if study == LEAKAGE else "source windows_s seeds only"
    inputs |= {name: f"params:{name}" for name in settings.split()} | {
        "study": f"params:studies.{study}"
    }
    return _node(pool, inputs, f"{study}.reporting.pooled", study)


def _described(sensor: str, virtual: bool) -> Node:
    inputs = {name: f"{sensor}.raw_logs.{name}" for name in ("recordings", "quality")}
    inputs |= {name: f"{sensor}.ground_truth.{name}" for name in ("bias", "noise", "allan")}
    inputs |= {"ground_truth": "params:ground_truth"}
    if virtual:
        inputs["virtual"] = f"{sensor}.virtual_gyros.recordings"
    return _node(describe, inputs, f"{sensor}.reporting.description", sensor)


def _node(function: Any, inputs: dict[str, str], outputs: str | list[str], owner: str) -> Node:
    name = f"{function.__name__}_{owner}"
    return Node(function, inputs, outputs, name=name, namespace="reporting")
