"""Which trainings the studies of the paper ask for: one :class:`Cell` each."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields, replace
from itertools import product
from typing import Any

from gyro_pipeline.conventions import AXES, HOLD_OUT, InputError
from gyro_pipeline.parameters import Only, Parameters, Splits, Study, Training, VirtualGyros

CNN, MEAN = "cnn", "mean"


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
        if self.estimator == CNN and self.real_imus == 1:
            content["method"] = 2
        return content

    @classmethod
    def names(cls) -> list[str]:
        """Names of the fields, in order."""
        return [field.name for field in fields(cls)]


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


def over_folds(cells: Sequence[Cell], folds: Sequence[int], only: Only) -> list[Cell]:
    """One network per fold; any other estimator once, over the recordings of all folds.

    Raises:
        InputError: If ``only.fold`` is none of the folds.
    """
    if only.fold is not None and only.fold not in folds:
        raise InputError(
            f"only.fold={only.fold}: {cells[0].sensor} has folds {min(folds)} to {max(folds)}"
        )
    wanted = [fold for fold in folds if only.fold in (None, fold)]
    return [
        replace(cell, fold=fold)
        for cell in cells
        for fold in (wanted if cell.estimator == CNN else [HOLD_OUT])
    ]


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
    if cell.estimator != CNN:
        return params
    validation = splits.validation_recordings if folds == 1 else splits.fold_validation_recordings
    params |= training.model_dump()
    params |= {"validation_recordings": validation, "split_seed": splits.split_seed}
    if cell.virtual_gyros:
        params["turn_on_jitter_mdps"] = virtual_gyros.turn_on_jitter_mdps
    return params
