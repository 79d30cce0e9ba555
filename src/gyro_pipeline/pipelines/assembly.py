"""The pipelines for the given parameters, assembled from the stages."""

from collections.abc import Iterable

from kedro.pipeline import Node, Pipeline

from gyro_pipeline.parameters import Parameters
from gyro_pipeline.pipelines.evaluation import pipeline as evaluation
from gyro_pipeline.pipelines.ground_truth import pipeline as ground_truth
from gyro_pipeline.pipelines.raw_logs import pipeline as raw_logs
from gyro_pipeline.pipelines.reporting import pipeline as reporting
from gyro_pipeline.pipelines.training import pipeline as training
from gyro_pipeline.pipelines.virtual_gyros import pipeline as virtual_gyros
from gyro_pipeline.pipelines.windowed_splits import pipeline as windowed_splits
from gyro_pipeline.studies import used_sensors


def assemble(parameters: Parameters) -> dict[str, Pipeline]:
    """All pipelines; each study ends with its tables and figures."""
    narrowed = used_sensors(parameters)
    # a pipeline is never empty, so that a check can report that the filters leave no sensor
    whole = {
        name: study.sensors_among(parameters.sensors) for name, study in parameters.studies.items()
    }
    default = [name for name, study in parameters.studies.items() if study.default]
    studied = narrowed if any(narrowed[name] for name in default) else whole
    sensors = [name for name in parameters.sensors if parameters.only.sensor in (None, name)]
    pipelines = {name: _study(parameters, {name: narrowed[name] or whole[name]}) for name in whole}
    pipelines["__default__"] = _study(parameters, {name: studied[name] for name in default})
    pipelines["reporting"] = Pipeline(
        [node for node in pipelines["__default__"].nodes if not _makes_runs(node)]
    )
    pipelines["ground_truth"] = sum(
        (_measured(sensor) + ground_truth.create_report(sensor) for sensor in sensors), Pipeline([])
    )
    pipelines["virtual_gyros"] = sum(
        (
            _measured(sensor) + virtual_gyros.create_pipeline(sensor)
            for sensor in sensors
            if sensor in _virtual_sensors(parameters, parameters.studies)
        ),
        Pipeline([]),
    )
    return pipelines


def _study(parameters: Parameters, studies: dict[str, list[str]]) -> Pipeline:
    """From raw logs to the report of some studies; empty without sensors."""
    sensors = list(dict.fromkeys(sensor for names in studies.values() for sensor in names))
    if not sensors:
        return Pipeline([])
    virtual = _virtual_sensors(parameters, studies)
    return _runs(parameters, studies) + reporting.create_pipeline(studies, sensors, [*virtual])


def _makes_runs(node: Node) -> bool:
    """Whether a node trains or evaluates."""
    return any(name.endswith((".training.runs", ".evaluation.runs")) for name in node.outputs)


def _runs(parameters: Parameters, studies: dict[str, list[str]]) -> Pipeline:
    """From raw logs to evaluated runs."""
    whole = Pipeline([])
    for study, sensors in studies.items():
        for sensor in sensors:
            virtual = any(parameters.studies[study].grid_of(sensor).virtual_gyros)
            whole += _measured(sensor)
            whole += virtual_gyros.create_pipeline(sensor) if virtual else Pipeline([])
            whole += windowed_splits.create_pipeline(study, sensor, virtual)
            whole += training.create_pipeline(study, sensor, virtual)
            whole += evaluation.create_pipeline(study, sensor)
    return whole


def _measured(sensor: str) -> Pipeline:
    """From raw logs to the bias table and the noise figures."""
    return raw_logs.create_pipeline(sensor) + ground_truth.create_pipeline(sensor)


def _virtual_sensors(parameters: Parameters, studies: Iterable[str]) -> set[str]:
    """Sensors with virtual gyroscopes in at least one of the studies."""
    return {
        sensor
        for study in (parameters.studies[name] for name in studies)
        for sensor in study.sensors_among(parameters.sensors)
        if any(study.grid_of(sensor).virtual_gyros)
    }
