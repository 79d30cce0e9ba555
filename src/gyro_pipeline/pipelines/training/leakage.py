"""Nodes of the leak study's training: leaks on purpose, in an experiment of their own."""

from collections.abc import Iterator
from dataclasses import asdict, replace
from typing import Any

import numpy as np
import pandas as pd
import xarray as xr

from gyro_pipeline.conventions import BEST_EPOCH_ON_TEST, TEST_IMU, InputError
from gyro_pipeline.fingerprints import code_hash, fingerprint
from gyro_pipeline.learning.examples import Device, with_shuffled_labels
from gyro_pipeline.learning.jobs import TrainingJob
from gyro_pipeline.parameters import Execution, Leakage, Only, Splits, Training
from gyro_pipeline.pipelines.training.nodes import (
    check_cell,
    check_present,
    labelled_bias,
    log_losses,
    train_missing,
    training_code,
)
from gyro_pipeline.protocol import leaks
from gyro_pipeline.protocol.leaks import Division, divide_windows, with_windows
from gyro_pipeline.protocol.windows import UsableWindows, window_size
from gyro_pipeline.studies import CNN_SHUFFLED, LEAKAGE, LeakCell, leak_cells, leak_params
from gyro_pipeline.tracking import FINGERPRINT, StoredRun, TrainedRun


def plan_leakage(
    leakage: Leakage,
    recordings: xr.Dataset,
    seeds: list[int],
    only: Only,
    training: Training,
    splits: Splits,
) -> pd.DataFrame:
    """List the trainings of the leak study on this sensor.

    Args:
        leakage: Its strides, recordings and network.
        recordings: Real recordings.
        seeds: Of the networks.
        only: Narrows the cells.
        training: Batch size, learning rate and centring.
        splits: The seed by which recordings and windows are dealt.

    Returns:
        A row per run: the fields of :class:`~gyro_pipeline.studies.LeakCell` and the
        ``fingerprint`` of all that its training depends on.

    Raises:
        InputError: If the recordings cannot give what is asked for, or ``only`` leaves nothing.
    """
    sensor, source = recordings.attrs["sensor"], recordings.attrs["source"]
    size = round(leakage.window_s * recordings.attrs["rate_hz"])
    label = f"{LEAKAGE} {sensor}, {leakage.window_s:g} s windows"
    log_losses(label, UsableWindows(recordings), size)
    recordings = with_windows(recordings, leakage)
    sizes = leakage.training(training, windows=1)
    code = [*training_code(), code_hash([leaks])]
    wanted = only.model_dump(exclude_none=True)
    rows = []
    for cell in leak_cells(leakage, sensor, source, seeds):
        if any(getattr(cell, key) != value for key, value in wanted.items()):
            continue
        check_cell(cell, recordings, sizes)
        check_present(cell, recordings)
        divide_windows(*_division(cell), recordings, leakage, splits.split_seed)
        content = cell.content | {
            "recordings": recordings.attrs["data_hash"],
            "training": training.model_dump(),
            "leakage": leakage.model_dump(exclude={"sensors", "strides_s"}),
            "split_seed": splits.split_seed,
            "code": code,
        }
        rows.append(asdict(cell) | {FINGERPRINT: fingerprint(content)})
    if not rows:
        raise InputError(
            f"only={wanted} leaves nothing of the leak study: 3 real gyroscopes, no virtual ones, "
            f"{leakage.window_s:g} s, seeds {seeds}"
        )
    return pd.DataFrame(rows)


def train_leakage(  # noqa: PLR0917 - a node's arguments are its datasets
    cells: pd.DataFrame,
    tracked: list[StoredRun],
    recordings: xr.Dataset,
    bias: pd.DataFrame,
    leakage: Leakage,
    training: Training,
    splits: Splits,
    execution: Execution,
) -> Iterator[TrainedRun]:
    """Train what the plan asks for and is not trained yet; each run is saved when it ends.

    Args:
        cells: From :func:`plan_leakage`.
        tracked: All trained runs on these logs.
        recordings: Real recordings.
        bias: Their ground truth.
        leakage: Recordings, network and steps.
        training: Batch size, learning rate and centring.
        splits: The seed of the deal.
        execution: How trainings are run.

    Yields:
        Runs that wait for their evaluation, each with its ``leak`` and ``window_stride_s``.
    """
    planned = {
        row[FINGERPRINT]: LeakCell(**{name: row[name] for name in LeakCell.names()})
        for row in cells.to_dict("records")
    }
    biases, recordings = labelled_bias(bias), with_windows(recordings, leakage)

    def job(name: str, cell: LeakCell) -> TrainingJob:
        divided = divide_windows(*_division(cell), recordings, leakage, splits.split_seed)
        return _job(name, cell, recordings, biases, divided, leakage, training)

    def params(cell: LeakCell) -> dict[str, Any]:
        return leak_params(cell, job("", cell).settings, leakage, splits)

    yield from train_missing(planned, tracked, recordings.attrs, execution, params, job)


def _job(  # noqa: PLR0917 - what a training is made of
    name: str,
    cell: LeakCell,
    recordings: xr.Dataset,
    biases: xr.DataArray,
    divided: Division,
    leakage: Leakage,
    training: Training,
) -> TrainingJob:
    def device(windows: dict[int, np.ndarray]) -> Device:
        numbers, starts = tuple(windows), tuple(windows.values())
        return Device(recordings.angular_rate, biases, (TEST_IMU,), numbers, starts)

    trained, shuffled = device(divided.training), cell.estimator == CNN_SHUFFLED
    if shuffled:
        trained = with_shuffled_labels(trained, np.random.default_rng(cell.seed))
    samples, rate_hz = recordings.sizes["sample"], recordings.attrs["rate_hz"]
    window = window_size(cell.window_s, rate_hz, samples, cell.sensor)
    return TrainingJob(
        name=name,
        devices=[trained],
        # the leak itself: the test windows choose the epoch
        validation=device(divided.test) if cell.leak == BEST_EPOCH_ON_TEST else None,
        window=window,
        settings=leakage.training(training, sum(trained.windows(window))),
        seed=cell.seed,
        cell=cell if shuffled else replace(cell, seed=0),  # a seed has labels of its own
    )


def _division(cell: LeakCell) -> tuple[str, int, float]:
    return cell.leak, cell.fold, cell.window_stride_s
