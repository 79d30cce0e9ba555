"""Fitting by name: the list of estimators, a stranger's own, and many at once."""

import numpy as np
import pytest
from joblib.externals.loky import get_reusable_executor

from gyro_pipeline.conventions import MDPS, InputError
from gyro_pipeline.estimators import estimator_class
from gyro_pipeline.estimators.fitting import FitJob, run_fits
from gyro_pipeline.parameters import Execution, Training
from gyro_pipeline.physics.allan import NoiseFigures
from gyro_pipeline.physics.recording_model import constant_bias

MODEL = constant_bias(800, 20.0, NoiseFigures(5 * MDPS, 0, 0), 0.0, MDPS)
SETTINGS = Training(
    **{"centring": "per_device", "channels": 4, "kernel": 6, "stride": 5, "pool": 2, "hidden": 8},
    **{"epochs": 3, "batch_size": 8, "learning_rate": 1e-3, "decay": 0.1, "decay_every": 4},
)
STRANGER = """
from gyro_pipeline.estimators.base import Estimator

class Half(Estimator):
    uses = "all"

    def _fit(self, training):
        self.imus = list(training.imus)

    def _estimate(self, windows):
        return windows.samples.mean(axis=-1) / 2, 1.0

class Failing(Estimator):
    def _fit(self, training):
        raise ArithmeticError("the sky fell")

class NoEstimator:
    pass
"""


@pytest.fixture(scope="module")
def recordings(simulate):
    return simulate(MODEL, 6, imus=2)


@pytest.fixture(scope="module")
def stranger(tmp_path_factory):
    folder = tmp_path_factory.mktemp("stranger")
    (folder / "a_strangers_file.py").write_text(STRANGER)
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(folder)
        get_reusable_executor().shutdown()  # workers of other tests do not see this folder
        yield "a_strangers_file:Half"


def jobs_of(training, names, seeds=(0,)):
    return [
        FitJob(f"{name} {seed}", f"run {name}", "hold-out", name, SETTINGS, seed, training)
        for name in names
        for seed in seeds
    ]


def test_a_name_of_no_estimator_is_refused(stranger):
    for name, told in (
        ("kalman", "unknown estimator 'kalman'; expected one of mean, .* package.module:Class"),
        ("not_there:Mine", "No module named 'not_there'; expected package.module:Class"),
        ("a_strangers_file:Other", "has no attribute 'Other'"),
        ("a_strangers_file:NoEstimator", "expected a subclass of .*Estimator or of torch.nn.Mod"),
    ):
        with pytest.raises(InputError, match=told):
            estimator_class(name)


@pytest.mark.slow
@pytest.mark.parametrize("executor", ["serial", "processes"])
def test_a_strangers_estimators_are_fitted_and_one_that_fails_ends_the_run_after_all_others(
    stranger, recordings, training_set, executor, caplog
):
    failing = stranger.replace("Half", "Failing")
    jobs = jobs_of(training_set(recordings), [failing, stranger, "mean"])
    found, fits = {}, run_fits(jobs, Execution(executor=executor, workers=2), "all")
    with pytest.raises(InputError, match=f"run {failing}, hold-out: .*the sky fell.* .1 f"):
        for job, fit in fits:
            found[job.estimator] = fit
    assert "Traceback" in caplog.text  # of a failure that nobody foresaw
    assert sorted(found) == sorted([stranger, "mean"])
    assert found[stranger].estimator.imus == [("real", 1), ("real", 2)]  # what its row names
    windows = recordings.angular_rate.to_numpy()[0, :, :, :200]
    half, whole = (found[name].estimator.estimate(windows)[0] for name in (stranger, "mean"))
    np.testing.assert_allclose(half, whole / 2, atol=1e-6)
    assert all(fit.started <= fit.ended for fit in found.values())


@pytest.mark.slow
def test_networks_are_trained_in_a_batch_and_all_else_in_processes(recordings, training_set):
    jobs = jobs_of(training_set(recordings), ["mean", "cnn", "cnn_shuffled"], seeds=(0, 1))
    batched, alone = (
        {job.key: fit for job, fit in run_fits(jobs, Execution(executor=name, workers=2), "all")}
        for name in ("batched", "serial")
    )
    assert {name: fit.estimator.engine.split()[0] for name, fit in batched.items()} == {
        job.key: "cpu" if job.estimator == "mean" else "batched" for job in jobs
    }
    windows = recordings.angular_rate.to_numpy()[0, :, :, :200]
    for name, fit in batched.items():
        one, other = (f.estimator.estimate(windows)[0] for f in (fit, alone[name]))
        np.testing.assert_allclose(one, other, atol=1e-5 * MDPS + 1e-6)
