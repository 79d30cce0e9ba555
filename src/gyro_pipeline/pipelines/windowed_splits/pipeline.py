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
    stage, logs = f"{sensor}.windowed_splits", f"{sensor}.raw_logs"
    inputs = {name: f"params:{name}" for name in ("splits", "windows_s", "only")}
    inputs |= {name: f"{stage}.{name}" for name in ("recordings", "contents")}
    inputs["study"] = f"params:studies.{study}"
    if virtual:
        inputs["virtual"] = f"{sensor}.virtual_gyros.recordings"
    cut = Node(
        cut_to_common_length,
        [f"{logs}.recordings", f"{sensor}.ground_truth.bias", f"{logs}.quality"],
        [f"{stage}.recordings", f"{stage}.bias", f"{stage}.contents"],
        name=f"cut_to_common_length_{sensor}",
        namespace="windowed_splits",
        tags=[sensor],
    )
    split = Node(
        split_windows,
        inputs,
        f"{study}.{stage}.windows",
        name=f"split_windows_{study}_{sensor}",
        namespace="windowed_splits",
        tags=[study, sensor],
    )
    return Pipeline([cut, split])
