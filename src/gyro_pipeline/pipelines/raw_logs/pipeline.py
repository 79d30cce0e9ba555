"""Wiring of the raw-logs stage."""

from kedro.pipeline import Node, Pipeline

from gyro_pipeline.pipelines.raw_logs.nodes import inspect_logs, require_enough


def create_pipeline(sensor: str) -> Pipeline:
    """Recordings of one sensor."""
    stage = f"{sensor}.raw_logs"
    return Pipeline(
        [
            Node(
                inspect_logs,
                [f"{stage}.files", "params:quality", "params:execution"],
                [f"{stage}.inspected", f"{stage}.quality"],
                name=f"inspect_{sensor}",
                namespace="raw_logs",
            ),
            Node(
                require_enough,
                [f"{stage}.inspected", f"{stage}.quality", "params:quality"],
                f"{stage}.recordings",
                name=f"require_enough_{sensor}",
                namespace="raw_logs",
            ),
        ]
    )
