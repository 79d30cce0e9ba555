"""Wiring of the evaluation stage."""

from kedro.pipeline import Node, Pipeline

from gyro_pipeline.pipelines.evaluation.nodes import evaluate


def create_pipeline(study: str, sensor: str) -> Pipeline:
    """The evaluation of the runs of a study on a sensor."""
    stage, splits = f"{study}.{sensor}", f"{sensor}.windowed_splits"
    inputs = {
        "plan": f"{stage}.training.plan",
        "runs": f"{stage}.training.runs",  # StoredRun objects, whose fits training has saved
        "recordings": f"{splits}.recordings",
        "windows": f"{stage}.windowed_splits.windows",
        "bias": f"{splits}.bias",
        "allan": f"{sensor}.ground_truth.allan",
    }
    name, tags = f"evaluate_{study}_{sensor}", [study, sensor]
    output = f"{stage}.evaluation.runs"
    return Pipeline([Node(evaluate, inputs, output, name=name, namespace="evaluation", tags=tags)])
