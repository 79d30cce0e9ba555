"""Wiring of the evaluation stage."""

from kedro.pipeline import Node, Pipeline

from gyro_pipeline.pipelines.evaluation.leakage import evaluate_leakage
from gyro_pipeline.pipelines.evaluation.nodes import evaluate
from gyro_pipeline.studies import LEAKAGE


def create_pipeline(study: str, sensor: str, virtual: bool, roles: str = "roles") -> Pipeline:
    """Evaluation of one study's runs on one sensor.

    Args:
        study: Its name.
        sensor: Its name.
        virtual: Whether virtual gyroscopes take part.
        roles: ``roles``, or ``devices`` where every IMU in turn is an unseen one.
    """
    drawn = {"virtual": f"{sensor}.virtual_gyros.recordings"} if virtual else {}
    return Pipeline(
        [
            Node(
                evaluate,
                {
                    "cells": f"{study}.{sensor}.training.cells",
                    "runs": f"{study}.{sensor}.training.runs",
                    "recordings": f"{sensor}.windowed_splits.recordings",
                    "bias": f"{sensor}.windowed_splits.bias",
                    "allan": f"{sensor}.ground_truth.allan",
                    "roles": f"{sensor}.windowed_splits.{roles}",
                    "evaluation": "params:evaluation",
                }
                | drawn,
                f"{study}.{sensor}.evaluation.runs",
                name=f"evaluate_{study}_{sensor}",
                namespace="evaluation",
            )
        ]
    )


def create_leakage_pipeline(sensor: str) -> Pipeline:
    """Evaluation of the leak study's runs on one sensor."""
    settings = {name: f"params:{name}" for name in ("leakage", "splits", "evaluation")}
    return Pipeline(
        [
            Node(
                evaluate_leakage,
                settings
                | {
                    "cells": f"{LEAKAGE}.{sensor}.training.cells",
                    "runs": f"{LEAKAGE}.{sensor}.training.runs",
                    "recordings": f"{sensor}.windowed_splits.recordings",
                    "bias": f"{sensor}.windowed_splits.bias",
                    "allan": f"{sensor}.ground_truth.allan",
                },
                f"{LEAKAGE}.{sensor}.evaluation.runs",
                name=f"evaluate_{LEAKAGE}_{sensor}",
                namespace="evaluation",
            )
        ]
    )
