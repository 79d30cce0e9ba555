"""From tracked runs with known errors to results, and from these to tables, figures and words."""

from dataclasses import replace
from io import StringIO
from itertools import product

import numpy as np
import pandas as pd
import pytest

from gyro_pipeline.estimators import ESTIMATORS
from gyro_pipeline.parameters import Grid, Only, Study
from gyro_pipeline.pipelines.reporting.nodes import _explained, write_report
from gyro_pipeline.pipelines.reporting.results import pool_results
from gyro_pipeline.studies import CNN, CONSTANT, LEFT_OUT, MEAN, RunSpec, run_params, run_spec
from gyro_pipeline.tracking import CURVE, ERRORS, FINGERPRINT, SCORES, StoredRun

WINDOW_S = 10.0
pytestmark = pytest.mark.slow
TIMES_S = np.array([1.0, 5.0, 10.0, 20.0, 40.0])
MEAN_RMSE = 0.01 / np.sqrt(TIMES_S)  # of the running mean
RECORDINGS = range(1, 9)
SCORED = {
    **{"ceiling_rmse_dps": 0.001, "ceiling_time_saving_pct": 78.0, "test_rmse_dps": 0.1},
    **{"ceiling_accuracy_gain_pct": 66.0, "oracle_rmse_dps": 0.0011, "beats_oracle_p": 0.5},
    **{"oracle_accuracy_gain_pct": 62.0, "constant_accuracy_gain_pct": 20.0},
    "coverage_1sigma_pct": 68.0,
}


def curve(recordings):
    points = zip(TIMES_S, MEAN_RMSE, strict=True)
    each = product(recordings, (("first", 3), ("all", 6)), points)
    rows = [(r, "paper", windows, t, n * rmse**2, n) for r, (windows, n), (t, rmse) in each]
    columns = ["recording", "truth", "windows", "time_s", "sum_sq", "count"]
    return pd.DataFrame(rows, columns=columns)


def errors(scale, seed=0, best=False):
    """Two windows of three axes each; what the best epoch and another truth gave is far off."""
    generator = np.random.default_rng(seed)
    places = product(RECORDINGS, (0, 1), "xyz")
    table = pd.DataFrame(places, columns=["recording", "window", "axis"])
    table = table.assign(truth_variance=0.0, truth="paper", weights="last")
    table["error_dps"] = scale * generator.uniform(0.5, 1.5, len(table))
    decoys = [table.assign(truth="true", error_dps=9.0)]
    decoys += [table.assign(weights="best", error_dps=9.0)] if best else []
    return pd.concat([table, *decoys])


def rmse(tables, window=None):
    kept = pd.concat(tables).query("weights == 'last' and truth == 'paper'")
    kept = kept if window is None else kept[kept.window == window]
    return np.sqrt((kept.error_dps**2).mean())


def scores(**changes):
    each = product((SCORED | changes).items(), ("first", "all"))
    rows = [("last", "paper", windows, *score) for score, windows in each]
    decoy = ("best", "true", "all", "ceiling_rmse_dps", 9.0)
    names = ["weights", "truth", "windows", "score", "value"]
    return pd.DataFrame([*rows, decoy], columns=names).assign(lo=None, hi=None)


def study_of(name="augmentation", estimators=(CNN,), real=(3,), virtual=(0,), sensor="sparkfun"):
    grid = Grid(method=2, real_gyros=list(real), virtual_gyros=list(virtual))
    given = {"windows_s": [WINDOW_S], "sensors": {sensor: grid}}
    return Study(experiment=name, estimators=list(estimators), **given)


@pytest.fixture(scope="module")
def make_run(parameters):
    """A finished run of a row of a study."""
    base = parameters("base")

    def make(run_id, table, study=None, tags=(), oracle_p=0.5, **row):
        study = study or study_of()
        given = {"study": study.experiment, "sensor": "sparkfun", "source": "simulated"}
        given |= {"protocol": study.protocol, "estimator": CNN, "method": 2, "real_gyros": 3}
        given |= {"virtual_gyros": 0, "window_s": WINDOW_S, "window_stride_s": WINDOW_S, "seed": 0}
        spec = run_spec(RunSpec(**given | row), study.unseen_devices)
        params = run_params(spec, study, base.training, base.splits, base.virtual_gyros)
        artifacts = {ERRORS: table, CURVE: curve(RECORDINGS)}
        artifacts[SCORES] = scores(beats_oracle_p=oracle_p)
        made = {"run_id": run_id, "experiment_id": "7", "study": spec.study, "metrics": {}}
        made |= {"finished": True, "trained": True, "started_ms": 1_700_000_000_000}
        return StoredRun(
            params={name: str(value) for name, value in (params | {"folds": 1}).items()},
            tags={"simulated": "1", FINGERPRINT: run_id, "kedro_env": "smoke", **dict(tags)},
            **{"fits": frozenset(), "load": artifacts.__getitem__, "load_fit": {}.__getitem__},
            **made,
        )

    return make


def test_seeds_are_pooled_additions_paired_and_a_row_without_a_seed_says_so(make_run, mean, pool):
    study = study_of(virtual=(0, 24))
    tables = {(v, s): errors(0.002 - v * 2e-5, 10 + v + s) for v in (0, 24) for s in (0, 1)}
    runs = [make_run(f"{v}-{s}", tables[v, s], study, virtual_gyros=v, seed=s) for v, s in tables]
    pooled = pool([*runs, mean], study, seeds=(0, 1))["results"].set_index("virtual_gyros")
    row, mean_rmse = pooled.loc[24], rmse([mean.load(ERRORS)])
    few, more = (rmse([tables[v, 0], tables[v, 1]]) for v in (0, 24))
    assert row.test_rmse_dps == pytest.approx(more)
    gains = [100 * (1 - rmse([tables[24, s]]) / mean_rmse) for s in (0, 1)]
    assert row.accuracy_gain_pct_seed_sd == pytest.approx(np.std(gains, ddof=1))
    change = 100 * (few - more) / mean_rmse
    assert row.added_virtual_gyros_pct == pytest.approx(change)
    assert row.added_virtual_gyros_pct_lo < change < row.added_virtual_gyros_pct_hi
    plan = plan_of([*runs, mean])
    for there in ([*runs[:3], mean], runs, [*runs[:3], replace(runs[3], finished=False), mean]):
        rows = pool(there, study, seeds=(0, 1), plan=plan)["results"].set_index("virtual_gyros")
        assert rows.status[24] == "not run" and pd.isna(rows.run_ids[24])


@pytest.fixture(scope="module")
def mean(make_run):
    return make_run("mean", errors(0.003), estimator=MEAN)


def plan_of(runs, left_out=None):
    """The plan of some runs, and of others that cannot be made."""
    rows = [{name: run.params[name] for name in RunSpec.names()} for run in runs]
    numbers = {name: int for name in ("method", "real_gyros", "virtual_gyros", "seed")}
    kinds = numbers | dict.fromkeys(("window_s", "window_stride_s"), float)
    keys = {FINGERPRINT: [run.fingerprint for run in runs]}
    keys[LEFT_OUT] = [(left_out or {}).get(run.run_id) for run in runs]
    return pd.DataFrame(rows).astype(kinds).assign(**keys)


@pytest.fixture(scope="module")
def pool():
    def make(runs, study=None, seeds=(0,), plan=None, sensor="sparkfun"):
        given = study or study_of(), "simulated", [30.0], list(seeds), Only()
        stored = {f"{sensor}_plan": plan_of(runs) if plan is None else plan}
        return pool_results(*given, **stored, **{f"{sensor}_runs": runs})

    return make


@pytest.fixture(scope="module")
def write(parameters):
    """The report of some tables, by their addresses."""
    base = parameters("base")

    def make(stored, source="simulated", only=None, **fresh):
        # each as its CSV file gives it back
        texts = {address: table.to_csv(index=False) for address, table in stored.items()}
        how = {"keep_default_na": False, "na_values": [""]}
        loaders = {a: lambda t=text: pd.read_csv(StringIO(t), **how) for a, text in texts.items()}
        given = base.published, base.ground_truth, base.studies, {name: {} for name in base.sensors}
        return write_report(source, only or Only(), *given, loaders, **fresh)

    return make


def stored_as(study, pooled_tables):
    return {f"{study}/{name}": table for name, table in pooled_tables.items()}


def test_a_result_is_computed_from_the_errors_of_its_run(make_run, mean, pool):
    table = errors(0.002, best=True)
    made = pool([make_run("network", table), mean])
    results = made["results"].set_index("estimator")
    row, mean_rmse = results.loc[CNN], rmse([mean.load(ERRORS)])
    assert row.test_rmse_dps == pytest.approx(rmse([table]))
    assert row.test_rmse_dps_first == pytest.approx(rmse([table], window=0))
    assert row.mean_rmse_dps == pytest.approx(mean_rmse)
    assert row.accuracy_gain_pct == pytest.approx(100 * (1 - rmse([table]) / mean_rmse))
    reached = float(np.interp(-rmse([table]), -MEAN_RMSE, TIMES_S))
    assert row.time_saving_pct == pytest.approx(100 * (1 - WINDOW_S / reached))
    assert row.test_rmse_dps_lo < row.test_rmse_dps < row.test_rmse_dps_hi
    assert row.less_mean_dps == pytest.approx(rmse([table]) - mean_rmse)
    assert row.less_mean_dps_lo < row.less_mean_dps < row.less_mean_dps_hi < 0
    assert row.less_mean_dps2_true == 0  # mean squares, where both err by 9
    assert (row.recordings, row.seeds, row.folds, row.run_ids) == (8, 1, 1, "network")
    assert (row.ceiling_rmse_dps, row.recording_s, row.coverage_1sigma_pct) == (0.001, 40, 68)
    assert pd.isna(row.accuracy_gain_pct_seed_sd)
    assert results.loc["cnn_best"].test_rmse_dps == pytest.approx(9)
    curves = made["curves"]
    for windows in ("first", "all"):
        np.testing.assert_allclose(curves[curves.windows == windows].rmse_dps, MEAN_RMSE)


def test_only_runs_of_the_plan_count_and_what_it_left_out_says_why(make_run, mean, pool, caplog):
    caplog.set_level("INFO", logger="gyro_pipeline")
    study = study_of(estimators=[CNN, "ridge_same_time"])
    network = make_run("now", errors(0.001), study)
    ridge = make_run("", errors(0.001), study, estimator="ridge_same_time")
    stale = make_run("before", errors(1.0), study)
    plan = plan_of([network, ridge, mean], {"": "one recording"})
    results = pool([stale, network, mean], study, plan=plan)["results"]
    assert results.run_ids.tolist()[:2] == ["mean", "now"]
    assert results.status.fillna("").tolist() == ["", "", "one recording"]
    assert "augmentation: 1 finished runs with other settings or data" in caplog.text


def test_a_sensor_without_a_row_has_no_result_and_no_curve_of_another(make_run, mean, pool):
    """Not even of the sensor before it, whose rows the filters keep."""
    sensors = {name: study_of().sensors["sparkfun"] for name in ("sparkfun", "dot")}
    study = study_of().model_copy(update={"sensors": sensors})
    given = study, "simulated", [30.0], [0], Only(sensor="sparkfun")
    runs = [make_run("network", errors(0.002)), mean]
    stored = {"sparkfun_plan": plan_of(runs), "sparkfun_runs": runs}
    stored |= {"dot_plan": plan_of(runs)[:0], "dot_runs": []}
    made = pool_results(*given, **stored)
    assert set(made["results"].sensor) == set(made["curves"].sensor) == {"sparkfun"}
    assert len(made["curves"]) == 2 * len(TIMES_S)
    nothing = pool_results(*given, **{name: stored[name] for name in ("dot_plan", "dot_runs")})
    assert nothing["results"].empty and nothing["curves"].empty


def test_results_of_commands_with_params_are_not_part_of_the_report_of_the_source(grid, write):
    narrowed = {f"only.window_s=10/{address}": table for address, table in grid.items()}
    assert write(narrowed)[2] == write({})[2] != write(grid)[2]


def test_results_of_an_earlier_version_are_not_read_as_those_of_this_one(grid, write):
    """There, plain names meant first windows."""
    results = grid["augmentation/results"].copy()
    earlier = results.rename(columns={"test_rmse_dps": "test_rmse_dps_all"})
    page = write({"augmentation/results": earlier})[2]
    assert "There is no finished run with the current settings yet" in page


@pytest.fixture(scope="module")
def grid(make_run, mean, pool):
    """SparkFun's networks of two studies of the paper, a constant and two more estimators."""
    others = {CONSTANT: errors(0.0025, 5), "best_linear": errors(0.0015, 6)}
    others["residual_network"] = errors(0.0016, 7)
    counts = {"augmentation": ((3, 12), (0, 24)), "real2real": ((3, 9), (0,))}
    stored = {}
    for name, (real, virtual) in counts.items():
        study = study_of(name, [CNN, *others], real, virtual)
        runs = [make_run(f"{name} mean", mean.load(ERRORS), study, estimator=MEAN)]
        for r, v in product(real, virtual):
            run_id, counted = f"{r}+{v}-0123456789", {"real_gyros": r, "virtual_gyros": v}
            runs += [make_run(run_id, errors(0.002, r), study, **counted)]
            for kind, table in others.items():
                runs += [make_run(f"{kind}{r}", table, study, estimator=kind, **counted)]
        stored |= stored_as(name, pool(list({r.run_id: r for r in runs}.values()), study))
    return stored


@pytest.fixture(scope="module")
def report(grid, write):
    return write(grid)


def test_results_stand_beside_the_published_ones_and_the_ceiling(grid, report, write):
    results = grid["augmentation/results"]
    row = results[(results.real_gyros == 3) & (results.virtual_gyros == 24)]
    row = row.set_index("estimator").loc[CNN]
    ours = [f"{row[f'accuracy_gain_pct{end}']:.0f}" for end in ("", "_lo", "_hi")]
    table = report[0]["augmentation_three_gyroscopes"]
    expected = {
        **{"Approach": "(3 Real+Virtual)2Real", "Published S/A %": "84/79"},
        **{"A %": "{} [{}, {}]".format(*ours), "Ceiling S %": "78", "Ceiling A %": "66"},
        **{"Gyroscopes": "3 real + 24 virtual", "Source": "simulated", "Split": "hold-out"},
        **{"Seeds": 1, "Spread of A over seeds": "–", "Recordings": 8, "Runs": "3+24-012 residual"},
    }
    assert table.iloc[1].to_dict() | expected == table.iloc[1].to_dict()
    for kind in ("Constant", "Best linear", "Residual network"):
        assert table[f"{kind} A %"][1].endswith("]"), kind
    # of DOT there is no run: its row says so
    absent = table.iloc[2][["Published S/A %", "A %", "Note"]]
    assert absent.tolist() == ["89/85", "–", "not part of this run"]
    general = report[0]["real2real_generalization"]
    assert general["Published S/A %"].tolist() == ["82/87", "89/82", "83/98", "75/75"]
    assert len(report[0]["augmentation_results"]) == 1 + 4 + 3 + 1  # equal runs once
    # a source with fewer gyroscopes stands beside the published row
    results = grid["real2real/results"].query("real_gyros == 3")
    results = results.assign(source="published", simulated=False)
    stored = {"real2real/results": results, "real2real/curves": grid["real2real/curves"]}
    row = write(stored, "published")[0]["real2real_generalization"].iloc[0]
    row = row[["Gyroscopes", "Published S/A %", "Source"]]
    assert row.tolist() == ["3 real", "82/87 (9 real)", "published (measured)"]


def test_the_ends_of_the_curve_and_what_is_beyond_the_ceiling_are_said(grid, write):
    results = grid["augmentation/results"].copy()
    three = (results.real_gyros == 3) & (results.estimator == CNN)
    results.loc[three & (results.virtual_gyros == 0), "time_saving_pct"] = -np.inf
    results.loc[three & (results.virtual_gyros == 24), "time_saving_pct"] = np.inf
    results.loc[three & (results.virtual_gyros == 24), "accuracy_gain_pct_lo"] = 67
    changed = grid | {"augmentation/results": results}
    tables, _, page = write(changed)
    table = tables["augmentation_three_gyroscopes"]
    assert table["S %"][0].startswith("off the curve [")
    assert table["S %"][1].startswith("never reached [")
    assert table["Note"].fillna("").tolist()[:2] == ["", "beyond its ceiling in all windows"]
    assert "Entire 95 % interval above the ceiling: network on sparkfun at 10 s" in page


def test_the_oracle_stands_beside_and_chance_is_called_chance(make_run, mean, pool, write):
    conflict = "test recordings contradict the prior on x (p = 1e-05): turned; the mean gives 3"
    run = make_run("network", errors(0.002, 3), tags={"prior_conflict": conflict})
    made = pool([run, mean])
    row = made["results"].set_index("estimator").loc[CNN]
    own, of_mean = (table.query("axis == 'x'") for table in (errors(0.002, 3), mean.load(ERRORS)))
    gain = 100 * (1 - rmse([own]) / rmse([of_mean]))
    assert row.accuracy_gain_pct_x == pytest.approx(gain)
    made["results"].loc[:, "ceiling_accuracy_gain_pct"] = row.accuracy_gain_pct - 0.1
    tables, figures, page = write(stored_as("augmentation", made))
    table = tables["augmentation_three_gyroscopes"].iloc[0]
    assert table["Oracle A %"] == "62"
    assert "above its ceiling in all windows, which its interval contains" in table["Note"]
    assert table["Note"].endswith(conflict)
    assert f"network on sparkfun at 10 s: {conflict}" in page
    for ax in figures["forest"].axes:
        realised = [one for one in ax.lines if one.get_label() == "oracle"]
        assert {float(one.get_xdata()[0]) for one in realised} == {62}


def points(ax):
    """The first points with each label, of lines and of bars."""
    found = {bars.get_label(): bars.lines[0] for bars in reversed(ax.containers)}
    return found | {str(one.get_label()): one for one in reversed(ax.lines)}


def test_figures_show_both_ways_with_all_windows_first(grid, report):
    figures = report[1]
    results = grid["augmentation/results"]
    row = results[(results.estimator == CNN) & (results.virtual_gyros == 24)].iloc[0]
    for real, gain in ((3, 79), (12, 77)):
        main, beside = figures[f"augmentation_sparkfun_{real}_real"].axes
        assert main.get_title().startswith("all windows")
        assert "paper's way" in beside.get_title()
        lines = points(main)
        shown = {name.partition(",")[0]: one for name, one in lines.items()}
        np.testing.assert_allclose(shown["running mean"].get_ydata(), MEAN_RMSE * 1e3)
        (ceiling,) = [lines[name] for name in lines if name.startswith("ceiling")]
        np.testing.assert_allclose(ceiling.get_ydata(), [1.0])
        # the published accuracy, on the mean's RMSE of the data at hand
        (published,) = [lines[name] for name in lines if name.startswith("published, 24 virtual")]
        expected = row.mean_rmse_dps * (1 - gain / 100) * 1e3
        np.testing.assert_allclose(published.get_ydata(), expected)
        assert "network, 24 virtual, 95 % interval" in lines
    bars = figures["real2real_gyroscopes_10s"].axes[0].patches
    real = grid["real2real/results"].query("estimator == 'cnn'").sort_values("real_gyros")
    np.testing.assert_allclose([bar.get_height() for bar in bars], real.test_rmse_dps * 1e3)
    assert not [name for name in figures if name.startswith(("augmentation_dot", "input"))]


def test_the_forest_has_a_row_for_each_published_result_of_the_sensors(grid, report):
    left, right = report[1]["forest"].axes
    assert [text.get_text() for text in left.get_yticklabels()] == [
        "SparkFun, 3 real", "SparkFun, 3 real + 24 virtual", "SparkFun, 12 real",
        "SparkFun, 12 real + 24 virtual", "SparkFun, 9 real",
    ]  # fmt: skip
    rows = grid["augmentation/results"].query("real_gyros == 3 and virtual_gyros == 0")
    rows = rows.set_index("estimator")
    for ax, suffix in ((left, ""), (right, "_first")):
        for name, estimator in (("network", CNN), ("constant", CONSTANT)):
            gain = rows.loc[estimator][f"accuracy_gain_pct{suffix}"]
            assert points(ax)[name].get_xdata() == pytest.approx([gain])
        published = [one for one in ax.lines if one.get_label() == "published"]
        gains = [float(one.get_xdata()[0]) for one in published]
        assert gains == [57, 79, 88, 77, 87]


def test_what_beats_the_oracle_is_called_a_defect(make_run, mean, pool, write, report):
    run = make_run("network", errors(0.002), oracle_p=1e-6)
    page = write(stored_as("augmentation", pool([run, mean])))[2]
    assert "DEFECT OF THE EVALUATION: 1 beat the oracle" in page
    assert "No estimator beats the oracle" in report[2]


def test_every_estimator_and_its_fixed_options_are_explained():
    explained = dict(_explained(ESTIMATORS))
    assert explained["network"].startswith("The paper's network: convolution")
    assert explained["best linear fallback"].endswith("It allows for a wrong prior.")
    assert len(explained) == len(ESTIMATORS)


def test_what_was_not_made_is_named_with_the_fewest_commands(grid, write, pool, make_run, mean):
    results = grid["augmentation/results"].copy()
    results.loc[results.estimator == CNN, "status"] = "not run"
    page = write(grid | {"augmentation/results": results}, only=Only(sensor="sparkfun"))[2]
    lines = page.partition("### What was not made")[2].strip().splitlines()[2:]
    told = "| kedro run --env=smoke | 4 of 17 results of augmentation, the study input_channels |"
    assert lines == [told]
    assert "- **Narrowed to**: sensor=sparkfun" in page
    untrained = pool([], plan=plan_of([mean, make_run("network", errors(1.0))]))
    tables, _, page = write(stored_as("augmentation", untrained))
    assert tables["augmentation_three_gyroscopes"]["Note"][0] == "not run"
    assert "| kedro run | 2 of 2 results of augmentation, the study real2real" in page
    nothing = write({})
    assert "There is no finished run with the current settings yet" in nothing[2]
    assert nothing[:2] == ({}, {})


def test_a_study_of_ones_own_has_a_figure_and_only_findings_of_its_sensors(make_run, pool, write):
    study = study_of("mine", [MEAN, "best_linear"], sensor="<i>my_own_")
    given, tags = {"study": study, "sensor": "<i>my_own_"}, {"simulated": "0"}
    best_tags = tags | {"recommended": "True"}
    runs = [
        make_run("mean", errors(0.003), estimator=MEAN, tags=tags, **given),
        make_run("best", errors(0.002), estimator="best_linear", tags=best_tags, **given),
    ]
    tables, figures, page = write(stored_as("mine", pool(runs, study, sensor="<i>my_own_")), "logs")
    table = tables["mine_<i>my_own_"]
    assert table["Source"].unique().tolist() == ["logs (measured)"]
    names = ["running mean, RMSE in mdps", "best linear (recommended)", "ceiling"]
    assert table["Estimator"].tolist()[:3] == names
    mean, best = rmse([errors(0.003)]), rmse([errors(0.002)])
    assert table["10 s"][0] == "100.000"  # its score
    assert table["10 s"][1].startswith(f"{best / mean:.3f} [")
    less = tables["mine_comparison"].set_index("Estimator")["Less running mean mdps"]
    assert less["best_linear"].startswith(f"{(best - mean) * 1e3:+.3f}")
    shown = figures["mine_<i>my_own_"].axes[0].get_legend_handles_labels()[1]
    assert shown == ["running mean", "best linear (recommended)", "ceiling", "oracle"]
    assert "published gains" not in page and "SparkFun" not in page.partition("## How")[0]
    assert "<i>" not in page.replace("\\<i\\>", "")
