from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
import torch
import xarray as xr

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
    InputError,
)
from gyro_pipeline.estimators import ESTIMATORS, ORIENTATION_NOTE, RunningMean
from gyro_pipeline.parameters import Grid, Study
from gyro_pipeline.physics.allan import NoiseFigures
from gyro_pipeline.physics.noise import simulate_noise, warm_up
from gyro_pipeline.physics.recording_model import (
    best_linear,
    constant_bias,
    mean_squares,
    outside_noise,
)
from gyro_pipeline.pipelines.evaluation import bench as bench_module
from gyro_pipeline.pipelines.evaluation.bench import (
    Bench,
    known_recordings,
    off_the_curve,
)
from gyro_pipeline.pipelines.evaluation.device import describe_device
from gyro_pipeline.pipelines.evaluation.folds import Fitted
from gyro_pipeline.pipelines.evaluation.nodes import evaluate
from gyro_pipeline.pipelines.ground_truth.nodes import measure_allan_variance, measure_bias
from gyro_pipeline.protocol.scores import squared_errors
from gyro_pipeline.studies import CNN, MEAN
from gyro_pipeline.tracking import CURVE, ERRORS, EVALUATED_WITH, HISTORY, WEIGHTS

WINDOW_S, SIZE, RECORDING_S = 10.0, 200, 52.0
TESTED = (11, 12, 13, 14)


def device_of(world, recordings=None, numbers=range(1, 11)):
    recordings = world.recordings if recordings is None else recordings
    return describe_device(recordings, world.bias, world.allan, tuple(numbers), seed=1)


@pytest.fixture(scope="module")
def bench(world):
    return Bench(world.recordings, device_of(world), TESTED, WINDOW_S, world.evaluation)


@pytest.fixture(scope="module")
def simulated(world):
    """The same recordings with drawn values, as a simulated source gives them."""
    made = world.recordings.assign(
        true_bias=world.recordings.angular_rate.mean("sample", dtype=np.float64) + 1e-4,
        true_unit_bias=(("imu", "axis"), np.array([[1.0, 2, 3], [4, 5, 6]])),
        true_turn_on_spread=("axis", np.array([1e-3, 2e-3, 3e-3])),
        true_noise=("axis", np.array([3e-3, 4e-3, 5e-3])),
        true_flicker=0.0,
    )
    return made.assign_attrs(simulated=1)


class Off:
    """Knows the mean of the whole recording and is off by a constant."""

    def __init__(self, bench, by):
        self._means = {r.number: r.samples.mean(axis=1, dtype=np.float64) for r in bench.tested}
        self._by = by

    def estimate(self, windows, target, start_s, recording):
        biases = np.tile(self._means[recording] + self._by, (len(windows), 1))
        return biases, np.full(biases.shape, np.nan)


# errors and metrics


def test_errors_of_the_running_mean_are_those_computed_by_hand(world, bench):
    samples = world.recordings.angular_rate.sel(imu=1, recording=list(TESTED)).to_numpy()
    samples = samples.astype(np.float64)  # (recording, axis, sample)
    windows = samples[..., : 5 * SIZE].reshape(4, 3, 5, SIZE).mean(axis=-1).swapaxes(1, 2)
    whole = samples.mean(axis=-1)[:, None]
    errors = bench.mean_errors[bench.mean_errors.truth == PAPER]
    assert errors.recording.tolist() == np.repeat(TESTED, 15).tolist()
    np.testing.assert_allclose(errors.error_dps, (windows - whole).ravel(), atol=1e-12)
    rest = (1040 * whole - SIZE * windows) / (1040 - SIZE)
    disjoint = bench.mean_errors[bench.mean_errors.truth == DISJOINT]
    np.testing.assert_allclose(disjoint.error_dps, (windows - rest).ravel(), atol=1e-12)
    metrics = bench.metrics(bench.mean_errors, LAST)
    squares = (windows - whole) ** 2
    assert metrics["test_rmse_dps"] == pytest.approx(np.sqrt(squares[:, 0].mean()))
    assert metrics["test_rmse_dps_all"] == pytest.approx(np.sqrt(squares.mean()))
    place = 1040, 1040 / RECORDING_S
    noise = [
        outside_noise(figures, *place, start * SIZE, SIZE)
        for figures in bench.device.figures
        for start in range(5)
    ]
    white = bench.device.noise[0] ** 2 / (RECORDING_S - WINDOW_S)
    assert np.mean(noise) == pytest.approx(white.mean(), rel=0.1)
    honest = ((windows - rest) ** 2).mean() - np.mean(noise)
    assert metrics["test_mse_dps2_all_disjoint"] == pytest.approx(honest)


class Asked:
    """Returns a number that tells which target it was asked for, and where the window is."""

    def estimate(self, windows, target, start_s, recording):
        told = {"recording_mean": 1000.0, "bias": 2000.0}[target] + start_s + 100 * recording
        biases = np.tile(told[:, None], (1, 3))
        return biases, np.full(biases.shape, np.nan)


def test_an_estimator_is_asked_for_the_target_that_the_truth_is_about(world, simulated):
    bench = Bench(simulated, device_of(world, simulated), (12,), WINDOW_S, world.evaluation)
    errors = bench.errors(Asked())
    truth = simulated.angular_rate.sel(imu=1, recording=12).mean("sample", dtype=np.float64)
    for row in errors[errors.truth != DISJOINT].itertuples():
        aim = float(truth.sel(axis=row.axis)) + (1e-4 if row.truth == TRUE else 0)
        asked = {PAPER: 1000.0, TRUE: 2000.0}[row.truth] + WINDOW_S * row.window + 1200
        assert row.error_dps == pytest.approx(asked - aim)


def test_the_running_mean_gains_nothing_on_itself(bench):
    metrics = bench.metrics(bench.mean_errors, LAST)
    assert metrics["accuracy_gain_pct"] == 0
    # The first time that the curve of four recordings, which is not monotonic, is as low.
    curve = bench.curve.query("truth == 'paper' and windows == 'first'").groupby("time_s").sum()
    rmse = np.sqrt(curve.sum_sq / curve["count"])
    after = int((rmse <= rmse[WINDOW_S]).argmax())
    time_s = metrics["equivalent_time_s"]
    assert rmse.index[after - 1] < time_s <= rmse.index[after] <= WINDOW_S
    assert metrics["time_saving_pct"] == pytest.approx(100 * (1 - WINDOW_S / time_s))


def test_knowing_the_whole_recording_is_worth_the_whole_recording(bench):
    metrics = bench.metrics(bench.errors(Off(bench, 0.0)), LAST)
    assert metrics["test_rmse_dps"] == pytest.approx(0, abs=1e-12)
    assert metrics["accuracy_gain_pct"] == pytest.approx(100)
    assert metrics["equivalent_time_s"] == pytest.approx(RECORDING_S)
    assert metrics["time_saving_pct"] == pytest.approx(100 * (1 - WINDOW_S / RECORDING_S))


def test_an_estimate_off_the_curve_has_no_time_and_says_why(bench):
    metrics = bench.metrics(bench.errors(Off(bench, 1.0)), LAST)
    assert metrics["test_rmse_dps"] == pytest.approx(1)
    assert metrics["accuracy_gain_pct"] < -1000
    assert not any(name.startswith(("equivalent_time", "time_saving")) for name in metrics)
    notes = off_the_curve(metrics)
    assert "worse than the running mean of 0.25 s" in notes["equivalent_time_s"]
    assert "equivalent_time_s_all" in notes
    assert off_the_curve(bench.metrics(bench.mean_errors, LAST)) == {}


def test_a_level_that_the_running_mean_never_reaches_is_said_so(bench):
    metrics = bench.metrics(bench.mean_errors, LAST)
    best = {name: metrics[name] for name in ("test_rmse_dps", "mean_rmse_dps")}
    best["test_rmse_dps"] /= 100
    assert off_the_curve(best) == {"equivalent_time_s": "the running mean never gets there"}


def test_names_are_put_together_in_order(bench):
    names = set(bench.metrics(bench.mean_errors, BEST))
    assert "test_rmse_dps_all_best_lo" in names
    assert "test_mse_dps2_all_best_disjoint_hi" in names
    assert not any(name.startswith("ceiling") for name in names)  # it has no epoch
    assert {"ceiling_rmse_dps", "ceiling_rmse_dps_lo", "ceiling_rmse_dps_all_disjoint"} <= set(
        bench.metrics(bench.mean_errors, LAST)
    )


def test_intervals_hold_their_values(bench):
    metrics = bench.metrics(bench.mean_errors, LAST)
    for base in ("test_rmse_dps", "test_rmse_dps_all", "ceiling_rmse_dps"):
        assert metrics[f"{base}_lo"] < metrics[base] < metrics[f"{base}_hi"]


# the device and its ceiling


def test_noise_and_turn_on_spread_are_measured(make_recordings, parameters):
    noise, spread = 0.004, np.array([0.0, 0.002, 0.006])
    bias = np.random.default_rng(8).normal(0, 1, (1, 120, 3)) * spread + [5, -7, 0.1]
    recordings = make_recordings(bias, 1200, 20.0, noise, seed=9)
    allan = measure_allan_variance(recordings)
    table = measure_bias(recordings, allan, parameters().ground_truth)
    device = describe_device(recordings, table, allan, tuple(range(1, 121)), seed=1)
    assert device.noise.shape == device.spread.shape == (401, 3)
    np.testing.assert_allclose(device.noise[0], noise, rtol=0.04)
    np.testing.assert_allclose(device.spread[0, 1:], spread[1:], rtol=0.2)
    assert device.spread[0, 0] < 1.5e-4  # a third of N / sqrt(T), which is all there is
    assert device.unit_bias is None
    assert [model.noise.white for model in device.models] == pytest.approx(3 * [noise], rel=0.04)
    priors = [device.priors(axis) for axis in range(3)]
    np.testing.assert_allclose(np.stack(priors, axis=1)[..., 0, 0], device.spread**2)
    lo, hi = np.quantile(device.spread[1:, 2], [0.001, 0.999])
    assert lo < spread[2] < hi


def test_only_the_recordings_named_describe_the_device(world):
    known = device_of(world, numbers=range(2, 11))
    wild = world.bias.copy()
    wild.loc[~wild.recording.between(2, 10), "bias_dps"] = 99
    allan = world.allan.copy(deep=True)
    allan.allan_variance[:, [0, 10, 11, 12, 13]] = 99
    again = device_of(replace(world, bias=wild, allan=allan), numbers=range(2, 11))
    np.testing.assert_array_equal(known.noise, again.noise)
    np.testing.assert_array_equal(known.spread, again.spread)


def test_of_a_hold_out_the_test_recordings_are_unknown_of_a_k_fold_none(world):
    assert known_recordings(world.roles) == tuple(range(1, 11))
    folds = pd.concat([world.roles.assign(fold=fold) for fold in (0, 1)])
    assert known_recordings(folds) == tuple(range(1, 15))
    folds.loc[(folds.fold == 1) & (folds.recording == 1), "role"] = TEST
    assert bench_module.test_recordings(folds, 0) == TESTED
    assert bench_module.test_recordings(folds, 1) == (1, *TESTED)


def test_a_running_mean_over_a_k_fold_is_tested_on_every_recording():
    folds = pd.concat(
        pd.DataFrame({"fold": f, "recording": [1, 2, 3], "role": TRAIN}) for f in range(3)
    )
    folds.loc[folds.fold + 1 == folds.recording, "role"] = TEST
    assert bench_module.test_recordings(folds, HOLD_OUT) == (1, 2, 3)


def test_ceilings_of_simulated_data_are_the_closed_form(world, simulated):
    bench = Bench(simulated, device_of(world, simulated), TESTED, WINDOW_S, world.evaluation)
    assert bench.ceiling_basis == "drawn values"
    noise, spread = np.array([3e-3, 4e-3, 5e-3]), np.array([1e-3, 2e-3, 3e-3])
    q, r = spread**2 * WINDOW_S / noise**2, WINDOW_S / RECORDING_S
    mean = noise**2 * (1 / WINDOW_S - 1 / RECORDING_S)
    best = mean * (r + (1 - r) * q / (1 + q))
    rho = np.sqrt(best.mean() / mean.mean())
    ceilings = bench.ceilings(PAPER, ALL)
    assert ceilings["ceiling_rmse_dps"].value == pytest.approx(np.sqrt(best.mean()))
    assert ceilings["ceiling_rmse_dps"].lo is None
    assert ceilings["ceiling_accuracy_gain_pct"].value == pytest.approx(100 * (1 - rho))
    saving = 100 * (1 - rho**2) * (1 - r)
    assert ceilings["ceiling_time_saving_pct"].value == pytest.approx(saving)
    posterior = noise**2 / WINDOW_S * q / (1 + q)
    assert bench.ceilings(TRUE, ALL)["ceiling_rmse_dps"].value == (
        pytest.approx(np.sqrt(posterior.mean()))
    )


COLOUR = {"flicker": 3e-3, "random_walk": 1e-3}
WARM_UP, CONSTANT_S = (20e-3, 5e-3), 15.0  # mean and spread of the amplitude, deg/s


def coloured(simulated, constants_s, count=200):
    """Recordings of flicker, random walk and warm-up, with what was drawn."""
    generator = np.random.default_rng(4)
    noise, spread = simulated.true_noise.to_numpy(), simulated.true_turn_on_spread.to_numpy()
    unit = simulated.true_unit_bias.sel(imu=[1]).to_numpy()
    bias = unit[:, None] + generator.normal(0, spread, (1, count, 3))
    amplitude = generator.normal(*WARM_UP, bias.shape)
    constants_s = generator.uniform(*constants_s, bias.shape)
    rates = bias[..., None] + warm_up(amplitude, constants_s, int(RECORDING_S * 20), 20.0)
    rates += simulate_noise(
        generator,
        rates.shape,
        20.0,
        noise,
        flicker_dps=COLOUR["flicker"],
        random_walk_dps_rts=COLOUR["random_walk"],
    )
    drawn = {
        "angular_rate": (("imu", "recording", "axis", "sample"), rates.astype(np.float32)),
        "samples": (("imu", "recording"), np.full(rates.shape[:2], rates.shape[-1])),
        "true_bias": (("imu", "recording", "axis"), bias),
        "true_unit_bias": (("imu", "axis"), unit),
        "true_noise": ("axis", noise),
        "true_turn_on_spread": ("axis", spread),
        "true_time_constant": (("imu", "recording", "axis"), constants_s),
        "true_amplitude": (("imu", "recording", "axis"), amplitude),
        "true_amplitude_mean": WARM_UP[0],
        "true_amplitude_spread": WARM_UP[1],
        **{f"true_{name}": value for name, value in COLOUR.items()},
    }
    labels = {"imu": [1], "recording": np.arange(1, 1 + count), "axis": list("xyz")}
    return xr.Dataset(drawn, labels, simulated.attrs)


def bench_of_all(world, recordings):
    numbers = tuple(recordings.recording.to_numpy().tolist())
    return Bench(recordings, device_of(world, recordings), numbers, WINDOW_S, world.evaluation)


@pytest.fixture(scope="module")
def coloured_bench(world, simulated):
    return bench_of_all(world, coloured(simulated, 2 * [CONSTANT_S]))


@pytest.mark.parametrize("windows", [FIRST, ALL])
@pytest.mark.parametrize("truth", [PAPER, DISJOINT, TRUE])
def test_the_ceiling_of_coloured_noise_and_warm_up_is_what_the_oracle_reaches(
    coloured_bench, truth, windows
):
    assert coloured_bench.ceiling_basis == "drawn values"
    oracle = squared_errors(coloured_bench.oracle_errors, truth, windows)
    mean = squared_errors(coloured_bench.mean_errors, truth, windows)
    every = np.ones((1, 200))
    reached, of_mean = oracle.mean(every)[0], mean.mean(every)[0]
    # 600 gyroscope recordings: 6 % of a mean square
    expected = coloured_bench._expected(truth, windows, coloured_bench.size)
    of_noise = coloured_bench.oracle_errors.query("truth == @truth").truth_variance.mean()
    assert np.ravel(expected) == pytest.approx((reached, of_mean), rel=0.12, abs=0.12 * of_noise)
    ceilings = coloured_bench.ceilings(truth, windows)
    if reached < 0:  # truth (b), less its own noise but not less what it shares with the window
        assert truth == DISJOINT
        assert not ceilings
        return
    reached, of_mean = np.sqrt([reached, of_mean])
    assert ceilings["ceiling_rmse_dps"].value == pytest.approx(reached, rel=0.07)
    gain = 100 * (1 - reached / of_mean)
    assert ceilings["ceiling_accuracy_gain_pct"].value == pytest.approx(gain, abs=4)
    assert ceilings["ceiling_rmse_dps"].lo is None


def test_on_coloured_noise_one_who_looks_outside_the_window_is_found_out(coloured_bench):
    metrics = coloured_bench.metrics(coloured_bench.mean_errors, LAST)
    assert metrics["beats_oracle_p_all"] > 0.5
    assert 0 < metrics["ceiling_time_saving_pct_all"] < 100
    cheat = coloured_bench.metrics(coloured_bench.errors(Off(coloured_bench, 1e-3)), LAST)
    assert cheat["beats_oracle_p_all"] < 1e-6


@pytest.fixture(scope="module")
def ranging_bench(world, simulated):
    return bench_of_all(world, coloured(simulated, (8.0, 30.0), count=40))


def test_with_time_constants_of_their_own_the_limit_is_that_of_one_who_is_told_them(ranging_bench):
    assert "nobody who must learn" in ranging_bench.ceiling_basis
    oracle = squared_errors(ranging_bench.oracle_errors, PAPER, ALL).mean(np.ones((1, 40)))
    # 120 gyroscope recordings: 13 % of a mean square
    best, _ = ranging_bench._expected(PAPER, ALL, SIZE)
    assert best == pytest.approx(oracle, rel=0.2)
    ceiling = ranging_bench.ceilings(PAPER, ALL)["ceiling_rmse_dps"]
    assert ceiling.value == pytest.approx(np.sqrt(best[0]))


class OneConstant:
    """Best of all who take one time constant for all power-ons, on windows from power-on."""

    def __init__(self, bench, constant_s):
        models = [replace(one, time_constant_s=constant_s) for one in bench.device.models]
        self._lines = [best_linear(one, 0, SIZE, PAPER) for one in models]

    def estimate(self, windows, target, start_s, recording):
        axes = zip(self._lines, windows.swapaxes(0, 1), strict=True)
        biases = np.stack([line(one) for line, one in axes], axis=-1)
        return biases, np.full(biases.shape, np.nan)


def test_nobody_honest_beats_one_who_is_told_the_time_constants(ranging_bench):
    honest = ranging_bench.metrics(ranging_bench.errors(OneConstant(ranging_bench, 16.0)), LAST)
    assert honest["beats_oracle_p"] > 0.5
    cheat = ranging_bench.metrics(ranging_bench.errors(Off(ranging_bench, 1e-3)), LAST)
    assert cheat["beats_oracle_p"] < 1e-3


@pytest.mark.parametrize("seed", [1, 2])
def test_the_ceiling_of_measured_flicker_is_that_of_its_model(make_recordings, parameters, seed):
    """Flicker must not count as turn-on spread as well, or the ceiling is far too low."""
    count, samples, rate_hz = 60, 1200, 20.0
    noise = NoiseFigures(5e-3, 4e-3, 0.0)
    drawn = simulate_noise(
        np.random.default_rng(seed),
        (1, count, 3, samples),
        rate_hz,
        np.full(3, noise.white),
        flicker_dps=noise.instability,
    )
    recordings = make_recordings(np.zeros((1, count, 3)), samples, rate_hz, noise.white)
    recordings = recordings.assign(angular_rate=recordings.angular_rate.copy(data=drawn))
    allan = measure_allan_variance(recordings)
    table = measure_bias(recordings, allan, parameters().ground_truth)
    device = describe_device(recordings, table, allan, tuple(range(1, count + 1)), seed=1)
    model = constant_bias(samples, rate_hz, noise, 0.0, 0.0)
    bench = Bench(recordings, device, (1, 2), WINDOW_S, parameters().evaluation)
    best, mean = (np.sqrt(square) for square in mean_squares(model, 0, SIZE, PAPER))
    ceilings = bench.ceilings(PAPER, FIRST)
    gain = ceilings["ceiling_accuracy_gain_pct"]
    assert gain.value == pytest.approx(100 * (1 - best / mean), abs=4)
    assert gain.lo < gain.value <= gain.hi
    assert ceilings["ceiling_rmse_dps"].value == pytest.approx(best, rel=0.1)


def test_simulated_data_are_judged_against_the_drawn_bias_as_well(world, simulated):
    bench = Bench(simulated, device_of(world, simulated), TESTED, WINDOW_S, world.evaluation)
    metrics = bench.metrics(bench.errors(Off(bench, 0.0)), LAST)
    assert metrics["test_rmse_dps_true"] == pytest.approx(1e-4)
    assert metrics["beats_oracle_p"] < 0.05  # it looks at the whole recording


# the node


def evaluated(world, runs, **changes):
    w = replace(world, **changes)
    names = "recordings bias allan roles evaluation".split()
    given = {name: getattr(w, name) for name in names}
    return list(evaluate(cells=w.plan(), runs=runs, **given))


@pytest.fixture(scope="module")
def judged(world, stored):
    return evaluated(world, stored)


def test_every_run_that_waits_is_judged(world, stored, judged):
    assert [run.run_id for run in judged] == [
        next(one.run_id for one in stored if one.fingerprint == print_)
        for print_ in world.plan().fingerprint
    ]
    by_id = {run.run_id: run for run in stored}
    for run in judged:
        estimator = by_id[run.run_id].params["estimator"]
        assert set(run.artifacts) == {ERRORS} | ({CURVE} if estimator == MEAN else set())
        weights = {MEAN: {LAST}, CNN: {LAST, BEST}}[estimator]
        assert set(run.artifacts[ERRORS].weights) == weights
        errors = run.artifacts[ERRORS].query("weights == 'last' and truth == 'paper'")
        assert run.metrics["test_rmse_dps_all"] == pytest.approx(
            np.sqrt((errors.error_dps**2).mean())
        )
        first = errors[errors.window == 0]
        assert run.metrics["test_rmse_dps"] == pytest.approx(np.sqrt((first.error_dps**2).mean()))


def test_stored_weights_give_the_stored_errors(world, stored, judged):
    """From the state dict by plain PyTorch: convolution, LeakyReLU, max-pool, two layers."""
    run = next(one for one in judged if one.run_id == stored[-1].run_id)
    artifact = stored[-1].load(WEIGHTS)
    state, scaling, t = artifact["last"], artifact["scaling"], world.training
    layers = torch.nn.Sequential(
        torch.nn.Conv1d(3, t.channels, t.kernel, t.stride),
        torch.nn.LeakyReLU(0.1),
        torch.nn.MaxPool1d(t.pool),
    )
    layers[0].weight.data, layers[0].bias.data = (
        state["convolution.weight"],
        state["convolution.bias"],
    )
    samples = world.recordings.angular_rate.sel(imu=1, recording=11).to_numpy()
    centre = scaling["centre"].numpy()
    window = (samples[:, :SIZE] - centre[:, None]) / scaling["input_scale"]
    with torch.no_grad():
        features = layers(torch.tensor(window, dtype=torch.float32)[None]).swapaxes(1, 2).flatten()
        hidden = state["hidden.weight"] @ features + state["hidden.bias"]
        output = state["output.weight"] @ torch.where(hidden > 0, hidden, 0.1 * hidden)
        output = (output + state["output.bias"]).numpy() * scaling["target_scale"]
    expected = centre + output - samples.mean(axis=1, dtype=np.float64)
    errors = run.artifacts[ERRORS].query(
        "weights == 'last' and truth == 'paper' and recording == 11 and window == 0"
    )
    np.testing.assert_allclose(errors.error_dps, expected, atol=1e-7)


def test_what_was_judged_this_way_is_skipped_and_nothing_else(world, stored, judged, caplog):
    tags = {run.run_id: run.tags for run in judged}
    finished = [
        replace(run, finished=True, tags={**run.tags, **tags[run.run_id]}) for run in stored
    ]
    caplog.set_level("INFO", logger="gyro_pipeline")
    assert evaluated(world, finished) == []
    assert "0 runs evaluated, 5 skipped" in caplog.text
    waiting = [replace(finished[0], finished=False), *finished[1:]]
    assert [run.run_id for run in evaluated(world, waiting)] == [finished[0].run_id]
    other = world.evaluation.model_copy(update={"resamples": 101})
    again = evaluated(world, finished, evaluation=other)
    assert len(again) == 5
    assert {run.tags[EVALUATED_WITH] for run in again}.isdisjoint(
        run.tags[EVALUATED_WITH] for run in judged
    )


def test_only_the_test_imus_outputs_of_method_1_count(world, make_study, as_stored):
    study = make_study("input_channels", method=1, real_gyros=[6])
    channels = replace(world, study=study, virtual=None)
    runs = [as_stored(run, f"id{i}") for i, run in enumerate(channels.train())]
    run = evaluated(channels, runs)[-1]
    errors = run.artifacts[ERRORS]
    assert errors.groupby(["weights", "truth", "recording", "window"]).size().eq(3).all()
    artifact = runs[-1].load(WEIGHTS)
    # Outputs of all six are far from zero before the centres are added; IMU 1's centres come first.
    np.testing.assert_allclose(
        artifact["scaling"]["centre"][:3],
        world.bias.query("imu == 1 and recording <= 8").groupby("axis").bias_dps.mean(),
    )
    assert run.metrics["test_rmse_dps_all"] < 0.05  # IMU 2's biases are off by more


def test_without_validation_there_is_no_best_epoch(world, make_roles, as_stored):
    without = replace(world, roles=make_roles(14, test=4), virtual=None)
    cells = without.plan().query("estimator == 'cnn' and virtual_gyros == 0 and real_gyros == 3")
    (trained,) = without.train(cells=cells)
    assert trained.artifacts[WEIGHTS]["best"] is None
    assert "val_loss" not in trained.artifacts[HISTORY]
    names = "recordings bias allan roles evaluation".split()
    given = {name: getattr(without, name) for name in names}
    (run,) = evaluate(cells=cells, runs=[as_stored(trained, "id")], **given)
    assert not any(BEST in name.split("_") for name in run.metrics)


@pytest.mark.parametrize("windows", [FIRST, ALL])
def test_the_curve_at_the_window_is_the_running_means_rmse(bench, windows):
    curve = bench.curve.query(f"truth == 'paper' and windows == '{windows}' and time_s == 10.0")
    rmse = np.sqrt(curve.sum_sq.sum() / curve["count"].sum())
    name = "test_rmse_dps" + ("" if windows == FIRST else "_all")
    assert bench.metrics(bench.errors(RunningMean()), LAST)[name] == pytest.approx(rmse)


# estimators without a network


def of_estimators(world, names, roles=None):
    study = Study(
        experiment="estimators",
        estimators=list(names),
        sensors={"sparkfun": Grid(method=2, real_gyros=[3])},
    )
    return replace(world, study=study, virtual=None, roles=world.roles if roles is None else roles)


def judge(world, as_stored):
    """Metrics, tags and artifacts of each estimator."""
    runs = [as_stored(run, f"id{i}") for i, run in enumerate(world.train())]
    names = {run.run_id: run.params["estimator"] for run in runs}
    given = {n: getattr(world, n) for n in "recordings bias allan roles evaluation".split()}
    return {names[run.run_id]: run for run in evaluate(cells=world.plan(), runs=runs, **given)}


@pytest.fixture(scope="module")
def all_judged(world, as_stored):
    return judge(of_estimators(world, ESTIMATORS), as_stored)


def test_every_estimator_is_judged_like_a_network(world, all_judged):
    assert list(all_judged) == list(ESTIMATORS)
    for name, run in all_judged.items():
        for base in ("test_rmse_dps", "mean_rmse_dps", "accuracy_gain_pct", "ceiling_rmse_dps"):
            assert {base, f"{base}_all", f"{base}_all_lo"} <= set(run.metrics), name
        assert "test_mse_dps2_all_disjoint" in run.metrics
        assert set(run.artifacts[ERRORS].weights) == {LAST}
        estimator = ESTIMATORS[name]()
        assert run.tags["recommended"] == str(estimator.recommended)
        assert run.tags.get("uses_prior") == (ORIENTATION_NOTE if estimator.uses_prior else None)
    assert all_judged["best_linear"].metrics["accuracy_gain_pct_all"] > 0


def test_it_is_fitted_to_all_recordings_but_those_that_test(world, all_judged):
    known = world.recordings.sel(recording=slice(1, 10))
    constant = known.angular_rate.sel(imu=1).mean("sample", dtype=np.float64).mean("recording")
    tested = world.recordings.angular_rate.sel(imu=1, recording=list(TESTED))
    off = constant - tested.mean("sample", dtype=np.float64)
    metrics = all_judged["training_mean"].metrics
    assert metrics["test_rmse_dps_all"] == pytest.approx(float(np.sqrt((off**2).mean())))


def test_coverage_is_that_of_the_stated_deviations(all_judged):
    stated = {name for name, run in all_judged.items() if "coverage_1sigma_all" in run.metrics}
    assert set(all_judged) - stated == {
        *("median", "trimmed_mean", "ridge", "ridge_same_time", "window_mean_network")
    }
    for name in stated:
        errors = all_judged[name].artifacts[ERRORS].query("truth == 'paper'")
        within = (errors.error_dps.abs() < 2 * errors.sigma_dps).mean()
        assert all_judged[name].metrics["coverage_2sigma_all"] == pytest.approx(within)
        assert "coverage_1sigma_all_disjoint" not in all_judged[name].metrics
    assert 0.55 < all_judged["mean"].metrics["coverage_1sigma_all"] < 0.8


@pytest.fixture
def folds(world):
    """Of seven recordings each; the first is fitted to the second half, and the reverse."""
    first = [TEST] * 7 + [TRAIN] * 7
    return pd.concat(
        pd.DataFrame({"fold": fold, "recording": range(1, 15), "role": roles})
        for fold, roles in enumerate((first, first[::-1]))
    )


def test_in_a_k_fold_one_run_holds_the_recordings_of_all_folds(world, as_stored, folds):
    judged = judge(of_estimators(world, ["training_mean"], folds), as_stored)
    errors = judged["training_mean"].artifacts[ERRORS].query("truth == 'paper' and window == 0")
    assert errors.recording.nunique() == 14
    means = world.recordings.angular_rate.sel(imu=1).mean("sample", dtype=np.float64).to_numpy()
    expected = np.concatenate([means[7:].mean(0) - means[:7], means[:7].mean(0) - means[7:]])
    np.testing.assert_allclose(errors.error_dps, expected.ravel(), atol=1e-12)


def test_an_estimator_never_sees_the_drawn_values(simulated, world, monkeypatch):
    seen = []

    class Spy(RunningMean):
        def fit(self, recordings, imu=1):
            seen.append(recordings.recordings)
            return self

    monkeypatch.setitem(ESTIMATORS, "mean", Spy)
    Fitted(simulated, world.roles).estimator("mean", 1, 0)
    assert len(seen) == 1  # once for all recordings
    assert set(seen[0].data_vars) == {"angular_rate", "samples"}
    assert seen[0].recording.to_numpy().tolist() == list(range(1, 11))


def test_too_few_recordings_are_an_error_that_says_so(world, as_stored, make_roles):
    roles = make_roles(14, test=12)
    with pytest.raises(
        InputError, match="fold -1, 2 recordings: best_linear cannot be fitted: .*leave"
    ):
        judge(of_estimators(world, ["best_linear"], roles), as_stored)


def test_an_estimate_that_is_none_is_refused(bench):
    with pytest.raises(InputError, match="recording 11: expected an estimate for every window"):
        bench.errors(Off(bench, np.nan))


def test_a_residual_network_learns_from_the_imus_of_its_cell(world, monkeypatch):
    seen = []

    class Spy(RunningMean):
        def fit(self, recordings, imu=1):
            seen.append(recordings.recordings)
            return self

    monkeypatch.setitem(ESTIMATORS, "residual_network", Spy)
    fitted = Fitted(world.recordings, world.roles, world.virtual)
    for real, virtual in ((1, 0), (2, 3), (2, 3)):
        fitted.estimator("residual_network", real, virtual)
    alone, together = seen  # fitted once for each
    assert alone.imu.to_numpy().tolist() == [1]
    assert together.imu.to_numpy().tolist() == [1, 2, 3, 4, 5]
    drawn = together.angular_rate.sel(imu=slice(3, 5), recording=slice(1, 5)).to_numpy()
    np.testing.assert_array_equal(drawn, world.virtual.angular_rate.to_numpy()[:3, :5])
    # virtual recordings beyond those that train are not there
    assert np.isnan(together.angular_rate.sel(imu=3, recording=slice(6, 10))).all()


# masked samples, and recordings that an IMU lacks


@pytest.fixture(scope="module")
def damaged(world, make_bias):
    """The same world with a few samples masked, a window lost and two recordings of IMU 1 gone."""
    recordings = world.recordings.copy(deep=True)
    recordings.angular_rate[..., [7, 300, 301]] = np.nan
    recordings.angular_rate[0, 11, :, 210:260] = np.nan  # of a second window, more than a tenth
    recordings["samples"][0, [4, 12]], recordings.angular_rate[0, [4, 12]] = 0, np.nan
    allan = measure_allan_variance(recordings)
    return replace(world, recordings=recordings, allan=allan, bias=make_bias(recordings, allan))


def test_masked_samples_and_lacking_recordings_stop_nothing(damaged, as_stored):
    names = ["cnn", *ESTIMATORS]
    study = Study(
        experiment="estimators",
        estimators=names,
        sensors={"sparkfun": Grid(method=2, real_gyros=[3, 6])},
    )
    small = replace(damaged, study=study, virtual=None)
    runs = [as_stored(run, f"id{i}") for i, run in enumerate(small.train())]
    judged = list(
        evaluate(
            *(small.plan(), runs, small.recordings, small.bias, small.allan, small.roles),
            small.evaluation,
        )
    )
    assert len(judged) == len(runs) >= len(names)
    for run in judged:
        errors = run.artifacts[ERRORS]
        assert np.isfinite(errors.error_dps).all()
        windows = errors[
            (errors.truth == PAPER) & (errors["axis"] == "x") & (errors.weights == LAST)
        ]
        assert windows.groupby("recording").window.count().to_dict() == {11: 5, 12: 4, 14: 5}
        assert run.metrics["test_rmse_dps_all"] < 0.01


def without_windows(world, *numbers):
    """The same world, with every fifth sample of these recordings masked."""
    recordings = world.recordings.copy(deep=True)
    recordings.angular_rate[:, [number - 1 for number in numbers], :, ::5] = np.nan
    return replace(world, recordings=recordings)


def one_by_one(world, names=("cnn",), method=2, real_gyros=(3, 6)):
    """The same world, where each of the first six recordings tests in a fold of its own."""
    grid = Grid(method=method, real_gyros=list(real_gyros))
    study = Study(experiment="some", estimators=list(names), sensors={"sparkfun": grid})
    roles = [
        (fold, n, TEST if n == fold + 1 else VALIDATION if n == (fold + 1) % 6 + 1 else TRAIN)
        for fold in range(6)
        for n in range(1, 7)
    ]
    roles = pd.DataFrame(roles, columns=["fold", "recording", "role"])
    return replace(world, study=study, roles=roles, virtual=None)


def train_and_judge(world, as_stored):
    runs = [as_stored(run, f"id{i}") for i, run in enumerate(world.train())]
    given = world.recordings, world.bias, world.allan, world.roles, world.evaluation
    return list(evaluate(world.plan(), runs, *given))


def test_a_recording_that_lost_its_windows_trains_and_tests_no_network(world, as_stored, caplog):
    small = without_windows(one_by_one(world, ["cnn", *ESTIMATORS]), 3)
    networks = small.plan()[lambda cells: cells.estimator == CNN]
    assert set(networks.fold) == {0, 1, 3, 4, 5}
    assert set(networks.folds) == {5}
    assert (
        "some sparkfun, 10 s windows: 10 of 140 lost more than 10% of their samples and are left "
        "out; none is left of IMU 1 recording 3 (and of 1 more), so it trains no network and tests "
        "none"
    ) in caplog.text
    for run in train_and_judge(small, as_stored):
        assert np.isfinite(run.artifacts[ERRORS].error_dps).all()
        assert 3 not in set(run.artifacts[ERRORS].recording)


@pytest.mark.parametrize(
    ("lost", "words"),
    [
        (range(1, 7), "10 s windows: no test recording has one that can be used; lower windows_s"),
        (range(2, 7), "fold 0, 10 s windows: no training recording has one .* lower windows_s"),
    ],
)
def test_without_a_window_to_test_or_to_train_on_a_study_says_so(world, lost, words):
    with pytest.raises(InputError, match=f"some sparkfun.* {words}"):
        without_windows(one_by_one(world), *lost).train()


def test_what_an_imu_beside_lost_changes_no_window_of_the_tested_one(world, as_stored):
    small = one_by_one(world, method=1, real_gyros=[6])
    recordings = small.recordings.copy(deep=True)
    recordings.angular_rate[1, :, :, 200:230] = np.nan
    runs = train_and_judge(replace(small, recordings=recordings), as_stored)
    assert all(np.isfinite(run.metrics["test_rmse_dps_all"]) for run in runs)


def test_errors_in_masked_windows_are_about_what_was_measured(damaged):
    bench = Bench(damaged.recordings, device_of(damaged), (12,), WINDOW_S, damaged.evaluation)
    samples = damaged.recordings.angular_rate.sel(imu=1, recording=12).to_numpy().astype(float)
    errors = bench.mean_errors[bench.mean_errors.truth == PAPER]
    for window, start in enumerate((0, 400, 600, 800)):
        means = np.nanmean(samples[:, start : start + SIZE], axis=1) - np.nanmean(samples, axis=1)
        found = errors.error_dps[errors.window == window]
        np.testing.assert_allclose(found, means, atol=1e-8)
