"""Which trainings are made together, and that it does not matter."""

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
import torch
import xarray as xr

from gyro_pipeline.learning import jobs as jobs_module
from gyro_pipeline.learning import trainings
from gyro_pipeline.learning.examples import Device
from gyro_pipeline.learning.jobs import StoredNetwork, TrainingJob, run_training
from gyro_pipeline.learning.trainings import (
    batch_device,
    estimated_bytes,
    in_batches,
    train_batch,
)
from gyro_pipeline.parameters import Training

CPU = torch.device("cpu")
SETTINGS = Training(
    centring="per_device",
    **{"channels": 4, "kernel": 6, "stride": 5, "pool": 2, "hidden": 8},
    **{"epochs": 4, "batch_size": 8, "learning_rate": 1e-3, "decay": 0.1, "decay_every": 2},
)


@pytest.fixture(autouse=True)
def torch_settings_restored():
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)
    torch.use_deterministic_algorithms(False)


def recordings():
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


def grid(windows=(40, 60), imus=(1, 2, 3), seeds=(0, 1)):
    """Every window with so many IMUs and every seed."""
    rates, bias = recordings()
    train, watch = tuple(range(1, 10)), (10, 11)
    return [
        TrainingJob(
            name=f"{window} {count} {seed}",
            devices=[device(rates, bias, imu, train, window) for imu in range(1, count + 1)],
            validation=device(rates, bias, 1, watch, window),
            window=window,
            settings=SETTINGS,
            seed=seed,
            cell=(window, count),
        )
        for window in windows
        for count in imus
        for seed in seeds
    ]


def results_of(jobs):
    """Trained in batches."""
    found = trainings.run_trainings(jobs, "batched", "all")
    return {jobs[number].name: trained for number, trained in found}


def one_by_one(jobs):
    return {job.name: run_training(job, lambda work: None) for job in jobs}


def assert_same(one, other):
    assert one.keys() == other.keys()
    windows = np.random.default_rng(1).normal(size=(50, 3, 60)).astype(np.float32)
    for name, trained in one.items():
        a, b = trained.artifact, other[name].artifact
        assert (a["architecture"], a["best_epoch"]) == (b["architecture"], b["best_epoch"])
        pd.testing.assert_frame_equal(trained.history, other[name].history, rtol=1e-5)
        for which in ("last", "best"):
            seen = windows[..., : a["architecture"]["window"]]
            given = (StoredNetwork(artifact, which).biases(seen) for artifact in (a, b))
            np.testing.assert_allclose(*given, rtol=0, atol=1e-5)


def test_networks_trained_at_once_are_those_trained_one_by_one():
    together, alone = results_of(grid()), one_by_one(grid())
    assert_same(together, alone)
    assert {trained.engine for trained in together.values()} == {"batched cpu"} or (
        torch.cuda.is_available()
    )
    assert {trained.engine for trained in alone.values()} <= {"fused", "cpu"}


def test_equal_sizes_are_a_batch_and_others_are_not():
    jobs = grid() + [replace(job, settings=other()) for job in grid(windows=(40,), imus=(1,))]
    batches = in_batches(jobs, CPU, memory=np.inf)
    assert sorted(batch.size for batch in batches) == [2, 6, 6]
    for batch in batches:
        assert len({(job.architecture, job.settings) for job in batch.jobs}) == 1
    assert [batch.work for batch in batches] == sorted((b.work for b in batches), reverse=True)


def other():
    return SETTINGS.model_copy(update={"learning_rate": 1e-2})


def test_batches_fit_the_memory_there_is_and_give_the_same(monkeypatch):
    jobs = grid(windows=(40,))
    whole = results_of(jobs)
    memory = 0.6 * estimated_bytes(jobs)
    batches = in_batches(jobs, CPU, memory)
    assert len(batches) > 1
    assert all(estimated_bytes(batch.jobs) <= memory for batch in batches)
    assert sorted(job.name for batch in batches for job in batch.jobs) == sorted(whole)
    monkeypatch.setattr(trainings, "free_memory", lambda device: memory)
    assert_same(results_of(jobs), whole)


def test_what_fits_nowhere_is_trained_alone():
    assert [batch.size for batch in in_batches(grid(windows=(40,)), CPU, memory=1.0)] == [1] * 6


def test_seeds_of_a_cell_share_memory_and_cells_do_not():
    one, two = grid(windows=(40,), imus=(3,))
    strangers = [replace(job, cell=None) for job in (one, two)]
    data = estimated_bytes(strangers) - estimated_bytes([one, two])
    assert data > 2 * 4 * 3 * 9 * 3 * 3 * 40  # IMUs, recordings, windows, axes, samples
    assert estimated_bytes([one, two]) > estimated_bytes([one])


def test_a_cell_is_prepared_once_for_all_its_seeds(monkeypatch):
    prepared, asked = jobs_module.prepared, []

    def counted(job, after_each):
        asked.append(job.cell)
        return prepared(job, after_each)

    monkeypatch.setattr(trainings, "prepared", counted)
    results_of(grid())
    assert sorted(asked) == sorted({job.cell for job in grid()})


def test_jobs_that_name_no_cell_share_nothing():
    jobs = [replace(job, cell=None) for job in grid(windows=(40,))]
    assert_same(results_of(jobs), results_of(grid(windows=(40,))))


def test_the_estimated_work_is_what_is_reported():
    for batch in in_batches(grid(), CPU, memory=np.inf):
        reported = []
        assert len(list(train_batch(batch, reported.append))) == batch.size
        assert sum(reported) == batch.work


def test_results_come_before_the_rest_is_trained():
    """So an interrupt loses only what has not been handed out."""
    (batch,) = in_batches(grid(windows=(40,)), CPU, memory=np.inf)
    reported = []
    results = train_batch(batch, reported.append)
    assert next(results)[0].cell == (40, 1)
    assert sum(reported) < batch.work
    results.close()


def test_a_loss_that_is_no_longer_finite_ends_the_run():
    steep = SETTINGS.model_copy(update={"learning_rate": 1e30})
    with pytest.raises(FloatingPointError, match="the loss is .* in epoch"):
        results_of([replace(job, settings=steep) for job in grid()])


@pytest.mark.parametrize(
    ("executor", "cuda", "chosen"),
    [
        ("auto", True, "cuda"),
        ("auto", False, None),
        ("batched", True, "cuda"),
        ("batched", False, "cpu"),
        ("processes", True, None),
        ("serial", True, None),
    ],
)
def test_the_gpu_is_used_where_there_is_one_and_asked_for_nowhere_else(
    monkeypatch, executor, cuda, chosen
):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: cuda)
    device = batch_device(executor)
    assert (device and device.type) == chosen


def test_nothing_to_train_is_nothing_to_do():
    assert results_of([]) == {}


def test_one_training_stays_on_the_processor(monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    assert run_training(grid()[0], lambda work: None).engine in {"fused", "cpu"}


def test_free_memory_is_less_than_all():
    assert 0 < trainings.free_memory(CPU) < 1e15


@pytest.mark.skipif(not torch.cuda.is_available(), reason="there is no GPU here")
def test_on_a_gpu_networks_are_those_of_the_processor():
    together = results_of(grid())
    assert {trained.engine for trained in together.values()} == {"batched cuda"}
    assert_same(together, one_by_one(grid()))
