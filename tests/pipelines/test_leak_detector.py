"""The leak study finds what it must: a leak it was given, and none where there is none.

A network trained on shuffled labels can only learn the mean of the training labels. If it is
better than that constant on test recordings, information about them has reached it.
"""

from dataclasses import replace

import numpy as np
import pytest

from gyro_pipeline.conventions import BEST_EPOCH_ON_TEST, K_FOLD, TEST_IN_TRAINING, WINDOW_SPLIT
from gyro_pipeline.datasets.array_logs import ArrayLogs
from gyro_pipeline.pipelines.reporting.exhibits import LEAK_VARIANTS
from gyro_pipeline.pipelines.reporting.leakage import pool_leakage
from gyro_pipeline.studies import CNN, CNN_SHUFFLED

pytestmark = pytest.mark.slow
SPREAD = 5e-3


@pytest.fixture(scope="module")
def leak_study(make_world, make_study, parameters, as_stored):
    """The rows of the leak study's table, by protocol and estimator."""

    def run(recordings, leaks=(), **settings):
        base = parameters("base").training
        study = make_study("leakage", ["training_mean", CNN, CNN_SHUFFLED])
        ways = {"protocol": K_FOLD, "also": {leak: [CNN] for leak in leaks}}
        count = {"recordings": recordings.sizes["recording"], "folds": 5, "strides_s": [10.0]}
        world = make_world(
            recordings,
            study=study.model_copy(update=ways | count),
            training=base.model_copy(update={"epochs": 60, "learning_rate": 2e-3} | settings),
        )
        runs = as_stored(world.train())
        made = {run.run_id: run.artifacts for run in world.evaluate(runs)}
        judged = [replace(run, load=made[run.run_id].__getitem__, finished=True) for run in runs]
        stored = {"sparkfun_plan": world.plan, "sparkfun_runs": judged}
        given = study, world.training, {"sparkfun": {"rate_hz": 25}}
        return pool_leakage(*given, **stored)["results"].set_index(["leak", "estimator"])

    return run


@pytest.fixture(scope="module")
def simulated(make_recordings, leak_study):
    """The turn-on spread is large against the noise, so that a window tells the bias."""
    bias = np.random.default_rng(2).normal(0, SPREAD, (1, 30, 3))
    recordings = make_recordings(bias, samples=1300, rate_hz=25.0, noise_dps_rts=3e-3)
    drawn = {
        "true_bias": (("imu", "recording", "axis"), bias),
        "true_unit_bias": (("imu", "axis"), np.zeros((1, 3))),
        "true_turn_on_spread": ("axis", np.full(3, SPREAD)),
        "true_noise": ("axis", np.full(3, 3e-3)),
    }
    recordings = recordings.assign(drawn).assign_attrs(simulated=1)
    leaks = (WINDOW_SPLIT, TEST_IN_TRAINING, BEST_EPOCH_ON_TEST)
    return leak_study(recordings, leaks, channels=16, stride=5, pool=4, hidden=64)


def test_shuffled_labels_are_no_better_than_the_constant_and_a_networks_own_are(simulated):
    """The detector has the power to tell: what it must not find, it finds here."""
    assert simulated.over_constant_dps2_hi[K_FOLD, CNN_SHUFFLED] > 0
    assert simulated.over_constant_dps2_hi[K_FOLD, CNN] < 0
    assert simulated.over_constant_dps2[K_FOLD, CNN] < -0.5 * SPREAD**2


def test_leaks_look_better_than_a_split_by_recording_and_the_oracle_finds_the_largest(simulated):
    assert set(simulated.index) == set(LEAK_VARIANTS)
    assert set(simulated.windows) == {30 * 5}
    gains = simulated.accuracy_gain_pct
    # the same networks, each at the epoch at which it is best in the windows that judge it
    assert gains[BEST_EPOCH_ON_TEST, CNN] > gains[K_FOLD, CNN]
    assert gains[TEST_IN_TRAINING, CNN] > 0 > gains[K_FOLD, CNN]
    assert simulated.beats_oracle_p[TEST_IN_TRAINING, CNN] < 1e-3
    assert simulated.beats_oracle_p[K_FOLD].min() > 1e-3


def test_on_the_real_file_shuffled_labels_are_no_better_than_the_constant(
    parameters, read_logs, tmp_path, leak_study, real_file
):
    p, file = parameters("base"), real_file("memsense_test_real.npy")
    sensors = {name: one.model_dump() for name, one in p.sensors.items()}
    given = "memsense", sensors, "published", str(file.parent), {"all": file.name}
    logs = ArrayLogs(*given).load()
    recordings, _ = read_logs(logs, p.quality, tmp_path)
    recordings = recordings.assign_attrs(sensor="sparkfun")  # whose grid the study has
    found = leak_study(recordings)
    assert found.over_constant_dps2_hi[K_FOLD, CNN_SHUFFLED] > 0
