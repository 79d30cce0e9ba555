"""No honest network beats the oracle on white noise, and one with a leak is found out."""

from dataclasses import replace
from itertools import product

import numpy as np
import pandas as pd
import pytest
import xarray as xr

from gyro_pipeline.conventions import (
    ALL,
    AXES,
    BEST,
    DIMENSIONS,
    DISJOINT,
    FIRST,
    HOLD_OUT,
    LAST,
    PAPER,
    TEST,
    TRAIN,
    TRUE,
    VALIDATION,
)
from gyro_pipeline.learning.jobs import NetworkEstimator, run_training
from gyro_pipeline.parameters import VirtualGyros
from gyro_pipeline.physics.ceiling import running_mean_rmse
from gyro_pipeline.physics.noise import simulate_noise
from gyro_pipeline.pipelines.evaluation import bench as bench_module
from gyro_pipeline.pipelines.evaluation.bench import Bench
from gyro_pipeline.pipelines.training.nodes import Devices
from gyro_pipeline.protocol.scores import beats_oracle, holm, squared_errors
from gyro_pipeline.studies import CNN, Cell

NOISE, SPREAD, RECORDING_S = 3.3e-3, 0.31e-3, 87.0  # SparkFun's
SAMPLES = 1300  # a tenth of its rate: what matters is N, not sigma
TRAINING, VALIDATING, TESTING = 72, 8, 400
ONE_SIDED = 0.001
VIEWS = list(product((PAPER, DISJOINT, TRUE), (FIRST, ALL)))


@pytest.fixture(scope="module")
def recordings():
    """Two IMUs; all recordings after the first 80 test."""
    generator = np.random.default_rng(11)
    numbers = TRAINING + VALIDATING + TESTING
    unit = generator.uniform(-0.5, 0.5, (2, 3))
    bias = unit[:, None] + generator.normal(0, SPREAD, (2, numbers, 3))
    rates = simulate_noise(generator, (2, numbers, 3, SAMPLES), SAMPLES / RECORDING_S, NOISE)
    rates += bias[..., None].astype(np.float32)
    return xr.Dataset(
        {
            "angular_rate": (DIMENSIONS, rates),
            "samples": (DIMENSIONS[:2], np.full((2, numbers), SAMPLES)),
            "true_bias": (DIMENSIONS[:-1], bias),
            "true_unit_bias": (("imu", "axis"), unit),
        },
        coords={"imu": [1, 2], "recording": np.arange(1, 1 + numbers), "axis": list(AXES)},
        attrs={"sensor": "sparkfun", "simulated": 1, "rate_hz": SAMPLES / RECORDING_S},
    )


def roles_of(training, validating, testing):
    numbers = [training, validating, testing]
    roles = np.repeat([TRAIN, VALIDATION, TEST], [len(part) for part in numbers])
    return pd.DataFrame({"fold": HOLD_OUT, "recording": np.concatenate(numbers), "role": roles})


NUMBERS = np.arange(1, 1 + TRAINING + VALIDATING + TESTING)
HONEST = roles_of(*np.split(NUMBERS, [TRAINING, TRAINING + VALIDATING]))
LEAKY = roles_of(NUMBERS[TRAINING + VALIDATING :], NUMBERS[1:VALIDATING], NUMBERS[:1])


@pytest.fixture(scope="module")
def benches(recordings, parameters):
    device = bench_module.TestDevice(  # by its module: pytest takes the name for a test's
        noise=np.full((1, 3), NOISE),
        spread=np.full((1, 3), SPREAD),
        unit_bias=recordings.true_unit_bias.sel(imu=1).to_numpy(),
    )
    tested = tuple(NUMBERS[TRAINING + VALIDATING :].tolist())
    evaluation = parameters().evaluation
    return {s: Bench(recordings, device, tested, s, evaluation) for s in (10.0, 30.0)}


@pytest.fixture(scope="module")
def make_network(recordings, parameters):
    """Trains by the pipeline's own code; fewer epochs at a higher rate than the paper's 1200."""
    base = parameters("base").training.model_copy(update={"epochs": 40, "learning_rate": 1e-3})
    bias = recordings.angular_rate.mean("sample", dtype=np.float64)
    none = VirtualGyros(imus=1, recordings=1, train_recordings=1, turn_on_jitter_mdps=0, seed=0)

    def make(window_s, real_gyros, seed, roles=HONEST, **settings):
        cell = Cell("", 2, "sparkfun", "", real_gyros, 0, window_s, seed, HOLD_OUT, CNN)
        devices = Devices(recordings, bias, roles, None, none)
        job = devices.job("", cell, base.model_copy(update=settings))
        return run_training(job, lambda work: None)

    return make


def against_the_oracle(bench, trained):
    """One p value for each truth, choice of windows, and weights."""
    p_values = []
    for which in (LAST, BEST):
        errors = bench.errors(NetworkEstimator(trained.artifact, which))
        for view in VIEWS:
            oracle = squared_errors(bench.oracle_errors, *view)
            p_values.append(beats_oracle(squared_errors(errors, *view), oracle))
    return p_values


@pytest.fixture(scope="module")
def networks(make_network):
    """Networks that have seen no test recording, by window, gyroscopes, seed and centring."""
    cells = [
        (10.0, 3, 0, "per_device"),
        (10.0, 3, 1, "per_device"),
        (10.0, 6, 0, "global"),
        (30.0, 6, 1, "per_device"),
        (30.0, 3, 0, "global"),
    ]
    return {cell: make_network(*cell[:3], centring=cell[3]) for cell in cells}


@pytest.fixture(scope="module")
def honest(benches, networks):
    """Their p values."""
    judged = [against_the_oracle(benches[cell[0]], one) for cell, one in networks.items()]
    return np.concatenate(judged)


def test_no_honest_network_beats_the_oracle(honest):
    assert len(honest) == 5 * 2 * len(VIEWS)
    assert holm(honest).min() > ONE_SIDED


LARGE = {"channels": 16, "pool": 2, "hidden": 64, "epochs": 100}
"""Enough to learn the windows of the training recordings by heart."""


def test_a_leak_is_found_out(benches, make_network, honest):
    leaky = make_network(30.0, 3, 0, roles=LEAKY, **LARGE)
    corrected = holm([*honest, *against_the_oracle(benches[30.0], leaky)])
    assert corrected[len(honest) :].min() < ONE_SIDED
    assert corrected[: len(honest)].min() > ONE_SIDED


def test_the_same_network_without_the_leak_is_not(benches, make_network):
    p_values = against_the_oracle(benches[30.0], make_network(30.0, 3, 0, **LARGE))
    assert holm(p_values).min() > ONE_SIDED


def test_the_oracle_does_not_beat_itself(benches):
    for bench in benches.values():
        for view in VIEWS:
            oracle = squared_errors(bench.oracle_errors, *view)
            assert beats_oracle(oracle, oracle) == 1


def test_the_check_sees_a_tenth_of_a_gain(benches):
    """It has the power to: errors a tenth smaller than the oracle's are a defect."""
    oracle = squared_errors(benches[10.0].oracle_errors, PAPER, ALL)
    better = replace(oracle, sums=oracle.sums * 0.9**2)
    assert beats_oracle(better, oracle) < 1e-9


@pytest.mark.parametrize("truth", [PAPER, DISJOINT, TRUE])
@pytest.mark.parametrize("window_s", [10.0, 30.0])
def test_the_running_mean_has_the_rmse_of_the_closed_form(benches, window_s, truth):
    errors = squared_errors(benches[window_s].mean_errors, truth, ALL)
    rmse = np.sqrt(errors.sums.sum() / errors.counts.sum())
    assert rmse == pytest.approx(running_mean_rmse(NOISE, window_s, RECORDING_S, truth), rel=0.04)


@pytest.mark.parametrize("truth", [PAPER, DISJOINT, TRUE])
@pytest.mark.parametrize("window_s", [10.0, 30.0])
def test_the_oracle_has_the_rmse_of_the_ceiling(benches, window_s, truth):
    bench = benches[window_s]
    errors = squared_errors(bench.oracle_errors, truth, ALL)
    rmse = np.sqrt(errors.sums.sum() / errors.counts.sum())
    assert rmse == pytest.approx(bench.ceilings(truth, ALL)["ceiling_rmse_dps"].value, rel=0.06)


def test_a_network_with_its_own_centre_comes_near_the_ceiling(benches, networks):
    bench, network = benches[10.0], networks[10.0, 3, 0, "per_device"]
    errors = bench.errors(NetworkEstimator(network.artifact, BEST))
    near = squared_errors(errors, PAPER, ALL)
    ceiling = bench.ceilings(PAPER, ALL)["ceiling_rmse_dps"].value
    assert 0.95 < np.sqrt(near.sums.sum() / near.counts.sum()) / ceiling < 1.25
