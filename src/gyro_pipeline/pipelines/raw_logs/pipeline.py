"""Wiring of the raw-logs stage."""

from kedro.pipeline import Node, Pipeline

from gyro_pipeline.pipelines.raw_logs.nodes import label_recordings


def create_pipeline(sensor: str) -> Pipeline:
    """Recordings of one sensor."""
    return Pipeline(
        [
            Node(
                label_recordings,
                f"{sensor}.raw_logs.files",
                f"{sensor}.raw_logs.recordings",
                name=f"label_{sensor}",
                namespace="raw_logs",
            )
        ]
    )
