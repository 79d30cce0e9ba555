"""The commands of the README, on the smoke environment and on the real Memsense file."""

import re
import shutil
from collections import Counter
from itertools import product
from pathlib import Path

import mlflow.pyfunc
import numpy as np
import pandas as pd
import pytest
import xarray as xr
from mlflow import MlflowClient

from gyro_pipeline.estimators import ORIENTATION_NOTE

SMOKE = ("--pipeline=augmentation", "--env=smoke")
REPORT = "data/08_reporting/simulated_smoke"
PAGE = f"{REPORT}/report"
ROW = ["sensor", "estimator", "real_gyros", "virtual_gyros", "window_s"]
METRICS = {
    *("rmse_mdps", "mean_rmse_mdps", "ceiling_rmse_mdps", "accuracy_gain_pct"),
    *("accuracy_gain_pct_lo", "accuracy_gain_pct_hi", "time_saving_pct", "equivalent_time_s"),
    *("accuracy_gain_pct_first", "time_saving_pct_first"),
}
TABLES = {
    *("augmentation_results", "augmentation_three_gyroscopes", "augmentation_multiple_gyroscopes"),
    *("recording_quality", "start_up", "sensor_specifications", "dataset_hours"),
}
FIGURES = {
    *("forest", "drift", "allan_deviation", "running_average", "calibrated_signal"),
    *("mg_convergence", "augmentation_sparkfun_3_real", "augmentation_sparkfun_12_real"),
    *("augmentation_dot_3_real", "augmentation_dot_12_real"),
}
LARGEST = """
import numpy as np
from gyro_pipeline.conventions import ALL
from gyro_pipeline.estimators.base import Estimator

class Largest(Estimator):
    "Says how many IMUs it was fitted to."
    uses = ALL
    def _fit(self, training):
        self.imus = len(training.imus)
    def _estimate(self, windows):
        return self.imus, np.nan
"""
UP_TO_DATE = r"(\d+) of (\d+) nodes are up to date and not run again \((.*)\)"


def report(project):
    return {path.removeprefix(f"{REPORT}/"): b for path, b in project.files(REPORT).items()}


def row(run):
    return tuple(run.data.params[name] for name in ROW)


def the_run(runs, *wanted):
    (found,) = [run for run in runs if row(run) == wanted]
    return found


def identities(runs):
    return {run.info.run_id: (run.info.start_time, run.info.end_time) for run in runs}


def test_rows_whose_estimator_uses_the_same_training_set_are_one_run_that_says_what_made_it(smoke):
    assert smoke.done.code == 0, smoke.done.output
    last = smoke.done.output.strip().splitlines()[-4:]
    for line, words in zip(last, (REPORT, f"{PAGE}.html", "mlflow ui", "kedro viz"), strict=True):
        assert words in line
    assert "Traceback" not in smoke.done.output
    sensors = ("sparkfun", "dot")
    assert Counter(map(row, smoke.runs)) == Counter([
        *product(sensors, ["cnn"], ("3", "12"), ("0", "12", "24"), ["10.0"]),
        *product(sensors, ["residual_network"], ("3", "12"), ["0"], ["10.0"]),
        *product(sensors, ["mean", "training_mean", "best_linear"], ["3"], ["0"], ["10.0"]),
    ])  # fmt: skip
    for run in smoke.runs:
        params, tags, network = run.data.params, run.data.tags, row(run)[1] == "cnn"
        assert run.info.status == "FINISHED"
        assert ("virtual_seed" in params) == (params["virtual_gyros"] != "0")
        assert ("stop_below" in params) == network
        fixed = {"study": "augmentation", "source": "simulated_smoke", "method": "2", "folds": "1"}
        assert params.items() >= fixed.items()
        names = METRICS | ({"train_loss", "val_loss"} if network else {"coverage_95_pct"})
        assert names - {"equivalent_time_s"} <= set(run.data.metrics) <= names
        no_time = {"equivalent_time_s"} - set(run.data.metrics)  # it is said why
        assert no_time == {"equivalent_time_s"} & set(tags)
        assert (tags["kedro_env"], tags["simulated"], tags["layout"]) == ("smoke", "1", "3")
        keys = f"{tags['lock_hash']} {tags['fingerprint']}"
        assert re.fullmatch(r"[0-9a-f]{16} [0-9a-f]{16}", keys)
        assert {"kedro_run", "git_dirty", "mlflow.source.git.commit", "data_hash"} <= set(tags)
        assert {"torch", "numpy", "python", "mlflow.user", "mlflow.source.name"} <= set(tags)
        for part in (*row(run)[:2], f"{float(params['window_s']):g} s"):
            assert part in tags["mlflow.runName"]


def test_the_model_of_a_run_makes_the_errors_that_it_was_judged_by(smoke, monkeypatch):
    monkeypatch.setenv("MLFLOW_TRACKING_URI", f"sqlite:///{smoke.project.store}")
    run = the_run(smoke.runs, "dot", "cnn", "12", "0", "10.0")
    model = mlflow.pyfunc.load_model(f"runs:/{run.info.run_id}/model")
    errors = pd.read_parquet(smoke.project.artifacts(run) / "errors.parquet")
    last = errors[(errors.truth == "paper") & (errors.weights == "last")]
    path = smoke.project.folder / "data/02_intermediate/simulated_smoke/dot/recordings.nc"
    with xr.open_dataset(path) as recordings:
        rates, rate_hz = recordings.angular_rate.sel(imu=1), recordings.attrs["rate_hz"]
        size = round(10 * rate_hz)
        for (number, start), rows in last.groupby(["recording", "start"]):
            whole = rates.sel(recording=number).to_numpy().astype(float)
            asked = {"target": "recording_mean", "start_s": [start / rate_hz]}
            bias = model.predict(whole[None, :, start : start + size], asked)["bias_dps"][0]
            expected = rows.set_index("axis").error_dps[list("xyz")]
            assert bias - whole.mean(axis=-1) == pytest.approx(expected, abs=1e-8)


def test_the_report_says_what_was_run_links_its_runs_and_compares_with_the_paper(smoke):
    project = smoke.project
    written = {f"tables/{name}.{kind}" for name in TABLES for kind in ("csv", "md", "tex")}
    written |= {f"figures/{name}.{kind}" for name in FIGURES for kind in ("png", "svg")}
    assert set(report(project)) == written | {"report.html", "report.md"}
    assert not [path for path in project.files() if Path(path).name.startswith(".")]
    html, text = ((project.folder / f"{PAGE}.{suffix}").read_text() for suffix in ("html", "md"))
    (experiment,) = {run.info.experiment_id for run in smoke.runs}
    for page in (html, text):
        assert "This is a smoke run, not a result." in page
        assert "7 of 8 published gains on these sensors exceed" in page
        assert f"127.0.0.1:5000/#/experiments/{experiment}/runs" in page
    assert html.count("data:image/png") == len(FIGURES)
    every = (project.folder / "data/08_reporting/report.html").read_text()
    assert 'href="simulated_smoke/report.html"' in every
    results = (project.folder / REPORT / "tables/augmentation_results.csv").read_text()
    assert all(run.info.run_id[:8] in results for run in smoke.runs)
    three, multiple = (
        pd.read_csv(project.folder / REPORT / "tables" / f"augmentation_{name}.csv")
        for name in ("three_gyroscopes", "multiple_gyroscopes")
    )
    assert three["Published S/A %"].tolist() == ["72/57", "84/79", "89/85"]
    assert multiple["Published S/A %"].tolist() == ["86/88", "84/77", "88/80"]
    assert multiple["Ceiling S %"].astype(str).str.fullmatch(r"\d+").all()  # exact: no interval
    columns = {"cnn": "A %", "residual_network": "Residual network A %"}
    for run_id, (estimator, column) in zip(three["Runs"][0].split(), columns.items(), strict=True):
        run = the_run(smoke.runs, "sparkfun", estimator, "3", "0", "10.0")
        assert run.info.run_id.startswith(run_id)
        ends = [f"{run.data.metrics[f'accuracy_gain_pct{end}']:.0f}" for end in ("", "_lo", "_hi")]
        assert three[column][0] == "{} [{}, {}]".format(*ends)


def test_reporting_trains_nothing_and_says_in_rows_what_is_missing(smoke, smoke_copy):
    run = the_run(smoke.runs, "dot", "cnn", "12", "24", "10.0")
    MlflowClient(f"sqlite:///{smoke_copy.store}").delete_run(run.info.run_id)
    (smoke_copy.folder / "data/02_intermediate/simulated_smoke/dot/recordings.nc").unlink()
    only = "--params=only.sensor=dot,only.real_gyros=12"
    done = smoke_copy.command("--pipeline=reporting", "--env=smoke", only)
    assert done.code == 0, done.output
    assert len(smoke_copy.runs("augmentation")) == len(smoke.runs) - 1
    name = "tables/augmentation_multiple_gyroscopes.csv"
    (path,) = (smoke_copy.folder / REPORT).glob(f"only*/{name}")
    notes = pd.read_csv(path)["Note"].fillna("")
    assert notes.str.contains("not run").tolist() == [False, False, True]
    page = (path.parents[1] / "report.md").read_text()
    assert "| kedro run --env=smoke |" in page.partition("### What was not made")[2]


def test_another_setting_trains_anew_and_a_whole_run_shares_what_a_study_has(smoke, smoke_copy):
    smoke_copy.amend("smoke", studies={"real2real": {"estimators": ["cnn"]}})
    only = "only.sensor=sparkfun,only.window_s=10,only.real_gyros=3"
    whole = smoke_copy.command("--env=smoke", f"--params={only}")
    assert whole.code == 0, whole.output
    assert identities(smoke_copy.runs("augmentation")) == identities(smoke.runs)
    for study in ("real2real", "input_channels"):
        line = f"{study} sparkfun: 2 runs planned, 0 skipped (made before), 2 shared with another"
        assert line in whole.output
    for name in ("real2real_results", "real2real_generalization", "input_channels_results"):
        assert [path for path in report(smoke_copy) if path.endswith(f"tables/{name}.csv")]
    twins = {run.data.tags["fingerprint"]: run for run in smoke.runs}
    others = smoke_copy.runs("real2real") + smoke_copy.runs("input_channels")
    assert {run.info.status for run in others} == {"FINISHED"}
    for run in others:
        twin = twins[run.data.tags["fingerprint"]]
        assert row(run) == row(twin)
        assert run.data.metrics == pytest.approx(twin.data.metrics, rel=1e-4)
        if run.data.params["estimator"] == "cnn":
            assert smoke_copy.weights(run) == smoke.project.weights(twin)
    # another hyper-parameter
    changed = f"--params=training.hidden=33,{only},only.virtual_gyros=0"
    done = smoke_copy.command(*SMOKE, changed)
    assert done.code == 0, done.output
    assert "5 runs planned, 4 skipped" in done.output
    before, runs = identities(smoke.runs), smoke_copy.runs("augmentation")
    assert before.items() <= identities(runs).items()
    (new,) = [run for run in runs if run.info.run_id not in before]
    assert (new.data.params["hidden"], *row(new)) == ("33", "sparkfun", "cnn", "3", "0", "10.0")
    # it has a report of its own, and leaves that of the study
    written = report(smoke_copy)
    assert report(smoke.project).items() <= written.items()
    (own,) = [path for path in written if "virtual_gyros=0" in path and "_results.csv" in path]
    shown = [run for run in runs if run.info.run_id[:8] in written[own].decode()]
    assert [run for run in shown if run.data.params["estimator"] == "cnn"] == [new]
    assert f"{own.partition('/')[0]}/report.html" in done.output


def test_an_estimator_of_ones_own_is_trained_and_only_changes_run_again(new_project, monkeypatch):
    project = new_project()
    (project.folder / "src/of_a_stranger.py").write_text(LARGEST)
    asked = {
        "studies": {"augmentation": {"estimators": ["of_a_stranger:Largest"]}},
        "training": {"epochs": 1},
        "only": {"sensor": "sparkfun", "window_s": 30},
        "execution": {"executor": "serial"},
    }

    def run(pipeline="augmentation", **changes):
        return project.run_here(pipeline, "smoke", changed_only=True, **asked | changes)

    done = run()
    assert done.code == 0, done.output
    runs = project.runs("augmentation")
    own = [run for run in runs if run.data.params["estimator"] != "mean"]
    names = ("real_gyros", "virtual_gyros")
    counts = {run.info.run_id: tuple(int(run.data.params[name]) for name in names) for run in own}
    assert Counter(counts.values()) == Counter(product((3, 12), (0, 12, 24)))
    monkeypatch.setenv("MLFLOW_TRACKING_URI", f"sqlite:///{project.store}")
    for run_id, (real, virtual) in counts.items():
        model = mlflow.pyfunc.load_model(f"runs:/{run_id}/model")
        said = model.predict(np.zeros((1, 3, 450)))["bias_dps"]
        assert said.tolist() == [[(real + virtual) / 3] * 3]
    monkeypatch.delenv("MLFLOW_TRACKING_URI")
    # nothing changed
    states = project.files()
    left, nodes, _ = re.search(UP_TO_DATE, run("virtual_gyros").output).groups()
    assert left == nodes
    assert project.files() == states
    # a damaged file is made again, and the run says so
    bias = project.folder / "data/03_primary/simulated_smoke/sparkfun/bias.csv"
    bias.write_bytes(bias.read_bytes().replace(b"1", b"2", 1))
    mended = run("virtual_gyros").output
    assert "sparkfun.ground_truth.bias: missing, damaged or changed" in mended
    assert re.search(UP_TO_DATE, mended)
    again = run().output  # tables that lack runs are tried
    assert re.search(UP_TO_DATE, again)
    assert "runs planned" not in again
    assert "runs evaluated" not in again
    assert identities(project.runs("augmentation")) == identities(runs)
    # a setting of one stage changed, which changes the truth and no training
    other = run(ground_truth={"tolerance_mdps": 6.0})
    assert other.code == 0, other.output
    stages = re.search(UP_TO_DATE, other.output)[3].split(", ")
    assert "raw_logs" in stages
    assert "evaluation" not in stages
    assert f"{len(runs)} skipped (made before)" in other.output
    assert f"sparkfun: {len(runs)} runs evaluated, 0 skipped" in other.output
    # a node that is named is run
    before = bias.stat().st_mtime_ns
    node = "--nodes=ground_truth.bias_sparkfun"
    named = project.command("--pipeline=ground_truth", "--env=smoke", node)
    assert named.code == 0, named.output
    assert bias.stat().st_mtime_ns > before


def test_the_real_file_has_known_errors_and_stands_beside_the_simulated_one(smoke_copy, real_file):
    project, raw = smoke_copy, smoke_copy.folder / "data/01_raw/published"
    raw.mkdir(parents=True)
    shutil.copy(real_file("memsense_test_real.npy"), raw)
    known = ["mean", "training_mean", "empirical_bayes", "best_linear"]
    studies = {"estimators": {"windows_s": [10], "estimators": known}}
    studies["real2real"] = {"estimators": ["cnn"]}
    few = {"training": {"epochs": 2}, "only": {"window_s": 10}, "execution": {"executor": "serial"}}
    few |= {"splits": {"validation_recordings": 2}, "studies": studies}  # as on the simulated ones

    def run(pipeline, env="memsense_real"):
        done = project.run_here(pipeline, env, changed_only=True, **few)
        assert done.code == 0, done.output
        stored = [run for run in project.runs(pipeline) if run.data.params["source"] == "published"]
        return {run.data.params["estimator"]: run for run in stored}

    # all folds are one run, whose model is fitted to all recordings
    runs = run("real2real")
    assert set(runs) == {"mean", "cnn"}
    for one in runs.values():
        params, tags = one.data.params, one.data.tags
        assert one.info.status == "FINISHED"
        assert (params["sensor"], params["folds"], tags["simulated"]) == ("memsense", "11", "0")
        assert tags["model_fold"] == "all recordings"
        assert "fitted once more, to all recordings" in tags["mlflow.note.content"]
    assert f"{runs['mean'].data.metrics['rmse_mdps']:.4f}" == "1.5083"
    # what estimators without a network reach
    estimated = run("estimators")
    assert set(estimated) == set(known)
    rmse = {name: run.data.metrics["rmse_mdps"] for name, run in estimated.items()}
    assert f"{rmse['training_mean']:.4f}" == "1.4536"
    assert 0.53 < rmse["empirical_bayes"] / rmse["mean"] <= 0.72
    assert 0.53 < rmse["best_linear"] / rmse["mean"] <= 0.72
    assert 88 <= estimated["best_linear"].data.metrics["coverage_95_pct"] <= 99
    # in the report of its source
    (path,) = (project.folder / "data/08_reporting").glob("published/*/tables/real2real_gen*.csv")
    assert ORIENTATION_NOTE in (path.parents[1] / "report.md").read_text()
    measured = pd.read_csv(path, dtype={"Runs": str}).iloc[-1]  # an id may have digits only
    assert (measured["Sensor"], measured["Published S/A %"]) == ("memsense", "75/75 (6 real)")
    assert measured["Runs"] == runs["cnn"].info.run_id[:8]


FEW = {"strides_s": [10], "folds": 2, "training": {"steps": 4}, "recordings": 4}
BY_RECORDING = [("k_fold", name) for name in ("mean", "training_mean", "cnn", "cnn_shuffled")]
WAYS = {
    **dict.fromkeys(BY_RECORDING, 3),  # of fits: two folds, and all recordings
    **dict.fromkeys((("window_split", "cnn"), ("best_epoch_on_test", "cnn")), 2),
    ("test_in_training", "cnn"): 1,
}


def test_each_way_of_training_of_the_leak_study_is_one_run_made_once(new_project):
    project = new_project()

    def run(study=FEW, **params):
        given = {"execution": {"executor": "serial"}, "studies": {"leakage": study}}
        return project.run_here("leakage", "smoke", **given | params)

    done = run()
    assert done.code == 0, done.output
    runs = project.runs("leakage")
    ways = {(one.data.params["protocol"], one.data.params["estimator"]): one for one in runs}
    assert len(runs) == len(ways)
    fits = {way: sum(tag.startswith("fit.") for tag in one.data.tags) for way, one in ways.items()}
    assert fits == WAYS
    for (protocol, _), one in ways.items():
        assert (one.info.status, one.data.params["window_stride_s"]) == ("FINISHED", "10.0")
        assert protocol in one.info.run_name
        assert protocol in one.data.tags["mlflow.note.content"]
    leaks = {Path(path).name for path in project.files(REPORT) if "leakage_" in path}
    tables = {f"leakage_results.{ending}" for ending in ("csv", "md", "tex")}
    assert leaks == tables | {f"leakage_accuracy_against_stride.{e}" for e in ("png", "svg")}
    (results,) = [path for path in project.files() if path.endswith("leakage/results.csv")]
    assert len((project.folder / results).read_text().splitlines()) == 1 + 5
