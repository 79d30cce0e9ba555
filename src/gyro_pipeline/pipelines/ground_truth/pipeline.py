"""Wiring of the ground-truth stage."""

from collections.abc import Callable
from typing import Any

from kedro.pipeline import Node, Pipeline

from gyro_pipeline.conventions import ALWAYS
from gyro_pipeline.pipelines.ground_truth.nodes import (
    measure_allan_variance,
    measure_bias,
    measure_noise,
)
from gyro_pipeline.pipelines.ground_truth.report import report_biases


def create_report(sensor: str) -> Pipeline:
    """The report of the biases on the terminal."""
    logs = f"{sensor}.raw_logs"
    inputs = [f"{logs}.recordings", f"{sensor}.ground_truth.bias", f"{logs}.quality"]
    return Pipeline([_node("report_biases", report_biases, inputs, None, sensor, ALWAYS)])


def create_pipeline(sensor: str) -> Pipeline:
    """Bias and noise of the gyroscopes of a sensor."""
    recordings, stage = f"{sensor}.raw_logs.recordings", f"{sensor}.ground_truth"
    allan, bias, noise = f"{stage}.allan", f"{stage}.bias", f"{stage}.noise"
    settings = "params:ground_truth"
    return Pipeline(
        [
            _node("allan", measure_allan_variance, [recordings], allan, sensor),
            _node("bias", measure_bias, [recordings, allan, settings], bias, sensor),
            _node("noise", measure_noise, [recordings, allan, bias], noise, sensor),
        ]
    )


def _node(
    name: str, make: Callable[..., Any], inputs: list[str], output: str | None, *tags: str
) -> Node:
    """A node with the sensor as its first tag."""
    return Node(
        make, inputs, output, name=f"{name}_{tags[0]}", namespace="ground_truth", tags=[*tags]
    )
