"""Wiring of the windowed-splits stage."""

from kedro.pipeline import Node, Pipeline

from gyro_pipeline.pipelines.windowed_splits.nodes import cut_to_common_length, split_windows


def create_pipeline(study: str, sensor: str, virtual: bool) -> Pipeline:
    """The recordings of a sensor, cut to one length, and the windows table of a study.

    Args:
        study: Name of the study.
        sensor: Name of the sensor.
        virtual: Whether the study uses virtual gyroscopes.
    """
    stage = f"{sensor}.windowed_splits"
    optional = {"virtual": f"{sensor}.virtual_gyros.recordings"} if virtual else {}
    return Pipeline(
        [
            Node(
                cut_to_common_length,
                [
                    f"{sensor}.raw_logs.recordings",
                    f"{sensor}.ground_truth.bias",
                    f"{sensor}.raw_logs.quality",
                ],
                [f"{stage}.recordings", f"{stage}.bias", f"{stage}.contents"],
                name=f"cut_to_common_length_{sensor}",
                namespace="windowed_splits",
                tags=[sensor],
            ),
            Node(
                split_windows,
                {
                    "study": f"params:studies.{study}",
                    "recordings": f"{stage}.recordings",
                    "contents": f"{stage}.contents",
                    "splits": "params:splits",
                    "windows_s": "params:windows_s",
                    "only": "params:only",
                }
                | optional,
                f"{study}.{sensor}.windowed_splits.windows",
                name=f"split_windows_{study}_{sensor}",
                namespace="windowed_splits",
                tags=[study, sensor],
            ),
        ]
    )
