from dataclasses import replace

import numpy as np
import pytest
import torch
import xarray as xr

from gyro_pipeline.conventions import InputError
from gyro_pipeline.learning import jobs
from gyro_pipeline.learning.examples import Device, training_examples
from gyro_pipeline.learning.jobs import (
    StoredNetwork,
    TrainingJob,
    initial_network,
    run_training,
)
from gyro_pipeline.learning.network import Architecture
from gyro_pipeline.parameters import Training
from gyro_pipeline.physics.bias import windows_at

WINDOW = 40
STARTS = np.array([0, WINDOW])


def settings(**changes):
    given = {
        "centring": "per_device",
        "channels": 4,
        "kernel": 6,
        "stride": 5,
        "pool": 2,
        "hidden": 8,
        "epochs": 6,
        "batch_size": 8,
        "learning_rate": 1e-3,
        "decay": 0.1,
        "decay_every": 4,
    }
    return Training(**given | changes)


def recorded(imus=2, recordings=12, spread=1.0, noise=0.3, seed=0):
    """Rates (imu, recording, axis, sample) and biases: units far apart, turn-ons by ``spread``."""
    generator = np.random.default_rng(seed)
    bias = 5 * generator.normal(size=(imus, 1, 3)) + spread * generator.normal(
        size=(imus, recordings, 3)
    )
    rates = bias[..., None] + noise * generator.normal(size=(*bias.shape, 2 * WINDOW + 3))
    coords = {
        "imu": np.arange(1, imus + 1),
        "recording": np.arange(1, recordings + 1),
        "axis": list("xyz"),
    }
    dims = ("imu", "recording", "axis", "sample")
    return (
        xr.DataArray(rates.astype(np.float32), dims=dims, coords=coords),
        xr.DataArray(bias, dims=dims[:-1], coords=coords),
    )


def device(rates, bias, imus, numbers):
    labels = bias.sel(imu=list(imus), recording=list(numbers))
    biases = labels.transpose("recording", "imu", "axis").to_numpy().reshape(len(numbers), -1)
    return Device(rates, imus, tuple(numbers), biases, (STARTS,) * len(numbers))


def job(data=None, imus=((1,), (2,)), train=range(1, 9), validate=(9, 10), seed=0, **changes):
    rates, bias = data or recorded()
    devices = [device(rates, bias, one, train) for one in imus]
    validation = device(rates, bias, imus[0], validate) if validate else None
    return TrainingJob("a job", devices, validation, WINDOW, settings(**changes), seed)


def run(a_job):
    return run_training(a_job, lambda work: None)


def windows_of(rates, imus, number):
    """Windows (n, gyroscopes, samples), as an estimator sees them."""
    chosen = rates.sel(imu=list(imus), recording=number).to_numpy()
    return windows_at(chosen.reshape(-1, chosen.shape[-1]), WINDOW, STARTS).transpose(1, 0, 2)


def differing(one, other):
    return [name for name in one if not torch.equal(one[name], other[name])]


def test_two_runs_give_the_same_weights_bit_by_bit():
    torch.manual_seed(1)
    first = run(job())
    torch.manual_seed(2)
    torch.rand(3)
    torch.set_num_threads(2)
    second = run(job())
    for which in ("last", "best"):
        assert differing(first.artifact[which], second.artifact[which]) == []
    assert first.history.equals(second.history)


def test_another_seed_starts_elsewhere_and_ends_elsewhere():
    one, other = run(job(seed=0)), run(job(seed=1))
    assert set(differing(one.artifact["last"], other.artifact["last"])) == set(one.artifact["last"])
    a = job().architecture
    assert differing(initial_network(a, 0).state_dict(), initial_network(a, 0).state_dict()) == []
    assert differing(initial_network(a, 0).state_dict(), initial_network(a, 1).state_dict())


def test_the_seed_orders_the_examples_too(monkeypatch):
    a = job().architecture
    monkeypatch.setattr(jobs, "initial_network", lambda *_: initial_network(a, 0))
    one, other = run(job(seed=0)), run(job(seed=1))
    assert differing(one.artifact["last"], other.artifact["last"])
    assert differing(one.artifact["last"], run(job(seed=0)).artifact["last"]) == []


def test_global_random_state_is_left_alone():
    torch.manual_seed(3)
    np.random.seed(3)  # noqa: NPY002 - the global state is what is watched
    before, numpy_before = torch.get_rng_state(), np.random.get_state()  # noqa: NPY002
    run(job())
    assert torch.equal(torch.get_rng_state(), before)
    np.testing.assert_array_equal(np.random.get_state()[1], numpy_before[1])  # noqa: NPY002


def test_validation_and_test_recordings_do_not_reach_the_weights():
    rates, bias = recorded()
    untouched = run(job((rates, bias)))
    changed_rates, changed_bias = rates.copy(deep=True), bias.copy(deep=True)
    changed_rates[:, 8:] *= -3  # numbers 9 and 10 validate, 11 and 12 test
    changed_bias[:, 8:] += 7
    changed = run(job((changed_rates, changed_bias)))
    assert differing(untouched.artifact["last"], changed.artifact["last"]) == []
    assert untouched.history.train_loss.equals(changed.history.train_loss)
    assert not untouched.history.val_loss.equals(changed.history.val_loss)


def test_without_validation_there_is_no_best_epoch():
    trained = run(job(validate=()))
    assert trained.artifact["best"] is None
    assert trained.artifact["best_epoch"] is None
    assert "val_loss" not in trained.history


@pytest.mark.parametrize("which", ["last", "best"])
@pytest.mark.parametrize("centring", ["per_device", "global"])
@pytest.mark.parametrize("imus", [((1,), (2,)), ((2, 1),)])
def test_a_stored_network_estimates_its_outputs_scaled_back(tmp_path, imus, centring, which):
    rates, bias = recorded()
    over_fitting = {"train": range(1, 5), "epochs": 40, "learning_rate": 3e-2, "decay_every": 40}
    a_job = job((rates, bias), imus, centring=centring, **over_fitting)
    torch.save(run(a_job).artifact, tmp_path / "weights.pt")
    stored = torch.load(tmp_path / "weights.pt", weights_only=True)
    assert stored["best_epoch"] < 40
    windows = windows_of(rates, imus[0], 11)
    estimates = StoredNetwork(stored, which).biases(windows)

    _, scaling = training_examples(a_job.devices, a_job.architecture, centring)
    network = initial_network(a_job.architecture, seed=99)
    network.load_state_dict(stored[which])
    centre = scaling.centres[0]
    scaled = torch.from_numpy((windows - centre[:, None]) / scaling.input_scale)
    with torch.no_grad():
        outputs = network.double()(scaled).numpy()
    expected = centre + scaling.target_scale * outputs
    assert estimates.shape == (2, 3 * len(imus[0]))
    assert np.abs(expected - centre).max() > 100 * 2e-5 * scaling.target_scale
    np.testing.assert_allclose(estimates, expected, atol=2e-5 * scaling.target_scale)


@pytest.mark.parametrize("imus", [((1,), (2,)), ((1, 2),)])
def test_a_network_learns_what_is_easy_to_learn(imus):
    """Windows that tell the bias well: far better than the training mean, which knows nothing."""
    rates, bias = recorded(recordings=110, spread=1.0, noise=0.3)
    easy = {"channels": 16, "hidden": 32, "epochs": 60, "learning_rate": 1e-2, "decay_every": 40}
    a_job = job((rates, bias), imus, train=range(1, 81), validate=(), **easy)
    estimator = StoredNetwork(run(a_job).artifact, "last")
    truth = bias.sel(imu=list(imus[0])).to_numpy()  # (imus, recordings, axes)
    tested = range(81, 111)
    constant = truth[:, :80].mean(axis=1)
    errors = []
    for number in tested:
        estimates = estimator.biases(windows_of(rates, imus[0], number))
        errors.append(estimates - truth[:, number - 1].ravel())
    rmse = np.sqrt(np.mean(np.square(errors)))
    constants_rmse = np.sqrt(np.mean((truth[:, 80:] - constant[:, None]) ** 2))
    assert constants_rmse == pytest.approx(1.0, rel=0.3)
    assert rmse < 0.25 * constants_rmse


def test_the_estimated_work_is_what_is_reported():
    a_job = job()
    reported = []
    trained = run_training(a_job, reported.append)
    assert len(reported) == 1 + 6  # the preparation, then epochs
    assert reported[-6:] == [a_job.epoch_work] * len(trained.history)
    assert sum(reported) == pytest.approx(a_job.work)
    assert job(epochs=12).work == a_job.work + 6 * a_job.epoch_work
    assert job(train=range(1, 5)).work < a_job.work


def test_the_network_sees_all_imus_side_by_side():
    assert job(imus=((1, 2),)).architecture == Architecture(6, WINDOW, 4, 6, 5, 2, 8)
    assert job(imus=((1,), (2,))).architecture == Architecture(3, WINDOW, 4, 6, 5, 2, 8)


@pytest.mark.parametrize(("window", "kernel"), [(8, 6), (8, 5), (3, 6), (3, 5)])
def test_a_window_too_short_for_the_network_is_refused(window, kernel):
    with pytest.raises(InputError, match=f"window of {window} samples is too short"):
        run(replace(job(kernel=kernel), window=window))
