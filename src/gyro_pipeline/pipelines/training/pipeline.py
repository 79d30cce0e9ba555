"""Wiring of the training stage."""

from kedro.pipeline import Node, Pipeline

from gyro_pipeline.pipelines.training.nodes import plan, train


def create_pipeline(study: str, sensor: str, virtual: bool) -> Pipeline:
    """Trainings of one study on one sensor.

    Args:
        study: Its name.
        sensor: Its name.
        virtual: Whether virtual gyroscopes take part.
    """
    stage = f"{study}.{sensor}.training"
    data = {
        "recordings": f"{sensor}.raw_logs.recordings",
        "roles": f"{sensor}.windowed_splits.roles",
        "training": "params:training",
    }
    if virtual:
        data["virtual"] = f"{sensor}.virtual_gyros.recordings"
    return Pipeline(
        [
            Node(
                plan,
                data
                | {
                    "study": f"params:studies.{study}",
                    "windows_s": "params:windows_s",
                    "seeds": "params:seeds",
                    "only": "params:only",
                },
                f"{stage}.cells",
                name=f"plan_{study}_{sensor}",
                namespace="training",
            ),
            Node(
                train,
                data
                | {
                    "cells": f"{stage}.cells",
                    "tracked": f"{sensor}.training.tracked",
                    "bias": f"{sensor}.ground_truth.bias",
                    "splits": "params:splits",
                    "virtual_gyros": "params:virtual_gyros",
                    "execution": "params:execution",
                },
                f"{stage}.runs",
                name=f"train_{study}_{sensor}",
                namespace="training",
            ),
        ]
    )
