"""No honest network beats the oracle on white noise, and one with a leak is found out."""

from itertools import product

import numpy as np
import pandas as pd
import pytest

from gyro_pipeline.conventions import (
    ALL,
    BEST,
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
from gyro_pipeline.estimators import make_estimator
from gyro_pipeline.physics.ceiling import running_mean_rmse
from gyro_pipeline.pipelines.evaluation.bench import Bench
from gyro_pipeline.pipelines.evaluation.device import describe_devices
from gyro_pipeline.pipelines.training.nodes import TrainingSets
from gyro_pipeline.scoring.scores import beats_oracle, holm, squared_errors
from gyro_pipeline.studies import CNN, RunSpec

pytestmark = pytest.mark.slow

NOISE, SPREAD, RECORDING_S = 3.3e-3, 0.31e-3, 87.0  # SparkFun's
SAMPLES = 1300  # a tenth of its rate: what matters is N, not sigma
RATE_HZ = SAMPLES / RECORDING_S
ONE_SIDED = 0.001
TRUTHS = (PAPER, DISJOINT, TRUE)
VIEWS = list(product(TRUTHS, (FIRST, ALL)))
HONEST = {TRAIN: range(1, 73), VALIDATION: range(73, 81), TEST: range(81, 481)}
LEAKY = HONEST | {TRAIN: range(81, 481)}


@pytest.fixture(scope="module")
def recordings(make_recordings):
    """Two IMUs with 480 recordings."""
    generator = np.random.default_rng(11)
    unit = generator.uniform(-0.5, 0.5, (2, 3))
    bias = unit[:, None] + generator.normal(0, SPREAD, (2, 480, 3))
    made = make_recordings(bias, SAMPLES, RATE_HZ, NOISE)
    return made.assign(
        recording_mean=made.angular_rate.mean("sample", dtype=np.float64),
        true_bias=(("imu", "recording", "axis"), bias),
        true_unit_bias=(("imu", "axis"), unit),
        true_noise=("axis", np.full(3, NOISE)),
        true_turn_on_spread=("axis", np.full(3, SPREAD)),
    ).assign_attrs(simulated=1)


def table_of(roles, window_s):
    """Windows of both IMUs that learn, and those of the first that test."""
    size = round(window_s * RATE_HZ)
    rows = [
        (role, imu, number, start)
        for role, numbers in roles.items()
        for imu in ((1,) if role == TEST else (1, 2))
        for number in numbers
        for start in range(0, SAMPLES - size + 1, size)
    ]
    table = pd.DataFrame(rows, columns=["role", "imu", "recording", "start"])
    place = {"protocol": "by_recording", "window_s": window_s, "window_stride_s": window_s}
    return table.assign(**place, fold=HOLD_OUT, origin="real")


@pytest.fixture(scope="module")
def benches(recordings, parameters):
    def made(window_s):
        table = table_of(HONEST, window_s)
        device = describe_devices(recordings, None, None, table)
        tests = table[table.role == TEST]
        return Bench(recordings, device, tests, window_s)

    return {window_s: made(window_s) for window_s in (10.0, 30.0)}


@pytest.fixture(scope="module")
def errors_of(recordings, parameters, benches):
    """Errors of a network with the weights of the last and the best epoch."""
    base = parameters("base").training.model_copy(update={"epochs": 40, "learning_rate": 1e-3})

    def judge(window_s, real_gyros, roles=HONEST, **settings):
        place = ("", "sparkfun", "test", "by_recording", CNN, 2)
        spec = RunSpec(*place, real_gyros, 0, window_s, window_s, seed=0)
        training = TrainingSets(table_of(roles, window_s), recordings, None).of(spec)[HOLD_OUT]
        network = make_estimator(CNN, base.model_copy(update=settings), seed=0).fit(training)
        found = {which: {HOLD_OUT: one} for which, one in network.variants().items()}
        return {which: benches[window_s].errors(fits) for which, fits in found.items()}

    return judge


def p_values(bench, errors):
    """One for each truth, choice of windows, and weights."""
    return [
        beats_oracle(squared_errors(one, *view), squared_errors(bench.oracle_errors, *view))
        for one in (errors[LAST], errors[BEST])
        for view in VIEWS
    ]


LARGE = {"channels": 16, "pool": 2, "hidden": 64, "epochs": 100}
"""Enough to learn the windows of the training recordings by heart."""


@pytest.fixture(scope="module")
def plain(errors_of):
    return errors_of(10.0, 3)


def test_no_honest_network_beats_the_oracle_and_one_with_a_leak_is_found_out(
    benches, errors_of, plain
):
    short, long = benches[10.0], benches[30.0]
    honest = [
        *p_values(short, plain),
        *p_values(long, errors_of(30.0, 3, **LARGE)),
    ]
    assert len(honest) == 2 * 2 * len(VIEWS)
    assert holm(honest).min() > ONE_SIDED
    corrected = holm([*honest, *p_values(long, errors_of(30.0, 3, LEAKY, **LARGE))])
    assert corrected[: len(honest)].min() > ONE_SIDED
    assert corrected[len(honest) :].min() < ONE_SIDED


def rmse_of(errors, *view):
    squares = squared_errors(errors, *view)
    return np.sqrt(squares.sums.sum() / squares.counts.sum())


def test_the_mean_has_the_rmse_of_the_closed_form_and_the_oracle_that_of_the_ceiling(benches):
    for (window_s, bench), truth in product(benches.items(), TRUTHS):
        expected = running_mean_rmse(NOISE, window_s, RECORDING_S, truth)
        assert rmse_of(bench.mean_errors, truth, ALL) == pytest.approx(expected, rel=0.04)
        ceiling = bench.ceilings.of(truth, ALL)["ceiling_rmse_dps"].value
        assert rmse_of(bench.oracle_errors, truth, ALL) == pytest.approx(ceiling, rel=0.06)


def test_a_network_with_its_own_centre_comes_near_the_ceiling(benches, plain):
    ceiling = benches[10.0].ceilings.of(PAPER, ALL)["ceiling_rmse_dps"].value
    assert 0.95 < rmse_of(plain[BEST], PAPER, ALL) / ceiling < 1.25
