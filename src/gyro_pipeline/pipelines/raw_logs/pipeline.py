"""Wiring of the raw-logs stage."""

from collections.abc import Callable
from typing import Any

from kedro.pipeline import Node, Pipeline

from gyro_pipeline.pipelines.raw_logs.nodes import inspect_logs, label_recordings, quality_table


def create_pipeline(sensor: str) -> Pipeline:
    """The recordings of a sensor."""
    stage, quality, settings = f"{sensor}.raw_logs", "params:quality", "params:execution"
    files, inspected, table = f"{stage}.files", f"{stage}.inspected", f"{stage}.quality"
    labelled = [files, inspected, table, quality, "params:splits"]
    nodes: list[tuple[str, Callable[..., Any], list[str], str]] = [
        ("inspect", inspect_logs, [files, f"{stage}.earlier", quality, settings], inspected),
        ("quality_table", quality_table, [files, inspected], table),
        ("label", label_recordings, labelled, f"{stage}.recordings"),
    ]
    return Pipeline(
        [
            Node(make, inputs, output, name=f"{name}_{sensor}", namespace="raw_logs", tags=[sensor])
            for name, make, inputs, output in nodes
        ]
    )
