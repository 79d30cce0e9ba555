"""From tracked runs and stored recordings with known numbers to results, tables and figures."""

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest

from gyro_pipeline.conventions import InputError, Missing
from gyro_pipeline.parameters import Grid, Only, Study
from gyro_pipeline.physics.ceiling import ceiling_rmse, pooled, running_mean_rmse
from gyro_pipeline.pipelines.ground_truth.nodes import (
    measure_allan_variance,
    measure_bias,
    measure_noise,
)
from gyro_pipeline.pipelines.reporting import figures, signals
from gyro_pipeline.pipelines.reporting.nodes import (
    missing_results,
    or_missing,
    pool_measured_elsewhere,
    pool_results,
    refuse_gaps,
)
from gyro_pipeline.pipelines.reporting.tables import (
    comparison,
    dataset_hours,
    generalization,
    multiple_gyroscopes,
    ratios,
    results_table,
    sensor_specifications,
    three_gyroscopes,
)
from gyro_pipeline.studies import CNN, LEFT_OUT, MEAN, RunSpec, run_params, run_spec
from gyro_pipeline.tracking import CURVE, ERRORS, FINGERPRINT, SCORES, StoredRun

WINDOW_S = 10.0
TIMES_S = np.array([1.0, 5.0, 10.0, 20.0, 40.0])
MEAN_RMSE = 0.01 / np.sqrt(TIMES_S)  # of the running mean
RECORDINGS = range(1, 9)
STORED = {
    "ceiling_rmse_dps": 0.001,
    "ceiling_time_saving_pct": 78.0,
    "ceiling_accuracy_gain_pct": 66.0,
    "coverage_1sigma_pct": 68.0,
    "test_rmse_dps": 0.1,
}
COMMAND = "kedro run --pipeline=augmentation --params=only.sensor=sparkfun,only.window_s=10"


def curve(recordings):
    rows = [
        (recording, "paper", windows, time_s, count * rmse**2, count)
        for recording in recordings
        for windows, count in (("first", 3), ("all", 6))
        for time_s, rmse in zip(TIMES_S, MEAN_RMSE, strict=True)
    ]
    columns = ["recording", "truth", "windows", "time_s", "sum_sq", "count"]
    return pd.DataFrame(rows, columns=columns)


def errors(scale, seed=0, recordings=RECORDINGS):
    """Two windows of three axes each; what the best epoch and another truth gave is far off."""
    generator = np.random.default_rng(seed)
    table = pd.DataFrame(
        [(r, w, a) for r in recordings for w in (0, 1) for a in "xyz"],
        columns=["recording", "window", "axis"],
    ).assign(truth_variance=0.0, truth="paper", weights="last")
    table["error_dps"] = scale * generator.uniform(0.5, 1.5, len(table))
    decoys = [table.assign(weights="best", error_dps=9.0), table.assign(truth="true", error_dps=9)]
    return pd.concat([table, *decoys])


def rmse(tables, window=None):
    kept = pd.concat(tables).query("weights == 'last' and truth == 'paper'")
    kept = kept if window is None else kept[kept.window == window]
    return np.sqrt((kept.error_dps**2).mean())


def scores():
    rows = [("last", "paper", w, n, v) for n, v in STORED.items() for w in ("first", "all")]
    decoy = ("best", "true", "all", "ceiling_rmse_dps", 9.0)
    names = ["weights", "truth", "windows", "score", "value"]
    return pd.DataFrame([*rows, decoy], columns=names).assign(lo=None, hi=None)


def study_of(name="augmentation", estimators=(CNN,), real=(3,), virtual=(0,), **changes):
    grid = Grid(method=2, real_gyros=list(real), virtual_gyros=list(virtual))
    given = {"windows_s": [WINDOW_S], "sensors": {"sparkfun": grid}} | changes
    return Study(experiment=name, estimators=list(estimators), **given)


@pytest.fixture(scope="module")
def settings(parameters):
    p = parameters()
    return p.training, p.splits, p.virtual_gyros, p.evaluation


@pytest.fixture(scope="module")
def make_run(settings):
    """A finished run of a row of a study."""

    def make(run_id, table, study=None, folds=1, started_ms=0, data="data", simulated=1, **row):
        given = {
            "study": "augmentation", "sensor": "sparkfun", "source": "simulated",
            "protocol": "by_recording", "estimator": CNN, "method": 2, "real_gyros": 3,
            "virtual_gyros": 0, "window_s": WINDOW_S, "window_stride_s": WINDOW_S, "seed": 0,
        }  # fmt: skip
        study = study or study_of()
        row = {"study": study.experiment, "protocol": study.protocol} | row
        spec = run_spec(RunSpec(**given | row), study.unseen_devices)
        params = run_params(spec, study, *settings[:3]) | {"folds": folds}
        artifacts = {ERRORS: table, CURVE: curve(RECORDINGS), SCORES: scores()}
        return StoredRun(
            run_id=run_id,
            experiment_id="1",
            study=spec.study,
            finished=True,
            trained=True,
            started_ms=started_ms,
            params={name: str(value) for name, value in params.items()},
            tags={"data_hash": data, "simulated": str(simulated), "fingerprint": run_id},
            metrics={},
            fits=frozenset(),
            load=artifacts.__getitem__,
            load_fit={}.__getitem__,
        )

    return make


@pytest.fixture(scope="module")
def mean(make_run):
    table = errors(0.003).query("weights == 'last'")  # it has no epochs
    return make_run("mean", table, estimator=MEAN)


@pytest.fixture(scope="module")
def pool(settings):
    def make(runs, study=None, seeds=(0,), plan=None):
        given = study or study_of(), "simulated", [30.0], list(seeds), *settings
        plan = Missing(("plan it",)) if plan is None else plan
        return pool_results(*given, sparkfun_runs=runs, sparkfun_plan=plan)

    return make


# pooling


def test_a_result_is_computed_from_the_errors_of_its_run(make_run, mean, pool):
    table = errors(0.002)
    results, curves, _ = pool([make_run("network", table, folds=8), mean])
    row = results[results.estimator == CNN].iloc[0]
    mean_rmse = rmse([mean.load(ERRORS)])
    assert row.test_rmse_dps_all == pytest.approx(rmse([table]))
    assert row.test_rmse_dps == pytest.approx(rmse([table], window=0))
    assert row.mean_rmse_dps_all == pytest.approx(mean_rmse)
    assert row.accuracy_gain_pct_all == pytest.approx(100 * (1 - rmse([table]) / mean_rmse))
    reached = float(np.interp(-rmse([table]), -MEAN_RMSE, TIMES_S))
    assert row.equivalent_time_s_all == pytest.approx(reached)
    assert row.time_saving_pct_all == pytest.approx(100 * (1 - WINDOW_S / reached))
    assert row.test_rmse_dps_all_lo < row.test_rmse_dps_all < row.test_rmse_dps_all_hi
    assert (row.recordings, row.seeds, row.folds, row.run_ids) == (8, 1, 8, "network")
    assert (row.ceiling_rmse_dps_all, row.recording_s) == (0.001, 40)
    assert pd.isna(row.accuracy_gain_pct_all_seed_sd)
    for windows in ("first", "all"):
        np.testing.assert_allclose(curves[curves.windows == windows].rmse_dps, MEAN_RMSE)


def test_seeds_are_pooled_and_their_spread_is_given(make_run, mean, pool):
    tables = [errors(scale) for scale in (0.001, 0.002, 0.004)]
    runs = [make_run(f"seed{seed}", table, seed=seed) for seed, table in enumerate(tables)]
    results, _, _ = pool([*runs, mean], seeds=(0, 1, 2))
    row = results[results.estimator == CNN].iloc[0]
    assert row.test_rmse_dps_all == pytest.approx(rmse(tables))
    gains = [100 * (1 - rmse([table]) / row.mean_rmse_dps_all) for table in tables]
    assert row.accuracy_gain_pct_all_seed_sd == pytest.approx(np.std(gains, ddof=1))
    assert (row.seeds, row.recordings) == (3, 8)
    # without one of them, or with one on other data, the row is missing: one command makes it
    other = replace(runs[2], tags={**runs[2].tags, "data_hash": "other"})
    for there in (runs[:2], [*runs[:2], other]):
        (command,) = pool([*there, mean], seeds=(0, 1, 2))[0].missing.dropna()
        assert command == f"{COMMAND},only.real_gyros=3,only.virtual_gyros=0"


def test_rows_whose_estimator_uses_the_same_part_of_the_training_set_show_one_run(
    make_run, mean, pool
):
    study = study_of(estimators=["residual_network"], real=(3, 12), virtual=(0, 24))
    runs = [
        make_run(f"real{real}", errors(0.001 * real), estimator="residual_network", real_gyros=real)
        for real in (3, 12)
    ]
    results, _, _ = pool([*runs, mean], study, seeds=(0, 1))
    shown = results[results.estimator == "residual_network"]
    assert shown.run_ids.tolist() == ["real3", "real3", "real12", "real12"]
    assert shown.virtual_gyros.tolist() == [0, 24, 0, 24]
    assert (shown.seeds == 1).all()
    assert pool([mean], study, seeds=(0, 1))[0].missing.dropna().nunique() == 4


def test_the_newest_run_with_these_settings_counts_and_of_others_it_is_told_why_not(
    make_run, mean, pool, caplog
):
    caplog.set_level("INFO", logger="gyro_pipeline")
    right, wrong = errors(0.001), errors(1.0)
    runs = [
        replace(make_run("unfinished", wrong, started_ms=9), finished=False),
        make_run("elsewhere", wrong, started_ms=8, source="other"),
        make_run("wider", wrong, started_ms=7),
        make_run("new", right, started_ms=2),
        make_run("old", wrong, started_ms=1),
        make_run("another seed", wrong, seed=7),
        mean,
    ]
    runs[2] = replace(runs[2], params={**runs[2].params, "hidden": "33"})
    results, _, unused = pool(runs)
    row = results[results.estimator == CNN].iloc[0]
    assert row.run_ids == "new"
    assert row.test_rmse_dps_all == pytest.approx(rmse([right]))
    why = dict(zip(unused.run_id, unused.why, strict=True))
    assert why.keys() == {"elsewhere", "old", "wider", "another seed"}
    assert why["wider"].startswith("other settings: hidden 33, now ")
    assert why["another seed"] == "not in the study's grid"
    assert why["old"].startswith("a newer run")
    assert "augmentation: 4 older runs with other settings or data are in" in caplog.text


def test_a_run_that_the_last_plan_has_is_found_by_its_fingerprint(make_run, mean, pool):
    study = study_of(real=(3, 6))
    stale = make_run("stale", errors(1.0), started_ms=9)
    planned_run = make_run("planned", errors(1e-3))
    planned_run = replace(planned_run, params=planned_run.params | {"split_seed": "77"})
    narrowed = make_run("narrowed", errors(1e-3), real_gyros=6)
    plan = plan_of(planned_run, mean)
    results, _, unused = pool([stale, planned_run, narrowed, mean], study, plan=plan)
    assert results.run_ids.tolist() == ["mean", "planned", "narrowed"]
    assert unused.run_id.tolist() == ["stale"]
    results, _, _ = pool([stale, narrowed, mean], study, plan=plan)
    assert results[results.missing.notna()].real_gyros.tolist() == [3]


def plan_of(*runs, left_out=""):
    """A plan as its file gives it back."""
    rows = [{name: run.params[name] for name in RunSpec.names()} for run in runs]
    numbers = {name: int for name in ("method", "real_gyros", "virtual_gyros", "seed")}
    kinds = numbers | dict.fromkeys(("window_s", "window_stride_s"), float)
    keys = {FINGERPRINT: [run.fingerprint for run in runs], LEFT_OUT: left_out or None}
    return pd.DataFrame(rows).astype(kinds).assign(**keys)


def test_what_the_last_plan_left_out_is_no_gap(make_run, mean, pool):
    study = study_of(estimators=["ridge_same_time", CNN])
    lacking = make_run("", errors(1.0), estimator="ridge_same_time")
    plan = plan_of(lacking, left_out="one recording")
    network = make_run("network", errors(1e-3))
    assert pool([network, mean], study)[0].missing.notna().sum() == 1
    results, _, _ = pool([network, mean], study, plan=plan)
    assert results.estimator.tolist() == [MEAN, CNN]
    assert results.missing.isna().all()


def test_a_run_of_the_last_plan_counts_unless_the_settings_are_others_now(make_run, mean, pool):
    network = make_run("network", errors(1e-3))
    plan = plan_of(network, mean)
    # of the splits, what makes no difference to a run may have been another when it was made
    for setting, made in (("fold_validation_recordings", True), ("hidden", False)):
        older = replace(network, params=network.params | {setting: "33"})
        results, _, _ = pool([older, mean], plan=plan)
        assert (results.run_ids == "network").any() == made


def test_measured_data_of_other_sources_are_pooled_as_far_as_they_are_there(
    make_run, mean, settings
):
    study = study_of(real=(3, 6))

    def elsewhere(runs, seeds=(0,)):
        given = study, "simulated", [30.0], list(seeds), *settings
        return pool_measured_elsewhere(*given, runs)

    there = {"source": "published", "simulated": 0, "folds": 5}
    means = make_run("mean", mean.load(ERRORS), estimator=MEAN, **there)
    runs = [make_run("network", errors(1e-3), **there), means]
    results = elsewhere(runs)
    assert results.estimator.tolist() == [MEAN, CNN]  # none for 6 gyroscopes
    assert results.missing.isna().all()
    row = results.iloc[1]
    assert (row.source, row.simulated, row.folds) == ("published", False, 5)
    assert elsewhere(runs, seeds=(0, 1)).seeds.iloc[1] == 1  # those that are there
    simulated = [replace(run, tags={**run.tags, "simulated": "1"}) for run in runs]
    assert elsewhere(simulated).empty
    assert elsewhere([means]).estimator.tolist() == [MEAN]
    assert elsewhere([]).columns.tolist()[:2] == ["sensor", "source"]


# tables and figures of results


@pytest.fixture(scope="module")
def published(parameters):
    """The paper's numbers, of its results those of SparkFun."""
    whole = parameters("base").published
    return whole.model_copy(
        update={"results": [row for row in whole.results if row.sensor == "sparkfun"]}
    )


@pytest.fixture(scope="module")
def pooled_grid(make_run, mean, pool):
    """Three to twelve real gyroscopes with 0 and 24 virtual ones, and the running mean."""
    counts = [(real, virtual) for real in (3, 9, 12) for virtual in (0, 24)]
    runs = [
        make_run(f"{r}+{v}-0123456789", errors(0.002, r), real_gyros=r, virtual_gyros=v)
        for r, v in counts
    ]
    return pool([*runs, mean], study_of(real=(3, 9, 12), virtual=(0, 24)))


@pytest.fixture
def whole(pooled_grid):
    results, curves, _ = pooled_grid
    return results.copy(), curves


@pytest.fixture(scope="module")
def nothing(settings):
    """Of other sources."""
    return pool_measured_elsewhere(study_of(), "simulated", [30.0], [0], *settings, [])


@pytest.fixture
def other(whole):
    """The result of three gyroscopes on measured data of another source."""
    row = whole[0].query("estimator == 'cnn' and real_gyros == 3 and virtual_gyros == 0")
    return row.assign(source="published", simulated=False, folds=11)


def test_results_stand_beside_the_published_ones_and_the_ceiling(whole, published):
    results, _ = whole
    spread = {"time_saving_pct_all_seed_sd": 3.25, "accuracy_gain_pct_all_seed_sd": 1.75}
    table = three_gyroscopes(results.assign(**spread, seeds=5.0), published)
    row = results[(results.real_gyros == 3) & (results.virtual_gyros == 24)].iloc[0]
    ours = [f"{row[f'accuracy_gain_pct_all{end}']:.0f}" for end in ("", "_lo", "_hi")]
    shown = table.iloc[1].to_dict()
    assert (
        shown
        | {
            "Approach": "(3 Real+Virtual)2Real",
            "Published S/A %": "84/79",
            "A %": "{} [{}, {}]".format(*ours),
            "Ceiling S %": "78",
            "Ceiling A %": "66",
            "Gyroscopes": "3 real + 24 virtual",
            "Source": "simulated",
            "Split": "hold-out",
            "Residual network A %": "–",
            "Seeds": 5,
            "Spread of S over seeds": "3.2",
            "Spread of A over seeds": "1.8",
            "Recordings": 8,
            "Runs": "3+24-012",
        }
        == shown
    )
    assert shown["Paper's way A %"].startswith(f"{row.accuracy_gain_pct:.0f} [")
    assert three_gyroscopes(results, published)["Spread of A over seeds"].tolist() == ["–", "–"]
    assert multiple_gyroscopes(results, published)["Published S/A %"].tolist() == ["86/88", "84/77"]
    measured = three_gyroscopes(results.assign(source="mine", simulated=False), published)
    assert set(measured["Source"]) == {"mine (measured)"}


def test_the_residual_network_has_columns_beside_the_papers(whole, published):
    results, _ = whole
    residual = results[results.estimator == CNN].assign(
        estimator="residual_network", accuracy_gain_pct_all=61.0, run_ids="residual-run"
    )
    both = pd.concat([results, residual], ignore_index=True)
    table = three_gyroscopes(both, published)
    assert [text.split(" ")[0] for text in table["Residual network A %"]] == ["61", "61"]
    assert table["Runs"].tolist() == ["3+0-0123 residual", "3+24-012 residual"]
    assert table["A %"].tolist() == three_gyroscopes(results, published)["A %"].tolist()
    both.loc[both.estimator == "residual_network", "missing"] = "make it"
    assert three_gyroscopes(both, published) == Missing(("make it", "make it"))


def test_negative_savings_and_the_ends_of_the_curve_are_printed(whole, published):
    results, _ = whole
    three = (results.real_gyros == 3) & (results.estimator == CNN)
    savings = ["time_saving_pct_all", "time_saving_pct"]
    results.loc[three & (results.virtual_gyros == 0), savings] = [-np.inf, -37.4]
    results.loc[three & (results.virtual_gyros == 24), savings[0]] = np.inf
    table = three_gyroscopes(results, published)
    assert table["S %"][0].startswith("off the curve [")
    assert table["Paper's way S %"][0].startswith("-37 [")
    assert table["S %"][1].startswith("never reached [")


def test_measured_data_of_other_sources_stand_below(whole, other, nothing, published):
    results, _ = whole
    assert len(generalization(results, nothing, published)) == 1
    table = generalization(results, other, published)
    assert table["Source"].tolist() == ["simulated", "published (measured)"]
    assert table["Published S/A %"].tolist() == ["82/87", "82/87 (9 real)"]
    assert table["Split"].tolist() == ["hold-out", "k-fold, 11 folds"]
    # of several the one that comes closest, and none with more gyroscopes than the paper's
    more = pd.concat([other, other.assign(real_gyros=6), other.assign(real_gyros=12)])
    assert generalization(results, more, published)["Gyroscopes"].tolist() == ["9 real", "6 real"]
    listed = results_table(results, other)
    assert len(listed) == len(results) + 1
    assert listed.source.iloc[-1] == "published (measured)"


def test_what_lacks_a_run_is_not_made_and_the_rest_is(whole, published, nothing):
    results, curves = whole
    lacking = (results.real_gyros == 12) & (results.virtual_gyros == 24)
    results["missing"] = np.where(lacking, "kedro run it", None)
    assert isinstance(three_gyroscopes(results, published), pd.DataFrame)
    missing = Missing(("kedro run it",))
    assert multiple_gyroscopes(results, published) == missing
    assert figures.sparkfun_12_real(results, curves, published) == missing
    assert len(results_table(results, nothing)) == len(results) - 1
    assert missing_results(results) == missing.reasons
    assert isinstance(results_table(results.assign(missing="it"), nothing), Missing)


def test_a_published_result_that_no_study_has_is_refused(whole, published):
    stray = published.results[0].model_copy(update={"real_gyros": 6})
    with pytest.raises(InputError, match="'Real2Real' of sparkfun is no row of its study"):
        three_gyroscopes(whole[0], published.model_copy(update={"results": [stray]}))


def labels(figure):
    return {text.get_text() for text in figure.legends[0].get_texts()}


def line(ax, label):
    (found,) = [one for one in ax.lines if str(one.get_label()).startswith(label)]
    return found


@pytest.mark.parametrize(
    ("make", "real", "gain"), [(figures.sparkfun_3_real, 3, 79), (figures.sparkfun_12_real, 12, 77)]
)
def test_a_figure_shows_both_ways_with_all_windows_first(whole, published, make, real, gain):
    results, curves = whole
    figure = make(results, curves, published)
    main, beside = figure.axes
    assert main.get_title().startswith("all windows")
    assert "paper's way" in beside.get_title()
    np.testing.assert_allclose(line(main, "running mean").get_ydata(), MEAN_RMSE * 1e3)
    np.testing.assert_allclose(line(main, "ceiling").get_ydata(), [1.0])
    # The published accuracy, on the mean's RMSE of the data at hand.
    row = results[(results.real_gyros == real) & (results.virtual_gyros == 24)].iloc[0]
    expected = row.mean_rmse_dps_all * (1 - gain / 100) * 1e3
    np.testing.assert_allclose(line(main, "published, 24 virtual").get_ydata(), expected)
    assert {"network, 24 virtual, 95 % interval"} <= labels(figure)


def test_the_methods_are_compared_by_their_number_of_gyroscopes(whole, published):
    results, curves = whole
    real = results[results.virtual_gyros == 0]
    networks = {f"network, {n} real, 95 % interval" for n in (3, 9, 12)}
    two = figures.training_data(real, curves, published)
    assert networks | {"published, 3 real", "published, 12 real"} <= labels(two)
    one = figures.input_channels(real, curves)
    assert networks <= labels(one)
    assert not [label for label in labels(one) if "published" in label]
    main = figures.gyroscopes_10s(real, published).axes[0]
    of_networks = real[real.estimator == CNN].sort_values("real_gyros")
    heights = [bar.get_height() for bar in main.patches]
    np.testing.assert_allclose(heights, of_networks.test_rmse_dps_all * 1e3)
    mean_mdps = of_networks.mean_rmse_dps_all.iloc[0] * 1e3
    np.testing.assert_allclose(line(main, "model-based").get_ydata(), mean_mdps)


def with_ceiling(row, noise, spread, recording_s=87.0):
    """A result whose ceiling is that of known values."""
    times = (WINDOW_S, recording_s, "paper")
    limit = pooled(ceiling_rmse(noise, spread, *times))
    gain = 100 * (1 - limit / pooled(running_mean_rmse(noise, *times)))
    given = {"ceiling_accuracy_gain_pct": gain, "ceiling_accuracy_gain_pct_lo": gain}
    given |= {"ceiling_accuracy_gain_pct_hi": gain + 3, "ceiling_rmse_dps": limit}
    return row.assign(recording_s=recording_s, **given)


def test_savings_lie_at_the_spread_of_the_data_and_off_the_figure_are_arrows(
    whole, other, published
):
    results, _ = whole
    for spread in (3e-5, 1e-2):
        known = with_ceiling(other, np.full(3, 0.0033), np.full(3, spread)).iloc[0]
        assert figures.equal_spread(known) == pytest.approx(spread)
        assert figures.equal_spread(known, "_hi") < figures.equal_spread(known, "_lo")
    rows = results[(results.virtual_gyros == 0) & (results.estimator == CNN)]
    rows = with_ceiling(rows, np.full(3, 0.0033), np.full(3, 3e-4))
    rows.loc[rows.real_gyros == 12, "time_saving_pct_all"] = -np.inf
    other = with_ceiling(other, np.full(3, 0.005), np.full(3, 1e-3))
    claims = [row for row in published.results if row.table == "generalization"]
    four = published.model_copy(update={"results": claims * 4})
    figure = figures.saving_against_turn_on_spread(rows, other, four)
    points = {container.get_label(): container.lines[0] for container in figure.axes[0].containers}
    assert points["network, 9 real, 95 % interval"].get_xdata() == pytest.approx([0.3])
    (arrow,) = [one for one in points.values() if one.get_marker() == "v"]
    assert arrow.get_ydata() == figure.axes[0].get_ylim()[0]
    label = "network, 3 real, source published (measured), k-fold"
    assert points[label].get_xdata() == pytest.approx([1.0])


# estimators beside one another


@pytest.fixture(scope="module")
def compared(make_run, mean, pool):
    """The running mean and three estimators; the results of some of their runs, and the runs."""

    def pooled(runs, protocol="by_recording"):
        name = "estimators" if protocol == "by_recording" else "unseen_devices"
        names = [MEAN, "empirical_bayes", "best_linear", *([CNN] if name == "estimators" else [])]
        return pool(runs, study_of(name, names, protocol=protocol))[0]

    base, study = errors(0.002), study_of("estimators", [MEAN, CNN])
    halved = base.assign(error_dps=base.error_dps / 2)
    worse = base.assign(error_dps=np.where(base.truth == "true", 11.0, base.error_dps))
    tables = {"empirical_bayes": worse, "best_linear": halved, CNN: errors(0.004, 1)}
    runs = [make_run(name, tables[name], study, estimator=name) for name in tables]
    tags = {"uses_prior": "yes", "recommended": "True"}
    runs[:2] = [replace(run, tags=run.tags | tags) for run in runs[:2]]
    means = make_run("mean", mean.load(ERRORS), study, estimator=MEAN)
    return pooled, [means, *runs]


def test_estimators_are_compared_with_the_mean_and_the_best_linear_one(compared, nothing):
    pooled, runs = compared
    results = pooled(runs)
    assert results.estimator.tolist() == [MEAN, "empirical_bayes", "best_linear", CNN, "cnn_best"]
    bayes = results.iloc[1]
    own, mean_rmse = rmse([runs[1].load(ERRORS)]), rmse([runs[0].load(ERRORS)])
    assert bayes.less_mean_dps == pytest.approx(own - mean_rmse)
    assert bayes.less_mean_dps_lo < bayes.less_mean_dps < bayes.less_mean_dps_hi < 0
    assert bayes.less_best_linear_dps == pytest.approx(own / 2)
    # against the other truths, mean squares
    for name, off in {"mean": 9, "best_linear": 4.5}.items():
        ends = [bayes[f"less_{name}_dps2_true{end}"] for end in ("", "_lo", "_hi")]
        assert ends == pytest.approx(3 * [11**2 - off**2])
    # the paper's network at its best epoch has errors of 9 deg/s
    assert results.test_rmse_dps_all.iloc[-1] == pytest.approx(9)
    assert results.test_rmse_dps_all.iloc[-2] == pytest.approx(rmse([runs[3].load(ERRORS)]))
    table = comparison(results, nothing).set_index("Estimator")
    assert table["Recommended"].tolist() == ["no", "yes", "yes", "no", "no"]
    assert table["Stored prior"].tolist() == ["no", "yes", "yes", "no", "no"]
    assert table["Less running mean mdps"]["mean"] == "–"
    assert table["Less best_linear mdps"]["empirical_bayes"].startswith(f"{own / 2 / 1e-3:+.3f} [+")
    shown = table["Less best linear, true bias mdps²"]
    assert shown["empirical_bayes"].startswith("+100750000.000 [+")
    assert shown["best_linear"] == "–"
    assert set(table["Less mean, outside mdps²"]) == {"–"}  # these runs have no such truth
    assert table["Within ±1σ %"]["best_linear"] == 68
    assert table["RMSE / running mean's"]["empirical_bayes"] == round(own / 0.1, 3)  # its score


def test_what_is_there_is_compared_and_the_command_for_the_rest_is_given(compared, nothing):
    pooled, runs = compared
    results = pooled(runs[:2])
    commands = tuple(results.missing.dropna())
    assert commands[0] == COMMAND.replace("augmentation", "estimators")
    table = comparison(results, nothing)
    assert table["Estimator"].tolist() == ["mean", "empirical_bayes"]
    assert (table["Less best_linear mdps"] == "–").all()
    assert ratios(results, nothing, "sparkfun").Estimator.tolist() == [
        *("running mean, RMSE in mdps", "empirical bayes (recommended)", "ceiling")
    ]
    assert figures.estimators(results, nothing, "sparkfun") == Missing(commands)
    assert isinstance(comparison(pooled([]), nothing), Missing)


def test_errors_relative_to_the_mean_are_a_compact_table_and_a_figure(compared, nothing):
    pooled, runs = compared
    results = pooled(runs[:3] + runs[3:])
    results = results[~results.estimator.str.startswith("cnn")]
    elsewhere = results.assign(source="published", simulated=False)
    both = ratios(results, elsewhere, "sparkfun").set_index("Estimator")
    assert both.columns.tolist() == ["Source", "10 s", "Split"]
    assert both.Source.unique().tolist() == ["simulated", "published (measured)"]
    names = ["empirical bayes (recommended)", "best linear (recommended)"]
    table = both[both.Source == "simulated"]
    assert table.index.tolist() == ["running mean, RMSE in mdps", *names, "ceiling"]
    bayes = results.set_index("estimator").loc["empirical_bayes"]
    value, hi, lo = (1 - bayes[f"accuracy_gain_pct_all{end}"] / 100 for end in ("", "_lo", "_hi"))
    assert table["10 s"].tolist()[:2] == [
        f"{results.test_rmse_dps_all[0] / 1e-3:.3f}",
        f"{value:.3f} [{lo:.3f}, {hi:.3f}]",
    ]
    figure = figures.estimators(results, elsewhere, "sparkfun")
    assert len(figure.axes) == 4
    for ax in figure.axes:
        assert ax.get_legend_handles_labels()[1] == ["mean", *names, "ceiling"]


def test_unseen_devices_are_called_so_and_are_what_is_resampled(compared, make_run, nothing):
    pooled, runs = compared
    study = study_of("unseen_devices", [MEAN], protocol="leave_one_device_out")

    def of_devices(run):
        by_imu = [run.load(ERRORS).assign(imu=imu) for imu in (1, 2)]
        name = run.params["estimator"]
        made = make_run(name, pd.concat(by_imu), study, folds=2, estimator=name)
        curves = pd.concat([run.load(CURVE).assign(imu=imu) for imu in (1, 2)])
        loaded = {ERRORS: pd.concat(by_imu), CURVE: curves, SCORES: run.load(SCORES)}
        return replace(made, load=loaded.__getitem__)

    results = pooled([of_devices(run) for run in runs[:3]], "leave_one_device_out")
    assert (results.recordings[1:] == 16).all()
    # both devices have the same errors, so that resamples of devices are all alike
    bayes = results.set_index("estimator").loc["empirical_bayes"]
    assert bayes.accuracy_gain_pct_all_lo == pytest.approx(bayes.accuracy_gain_pct_all_hi)
    table = ratios(results, nothing, "sparkfun")
    assert (table.Split == "leave-one-device-out, 2 devices").all()
    title = figures.estimators(results, nothing, "sparkfun").get_suptitle()
    assert title == "sparkfun, unseen devices: error against window length, all windows"


# stored data

SENSORS = ("dot", "sparkfun", "ng", "memsense")


@pytest.fixture(scope="module")
def stored(make_recordings):
    """Two IMUs of each sensor, ten recordings of which three test; three virtual ones."""
    given = {}
    for seed, sensor in enumerate(SENSORS):
        bias = np.random.default_rng(seed).uniform(-1, 1, (2, 10, 3))
        recordings = make_recordings(bias, 600, 20.0, 0.004, seed)
        recordings.attrs["sensor"] = sensor
        split = np.repeat(["train", "validation", "test"], [5, 2, 3])
        recordings = recordings.assign_coords(split=("recording", split))
        virtual = recordings.isel(imu=[0, 0, 0]).assign_coords(imu=[1, 2, 3])
        given[f"{sensor}_recordings"] = recordings
        given[f"{sensor}_virtual"] = virtual.assign_attrs(train_recordings=6)
    return given


def test_hours_are_counted(stored, published):
    table = dataset_hours(published, **stored).set_index("Dataset")
    one, three = table.loc["1"], table.loc["3"]
    # training recordings of all six gyroscopes, test recordings of three, 30 s each
    assert (one["Training recordings"], one["Test recordings"]) == (6 * 7, 3 * 3)
    assert one["Train h"] == pytest.approx(6 * 7 * 30 / 3600, abs=0.0051)
    assert one["Total h"] == pytest.approx((6 * 7 + 3 * 3) * 30 / 3600, abs=0.0051)
    samples = (6 * 7 + 3 * 3) * 600
    ends = f"{samples / 145 / 3600:.2f} to {samples / 130 / 3600:.2f}"
    assert one["At the datasheet's rate h"] == ends
    assert (three["Training recordings"], three["Test recordings"]) == (9 * 6, 0)
    assert three["Source"].startswith("virtual, from test")
    assert table.loc["2", "Note"].startswith("the text's 400 recordings")
    assert table["Paper's total h"][["1", "real", "all"]].tolist() == [24.65, 76.2, 186.6]
    numbered = table.loc[["1", "2", "3", "4", "5", "6"], "Training recordings"].sum()
    assert table.loc["all", "Training recordings"] == numbered


def test_hours_follow_what_is_there(stored, published):
    def hours(dataset, **changes):
        return dataset_hours(published, **stored | changes).set_index("Dataset").loc[dataset]

    whole = stored["sparkfun_recordings"]
    absent = whole.copy(deep=True)  # a recording that one IMU lacks
    absent["samples"].loc[{"imu": 2, "recording": 1}] = 0
    assert hours("1", sparkfun_recordings=absent)["Training recordings"] == 6 * 7 - 3
    # recordings of a k-fold train and test, and count once in the total
    row = hours("5", ng_recordings=stored["ng_recordings"].drop_vars("split"))
    assert (row["Training recordings"], row["Test recordings"]) == (60, 30)
    assert row["Total h"] == pytest.approx(60 * 30 / 3600, abs=0.0051)
    older = stored["dot_virtual"].copy()
    del older.attrs["train_recordings"]
    command = r"kedro run --pipeline=virtual_gyros --params=only\.sensor=dot"
    with pytest.raises(InputError, match=rf"virtual recordings of dot.*older version.*{command}"):
        hours("3", dot_virtual=older)


def test_datasheets_and_signals_are_shown_from_the_recordings(stored, published, parameters):
    settings, noise, biases = parameters().ground_truth, {}, {}
    for sensor in SENSORS:
        recordings = stored[f"{sensor}_recordings"]
        allan = measure_allan_variance(recordings)
        biases[sensor] = measure_bias(recordings, allan, settings)
        noise[f"{sensor}_recordings"], noise[f"{sensor}_allan"] = recordings, allan
        noise[f"{sensor}_noise"] = measure_noise(recordings, allan, biases[sensor])
    table = sensor_specifications(published, **noise).set_index("Sensor")
    dot = table.loc["Movella DOT"]
    assert dot["Datasheet N mdps√s"] == pytest.approx(7 / np.sqrt(2))
    assert dot["Datasheet σ mdps"] == pytest.approx(7 * np.sqrt(20 / 2))
    assert float(dot["N mdps√s"].split()[0]) == pytest.approx(4, rel=0.1)
    assert float(dot["σ mdps"].split()[0]) == pytest.approx(4 * np.sqrt(20), rel=0.03)
    assert pd.isna(table.loc["NG", "Datasheet N mdps√s"])

    recordings, bias = noise["sparkfun_recordings"], biases["sparkfun"]
    average = signals.running_average(recordings, bias, settings)
    assert f"stays within from {bias.settling_time_s.iloc[0]:.1f} s on" in labels(average)
    raw, calibrated = signals.calibrated_signal(recordings, bias).axes[0].lines[:2]
    np.testing.assert_allclose(raw.get_ydata() - calibrated.get_ydata(), bias.bias_dps.iloc[0])
    convergence = signals.mg_convergence(recordings, bias, settings)
    titles = [ax.get_title() for ax in convergence.axes]
    assert [title.split()[0] for title in titles] == ["1", "4"]  # there are six
    ends = line(convergence.axes[1], "average of all").get_ydata()
    assert ends[-1] == pytest.approx(0, abs=1e-6)  # each is centred
    allan = signals.allan_deviation(published, **noise)
    assert allan.axes[0].get_title() == "Movella DOT; test (measured)"
    assert "N = " in allan.axes[0].texts[0].get_text()


# gaps


def test_a_node_makes_nothing_of_what_is_not_there():
    def make(recordings, bias=None):
        return f"{recordings} and {bias}"

    node = or_missing(make)
    assert node("a", bias="b") == ("a and b", ())
    absent = Missing(("make c",))
    assert node(absent, bias="b") == node("a", bias=absent) == (absent, ("make c",))
    assert or_missing(lambda: absent)() == (absent, ("make c",))


def test_gaps_are_refused_each_command_once_unless_narrowed_on_purpose(caplog):
    caplog.set_level("INFO", logger="gyro_pipeline")
    refuse_gaps(Only(), (), ())
    assert not caplog.text
    with pytest.raises(InputError) as refused:
        refuse_gaps(Only(), (), ("make a", "make b"), ("make a",))
    text = str(refused.value)
    assert text.startswith("2 results or recordings are not there")
    assert text.count("make a") == text.count("make b") == 1
    refuse_gaps(Only(seed=0), ("make a",))
    assert "narrowed by only: 1 results" in caplog.text
