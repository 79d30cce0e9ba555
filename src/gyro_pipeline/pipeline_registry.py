"""The pipelines by name: a table of contents."""

from pathlib import Path

from kedro.config import OmegaConfigLoader
from kedro.framework.project import settings
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
from gyro_pipeline.studies import LEAKAGE, leak_sensors, used_sensors

_selected: Parameters | None = None


def select(parameters: Parameters) -> None:
    """Register pipelines for the studies, sensors and ``only`` of these parameters.

    Kedro builds pipelines after the context of a run, which is where this is called from.
    """
    global _selected  # noqa: PLW0603 - Kedro calls register_pipelines without arguments
    _selected = parameters


def register_pipelines() -> dict[str, Pipeline]:
    """All pipelines; each study ends by writing its own tables and figures."""
    parameters = _selected or base_parameters()
    sensors = used_sensors(parameters)
    every_sensor = {study: list(asked.sensors) for study, asked in parameters.studies.items()}
    default = [study for study, asked in parameters.studies.items() if asked.default]
    wanted = parameters.only.sensor
    pipelines = {
        study: _runs(parameters, {study: sensors[study]})
        + reporting.create_pipeline({study: every_sensor[study]}, inspected=[*parameters.sensors])
        for study in parameters.studies
    }
    known = [sensor for sensor in parameters.sensors if wanted in (None, sensor)]
    drawn = _virtual_sensors(parameters)
    pipelines["ground_truth"] = sum(
        (_measured(sensor) + ground_truth.create_report(sensor) for sensor in known), Pipeline([])
    )
    pipelines["virtual_gyros"] = sum(
        (_measured(sensor) + _split(sensor, sensor in drawn) for sensor in known), Pipeline([])
    )
    published = parameters.published
    pipelines["reporting"] = reporting.create_pipeline(
        {study: every_sensor[study] for study in default},
        sensors=[row.sensor for row in published.specifications],
        virtual=[row.sensor for row in published.hours if row.virtual],
        inspected=[*parameters.sensors],
    )
    pipelines[LEAKAGE] = _leakage(parameters)
    runs = _runs(parameters, {study: sensors[study] for study in default})
    pipelines["__default__"] = runs + pipelines["reporting"]
    return pipelines


def _runs(parameters: Parameters, studies: dict[str, list[str]]) -> Pipeline:
    """From raw logs to evaluated runs."""
    whole = Pipeline([])
    for study, sensors in studies.items():
        for sensor in sensors:
            asked = parameters.studies[study]
            virtual = any(asked.sensors[sensor].virtual_gyros)
            roles = "devices" if asked.unseen_devices else "roles"
            whole += _measured(sensor) + _split(sensor, virtual, asked.unseen_devices)
            whole += training.create_pipeline(study, sensor, virtual, roles)
            whole += evaluation.create_pipeline(study, sensor, virtual, roles)
    return whole


def _leakage(parameters: Parameters) -> Pipeline:
    """From raw logs to the leak study's table and figure; no other pipeline has any of it."""
    sensors = leak_sensors(parameters.leakage, parameters.only)
    whole = Pipeline([])
    for sensor in sensors:
        whole += _measured(sensor) + windowed_splits.create_cut_pipeline(sensor)
        whole += training.create_leakage_pipeline(sensor)
        whole += evaluation.create_leakage_pipeline(sensor)
    # never without nodes, which Kedro refuses before our check can say why
    return whole + reporting.create_leakage_pipeline(sensors or parameters.leakage.sensors)


def _measured(sensor: str) -> Pipeline:
    """From raw logs to the bias table and the noise figures."""
    return raw_logs.create_pipeline(sensor) + ground_truth.create_pipeline(sensor)


def _split(sensor: str, virtual: bool, unseen_devices: bool = False) -> Pipeline:
    """The roles of the recordings, and the virtual gyroscopes drawn from those that train."""
    drawn = virtual_gyros.create_pipeline(sensor) if virtual else Pipeline([])
    return windowed_splits.create_pipeline(sensor, unseen_devices) + drawn


def _virtual_sensors(parameters: Parameters) -> set[str]:
    """Sensors of which some study trains on virtual gyroscopes."""
    return {
        sensor
        for study in parameters.studies.values()
        for sensor, grid in study.sensors.items()
        if any(grid.virtual_gyros)
    }


def base_parameters() -> Parameters:
    """Parameters of ``conf/base``, for commands that run nothing (``kedro registry list``)."""
    conf = OmegaConfigLoader(str(Path.cwd() / settings.CONF_SOURCE), **settings.CONFIG_LOADER_ARGS)
    return Parameters(**conf["parameters"])
