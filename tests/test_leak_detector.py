"""A network trained on shuffled labels is no better than the constant, on simulated and real data.

It can only learn the mean of the training labels. If it is better on test recordings, information
about them has reached it some other way.
"""

import os
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from gyro_pipeline.conventions import LAST, TEST, TRAIN
from gyro_pipeline.datasets.array_logs import ArrayLogs
from gyro_pipeline.learning.jobs import NetworkEstimator, run_training
from gyro_pipeline.parameters import VirtualGyros
from gyro_pipeline.pipelines.training.nodes import Devices
from gyro_pipeline.protocol.leaks import strided_errors
from gyro_pipeline.protocol.scores import paired_difference, resampled_weights
from gyro_pipeline.protocol.splits import assign_roles, with_role
from gyro_pipeline.protocol.windows import cut_windows
from gyro_pipeline.studies import CNN, CNN_SHUFFLED, Cell

REAL_FILE = "memsense_test_real.npy"
WINDOW_S = 10.0
NO_VIRTUAL = VirtualGyros(imus=1, recordings=1, train_recordings=1, turn_on_jitter_mdps=0, seed=0)


@pytest.fixture(scope="module")
def against_the_constant(parameters):
    """Mean square over the constant's on test recordings of all folds, with a 99 % interval."""
    base = parameters("base")
    training = base.training.model_copy(update={"epochs": 150, "learning_rate": 1e-3})
    splits = base.splits.model_copy(update={"leave_one_out_up_to": 0})

    def judge(recordings, estimator):
        numbers = recordings.recording.to_numpy().tolist()
        roles = assign_roles(numbers, splits)
        bias = recordings.angular_rate.mean("sample", dtype=np.float64)
        devices = Devices(recordings, bias, roles, None, NO_VIRTUAL)
        tables = []
        for fold in sorted(roles.fold.unique()):
            cell = Cell("", 2, "", "", 3, 0, WINDOW_S, 0, fold, estimator)
            job = devices.job("", cell, training)
            network = NetworkEstimator(run_training(job, lambda work: None).artifact, LAST)
            constant = bias.sel(imu=1, recording=with_role(roles, fold, TRAIN)).mean("recording")
            for number in with_role(roles, fold, TEST):
                windows = cut_windows(
                    recordings.angular_rate.sel(imu=1, recording=number).to_numpy(), job.window
                )
                truth = bias.sel(imu=1, recording=number).to_numpy()
                errors = network.estimate(windows.transpose(1, 0, 2))[0] - truth
                of = {"recording": number, "error_dps": errors.ravel()}
                constants = np.tile(constant.to_numpy() - truth, len(errors))
                tables.append(pd.DataFrame(of | {"constant_error_dps": constants}))
        errors = pd.concat(tables)
        weights = resampled_weights(len(numbers), 2000, seed=1)
        return paired_difference(
            strided_errors(errors), strided_errors(errors, "constant"), weights, 99
        )

    return judge


@pytest.fixture(scope="module")
def informative(make_recordings):
    """The turn-on spread is large against the noise, so that a window tells the bias."""
    bias = np.random.default_rng(2).normal(0, 5e-3, (1, 30, 3))
    return make_recordings(bias, samples=1300, rate_hz=25.0, noise_dps_rts=3e-3)


@pytest.fixture(scope="module")
def real(parameters, read_logs, tmp_path_factory):
    folder = os.environ.get("GYRO_PIPELINE_REAL_DATA")
    if not folder or not Path(folder, REAL_FILE).is_file():
        pytest.skip(f"GYRO_PIPELINE_REAL_DATA names no folder with {REAL_FILE}")
    p = parameters("base")
    sensors = {name: one.model_dump() for name, one in p.sensors.items()}
    logs = ArrayLogs("memsense", sensors, "published", folder, {"all": REAL_FILE}).load()
    return read_logs(logs, p.quality, tmp_path_factory.mktemp("recordings"))[0]


def test_on_simulated_data_shuffled_labels_are_no_better_than_the_constant(
    against_the_constant, informative
):
    assert against_the_constant(informative, CNN_SHUFFLED).hi > 0


def test_the_same_network_with_its_own_labels_is_seen_to_be_better(
    against_the_constant, informative
):
    """The detector has the power to tell: what it must not find, it finds here."""
    difference = against_the_constant(informative, CNN)
    assert difference.hi < 0
    assert difference.value < -0.5 * 5e-3**2


def test_on_the_real_file_shuffled_labels_are_no_better_than_the_constant(
    against_the_constant, real
):
    assert against_the_constant(real, CNN_SHUFFLED).hi > 0
