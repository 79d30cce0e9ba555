"""The runs that the studies need, as :class:`RunSpec` objects."""

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, fields, replace
from itertools import product
from typing import Any, Self

import pandas as pd

from gyro_pipeline.conventions import AXES, NOTHING, OWN, REAL, InputError
from gyro_pipeline.estimators import ESTIMATORS, estimator_class, settings_of
from gyro_pipeline.parameters import Only, Parameters, Splits, Study, Training, VirtualGyros

CNN, CNN_SHUFFLED, MEAN, CONSTANT = "cnn", "cnn_shuffled", "mean", "training_mean"

RESIDUAL_NETWORK = "residual_network"
"""The recommended estimator, which the report compares with the paper's network."""

DEFAULT_PIPELINE = "__default__"
"""The pipeline that runs when no name is given."""

LEAKAGE = "leakage"
"""The leak study, which has a separate report."""

LEFT_OUT = "left_out"
"""Column of a plan: the reason why a run is impossible; empty for possible runs."""


@dataclass(frozen=True)
class RunSpec:
    """An estimator, its sensor, window and training set: a row of a study, or a run.

    :func:`run_spec` reduces a row to its run. The fields are stored as parameters of the run, under
    the same names.
    """

    study: str
    sensor: str
    source: str
    protocol: str
    estimator: str
    method: int  # 1: IMUs side by side are input channels; 2: they are more training data
    real_gyros: int
    virtual_gyros: int
    window_s: float
    window_stride_s: float
    seed: int

    @property
    def real_imus(self) -> int:
        """Real IMUs in training."""
        return self.real_gyros // len(AXES)

    @property
    def virtual_imus(self) -> int:
        """Virtual IMUs in training; always the first, so that larger sets contain smaller ones."""
        return self.virtual_gyros // len(AXES)

    @classmethod
    def names(cls) -> list[str]:
        """Names of the fields, in order."""
        return [field.name for field in fields(cls)]

    @classmethod
    def of_row(cls, row: Mapping[Any, Any]) -> Self:
        """The spec of a row of a plan, which has further columns."""
        return cls(**{name: row[name] for name in cls.names()})


def study_rows(  # noqa: PLR0917 - the axes of a grid
    study: Study,
    sensor: str,
    source: str,
    windows_s: Sequence[float],
    seeds: Sequence[int],
    only: Only,
) -> list[RunSpec]:
    """Rows of a study on a sensor, narrowed by ``only``, the running means first.

    A running mean is kept for each window for which another estimator remains.
    """
    grid, filters = study.grid_of(sensor), only.model_dump(exclude_none=True)
    rows = [
        RunSpec(
            *(study.experiment, sensor, source, protocol, estimator),
            method=grid.method,
            real_gyros=real,
            virtual_gyros=virtual,
            window_s=float(window_s),
            window_stride_s=float(stride_s or window_s),
            seed=seed,
        )
        for window_s, stride_s in product(study.windows_s or windows_s, study.strides_s or [0])
        for protocol, estimators in study.estimators_of.items()
        for estimator, real, virtual, seed in product(
            sweep_names(estimators, study.sweep), grid.real_gyros, grid.virtual_gyros, seeds
        )
    ]
    rows = [row for row in rows if all(getattr(row, key) == v for key, v in filters.items())]
    means = [
        replace(
            row,
            protocol=study.protocol,
            estimator=MEAN,
            real_gyros=min(grid.real_gyros),
            virtual_gyros=0,
            seed=0,
        )
        for row in rows
    ]
    return [*dict.fromkeys(means), *(row for row in rows if row.estimator != MEAN)]


def sweep_names(estimators: Iterable[str], grid: Mapping[str, Sequence[Any]]) -> list[str]:
    """Names of estimators; a seeded estimator has one for each combination of settings.

    Args:
        estimators: Names without settings.
        grid: Values of each setting.
    """
    if not any(grid.values()):
        return list(estimators)
    combinations = [
        "".join(f" {key}={_text(value)}" for key, value in zip(grid, values, strict=True))
        for values in product(*grid.values())
    ]
    return [
        name + settings
        for name in estimators
        for settings in (combinations if estimator_class(name).seeded else [""])
    ]


def _text(value: Any) -> str:
    """A setting as the name of an estimator spells it: words without quotes."""
    return value if isinstance(value, str) else json.dumps(value)


def run_specs(rows: Iterable[RunSpec], unseen_devices: bool) -> list[RunSpec]:
    """Runs that rows need: rows whose estimator uses the same training set share a run."""
    return list(dict.fromkeys(run_spec(row, unseen_devices) for row in rows))


def run_spec(row: RunSpec, unseen_devices: bool) -> RunSpec:
    """Reduce a row to the part of its training set that its estimator uses.

    Args:
        row: A row of a study.
        unseen_devices: Whether the tested devices are unseen in training. They have no recordings
            there, so an estimator that would use them uses all real recordings.

    Returns:
        The row without the gyroscopes, the seed and the method that do not affect its result.
    """
    estimator = estimator_class(row.estimator)
    uses = REAL if estimator.uses == OWN and unseen_devices else estimator.uses
    counts = {NOTHING: (0, 0), OWN: (len(AXES), 0), REAL: (row.real_gyros, 0)}
    real, virtual = counts.get(uses, (row.real_gyros, row.virtual_gyros))
    side_by_side = estimator.side_by_side and real > len(AXES)
    return replace(
        row,
        method=row.method if side_by_side else 2,  # for one IMU both methods are the same
        real_gyros=real,
        virtual_gyros=virtual,
        seed=row.seed if estimator.seeded else 0,
    )


def possible_runs(plan: pd.DataFrame) -> dict[str, RunSpec]:
    """The possible runs of a plan, by fingerprint."""
    possible = plan[plan[LEFT_OUT].isna() | (plan[LEFT_OUT] == "")]
    return {row["fingerprint"]: RunSpec.of_row(row) for row in possible.to_dict("records")}


def used_sensors(parameters: Parameters) -> dict[str, list[str]]:
    """The sensors of each study on which ``only`` leaves at least one row."""
    p = parameters
    return {
        name: [
            sensor
            for sensor in study.sensors_among(p.sensors)
            if study_rows(study, sensor, p.source, p.windows_s, p.seeds, p.only)
        ]
        for name, study in p.studies.items()
    }


def studies_to_run(parameters: Parameters, pipelines: Sequence[str]) -> dict[str, list[str]]:
    """The studies that pipelines run, with the sensors that ``only`` leaves of each."""
    all_defaults = bool({DEFAULT_PIPELINE, "reporting"} & set(pipelines))
    return {
        study: sensors
        for study, sensors in used_sensors(parameters).items()
        if study in pipelines or (parameters.studies[study].default and all_defaults)
    }


def check_possible(parameters: Parameters, pipelines: Sequence[str]) -> None:
    """Refuse studies that need more than their sensors have.

    Only the studies that will run are checked. Where a sensor's entry states neither the number of
    IMUs nor the length of recordings, the plan of the runs checks them against the files.

    Args:
        parameters: All parameters.
        pipelines: Names of the pipelines to run.

    Raises:
        InputError: ``only`` leaves nothing of the studies, a sensor or estimator is unknown, or a
            sensor has fewer IMUs or shorter recordings than a study needs.
    """
    studies = studies_to_run(parameters, pipelines)
    if studies and not any(studies.values()):
        only = parameters.only.model_dump(exclude_none=True)
        raise InputError(
            f"only={only} matches nothing in {', '.join(studies)}; for their rows, and to add a "
            "sensor, see conf/base/parameters/studies.yml"
        )
    for study, sensors in studies.items():
        settings = parameters.studies[study]
        if study != LEAKAGE and (settings.also or len(settings.strides_s or ()) > 1):
            raise InputError(
                f"studies.{study}: expected one protocol and one stride, as the report has no "
                f"column for several; make a study for each (also and strides_s are for {LEAKAGE})"
            )
        for sensor in sensors:
            parameters.check_sensor(f"studies.{study}", sensor)
            _check_rows(parameters, study, sensor)


def _check_rows(p: Parameters, study: str, name: str) -> None:
    """Compare the rows of a study on a sensor with what the sensor's entry says."""
    settings = p.studies[study]
    rows = study_rows(settings, name, p.source, p.windows_s, p.seeds, p.only)
    for estimator in dict.fromkeys(row.estimator for row in rows):
        if estimator not in ESTIMATORS:  # the built-in ones are valid; checking them loads PyTorch
            settings_of(estimator, settings.training_of(p.training))
        if settings.unseen_devices and estimator_class(estimator).seeded:
            raise InputError(
                f"studies.{study}.estimators: {estimator} cannot be judged on unseen devices; "
                "leave it out of a study with protocol leave_one_device_out"
            )
    imus, length_s = p.sensors[name].imus, p.sensors[name].recording_s
    real, virtual = len(AXES) * (imus or 0), len(AXES) * p.virtual_gyros.imus
    for field, limit, words in (
        ("real_gyros", real or None, f"real gyroscopes needed, {name} has {real} (imus: {imus})"),
        (
            "virtual_gyros",
            virtual,
            f"virtual gyroscopes needed, virtual_gyros.imus makes {virtual}",
        ),
        (
            "window_s",
            length_s,
            f"s windows needed, longer than a recording of {name}, {length_s or 0:g} s "
            "(windows_s of the studies; recording_s of the sensor)",
        ),
    ):
        most = max(getattr(row, field) for row in rows)
        if limit is not None and most > limit:
            raise InputError(f"studies.{study}.{name}: {most:g} {words}")


def run_params(
    spec: RunSpec, study: Study, training: Training, splits: Splits, virtual_gyros: VirtualGyros
) -> dict[str, Any]:
    """Parameters that a run is logged with: its identity and the settings that it depends on.

    Args:
        spec: The run.
        study: Its study, which may change some settings.
        training: Hyper-parameters of seeded estimators.
        splits: How recordings are split, and which windows train.
        virtual_gyros: How virtual gyroscopes are drawn, for runs that use them.
    """
    split = study.splits_of(splits).model_dump(exclude={"folds"})  # logged as the actual number
    params: dict[str, Any] = asdict(spec) | split
    if spec.virtual_gyros:
        params |= {f"virtual_{name}": value for name, value in virtual_gyros.model_dump().items()}
    settings = settings_of(spec.estimator, study.training_of(training))
    return params | {name: value for name, value in settings.items() if value is not None}
