"""Fitting by name: the list of estimators, a stranger's own, and many at once."""

import subprocess
import sys

import numpy as np
import pytest
from joblib.externals.loky import get_reusable_executor

from gyro_pipeline.conventions import MDPS, OWN, InputError
from gyro_pipeline.estimators import ESTIMATORS, estimator_class, fitting, make_estimator
from gyro_pipeline.estimators.base import Estimator
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


@pytest.fixture
def stranger(tmp_path, monkeypatch):
    (tmp_path / "a_strangers_file.py").write_text(STRANGER)
    monkeypatch.syspath_prepend(tmp_path)
    get_reusable_executor().shutdown()  # workers of other tests do not see this folder
    return "a_strangers_file:Half"


def execution(executor):
    return Execution(executor=executor, workers=2)


def jobs_of(training, names, seeds=(0,)):
    return [
        FitJob(f"{name} {seed}", f"run {name}", "hold-out", name, SETTINGS, seed, training)
        for name in names
        for seed in seeds
    ]


def test_the_list_is_there_without_what_it_names():
    heavy = "import sys, gyro_pipeline.estimators as e; assert e.ESTIMATORS; print(*sys.modules)"
    done = subprocess.run([sys.executable, "-c", heavy], capture_output=True, text=True, check=True)
    assert not {"torch", "scipy", "xarray", "pandas"} & set(done.stdout.split())


@pytest.mark.parametrize(
    ("name", "told"),
    [
        ("kalman", "unknown estimator 'kalman'; expected one of mean, .* package.module:Class"),
        ("not_there:Mine", "No module named 'not_there'; expected package.module:Class"),
        ("a_strangers_file:Other", "has no attribute 'Other'"),
        (
            "a_strangers_file:NoEstimator",
            "expected a subclass of .*Estimator or of torch.nn.Module",
        ),
    ],
)
def test_a_name_of_no_estimator_is_refused(stranger, name, told):
    with pytest.raises(InputError, match=told):
        estimator_class(name)


@pytest.mark.parametrize("executor", ["serial", "processes"])
def test_a_strangers_estimator_is_fitted_to_what_its_row_names(
    stranger, recordings, training_set, executor
):
    training = training_set(recordings)
    jobs = jobs_of(training, [stranger, "mean"])
    fits = {job.estimator: fit for job, fit in run_fits(jobs, execution(executor), "all")}
    assert fits[stranger].estimator.imus == [("real", 1), ("real", 2)]
    windows = recordings.angular_rate.to_numpy()[0, :, :, :200]
    half, _ = fits[stranger].estimator.estimate(windows)
    whole, _ = fits["mean"].estimator.estimate(windows)
    np.testing.assert_allclose(half, whole / 2, atol=1e-6)
    assert all(fit.started <= fit.ended for fit in fits.values())


@pytest.mark.parametrize("executor", ["serial", "processes"])
def test_a_fit_that_fails_ends_the_run_in_a_line_after_all_others(
    stranger, recordings, training_set, executor, caplog
):
    failing = stranger.replace("Half", "Failing")
    jobs = jobs_of(training_set(recordings), [failing, "ridge", "mean"])
    fitted, fits = [], run_fits(jobs, execution(executor), "all")
    with pytest.raises(InputError, match=f"run {failing}, hold-out: .*the sky fell.* .1 f"):
        fitted.extend(job.estimator for job, _ in fits)
    assert sorted(fitted) == ["mean", "ridge"]
    assert "Traceback" in caplog.text  # of a failure that nobody foresaw


@pytest.mark.parametrize("name", [name for name in ESTIMATORS if not estimator_class(name).seeded])
def test_a_saved_one_estimates_as_before_and_holds_no_recordings(
    recordings, training_set, tmp_path, name
):
    fitted = make_estimator(name, SETTINGS, 0).fit(training_set(recordings))
    windows = recordings.angular_rate.to_numpy()[0, :, :, :200]
    expected = fitted.estimate(windows)
    fitted.save(tmp_path / "fit")
    np.testing.assert_array_equal(Estimator.load(tmp_path / "fit").estimate(windows), expected)
    size = sum(file.stat().st_size for file in (tmp_path / "fit").iterdir())
    assert size < 0.4 * recordings.angular_rate.sel(imu=1).nbytes


def test_too_few_recordings_are_refused_and_enough_are_not(recordings, training_set):
    name, fewest = "best_linear", 3
    assert estimator_class(name).fewest_recordings == fewest
    enough = training_set(recordings.isel(recording=slice(fewest)))
    make_estimator(name, SETTINGS, 0).fit(enough)
    too_few = training_set(recordings.isel(recording=slice(fewest - 1)))
    told = (
        f"run {name}, hold-out: cannot be fitted: expected at least {fewest} .* got {fewest - 1} "
    )
    with pytest.raises(InputError, match=told):
        list(run_fits(jobs_of(too_few, [name]), execution("serial"), "all"))


def test_networks_are_trained_in_a_batch_and_all_else_in_processes(recordings, training_set):
    jobs = jobs_of(training_set(recordings), ["mean", "cnn", "cnn_shuffled"], seeds=(0, 1))
    batched = {job.key: fit for job, fit in run_fits(jobs, execution("batched"), "all")}
    alone = {job.key: fit for job, fit in run_fits(jobs, execution("serial"), "all")}
    assert {name: fit.engine.split()[0] for name, fit in batched.items()} == {
        job.key: "cpu" if job.estimator == "mean" else "batched" for job in jobs
    }
    windows = recordings.angular_rate.to_numpy()[0, :, :, :200]
    for name, fit in batched.items():
        one, other = (f.estimator.estimate(windows)[0] for f in (fit, alone[name]))
        np.testing.assert_allclose(one, other, atol=1e-5 * MDPS + 1e-6)


def test_jobs_of_the_same_recordings_and_estimator_go_to_one_worker(recordings, training_set):
    short, long = (training_set(recordings, window_s=window_s) for window_s in (5, 10))
    again = type(short)(short.real, None, short.windows[::3], 100, 1)
    jobs = jobs_of(short, ["mean", "ridge", "cnn"], seeds=(0, 1)) + jobs_of(again, ["mean"])
    groups = [[job.name for job in group.jobs] for group in fitting._groups(jobs)]
    assert sorted(map(len, groups)) == [1, 1, 2, 3]
    assert jobs_of(long, ["mean"])[0].training.part(OWN).size == 200
