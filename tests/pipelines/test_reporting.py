from dataclasses import replace

import numpy as np
import pandas as pd
import pytest

from gyro_pipeline.conventions import HOLD_OUT, InputError, Missing
from gyro_pipeline.parameters import Grid, Only, Study
from gyro_pipeline.physics.ceiling import ceiling_rmse, pooled, running_mean_rmse
from gyro_pipeline.pipelines.ground_truth.nodes import measure_allan_variance, measure_noise
from gyro_pipeline.pipelines.reporting.figures import (
    equal_spread,
    gyroscopes_10s,
    input_channels,
    saving_against_turn_on_spread,
    sparkfun_3_real,
    sparkfun_12_real,
    training_data,
)
from gyro_pipeline.pipelines.reporting.figures import (
    estimators as estimators_figure,
)
from gyro_pipeline.pipelines.reporting.nodes import (
    missing_results,
    or_missing,
    pool_measured_elsewhere,
    pool_results,
    refuse_gaps,
)
from gyro_pipeline.pipelines.reporting.signals import (
    allan_deviation,
    calibrated_signal,
    mg_convergence,
    running_average,
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
from gyro_pipeline.studies import CNN, MEAN, Cell, run_params
from gyro_pipeline.tracking import CURVE, ERRORS, StoredRun

WINDOW_S = 10.0
TIMES_S = np.array([1.0, 5.0, 10.0, 20.0, 40.0])
MEAN_RMSE = 0.01 / np.sqrt(TIMES_S)  # of the running mean
CEILINGS = {
    "ceiling_rmse_dps": 0.001,
    "ceiling_time_saving_pct": 78.0,
    "ceiling_accuracy_gain_pct": 66.0,
}


def curve(recordings):
    rows = [
        (recording, "paper", windows, time_s, count * rmse**2, count)
        for recording in recordings
        for windows, count in (("first", 3), ("all", 6))
        for time_s, rmse in zip(TIMES_S, MEAN_RMSE, strict=True)
    ]
    columns = ["recording", "truth", "windows", "time_s", "sum_sq", "count"]
    return pd.DataFrame(rows, columns=columns)


def errors(recordings, scale, seed=0):
    """Two windows of three axes each; what the best epoch and another truth gave is far off."""
    generator = np.random.default_rng([seed, *recordings])
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


@pytest.fixture(scope="module")
def settings(parameters):
    p = parameters()
    return p.training, p.splits, p.virtual_gyros


@pytest.fixture(scope="module")
def make_run(settings):
    def make(run_id, recordings, table, folds=1, started_ms=0, data="data", **cell):
        given = {
            "study": "augmentation",
            "method": 2,
            "sensor": "sparkfun",
            "source": "simulated",
            "real_gyros": 3,
            "virtual_gyros": 0,
            "window_s": WINDOW_S,
            "seed": 0,
            "fold": HOLD_OUT,
            "estimator": CNN,
        }
        made = Cell(**given | cell)
        artifacts = {ERRORS: table, CURVE: curve(recordings)}
        metrics = {f"{n}{s}": v for n, v in CEILINGS.items() for s in ("", "_all")}
        return StoredRun(
            run_id=run_id,
            experiment_id="1",
            study=made.study,
            finished=True,
            started_ms=started_ms,
            params={k: str(v) for k, v in run_params(made, folds, *settings).items()},
            tags={"data_hash": data, "simulated": "1"},
            metrics=metrics | {"test_rmse_dps": 0.1, "test_rmse_dps_all": 0.1},
            load=artifacts.__getitem__,
        )

    return make


@pytest.fixture(scope="module")
def mean(make_run):
    def make(recordings, **changes):
        cell = {"estimator": MEAN, "method": 0, "real_gyros": 0} | changes
        table = errors(recordings, 0.003).query("weights == 'last'")  # it has no epochs
        return make_run("mean", recordings, table, **cell)

    return make


@pytest.fixture(scope="module")
def pool(parameters, settings):
    def make(runs, real=(3,), virtual=(0,), seeds=(0,), source="simulated"):
        grid = Grid(method=2, real_gyros=list(real), virtual_gyros=list(virtual))
        study = Study(experiment="augmentation", sensors={"sparkfun": grid})
        evaluation = parameters().evaluation
        return pool_results(study, source, [WINDOW_S], list(seeds), *settings, evaluation, runs)

    return make


@pytest.fixture(scope="module")
def elsewhere(parameters, settings):
    """Results on measured data of other sources than ``simulated``."""

    def make(runs, seeds=(0,), sensor="sparkfun", real=(3, 6)):
        study = Study(
            experiment="augmentation", sensors={sensor: Grid(method=2, real_gyros=list(real))}
        )
        given = (study, "simulated", [WINDOW_S], list(seeds), *settings, parameters().evaluation)
        return pool_measured_elsewhere(*given, runs)

    return make


def measured(run):
    return replace(run, tags={**run.tags, "simulated": "0"})


# pooling


def test_a_row_pools_the_errors_of_all_folds(make_run, mean, pool):
    folds = [errors([fold + 1], 0.001 * (fold + 1)) for fold in range(5)]
    runs = [
        make_run(f"fold{fold}", [fold + 1], table, folds=5, fold=fold)
        for fold, table in enumerate(folds)
    ]
    means = mean(range(1, 6))
    results, _, _ = pool([*runs, replace(means, params={**means.params, "folds": "5"})])
    row = results[results.estimator == CNN].iloc[0]
    mean_rmse = rmse([means.load(ERRORS)])
    assert row.test_rmse_dps_all == pytest.approx(rmse(folds))
    assert row.test_rmse_dps == pytest.approx(rmse(folds, window=0))
    assert row.mean_rmse_dps_all == pytest.approx(mean_rmse)
    assert row.accuracy_gain_pct_all == pytest.approx(100 * (1 - rmse(folds) / mean_rmse))
    reached = float(np.interp(-rmse(folds), -MEAN_RMSE, TIMES_S))
    assert row.equivalent_time_s_all == pytest.approx(reached)
    assert row.time_saving_pct_all == pytest.approx(100 * (1 - WINDOW_S / reached))
    assert row.test_rmse_dps_all_lo < row.test_rmse_dps_all < row.test_rmse_dps_all_hi
    assert (row.recordings, row.seeds) == (5, 1)
    assert row.run_ids == "fold0 fold1 fold2 fold3 fold4"
    assert pd.isna(row.accuracy_gain_pct_all_seed_sd)


def test_a_row_without_one_of_its_folds_is_missing(make_run, mean, pool):
    runs = [
        make_run(f"fold{fold}", [fold + 1], errors([fold + 1], 1e-3), folds=5, fold=fold)
        for fold in range(4)
    ]
    means = mean(range(1, 6))
    results, _, _ = pool([*runs, replace(means, params={**means.params, "folds": "5"})])
    row = results[results.estimator == CNN].iloc[0]
    assert row.missing == (
        "kedro run --pipeline=augmentation --params=only.sensor=sparkfun,only.window_s=10,"
        "only.real_gyros=3,only.virtual_gyros=0,only.seed=0"
    )


def test_seeds_are_pooled_and_their_spread_is_given(make_run, mean, pool):
    recordings = range(1, 6)
    tables = [errors(recordings, scale) for scale in (0.001, 0.002, 0.004)]
    runs = [make_run(f"seed{seed}", recordings, t, seed=seed) for seed, t in enumerate(tables)]
    results, _, _ = pool([*runs, mean(recordings)], seeds=(0, 1, 2))
    row = results[results.estimator == CNN].iloc[0]
    assert row.test_rmse_dps_all == pytest.approx(rmse(tables))
    gains = [100 * (1 - rmse([table]) / row.mean_rmse_dps_all) for table in tables]
    assert row.accuracy_gain_pct_all_seed_sd == pytest.approx(np.std(gains, ddof=1))
    assert (row.seeds, row.recordings) == (3, 5)


def test_a_row_without_one_of_its_seeds_is_missing(make_run, mean, pool):
    runs = [make_run("seed0", [1, 2], errors([1, 2], 1e-3)), mean([1, 2])]
    results, _, _ = pool(runs, seeds=(0, 1))
    (command,) = results.missing.dropna()
    assert "only.seed" not in command  # one command makes them all


def test_the_newest_run_counts_and_others_do_not(make_run, mean, pool):
    r = [1, 2, 3]
    right = errors(r, 0.001)
    runs = [
        make_run("unfinished", r, errors(r, 1.0), started_ms=9),
        make_run("new", r, right, started_ms=2),
        make_run("old", r, errors(r, 1.0), started_ms=1),
        make_run("elsewhere", r, errors(r, 1.0), started_ms=8, source="other"),
        make_run("longer", r, errors(r, 1.0), started_ms=7),
        mean(r),
    ]
    runs[0] = replace(runs[0], finished=False)
    runs[4] = replace(runs[4], params={**runs[4].params, "epochs": "9999"})
    results, _, _ = pool(runs)
    row = results[results.estimator == CNN].iloc[0]
    assert row.run_ids == "new"
    assert row.test_rmse_dps_all == pytest.approx(rmse([right]))


def test_runs_on_other_data_are_not_pooled(make_run, mean, pool):
    r = [1, 2, 3]
    runs = [
        make_run("now", r, errors(r, 1e-3), started_ms=2),
        make_run("before", r, errors(r, 1e-3), started_ms=1, data="other data", seed=1),
        mean(r),
    ]
    results, _, _ = pool(runs, seeds=(0, 1))
    assert results[results.estimator == CNN].iloc[0].missing is not None


def test_curves_are_those_of_the_running_mean(make_run, mean, pool):
    _, curves, _ = pool([mean([1, 2, 3])])
    for windows in ("first", "all"):
        of = curves[curves.windows == windows]
        np.testing.assert_allclose(of.rmse_dps, MEAN_RMSE)
        np.testing.assert_array_equal(of.time_s, TIMES_S)


def test_runs_that_no_result_uses_are_told_with_the_reason(make_run, mean, pool, caplog):
    caplog.set_level("INFO", logger="gyro_pipeline")
    r = [1, 2, 3]
    runs = [
        make_run("new", r, errors(r, 1e-3), started_ms=2),
        make_run("old", r, errors(r, 1e-3), started_ms=1),
        make_run("wider", r, errors(r, 1e-3)),
        make_run("another seed", r, errors(r, 1e-3), seed=7),
        make_run("unfinished", r, errors(r, 1e-3)),
        mean(r),
    ]
    runs[2] = replace(runs[2], params={**runs[2].params, "hidden": "33"})
    runs[4] = replace(runs[4], finished=False)
    _, _, unused = pool(runs)
    why = dict(zip(unused.run_id, unused.why, strict=True))
    assert why.keys() == {"old", "wider", "another seed"}
    assert why["wider"].startswith("other settings: hidden 33, now ")
    assert why["another seed"] == "not in the study's grid"
    assert why["old"].startswith("a newer run")
    line = "augmentation: 3 older runs with other settings or data are in the store and not used"
    assert line in caplog.text
    caplog.clear()
    assert pool([runs[0], runs[5]])[2].empty
    assert "not used" not in caplog.text


def test_measured_data_of_other_sources_are_pooled_as_far_as_they_are_there(
    make_run, mean, elsewhere
):
    recordings = range(1, 6)
    folds = [
        make_run(f"fold{fold}", [fold + 1], errors([fold + 1], 1e-3), folds=5, fold=fold,
                 source="published")
        for fold in range(5)
    ]  # fmt: skip
    means = mean(recordings, source="published")
    runs = [*folds, replace(means, params={**means.params, "folds": "5"})]
    results = elsewhere([measured(run) for run in runs])
    assert results.estimator.tolist() == [MEAN, CNN]  # none for 6 gyroscopes
    assert results.missing.isna().all()
    row = results.iloc[1]
    assert (row.source, row.simulated, row.folds, row.recordings) == ("published", False, 5, 5)
    # of several seeds those that are there, and no other source that is simulated, too
    assert elsewhere([measured(run) for run in runs], seeds=(0, 1)).seeds.iloc[1] == 1
    assert elsewhere(runs).empty
    assert elsewhere([measured(run) for run in runs[1:]]).estimator.tolist() == [MEAN]
    assert elsewhere([]).columns.tolist()[:2] == ["sensor", "source"]


# tables of results


@pytest.fixture(scope="module")
def published(parameters):
    """The paper's numbers, of its results those of SparkFun."""
    whole = parameters("base").published
    return whole.model_copy(
        update={"results": [row for row in whole.results if row.sensor == "sparkfun"]}
    )


@pytest.fixture
def whole(make_run, mean, pool):
    """Three to twelve real gyroscopes with 0 and 24 virtual ones, and the running mean."""
    recordings = range(1, 9)
    runs = [
        make_run(f"{real}+{virtual}-0123456789", recordings, errors(recordings, 0.002, real),
                 real_gyros=real, virtual_gyros=virtual)
        for real in (3, 9, 12)
        for virtual in (0, 24)
    ]  # fmt: skip
    return pool([*runs, mean(recordings)], real=(3, 9, 12), virtual=(0, 24))


@pytest.fixture
def nothing(elsewhere):
    """Of other sources."""
    return elsewhere([])


@pytest.fixture
def other(whole):
    """The result of three gyroscopes on measured data of another source."""
    row = whole[0][(whole[0].real_gyros == 3) & (whole[0].virtual_gyros == 0)]
    return row.assign(source="published", simulated=False, folds=11)


def test_results_stand_beside_the_published_ones_and_the_ceiling(whole, published):
    results, _, _ = whole
    table = three_gyroscopes(results, published)
    assert table["Approach"].tolist() == ["Real2Real", "(3 Real+Virtual)2Real"]
    assert table["Published S/A %"].tolist() == ["72/57", "84/79"]
    assert table["Ceiling S %"].tolist() == ["78", "78"]
    assert table["Ceiling A %"].tolist() == ["66", "66"]
    assert table["Gyroscopes"].tolist() == ["3 real", "3 real + 24 virtual"]
    row = results[(results.real_gyros == 3) & (results.virtual_gyros == 24)].iloc[0]
    ours = [f"{row[f'accuracy_gain_pct_all{end}']:.0f}" for end in ("", "_lo", "_hi")]
    assert table["A %"][1] == "{} [{}, {}]".format(*ours)
    assert table["Paper's way A %"][1].startswith(f"{row.accuracy_gain_pct:.0f} [")
    assert table["Source"].tolist() == ["simulated", "simulated"]
    assert table["Split"].tolist() == ["hold-out", "hold-out"]
    assert table["Spread of A over seeds"].tolist() == ["–", "–"]
    assert table["Recordings"].tolist() == [8, 8]
    assert table["Runs"].tolist() == ["3+0-0123", "3+24-012"]
    multiple = multiple_gyroscopes(results, published)
    assert multiple["Published S/A %"].tolist() == ["86/88", "84/77"]


def test_the_spread_over_seeds_has_columns_of_its_own(whole, published):
    results, _, _ = whole
    spread = {"time_saving_pct_all_seed_sd": 3.25, "accuracy_gain_pct_all_seed_sd": 1.75}
    table = three_gyroscopes(results.assign(**spread, seeds=5.0), published)
    assert table["Spread of S over seeds"].tolist() == ["3.2", "3.2"]
    assert table["Spread of A over seeds"].tolist() == ["1.8", "1.8"]
    assert table["Seeds"].tolist() == [5, 5]


def test_negative_savings_and_the_ends_of_the_curve_are_printed(whole, published):
    results, _, _ = whole
    three = results.real_gyros == 3
    results.loc[three & (results.virtual_gyros == 0), "time_saving_pct_all"] = -np.inf
    results.loc[three & (results.virtual_gyros == 0), "time_saving_pct"] = -37.4
    results.loc[three & (results.virtual_gyros == 24), "time_saving_pct_all"] = np.inf
    table = three_gyroscopes(results, published)
    assert table["S %"][0].startswith("off the curve [")
    assert table["Paper's way S %"][0].startswith("-37 [")
    assert table["S %"][1].startswith("never reached [")


def test_data_that_are_simulated_or_measured_are_called_so(whole, published):
    results, _, _ = whole
    table = three_gyroscopes(results.assign(source="mine"), published)
    assert set(table["Source"]) == {"mine (simulated)"}
    table = three_gyroscopes(results.assign(source="mine", simulated=False), published)
    assert set(table["Source"]) == {"mine (measured)"}


def test_generalization_has_measured_data_of_other_sources_below(whole, other, nothing, published):
    results, _, _ = whole
    assert len(generalization(results, nothing, published)) == 1
    table = generalization(results, other, published)
    assert table["Source"].tolist() == ["simulated", "published (measured)"]
    assert table["Gyroscopes"].tolist() == ["9 real", "3 real"]
    assert table["Published S/A %"].tolist() == ["82/87", "82/87 (9 real)"]
    assert table["Split"].tolist() == ["hold-out", "k-fold, 11 folds"]
    # of several the one that comes closest, and none with more gyroscopes than the paper's
    more = pd.concat([other, other.assign(real_gyros=6), other.assign(real_gyros=12)])
    assert generalization(results, more, published)["Gyroscopes"].tolist() == ["9 real", "6 real"]


def test_results_of_other_sources_are_listed_last(whole, other):
    results, _, _ = whole
    table = results_table(results, other)
    assert len(table) == len(results) + 1
    assert table.source.iloc[-1] == "published (measured)"
    assert table.split.iloc[-1] == "k-fold, 11 folds"
    none = results.assign(missing="kedro run it")
    assert isinstance(results_table(none, other), Missing)


def test_what_lacks_a_run_is_not_made_and_the_rest_is(whole, published, nothing):
    results, curves, _ = whole
    lacking = (results.real_gyros == 12) & (results.virtual_gyros == 24)
    results["missing"] = np.where(lacking, "kedro run it", None)
    assert isinstance(three_gyroscopes(results, published), pd.DataFrame)
    assert isinstance(generalization(results, nothing, published), pd.DataFrame)
    missing = Missing(("kedro run it",))
    assert multiple_gyroscopes(results, published) == missing
    assert sparkfun_12_real(results, curves, published) == missing
    assert len(results_table(results, nothing)) == len(results) - 1
    assert missing_results(results) == missing.reasons


def test_a_published_result_that_no_study_has_is_refused(whole, published):
    stray = published.results[0].model_copy(update={"real_gyros": 6})
    with pytest.raises(InputError, match=r"'Real2Real' of sparkfun is no cell of its study"):
        three_gyroscopes(whole[0], published.model_copy(update={"results": [stray]}))


# figures of results


def labels(figure):
    return {text.get_text() for text in figure.legends[0].get_texts()}


def test_a_figure_shows_both_ways_with_all_windows_first(whole, published):
    results, curves, _ = whole
    figure = sparkfun_3_real(results, curves, published)
    main, beside = figure.axes
    assert main.get_title().startswith("all windows")
    assert "paper's way" in beside.get_title()
    assert "simulated" in figure.get_suptitle()
    line = next(one for one in main.lines if one.get_label() == "running mean")
    np.testing.assert_allclose(line.get_ydata(), MEAN_RMSE * 1e3)
    drawn = {"running mean", "network, 24 virtual, 95 % interval", "published, 24 virtual"}
    assert drawn <= labels(figure)
    # The published accuracy, on the mean's RMSE of the data at hand.
    row = results[(results.real_gyros == 3) & (results.virtual_gyros == 24)].iloc[0]
    claim = next(one for one in main.lines if one.get_label() == "published, 24 virtual")
    np.testing.assert_allclose(claim.get_ydata(), row.mean_rmse_dps_all * 0.21 * 1e3)


def test_the_methods_are_compared_by_their_number_of_gyroscopes(whole, published):
    results, curves, _ = whole
    real = results[results.virtual_gyros == 0]
    networks = {f"network, {n} real, 95 % interval" for n in (3, 9, 12)}
    two = training_data(real, curves, published)
    assert networks | {"published, 3 real", "published, 12 real"} <= labels(two)
    one = input_channels(real, curves)
    assert networks <= labels(one)
    assert not [label for label in labels(one) if "published" in label]
    assert "Method 1" in one.get_suptitle()
    assert "Method 2" in two.get_suptitle()


def test_bars_have_the_model_based_line_above_them(whole, published):
    results, _, _ = whole
    real = results[results.virtual_gyros == 0]
    main = gyroscopes_10s(real, published).axes[0]
    networks = real[real.estimator == CNN].sort_values("real_gyros")
    heights = [bar.get_height() for bar in main.patches]
    np.testing.assert_allclose(heights, networks.test_rmse_dps_all * 1e3)
    assert [text.get_text() for text in main.get_xticklabels()] == ["3", "9", "12"]
    line = next(one for one in main.lines if str(one.get_label()).startswith("model-based"))
    np.testing.assert_allclose(line.get_ydata(), networks.mean_rmse_dps_all.iloc[0] * 1e3)


def with_ceiling(row, noise, spread, recording_s=87.0):
    """A result whose ceiling is that of known values."""
    times = (WINDOW_S, recording_s, "paper")
    limit = pooled(ceiling_rmse(noise, spread, *times))
    mean = pooled(running_mean_rmse(noise, *times))
    return row.assign(
        recording_s=recording_s,
        ceiling_rmse_dps=limit,
        **{f"ceiling_accuracy_gain_pct{end}": 100 * (1 - limit / mean) for end in ("", "_lo")},
        ceiling_accuracy_gain_pct_hi=100.0 * (1 - limit / mean) + 3,
    )


def test_the_spread_of_a_result_is_the_one_its_ceiling_was_computed_from(whole):
    row = whole[0].tail(1)
    for spread in (3e-5, 3.1e-4, 1e-2):
        known = with_ceiling(row, np.full(3, 0.0033), np.full(3, spread)).iloc[0]
        assert equal_spread(known) == pytest.approx(spread)
        assert equal_spread(known, "_hi") < equal_spread(known, "_lo") == equal_spread(known)
    known = with_ceiling(row, np.full(3, 0.0033), np.zeros(3)).iloc[0]
    assert equal_spread(known) == pytest.approx(0, abs=1e-9)


def test_savings_lie_at_the_spread_of_the_data_and_off_the_figure_are_arrows(
    whole, other, published
):
    results, _, _ = whole
    rows = with_ceiling(results[results.virtual_gyros == 0], np.full(3, 0.0033), np.full(3, 3e-4))
    rows.loc[rows.real_gyros == 12, "time_saving_pct_all"] = -np.inf
    other = with_ceiling(other, np.full(3, 0.005), np.full(3, 1e-3))
    claims = [row for row in published.results if row.table == "generalization"]
    four = published.model_copy(update={"results": claims * 4})
    figure = saving_against_turn_on_spread(rows, other, four)
    points = {container.get_label(): container.lines[0] for container in figure.axes[0].containers}
    assert points["network, 9 real, 95 % interval"].get_xdata() == pytest.approx([0.3])
    (arrow,) = [line for line in points.values() if line.get_marker() == "v"]
    assert arrow.get_ydata() == figure.axes[0].get_ylim()[0]
    label = "network, 3 real, source published (measured), k-fold"
    assert points[label].get_xdata() == pytest.approx([1.0])


# stored data

SENSORS = ("dot", "sparkfun", "ng", "memsense")


@pytest.fixture(scope="module")
def stored(make_recordings, make_roles):
    """Two IMUs of each sensor, ten recordings of which three test; three virtual ones."""
    given = {}
    for seed, sensor in enumerate(SENSORS):
        bias = np.random.default_rng(seed).uniform(-1, 1, (2, 10, 3))
        recordings = make_recordings(bias, 600, 20.0, 0.004, seed)
        recordings.attrs["sensor"] = sensor
        virtual = recordings.isel(imu=[0, 0, 0]).assign_coords(imu=[1, 2, 3])
        given |= {
            f"{sensor}_recordings": recordings,
            f"{sensor}_roles": make_roles(10, test=3, validation=2),
            f"{sensor}_virtual": virtual.assign_attrs(train_recordings=6),
        }
    return given


def hours(stored, published, **changes):
    return dataset_hours(published, **stored | changes).set_index("Dataset")


def test_hours_are_counted(stored, published):
    table = hours(stored, published)
    one, three = table.loc["1"], table.loc["3"]
    # training recordings of all six gyroscopes, test recordings of three, 30 s each
    assert (one["Training recordings"], one["Test recordings"]) == (6 * 7, 3 * 3)
    assert one["Train h"] == pytest.approx(6 * 7 * 30 / 3600, abs=0.0051)
    assert one["Total h"] == pytest.approx((6 * 7 + 3 * 3) * 30 / 3600, abs=0.0051)
    samples = (6 * 7 + 3 * 3) * 600
    ends = f"{samples / 145 / 3600:.2f} to {samples / 130 / 3600:.2f}"
    assert one["At the datasheet's rate h"] == ends
    assert one["Paper's total h"] == 24.65
    assert (three["Training recordings"], three["Test recordings"]) == (9 * 6, 0)
    assert three["Source"].startswith("virtual, from test")
    assert table.loc["2", "Note"].startswith("the text's 400 recordings")
    assert table.loc["all", "Paper's total h"] == 186.6
    assert table.loc["real", "Paper's total h"] == 76.2
    counted = table.loc[["1", "2", "3", "4", "5", "6"], "Training recordings"].sum()
    assert table.loc["all", "Training recordings"] == counted


def test_virtual_recordings_of_an_older_version_are_an_error_that_says_what_to_run(
    stored, published
):
    older = stored["dot_virtual"].copy()
    del older.attrs["train_recordings"]
    command = r"kedro run --pipeline=virtual_gyros --params=only\.sensor=dot"
    with pytest.raises(InputError, match=rf"virtual recordings of dot.*older version.*{command}"):
        hours(stored, published, dot_virtual=older)


def test_a_recording_less_is_hours_less(stored, published):
    before = hours(stored, published)
    shorter = stored["sparkfun_recordings"].drop_sel(recording=1)
    after = hours(stored, published, sparkfun_recordings=shorter)
    gone = before["Training recordings"] - after["Training recordings"]
    assert gone[gone != 0].to_dict() == {"1": 6, "real": 6, "all": 6}
    assert after.loc["1", "Total h"] < before.loc["1", "Total h"]
    # a recording that one IMU lacks
    absent = stored["sparkfun_recordings"].copy(deep=True)
    absent["samples"].loc[{"imu": 2, "recording": 1}] = 0
    after = hours(stored, published, sparkfun_recordings=absent)
    assert after.loc["1", "Training recordings"] == before.loc["1", "Training recordings"] - 3


def test_recordings_of_a_k_fold_count_once_in_the_total(stored, published):
    roles = pd.DataFrame(
        [(f, r, "test" if r == f + 1 else "train") for f in range(10) for r in range(1, 11)],
        columns=["fold", "recording", "role"],
    )
    row = hours(stored, published, ng_roles=roles).loc["5"]
    assert (row["Training recordings"], row["Test recordings"]) == (60, 30)
    assert row["Total h"] == pytest.approx(60 * 30 / 3600, abs=0.0051)


@pytest.fixture(scope="module")
def noise(stored, make_bias):
    given = {}
    for sensor in SENSORS:
        recordings = stored[f"{sensor}_recordings"]
        allan = measure_allan_variance(recordings)
        bias = make_bias(recordings, allan)
        given[f"{sensor}_recordings"] = recordings
        given[f"{sensor}_allan"] = allan
        given[f"{sensor}_noise"] = measure_noise(recordings, allan, bias)
    return given


def test_datasheets_stand_beside_what_was_measured(noise, published):
    table = sensor_specifications(published, **noise).set_index("Sensor")
    dot, ng = table.loc["Movella DOT"], table.loc["NG"]
    assert dot["Datasheet N mdps√s"] == pytest.approx(7 / np.sqrt(2))
    assert dot["Datasheet σ mdps"] == pytest.approx(7 * np.sqrt(20 / 2))
    assert float(dot["N mdps√s"].split()[0]) == pytest.approx(4, rel=0.1)
    assert float(dot["σ mdps"].split()[0]) == pytest.approx(4 * np.sqrt(20), rel=0.03)
    assert dot["Datasheet B deg/h"] == 10
    assert table.loc["SparkFun", "Datasheet rate Hz"] == "130–145"
    assert pd.isna(ng["Datasheet N mdps√s"])
    assert set(table["Source"]) == {"test (measured)"}


def test_signals_are_drawn_from_the_recordings(stored, noise, published, parameters, make_bias):
    recordings, settings = stored["sparkfun_recordings"], parameters().ground_truth
    bias = make_bias(recordings, noise["sparkfun_allan"])
    first = bias.iloc[0]
    average = running_average(recordings, bias, settings)
    assert f"stays within from {first.settling_time_s:.1f} s on" in labels(average)
    signal = calibrated_signal(recordings, bias)
    raw, calibrated = signal.axes[0].lines[:2]
    np.testing.assert_allclose(raw.get_ydata() - calibrated.get_ydata(), first.bias_dps)
    convergence = mg_convergence(recordings, bias, settings)
    titles = [ax.get_title() for ax in convergence.axes]
    assert [title.split()[0] for title in titles] == ["1", "4"]  # there are six
    (average_of_all,) = [
        line for line in convergence.axes[1].lines if line.get_label() == "average of all"
    ]
    assert average_of_all.get_ydata()[-1] == pytest.approx(0, abs=1e-6)  # each is centred
    allan = allan_deviation(published, **noise)
    assert [ax.get_title() for ax in allan.axes][:2] == [
        "Movella DOT; test (measured)",
        "SparkFun; test (measured)",
    ]
    assert "N = " in allan.axes[0].texts[0].get_text()
    for figure in (average, signal, convergence):
        assert "test (measured)" in figure.get_suptitle()


# gaps


def test_a_node_makes_nothing_of_what_is_not_there():
    def make(recordings, bias=None):
        """Say it."""
        return f"{recordings} and {bias}"

    node = or_missing(make)
    assert node("a", bias="b") == ("a and b", ())
    absent = Missing(("make c",))
    assert node(absent, bias="b") == (absent, ("make c",))
    assert node("a", bias=absent) == (absent, ("make c",))
    assert or_missing(lambda: absent)() == (absent, ("make c",))
    assert (node.__name__, node.__doc__) == ("make", "Say it.")


def test_gaps_are_refused_each_command_once():
    with pytest.raises(InputError) as refused:
        refuse_gaps(Only(), (), ("make a", "make b"), ("make a",))
    text = str(refused.value)
    assert text.startswith("2 results or recordings are not there")
    assert text.count("make a") == text.count("make b") == 1


def test_without_gaps_or_when_narrowed_on_purpose_all_is_well(caplog):
    caplog.set_level("INFO", logger="gyro_pipeline")
    refuse_gaps(Only(), (), ())
    assert not caplog.text
    refuse_gaps(Only(seed=0), ("make a",))
    assert "narrowed by only: 1 results" in caplog.text


# estimators without a network


@pytest.fixture
def estimators(make_run, mean, settings, parameters):
    """The running mean and two estimators; one is better than the other in every window."""
    recordings = range(1, 9)
    base = errors(recordings, 0.002)
    tables = {"empirical_bayes": base, "best_linear": base.assign(error_dps=base.error_dps / 2)}
    runs = [
        make_run(name, recordings, table, study="estimators", estimator=name, method=0)
        for name, table in tables.items()
    ]
    runs = [replace(run, metrics={**run.metrics, "coverage_1sigma_all": 0.68}) for run in runs]

    def pooled(runs, unseen=False):
        study = Study(
            experiment="unseen_devices" if unseen else "estimators",
            protocol="leave_one_device_out" if unseen else "by_recording",
            estimators=["mean", *tables],
            windows_s=[WINDOW_S],
            sensors={"sparkfun": Grid(method=2, real_gyros=[3])},
        )
        given = (study, "simulated", [30.0], [0], *settings, parameters().evaluation)
        return pool_results(*given, runs)[0]

    return pooled, [mean(recordings, study="estimators"), *runs]


def test_estimators_are_compared_with_the_mean_and_the_best_linear_one(estimators, nothing):
    pooled, runs = estimators
    results = pooled(runs)
    assert results.estimator.tolist() == ["mean", "empirical_bayes", "best_linear"]
    bayes = results.iloc[1]
    own, mean_rmse = rmse([runs[1].load(ERRORS)]), rmse([runs[0].load(ERRORS)])
    assert bayes.less_mean_dps == pytest.approx(own - mean_rmse)
    assert bayes.less_mean_dps_lo < bayes.less_mean_dps < bayes.less_mean_dps_hi < 0
    assert bayes.less_best_linear_dps == pytest.approx(own / 2)
    table = comparison(results, nothing).set_index("Estimator")
    assert table["Recommended"].tolist() == ["no", "yes", "yes"]
    assert table["Stored prior"].tolist() == ["no", "yes", "yes"]
    assert table["RMSE / running mean's"]["empirical_bayes"] == round(own / 0.1, 3)  # its metric
    assert table["Less running mean mdps"]["mean"] == "–"
    assert table["Less best_linear mdps"]["best_linear"] == "–"
    assert table["Less best_linear mdps"]["empirical_bayes"].startswith(f"{own / 2 / 1e-3:+.3f} [+")
    assert table["Within ±1σ %"]["best_linear"] == 68
    assert pd.isna(table["Within ±1σ %"]["mean"])
    assert (table["Recordings"] == 8).all()


def test_against_the_other_truths_mean_squares_are_compared(estimators, nothing):
    pooled, runs = estimators
    worse = runs[1].load(ERRORS)
    worse.loc[worse.truth == "true", "error_dps"] = 11.0  # the mean's is 9
    results = pooled([runs[0], replace(runs[1], load={ERRORS: worse}.__getitem__), runs[2]])
    bayes = results.iloc[1]
    for name, off in {"mean": 9, "best_linear": 4.5}.items():
        ends = [bayes[f"less_{name}_dps2_true{end}"] for end in ("", "_lo", "_hi")]
        assert ends == pytest.approx(3 * [11**2 - off**2])
    table = comparison(results, nothing).set_index("Estimator")
    shown = table["Less best linear, true bias mdps²"]
    assert shown["empirical_bayes"].startswith("+100750000.000 [+")
    assert shown["best_linear"] == table["Less mean, true bias mdps²"]["mean"] == "–"
    assert set(table["Less mean, outside mdps²"]) == {"–"}  # these runs have no such truth


def test_what_is_there_is_compared_and_the_command_for_the_rest_is_given(estimators, nothing):
    pooled, runs = estimators
    results = pooled(runs[:2])
    (command,) = results.missing.dropna()
    assert command == (
        "kedro run --pipeline=estimators --params=only.sensor=sparkfun,only.window_s=10"
    )
    table = comparison(results, nothing)
    assert table["Estimator"].tolist() == ["mean", "empirical_bayes"]
    assert (table["Less best_linear mdps"] == "–").all()
    assert comparison(pooled([]), nothing) == Missing(tuple([command] * 3))
    assert estimators_figure(results, nothing, "sparkfun") == Missing((command,))


def test_their_errors_relative_to_the_mean_are_a_compact_table(estimators, nothing):
    pooled, runs = estimators
    results = pooled(runs)
    table = ratios(results, nothing, "sparkfun").set_index("Estimator")
    assert table.columns.tolist() == ["Source", "10 s", "Split"]
    names = ["empirical bayes (recommended)", "best linear (recommended)"]
    assert table.index.tolist() == ["running mean, RMSE in mdps", *names, "ceiling"]
    bayes = results.set_index("estimator").loc["empirical_bayes"]
    value, hi, lo = (1 - bayes[f"accuracy_gain_pct_all{end}"] / 100 for end in ("", "_lo", "_hi"))
    assert lo <= value <= hi
    assert table["10 s"].iloc[0] == f"{results.test_rmse_dps_all[0] / 1e-3:.3f}"
    assert table["10 s"].iloc[1] == f"{value:.3f} [{lo:.3f}, {hi:.3f}]"
    assert (table.Split == "hold-out").all()
    elsewhere = results.assign(source="published", simulated=False)
    both = ratios(results, elsewhere, "sparkfun")
    assert both.Source.unique().tolist() == ["simulated", "published (measured)"]
    assert ratios(pooled(runs[:2]), nothing, "sparkfun").Estimator.tolist() == [
        *("running mean, RMSE in mdps", "empirical bayes (recommended)", "ceiling")
    ]
    lacking = pooled([])
    assert ratios(lacking, nothing, "sparkfun") == Missing(tuple(lacking.missing))


def test_unseen_devices_are_called_so_and_are_what_is_resampled(estimators, nothing):
    pooled, runs = estimators

    def of_devices(run):
        by_imu = [run.load(ERRORS).assign(imu=imu) for imu in (1, 2)]
        curve = [run.load(CURVE).assign(imu=imu) for imu in (1, 2)]
        loaded = {ERRORS: pd.concat(by_imu), CURVE: pd.concat(curve)}
        params = {**run.params, "study": "unseen_devices", "folds": "2"}
        return replace(run, study="unseen_devices", params=params, load=loaded.__getitem__)

    results = pooled([of_devices(run) for run in runs], unseen=True)
    assert (results.recordings[1:] == 16).all()
    assert (results.protocol == "leave_one_device_out").all()
    # both devices have the same errors, so that resamples of devices are all alike
    bayes = results.set_index("estimator").loc["empirical_bayes"]
    assert bayes.accuracy_gain_pct_all_lo == pytest.approx(bayes.accuracy_gain_pct_all_hi)
    table = ratios(results, nothing, "sparkfun")
    assert (table.Split == "leave-one-device-out, 2 devices").all()
    title = estimators_figure(results, nothing, "sparkfun").get_suptitle()
    assert title == "sparkfun, unseen devices: error against window length, all windows"


def test_their_figure_has_a_line_for_each_and_the_ceiling(estimators, nothing):
    pooled, runs = estimators
    results = pooled(runs)
    figure = estimators_figure(results, nothing, "sparkfun")
    for ax in figure.axes:
        labels = ax.get_legend_handles_labels()[1]
        best = [f"{name} (recommended)" for name in ("empirical bayes", "best linear")]
        assert labels == ["mean", *best, "ceiling"]
    elsewhere = results.assign(source="published", simulated=False)
    assert len(estimators_figure(results, elsewhere, "sparkfun").axes) == 4


def test_the_papers_network_is_compared_at_its_last_and_its_best_epoch(
    estimators, make_run, settings, parameters, nothing
):
    _, runs = estimators
    recordings = range(1, 9)
    table = errors(recordings, 0.004)  # at the best epoch, 9 deg/s
    network = make_run("network", recordings, table, study="estimators")
    study = Study(
        experiment="estimators",
        estimators=["mean", "best_linear", CNN],
        windows_s=[WINDOW_S],
        sensors={"sparkfun": Grid(method=2, real_gyros=[3])},
    )
    given = (study, "simulated", [WINDOW_S], [0], *settings, parameters().evaluation)
    results = pool_results(*given, [*runs, network])[0].set_index("estimator")
    assert results.index.tolist() == ["mean", "best_linear", "cnn", "cnn_best"]
    assert results.test_rmse_dps_all["cnn"] == pytest.approx(rmse([table]))
    assert results.test_rmse_dps_all["cnn_best"] == pytest.approx(9)
    assert results.less_best_linear_dps["cnn_best"] > results.less_best_linear_dps["cnn"] > 0
    assert comparison(results.reset_index(), nothing)["Recommended"].tolist()[2:] == ["no", "no"]


def test_the_residual_network_has_columns_beside_the_papers(whole, published):
    results, _, _ = whole
    residual = results[results.estimator == CNN].assign(
        estimator="residual_network", method=0, accuracy_gain_pct_all=61.0, run_ids="residual-run"
    )
    both = pd.concat([results, residual], ignore_index=True)
    table = three_gyroscopes(both, published)
    assert [text.split(" ")[0] for text in table["Residual network A %"]] == ["61", "61"]
    assert table["Runs"].tolist() == ["3+0-0123 residual", "3+24-012 residual"]
    assert table["A %"].tolist() == three_gyroscopes(results, published)["A %"].tolist()
    assert set(three_gyroscopes(results, published)["Residual network A %"]) == {"–"}
    both.loc[both.estimator == "residual_network", "missing"] = "make it"
    assert three_gyroscopes(both, published) == Missing(("make it", "make it"))
