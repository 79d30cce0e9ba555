"""Wiring of the windowed-splits stage."""

from kedro.pipeline import Node, Pipeline

from gyro_pipeline.pipelines.windowed_splits.nodes import split_devices, split_recordings


def create_pipeline(sensor: str, unseen_devices: bool = False) -> Pipeline:
    """Roles of one sensor's recordings.

    Args:
        sensor: Its name.
        unseen_devices: Whether every IMU in turn is an unseen one.
    """
    made = (split_devices, "devices") if unseen_devices else (split_recordings, "roles")
    return Pipeline(
        [
            Node(
                made[0],
                [f"{sensor}.raw_logs.recordings", "params:splits"],
                f"{sensor}.windowed_splits.{made[1]}",
                name=f"{made[0].__name__}_{sensor}",
                namespace="windowed_splits",
            )
        ]
    )
