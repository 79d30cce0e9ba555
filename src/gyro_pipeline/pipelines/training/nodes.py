"""Nodes of the training stage."""

import logging
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any, TypeVar

import numpy as np
import pandas as pd
import xarray as xr

from gyro_pipeline.conventions import AXES, TEST, TEST_IMU, TRAIN, VALIDATION, InputError
from gyro_pipeline.estimators import ESTIMATORS
from gyro_pipeline.fingerprints import code_hash, fingerprint
from gyro_pipeline.learning import (
    batched,
    examples,
    fused,
    jobs,
    network,
    packing,
    trainer,
    trainings,
)
from gyro_pipeline.learning.examples import Device, with_shuffled_labels
from gyro_pipeline.learning.jobs import TrainingJob
from gyro_pipeline.learning.trainings import run_trainings
from gyro_pipeline.parameters import Execution, Only, Splits, Study, Training, VirtualGyros
from gyro_pipeline.protocol import windows
from gyro_pipeline.protocol.recordings import present
from gyro_pipeline.protocol.splits import check_devices, check_roles, refuse_two_roles, with_role
from gyro_pipeline.protocol.windows import UsableWindows, window_size
from gyro_pipeline.studies import (
    CNN,
    CNN_SHUFFLED,
    NETWORKS,
    Cell,
    over_folds,
    run_params,
    study_cells,
)
from gyro_pipeline.tracking import FINGERPRINT, HISTORY, TRAINED_IN, WEIGHTS, StoredRun, TrainedRun

logger = logging.getLogger(__name__)

_ADVICE = "lower windows_s of the study, or bring recordings that lost fewer samples"


def plan(
    study: Study,
    recordings: xr.Dataset,
    roles: pd.DataFrame,
    windows_s: list[float],
    seeds: list[int],
    only: Only,
    training: Training,
    virtual: xr.Dataset | None = None,
) -> pd.DataFrame:
    """List the runs that the study needs on this sensor, before anything is trained.

    Args:
        study: Its grid.
        recordings: Real recordings.
        roles: Which of them train, validate and test, in each fold.
        windows_s: Calibration times, seconds.
        seeds: Of the networks.
        only: Narrows the grid.
        training: Hyper-parameters; part of each fingerprint.
        virtual: Virtual recordings, where the study uses some.

    Returns:
        A row per run: the fields of :class:`~gyro_pipeline.studies.Cell`, ``folds`` and the
        ``fingerprint`` of all that its training depends on.

    Raises:
        InputError: If the recordings cannot give what the grid asks for.
    """
    check = check_devices if study.unseen_devices else check_roles
    check(roles)
    sensor, source = recordings.attrs["sensor"], recordings.attrs["source"]
    folds = sorted(roles.fold.unique().tolist())
    cells = study_cells(study, sensor, source, windows_s, seeds, only)
    for cell in cells:
        check_cell(cell, recordings, training)
        if not study.unseen_devices:
            check_present(cell, recordings)
    tested = tested_folds(study.experiment, cells, recordings, roles)
    cells = [one for cell in cells for one in over_folds([cell], tested[cell.window_s], only)]
    code = training_code()
    rows = []
    for cell in cells:
        content = cell.content | {"recordings": recordings.attrs["data_hash"]}
        if cell.estimator in NETWORKS:
            content |= {"training": training.model_dump(), "code": code}
            content |= {"roles": roles[roles.fold == cell.fold].role.tolist()}
        else:
            content |= {"tested": {fold: with_role(roles, fold, TEST) for fold in folds}}
        if cell.virtual_gyros and virtual is not None:
            content |= {"virtual": virtual.attrs["data_hash"]}
        hashed = fingerprint(content)
        made_of = {FINGERPRINT: hashed, "folds": len(tested[cell.window_s])}
        rows.append({name: getattr(cell, name) for name in Cell.names()} | made_of)
    return pd.DataFrame(rows)


def tested_folds(
    study: str, cells: Sequence[Cell], recordings: xr.Dataset, roles: pd.DataFrame
) -> dict[float, list[int]]:
    """Folds with a window to test, for each window length; the log says which windows are lost.

    Raises:
        InputError: No fold has one.
    """
    sensor, rate_hz = recordings.attrs["sensor"], recordings.attrs["rate_hz"]
    windows, tests = UsableWindows(recordings), roles[roles.role == TEST]
    tests = tests if "imu" in tests else tests.assign(imu=TEST_IMU)
    folds: dict[float, list[int]] = {}
    for window_s in dict.fromkeys(cell.window_s for cell in cells):
        size, label = round(window_s * rate_hz), f"{study} {sensor}, {window_s:g} s windows"
        log_losses(label, windows, size)
        places = zip(tests.imu.tolist(), tests.recording.tolist(), strict=True)
        counts = [windows.count([imu], number, size) for imu, number in places]
        folds[window_s] = sorted(tests.fold[np.array(counts) > 0].unique().tolist())
        if not folds[window_s]:
            raise InputError(f"{label}: no test recording has one that can be used; {_ADVICE}")
    return folds


def train(  # noqa: PLR0913, PLR0917 - a node's arguments are its datasets
    cells: pd.DataFrame,
    tracked: list[StoredRun],
    recordings: xr.Dataset,
    bias: pd.DataFrame,
    roles: pd.DataFrame,
    training: Training,
    splits: Splits,
    virtual_gyros: VirtualGyros,
    execution: Execution,
    virtual: xr.Dataset | None = None,
) -> Iterator[TrainedRun]:
    """Train what the plan asks for and no study has trained yet; each run is saved when it ends.

    Args:
        cells: From :func:`plan`.
        tracked: All trained runs on these logs, of any study.
        recordings: Real recordings; workers read only what they need of them.
        bias: Their ground truth.
        roles: Which of them train and validate, in each fold.
        training: Hyper-parameters.
        splits: Recorded with each run.
        virtual_gyros: Which virtual recordings train.
        execution: How trainings are run.
        virtual: Virtual recordings, where the study uses some.

    Yields:
        Runs that wait for their evaluation.
    """
    planned = {row[FINGERPRINT]: _cell(row) for row in cells.to_dict("records")}
    folds = dict(zip(planned.values(), cells.folds.tolist(), strict=True))
    devices = Devices(recordings, labelled_bias(bias), roles, virtual, virtual_gyros)
    yield from train_missing(
        planned,
        tracked,
        recordings.attrs,
        execution,
        params=lambda cell: run_params(cell, folds[cell], training, splits, virtual_gyros),
        job=lambda name, cell: devices.job(name, cell, training),
    )


def training_code() -> list[str]:
    """What the results of a training depend on beside its settings and data."""
    modules = [batched, examples, fused, jobs, network, packing, trainer, trainings, windows]
    return [code_hash(modules), *(path.read_text() for path in fused.SOURCES)]


def log_losses(label: str, windows: UsableWindows, size: int) -> None:
    """Say which windows of a study are left out, if any is."""
    if losses := windows.losses(size):
        logger.warning("%s: %s", label, losses)


C = TypeVar("C", bound=Cell)


def train_missing(
    planned: Mapping[str, C],
    tracked: Sequence[StoredRun],
    data: Mapping[str, Any],
    execution: Execution,
    params: Callable[[C], dict[str, Any]],
    job: Callable[[str, C], TrainingJob],
) -> Iterator[TrainedRun]:
    """Train the cells of one study and sensor that are not trained yet.

    Args:
        planned: All of them by fingerprint.
        tracked: All trained runs on these logs, of any study.
        data: Attributes of the recordings.
        execution: How trainings are run.
        params: What the run of a cell carries.
        job: The training of a cell, by its fingerprint.

    Yields:
        Runs that wait for their evaluation.
    """
    tagged = {"data_hash": data["data_hash"], "simulated": str(data["simulated"])}

    def run(fp: str, started: float, tags: dict[str, str], **left: Any) -> TrainedRun:
        tags = tagged | {FINGERPRINT: fp} | tags
        carried = params(planned[fp])
        return TrainedRun(planned[fp].study, carried, tags, _ms(started), _ms(time.time()), **left)

    study = next(iter(planned.values())).study
    here = {run.fingerprint for run in tracked if run.study == study}
    elsewhere = {run.fingerprint: run for run in tracked}
    missing = [fp for fp in planned if fp not in here]
    shared = [fp for fp in missing if fp in elsewhere]
    networks = [fp for fp in missing if planned[fp].estimator in NETWORKS]
    to_train = [fp for fp in networks if fp not in elsewhere]
    label = f"{study} {data['sensor']}"
    logger.info(
        "%s: %d runs planned, %d skipped (trained before), %d shared with another study, "
        "%d to train",
        *(label, len(planned), len(planned) - len(missing), len(shared), len(to_train)),
    )
    for fp in missing:
        if fp in shared:
            twin = elsewhere[fp]
            left = _copied(twin) if fp in networks else {}
            yield run(fp, time.time(), {TRAINED_IN: twin.tags.get(TRAINED_IN, twin.study)}, **left)
        elif fp not in to_train:
            yield run(fp, time.time(), {})
    todo = [job(fp, planned[fp]) for fp in to_train]
    for done, trained in run_trainings(todo, execution, label):
        artifacts = {WEIGHTS: trained.artifact, HISTORY: trained.history}
        ended = {
            "best_epoch": str(trained.artifact["best_epoch"]),
            "last_epoch": str(trained.history.epoch.iloc[-1]),
            "engine": trained.engine,
        }
        yield run(done.name, trained.started, ended, history=trained.history, artifacts=artifacts)


class Devices:
    """Training devices of each cell: real IMUs first, the test IMU first of all."""

    def __init__(
        self,
        recordings: xr.Dataset,
        bias: xr.DataArray,
        roles: pd.DataFrame,
        virtual: xr.Dataset | None,
        virtual_gyros: VirtualGyros,
    ) -> None:
        self._recordings, self._bias, self._roles = recordings, bias, roles
        self._virtual, self._virtual_gyros = virtual, virtual_gyros
        self._windows = UsableWindows(recordings)

    def job(self, name: str, cell: Cell, training: Training) -> TrainingJob:
        """The training of a cell, under a name of the caller's choice.

        Raises:
            InputError: If a recording would be used in two roles, be it by different IMUs, or no
                window is left to train on.
        """
        samples, rate_hz = self._recordings.sizes["sample"], self._recordings.attrs["rate_hz"]
        imus = tuple(self._recordings.imu.to_numpy()[: cell.real_imus].tolist())
        inputs = [imus] if cell.method == 1 else [(imu,) for imu in imus]
        window = window_size(cell.window_s, rate_hz, samples, cell.sensor)
        devices = [self._real(side_by_side, cell.fold, TRAIN, window) for side_by_side in inputs]
        if not devices[0].numbers:  # whose centre the estimates are about
            raise InputError(
                f"{cell.study} {cell.sensor} fold {cell.fold}, {cell.window_s:g} s windows: no "
                f"training recording has one that can be used; {_ADVICE}"
            )
        devices = [device for device in devices if device.numbers]
        validation = self._real(inputs[0], cell.fold, VALIDATION, window)
        tested = [(TEST_IMU, number) for number in with_role(self._roles, cell.fold, TEST)]
        used = {TRAIN: _used(devices), VALIDATION: _used([validation]), TEST: tested}
        refuse_two_roles(used, f"{cell.sensor} fold {cell.fold}")
        devices += [self._virtual_imu(imu) for imu in range(1, 1 + cell.virtual_imus)]
        shuffled = cell.estimator == CNN_SHUFFLED
        if shuffled:
            generator = np.random.default_rng(cell.seed)
            devices = [with_shuffled_labels(device, generator) for device in devices]
        return TrainingJob(
            name=name,
            devices=devices,
            validation=validation if validation.numbers else None,
            window=window,
            settings=training,
            seed=cell.seed,
            cell=cell if shuffled else replace(cell, seed=0),  # a seed has labels of its own
        )

    def _real(self, imus: tuple[int, ...], fold: int, role: str, window: int) -> Device:
        numbers = [
            number
            for number in with_role(self._roles, fold, role)
            if self._windows.count(imus, number, window)
        ]
        return Device(self._recordings.angular_rate, self._bias, imus, tuple(numbers))

    def _virtual_imu(self, imu: int) -> Device:
        if self._virtual is None:
            raise InputError("virtual gyroscopes asked of a pipeline that makes none")
        numbers = range(1, 1 + self._virtual_gyros.train_recordings)
        return Device(
            self._virtual.angular_rate, self._virtual.recording_mean.load(), (imu,), tuple(numbers)
        )


def _used(devices: Sequence[Device]) -> list[tuple[int, int]]:
    """IMU and number of every recording."""
    return [(imu, n) for device in devices for imu in device.imus for n in device.numbers]


def check_cell(cell: Cell, recordings: xr.Dataset, training: Training) -> None:
    """Refuse a cell that the recordings cannot give.

    Raises:
        InputError: A window that does not fit, or more IMUs than there are.
    """
    if cell.estimator not in (*NETWORKS, *ESTIMATORS):
        raise InputError(
            f"{cell.study}: unknown estimator {cell.estimator!r}; there are {CNN}, "
            f"{', '.join(ESTIMATORS)}"
        )
    samples, rate_hz = recordings.sizes["sample"], recordings.attrs["rate_hz"]
    size = window_size(cell.window_s, rate_hz, samples, cell.sensor)
    if cell.estimator in NETWORKS:
        jobs.sized(training, cell.real_gyros if cell.method == 1 else len(AXES), size)
    if cell.real_imus > recordings.sizes["imu"]:
        available = len(AXES) * recordings.sizes["imu"]
        raise InputError(
            f"{cell.sensor}: {cell.real_gyros} gyroscopes asked by {cell.study}, the "
            f"{cell.source} recordings hold {available}; narrow with --params=only.real_gyros=..."
        )


def check_present(cell: Cell, recordings: xr.Dataset) -> None:
    """Refuse a recording that one of the IMUs that are seen side by side lacks.

    Raises:
        InputError: Naming the recording.
    """
    if cell.method != 1 or cell.real_imus == 1:
        return  # a recording that an IMU lacks is not used for it
    there = present(recordings).isel(imu=slice(cell.real_imus))
    for number in recordings.recording[~there.all("imu").to_numpy()].to_numpy():
        raise InputError(
            f"{cell.sensor} recording {number}: expected {cell.real_imus} IMUs side by side for "
            f"{cell.study} (method 1), not all are there"
        )


def _cell(row: Mapping[Any, Any]) -> Cell:
    return Cell(**{name: row[name] for name in Cell.names()})


def labelled_bias(bias: pd.DataFrame) -> xr.DataArray:
    """The bias table as an array (imu, recording, axis), deg/s."""
    return bias.set_index(["imu", "recording", "axis"]).bias_dps.to_xarray()


def _copied(twin: StoredRun) -> dict[str, Any]:
    history = twin.load(HISTORY)
    return {"history": history, "artifacts": {WEIGHTS: twin.load(WEIGHTS), HISTORY: history}}


def _ms(seconds: float) -> int:
    return int(1000 * seconds)
