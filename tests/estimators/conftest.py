"""Simulated recordings of one or more IMUs, and what an estimator makes of their windows."""

import numpy as np
import pandas as pd
import pytest
import torch
import xarray as xr
from threadpoolctl import threadpool_limits

from gyro_pipeline.conventions import AXES, DIMENSIONS, ORIGIN_REAL, RECORDING_MEAN, TRAIN
from gyro_pipeline.estimators.training_set import TrainingSet
from gyro_pipeline.physics.bias import windows_at
from gyro_pipeline.physics.noise import simulate_noise, warm_up


def labelled(rates, rate_hz):
    """(imu, recording, axis, sample) in the layout of the conventions."""
    imus, count, _, samples = rates.shape
    coords = {"imu": range(1, 1 + imus), "recording": range(1, 1 + count), "axis": list(AXES)}
    attrs = {"sensor": "test", "source": "test", "simulated": 0, "rate_hz": rate_hz}
    lengths = np.full((imus, count), samples)
    data = {"angular_rate": (DIMENSIONS, rates), "samples": (DIMENSIONS[:2], lengths)}
    return xr.Dataset(data, coords, attrs)


@pytest.fixture(autouse=True, scope="module")
def one_thread():
    """More only get in each other's way on tensors so small; a training changes both settings."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    with threadpool_limits(1):
        yield
    torch.set_num_threads(threads)
    torch.use_deterministic_algorithms(False)


@pytest.fixture(scope="session")
def simulate():
    """Recordings and their biases from a :class:`RecordingModel`, the same for all axes."""

    def make(model, count, seed=0, imus=1, unit_bias=0.5):
        generator, noise = np.random.default_rng(seed), model.noise
        shape = (imus, count, len(AXES))
        given = (*shape, model.samples), model.rate_hz, noise.white
        colour = {"flicker_dps": noise.instability, "random_walk_dps_rts": noise.random_walk}
        rates = simulate_noise(generator, *given, **colour).astype(np.float64)
        drawn = generator.multivariate_normal(model.mean, model.covariance, shape)
        unit = generator.uniform(-unit_bias, unit_bias, (imus, 1, len(AXES)))
        bias = unit + drawn[..., 0]
        rates += bias[..., None]
        if model.mean.size > 1:
            rates += warm_up(drawn[..., 1], model.time_constant_s, model.samples, model.rate_hz)
        recordings = labelled(rates.astype(np.float32), model.rate_hz)
        recordings["true_bias"] = (DIMENSIONS[:-1], bias)
        recordings["true_unit_bias"] = (("imu", "axis"), unit[:, 0])
        return recordings

    return make


def windows_table(recordings, size, roles=None):
    """All non-overlapping windows of the recordings that are there, in no order."""
    there = recordings["samples"].to_numpy() > 0
    imus, numbers = (recordings[name].to_numpy() for name in ("imu", "recording"))
    rows = [
        ((roles or {}).get(numbers[n], TRAIN), ORIGIN_REAL, imus[i], numbers[n], start)
        for i, n in np.argwhere(there)
        for start in range(0, recordings.sizes["sample"] - size + 1, size)
    ]
    columns = ["role", "origin", "imu", "recording", "start"]
    return pd.DataFrame(rows, columns=columns).sample(frac=1, random_state=0)


@pytest.fixture(scope="session")
def training_set():
    """Recordings as a training set, with windows of 10 s or another length."""

    def make(recordings, device=1, window_s=10, roles=None):
        recordings = recordings[["angular_rate", "samples"]]
        means = recordings.angular_rate.mean("sample", dtype=np.float64)
        recordings = recordings.assign(recording_mean=means)
        size = round(window_s * recordings.attrs["rate_hz"])
        windows = windows_table(recordings, size, roles)
        return TrainingSet(recordings, None, windows, size, device)

    return make


@pytest.fixture(scope="session")
def judged():
    """Errors and sigmas of an estimator in all windows of IMU 1."""

    def judge(estimator, recordings, window_s, target=RECORDING_MEAN):
        rate_hz = recordings.attrs["rate_hz"]
        size = round(window_s * rate_hz)
        errors, sigmas = [], []
        for number in recordings.recording.to_numpy():
            one = recordings.sel(imu=1, recording=number)
            samples = one.angular_rate.to_numpy()
            starts = np.arange(0, samples.shape[-1] - size + 1, size)
            windows = windows_at(samples, size, starts).transpose(1, 0, 2)
            bias, sigma = estimator.estimate(windows, target, starts / rate_hz, int(number))
            mean = samples.mean(axis=-1, dtype=np.float64)
            errors.append(bias - (mean if target == RECORDING_MEAN else one.true_bias.to_numpy()))
            sigmas.append(sigma)
        return np.concatenate(errors), np.concatenate(sigmas)

    return judge


@pytest.fixture(scope="session")
def memsense(real_file):
    """The public Memsense recordings."""
    return labelled(np.load(real_file("memsense_test_real.npy"))[None], 250.0)
