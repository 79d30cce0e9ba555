"""The commands of the README, on the smoke environment and on the real Memsense file."""

import os
import re
import shutil
import sys
from collections import Counter
from dataclasses import dataclass
from itertools import product
from pathlib import Path

import mlflow.pyfunc
import numpy as np
import pandas as pd
import pytest
import xarray as xr
from mlflow import MlflowClient

from gyro_pipeline.estimators import ESTIMATORS, ORIENTATION_NOTE, make_estimator
from gyro_pipeline.hooks import Session

SERIAL = {"executor": "serial"}  # where few fits are not worth the start of processes
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
LOSSES = {"train_loss", "val_loss"}
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


def files_of(names):
    return {f"{kind}/{name}.{ending}" for kind in names for name in names[kind]
            for ending in FORMATS[kind]}  # fmt: skip


def row(run):
    return tuple(run.data.params[name] for name in ROW)


def the_run(runs, *wanted):
    (found,) = [run for run in runs if row(run) == wanted]
    return found


def identities(runs):
    return {run.info.run_id: (run.info.start_time, run.info.end_time) for run in runs}


@dataclass(frozen=True)
class Step:
    """What there was after a command."""

    code: int
    output: str
    runs: dict
    report: dict
    page: str


def step(project, done):
    runs = {study: project.runs(study) for study in ("augmentation", "real2real", "input_channels")}
    report = {path.removeprefix(f"{REPORT}/"): b for path, b in project.files(REPORT).items()}
    page = (project.folder / f"{PAGE}.html").read_text()
    return Step(done.code, done.output, runs, report, page)


# The first run


def test_the_first_run_ends_well_and_says_where_to_look(smoke):
    assert smoke.done.code == 0, smoke.done.output
    last = smoke.done.output.strip().splitlines()[-4:]
    for line, words in zip(last, (REPORT, f"{PAGE}.html", "mlflow ui", "kedro viz"), strict=True):
        assert words in line
    assert "Traceback" not in smoke.done.output


def test_rows_whose_estimator_uses_the_same_training_set_are_one_finished_run(smoke):
    assert {run.info.status for run in smoke.runs} == {"FINISHED"}
    places, windows = ("sparkfun", "dot"), ("10.0", "30.0")
    assert Counter(map(row, smoke.runs)) == Counter([
        *product(places, ["cnn"], ("3", "12"), ("0", "12", "24"), windows),
        *product(places, ["residual_network"], ("3", "12"), ["0"], windows),
        *product(places, ["mean"], ["3"], ["0"], windows),
    ])  # fmt: skip


def test_parameters_and_metrics_keep_their_names(smoke):
    for run in smoke.runs:
        params, network = run.data.params, run.data.params["estimator"] == "cnn"
        virtual = VIRTUAL if params["virtual_gyros"] != "0" else set()
        assert set(params) == PARAMS | virtual | (HYPER_PARAMETERS if network else set())
        fixed = {"study": "augmentation", "source": "simulated_smoke", "method": "2", "folds": "1"}
        assert {name: params[name] for name in fixed} == fixed
        names = METRICS | (LOSSES if network else {"coverage_95_pct"})
        assert names - {"equivalent_time_s"} <= set(run.data.metrics) <= names
        no_time = {"equivalent_time_s"} - set(run.data.metrics)  # it is said why
        assert no_time == {"equivalent_time_s"} & set(run.data.tags)


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
        scores = pd.read_csv(folder / "scores.csv").set_index(
            ["weights", "truth", "windows", "score"]
        )
        first = errors[errors.start == 0]
        rmse = scores.value["last", "paper", "first", "test_rmse_dps"]
        assert rmse == pytest.approx(np.sqrt((first.error_dps**2).mean()))
        gain = scores.value["last", "paper", "first", "accuracy_gain_pct"]
        assert metrics["accuracy_gain_pct_first"] == gain


@pytest.mark.parametrize("estimator", ["cnn", "residual_network"])
def test_the_model_of_a_run_makes_the_errors_that_it_was_judged_by(smoke, estimator, monkeypatch):
    monkeypatch.setenv("MLFLOW_TRACKING_URI", f"sqlite:///{smoke.project.store}")
    run = the_run(smoke.runs, "dot", estimator, "12", "0", "30.0")
    model = mlflow.pyfunc.load_model(f"runs:/{run.info.run_id}/model")
    errors = pd.read_parquet(smoke.project.artifacts(run) / "errors.parquet")
    last = errors[(errors.truth == "paper") & (errors.weights == "last")]
    path = smoke.project.folder / "data/02_intermediate/simulated_smoke/dot/recordings.nc"
    with xr.open_dataset(path) as recordings:
        rates, rate_hz = recordings.angular_rate.sel(imu=1), recordings.attrs["rate_hz"]
        size = round(30 * rate_hz)
        for (number, start), rows in last.groupby(["recording", "start"]):
            whole = rates.sel(recording=number).to_numpy().astype(float)
            asked = {"target": "recording_mean", "start_s": [start / rate_hz]}
            bias = model.predict(whole[None, :, start : start + size], asked)["bias_dps"][0]
            expected = rows.set_index("axis").error_dps[list("xyz")]
            assert bias - whole.mean(axis=-1) == pytest.approx(expected, abs=1e-8)


def test_the_report_says_what_was_run_and_links_every_run(smoke):
    written = {path for path in smoke.files if path.startswith(REPORT)}
    assert written == {f"{REPORT}/{name}" for name in files_of(AUGMENTATION)}
    assert not [path for path in smoke.files if Path(path).name.startswith(".")]
    html, text = (smoke.files[f"{PAGE}.{suffix}"].decode() for suffix in ("html", "md"))
    for page in (html, text):
        assert "This is a smoke run, not a result." in page
        assert "kedro run --pipeline=augmentation --env=smoke" in page
    assert html.count("data:image/png") == len(AUGMENTATION["figures"])
    for run in smoke.runs:
        assert f"#/experiments/{run.info.experiment_id}/runs/{run.info.run_id}" in html
        assert f"`{run.info.experiment_id}/{run.info.run_id}`" in text


def test_tables_show_published_ours_and_the_ceiling_with_their_runs(smoke):
    three, multiple = (
        pd.read_csv(smoke.project.folder / REPORT / "tables" / f"augmentation_{name}.csv")
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


def test_runs_say_what_made_them(smoke):
    for run in smoke.runs:
        tags = run.data.tags
        assert (tags["kedro_env"], tags["simulated"], tags["layout"]) == ("smoke", "1", "3")
        assert re.fullmatch(r"[0-9a-f]{16}", tags["lock_hash"])
        assert re.fullmatch(r"[0-9a-f]{16}", tags["fingerprint"])
        assert {"kedro_run", "git_dirty", "mlflow.source.git.commit", "data_hash"} <= set(tags)
        assert {"torch", "numpy", "python", "mlflow.user", "mlflow.source.name"} <= set(tags)
        for part in (*row(run)[:2], f"{float(run.data.params['window_s']):g} s"):
            assert part in tags["mlflow.runName"]


# Each of these does the next thing in the same project.


@pytest.fixture(scope="module")
def incomplete(smoke):
    """A run is deleted, and two files of the report."""
    project = smoke.project
    run = the_run(smoke.runs, "dot", "cnn", "12", "24", "10.0")
    MlflowClient(f"sqlite:///{project.store}").delete_run(run.info.run_id)
    for name in ("augmentation_three_gyroscopes.md", "augmentation_results.csv"):
        (project.folder / REPORT / "tables" / name).unlink()
    return step(project, project.run_here("reporting", "smoke"))


@pytest.fixture(scope="module")
def repaired(smoke, incomplete):
    (command,) = set(re.findall(r"kedro run (--pipeline=augmentation \S+)", incomplete.output))
    return step(smoke.project, smoke.project.kedro_run(*command.split(), "--env=smoke"))


@pytest.fixture(scope="module")
def changed(smoke, repaired):
    only = {"sensor": "dot", "real_gyros": 3, "virtual_gyros": 0, "window_s": 10}
    changes = {"only": only, "training": {"hidden": 33}, "execution": SERIAL}
    return step(smoke.project, smoke.project.run_here("augmentation", "smoke", **changes))


@pytest.fixture(scope="module")
def whole(smoke, changed):
    return step(smoke.project, smoke.project.run_here("__default__", "smoke", execution=SERIAL))


@pytest.fixture(scope="module")
def with_gaps(smoke, whole):
    """Without nine gyroscopes of DOT at 10 s, in one table and one figure, and a sensor's file."""
    project = smoke.project
    run = the_run(whole.runs["real2real"], "dot", "cnn", "9", "0", "10.0")
    MlflowClient(f"sqlite:///{project.store}").delete_run(run.info.run_id)
    (project.folder / "data/02_intermediate/simulated_smoke/ng/recordings.nc").unlink()
    return step(project, project.run_here("reporting", "smoke"))


def test_reporting_makes_what_it_can_and_names_what_is_missing(smoke, incomplete):
    assert incomplete.code != 0
    assert "Traceback" not in incomplete.output
    three = "tables/augmentation_three_gyroscopes.md"
    assert incomplete.report[three] == smoke.files[f"{REPORT}/{three}"]
    assert len(incomplete.report["tables/augmentation_results.csv"].splitlines()) == 1 + 51
    assert not [name for name in incomplete.report if "multiple_gyr" in name or "dot_12" in name]
    assert len(incomplete.runs["augmentation"]) == len(smoke.runs) - 1  # nothing was trained
    (command,) = set(re.findall(r"kedro run --pipeline=augmentation \S+", incomplete.output))
    for part in ("sensor=dot", "real_gyros=12", "virtual_gyros=24", "window_s=10", "seed=0"):
        assert f"only.{part}" in command
    assert f"<code>{command} --env=smoke</code>" in incomplete.page
    assert "--pipeline=input_channels" in incomplete.output
    assert "--pipeline=ground_truth --params=only.sensor=ng" in incomplete.output


def test_the_command_it_names_repairs_it_and_trains_nothing_else(incomplete, repaired):
    assert repaired.code == 0, repaired.output
    before, after = (identities(one.runs["augmentation"]) for one in (incomplete, repaired))
    assert before.items() <= after.items()
    assert len(after) == len(before) + 1
    assert set(repaired.report) >= files_of(AUGMENTATION)


def test_another_hyper_parameter_trains_anew_and_keeps_what_was(repaired, changed):
    assert changed.code == 0, changed.output
    assert "3 runs planned, 2 skipped" in changed.output
    before = identities(repaired.runs["augmentation"])
    assert before.items() <= identities(changed.runs["augmentation"]).items()
    (new,) = [run for run in changed.runs["augmentation"] if run.info.run_id not in before]
    assert new.data.params["hidden"] == "33"
    assert row(new) == ("dot", "cnn", "3", "0", "10.0")
    # its report uses the new run and says what it does not use
    unused = "24 older runs with other settings or data are in the store and not used"
    assert f"augmentation: {unused}" in changed.output
    report = changed.report["tables/augmentation_results.csv"].decode()
    shown = [run for run in changed.runs["augmentation"] if run.info.run_id[:8] in report]
    assert [run for run in shown if run.data.params["estimator"] == "cnn"] == [new]


def test_a_whole_run_skips_what_is_there_and_shares_what_another_study_has(smoke, changed, whole):
    assert whole.code == 0, whole.output
    before = identities(changed.runs["augmentation"])
    assert identities(whole.runs["augmentation"]) == before
    for line in (
        "augmentation dot: 18 runs planned, 18 skipped (made before), 0 shared",
        "real2real dot: 18 runs planned, 0 skipped (made before), 10 shared with another study, 8",
        "input_channels sparkfun: 10 runs planned, 0 skipped (made before), 4 shared",
        "augmentation: 1 older runs with other settings or data are in the store and not used",
    ):
        assert line in whole.output
    assert set(whole.report) == files_of(AUGMENTATION) | files_of(OTHERS)
    twins = {run.data.tags["fingerprint"]: run for run in whole.runs["augmentation"]}
    others = whole.runs["real2real"] + whole.runs["input_channels"]
    assert {run.info.status for run in others} == {"FINISHED"}
    for run in others:
        twin = twins.get(run.data.tags["fingerprint"])
        one_imu = run.data.params["real_gyros"] == "3"
        assert run.data.params["method"] == "2" or not one_imu
        if twin is not None:
            assert row(run) == row(twin)
            assert run.data.metrics == pytest.approx(twin.data.metrics, rel=1e-4)
            if run.data.params["estimator"] == "cnn":
                assert smoke.project.weights(run) == smoke.project.weights(twin)


def test_what_is_deleted_is_missed_by_exactly_what_needs_it(whole, with_gaps):
    assert with_gaps.code != 0
    gone = {
        "tables": ["real2real_generalization", "sensor_specifications", "dataset_hours"],
        "figures": ["real2real_saving_against_turn_on_spread", "allan_deviation"],
    }
    assert set(with_gaps.report) == set(whole.report) - files_of(gone)
    assert set(re.findall(r"kedro run --pipeline=\S+ --params=\S+", with_gaps.output)) == {
        "kedro run --pipeline=real2real --params=only.sensor=dot,only.window_s=10,"
        "only.real_gyros=9,only.virtual_gyros=0,only.seed=0",
        "kedro run --pipeline=ground_truth --params=only.sensor=ng",
    }
    results = with_gaps.report["tables/real2real_results.csv"].splitlines()
    assert len(results) == len(whole.report["tables/real2real_results.csv"].splitlines()) - 1


# A stranger's estimator, and all of our own


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


@pytest.fixture(scope="module")
def strangers(new_project):
    project = new_project()
    (project.folder / "src/of_a_stranger.py").write_text(LARGEST)
    changes = {"studies": {"augmentation": {"estimators": ["cnn", "of_a_stranger:Largest"]}}}
    changes |= {"training": {"epochs": 1}, "only": {"sensor": "sparkfun", "window_s": 30}}
    changes |= {"execution": SERIAL}
    return project, project.run_here("augmentation", "smoke", **changes), changes


def test_rows_of_a_strangers_estimator_are_trained_on_what_they_name(strangers):
    project, done, _ = strangers
    assert done.code == 0, done.output
    every = project.runs("augmentation")
    runs = [run for run in every if run.data.params["estimator"] not in ("mean", "cnn")]
    names = ("real_gyros", "virtual_gyros")
    counts = {run.info.run_id: tuple(int(run.data.params[name]) for name in names) for run in runs}
    assert Counter(counts.values()) == Counter(product((3, 12), (0, 12, 24)))
    uri = f"sqlite:///{project.store}"
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("MLFLOW_TRACKING_URI", uri)
        for run_id, (real, virtual) in counts.items():
            model = mlflow.pyfunc.load_model(f"runs:/{run_id}/model")
            said = model.predict(np.zeros((1, 3, 450)))["bias_dps"]
            assert said.tolist() == [[(real + virtual) / 3] * 3]


def test_a_second_run_does_nothing_a_change_runs_what_follows_and_a_named_node_is_run(
    strangers, monkeypatch
):
    project, _, changes = strangers
    up_to_date = r"(\d+) of (\d+) nodes are up to date and not run again \((.*)\)"
    monkeypatch.setattr(sys.modules[type(project).__module__], "KedroSession", Session)
    first = project.run_here("augmentation", "smoke", **changes)
    assert not re.search(up_to_date, first.output)  # nodes that no such session has run
    states, runs = project.files(), identities(project.runs("augmentation"))
    again = project.run_here("virtual_gyros", "smoke", **changes)
    left, nodes, _ = re.search(up_to_date, again.output).groups()
    assert (again.code, left) == (0, nodes)
    assert project.files() == states
    again = project.run_here("augmentation", "smoke", **changes)  # tables that lack runs are tried
    assert re.search(up_to_date, again.output)
    assert "runs planned" not in again.output
    assert "runs evaluated" not in again.output
    assert identities(project.runs("augmentation")) == runs
    changed = changes | {"evaluation": {"resamples": 160}}
    other = project.run_here("augmentation", "smoke", **changed)
    assert other.code == 0, other.output
    stages = set(re.search(up_to_date, other.output)[3].split(", "))
    assert {"raw_logs", "ground_truth", "virtual_gyros", "training"} <= stages
    assert "evaluation" not in stages
    assert "runs planned" not in other.output
    assert f"sparkfun: {len(runs)} runs evaluated, 0 skipped" in other.output
    bias = project.folder / "data/03_primary/simulated_smoke/sparkfun/bias.csv"
    before = bias.stat().st_mtime_ns
    named = project.kedro_run(
        "--pipeline=ground_truth", "--env=smoke", "--nodes=ground_truth.bias_sparkfun"
    )
    assert named.code == 0, named.output
    assert bias.stat().st_mtime_ns > before


@pytest.fixture(scope="module")
def estimators(new_project):
    """Of one sensor and window, made, and asked for again."""
    project = new_project()
    only = {"sensor": "sparkfun", "window_s": 10}
    done = project.run_here("estimators", "smoke", only=only)
    made = project.runs("estimators")
    return project, done, made, project.run_here("estimators", "smoke", only=only)


def test_every_estimator_is_a_finished_run_with_a_model(estimators, parameters):
    _, done, runs, again = estimators
    assert done.code == 0, done.output
    every = [name for name in ESTIMATORS if name != "cnn_shuffled"]
    assert sorted(run.data.params["estimator"] for run in runs) == sorted(every)
    for run in runs:
        name, tags = run.data.params["estimator"], run.data.tags
        made = make_estimator(name, parameters().training, 0)
        assert run.info.status == "FINISHED"
        assert len(run.outputs.model_outputs) == 1
        assert ("uses_prior" in tags) == made.uses_prior
        assert tags["recommended"] == str(made.recommended)
        no_sigma = {"median", "trimmed_mean", "ridge", "ridge_same_time", "window_mean_network"}
        assert ("coverage_95_pct" in run.data.metrics) == (name not in no_sigma | {"cnn"})
    assert f"sparkfun: 0 runs evaluated, {len(every)} skipped" in again.output
    assert f"{len(every)} skipped (made before)" in again.output


def test_estimators_are_compared_in_the_report(estimators):
    project, _, runs, _ = estimators
    table = pd.read_csv(project.folder / REPORT / "tables/estimators_comparison.csv")
    table = table.set_index("Estimator")
    assert {run.data.params["estimator"] for run in runs} | {"cnn_best"} == set(table.index)
    (ridge,) = [run for run in runs if run.data.params["estimator"] == "ridge"]
    rmse = ridge.data.metrics["rmse_mdps"]
    assert table["RMSE mdps"]["ridge"] == pytest.approx(rmse, abs=1e-3)
    page = (project.folder / f"{PAGE}.html").read_text()
    assert "SparkFun: estimators, error relative to the running mean" in page
    assert "best linear history (recommended)" in page
    assert ORIENTATION_NOTE in page


# The real file


@pytest.fixture(scope="module")
def memsense(new_project):
    folder, name = os.environ.get("GYRO_PIPELINE_REAL_DATA", ""), "memsense_test_real.npy"
    if not folder or not Path(folder, name).is_file():
        pytest.skip(f"GYRO_PIPELINE_REAL_DATA names no folder with {name}")
    project = new_project()
    raw = project.folder / "data/01_raw/published"
    raw.mkdir(parents=True)
    shutil.copy(Path(folder, name), raw)
    settings = {"training": {"epochs": 2}, "splits": {"validation_recordings": 2}}
    done = project.run_here("real2real", "memsense_real", **settings, execution=SERIAL)
    return project, done, project.runs("real2real")


def test_on_the_real_file_all_folds_are_one_run_with_a_model_of_all_recordings(memsense):
    _, done, runs = memsense
    assert done.code == 0, done.output
    names = ("mean", "cnn", "residual_network")
    kinds = Counter((r.data.params["estimator"], r.data.params["window_s"]) for r in runs)
    assert kinds == Counter(product(names, ("10.0", "30.0")))
    for run in runs:
        params, tags = run.data.params, run.data.tags
        assert run.info.status == "FINISHED"
        assert (params["sensor"], params["source"]) == ("memsense", "published")
        assert (params["folds"], tags["simulated"]) == ("11", "0")
        assert tags["model_fold"] == "all recordings"
        assert "fitted once more, to all recordings" in tags["mlflow.note.content"]


def test_the_running_means_error_on_the_real_file_is_the_known_one(memsense):
    _, done, runs = memsense
    mean = the_run(runs, "memsense", "mean", "3", "0", "10.0")
    assert f"{mean.data.metrics['rmse_mdps']:.3f}" == "1.508"
    (line,) = [one for one in done.output.splitlines() if "memsense mean 3+0 10 s" in one]
    assert line.endswith(": RMSE 1.5083 mdps in all windows, 1.5854 in the first")


def test_the_real_file_stands_beside_the_simulated_one_in_the_report(memsense):
    project, _, runs = memsense
    changes = {"training": {"epochs": 2}, "only": {"window_s": 10}}
    done = project.run_here("real2real", "smoke", **changes, execution=SERIAL)
    assert done.code == 0, done.output
    table = pd.read_csv(project.folder / REPORT / "tables/real2real_generalization.csv")
    assert table["Sensor"].tolist() == ["sparkfun", "dot", "ng", "memsense", "memsense"]
    measured = table.iloc[-1]
    assert measured["Source"] == "published (measured)"
    assert measured["Split"] == "k-fold, 11 folds"
    assert measured["Published S/A %"] == "75/75 (6 real)"
    names = ("cnn", "residual_network")
    both = [the_run(runs, "memsense", name, "3", "0", "10.0") for name in names]
    assert measured["Runs"].split() == [run.info.run_id[:8] for run in both]


def test_estimators_without_a_network_reach_on_the_real_file_what_is_known(memsense):
    project, _, _ = memsense
    asked = ["mean", "training_mean", "empirical_bayes", "best_linear"]
    studies = {"estimators": {"windows_s": [10], "estimators": asked}}
    done = project.run_here("estimators", "memsense_real", studies=studies)
    assert done.code == 0, done.output
    runs = {run.data.params["estimator"]: run.data for run in project.runs("estimators")}
    assert set(runs) == set(asked)
    rmse = {name: run.metrics["rmse_mdps"] for name, run in runs.items()}
    assert f"{rmse['training_mean']:.4f}" == "1.4536"
    assert 0.53 < rmse["empirical_bayes"] / rmse["mean"] <= 0.72
    assert 0.53 < rmse["best_linear"] / rmse["mean"] <= 0.72
    assert 88 <= runs["best_linear"].metrics["coverage_95_pct"] <= 99
