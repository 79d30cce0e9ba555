"""The pipelines that the parameters ask for, put together from the stages: a table of contents."""

from kedro.pipeline import Pipeline

from gyro_pipeline.parameters import Parameters
from gyro_pipeline.pipelines import (
    evaluation,
    ground_truth,
    raw_logs,
    reporting,
    training,
    virtual_gyros,
    windowed_splits,
)
from gyro_pipeline.studies import LEAKAGE, used_sensors


def assemble(parameters: Parameters) -> dict[str, Pipeline]:
    """All pipelines; each study ends by writing its own tables and figures."""
    sensors = used_sensors(parameters)
    every_sensor = {
        study: asked.sensors_among(parameters.sensors)
        for study, asked in parameters.studies.items()
    }
    default = [study for study, asked in parameters.studies.items() if asked.default]
    wanted = parameters.only.sensor
    pipelines = {
        study: _runs(parameters, {study: sensors[study]})
        + reporting.create_pipeline({study: every_sensor[study]}, inspected=[*parameters.sensors])
        for study in parameters.studies
        if study != LEAKAGE
    }
    known = [sensor for sensor in parameters.sensors if wanted in (None, sensor)]
    pipelines["ground_truth"] = sum(
        (_measured(sensor) + ground_truth.create_report(sensor) for sensor in known), Pipeline([])
    )
    pipelines["virtual_gyros"] = sum(
        (
            _measured(sensor) + virtual_gyros.create_pipeline(sensor)
            for sensor in known
            if sensor in _virtual_sensors(parameters)
        ),
        Pipeline([]),
    )
    published = parameters.published
    pipelines["reporting"] = reporting.create_pipeline(
        {study: every_sensor[study] for study in default},
        sensors=[row.sensor for row in published.specifications],
        virtual=[row.sensor for row in published.hours if row.virtual],
        inspected=[*parameters.sensors],
    )
    if LEAKAGE in parameters.studies:  # its report is its own, and never without nodes
        shown = sensors[LEAKAGE] or every_sensor[LEAKAGE]
        leaks = reporting.create_leakage_pipeline(shown)
        pipelines[LEAKAGE] = _runs(parameters, {LEAKAGE: sensors[LEAKAGE]}) + leaks
    runs = _runs(parameters, {study: sensors[study] for study in default})
    pipelines["__default__"] = runs + pipelines["reporting"]
    return pipelines


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


def _virtual_sensors(parameters: Parameters) -> set[str]:
    """Sensors of which some study trains on virtual gyroscopes."""
    return {
        sensor
        for study in parameters.studies.values()
        for sensor in study.sensors_among(parameters.sensors)
        if any(study.grid_of(sensor).virtual_gyros)
    }
