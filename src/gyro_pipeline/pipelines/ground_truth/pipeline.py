"""Wiring of the ground-truth stage."""

from kedro.pipeline import Node, Pipeline

from gyro_pipeline.conventions import ALWAYS
from gyro_pipeline.pipelines.ground_truth.nodes import (
    measure_allan_variance,
    measure_bias,
    measure_noise,
)
from gyro_pipeline.pipelines.ground_truth.report import report_biases


def create_report(sensor: str) -> Pipeline:
    """The biases, on the terminal."""
    stage = f"{sensor}.ground_truth"
    return Pipeline(
        [
            Node(
                report_biases,
                [f"{sensor}.raw_logs.recordings", f"{stage}.bias", f"{sensor}.raw_logs.quality"],
                None,
                name=f"report_biases_{sensor}",
                namespace="ground_truth",
                tags=[sensor, ALWAYS],
            )
        ]
    )


def create_pipeline(sensor: str) -> Pipeline:
    """Bias and noise of one sensor's gyroscopes."""
    recordings, stage = f"{sensor}.raw_logs.recordings", f"{sensor}.ground_truth"
    return Pipeline(
        [
            Node(
                measure_allan_variance,
                recordings,
                f"{stage}.allan",
                name=f"allan_{sensor}",
                namespace="ground_truth",
                tags=[sensor],
            ),
            Node(
                measure_bias,
                [recordings, f"{stage}.allan", "params:ground_truth"],
                f"{stage}.bias",
                name=f"bias_{sensor}",
                namespace="ground_truth",
                tags=[sensor],
            ),
            Node(
                measure_noise,
                [recordings, f"{stage}.allan", f"{stage}.bias"],
                f"{stage}.noise",
                name=f"noise_{sensor}",
                namespace="ground_truth",
                tags=[sensor],
            ),
        ]
    )
