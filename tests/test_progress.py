"""The time left that is shown, on a simulated clock."""

from types import SimpleNamespace

import numpy as np
import pytest
import xarray as xr

from gyro_pipeline import executors
from gyro_pipeline.executors import _Progress
from gyro_pipeline.learning.examples import Device
from gyro_pipeline.learning.jobs import RECORDING_WORK, TrainingJob


@pytest.fixture
def clock(monkeypatch):
    """Stands still until it is set."""
    simulated = SimpleNamespace(now=100.0)
    monkeypatch.setattr(executors, "time", SimpleNamespace(monotonic=lambda: simulated.now))
    return simulated


def test_time_left_counts_from_the_first_report_and_on_workers_that_run_out_of_jobs(clock):
    progress = _Progress("study", 3, [10.0, 10.0, 10.0], workers=2, what="jobs")
    clock.now += 50  # processes start
    progress.advance_to(0.5, all_at_work=False)
    clock.now += 5
    progress.advance_to(1.0)
    assert progress.seconds_left() is None  # no pace yet
    clock.now += 4
    progress.advance_to(5.0)  # two units of time, 2 s each, of 20: the last job runs alone
    assert progress.seconds_left() == pytest.approx((20 - 2.5) * 2)
    clock.now += 15
    progress.advance_to(20.0)
    assert progress.seconds_left() == pytest.approx(10 * 2)
    clock.now += 10
    progress.advance_to(25.0)
    assert progress.seconds_left() == pytest.approx(5 * 2)


def training_of(window, recordings, settings):
    """A training that is only to be estimated: three gyroscopes, eight recordings to validate."""
    dims = ("imu", "recording", "axis", "sample")
    rates = xr.DataArray(np.broadcast_to(np.float32(0), (1, 1, 3, 13000)), dims=dims)
    starts = np.arange(0, 13000 - window + 1, window)
    train, watch = (
        Device(rates, (1,), tuple(range(count)), np.zeros((count, 3)), (starts,) * count)
        for count in (recordings, 8)
    )
    return TrainingJob("", [train], watch, window, settings, seed=0)


# Window, training recordings, seconds before the first epoch, ms of an epoch: as measured on one
# core for the augmentation study on the SparkFun.
MEASURED = [
    *((1494, 928, 1.63, 19.4), (1494, 712, 1.35, 14.9), (4483, 928, 1.71, 17.1)),
    *((1494, 608, 1.07, 9.7), (4483, 712, 1.44, 8.5), (4483, 608, 1.06, 6.8)),
    *((1494, 392, 0.69, 5.3), (4483, 392, 0.68, 4.2), (1494, 288, 0.51, 4.1)),
    *((4483, 288, 0.51, 3.3), (1494, 72, 0.14, 1.4), (4483, 72, 0.14, 1.2)),
]


@pytest.mark.parametrize(("workers", "epochs"), [(1, 1200), (2, 300)])
def test_time_left_is_right_within_half_after_a_tenth(clock, parameters, workers, epochs):
    settings = parameters("base").training.model_copy(update={"epochs": epochs})
    profile = [
        (training_of(window, recordings, settings), preparation_s, epoch_ms / 1e3)
        for window, recordings, preparation_s, epoch_ms in MEASURED
    ]
    profile.sort(key=lambda one: one[0].work, reverse=True)
    start, reports = clock.now, []
    free = [start + 7.0] * workers  # after so long they have started and imported
    for job, preparation_s, epoch_s in profile:
        worker = free.index(min(free))
        for seconds, count, work in (
            (preparation_s / job.recordings, job.recordings, RECORDING_WORK),
            (epoch_s, epochs, job.epoch_work),
        ):
            reports += [(free[worker] + seconds * (n + 1), worker, work) for n in range(count)]
            free[worker] += seconds * count
    works = [job.work for job, *_ in profile]
    progress = _Progress("study", len(works), works, workers, "jobs")
    reports.sort()
    at_work, done, factors = set(), 0.0, []
    for now in np.arange(start, max(free) - 2.0, executors._POLL_S):  # until two seconds are left
        while reports[0][0] <= now:
            _, worker, work = reports.pop(0)
            at_work.add(worker)
            done += work
        clock.now = now
        progress.advance_to(done, len(at_work) == workers)
        if done > 0.1 * sum(works):
            factors.append(progress.seconds_left() / (max(free) - now))
    assert len(factors) > 50
    assert 1 / 1.5 < min(factors) <= max(factors) < 1.5
