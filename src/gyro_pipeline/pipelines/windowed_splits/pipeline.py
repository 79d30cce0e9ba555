"""Wiring of the windowed-splits stage."""

from kedro.pipeline import Node, Pipeline

from gyro_pipeline.pipelines.windowed_splits.nodes import split_recordings


def create_pipeline(sensor: str) -> Pipeline:
    """Roles of one sensor's recordings."""
    return Pipeline(
        [
            Node(
                split_recordings,
                [f"{sensor}.raw_logs.recordings", "params:splits"],
                f"{sensor}.windowed_splits.roles",
                name=f"split_{sensor}",
                namespace="windowed_splits",
            )
        ]
    )
