"""Which trainings are made together, and that it does not matter."""

import logging
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
import torch
import xarray as xr
from torch import nn

from gyro_pipeline.learning import jobs as jobs_module
from gyro_pipeline.learning import trainings
from gyro_pipeline.learning.examples import Device
from gyro_pipeline.learning.jobs import StoredNetwork, TrainingJob, run_training
from gyro_pipeline.learning.network import CalibrationNetwork
from gyro_pipeline.learning.trainings import batch_device, in_batches, run_trainings, train_batch
from gyro_pipeline.parameters import Training

DEVICE = torch.device("cuda" if torch.cuda.is_available() else "cpu")
SETTINGS = Training(
    centring="per_device",
    **{"channels": 4, "kernel": 6, "stride": 5, "pool": 2, "hidden": 8},
    **{"epochs": 4, "batch_size": 8, "learning_rate": 1e-3, "decay": 0.1, "decay_every": 2},
)


def recorded():
    generator = np.random.default_rng(0)
    bias = generator.normal(size=(3, 12, 3))
    rates = bias[..., None] + generator.normal(size=(3, 12, 3, 123))
    coords = {"imu": [1, 2, 3], "recording": np.arange(1, 13), "axis": list("xyz")}
    dims = ("imu", "recording", "axis", "sample")
    return (
        xr.DataArray(rates.astype(np.float32), dims=dims, coords=coords),
        xr.DataArray(bias, dims=dims[:-1], coords=coords),
    )


def device(rates, bias, imu, numbers, size):
    starts = np.arange(0, rates.sizes["sample"] - size + 1, size)
    biases = bias.sel(imu=imu, recording=list(numbers)).to_numpy()
    return Device(rates, (imu,), numbers, biases, (starts,) * len(numbers))


def grid(windows=(40, 60), imus=(1, 2), seeds=(0, 1)):
    """Every window with so many IMUs and every seed, and once more without the last recording."""
    rates, bias = recorded()
    return [
        TrainingJob(
            name=f"{window} {count} {train} {seed}",
            devices=[device(rates, bias, imu, train, window) for imu in range(1, count + 1)],
            validation=device(rates, bias, 1, (10, 11), window),
            window=window,
            settings=SETTINGS,
            seed=seed,
            cell=(window, count, train),
        )
        for window in windows
        for count in imus
        for train in (tuple(range(1, 9)), tuple(range(2, 10)))
        for seed in seeds
    ]


def results_of(jobs):
    """Trained in batches."""
    return {jobs[number].name: trained for number, trained in run_trainings(jobs, "batched", "all")}


def assert_those_one_by_one(jobs, results):
    windows = np.random.default_rng(1).normal(size=(50, 3, 60)).astype(np.float32)
    assert results.keys() == {job.name for job in jobs}
    for job in jobs:
        got, expected = results[job.name], run_training(job, lambda work: None)
        assert got.artifact["best_epoch"] == expected.artifact["best_epoch"]
        pd.testing.assert_frame_equal(got.history, expected.history, rtol=1e-5)
        for which in ("last", "best"):
            seen = windows[..., : job.window]
            given = (StoredNetwork(one.artifact, which).biases(seen) for one in (got, expected))
            np.testing.assert_allclose(*given, rtol=0, atol=1e-5)


def test_networks_trained_at_once_are_those_trained_one_by_one():
    results = results_of(grid())
    assert_those_one_by_one(grid(), results)
    assert {trained.engine for trained in results.values()} == {f"batched {DEVICE.type}"}


def test_equal_sizes_schedules_and_numbers_of_windows_are_a_batch():
    steeper = SETTINGS.model_copy(update={"learning_rate": 1e-2})
    one = grid(windows=(40,), imus=(1,))
    jobs = grid() + [replace(job, settings=steeper) for job in one]
    jobs += [replace(job, validation=None) for job in one]
    assert [len(batch.jobs) for batch in in_batches(jobs, DEVICE, 1e12)] == [4] * 6


def test_batches_fit_the_memory_there_is_and_one_training_is_always_made():
    jobs = grid(windows=(40,), imus=(1,))
    memory = 2.5 * trainings._bytes(jobs[0])
    assert [len(batch.jobs) for batch in in_batches(jobs, DEVICE, memory)] == [2, 2]
    assert [len(batch.jobs) for batch in in_batches(jobs, DEVICE, 1.0)] == [1] * 4
    assert 0 < trainings.free_memory(DEVICE) < 1e15


def test_a_cell_is_prepared_once_for_all_its_seeds(monkeypatch):
    prepared, asked = jobs_module.prepared, []
    monkeypatch.setattr(trainings, "prepared", lambda job: asked.append(job.cell) or prepared(job))
    results_of(grid())
    assert sorted(asked) == sorted({job.cell for job in grid()})
    asked.clear()
    strangers = [replace(job, cell=None) for job in grid(windows=(40,), imus=(1,))]
    assert_those_one_by_one(strangers, results_of(strangers))
    assert len(asked) == len(strangers)


class Dropping(CalibrationNetwork):
    """The paper's network with dropout, which no two trainings share."""

    def forward_packed(self, packed):
        return super().forward_packed(nn.functional.dropout(packed, 0.1))


def test_networks_that_cannot_be_batched_are_trained_one_by_one_and_the_log_says_why(
    monkeypatch, caplog
):
    caplog.set_level(logging.INFO)
    for module in (jobs_module, trainings):
        monkeypatch.setattr(
            module, "initial_network", lambda architecture, _: Dropping(architecture)
        )
    (batch,) = in_batches(grid(windows=(40,), imus=(1,)), DEVICE, 1e12)
    reported = []
    assert [one.engine for one in train_batch(batch, reported.append)] == ["cpu"] * 4
    assert sum(reported) == pytest.approx(batch.work)
    assert "Dropping: trained one by one: vmap: called random operation" in caplog.text


def test_the_estimated_work_is_what_is_reported():
    for batch in in_batches(grid(), DEVICE, 1e12):
        reported = []
        train_batch(batch, reported.append)
        assert sum(reported) == pytest.approx(batch.work)
        assert len(reported) == len(batch.jobs) + SETTINGS.epochs


def test_a_loss_that_is_no_longer_finite_ends_the_run():
    steep = SETTINGS.model_copy(update={"learning_rate": 1e30})
    with pytest.raises(FloatingPointError, match="the loss is .* in epoch"):
        results_of([replace(job, settings=steep) for job in grid()])


@pytest.mark.parametrize(
    ("executor", "cuda", "chosen"),
    [
        *(("auto", True, "cuda"), ("auto", False, None)),
        *(("batched", True, "cuda"), ("batched", False, "cpu")),
        *(("processes", True, None), ("serial", True, None)),
    ],
)
def test_the_gpu_is_used_where_there_is_one_and_asked_for_nowhere_else(
    monkeypatch, executor, cuda, chosen
):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: cuda)
    found = batch_device(executor)
    assert (found and found.type) == chosen


def test_nothing_to_train_is_nothing_to_do():
    assert results_of([]) == {}
