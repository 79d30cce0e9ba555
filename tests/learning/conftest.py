"""Recordings and schedules small enough to train on in a second."""

import numpy as np
import pytest
import torch
import xarray as xr

from gyro_pipeline.learning.examples import NetworkInput
from gyro_pipeline.parameters import Training


@pytest.fixture(autouse=True)
def one_thread():
    """More only get in each other's way on tensors so small; a training changes both settings."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)
    torch.use_deterministic_algorithms(False)


@pytest.fixture(scope="session")
def schedule():
    """Settings of training: ``schedule(epochs=3)``."""
    given = {
        **{"channels": 4, "kernel": 6, "stride": 5, "pool": 2, "hidden": 8},
        **{"epochs": 5, "batch_size": 16, "learning_rate": 1e-3, "decay": 0.1, "decay_every": 2},
    }
    return lambda **changes: Training(**{"centring": "per_device", **given, **changes})


@pytest.fixture(scope="session")
def recorded():
    """Rates (imu, recording, axis, sample) and biases: units far apart, turn-ons by ``spread``."""

    def made(imus=2, recordings=12, samples=83, spread=1.0, noise=0.3, seed=0):
        generator = np.random.default_rng(seed)
        units = 5 * generator.normal(size=(imus, 1, 3))
        bias = units + spread * generator.normal(size=(imus, recordings, 3))
        rates = bias[..., None] + noise * generator.normal(size=(*bias.shape, samples))
        numbers = np.arange(1, recordings + 1)
        coords = {"imu": np.arange(1, imus + 1), "recording": numbers, "axis": list("xyz")}
        dims = ("imu", "recording", "axis", "sample")
        labels = xr.DataArray(bias, dims=dims[:-1], coords=coords)
        return xr.DataArray(rates.astype(np.float32), dims=dims, coords=coords), labels

    return made


@pytest.fixture(scope="session")
def device():
    """Recordings of IMUs side by side, with all windows that do not overlap or with some."""

    def made(rates, labels, imus, numbers, size, starts=None):
        biases = labels.sel(imu=list(imus), recording=list(numbers))
        biases = biases.transpose("recording", "imu", "axis").to_numpy().reshape(len(numbers), -1)
        every = np.arange(0, rates.sizes["sample"] - size + 1, size)
        return NetworkInput(rates, imus, tuple(numbers), biases, starts or (every,) * len(numbers))

    return made
