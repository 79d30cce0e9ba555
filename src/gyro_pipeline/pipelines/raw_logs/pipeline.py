"""Wiring of the raw-logs stage."""

from kedro.pipeline import Node, Pipeline

from gyro_pipeline.pipelines.raw_logs.nodes import inspect_logs, label_recordings, quality_table


def create_pipeline(sensor: str) -> Pipeline:
    """Recordings of one sensor."""
    stage = f"{sensor}.raw_logs"
    return Pipeline(
        [
            Node(
                inspect_logs,
                [f"{stage}.files", f"{stage}.earlier", "params:quality", "params:execution"],
                f"{stage}.inspected",
                name=f"inspect_{sensor}",
                namespace="raw_logs",
                tags=[sensor],
            ),
            Node(
                quality_table,
                [f"{stage}.files", f"{stage}.inspected"],
                f"{stage}.quality",
                name=f"quality_table_{sensor}",
                namespace="raw_logs",
                tags=[sensor],
            ),
            Node(
                label_recordings,
                [
                    f"{stage}.files",
                    f"{stage}.inspected",
                    f"{stage}.quality",
                    "params:quality",
                    "params:splits",
                ],
                f"{stage}.recordings",
                name=f"label_{sensor}",
                namespace="raw_logs",
                tags=[sensor],
            ),
        ]
    )
