"""Leave-one-device-out: every IMU in turn is one that the estimators have never seen."""

import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import xarray as xr

from gyro_pipeline.conventions import ALL, AXES, DIMENSIONS, FIRST, PAPER, TEST, TRAIN, InputError
from gyro_pipeline.estimators import ESTIMATORS, RunningMean
from gyro_pipeline.fingerprints import data_hash
from gyro_pipeline.parameters import Grid, Study
from gyro_pipeline.pipelines.evaluation.bench import Bench
from gyro_pipeline.pipelines.evaluation.device import UNIT_SPREAD, describe_unseen
from gyro_pipeline.pipelines.evaluation.folds import FittedToOthers
from gyro_pipeline.pipelines.evaluation.nodes import evaluate
from gyro_pipeline.pipelines.ground_truth.nodes import measure_allan_variance
from gyro_pipeline.pipelines.windowed_splits.nodes import split_devices
from gyro_pipeline.protocol.scores import resampled_weights, rmse_difference, squared_errors
from gyro_pipeline.protocol.splits import check_devices, leave_one_device_out, refuse_copies
from gyro_pipeline.tracking import CURVE, ERRORS

NAMES = ["mean", "empirical_bayes", "best_linear", "residual_network"]


# who trains and who tests


@pytest.fixture(scope="module")
def splits(parameters):
    return parameters("base").splits


def used(roles, unseen, role):
    chosen = roles[(roles.fold == unseen) & (roles.role == role)]
    return list(zip(chosen.imu.tolist(), chosen.recording.tolist(), strict=True))


def test_on_a_hold_out_no_recording_made_with_a_test_recording_trains(splits):
    roles = leave_one_device_out({imu: range(1, 101) for imu in (1, 2, 3)}, splits)
    assert roles.fold.unique().tolist() == [1, 2, 3]
    assert used(roles, 2, TEST) == [(2, number) for number in range(81, 101)]
    assert used(roles, 2, TRAIN) == [(imu, n) for imu in (1, 3) for n in range(1, 81)]


def test_a_given_split_wins(splits):
    given = {1: TRAIN, 2: TEST, 3: TRAIN}
    roles = leave_one_device_out({1: [1, 2, 3], 2: [1, 2]}, splits, given)
    assert used(roles, 1, TEST) == [(1, 2)]
    assert used(roles, 1, TRAIN) == [(2, 1)]
    assert used(roles, 2, TRAIN) == [(1, 1), (1, 3)]


@pytest.mark.parametrize("count", [1, 11])
def test_few_recordings_all_train_or_test(splits, count):
    numbers = list(range(1, 1 + count))
    roles = leave_one_device_out({imu: numbers for imu in range(1, 6)}, splits)
    for unseen in range(1, 6):
        assert used(roles, unseen, TEST) == [(unseen, number) for number in numbers]
        others = [imu for imu in range(1, 6) if imu != unseen]
        assert used(roles, unseen, TRAIN) == [(imu, n) for imu in others for n in numbers]


def test_one_device_has_no_other_to_learn_from(splits):
    with pytest.raises(InputError, match="expected at least 2 IMUs, got 1; bring recordings"):
        leave_one_device_out({1: [1, 2, 3]}, splits)


def test_a_device_without_a_test_recording_only_trains(splits):
    roles = leave_one_device_out({1: [1, 2], 2: [1]}, splits, {1: TRAIN, 2: TEST})
    assert roles.fold.unique().tolist() == [1]
    assert used(roles, 1, TEST) == [(1, 2)]
    assert used(roles, 1, TRAIN) == [(2, 1)]


def test_no_device_with_a_test_recording_is_refused(splits):
    given = {1: TRAIN, 2: TRAIN, 3: TEST}
    with pytest.raises(InputError, match="expected an IMU with a recording to test, got none"):
        leave_one_device_out({1: [1, 2], 2: [1, 2]}, splits, given)


@pytest.mark.parametrize(
    ("imu", "role", "message"),
    [
        (2, TRAIN, "unseen device IMU 2: recordings 7 of IMU 2 have role 'train'"),
        (3, TEST, "unseen device IMU 2: recordings 7 of IMU 3 have role 'test'"),
    ],
)
def test_the_unseen_device_never_trains_and_no_other_tests(splits, imu, role, message):
    roles = leave_one_device_out({imu: [1, 2] for imu in (1, 2, 3)}, splits)
    wrong = pd.DataFrame([(2, imu, 7, role)], columns=roles.columns)
    with pytest.raises(InputError, match=message):
        check_devices(pd.concat([roles, wrong]))


def test_a_copy_of_a_devices_recording_under_another_devices_number_is_refused(splits):
    roles = leave_one_device_out({1: [1], 2: [1]}, splits)
    refuse_copies({(1, 1): "a", (2, 1): "b"}, roles)
    with pytest.raises(InputError, match="fold 1: IMU 2 recording 1 .train. holds the same"):
        refuse_copies({(1, 1): "a", (2, 1): "a"}, roles)


def test_what_an_imu_lacks_neither_trains_nor_tests(make_recordings, splits):
    recordings = make_recordings(np.zeros((3, 2, 3)), samples=4, rate_hz=1, noise_dps_rts=1.0)
    recordings.angular_rate[1, 0], recordings["samples"][1, 0] = np.nan, 0
    roles = split_devices(recordings, splits)
    assert used(roles, 2, TEST) == [(2, 2)]
    assert used(roles, 1, TRAIN) == [(2, 2), (3, 1), (3, 2)]


# how they are judged


def judge(recordings, world, as_stored, names=NAMES, windows_s=(10.0,)):
    """Metrics and artifacts by estimator and window."""
    study = Study(
        experiment="unseen_devices",
        protocol="leave_one_device_out",
        estimators=list(names),
        windows_s=list(windows_s),
        sensors={recordings.attrs["sensor"]: Grid(method=2, real_gyros=[3])},
    )
    allan = measure_allan_variance(recordings)
    small = replace(
        world,
        study=study,
        recordings=recordings,
        roles=split_devices(recordings, world.splits),
        virtual=None,
    )
    runs = [as_stored(run, f"id{i}") for i, run in enumerate(small.train())]
    names_of = {
        run.run_id: (run.params["estimator"], float(run.params["window_s"])) for run in runs
    }
    cells, roles = small.plan(), small.roles
    judged = evaluate(cells, runs, recordings, world.bias, allan, roles, world.evaluation)
    return {names_of[run.run_id]: run for run in judged}


@pytest.fixture(scope="module")
def four(make_recordings):
    """Four IMUs of six recordings, of which the last two of the first IMU are lacking."""
    generator = np.random.default_rng(2)
    bias = generator.uniform(-1, 1, (4, 1, 3)) + generator.normal(0, 1e-3, (4, 6, 3))
    recordings = make_recordings(bias, 1040, 20.0, 3e-3)
    recordings.angular_rate[0, 4:], recordings["samples"][0, 4:] = np.nan, 0
    return recordings


@pytest.fixture(scope="module")
def judged(four, world, as_stored):
    return judge(four, world, as_stored)


def test_each_device_is_judged_by_estimators_fitted_to_the_others(four, judged):
    errors = judged["empirical_bayes", 10.0].artifacts[ERRORS]
    assert errors.groupby("imu").recording.unique().map(len).tolist() == [4, 6, 6, 6]
    samples = four.angular_rate.sel(imu=3, recording=2).to_numpy()
    windows = samples[:, :1000].reshape(3, 5, 200).transpose(1, 0, 2)
    fitted = ESTIMATORS["empirical_bayes"]().fit(four.sel(imu=[1, 2, 4]), imu=3)
    estimates, _ = fitted.estimate(windows, "recording_mean")
    expected = estimates - samples.mean(axis=1, dtype=np.float64)
    own = errors.query("imu == 3 and recording == 2 and truth == 'paper'")
    np.testing.assert_allclose(own.error_dps, expected.ravel(), atol=1e-12)


def test_intervals_are_over_devices(four, judged, world):
    run = judged["empirical_bayes", 10.0]
    mean = judged["mean", 10.0].artifacts[ERRORS]
    own = squared_errors(run.artifacts[ERRORS], PAPER, ALL)
    assert own.counts.tolist() == [60, 90, 90, 90]  # windows and axes of a device
    weights = resampled_weights(4, world.evaluation.resamples, world.evaluation.bootstrap_seed)
    squares = own.mean(weights), squared_errors(mean, PAPER, ALL).mean(weights)
    gains = 100 * (1 - np.sqrt(squares[0] / squares[1]))
    assert run.metrics["accuracy_gain_pct_all"] == pytest.approx(gains[0])
    lo, hi = np.quantile(gains[1:], [0.025, 0.975], method="inverted_cdf")
    assert run.metrics["accuracy_gain_pct_all_lo"] == pytest.approx(lo)
    assert run.metrics["accuracy_gain_pct_all_hi"] == pytest.approx(hi)
    curve = judged["mean", 10.0].artifacts[CURVE]
    assert set(curve.imu) == {1, 2, 3, 4}


def test_on_white_noise_nothing_is_to_be_gained_and_nothing_is(judged):
    for run in judged.values():
        assert run.metrics["accuracy_gain_pct_all"] == pytest.approx(0, abs=0.5)
        assert run.metrics["ceiling_accuracy_gain_pct_all"] == pytest.approx(0, abs=0.5)


def test_the_unseen_device_is_not_among_what_is_learned_from(four, splits, monkeypatch):
    seen = {}

    class Spy(RunningMean):
        def fit(self, recordings, imu=1):
            seen[recordings.imu] = recordings
            return self

    monkeypatch.setitem(ESTIMATORS, "mean", Spy)
    FittedToOthers(four.assign(true_bias=1.0), split_devices(four, splits)).estimator("mean", 1, 0)
    assert list(seen) == [1, 2, 3, 4]
    for imu, training in seen.items():
        others = [one for one in (1, 2, 3, 4) if one != imu]
        assert not training.seen
        assert training.known == training.imus == others
        assert training.recordings.imu.to_numpy().tolist() == others
        assert set(training.recordings.data_vars) == {"angular_rate", "samples"}
        assert training.rates.shape == (18 if imu == 1 else 16, 3, 1040)


def test_what_others_tell_is_the_same_as_without_the_device(four):
    """The shared Allan variances and labels are those of a fit from the beginning."""
    shared = FittedToOthers(four, split_devices_of(four))._training[2]
    alone = ESTIMATORS["empirical_bayes"]().fit(four.sel(imu=[1, 3, 4]), imu=2)
    again = ESTIMATORS["empirical_bayes"]().fit(shared)
    np.testing.assert_allclose(again._noise, alone._noise)
    np.testing.assert_allclose(again._prior, alone._prior)


def split_devices_of(recordings):
    imus = recordings.imu.to_numpy().tolist()
    rows = [(u, i, n, TEST if u == i else TRAIN) for u in imus for i in imus for n in range(1, 7)]
    return pd.DataFrame(rows, columns=["fold", "imu", "recording", "role"])


def test_of_simulated_devices_the_noise_is_known_and_the_bias_is_not(four):
    drawn = four.isel(recording=slice(0, 4)).assign(
        true_bias=four.angular_rate.mean("sample", dtype=np.float64),
        true_unit_bias=(("imu", "axis"), np.ones((4, 3))),
        true_turn_on_spread=("axis", np.full(3, 1e-3)),
        true_noise=("axis", np.array([3e-3, 4e-3, 5e-3])),
        true_flicker=2e-3,
    )
    places = [(imu, number) for imu in (1, 2, 4) for number in (1, 2)]
    device = describe_unseen(drawn.assign_attrs(simulated=1), None, places, (1, 2, 4))
    np.testing.assert_array_equal(device.noise, np.tile([3e-3, 4e-3, 5e-3], 3)[None])
    assert (device.spread == UNIT_SPREAD).all()
    assert (device.unit_bias == 0).all()
    assert [model.covariance[0, 0] for model in device.models] == 9 * [UNIT_SPREAD**2]
    assert {model.noise.instability for model in device.models} == {2e-3}


def test_the_best_possible_estimate_of_an_unseen_device_knows_each_ones_noise(four, world):
    drawn = four.isel(recording=slice(0, 4)).assign(
        true_bias=four.angular_rate.isel(recording=slice(0, 4)).mean("sample", dtype=np.float64),
        true_unit_bias=(("imu", "axis"), np.ones((4, 3))),
        true_turn_on_spread=("axis", np.full(3, 1e-3)),
        true_noise=("axis", np.full(3, 3e-3)),
        true_flicker=0.0,
    )
    drawn = drawn.assign_attrs(simulated=1)
    imus, numbers = (1, 2, 3, 4), (1, 2, 3, 4)
    device = describe_unseen(drawn, None, [(imu, n) for imu in imus for n in numbers], imus)
    bench = Bench(drawn, device, numbers, 10.0, world.evaluation, imus)
    oracle, mean = bench.oracle_errors, bench.mean_errors
    assert len(oracle) == len(mean) == 4 * 4 * 5 * 3 * 3
    # q is 10^6: the running mean, but for its millionth part towards 0
    np.testing.assert_allclose(oracle.error_dps, mean.error_dps, atol=2e-6)
    assert bench.metrics(mean, "last")["ceiling_accuracy_gain_pct_all"] == pytest.approx(
        0, abs=1e-3
    )


def test_an_estimator_that_cannot_be_fitted_says_without_whom(four, splits):
    few = four.isel(imu=slice(1, 3), recording=slice(0, 2))
    fitted = FittedToOthers(few, split_devices(few, splits))
    message = "sparkfun without IMU 2: best_linear cannot be fitted: .* bring more recordings"
    with pytest.raises(InputError, match=message):
        fitted.estimator("best_linear", 1, 0)


# real devices


@pytest.fixture(scope="module")
def dots():
    """The public DOT recordings, one of each of five devices, without their first row of zeros."""
    folder = os.environ.get("GYRO_PIPELINE_REAL_DATA")
    if folder is None:
        pytest.skip("GYRO_PIPELINE_REAL_DATA, the folder of the real recordings, is not set")
    names = [f"w_{axis}" for axis in AXES]
    rates = [
        pd.read_csv(Path(folder) / f"dot_x_stat_{imu}.csv", skipinitialspace=True)[names]
        .iloc[1:13_000]
        .to_numpy(np.float32)
        .T[None]
        for imu in range(1, 6)
    ]
    rates = np.stack(rates)
    assert rates.shape == (5, 1, 3, 12_999)
    assert np.isfinite(rates).all()
    labels = {"imu": np.arange(1, 6), "recording": [1], "axis": list(AXES)}
    attrs = {"sensor": "dot", "source": "files", "simulated": 0, "rate_hz": 120.0}
    attrs["data_hash"] = data_hash(rates, [])
    lengths = np.full(rates.shape[:2], rates.shape[-1])
    data = {"angular_rate": (DIMENSIONS, rates), "samples": (DIMENSIONS[:2], lengths)}
    return xr.Dataset(data, labels, attrs)


def test_on_real_unseen_devices_the_recommended_ones_are_no_worse_than_the_mean(
    dots, world, as_stored
):
    """And none claims a gain: no interval of a recommended one lies below the mean."""
    judged = judge(dots, world, as_stored, windows_s=[10.0, 30.0])
    mean = {window_s: judged["mean", window_s].artifacts[ERRORS] for window_s in (10.0, 30.0)}
    reference = squared_errors(mean[10.0], PAPER, ALL)
    # coloured noise: 1.6 mdps if it were white
    assert np.sqrt(reference.sums.sum() / reference.counts.sum()) == pytest.approx(3.4e-3, rel=0.1)
    weights = resampled_weights(5, 2000, seed=1)
    for name in NAMES[1:]:
        own = squared_errors(judged[name, 10.0].artifacts[ERRORS], PAPER, ALL)
        ratio = np.sqrt(own.sums.sum() / reference.sums.sum())
        assert 0.97 < ratio <= 1.02, name
        assert rmse_difference(own, reference, weights).hi >= 0, name
        first = squared_errors(judged[name, 30.0].artifacts[ERRORS], PAPER, FIRST)
        at_30_s = squared_errors(mean[30.0], PAPER, FIRST)
        assert np.sqrt(first.sums.sum() / at_30_s.sums.sum()) <= 1.05, name
