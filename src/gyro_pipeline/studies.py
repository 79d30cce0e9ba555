"""Which runs the studies ask for: one :class:`RunSpec` each."""

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, fields, replace
from itertools import product
from typing import Any

import pandas as pd

from gyro_pipeline.conventions import AXES, NOTHING, OWN, REAL, InputError
from gyro_pipeline.estimators import ESTIMATORS, estimator_class, settings_of
from gyro_pipeline.parameters import Only, Parameters, Splits, Study, Training, VirtualGyros

CNN, CNN_SHUFFLED, MEAN, CONSTANT = "cnn", "cnn_shuffled", "mean", "training_mean"

RESIDUAL_NETWORK = "residual_network"
"""The recommended estimator that stands beside the paper's network."""

DEFAULT = "__default__"
"""The pipeline without a name."""

LEAKAGE = "leakage"
"""The leak study, which has a report of its own."""


LEFT_OUT = "left_out"
"""Column of a plan: why a run cannot be made; empty where it can."""


@dataclass(frozen=True)
class RunSpec:
    """One estimator on one sensor and window, and what it learns from: one MLflow run.

    The fields are parameters of the run, by these names.
    """

    study: str
    sensor: str
    source: str
    protocol: str
    estimator: str
    method: int
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
        """Virtual IMUs in training; the first ones, so that smaller sets are parts of larger."""
        return self.virtual_gyros // len(AXES)

    @classmethod
    def names(cls) -> list[str]:
        """Names of the fields, in order."""
        return [field.name for field in fields(cls)]


def study_rows(  # noqa: PLR0917 - what a grid is made of
    study: Study,
    sensor: str,
    source: str,
    windows_s: Sequence[float],
    seeds: Sequence[int],
    only: Only,
) -> list[RunSpec]:
    """Rows of a study on a sensor, the running mean of each window first.

    ``only`` narrows them. A running mean stays wherever another estimator of its window does.
    """
    grid, wanted = study.grid_of(sensor), only.model_dump(exclude_none=True)
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
            swept(estimators, study.sweep), grid.real_gyros, grid.virtual_gyros, seeds
        )
    ]
    rows = [row for row in rows if all(getattr(row, key) == v for key, v in wanted.items())]
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


def swept(estimators: Iterable[str], grid: Mapping[str, Sequence[Any]]) -> list[str]:
    """Estimators with each seeded one once for every combination of some settings.

    Args:
        estimators: Their names.
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
    """As the name of an estimator has it: words without quotes."""
    return value if isinstance(value, str) else json.dumps(value)


def run_specs(rows: Iterable[RunSpec], unseen_devices: bool) -> list[RunSpec]:
    """Runs that make some rows: rows whose estimator uses the same training set are one run."""
    return list(dict.fromkeys(run_spec(row, unseen_devices) for row in rows))


def run_spec(row: RunSpec, unseen_devices: bool) -> RunSpec:
    """A row reduced to what its estimator uses of the training set that it names.

    Args:
        row: It.
        unseen_devices: Whether the tested devices are unseen ones, of which there are no own
            recordings: all real ones are used in their place.

    Returns:
        The row without the gyroscopes, the seed and the method that change nothing.
    """
    estimator = estimator_class(row.estimator)
    uses = REAL if estimator.uses == OWN and unseen_devices else estimator.uses
    counts = {NOTHING: (0, 0), OWN: (len(AXES), 0), REAL: (row.real_gyros, 0)}
    real, virtual = counts.get(uses, (row.real_gyros, row.virtual_gyros))
    side_by_side = estimator.side_by_side and real > len(AXES)
    return replace(
        row,
        method=row.method if side_by_side else 2,  # one IMU is the same in both methods
        real_gyros=real,
        virtual_gyros=virtual,
        seed=row.seed if estimator.seeded else 0,
    )


def planned(plan: pd.DataFrame) -> dict[str, RunSpec]:
    """The runs of a plan that can be made, by fingerprint."""
    made = plan[plan[LEFT_OUT].isna() | (plan[LEFT_OUT] == "")]
    return {
        row["fingerprint"]: RunSpec(**{name: row[name] for name in RunSpec.names()})
        for row in made.to_dict("records")
    }


def used_sensors(parameters: Parameters) -> dict[str, list[str]]:
    """For each study the sensors on which ``only`` leaves it at least one row."""
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
    """Sensors of each study that some pipelines run, as ``only`` leaves them."""
    whole = bool({DEFAULT, "reporting"} & set(pipelines))
    return {
        study: sensors
        for study, sensors in used_sensors(parameters).items()
        if study in pipelines or (parameters.studies[study].default and whole)
    }


def check_possible(parameters: Parameters, pipelines: Sequence[str]) -> None:
    """Refuse what these pipelines ask of sensors that cannot give it.

    Nobody has to mend a study that does not run, so no other is looked at. Where a sensor's entry
    does not say how many IMUs there are, or how long recordings are, its files decide: the plan of
    the runs compares with them.

    Args:
        parameters: All of them.
        pipelines: Names of those to run.

    Raises:
        InputError: ``only`` leaves nothing of the studies, a sensor or estimator is unknown, or a
            sensor has fewer IMUs or shorter recordings than a study needs.
    """
    studies = studies_to_run(parameters, pipelines)
    if studies and not any(studies.values()):
        only = parameters.only.model_dump(exclude_none=True)
        raise InputError(
            f"only={only} matches nothing in {', '.join(studies)}; for what there is, and to "
            "name a new sensor, see studies.yml in conf/base/parameters"
        )
    for study, sensors in studies.items():
        for sensor in sensors:
            parameters.check_sensor(f"studies.{study}", sensor)
            _check_rows(parameters, study, sensor)


def _check_rows(p: Parameters, study: str, name: str) -> None:
    """Compare the rows of a study on a sensor with what the sensor's entry says."""
    asked_study = p.studies[study]
    rows = study_rows(asked_study, name, p.source, p.windows_s, p.seeds, p.only)
    for estimator in dict.fromkeys(row.estimator for row in rows):
        if estimator not in ESTIMATORS:  # those can be made; to look at all takes PyTorch
            settings_of(estimator, asked_study.training_of(p.training))
        if asked_study.unseen_devices and estimator_class(estimator).seeded:
            raise InputError(
                f"studies.{study}.estimators: {estimator} cannot be judged on unseen devices; "
                "leave it out of a study with protocol leave_one_device_out"
            )
    imus, length_s = p.sensors[name].imus, p.sensors[name].recording_s
    has, makes = len(AXES) * (imus or 0), len(AXES) * p.virtual_gyros.imus
    for asked, limit, words in (
        ("real_gyros", has or None, f"real gyroscopes asked, {name} has {has} (its imus: {imus})"),
        ("virtual_gyros", makes, f"virtual gyroscopes asked, virtual_gyros.imus makes {makes}"),
        (
            "window_s",
            length_s,
            f"s windows asked, longer than a recording of {name}, {length_s or 0:g} s "
            "(windows_s of the studies; recording_s of the sensor)",
        ),
    ):
        most = max(getattr(row, asked) for row in rows)
        if limit is not None and most > limit:
            raise InputError(f"studies.{study}.{name}: {most:g} {words}")


def run_params(
    spec: RunSpec, study: Study, training: Training, splits: Splits, virtual_gyros: VirtualGyros
) -> dict[str, Any]:
    """Parameters that a run carries: its identity, and the settings that it depends on.

    Args:
        spec: Which run.
        study: Its study, which may change some settings.
        training: Hyper-parameters, of estimators that have some.
        splits: How recordings are split, and which windows train.
        virtual_gyros: How they were drawn, where the run has some.
    """
    split = study.splits(splits).model_dump(exclude={"folds"})  # a run carries how many it has
    params: dict[str, Any] = asdict(spec) | split
    if spec.virtual_gyros:
        drawn = virtual_gyros.model_dump()
        params |= {f"virtual_{name}": value for name, value in drawn.items()}
    made_with = settings_of(spec.estimator, study.training_of(training))
    return params | {name: value for name, value in made_with.items() if value is not None}
