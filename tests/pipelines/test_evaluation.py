"""Every estimator is judged alike, in the windows that the table says, against known limits."""

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
import xarray as xr

from gyro_pipeline.conventions import ALL, BEST, DISJOINT, FIRST, LAST, PAPER, TRUE
from gyro_pipeline.estimators import ORIENTATION_NOTE
from gyro_pipeline.estimators.averages import RunningMean
from gyro_pipeline.estimators.base import Estimator
from gyro_pipeline.physics.allan import NoiseFigures
from gyro_pipeline.physics.noise import simulate_noise, warm_up
from gyro_pipeline.physics.recording_model import constant_bias, mean_squares, outside_noise
from gyro_pipeline.physics.turn_on import joint_draws
from gyro_pipeline.pipelines.evaluation.bench import Bench
from gyro_pipeline.pipelines.evaluation.device import describe_devices
from gyro_pipeline.pipelines.evaluation.nodes import ceiling_warning, evaluate
from gyro_pipeline.pipelines.ground_truth.nodes import measure_allan_variance
from gyro_pipeline.scoring.scores import squared_errors
from gyro_pipeline.studies import CNN, MEAN
from gyro_pipeline.tracking import CURVE, ERRORS, EVALUATED_WITH, FINGERPRINT
from gyro_pipeline.tracking import SCORES as TABLE

WINDOW_S, SIZE, RECORDING_S = 10.0, 200, 52.0
pytestmark = pytest.mark.slow
TESTED = (11, 12, 13, 14)
STARTS = range(0, 801, 200)
SEVERAL = [MEAN, CNN, "best_linear", "empirical_bayes", "ridge_same_time", "last_calibration"]


def table_of(learned, tested, imu=1, fold="hold-out"):
    """A windows table of recordings of one IMU."""
    rows = [(fold, "train", "real", imu, number, start) for number in learned for start in STARTS]
    rows += [(fold, "test", "real", imu, number, start) for number in tested for start in STARTS]
    columns = ["fold", "role", "origin", "imu", "recording", "start"]
    return pd.DataFrame(rows, columns=columns)


@pytest.fixture(scope="module")
def bench_of(world):
    """The bench of a windows table; what was measured of recordings is the small world's."""

    def made(recordings, table, bias=world.bias, allan=world.allan):
        device = describe_devices(recordings, bias, allan, table)
        tests = table[table.role == "test"]
        return Bench(recordings, device, tests, WINDOW_S)

    return made


@pytest.fixture(scope="module")
def bench(world, bench_of):
    return bench_of(world.recordings, table_of(range(1, 11), TESTED))


class Off(Estimator):
    """Knows the mean of the whole recording and is off by a constant."""

    def __init__(self, bench, by):
        self._means = {r.number: r.samples.mean(axis=1, dtype=float) for r in bench.test_recordings}
        self._by = by

    def _estimate(self, windows):
        return self._means[windows.recording] + self._by, np.nan


class Asked(Estimator):
    """Returns a number that tells what it was asked, and which fit it is."""

    def __init__(self, offset):
        self._offset = offset

    def _estimate(self, windows):
        told = {"recording_mean": 1000.0, "bias": 2000.0}[windows.target] + self._offset
        told += windows.start_s + 100 * windows.recording
        return told[:, None], np.abs(windows.samples[:, :, 0])


def scores_of(bench, estimator, weights=LAST):
    """Value of each score by truth, windows and name."""
    folds = dict.fromkeys(bench.tests.fold.unique(), estimator)
    return by_name(bench.scores(bench.errors(folds), weights))


def by_name(scores):
    return scores.set_index(["truth", "windows", "score"]).value.sort_index()


def test_the_windows_of_the_table_are_judged_each_by_the_fit_of_its_fold(world, bench_of):
    rows = [("a", 2, 11, 137), ("a", 1, 11, 0), ("b", 1, 11, 840), ("b", 1, 3, 200)]
    tests = pd.DataFrame(rows, columns=["fold", "imu", "recording", "start"])
    table = pd.concat([table_of((1,), (), fold="a"), tests.assign(role="test", origin="real")])
    errors = bench_of(world.recordings, table).errors({"a": Asked(0.0), "b": Asked(0.5)})
    assert set(errors.truth) == {PAPER, DISJOINT}
    found = errors[["imu", "recording", "start"]].drop_duplicates()
    assert sorted(found.itertuples(index=False, name=None)) == sorted(row[1:] for row in rows)
    offsets = {row[1:]: {"a": 0.0, "b": 0.5}[row[0]] for row in rows}
    for row in errors.itertuples():
        place = {"imu": row.imu, "recording": row.recording, "axis": row.axis}
        samples = world.recordings.angular_rate.sel(place).to_numpy().astype(np.float64)
        inside = slice(row.start, row.start + SIZE)
        truth = {PAPER: samples, DISJOINT: np.delete(samples, inside)}[row.truth].mean()
        told = {PAPER: 1000.0, DISJOINT: 2000.0}[row.truth] + row.start / 20.0
        told += 100 * row.recording + offsets[row.imu, row.recording, row.start]
        assert row.error_dps == pytest.approx(told - truth)
        assert row.sigma_dps == pytest.approx(abs(samples[row.start]))


def test_the_running_means_scores_are_those_computed_by_hand(world, bench):
    samples = world.recordings.angular_rate.sel(imu=1, recording=list(TESTED)).to_numpy()
    samples = samples.astype(np.float64)  # (recording, axis, sample)
    windows = samples[..., : 5 * SIZE].reshape(4, 3, 5, SIZE).mean(axis=-1)
    whole = samples.mean(axis=-1)[..., None]
    squares = (windows - whole) ** 2
    scores = scores_of(bench, RunningMean())
    assert scores[PAPER, ALL, "test_rmse_dps"] == pytest.approx(np.sqrt(squares.mean()))
    assert scores[PAPER, FIRST, "test_rmse_dps"] == pytest.approx(np.sqrt(squares[..., 0].mean()))
    assert scores[PAPER, ALL, "accuracy_gain_pct"] == 0
    rest = (1040 * whole - SIZE * windows) / (1040 - SIZE)
    figures = bench.device.figures
    noise = [outside_noise(one, 1040, 20.0, start, SIZE) for one in figures for start in STARTS]
    white = bench.device.noise**2 / (RECORDING_S - WINDOW_S)
    assert np.mean(noise) == pytest.approx(white.mean(), rel=0.1)
    expected = ((windows - rest) ** 2).mean() - np.mean(noise)
    assert scores[DISJOINT, ALL, "test_mse_dps2"] == pytest.approx(expected)
    # the curve of four recordings is not monotonic: its first crossing would be too early
    assert scores[PAPER, FIRST, "equivalent_time_s"] == pytest.approx(WINDOW_S)
    assert scores[PAPER, FIRST, "time_saving_pct"] == pytest.approx(0)


def test_noise_and_turn_on_spread_are_measured(make_recordings, make_bias):
    noise, spread = 0.004, np.array([0.0, 0.002, 0.006])
    bias = np.random.default_rng(8).normal(0, 1, (1, 60, 3)) * spread + [5, -7, 0.1]
    recordings = make_recordings(bias, 1200, 20.0, noise, seed=9)
    allan = measure_allan_variance(recordings)
    table = table_of(range(1, 61), (1,))
    device = describe_devices(recordings, make_bias(recordings, allan), allan, table)
    assert device.spread.shape == (401, 3)
    np.testing.assert_allclose(device.noise, noise, rtol=0.05)
    np.testing.assert_allclose(device.spread[0, 1:], spread[1:], rtol=0.25)
    assert device.spread[0, 0] < 2e-4  # less than half of N / sqrt(T), which is all there is
    assert device.unit_bias is None
    lo, hi = np.quantile(device.spread[1:, 2], [0.001, 0.999])
    assert lo < spread[2] < hi


def test_only_the_recordings_that_some_fold_learns_from_describe_the_device(world):
    table = table_of(range(2, 11), TESTED)
    wild = world.bias.copy()
    wild.loc[~wild.recording.between(2, 10), "bias_dps"] = 99
    allan = world.allan.copy(deep=True)
    allan.allan_variance[:, [0, 10, 11, 12, 13]] = 99
    known, again = (
        describe_devices(world.recordings, bias, variances, table)
        for bias, variances in ((world.bias, world.allan), (wild, allan))
    )
    np.testing.assert_array_equal(known.noise, again.noise)
    np.testing.assert_array_equal(known.spread, again.spread)


def with_drawn(recordings):
    """Recordings with drawn values, as a simulated source gives them."""
    made = recordings.assign(
        true_bias=recordings.angular_rate.mean("sample", dtype=np.float64) + 1e-4,
        true_unit_bias=(("imu", "axis"), np.array([[1.0, 2, 3], [4, 5, 6]])),
        true_turn_on_spread=("axis", np.array([1e-3, 2e-3, 3e-3])),
        true_noise=("axis", np.array([3e-3, 4e-3, 5e-3])),
        true_flicker=0.0,
    )
    return made.assign_attrs(simulated=1)


def test_ceilings_of_simulated_data_are_the_closed_form(world, bench_of):
    bench = bench_of(with_drawn(world.recordings), table_of((1,), TESTED))
    assert bench.ceilings.basis == "drawn values"
    noise, spread = np.array([3e-3, 4e-3, 5e-3]), np.array([1e-3, 2e-3, 3e-3])
    q, r = spread**2 * WINDOW_S / noise**2, WINDOW_S / RECORDING_S
    mean = noise**2 * (1 / WINDOW_S - 1 / RECORDING_S)
    best = mean * (r + (1 - r) * q / (1 + q))
    rho = np.sqrt(best.mean() / mean.mean())
    ceilings = bench.ceilings.of(PAPER, ALL)
    assert ceilings["ceiling_rmse_dps"].value == pytest.approx(np.sqrt(best.mean()))
    assert ceilings["ceiling_rmse_dps"].lo is None
    assert ceilings["ceiling_accuracy_gain_pct"].value == pytest.approx(100 * (1 - rho))
    saving = 100 * (1 - rho**2) * (1 - r)
    assert ceilings["ceiling_time_saving_pct"].value == pytest.approx(saving)
    posterior = noise**2 / WINDOW_S * q / (1 + q)
    ceiling = bench.ceilings.of(TRUE, ALL)["ceiling_rmse_dps"].value
    assert ceiling == pytest.approx(np.sqrt(posterior.mean()))
    scores = scores_of(bench, Off(bench, 0.0))
    assert scores[TRUE, ALL, "test_rmse_dps"] == pytest.approx(1e-4)
    assert scores[PAPER, ALL, "beats_oracle_p"] < 0.05  # it looks at the whole recording


def coloured(known, count):
    """Recordings with flicker, random walk and warm-up, of the spreads of others."""
    generator, (flicker, walk), warming = np.random.default_rng(4), (3e-3, 1e-3), (20e-3, 5e-3)
    noise, spread = known.true_noise.to_numpy(), known.true_turn_on_spread.to_numpy()
    unit = known.true_unit_bias.sel(imu=[1]).to_numpy()
    bias = unit[:, None] + generator.normal(0, spread, (1, count, 3))
    amplitude, times_s = generator.normal(*warming, bias.shape), np.full(bias.shape, 15.0)
    rates = bias[..., None] + warm_up(amplitude, times_s, int(RECORDING_S * 20), 20.0)
    more = {"flicker_dps": flicker, "random_walk_dps_rts": walk}
    rates += simulate_noise(generator, rates.shape, 20.0, noise, **more)
    places = ("imu", "recording", "axis")
    drawn = {
        "angular_rate": ((*places, "sample"), rates.astype(np.float32)),
        "samples": (places[:2], np.full(rates.shape[:2], rates.shape[-1])),
        **{"true_bias": (places, bias), "true_unit_bias": (("imu", "axis"), unit)},
        **{"true_noise": ("axis", noise), "true_turn_on_spread": ("axis", spread)},
        **{"true_time_constant": (places, times_s), "true_amplitude": (places, amplitude)},
        **{"true_amplitude_mean": warming[0], "true_amplitude_spread": warming[1]},
        **{"true_flicker": flicker, "true_random_walk": walk},
    }
    labels = {"imu": [1], "recording": range(1, 1 + count), "axis": list("xyz")}
    return xr.Dataset(drawn, labels, known.attrs)


def test_the_ceiling_of_coloured_noise_and_warm_up_is_what_the_oracle_reaches(world, bench_of):
    """All recordings test, which is not honest."""
    recordings = coloured(with_drawn(world.recordings), count=100)
    bench = bench_of(recordings, table_of((1,), range(1, 101)))
    assert bench.ceilings.basis == "drawn values"
    every = np.ones((1, 100))
    for truth, windows in [(t, w) for t in (PAPER, DISJOINT, TRUE) for w in (FIRST, ALL)]:
        reached = squared_errors(bench.oracle_errors, truth, windows).mean(every)[0]
        of_mean = squared_errors(bench.mean_errors, truth, windows).mean(every)[0]
        # 300 gyroscope recordings: 8 % of a mean square
        expected = np.ravel(bench.ceilings._expected(truth, windows, SIZE, bench.device.spread**2))
        of_noise = bench.oracle_errors.query("truth == @truth").truth_variance.mean()
        assert expected == pytest.approx((reached, of_mean), rel=0.16, abs=0.16 * of_noise)
        ceilings = bench.ceilings.of(truth, windows)
        if truth == DISJOINT:  # what estimators are asked for is the bias
            assert ceilings == {}
            continue
        assert ceilings["ceiling_rmse_dps"].value == pytest.approx(np.sqrt(reached), rel=0.08)
        gain = ceilings["ceiling_accuracy_gain_pct"].value
        assert gain == pytest.approx(100 * (1 - np.sqrt(reached / of_mean)), abs=4)
    scores = scores_of(bench, RunningMean())[PAPER, ALL]
    assert scores["beats_oracle_p"] > 0.5
    assert 0 < scores["ceiling_time_saving_pct"] < 100
    assert scores_of(bench, Off(bench, 1e-3))[PAPER, ALL, "beats_oracle_p"] < 1e-6


def test_the_ceiling_of_measured_flicker_is_that_of_its_model(make_recordings, make_bias, bench_of):
    """Flicker must not count as turn-on spread as well, or the ceiling is far too low."""
    count, samples, rate_hz, white, flicker = 60, 1200, 20.0, 5e-3, 4e-3
    recordings = make_recordings(np.zeros((1, count, 3)), samples, rate_hz, white)
    shape, generator = (1, count, 3, samples), np.random.default_rng(1)
    drawn = simulate_noise(generator, shape, rate_hz, np.full(3, white), flicker_dps=flicker)
    recordings = recordings.assign(angular_rate=recordings.angular_rate.copy(data=drawn))
    allan = measure_allan_variance(recordings)
    table = table_of(range(1, count + 1), (1, 2))
    bench = bench_of(recordings, table, make_bias(recordings, allan), allan)
    model = constant_bias(samples, rate_hz, NoiseFigures(white, flicker, 0.0), 0.0, 0.0)
    best, mean = (np.sqrt(square) for square in mean_squares(model, 0, SIZE, PAPER))
    ceilings = bench.ceilings.of(PAPER, FIRST)
    gain = ceilings["ceiling_accuracy_gain_pct"]
    assert gain.value == pytest.approx(100 * (1 - best / mean), abs=4)
    assert gain.lo < gain.value <= gain.hi
    assert ceilings["ceiling_rmse_dps"].value == pytest.approx(best, rel=0.1)


@pytest.fixture(scope="module")
def judged(world, stored):
    return {run.run_id: run for run in world.evaluate(stored)}


def alone(world, run, bias=None, allan=None):
    """A run that is judged where no other was planned."""
    plan = world.plan[world.plan[FINGERPRINT] == run.fingerprint]
    measured = [world.bias if bias is None else bias, world.allan if allan is None else allan]
    (found,) = evaluate(plan, [run], world.recordings, world.windows, *measured)
    return found


def test_the_metrics_of_a_run_are_those_of_its_errors(world, stored, judged):
    assert set(judged) == {run.run_id for run in stored}
    (mean,) = (judged[run.run_id] for run in stored if run.params["estimator"] == MEAN)
    mean_errors = mean.artifacts[ERRORS].query("truth == 'paper'")

    def rmse(errors):
        return np.sqrt((errors.error_dps**2).mean())

    for run in stored:
        network, found = run.params["estimator"] == CNN, judged[run.run_id]
        errors, metrics = found.artifacts[ERRORS], found.metrics
        scores = by_name(found.artifacts[TABLE].query("weights == 'last'"))
        assert set(found.artifacts) == {ERRORS, TABLE} | (set() if network else {CURVE})
        assert set(errors.weights) == ({LAST, BEST} if network else {LAST})
        last = errors.query("weights == 'last' and truth == 'paper'")
        assert metrics["rmse_mdps"] == pytest.approx(1e3 * rmse(last))
        assert metrics["mean_rmse_mdps"] == pytest.approx(1e3 * rmse(mean_errors))
        gain = 100 * (1 - rmse(last) / rmse(mean_errors))
        assert metrics["accuracy_gain_pct"] == pytest.approx(gain, abs=1e-9)
        assert metrics["accuracy_gain_pct_lo"] <= gain <= metrics["accuracy_gain_pct_hi"]
        firsts = [rmse(table[table.start == 0]) for table in (last, mean_errors)]
        gain = 100 * (1 - firsts[0] / firsts[1])
        assert metrics["accuracy_gain_pct_first"] == pytest.approx(gain, abs=1e-9)
        for name in {"time_saving_pct", "equivalent_time_s"} & set(metrics):
            assert metrics[name] == scores[PAPER, ALL, name]
        if not network:
            within = (last.error_dps.abs() < 1.959964 * last.sigma_dps).mean()
            assert metrics["coverage_95_pct"] == pytest.approx(100 * within)
            assert 85 < metrics["coverage_95_pct"] <= 100


def test_what_the_table_says_is_all_that_evaluation_knows_of_splits(world, stored, judged):
    """No coordinate of the recordings, and no name of a fold or a protocol, changes a number."""
    recordings = world.recordings.drop_vars("split").assign(recording_mean=lambda one: np.nan)
    renamed = world.windows.assign(fold="of any name", protocol="of any name")
    runs = [replace(run, load_fit=lambda _, run=run: run.load_fit("hold-out")) for run in stored]
    plan = world.plan.assign(protocol="of any name")
    for run in evaluate(plan, runs, recordings, renamed, world.bias, world.allan):
        assert run.metrics == judged[run.run_id].metrics


def test_what_was_judged_this_way_is_skipped_and_nothing_else(world, stored, judged, caplog):
    tags = {run.run_id: {**run.tags, **judged[run.run_id].tags} for run in stored}
    finished = [replace(run, finished=True, tags=tags[run.run_id]) for run in stored]
    caplog.set_level("INFO", logger="gyro_pipeline")
    assert world.evaluate(finished) == []
    assert "0 runs evaluated, 5 skipped" in caplog.text
    waiting = [replace(finished[0], finished=False), *finished[1:]]
    assert [run.run_id for run in world.evaluate(waiting)] == [finished[0].run_id]
    before = {run.tags[EVALUATED_WITH] for run in judged.values()}
    for bias, allan in (
        (world.bias.assign(bias_dps=world.bias.bias_dps + 1e-9), world.allan),
        (world.bias, world.allan.assign(allan_variance=world.allan.allan_variance * 1.01)),
    ):
        assert alone(world, finished[0], bias, allan).tags[EVALUATED_WITH] not in before


@pytest.fixture(scope="module")
def all_judged(world, make_study):
    names = ["training_mean", "median", "ridge", "empirical_bayes", "best_linear"]
    return replace(world, study=make_study("estimators", names)).judged()


def test_other_estimators_are_judged_like_a_network(all_judged):
    for name, run in all_judged.items():
        scores = by_name(run.artifacts[TABLE])
        assert np.isfinite(scores).all(), name
        always = {(PAPER, ALL, "ceiling_rmse_dps"), (DISJOINT, ALL, "test_mse_dps2")}
        assert always <= set(scores.index)
        stated = run.artifacts[ERRORS].sigma_dps.notna().any()
        assert stated == ((PAPER, ALL, "coverage_1sigma_pct") in scores.index)
        assert stated == (name not in {"median", "ridge"})
        assert run.tags.get("uses_prior") in {None, ORIENTATION_NOTE}
    assert all_judged["best_linear"].metrics["accuracy_gain_pct"] > 0
    assert all_judged["best_linear"].tags["recommended"] == "True"
    assert all_judged["best_linear"].tags["uses_prior"] == ORIENTATION_NOTE
    assert "uses_prior" not in all_judged["mean"].tags


def test_an_estimate_off_the_curve_has_no_time_and_says_why(world, stored, bench):
    run = alone(world, replace(stored[0], load_fit=lambda _: Off(bench, 1.0)))
    assert "worse than the running mean of 0.25 s" in run.tags["equivalent_time_s"]
    assert "equivalent_time_s" not in run.metrics


def test_a_sensor_that_was_turned_is_told_from_others_and_history_follows_it(
    world, make_world, make_study, all_judged
):
    raw = world.raw.copy(deep=True)
    raw.angular_rate[0, 10:, 0] += 0.05  # x of the recordings that test
    names = ["training_mean", "last_calibration"]
    judged = make_world(raw, study=make_study("some", names)).judged()
    conflict = judged["training_mean"].tags["prior_conflict"]
    assert conflict.startswith("test recordings contradict the prior on x (p = ")
    assert f"the running mean gives {judged[MEAN].metrics['rmse_mdps']:.3g}" in conflict
    assert "prior_conflict" not in judged[MEAN].tags  # which uses none
    assert "prior_conflict" not in all_judged["training_mean"].tags  # which was not turned
    scores = by_name(judged["training_mean"].artifacts[TABLE])[PAPER, ALL]
    assert scores["prior_p_x"] < 1e-6
    assert scores["prior_p_z"] > 1e-2
    assert scores["constant_rmse_dps"] == pytest.approx(scores["test_rmse_dps"])
    assert scores["constant_accuracy_gain_pct"] == pytest.approx(scores["accuracy_gain_pct"])
    means = raw.angular_rate.sel(imu=1).mean("sample", dtype=np.float64).to_numpy()
    errors = judged["last_calibration"].artifacts[ERRORS].query("truth == 'paper' and start == 0")
    np.testing.assert_allclose(errors.error_dps, np.ravel(means[9:13] - means[10:]), atol=1e-12)


def test_an_interval_wholly_beyond_the_ceiling_is_flagged(bench):
    beyond = bench.scores(bench.errors({"hold-out": Off(bench, 1e-5)}), LAST)
    assert "all windows, truth paper" in ceiling_warning(beyond)["beyond_ceiling"]
    assert not ceiling_warning(bench.scores(bench.mean_errors, LAST))
    scores = by_name(beyond)[PAPER, ALL]
    assert "ceiling_joint_rmse_dps" not in scores  # its axes are independent
    joint = joint_draws(*bench.device.biases, 100)
    device = replace(bench.device, joint=joint)
    correlated = Bench(bench.recordings, device, bench.tests, WINDOW_S)
    beyond = correlated.scores(correlated.errors({"hold-out": Off(bench, 1e-5)}), LAST)
    for name in ("joint", "history"):
        limit = beyond[beyond.score == f"ceiling_{name}_accuracy_gain_pct"].iloc[0]
        assert -20 < limit.lo < limit.value < limit.hi < 90
        assert "all windows" in ceiling_warning(beyond, name)["beyond_ceiling"]
        # an estimator stands beside the ceiling of what it uses
        out_of_reach = beyond.assign(value=beyond.value.mask(beyond.score == limit.score, 101))
        out_of_reach["lo"] = beyond.lo.mask(beyond.score == limit.score, 100.5)
        out_of_reach["hi"] = beyond.hi.mask(beyond.score == limit.score, 101.5)
        assert "paper" not in ceiling_warning(out_of_reach, name).get("beyond_ceiling", "")
    assert -1 <= scores["turn_on_correlation_xz"] <= 1
    by_axis = [1 - scores[f"accuracy_gain_pct_{axis}"] / 100 for axis in "xyz"]
    assert 0 < min(by_axis) <= 1 - scores["accuracy_gain_pct"] / 100 <= max(by_axis)


def test_in_a_k_fold_each_recording_is_judged_by_the_fit_without_it(world, make_study):
    raw = world.raw.drop_vars("split").isel(recording=slice(6))
    folds = replace(world, raw=raw, study=make_study("some", ["training_mean"]))
    errors = folds.judged()["training_mean"].artifacts[ERRORS]
    errors = errors.query("truth == 'paper' and start == 0")
    means = raw.angular_rate.sel(imu=1).mean("sample", dtype=np.float64).to_numpy()
    expected = [(means.sum(axis=0) - one) / 5 - one for one in means]
    assert errors.recording.tolist() == np.repeat(range(1, 7), 3).tolist()
    np.testing.assert_allclose(errors.error_dps, np.ravel(expected), atol=1e-12)


def test_unseen_devices_are_judged_one_by_one_and_nothing_is_better_than_the_mean(
    make_recordings, make_world, make_study
):
    bias = np.random.default_rng(1).normal(0, 1, (3, 1, 3)) + np.zeros((3, 6, 1))
    recordings = make_recordings(bias, 1040, 20.0, 0.003)
    shrinking = ["empirical_bayes", "empirical_bayes_pooled", "best_linear"]
    study = make_study("unseen_devices", ["training_mean", *shrinking], real_gyros=[6])
    study = study.model_copy(update={"protocol": "leave_one_device_out"})
    judged = make_world(recordings, study=study).judged()
    errors = judged["training_mean"].artifacts[ERRORS].query("truth == 'paper' and start == 0")
    means = recordings.angular_rate.mean("sample", dtype=np.float64)
    for imu, own in errors.groupby("imu"):
        others = means.sel(imu=[one for one in (1, 2, 3) if one != imu]).mean(["imu", "recording"])
        expected = (others - means.sel(imu=imu)).transpose("recording", "axis").to_numpy().ravel()
        np.testing.assert_allclose(own.error_dps, expected, atol=1e-12)
    for run in judged.values():
        assert set(run.artifacts[ERRORS].imu) == {1, 2, 3}
        assert run.metrics["mean_rmse_mdps"] == judged[MEAN].metrics["rmse_mdps"]
        scores = by_name(run.artifacts[TABLE])
        limit = scores[PAPER, ALL, "ceiling_accuracy_gain_pct"]
        assert limit == pytest.approx(0, abs=1e-2)
    for name in shrinking:
        assert judged[name].metrics["accuracy_gain_pct"] == pytest.approx(0, abs=1)
    # of three devices, whole ones are left out
    table = judged["training_mean"].artifacts[TABLE].set_index(["truth", "windows", "score"])
    row = table.loc[(PAPER, FIRST, "test_mse_dps2")]
    of_device = (errors.error_dps**2).groupby(errors.imu).mean().to_numpy()
    left = np.log([np.delete(of_device, place).mean() for place in range(3)])
    half = 4.302653 * np.sqrt(2 * left.var())
    ends = np.log([row.lo, row.hi])
    np.testing.assert_allclose(ends, np.log(row.value) + [-half, half], rtol=1e-5)


@pytest.fixture(scope="module")
def damaged(world, make_world, make_study):
    """A few samples masked, a window lost, two recordings of IMU 1 gone, and IMUs 2 and 3."""
    raw = world.raw.copy(deep=True).assign_coords(imu=[2, 3])
    raw.angular_rate[..., [7, 300, 301]] = np.nan
    raw.angular_rate[0, 11, :, 210:260] = np.nan  # of a second window, more than a tenth
    raw["samples"][0, [4, 12]], raw.angular_rate[0, [4, 12]] = 0, np.nan
    raw["samples"][1, 10], raw.angular_rate[1, 10] = 0, np.nan
    return make_world(raw, study=make_study("some", SEVERAL, real_gyros=[6], virtual_gyros=[3]))


def test_masked_samples_and_lacking_recordings_stop_nothing(damaged):
    judged = damaged.judged()
    assert set(judged) == set(SEVERAL)
    for run in judged.values():
        errors = run.artifacts[ERRORS]
        assert np.isfinite(errors.error_dps).all()
        assert set(errors.imu) == {2}
        windows = errors.query("truth == 'paper' and axis == 'x' and weights == 'last'")
        assert windows.groupby("recording").start.count().to_dict() == {11: 5, 12: 4, 14: 5}
        assert run.metrics["rmse_mdps"] < 10
    samples = damaged.raw.angular_rate.sel(imu=2, recording=12).to_numpy().astype(float)
    errors = judged["mean"].artifacts[ERRORS].query("truth == 'paper' and recording == 12")
    for start, found in errors.groupby("start"):
        means = np.nanmean(samples[:, start : start + SIZE], axis=1) - np.nanmean(samples, axis=1)
        np.testing.assert_allclose(found.error_dps, means, atol=1e-8)
    assert errors.start.unique().tolist() == [0, 400, 600, 800]


def test_side_by_side_what_one_imu_lacks_is_left_out_before_training(damaged, make_study):
    """IMU 3 lacks a recording that tests, and both of them some that train."""
    channels = replace(damaged, study=make_study("input_channels", method=1, real_gyros=[6]))
    (problem,) = channels.plan.left_out[channels.plan.estimator == CNN]
    assert "recording 11" in problem
    whole = damaged.raw.copy(deep=True)
    whole["samples"][1, 10], whole.angular_rate[1, 10] = 1040, 0.1
    whole.angular_rate[1, 13, :, 200:230] = np.nan  # what the other lost changes no window
    run = replace(channels, raw=whole).judged()[CNN]
    errors = run.artifacts[ERRORS]
    assert errors.groupby("recording").start.nunique().to_dict() == {11: 5, 12: 4, 14: 5}
    # of the tested IMU alone: the other's biases are off by more
    assert errors.groupby(["weights", "truth", "recording", "start"]).size().eq(3).all()
    assert run.metrics["rmse_mdps"] < 50
