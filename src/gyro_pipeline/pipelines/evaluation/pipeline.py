"""Wiring of the evaluation stage."""

from kedro.pipeline import Node, Pipeline

from gyro_pipeline.pipelines.evaluation.nodes import evaluate


def create_pipeline(study: str, sensor: str) -> Pipeline:
    """The evaluation of the runs of a study on a sensor."""
    return Pipeline(
        [
            Node(
                evaluate,
                {
                    "plan": f"{study}.{sensor}.training.plan",
                    "runs": f"{study}.{sensor}.training.runs",
                    "recordings": f"{sensor}.windowed_splits.recordings",
                    "windows": f"{study}.{sensor}.windowed_splits.windows",
                    "bias": f"{sensor}.windowed_splits.bias",
                    "allan": f"{sensor}.ground_truth.allan",
                },
                f"{study}.{sensor}.evaluation.runs",
                name=f"evaluate_{study}_{sensor}",
                namespace="evaluation",
                tags=[study, sensor],
            )
        ]
    )
