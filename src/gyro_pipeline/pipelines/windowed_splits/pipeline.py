"""Wiring of the windowed-splits stage."""

from kedro.pipeline import Node, Pipeline

from gyro_pipeline.pipelines.windowed_splits.nodes import (
    cut_to_shortest,
    split_devices,
    split_recordings,
)


def create_cut_pipeline(sensor: str) -> Pipeline:
    """One sensor's recordings, all of one length, and their biases."""
    stage = f"{sensor}.windowed_splits"
    return Pipeline(
        [
            Node(
                cut_to_shortest,
                [
                    f"{sensor}.raw_logs.recordings",
                    f"{sensor}.ground_truth.bias",
                    f"{sensor}.raw_logs.quality",
                ],
                [f"{stage}.recordings", f"{stage}.bias"],
                name=f"cut_to_shortest_{sensor}",
                namespace="windowed_splits",
            )
        ]
    )


def create_pipeline(sensor: str, unseen_devices: bool = False) -> Pipeline:
    """Recordings of one length of one sensor, and their roles.

    Args:
        sensor: Its name.
        unseen_devices: Whether every IMU in turn is an unseen one.
    """
    made = (split_devices, "devices") if unseen_devices else (split_recordings, "roles")
    return create_cut_pipeline(sensor) + Pipeline(
        [
            Node(
                made[0],
                [f"{sensor}.windowed_splits.recordings", "params:splits"],
                f"{sensor}.windowed_splits.{made[1]}",
                name=f"{made[0].__name__}_{sensor}",
                namespace="windowed_splits",
            )
        ]
    )
