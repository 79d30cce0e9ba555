"""Wiring of the training stage."""

from typing import Any

from kedro.pipeline import Node, Pipeline

from gyro_pipeline.pipelines.training.nodes import plan_runs, train


def create_pipeline(study: str, sensor: str, virtual: bool) -> Pipeline:
    """The trainings of a study on a sensor.

    Args:
        study: Name of the study.
        sensor: Name of the sensor.
        virtual: Whether the study uses virtual gyroscopes.
    """
    stage = f"{study}.{sensor}.training"
    data = {
        "study": f"params:studies.{study}",
        "recordings": f"{sensor}.windowed_splits.recordings",
        "windows": f"{study}.{sensor}.windowed_splits.windows",
        "training": "params:training",
    }
    if virtual:
        data["virtual"] = f"{sensor}.virtual_gyros.recordings"
    grid = {name: f"params:{name}" for name in ("windows_s", "seeds", "only")}
    settings = {name: f"params:{name}" for name in ("splits", "virtual_gyros", "execution")}
    runs = {"plan": f"{stage}.plan", "all_runs": f"{sensor}.training.tracked"}
    nodes: list[tuple[str, Any, dict[str, str], str]] = [
        ("plan", plan_runs, data | grid, f"{stage}.plan"),
        # the run store: FittedRun objects are saved, and StoredRun objects are loaded
        ("train", train, data | settings | runs, f"{stage}.runs"),
    ]
    namespace, tags = "training", [study, sensor]
    return Pipeline([
        Node(make, inputs, output, name=f"{name}_{study}_{sensor}", namespace=namespace, tags=tags)
        for name, make, inputs, output in nodes
    ])  # fmt: skip
