"""Trainings as jobs: one by one, and many at once."""

import logging
from dataclasses import replace
from itertools import product

import numpy as np
import pandas as pd
import pytest
import torch
from torch import nn

from gyro_pipeline.learning import trainings
from gyro_pipeline.learning.design import Design, options_of
from gyro_pipeline.learning.examples import training_examples
from gyro_pipeline.learning.jobs import StoredNetwork, TrainingJob, run_training
from gyro_pipeline.learning.trainings import batch_device, run_trainings
from gyro_pipeline.physics.bias import windows_at

WINDOW = 40
DEVICE = torch.device("cuda" if torch.cuda.is_available() else "cpu")
PAPER = "gyro_pipeline.learning.network:CalibrationNetwork"
OTHERS = {"seed": 0, "path": PAPER, "cell": None}


class Dropping(nn.Module):
    """A network of one's own with dropout, which no two trainings share."""

    def __init__(self, gyroscopes, window, share=0.1):
        super().__init__()
        self.drop, self.output = nn.Dropout(share), nn.Linear(window, 1)

    def forward(self, windows):
        return self.output(self.drop(windows)).squeeze(2)


@pytest.fixture
def make(recorded, device, schedule):
    """A job: ``make(seed=1, epochs=3)``."""

    def made(data=None, imus=((1,), (2,)), train=range(1, 9), *, validate=(9, 10), **given):
        seed, path, cell = (given.pop(name, default) for name, default in OTHERS.items())
        rates, bias = data or recorded()
        settings = schedule(**{"batch_size": 8, "epochs": 6, "decay_every": 4, **given})
        devices = [device(rates, bias, one, train, WINDOW) for one in imus]
        validation = device(rates, bias, imus[0], validate, WINDOW) if validate else None
        design = Design(path, 3 * len(imus[0]), WINDOW, options_of(path, settings, {}))
        return TrainingJob(design, devices, validation, settings, seed, cell)

    return made


def differing(one, other, which="last"):
    mine, theirs = one.artifact[which], other.artifact[which]
    return {name for name in mine if not torch.equal(mine[name], theirs[name])}


@pytest.mark.parametrize("path", [PAPER, f"{__name__}:Dropping"])
def test_the_seed_alone_is_random_and_global_state_is_left_alone(make, path, monkeypatch):
    if path != PAPER:
        design = "gyro_pipeline.learning.design.network_class"
        monkeypatch.setattr(design, lambda _: Dropping)
    torch.manual_seed(3)
    before = torch.get_rng_state()
    first = run_training(make(path=path))
    assert torch.equal(torch.get_rng_state(), before)
    torch.rand(3)
    torch.set_num_threads(2)
    again, other = run_training(make(path=path)), run_training(make(path=path, seed=1))
    assert not differing(first, again) | differing(first, again, "best")
    assert first.losses.equals(again.losses)
    assert differing(first, other) == set(first.artifact["last"])
    reordered = replace(make(), seed=1)
    monkeypatch.setattr(Design, "build", lambda self, _, build=Design.build: build(self, 0))
    assert differing(run_training(make()), run_training(reordered))


def test_validation_and_test_recordings_do_not_reach_the_weights(make, recorded):
    rates, bias = recorded()
    untouched = run_training(make((rates, bias)))
    other_rates, other_bias = rates.copy(deep=True), bias.copy(deep=True)
    other_rates[:, 8:] *= -3  # numbers 9 and 10 validate, 11 and 12 test
    other_bias[:, 8:] += 7
    changed = run_training(make((other_rates, other_bias)))
    assert not differing(untouched, changed)
    assert not untouched.losses.val_loss.equals(changed.losses.val_loss)
    alone = run_training(make(validate=()))
    assert alone.artifact["best"] is None
    assert not differing(untouched, alone)


@pytest.mark.parametrize("imus", [((1,), (2,)), ((2, 1),)], ids=["training data", "channels"])
def test_a_stored_network_estimates_its_outputs_scaled_back(make, recorded, imus):
    rates, bias = recorded()
    over_fitting = {"train": range(1, 5), "epochs": 40, "learning_rate": 3e-2, "decay_every": 40}
    job = make((rates, bias), imus, centring="global", **over_fitting)
    trained = run_training(job)
    artifact = trained.artifact
    assert trained.losses.val_loss.idxmin() < 39
    samples = rates.sel(imu=list(imus[0]), recording=11).to_numpy().reshape(-1, rates.shape[-1])
    windows = windows_at(samples, WINDOW, np.array([0, WINDOW])).transpose(1, 0, 2)
    _, scaling = training_examples(job.devices, job.design.layout, "global")
    centre = scaling.centres[0]
    scaled = torch.from_numpy((windows - centre[:, None]) / scaling.input_scale)
    for which in ("last", "best"):
        network = job.design.build(seed=99)
        network.load_state_dict(artifact[which])
        with torch.no_grad():
            expected = centre + scaling.target_scale * network.double()(scaled).numpy()
        estimates = StoredNetwork(artifact, which).biases(windows)
        assert np.abs(expected - centre).max() > 100 * 2e-5 * scaling.target_scale
        np.testing.assert_allclose(estimates, expected, atol=2e-5 * scaling.target_scale)


def grid(make, recorded, path=PAPER):
    """Two numbers of devices and two splits, each with two seeds."""
    data, trains = recorded(imus=2), (range(1, 9), range(2, 10))
    return [
        make(data, imus, train, seed=seed, path=path, cell=(len(imus), train))
        for imus, train, seed in product((((1,),), ((1,), (2,))), trains, (0, 1))
    ]


def test_networks_trained_at_once_are_those_trained_one_by_one(make, recorded, monkeypatch):
    asked, prepare = [], trainings.prepare_examples
    monkeypatch.setattr(
        trainings, "prepare_examples", lambda job: asked.append(job.cell) or prepare(job)
    )
    jobs = grid(make, recorded)
    results = dict(run_trainings(jobs, DEVICE, "all"))
    assert sorted(results) == list(range(8))
    assert len(asked) == len(set(asked)) == 4  # once for all seeds
    windows = np.random.default_rng(1).normal(size=(50, 3, WINDOW)).astype(np.float32)
    for number, job in enumerate(jobs):
        together, alone = results[number], run_training(job)
        assert together.engine == f"batched {DEVICE.type}"
        pd.testing.assert_frame_equal(together.losses, alone.losses, rtol=1e-5)
        pair = (StoredNetwork(one.artifact, "best").biases(windows) for one in (together, alone))
        np.testing.assert_allclose(*pair, rtol=0, atol=1e-5)
    assert not list(run_trainings([], DEVICE, "none"))


def test_what_cannot_be_trained_at_once_is_trained_one_by_one_and_the_log_says_why(
    make, recorded, monkeypatch, caplog
):
    caplog.set_level(logging.INFO)
    rates, bias = recorded()
    jobs = [make((rates.where(rates.recording != 3), bias)), make((rates, bias))]
    results = dict(run_trainings(jobs, DEVICE, "all"))
    assert "training samples are not all finite" in str(results[0])
    assert results[1].engine in {"fused", "cpu"}
    assert "all: batch 1 of 1, 2 networks: trained one by one: training samples" in caplog.text
    monkeypatch.setattr("gyro_pipeline.learning.design.network_class", lambda _: Dropping)
    results = dict(run_trainings(grid(make, recorded)[:4], DEVICE, "own"))
    assert {result.engine for result in results.values()} == {"cpu"}
    assert "Dropping: trained one by one: vmap: called random operation" in caplog.text


def test_the_gpu_is_used_where_there_is_one_and_asked_for_nowhere_else(monkeypatch):
    for executor, cuda, chosen in (
        *(("auto", True, "cuda"), ("auto", False, None)),
        *(("batched", True, "cuda"), ("batched", False, "cpu")),
        *(("processes", True, None), ("serial", True, None)),
    ):
        monkeypatch.setattr(torch.cuda, "is_available", lambda cuda=cuda: cuda)
        place = batch_device(executor)
        assert (place and place.type) == chosen


def test_estimates_are_equal_for_any_number_of_threads():
    sizes = {"channels": 8, "kernel": 10, "stride": 10, "pool": 8, "hidden": 32}
    design = Design(PAPER, 3, 108, sizes)
    weights = design.build(seed=0).state_dict()
    scaling = {"centre": torch.zeros(3), "input_scale": 1.0, "target_scale": 1.0}
    network = StoredNetwork({"network": vars(design), "scaling": scaling, "last": weights}, "last")
    windows = np.random.default_rng(0).normal(size=(8, 3, 108)).astype(np.float32)
    threads, estimates = torch.get_num_threads(), []
    try:
        for number in (1, 2, 4):
            torch.set_num_threads(number)
            estimates.append(network.biases(windows))
            assert torch.get_num_threads() == number
    finally:
        torch.set_num_threads(threads)
    np.testing.assert_array_equal(estimates[1:], [estimates[0]] * 2)
