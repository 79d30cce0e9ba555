"""Wiring of the virtual-gyroscopes stage."""

from kedro.pipeline import Node, Pipeline

from gyro_pipeline.pipelines.virtual_gyros.nodes import synthesise


def create_pipeline(sensor: str) -> Pipeline:
    """Virtual gyroscopes like those of a sensor."""
    stage, name = "virtual_gyros", f"synthesise_{sensor}"
    inputs = [f"{sensor}.raw_logs.recordings", f"{sensor}.ground_truth.bias", f"params:{stage}"]
    output = f"{sensor}.{stage}.recordings"
    return Pipeline([Node(synthesise, inputs, output, name=name, namespace=stage, tags=[sensor])])
