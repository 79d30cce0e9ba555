"""The commands of the README, on the smoke environment and on the real Memsense file."""

import os
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

from gyro_pipeline.estimators import ESTIMATORS, ORIENTATION_NOTE, make_estimator

SMOKE = ("--pipeline=augmentation", "--env=smoke")
REPORT = "data/08_reporting/simulated_smoke"
PAGE = "data/08_reporting/report"
ROW = ["sensor", "estimator", "real_gyros", "virtual_gyros", "window_s"]
PARAMS = {
    *ROW, "study", "source", "protocol", "method", "window_stride_s", "seed", "folds",
    "validation_recordings", "fold_validation_recordings", "training_windows", "split_seed",
    "test_fraction", "k_fold_below", "leave_one_out_up_to",
}  # fmt: skip
VIRTUAL = {
    "virtual_imus", "virtual_recordings", "virtual_train_recordings",
    "virtual_turn_on_jitter_mdps", "virtual_seed",
}  # fmt: skip
HYPER_PARAMETERS = {
    "centring", "channels", "kernel", "stride", "pool", "hidden", "epochs", "batch_size",
    "learning_rate", "decay", "decay_every", "stop_below",
}  # fmt: skip
METRICS = {
    "rmse_mdps", "mean_rmse_mdps", "ceiling_rmse_mdps", "accuracy_gain_pct",
    "accuracy_gain_pct_lo", "accuracy_gain_pct_hi", "time_saving_pct", "equivalent_time_s",
    "accuracy_gain_pct_first", "time_saving_pct_first",
}  # fmt: skip
# What `kedro run` writes: the five tables of the paper, every figure, and all results.
FORMATS = {"tables": ("csv", "md", "tex"), "figures": ("png", "svg")}
AUGMENTATION = {
    "tables": ["augmentation_results", "augmentation_three_gyroscopes",
               "augmentation_multiple_gyroscopes", "recording_quality"],
    "figures": [f"augmentation_{sensor}_{real}_real"
                for sensor in ("sparkfun", "dot") for real in (3, 12)],
}  # fmt: skip
OTHERS = {
    "tables": ["real2real_generalization", "sensor_specifications", "dataset_hours",
               "real2real_results", "input_channels_results"],
    "figures": ["running_average", "calibrated_signal", "mg_convergence", "allan_deviation",
                "input_channels_input_channels", "real2real_training_data",
                "real2real_gyroscopes_10s", "real2real_saving_against_turn_on_spread"],
}  # fmt: skip


def files_of(*kinds):
    return {f"{kind}/{name}.{ending}" for names in kinds for kind in names for name in names[kind]
            for ending in FORMATS[kind]}  # fmt: skip


def report(project):
    return {path.removeprefix(f"{REPORT}/"): b for path, b in project.files(REPORT).items()}


def row(run):
    return tuple(run.data.params[name] for name in ROW)


def the_run(runs, *wanted):
    (found,) = [run for run in runs if row(run) == wanted]
    return found


def identities(runs):
    return {run.info.run_id: (run.info.start_time, run.info.end_time) for run in runs}


def delete(project, run):
    MlflowClient(f"sqlite:///{project.store}").delete_run(run.info.run_id)


def repairs(output):
    return set(re.findall(r"kedro run --pipeline=\S+ --params=\S+", output))


# The first run


def test_the_first_run_ends_well_and_says_where_to_look(smoke):
    assert smoke.done.code == 0, smoke.done.output
    last = smoke.done.output.strip().splitlines()[-4:]
    for line, words in zip(last, (REPORT, f"{PAGE}.html", "mlflow ui", "kedro viz"), strict=True):
        assert words in line
    assert "Traceback" not in smoke.done.output


def test_rows_whose_estimator_uses_the_same_training_set_are_one_run_that_says_what_made_it(smoke):
    sensors = ("sparkfun", "dot")
    assert Counter(map(row, smoke.runs)) == Counter([
        *product(sensors, ["cnn"], ("3", "12"), ("0", "12", "24"), ["10.0"]),
        *product(sensors, ["residual_network"], ("3", "12"), ["0"], ["10.0"]),
        *product(sensors, ["mean"], ["3"], ["0"], ["10.0"]),
    ])  # fmt: skip
    for run in smoke.runs:
        params, tags, network = run.data.params, run.data.tags, row(run)[1] == "cnn"
        assert run.info.status == "FINISHED"
        virtual = VIRTUAL if params["virtual_gyros"] != "0" else set()
        assert set(params) == PARAMS | virtual | (HYPER_PARAMETERS if network else set())
        fixed = {"study": "augmentation", "source": "simulated_smoke", "method": "2", "folds": "1"}
        assert {name: params[name] for name in fixed} == fixed
        names = METRICS | ({"train_loss", "val_loss"} if network else {"coverage_95_pct"})
        assert names - {"equivalent_time_s"} <= set(run.data.metrics) <= names
        no_time = {"equivalent_time_s"} - set(run.data.metrics)  # it is said why
        assert no_time == {"equivalent_time_s"} & set(tags)
        assert (tags["kedro_env"], tags["simulated"], tags["layout"]) == ("smoke", "1", "2")
        assert re.fullmatch(
            r"[0-9a-f]{16} [0-9a-f]{16}", f"{tags['lock_hash']} {tags['fingerprint']}"
        )
        assert {"kedro_run", "git_dirty", "mlflow.source.git.commit", "data_hash"} <= set(tags)
        assert {"torch", "numpy", "python", "mlflow.user", "mlflow.source.name"} <= set(tags)
        for part in (*row(run)[:2], f"{float(params['window_s']):g} s"):
            assert part in tags["mlflow.runName"]


def test_metrics_are_those_of_the_errors_kept_with_the_run(smoke):
    for run in smoke.runs:
        folder, metrics = smoke.project.artifacts(run), run.data.metrics
        assert folder.is_relative_to(smoke.project.folder)
        own = {"cnn": {"history.csv"}, "mean": {"running_mean_curve.parquet"}}
        kept = {"errors.parquet", "scores.csv"} | own.get(run.data.params["estimator"], set())
        assert {path.name for path in folder.iterdir()} == kept
        errors = pd.read_parquet(folder / "errors.parquet")
        errors = errors[(errors.truth == "paper") & (errors.weights == "last")]
        assert metrics["rmse_mdps"] == pytest.approx(1e3 * np.sqrt((errors.error_dps**2).mean()))
        ratio = metrics["rmse_mdps"] / metrics["mean_rmse_mdps"]
        assert metrics["accuracy_gain_pct"] == pytest.approx(100 * (1 - ratio))
        scores = pd.read_csv(folder / "scores.csv")
        scores = scores.set_index(["weights", "truth", "windows", "score"]).value
        first = errors[errors.start == 0]
        rmse = scores["last", "paper", "first", "test_rmse_dps"]
        assert rmse == pytest.approx(np.sqrt((first.error_dps**2).mean()))
        gain = scores["last", "paper", "first", "accuracy_gain_pct"]
        assert metrics["accuracy_gain_pct_first"] == gain


@pytest.mark.parametrize("estimator", ["cnn", "residual_network"])
def test_the_model_of_a_run_makes_the_errors_that_it_was_judged_by(smoke, estimator, monkeypatch):
    monkeypatch.setenv("MLFLOW_TRACKING_URI", f"sqlite:///{smoke.project.store}")
    run = the_run(smoke.runs, "dot", estimator, "12", "0", "10.0")
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


def test_the_report_says_what_was_run_links_every_run_and_compares_with_the_paper(smoke):
    project = smoke.project
    assert set(report(project)) == files_of(AUGMENTATION)
    assert not [path for path in project.files() if Path(path).name.startswith(".")]
    html, text = ((project.folder / f"{PAGE}.{suffix}").read_text() for suffix in ("html", "md"))
    for page in (html, text):
        assert "This is a smoke run, not a result." in page
        assert "kedro run --pipeline=augmentation --env=smoke" in page
    assert html.count("data:image/png") == len(AUGMENTATION["figures"])
    for run in smoke.runs:
        assert f"#/experiments/{run.info.experiment_id}/runs/{run.info.run_id}" in html
        assert f"`{run.info.experiment_id}/{run.info.run_id}`" in text
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


# What can happen next


def test_the_report_names_what_is_missing_and_the_command_that_makes_it_and_nothing_else(
    smoke, smoke_copy
):
    before = report(smoke_copy)
    delete(smoke_copy, the_run(smoke.runs, "dot", "cnn", "12", "24", "10.0"))
    three, results = (f"tables/augmentation_{name}" for name in ("three_gyroscopes", "results"))
    for name in (f"{three}.md", f"{results}.csv"):
        (smoke_copy.folder / REPORT / name).unlink()
    reported, written = smoke_copy.run_here("reporting", "smoke"), report(smoke_copy)
    assert reported.code != 0
    assert "Traceback" not in reported.output
    assert written[f"{three}.md"] == before[f"{three}.md"]
    assert len(written[f"{results}.csv"]) < len(before[f"{results}.csv"])
    assert not [name for name in written if "multiple_gyr" in name or "dot_12" in name]
    left = smoke_copy.runs("augmentation")
    assert len(left) == len(smoke.runs) - 1  # nothing was trained
    (command,) = [one for one in repairs(reported.output) if "augmentation" in one]
    for part in ("sensor=dot", "real_gyros=12", "virtual_gyros=24", "window_s=10", "seed=0"):
        assert f"only.{part}" in command
    assert f"<code>{command} --env=smoke</code>" in (smoke_copy.folder / f"{PAGE}.html").read_text()
    assert "--pipeline=input_channels" in reported.output
    assert "--pipeline=ground_truth --params=only.sensor=ng" in reported.output
    repaired = smoke_copy.command(*command.split()[2:], "--env=smoke")
    assert repaired.code == 0, repaired.output
    after = identities(smoke_copy.runs("augmentation"))
    assert identities(left).items() <= after.items()
    assert len(after) == len(smoke.runs)
    assert set(report(smoke_copy)) >= files_of(AUGMENTATION)


def test_another_hyper_parameter_trains_anew_and_keeps_what_was(smoke, smoke_copy):
    only = "only.sensor=dot,only.real_gyros=3,only.virtual_gyros=0,only.window_s=10"
    done = smoke_copy.command(*SMOKE, f"--params=training.hidden=33,{only}")
    assert done.code == 0, done.output
    assert "3 runs planned, 2 skipped" in done.output
    before, runs = identities(smoke.runs), smoke_copy.runs("augmentation")
    assert before.items() <= identities(runs).items()
    (new,) = [run for run in runs if run.info.run_id not in before]
    assert new.data.params["hidden"] == "33"
    assert row(new) == ("dot", "cnn", "3", "0", "10.0")
    # its report uses the new run and says what it does not use
    unused = "12 older runs with other settings or data are in the store and not used"
    assert f"augmentation: {unused}" in done.output
    table = report(smoke_copy)["tables/augmentation_results.csv"].decode()
    shown = [run for run in runs if run.info.run_id[:8] in table]
    assert [run for run in shown if run.data.params["estimator"] == "cnn"] == [new]


def test_a_whole_run_shares_what_another_study_has_and_gaps_are_missed_by_what_needs_them(
    smoke, smoke_copy
):
    whole = smoke_copy.command("--env=smoke")
    assert whole.code == 0, whole.output
    assert identities(smoke_copy.runs("augmentation")) == identities(smoke.runs)
    for line in (
        "real2real dot: 9 runs planned, 0 skipped (made before), 5 shared with another study, 4",
        "input_channels sparkfun: 5 runs planned, 0 skipped (made before), 2 shared",
    ):
        assert line in whole.output
    written = report(smoke_copy)
    assert set(written) == files_of(AUGMENTATION, OTHERS)
    twins = {run.data.tags["fingerprint"]: run for run in smoke.runs}
    others = smoke_copy.runs("real2real")
    deleted = the_run(others, "dot", "cnn", "9", "0", "10.0")
    others += smoke_copy.runs("input_channels")
    assert {run.info.status for run in others} == {"FINISHED"}
    for run in others:
        assert run.data.params["method"] == "2" or run.data.params["real_gyros"] != "3"
        twin = twins.get(run.data.tags["fingerprint"])
        if twin is not None:
            assert row(run) == row(twin)
            assert run.data.metrics == pytest.approx(twin.data.metrics, rel=1e-4)
            if run.data.params["estimator"] == "cnn":
                assert smoke_copy.weights(run) == smoke.project.weights(twin)
    # what is deleted is missed by exactly what needs it: a table, a figure, and a row of results
    delete(smoke_copy, deleted)
    (smoke_copy.folder / "data/02_intermediate/simulated_smoke/ng/recordings.nc").unlink()
    with_gaps, left = smoke_copy.command("--pipeline=reporting", "--env=smoke"), report(smoke_copy)
    assert with_gaps.code != 0
    assert set(left) == set(written) - files_of({
        "tables": ["real2real_generalization", "sensor_specifications", "dataset_hours"],
        "figures": ["real2real_saving_against_turn_on_spread", "allan_deviation"],
    })  # fmt: skip
    assert repairs(with_gaps.output) == {
        "kedro run --pipeline=real2real --params=only.sensor=dot,only.window_s=10,"
        "only.real_gyros=9,only.virtual_gyros=0,only.seed=0",
        "kedro run --pipeline=ground_truth --params=only.sensor=ng",
    }
    results = "tables/real2real_results.csv"
    assert len(left[results].splitlines()) == len(written[results].splitlines()) - 1


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


def test_an_estimator_of_ones_own_is_trained_on_what_rows_name_and_only_what_changed_runs_again(
    new_project, monkeypatch
):
    project = new_project()
    (project.folder / "src/of_a_stranger.py").write_text(LARGEST)
    asked = {
        "studies": {"augmentation": {"estimators": ["cnn", "of_a_stranger:Largest"]}},
        "training": {"epochs": 1},
        "only": {"sensor": "sparkfun", "window_s": 30},
        "execution": {"executor": "serial"},
    }

    def run(pipeline="augmentation", **changes):
        return project.run_here(pipeline, "smoke", changed_only=True, **asked | changes)

    done = run()
    assert done.code == 0, done.output
    runs = project.runs("augmentation")
    own = [run for run in runs if run.data.params["estimator"] not in ("mean", "cnn")]
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
    again = run().output  # tables that lack runs are tried
    assert re.search(UP_TO_DATE, again)
    assert "runs planned" not in again
    assert "runs evaluated" not in again
    assert identities(project.runs("augmentation")) == identities(runs)
    # a setting of a late stage changed
    other = run(evaluation={"resamples": 160})
    assert other.code == 0, other.output
    stages = set(re.search(UP_TO_DATE, other.output)[3].split(", "))
    assert {"raw_logs", "ground_truth", "virtual_gyros", "training"} <= stages
    assert "evaluation" not in stages
    assert "runs planned" not in other.output
    assert f"sparkfun: {len(runs)} runs evaluated, 0 skipped" in other.output
    # a node that is named is run
    bias = project.folder / "data/03_primary/simulated_smoke/sparkfun/bias.csv"
    before = bias.stat().st_mtime_ns
    node = "--nodes=ground_truth.bias_sparkfun"
    named = project.command("--pipeline=ground_truth", "--env=smoke", node)
    assert named.code == 0, named.output
    assert bias.stat().st_mtime_ns > before


def test_every_estimator_is_a_finished_run_with_a_model_and_a_row_of_the_comparison(
    new_project, parameters
):
    project = new_project()
    only = "--params=only.sensor=sparkfun,only.window_s=10"
    done = project.command("--pipeline=estimators", "--env=smoke", only)
    assert done.code == 0, done.output
    runs = {run.data.params["estimator"]: run for run in project.runs("estimators")}
    assert set(runs) == {*ESTIMATORS} - {"cnn_shuffled"}
    for name, run in runs.items():
        made = make_estimator(name, parameters().training, 0)
        assert run.info.status == "FINISHED"
        assert len(run.outputs.model_outputs) == 1
        assert ("uses_prior" in run.data.tags) == made.uses_prior
        assert run.data.tags["recommended"] == str(made.recommended)
        no_sigma = {"median", "trimmed_mean", "ridge", "ridge_same_time", "window_mean_network"}
        assert ("coverage_95_pct" in run.data.metrics) == (name not in no_sigma | {"cnn"})
    table = pd.read_csv(project.folder / REPORT / "tables/estimators_comparison.csv")
    table = table.set_index("Estimator")
    assert set(table.index) == {*runs, "cnn_best"}
    rmse = runs["ridge"].data.metrics["rmse_mdps"]
    assert table["RMSE mdps"]["ridge"] == pytest.approx(rmse, abs=1e-3)
    page = (project.folder / f"{PAGE}.html").read_text()
    assert "SparkFun: estimators, error relative to the running mean" in page
    assert "best linear history (recommended)" in page
    assert ORIENTATION_NOTE in page


# The real file


def test_the_real_file_has_known_errors_and_stands_beside_the_simulated_one(smoke_copy):
    folder, name = os.environ.get("GYRO_PIPELINE_REAL_DATA", ""), "memsense_test_real.npy"
    if not folder or not Path(folder, name).is_file():
        pytest.skip(f"GYRO_PIPELINE_REAL_DATA names no folder with {name}")
    project, raw = smoke_copy, smoke_copy.folder / "data/01_raw/published"
    raw.mkdir(parents=True)
    shutil.copy(Path(folder, name), raw)
    few = {"training": {"epochs": 2}, "only": {"window_s": 10}, "execution": {"executor": "serial"}}
    known = ["mean", "training_mean", "empirical_bayes", "best_linear"]
    few["splits"] = {"validation_recordings": 2}  # as on the simulated ones
    few["studies"] = {"estimators": {"windows_s": [10], "estimators": known}}

    def run(pipeline, env="memsense_real"):
        done = project.run_here(pipeline, env, changed_only=True, **few)
        assert done.code == 0, done.output
        if env == "smoke":
            return {}
        stored = [run for run in project.runs(pipeline) if run.data.params["source"] == "published"]
        return {run.data.params["estimator"]: run for run in stored}

    # all folds are one run, whose model is fitted to all recordings
    runs = run("real2real")
    assert set(runs) == {"mean", "cnn", "residual_network"}
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
    # in the report
    run("real2real", "smoke")
    table = pd.read_csv(project.folder / REPORT / "tables/real2real_generalization.csv")
    assert table["Sensor"].tolist() == ["sparkfun", "dot", "ng", "memsense", "memsense"]
    measured = table.iloc[-1]
    assert measured["Source"] == "published (measured)"
    assert measured["Split"] == "k-fold, 11 folds"
    assert measured["Published S/A %"] == "75/75 (6 real)"
    networks = [runs[name].info.run_id[:8] for name in ("cnn", "residual_network")]
    assert measured["Runs"].split() == networks
