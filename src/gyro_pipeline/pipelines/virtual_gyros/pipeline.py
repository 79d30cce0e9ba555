"""Wiring of the virtual-gyroscopes stage."""

from kedro.pipeline import Node, Pipeline

from gyro_pipeline.pipelines.virtual_gyros.nodes import synthesise


def create_pipeline(sensor: str) -> Pipeline:
    """Virtual gyroscopes like those of a sensor."""
    return Pipeline(
        [
            Node(
                synthesise,
                [
                    f"{sensor}.raw_logs.recordings",
                    f"{sensor}.ground_truth.bias",
                    "params:virtual_gyros",
                ],
                f"{sensor}.virtual_gyros.recordings",
                name=f"synthesise_{sensor}",
                namespace="virtual_gyros",
                tags=[sensor],
            )
        ]
    )
