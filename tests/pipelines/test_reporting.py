from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
from matplotlib.figure import Figure

from gyro_pipeline.conventions import HOLD_OUT, InputError, Missing
from gyro_pipeline.parameters import Grid, Only, Published, Study
from gyro_pipeline.pipelines.reporting.nodes import (
    multiple_gyroscopes,
    pool_results,
    refuse_gaps,
    results_table,
    sparkfun_3_real,
    sparkfun_12_real,
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


# pooling


def test_a_row_pools_the_errors_of_all_folds(make_run, mean, pool):
    folds = [errors([fold + 1], 0.001 * (fold + 1)) for fold in range(5)]
    runs = [
        make_run(f"fold{fold}", [fold + 1], table, folds=5, fold=fold)
        for fold, table in enumerate(folds)
    ]
    means = mean(range(1, 6))
    results, _ = pool([*runs, replace(means, params={**means.params, "folds": "5"})])
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
    results, _ = pool([*runs, replace(means, params={**means.params, "folds": "5"})])
    row = results[results.estimator == CNN].iloc[0]
    assert row.missing == (
        "kedro run --pipeline=augmentation --params=only.sensor=sparkfun,only.window_s=10,"
        "only.real_gyros=3,only.virtual_gyros=0,only.seed=0"
    )


def test_seeds_are_pooled_and_their_spread_is_given(make_run, mean, pool):
    recordings = range(1, 6)
    tables = [errors(recordings, scale) for scale in (0.001, 0.002, 0.004)]
    runs = [make_run(f"seed{seed}", recordings, t, seed=seed) for seed, t in enumerate(tables)]
    results, _ = pool([*runs, mean(recordings)], seeds=(0, 1, 2))
    row = results[results.estimator == CNN].iloc[0]
    assert row.test_rmse_dps_all == pytest.approx(rmse(tables))
    gains = [100 * (1 - rmse([table]) / row.mean_rmse_dps_all) for table in tables]
    assert row.accuracy_gain_pct_all_seed_sd == pytest.approx(np.std(gains, ddof=1))
    assert (row.seeds, row.recordings) == (3, 5)


def test_a_row_without_one_of_its_seeds_is_missing(make_run, mean, pool):
    runs = [make_run("seed0", [1, 2], errors([1, 2], 1e-3)), mean([1, 2])]
    results, _ = pool(runs, seeds=(0, 1))
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
    results, _ = pool(runs)
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
    results, _ = pool(runs, seeds=(0, 1))
    assert results[results.estimator == CNN].iloc[0].missing is not None


def test_curves_are_those_of_the_running_mean(make_run, mean, pool):
    _, curves = pool([mean([1, 2, 3])])
    for windows in ("first", "all"):
        of = curves[curves.windows == windows]
        np.testing.assert_allclose(of.rmse_dps, MEAN_RMSE)
        np.testing.assert_array_equal(of.time_s, TIMES_S)


# tables and figures


@pytest.fixture
def published(parameters):
    rows = [row.model_dump() for row in parameters("base").published]
    return [row for row in rows if row["sensor"] == "sparkfun"]


@pytest.fixture
def whole(make_run, mean, pool):
    """Three and twelve real gyroscopes with 0 and 24 virtual ones, and the running mean."""
    recordings = range(1, 9)
    runs = [
        make_run(f"{real}+{virtual}-0123456789", recordings, errors(recordings, 0.002, real),
                 real_gyros=real, virtual_gyros=virtual)
        for real in (3, 12)
        for virtual in (0, 24)
    ]  # fmt: skip
    return pool([*runs, mean(recordings)], real=(3, 12), virtual=(0, 24))


def test_results_stand_beside_the_published_ones_and_the_ceiling(whole, published):
    results, _ = whole
    table, reasons = three_gyroscopes(results, published)
    assert reasons == ()
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
    assert table["Spread of A over seeds"].tolist() == ["–", "–"]
    assert table["Recordings"].tolist() == [8, 8]
    assert table["Runs"].tolist() == ["3+0-0123", "3+24-012"]
    multiple, _ = multiple_gyroscopes(results, published)
    assert multiple["Published S/A %"].tolist() == ["86/88", "84/77"]


def test_negative_savings_and_the_ends_of_the_curve_are_printed(whole, published):
    results, _ = whole
    three = results.real_gyros == 3
    results.loc[three & (results.virtual_gyros == 0), "time_saving_pct_all"] = -np.inf
    results.loc[three & (results.virtual_gyros == 0), "time_saving_pct"] = -37.4
    results.loc[three & (results.virtual_gyros == 24), "time_saving_pct_all"] = np.inf
    table, _ = three_gyroscopes(results, published)
    assert table["S %"][0].startswith("off the curve [")
    assert table["Paper's way S %"][0].startswith("-37 [")
    assert table["S %"][1].startswith("never reached [")


def test_data_that_are_simulated_are_called_so(whole, published):
    results, _ = whole
    table, _ = three_gyroscopes(results.assign(source="mine"), published)
    assert set(table["Source"]) == {"mine (simulated)"}
    table, _ = three_gyroscopes(results.assign(source="mine", simulated=False), published)
    assert set(table["Source"]) == {"mine"}


def test_what_lacks_a_run_is_not_made_and_the_rest_is(whole, published):
    results, curves = whole
    lacking = (results.real_gyros == 12) & (results.virtual_gyros == 24)
    results["missing"] = np.where(lacking, "kedro run it", None)
    made, reasons = three_gyroscopes(results, published)
    assert isinstance(made, pd.DataFrame)
    assert reasons == ()
    missing = Missing(("kedro run it",))
    assert multiple_gyroscopes(results, published) == (missing, missing.reasons)
    assert sparkfun_12_real(results, curves, published) == (missing, missing.reasons)
    table, reasons = results_table(results)
    assert len(table) == len(results) - 1
    assert reasons == missing.reasons


def test_a_figure_shows_both_ways_with_all_windows_first(whole, published):
    results, curves = whole
    figure, reasons = sparkfun_3_real(results, curves, published)
    assert isinstance(figure, Figure)
    assert reasons == ()
    main, beside = figure.axes
    assert main.get_title().startswith("all windows")
    assert "paper's way" in beside.get_title()
    assert "simulated" in figure.get_suptitle()
    line = next(one for one in main.lines if one.get_label() == "running mean")
    np.testing.assert_allclose(line.get_ydata(), MEAN_RMSE * 1e3)
    drawn = {text.get_text() for text in figure.legends[0].get_texts()}
    assert {"running mean", "network, 24 virtual, 95 % interval", "published, 24 virtual"} <= drawn
    # The published accuracy, on the mean's RMSE of the data at hand.
    row = results[(results.real_gyros == 3) & (results.virtual_gyros == 24)].iloc[0]
    claim = next(one for one in main.lines if one.get_label() == "published, 24 virtual")
    np.testing.assert_allclose(claim.get_ydata(), row.mean_rmse_dps_all * 0.21 * 1e3)


def test_a_published_result_that_no_study_has_is_refused(whole, published):
    stray = Published(**published[0]).model_copy(update={"real_gyros": 9})
    with pytest.raises(InputError, match=r"'Real2Real' of sparkfun is no cell of its study"):
        three_gyroscopes(whole[0], [stray.model_dump()])


# gaps


def test_gaps_are_refused_each_command_once():
    with pytest.raises(InputError) as refused:
        refuse_gaps(Only(), (), ("make a", "make b"), ("make a",))
    text = str(refused.value)
    assert text.startswith("2 results have no finished runs")
    assert text.count("make a") == text.count("make b") == 1


def test_without_gaps_or_when_narrowed_on_purpose_all_is_well(caplog):
    caplog.set_level("INFO", logger="gyro_pipeline")
    refuse_gaps(Only(), (), ())
    assert not caplog.text
    refuse_gaps(Only(seed=0), ("make a",))
    assert "narrowed by only: 1 results" in caplog.text
