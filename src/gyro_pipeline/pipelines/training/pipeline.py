"""Wiring of the training stage."""

from kedro.pipeline import Node, Pipeline

from gyro_pipeline.pipelines.training.leakage import plan_leakage, train_leakage
from gyro_pipeline.pipelines.training.nodes import plan, train
from gyro_pipeline.studies import LEAKAGE


def create_pipeline(study: str, sensor: str, virtual: bool, roles: str = "roles") -> Pipeline:
    """Trainings of one study on one sensor.

    Args:
        study: Its name.
        sensor: Its name.
        virtual: Whether virtual gyroscopes take part.
        roles: ``roles``, or ``devices`` where every IMU in turn is an unseen one.
    """
    stage = f"{study}.{sensor}.training"
    data = {
        "recordings": f"{sensor}.windowed_splits.recordings",
        "roles": f"{sensor}.windowed_splits.{roles}",
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
                    "bias": f"{sensor}.windowed_splits.bias",
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


def create_leakage_pipeline(sensor: str) -> Pipeline:
    """Trainings of the leak study on one sensor."""
    stage = f"{LEAKAGE}.{sensor}.training"
    settings = {name: f"params:{name}" for name in ("leakage", "training", "splits")}
    data = {"recordings": f"{sensor}.windowed_splits.recordings"} | settings
    return Pipeline(
        [
            Node(
                plan_leakage,
                data | {"seeds": "params:seeds", "only": "params:only"},
                f"{stage}.cells",
                name=f"plan_{LEAKAGE}_{sensor}",
                namespace="training",
            ),
            Node(
                train_leakage,
                data
                | {
                    "cells": f"{stage}.cells",
                    "tracked": f"{sensor}.training.tracked",
                    "bias": f"{sensor}.windowed_splits.bias",
                    "execution": "params:execution",
                },
                f"{stage}.runs",
                name=f"train_{LEAKAGE}_{sensor}",
                namespace="training",
            ),
        ]
    )
