"""The commands of the README, on the smoke environment and on the real Memsense file."""

import os
import re
import shutil
from collections import Counter
from dataclasses import dataclass
from itertools import product
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from mlflow import MlflowClient

from gyro_pipeline.estimators import ESTIMATORS, ORIENTATION_NOTE

SERIAL = {"executor": "serial"}  # where few trainings are not worth the start of processes
REAL_FILE = "memsense_test_real.npy"
REPORT = "data/08_reporting/simulated_smoke"
PAGE = "data/08_reporting/report"
CELL = ["sensor", "real_gyros", "virtual_gyros", "window_s"]
PARAMS = {*CELL, "study", "method", "source", "seed", "fold", "estimator"}
HYPER_PARAMETERS = {
    "centring", "channels", "kernel", "stride", "pool", "hidden", "epochs", "batch_size",
    "learning_rate", "decay", "decay_every", "stop_below", "steps",
    "validation_recordings", "split_seed",
}  # fmt: skip
BASES = {
    "test_rmse_dps", "mean_rmse_dps", "equivalent_time_s", "time_saving_pct", "accuracy_gain_pct",
    "test_mse_dps2", "ceiling_rmse_dps", "ceiling_time_saving_pct", "ceiling_accuracy_gain_pct",
    "beats_oracle_p", "coverage_1sigma", "coverage_2sigma",
}  # fmt: skip
SUFFIXES = ["".join(parts) for parts in product(("", "_all"), ("", "_best"), ("", "_true"))]
REPORTED = {
    *(f"tables/augmentation_{name}.{kind}"
      for name in ("results", "three_gyroscopes", "multiple_gyroscopes")
      for kind in ("csv", "md", "tex")),
    *(f"tables/recording_quality.{kind}" for kind in ("csv", "md", "tex")),
    *(f"figures/augmentation_{sensor}_{real}_real.{kind}"
      for sensor in ("sparkfun", "dot") for real in (3, 12) for kind in ("png", "svg")),
}  # fmt: skip
# What `kedro run` writes: the five tables of the paper, every figure, and all results.
FORMATS = {"tables": ("csv", "md", "tex"), "figures": ("png", "svg")}
TABLES = {
    "augmentation_three_gyroscopes",
    "augmentation_multiple_gyroscopes",
    "real2real_generalization",
    "sensor_specifications",
    "dataset_hours",
    "recording_quality",
}
RESULTS = {"augmentation_results", "real2real_results", "input_channels_results"}
FIGURES = {
    "running_average", "calibrated_signal", "mg_convergence", "allan_deviation",
    "input_channels_input_channels", "real2real_training_data", "real2real_gyroscopes_10s",
    "real2real_saving_against_turn_on_spread", "augmentation_sparkfun_3_real",
    "augmentation_sparkfun_12_real", "augmentation_dot_3_real", "augmentation_dot_12_real",
}  # fmt: skip


NO_SIGMA = {"median", "trimmed_mean", "ridge", "ridge_same_time", "window_mean_network"}


def files_of(**names):
    return {f"{kind}/{name}.{ending}" for kind in names for name in names[kind]
            for ending in FORMATS[kind]}  # fmt: skip


def by_estimator(runs, estimator):
    return [run for run in runs if run.data.params["estimator"] == estimator]


def identities(runs):
    return {run.info.run_id: (run.info.start_time, run.info.end_time) for run in runs}


def cell(run):
    return tuple(run.data.params[name] for name in CELL)


@dataclass(frozen=True)
class Step:
    """What there was after a command."""

    code: int
    output: str
    augmentation: list
    real2real: list
    report: dict
    page: str


def step(project, done):
    studies = (project.runs(study) for study in ("augmentation", "real2real"))
    report = {path.removeprefix(f"{REPORT}/"): b for path, b in project.files(REPORT).items()}
    page = (project.folder / f"{PAGE}.html").read_text()
    return Step(done.code, done.output, *studies, report, page)


# Each of these does the next thing in the same project.


@pytest.fixture(scope="module")
def repeated(smoke):
    return step(smoke.project, smoke.project.run_here("augmentation", "smoke"))


@pytest.fixture(scope="module")
def shared(smoke, repeated):
    done = smoke.project.run_here("real2real", "smoke", only={"sensor": "dot"}, execution=SERIAL)
    return step(smoke.project, done)


@pytest.fixture(scope="module")
def incomplete(smoke, shared):
    project = smoke.project
    wanted = ("dot", "12", "24", "10.0")
    (run,) = [one for one in by_estimator(shared.augmentation, "cnn") if cell(one) == wanted]
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
def channels(smoke, changed):
    only = {"window_s": 10}
    done = smoke.project.run_here("input_channels", "smoke", only=only, execution=SERIAL)
    return done, smoke.project.runs("input_channels")


@pytest.fixture(scope="module")
def whole(smoke, channels):
    return step(smoke.project, smoke.project.run_here("__default__", "smoke", execution=SERIAL))


@pytest.fixture(scope="module")
def without_a_run(smoke, whole):
    """Nine gyroscopes of DOT at 10 s: in one table and one figure."""
    project = smoke.project
    wanted = ("dot", "9", "0", "10.0")
    (run,) = [one for one in by_estimator(whole.real2real, "cnn") if cell(one) == wanted]
    MlflowClient(f"sqlite:///{project.store}").delete_run(run.info.run_id)
    return step(project, project.run_here("reporting", "smoke"))


@pytest.fixture(scope="module")
def without_recordings(smoke, without_a_run):
    """Of one sensor, and its roles."""
    project = smoke.project
    for layer, name in (("02_intermediate", "recordings.nc"), ("05_model_input", "roles.csv")):
        (project.folder / "data" / layer / "simulated_smoke" / "ng" / name).unlink()
    return step(project, project.run_here("reporting", "smoke"))


# The first run


def test_the_first_run_ends_well_and_says_where_to_look(smoke):
    assert smoke.done.code == 0, smoke.done.output
    last = smoke.done.output.strip().splitlines()[-4:]
    for line, words in zip(last, (REPORT, f"{PAGE}.html", "mlflow ui", "kedro viz"), strict=True):
        assert words in line
    assert "Traceback" not in smoke.done.output


def test_there_is_one_finished_run_for_each_cell(smoke):
    assert {run.info.status for run in smoke.runs} == {"FINISHED"}
    networks, means = by_estimator(smoke.runs, "cnn"), by_estimator(smoke.runs, "mean")
    assert Counter(map(cell, networks)) == Counter(
        product(("sparkfun", "dot"), ("3", "12"), ("0", "12", "24"), ("10.0", "30.0"))
    )
    assert Counter(map(cell, means)) == Counter(
        product(("sparkfun", "dot"), ("0",), ("0",), ("10.0", "30.0"))
    )


def test_parameters_keep_their_names(smoke):
    for run in by_estimator(smoke.runs, "cnn"):
        names = PARAMS | HYPER_PARAMETERS | {"folds"}
        names |= {"turn_on_jitter_mdps"} if run.data.params["virtual_gyros"] != "0" else set()
        assert set(run.data.params) == names
        fixed = {"study": "augmentation", "method": "2", "seed": "0", "fold": "-1", "epochs": "6"}
        assert {name: run.data.params[name] for name in fixed} == fixed
        assert run.data.params["source"] == "simulated_smoke"
        assert run.data.tags["simulated"] == "1"
    for run in by_estimator(smoke.runs, "mean"):
        assert set(run.data.params) == PARAMS | {"folds"}


def test_metrics_keep_their_names(smoke):
    name_of = re.compile(rf"({'|'.join(BASES)})(_all)?(_best)?(_disjoint|_true)?(_lo|_hi)?")
    for run in smoke.runs:
        metrics = run.data.metrics
        curves = (
            {"train_loss", "val_loss", "learning_rate"}
            if run.data.params["estimator"] == "cnn"
            else set()
        )
        assert curves <= set(metrics)
        for name in set(metrics) - curves:
            assert name_of.fullmatch(name), name
        suffixes = SUFFIXES if curves else [s for s in SUFFIXES if "_best" not in s]
        for base in ("test_rmse_dps", "mean_rmse_dps", "accuracy_gain_pct"):
            assert {base + s + end for s in suffixes for end in ("", "_lo", "_hi")} <= set(metrics)
        assert {"test_mse_dps2" + s.replace("_true", "_disjoint") for s in suffixes} <= set(metrics)
        ceilings = [s for s in suffixes if "_best" not in s]
        assert {f"ceiling_rmse_dps{s}" for s in ceilings} <= set(metrics)


def test_an_equivalent_time_is_a_number_or_is_said_to_be_none(smoke):
    for run in smoke.runs:
        for name in run.data.metrics:
            if name.startswith("test_rmse_dps") and not name.endswith(("_lo", "_hi")):
                time = name.replace("test_rmse_dps", "equivalent_time_s")
                assert (time in run.data.metrics) != (time in run.data.tags)


def test_curves_are_whole_and_end_at_the_last_epoch(smoke):
    client = MlflowClient(f"sqlite:///{smoke.project.store}")
    run = by_estimator(smoke.runs, "cnn")[0]
    for name in ("train_loss", "val_loss"):
        curve = client.get_metric_history(run.info.run_id, name)
        assert sorted(point.step for point in curve) == list(range(1, 7))
        last = max(curve, key=lambda point: point.step)
        assert run.data.metrics[name] == last.value


def test_metrics_are_those_of_the_errors_kept_with_the_run(smoke):
    for run in smoke.runs:
        folder = smoke.project.artifacts(run)
        assert folder.is_relative_to(smoke.project.folder)
        kept = {path.name for path in folder.iterdir()}
        network = run.data.params["estimator"] == "cnn"
        own = {
            "cnn": {"weights.pt", "history.csv"},
            "mean": {"running_mean_curve.parquet"},
            "residual_network": set(),
        }[run.data.params["estimator"]]
        assert kept == {"errors.parquet"} | own
        errors = pd.read_parquet(folder / "errors.parquet")
        for suffix in SUFFIXES if network else [""]:
            chosen = errors[errors.truth == ("true" if "_true" in suffix else "paper")]
            chosen = chosen[chosen.weights == ("best" if "_best" in suffix else "last")]
            chosen = chosen if "_all" in suffix else chosen[chosen.window == 0]
            rmse = np.sqrt((chosen.error_dps**2).mean())
            assert run.data.metrics[f"test_rmse_dps{suffix}"] == pytest.approx(rmse)
            mean = run.data.metrics[f"mean_rmse_dps{suffix}"]
            gain = run.data.metrics[f"accuracy_gain_pct{suffix}"]
            assert gain == pytest.approx(100 * (1 - rmse / mean))


def test_the_report_is_written(smoke):
    written = {path for path in smoke.files if path.startswith(REPORT)}
    assert written == {f"{REPORT}/{name}" for name in REPORTED}
    assert not [path for path in smoke.files if Path(path).name.startswith(".")]


def test_the_page_says_what_was_run_and_links_every_run(smoke):
    html, text = (smoke.files[f"{PAGE}.{suffix}"].decode() for suffix in ("html", "md"))
    for page in (html, text):
        assert "This is a smoke run, not a result." in page
        assert "Three real gyroscopes" in page
        assert "kedro run --pipeline=augmentation --env=smoke" in page
    assert html.count("data:image/png") == len([n for n in REPORTED if n.endswith(".png")])
    assert len(html) < 5e6
    for run in smoke.runs:
        assert f"#/experiments/{run.info.experiment_id}/runs/{run.info.run_id}" in html
        assert f"`{run.info.experiment_id}/{run.info.run_id}`" in text
    commit = smoke.runs[0].data.tags["mlflow.source.git.commit"]
    assert f"commit <code>{commit[:12] or 'unknown'}" in html


def test_tables_show_published_ours_and_the_ceiling_with_their_runs(smoke):
    ids = {run.info.run_id[:8] for run in smoke.runs}
    three, multiple = (
        pd.read_csv(smoke.project.folder / REPORT / "tables" / f"augmentation_{name}.csv")
        for name in ("three_gyroscopes", "multiple_gyroscopes")
    )
    assert three["Published S/A %"].tolist() == ["72/57", "84/79", "89/85"]
    assert multiple["Published S/A %"].tolist() == ["86/88", "84/77", "88/80"]
    for table in (three, multiple):
        assert table["Ceiling S %"].astype(str).str.fullmatch(r"\d+").all()  # exact: no interval
        assert table["A %"].str.fullmatch(r"-?\d+ \[-?\d+, -?\d+\]").all()
        assert table["Source"].eq("simulated_smoke").all()
        assert table["Recordings"].eq(4).all()
        assert {run for runs in table["Runs"] for run in runs.split()} <= ids
    by_id = {run.info.run_id[:8]: run for run in smoke.runs}
    for run_id, estimator, column in zip(
        three["Runs"][0].split(),
        ("cnn", "residual_network"),
        ("A %", "Residual network A %"),
        strict=True,
    ):
        run = by_id[run_id]
        assert cell(run) == ("sparkfun", "3", "0", "10.0")
        assert run.data.params["estimator"] == estimator
        gain = run.data.metrics["accuracy_gain_pct_all"]
        assert three[column][0].split()[0] == f"{gain:.0f}"


def test_runs_say_what_made_them(smoke):
    for run in smoke.runs:
        tags = run.data.tags
        assert tags["kedro_env"] == "smoke"
        assert re.fullmatch(r"[0-9a-f]{16}", tags["lock_hash"])
        assert re.fullmatch(r"[0-9a-f]{16}", tags["fingerprint"])
        assert {"kedro_run", "git_dirty", "mlflow.source.git.commit"} <= set(tags)
        assert {"torch", "numpy", "python", "data_hash"} <= set(tags)


# The next ones


def test_a_second_run_trains_nothing_and_says_so(smoke, repeated):
    assert repeated.code == 0, repeated.output
    skipped = "26 runs planned, 26 skipped (trained before), 0 shared with another study, 0 to"
    for sensor in ("sparkfun", "dot"):
        assert f"augmentation {sensor}: {skipped} train" in repeated.output
        assert f"{sensor}: 0 runs evaluated, 26 skipped" in repeated.output
    assert identities(repeated.augmentation) == identities(smoke.runs)
    before = {path.removeprefix(f"{REPORT}/"): b for path, b in smoke.files.items()}
    assert all(before[name] == content for name, content in repeated.report.items())
    assert repeated.page == smoke.files[f"{PAGE}.html"].decode()


def test_another_study_takes_the_cells_it_shares(smoke, shared):
    assert shared.code == 0, shared.output
    assert "18 runs planned, 0 skipped (trained before), 10 shared" in shared.output
    assert identities(shared.augmentation) == identities(smoke.runs)
    runs = shared.real2real
    assert len(by_estimator(runs, "cnn")) == 8
    assert len(by_estimator(runs, "residual_network")) == 8
    assert len(by_estimator(runs, "mean")) == 2
    assert {run.info.status for run in runs} == {"FINISHED"}
    twins = {run.data.tags["fingerprint"]: run for run in smoke.runs}
    for run in runs:
        assert run.data.params["study"] == "real2real"
        twin = twins.get(run.data.tags["fingerprint"])
        shares = run.data.params["real_gyros"] in ("0", "3", "12")
        assert (twin is not None) == shares
        assert run.data.tags.get("trained_in") == ("augmentation" if shares else None)
        if twin is not None:
            assert smoke.project.weights(run) == smoke.project.weights(twin)
            assert run.data.metrics == pytest.approx(twin.data.metrics, rel=1e-4)


def test_reporting_makes_what_it_can_and_names_what_is_missing(repeated, incomplete):
    assert incomplete.code != 0
    assert "Traceback" not in incomplete.output
    gone = {name for name in REPORTED if "multiple_gyroscopes" in name or "dot_12_real" in name}
    kept = {
        name for name in incomplete.report if re.match("(tables|figures)/(aug|recording)", name)
    }
    assert kept == REPORTED - gone
    three = "tables/augmentation_three_gyroscopes.md"
    assert incomplete.report[three] == repeated.report[three]
    results = incomplete.report["tables/augmentation_results.csv"].splitlines()
    assert len(results) == 1 + 51
    (command,) = set(re.findall(r"kedro run --pipeline=augmentation \S+", incomplete.output))
    for part in ("sensor=dot", "real_gyros=12", "virtual_gyros=24", "window_s=10", "seed=0"):
        assert f"only.{part}" in command
    assert "--pipeline=input_channels" in incomplete.output
    assert "--pipeline=ground_truth --params=only.sensor=ng" in incomplete.output
    assert "tables/sensor_specifications.csv" not in incomplete.report
    assert "figures/running_average.png" in incomplete.report
    assert "tables/input_channels_results.csv" not in incomplete.report
    assert len(incomplete.augmentation) == 51  # nothing was trained
    assert f"<code>{command} --env=smoke</code>" in incomplete.page


def test_the_command_it_names_repairs_it(incomplete, repaired):
    assert repaired.code == 0, repaired.output
    new = identities(repaired.augmentation).keys() - identities(incomplete.augmentation).keys()
    assert len(new) == 1
    assert len(repaired.augmentation) == 52
    assert set(repaired.report) >= REPORTED


def test_another_hyper_parameter_trains_anew_and_keeps_what_was(repaired, changed):
    assert changed.code == 0, changed.output
    before, after = identities(repaired.augmentation), identities(changed.augmentation)
    assert before.items() <= after.items()
    (new,) = [run for run in changed.augmentation if run.info.run_id not in before]
    assert new.data.params["hidden"] == "33"
    assert cell(new) == ("dot", "3", "0", "10.0")
    assert "3 runs planned, 2 skipped" in changed.output


def test_its_report_uses_the_new_run_and_says_what_it_does_not_use(smoke, repaired, changed):
    line = "24 older runs with other settings or data are in the store and not used"
    assert f"augmentation: {line}" in changed.output
    folder = smoke.project.folder / "data/07_model_output/simulated_smoke"
    # later steps have written these anew
    old = set(identities(by_estimator(repaired.augmentation, "cnn")))
    new = set(identities(changed.augmentation)) - set(identities(repaired.augmentation))
    assert len(old) == 24
    report = changed.report["tables/augmentation_results.csv"].decode()
    assert all(run_id[:8] in report for run_id in new)
    assert not [run_id for run_id in old if run_id[:8] in report]
    assert pd.read_csv(folder / "augmentation_unused.csv").columns[0] == "run_id"


def test_method_1_shares_its_cell_of_one_imu(smoke, channels):
    done, runs = channels
    assert done.code == 0, done.output
    assert "5 runs planned, 0 skipped (trained before), 2 shared" in done.output
    networks = {run.data.params["real_gyros"]: run for run in by_estimator(runs, "cnn")}
    assert networks.keys() == {"3", "6", "9", "12"}
    assert {run.data.params["method"] for run in networks.values()} == {"1"}
    shared = {gyros for gyros, run in networks.items() if "trained_in" in run.data.tags}
    assert shared == {"3"}
    twin = next(
        r for r in by_estimator(smoke.runs, "cnn") if cell(r) == ("sparkfun", "3", "0", "10.0")
    )
    assert smoke.project.weights(networks["3"]) == smoke.project.weights(twin)
    for run in networks.values():
        errors = pd.read_parquet(smoke.project.artifacts(run) / "errors.parquet")
        assert errors.groupby(["weights", "truth", "recording", "window"]).size().eq(3).all()


def test_the_whole_run_writes_every_table_and_figure(whole):
    assert whole.code == 0, whole.output
    assert set(whole.report) == files_of(tables=TABLES | RESULTS, figures=FIGURES)
    line = "augmentation: 1 older runs with other settings or data are in the store and not used"
    assert line in whole.output


def test_a_deleted_run_is_missed_by_exactly_what_needs_it(whole, without_a_run):
    assert without_a_run.code != 0
    gone = files_of(
        tables=["real2real_generalization"], figures=["real2real_saving_against_turn_on_spread"]
    )
    assert set(without_a_run.report) == set(whole.report) - gone
    assert set(re.findall(r"kedro run --pipeline=\S+ --params=\S+", without_a_run.output)) == {
        "kedro run --pipeline=real2real --params=only.sensor=dot,only.window_s=10,"
        "only.real_gyros=9,only.virtual_gyros=0,only.seed=0"
    }
    results = without_a_run.report["tables/real2real_results.csv"].splitlines()
    assert len(results) == len(whole.report["tables/real2real_results.csv"].splitlines()) - 1


def test_deleted_recordings_are_missed_by_exactly_what_needs_them(
    without_a_run, without_recordings
):
    gone = files_of(tables=["sensor_specifications", "dataset_hours"], figures=["allan_deviation"])
    assert set(without_recordings.report) == set(without_a_run.report) - gone
    for stage in ("ground_truth", "virtual_gyros"):
        assert f"kedro run --pipeline={stage} --params=only.sensor=ng" in without_recordings.output


@pytest.fixture(scope="module")
def estimators(new_project):
    """Of one sensor and window, made, and asked for again."""
    project = new_project()
    only = {"sensor": "sparkfun", "window_s": 10}
    done = project.run_here("estimators", "smoke", only=only)
    made = project.runs("estimators")
    return project, done, made, project.run_here("estimators", "smoke", only=only)


def test_every_estimator_without_a_network_is_a_finished_run(estimators):
    _, done, runs, _ = estimators
    assert done.code == 0, done.output
    assert sorted(run.data.params["estimator"] for run in runs) == sorted([*ESTIMATORS, "cnn"])
    for run in runs:
        assert run.info.status == "FINISHED"
    for run in (run for run in runs if run.data.params["estimator"] != "cnn"):
        assert set(run.data.params) == PARAMS | {"folds"}
        name, metrics = run.data.params["estimator"], run.data.metrics
        for suffix in ("", "_all", "_true", "_all_true"):
            assert {f"{base}{suffix}" for base in ("test_rmse_dps", "beats_oracle_p")} <= set(
                metrics
            )
        assert {"test_mse_dps2_all_disjoint", "ceiling_rmse_dps_all"} <= set(metrics)
        covered = {f"coverage_{n}sigma_all{truth}" for n in (1, 2) for truth in ("", "_true")}
        stated = name not in NO_SIGMA
        assert covered & set(metrics) == (covered if stated else set())
        assert ("uses_prior" in run.data.tags) == ESTIMATORS[name]().uses_prior


def test_they_are_compared_in_the_report_and_judged_once(estimators):
    project, _, runs, again = estimators
    assert again.code == 0, again.output
    assert f"sparkfun: 0 runs evaluated, {len(ESTIMATORS) + 1} skipped" in again.output
    assert identities(project.runs("estimators")) == identities(runs)
    table = pd.read_csv(project.folder / REPORT / "tables/estimators_comparison.csv")
    assert table["Estimator"].tolist() == [*ESTIMATORS, "cnn", "cnn_best"]
    by_name = {run.data.params["estimator"]: run for run in runs}
    rmse = 1e3 * by_name["ridge"].data.metrics["test_rmse_dps_all"]
    assert table.set_index("Estimator")["RMSE mdps"]["ridge"] == pytest.approx(rmse, abs=1e-3)
    page = (project.folder / f"{PAGE}.html").read_text()
    assert "SparkFun: estimators, error relative to the running mean" in page
    assert "best linear history (recommended)" in page
    assert ORIENTATION_NOTE in page


def test_ground_truth_alone(new_project):
    project = new_project()
    assert project.run_here("ground_truth", "smoke", only={"sensor": "ng"}).code == 0
    folder = project.folder / "data/03_primary/simulated_smoke/ng"
    assert len(pd.read_csv(folder / "bias.csv")) == 2 * 14 * 3
    noise = pd.read_csv(folder / "noise.csv")
    assert len(noise) == 2 * 3
    assert noise.white_dps_rts.mean() == pytest.approx(0.005, rel=0.1)
    assert project.runs("real2real") == []


# The real file


@pytest.fixture(scope="module")
def memsense(new_project):
    folder = os.environ.get("GYRO_PIPELINE_REAL_DATA")
    if not folder:
        pytest.skip("GYRO_PIPELINE_REAL_DATA names no folder of real recordings")
    file = Path(folder, REAL_FILE)
    if not file.is_file():
        pytest.skip(f"{REAL_FILE} is not in GYRO_PIPELINE_REAL_DATA, {folder}")
    project = new_project()
    raw = project.folder / "data/01_raw/published"
    raw.mkdir(parents=True)
    shutil.copy(file, raw)
    done = project.run_here("real2real", "memsense_real", training={"epochs": 2}, execution=SERIAL)
    return project, done, project.runs("real2real")


def test_the_real_file_gives_a_run_of_each_fold(memsense):
    _, done, runs = memsense
    assert done.code == 0, done.output
    assert {run.info.status for run in runs} == {"FINISHED"}
    folds = Counter(
        (run.data.params["window_s"], run.data.params["fold"]) for run in by_estimator(runs, "cnn")
    )
    assert folds == Counter(product(("10.0", "30.0"), map(str, range(11))))
    means = by_estimator(runs, "mean")
    assert sorted(run.data.params["window_s"] for run in means) == ["10.0", "30.0"]
    for run in runs:
        assert run.data.params["sensor"] == "memsense"
        assert run.data.params["source"] == "published"
        assert run.data.params["folds"] == "11"
        assert run.data.tags["simulated"] == "0"
        assert not any("_true" in name for name in run.data.metrics)


def test_the_running_means_error_on_the_real_file_is_the_known_one(memsense):
    _, done, runs = memsense
    (mean,) = [r for r in by_estimator(runs, "mean") if r.data.params["window_s"] == "10.0"]
    assert f"{mean.data.metrics['test_rmse_dps']:.7f}" == "0.0015854"
    assert f"{mean.data.metrics['test_rmse_dps_all']:.6f}" == "0.001508"
    (line,) = [one for one in done.output.splitlines() if "memsense mean 10 s: RMSE" in one]
    assert "0.0015854 deg/s" in line
    assert "0.001508 " in line


def test_the_real_file_stands_beside_the_simulated_one_in_the_report(memsense):
    project, _, runs = memsense
    changes = {"training": {"epochs": 2}, "only": {"window_s": 10}}
    done = project.run_here("real2real", "smoke", **changes, execution=SERIAL)
    assert done.code == 0, done.output
    folder = project.folder / REPORT / "tables"
    table = pd.read_csv(folder / "real2real_generalization.csv")
    assert table["Sensor"].tolist() == ["sparkfun", "dot", "ng", "memsense", "memsense"]
    row = table.iloc[-1]
    assert row["Source"] == "published (measured)"
    assert row["Gyroscopes"] == "3 real"
    assert row["Split"] == "k-fold, 11 folds"
    assert row["Published S/A %"] == "75/75 (6 real)"
    ids = {run.info.run_id[:8] for run in runs if run.data.params["window_s"] == "10.0"}
    assert set(row["Runs"].split()) <= ids
    assert len(row["Runs"].split()) == 11 + 1  # and the residual network
    results = pd.read_csv(folder / "real2real_results.csv")
    assert (results.source == "published (measured)").sum() == 6


def test_estimators_without_a_network_reach_on_the_real_file_what_is_known(memsense):
    project, _, _ = memsense
    asked = ["mean", "training_mean", "empirical_bayes", "best_linear"]
    studies = {"estimators": {"windows_s": [10], "estimators": asked}}
    done = project.run_here("estimators", "memsense_real", studies=studies)
    assert done.code == 0, done.output
    runs = {run.data.params["estimator"]: run for run in project.runs("estimators")}
    assert set(runs) == set(asked)
    assert all(run.data.params["folds"] == "11" for run in runs.values())
    rmse = {name: run.data.metrics["test_rmse_dps_all"] for name, run in runs.items()}
    assert f"{rmse['training_mean']:.7f}" == "0.0014536"
    assert 0.53 < rmse["empirical_bayes"] / rmse["mean"] <= 0.72
    assert 0.53 < rmse["best_linear"] / rmse["mean"] <= 0.72
    assert 0.6 <= runs["best_linear"].data.metrics["coverage_1sigma_all"] <= 0.78
