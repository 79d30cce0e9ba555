"""Which trainings the studies of the paper ask for: one :class:`Cell` each."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields, replace
from itertools import product
from typing import Any

from gyro_pipeline.conventions import (
    AXES,
    HOLD_OUT,
    LEAKS,
    NO_LEAK,
    TEST_IN_TRAINING,
    InputError,
)
from gyro_pipeline.parameters import (
    Leakage,
    Only,
    Parameters,
    Splits,
    Study,
    Training,
    VirtualGyros,
)

CNN, CNN_SHUFFLED, MEAN = "cnn", "cnn_shuffled", "mean"
NETWORKS = (CNN, CNN_SHUFFLED)
"""Estimators that are the paper's network: as it is, and with shuffled labels, a leak detector."""

RESIDUAL_NETWORK = "residual_network"
"""The estimator that is fitted to what a cell of the paper trains on: its real and virtual IMUs."""

DEFAULT = "__default__"
"""The pipeline without a name."""

LEAKAGE = "leakage"
"""The leak study: its pipeline, MLflow experiment and parameters."""


@dataclass(frozen=True)
class Cell:
    """One estimator on one sensor, window and fold: one MLflow run.

    The fields are parameters of the run, by these names. The running mean is trained on nothing:
    its ``method``, ``real_gyros`` and ``virtual_gyros`` are 0. Other estimators without a network
    have method 0 and seed 0, and are fitted in each fold when they are judged.
    """

    study: str
    method: int
    sensor: str
    source: str
    real_gyros: int
    virtual_gyros: int
    window_s: float
    seed: int
    fold: int
    estimator: str

    @property
    def real_imus(self) -> int:
        """Real IMUs in training."""
        return self.real_gyros // len(AXES)

    @property
    def virtual_imus(self) -> int:
        """Virtual IMUs in training; the first ones, so that smaller sets are parts of larger."""
        return self.virtual_gyros // len(AXES)

    @property
    def content(self) -> dict[str, Any]:
        """What the training depends on: not the study, and one IMU is the same in both methods."""
        content = asdict(self)
        del content["study"]
        if self.estimator in NETWORKS and self.real_imus == 1:
            content["method"] = 2
        return content

    @classmethod
    def names(cls) -> list[str]:
        """Names of the fields, in order."""
        return [field.name for field in fields(cls)]


@dataclass(frozen=True)
class LeakCell(Cell):
    """A training of the leak study; no run of another study has these parameters."""

    leak: str
    window_stride_s: float


def leak_cells(leakage: Leakage, sensor: str, source: str, seeds: Sequence[int]) -> list[LeakCell]:
    """Cells of the leak study on a sensor: for each stride the honest split, then the leaks."""
    ways = [(NO_LEAK, CNN), (NO_LEAK, CNN_SHUFFLED), *((leak, CNN) for leak in LEAKS[1:])]
    imu = (2, sensor, source, len(AXES), 0)
    return [
        LeakCell(LEAKAGE, *imu, leakage.window_s, seed, fold, estimator, leak, stride_s)
        for stride_s, (leak, estimator), seed in product(leakage.strides_s, ways, seeds)
        for fold in ([HOLD_OUT] if leak == TEST_IN_TRAINING else range(leakage.folds))
    ]


def leak_sensors(leakage: Leakage, only: Only) -> list[str]:
    """Sensors of the leak study that ``only`` leaves."""
    return [sensor for sensor in leakage.sensors if only.sensor in (None, sensor)]


def study_cells(  # noqa: PLR0913 - what a grid is made of
    study: Study,
    sensor: str,
    source: str,
    windows_s: Sequence[float],
    seeds: Sequence[int],
    only: Only,
) -> list[Cell]:
    """Cells of a study on a sensor on the hold-out split; the running mean of each window first.

    ``only`` narrows them. A running mean stays wherever another estimator of its window does.
    """
    name, grid = study.experiment, study.sensors[sensor]
    networks = [
        Cell(name, grid.method, sensor, source, real, virtual, float(window_s), seed, HOLD_OUT, CNN)
        for real, virtual, window_s, seed in product(
            grid.real_gyros, grid.virtual_gyros, study.windows_s or windows_s, seeds
        )
    ]
    cells = list(
        dict.fromkeys(
            cell if estimator == CNN else replace(cell, method=0, seed=0, estimator=estimator)
            for estimator in study.estimators
            for cell in networks
        )
    )
    wanted = only.model_dump(exclude_none=True, exclude={"fold"})  # folds: known only with data
    cells = [c for c in cells if all(getattr(c, key) == value for key, value in wanted.items())]
    means = [
        Cell(name, 0, sensor, source, 0, 0, window_s, 0, HOLD_OUT, MEAN)
        for window_s in dict.fromkeys(cell.window_s for cell in cells)
    ]
    return means + [cell for cell in cells if cell.estimator != MEAN]


def used_sensors(parameters: Parameters) -> dict[str, list[str]]:
    """For each study the sensors on which ``only`` leaves it at least one cell."""
    p = parameters
    return {
        name: [
            sensor
            for sensor in study.sensors
            if study_cells(study, sensor, p.source, p.windows_s, p.seeds, p.only)
        ]
        for name, study in p.studies.items()
    }


def studies_to_run(parameters: Parameters, pipelines: Sequence[str]) -> dict[str, list[str]]:
    """Sensors of each study that some pipelines run, as ``only`` leaves them."""
    studies = {
        study: sensors
        for study, sensors in used_sensors(parameters).items()
        if study in pipelines or (parameters.studies[study].default and DEFAULT in pipelines)
    }
    if LEAKAGE in pipelines:
        studies[LEAKAGE] = leak_sensors(parameters.leakage, parameters.only)
    return studies


def check_possible(parameters: Parameters, pipelines: Sequence[str]) -> None:
    """Refuse what these pipelines ask of sensors that cannot give it.

    Nobody has to mend a study that does not run, so no other is looked at. Where a sensor's entry
    does not say how many IMUs there are, or how long recordings are, its files decide: the plan of
    the runs compares with them.

    Args:
        parameters: All of them.
        pipelines: Names of those to run.

    Raises:
        InputError: ``only`` leaves nothing of the studies, a sensor is unknown, or it has fewer
            IMUs or shorter recordings than a study needs.
    """
    studies = studies_to_run(parameters, pipelines)
    if studies and not any(studies.values()):
        only = parameters.only.model_dump(exclude_none=True)
        raise InputError(
            f"only={only} matches nothing in {', '.join(studies)}; for what there is, and to "
            "name a new sensor, see studies.yml and leakage.yml in conf/base/parameters"
        )
    for study, sensors in studies.items():
        for sensor in sensors:
            parameters.check_sensor(_parameter(study), sensor)
            _check_cells(parameters, study, sensor)
    if {"reporting", DEFAULT} & set(pipelines):
        published = parameters.published
        named = [row.sensor for row in published.specifications]
        for sensor in named + [row.sensor for row in published.hours]:
            parameters.check_sensor("published", sensor)


def _parameter(study: str) -> str:
    return LEAKAGE if study == LEAKAGE else f"studies.{study}"


def _check_cells(p: Parameters, study: str, name: str) -> None:
    """Compare the cells of a study on a sensor with what the sensor's entry says."""
    cells: Sequence[Cell] = (
        leak_cells(p.leakage, name, p.source, p.seeds)
        if study == LEAKAGE
        else study_cells(p.studies[study], name, p.source, p.windows_s, p.seeds, p.only)
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
            "(windows_s of the studies, window_s of leakage; recording_s of the sensor)",
        ),
    ):
        most = max(getattr(cell, asked) for cell in cells)
        if limit is not None and most > limit:
            raise InputError(f"{_parameter(study)}.{name}: {most:g} {words}")


def over_folds(cells: Sequence[Cell], folds: Sequence[int], only: Only) -> list[Cell]:
    """One network per fold; any other estimator once, over the recordings of all folds.

    Raises:
        InputError: If ``only.fold`` is none of the folds.
    """
    if only.fold is not None and only.fold not in folds:
        raise InputError(
            f"only.fold={only.fold}: {cells[0].sensor} has folds {', '.join(map(str, folds))}"
        )
    wanted = [fold for fold in folds if only.fold in (None, fold)]
    return [
        replace(cell, fold=fold)
        for cell in cells
        for fold in (wanted if cell.estimator in NETWORKS else [HOLD_OUT])
    ]


def leak_params(
    cell: LeakCell, settings: Training, leakage: Leakage, splits: Splits
) -> dict[str, Any]:
    """Parameters that a run of the leak study carries; see :func:`run_params`.

    Args:
        cell: Which run.
        settings: What the network was trained with.
        leakage: How many recordings it uses, and into how many folds they or their windows go.
        splits: The seed of the deal.
    """
    folds = 1 if cell.fold == HOLD_OUT else leakage.folds
    used = {"folds": folds, "recordings": leakage.recordings, "split_seed": splits.split_seed}
    return asdict(cell) | used | settings.model_dump()


def run_params(
    cell: Cell, folds: int, training: Training, splits: Splits, virtual_gyros: VirtualGyros
) -> dict[str, Any]:
    """Parameters that a run of this cell carries: its identity, and what a network was made with.

    Args:
        cell: Which run.
        folds: How many folds make up the row it belongs to; 1 for a hold-out.
        training: Hyper-parameters.
        splits: Their validation counts and seed are recorded.
        virtual_gyros: Their turn-on jitter is recorded where the cell has some.
    """
    params: dict[str, Any] = asdict(cell) | {"folds": folds}
    if cell.virtual_gyros:
        params["turn_on_jitter_mdps"] = virtual_gyros.turn_on_jitter_mdps
    if cell.estimator not in NETWORKS:
        return params
    hold_out = cell.fold == HOLD_OUT
    validation = splits.validation_recordings if hold_out else splits.fold_validation_recordings
    params |= training.model_dump()
    return params | {"validation_recordings": validation, "split_seed": splits.split_seed}
