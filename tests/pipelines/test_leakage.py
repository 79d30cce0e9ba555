"""The leak study from plan to table, on small simulated recordings."""

from dataclasses import dataclass, replace

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
import pytest
import torch
import xarray as xr

from gyro_pipeline.conventions import (
    BEST_EPOCH_ON_TEST,
    HOLD_OUT,
    LEAKS,
    NO_LEAK,
    TEST_IN_TRAINING,
    WINDOW_SPLIT,
    InputError,
)
from gyro_pipeline.datasets.reports import to_latex, to_markdown
from gyro_pipeline.parameters import Execution, Only
from gyro_pipeline.pipelines.evaluation.leakage import evaluate_leakage
from gyro_pipeline.pipelines.ground_truth.nodes import measure_allan_variance, measure_bias
from gyro_pipeline.pipelines.reporting import leakage as report
from gyro_pipeline.pipelines.reporting.nodes import pool_results
from gyro_pipeline.pipelines.training import nodes
from gyro_pipeline.pipelines.training.leakage import plan_leakage, train_leakage
from gyro_pipeline.studies import CNN, CNN_SHUFFLED
from gyro_pipeline.tracking import CURVE, ERRORS, EVALUATED_WITH, FINGERPRINT, WEIGHTS

SERIAL = Execution(executor="serial", workers=None)
SAMPLES, RATE_HZ, NOISE, SPREAD = 1300, 25.0, 5e-3, 1e-3
LONG_S, SHORT_S = 10.0, 0.16


@dataclass(frozen=True)
class World:
    """All that the leak study's nodes take."""

    recordings: xr.Dataset
    allan: xr.Dataset
    bias: pd.DataFrame
    parameters: object
    seeds: tuple = (0,)
    only: Only = Only()

    def plan(self):
        p = self.parameters
        given = (p.leakage, self.recordings, list(self.seeds), self.only, p.training, p.splits)
        return plan_leakage(*given)

    def train(self, cells, tracked=()):
        p = self.parameters
        given = (self.recordings, self.bias, p.leakage, p.training, p.splits, SERIAL)
        return list(train_leakage(cells, list(tracked), *given))

    def evaluate(self, cells, runs):
        p = self.parameters
        given = (self.recordings, self.bias, self.allan, p.leakage, p.splits, p.evaluation)
        return list(evaluate_leakage(cells, list(runs), *given))


@pytest.fixture(scope="module")
def small(make_recordings, parameters):
    """One IMU, 12 recordings of white noise, of which the study takes 11."""
    generator = np.random.default_rng(3)
    unit = generator.uniform(-0.02, 0.02, (1, 3))
    bias = unit[:, None] + generator.normal(0, SPREAD, (1, 12, 3))
    made = make_recordings(bias, SAMPLES, RATE_HZ, NOISE)
    recordings = made.assign(
        true_bias=(("imu", "recording", "axis"), bias),
        true_unit_bias=(("imu", "axis"), unit),
        true_turn_on_spread=("axis", np.full(3, SPREAD)),
        true_noise=("axis", np.full(3, NOISE)),
        true_flicker=0.0,
    ).assign_attrs(simulated=1, sensor="memsense")
    p = parameters(
        leakage={
            "strides_s": [LONG_S, SHORT_S],
            "steps": 600,
            "network": {"channels": 16, "kernel": 8, "stride": 2, "pool": 2, "hidden": 64},
        },
        training={"learning_rate": 1e-3},
        evaluation={"resamples": 200},
    )
    allan = measure_allan_variance(recordings)
    return World(recordings, allan, measure_bias(recordings, allan, p.ground_truth), p)


@pytest.fixture(scope="module")
def cells(small):
    return small.plan()


@pytest.fixture(scope="module")
def trained(small, cells):
    return small.train(cells)


@pytest.fixture(scope="module")
def evaluated(small, cells, trained, as_stored):
    """The runs as the store has them in the end."""
    stored = [as_stored(run, f"run{number}") for number, run in enumerate(trained)]
    done = {run.run_id: run for run in small.evaluate(cells, stored)}
    return [
        replace(
            run,
            finished=True,
            metrics=done[run.run_id].metrics,
            tags={**run.tags, **done[run.run_id].tags},
            load={**one.artifacts, **done[run.run_id].artifacts}.__getitem__,
        )
        for run, one in zip(stored, trained, strict=True)
    ]


@pytest.fixture(scope="module")
def results(small, cells, evaluated):
    given = {"memsense_cells": cells, "memsense_runs": evaluated}
    return report.pool_leakage(small.parameters.evaluation, **given)


def of(runs, leak, estimator=CNN, stride_s=SHORT_S):
    wanted = {"leak": leak, "estimator": estimator, "window_stride_s": str(stride_s)}
    return [run for run in runs if {k: str(run.params[k]) for k in wanted} == wanted]


def way(results, leak, estimator=CNN, stride_s=SHORT_S):
    match = (results.leak == leak) & (results.estimator == estimator)
    (row,) = results[match & (results.window_stride_s == stride_s)].to_dict("records")
    return row


# plan and train


def test_a_plan_has_every_fold_of_every_way_and_a_fingerprint_for_each(cells):
    assert len(cells) == 2 * (4 * 5 + 1)
    assert cells[FINGERPRINT].is_unique
    assert set(cells.leak) == set(LEAKS)
    assert set(cells[cells.leak == TEST_IN_TRAINING].fold) == {HOLD_OUT}


def test_fingerprints_know_the_data_the_deal_the_network_and_the_training(small, cells):
    def changed(recordings=small.recordings, **groups):
        p = small.parameters
        groups = {k: getattr(p, k).model_copy(update=v) for k, v in groups.items()}
        one = replace(small, recordings=recordings, parameters=p.model_copy(update=groups)).plan()
        return set(one[FINGERPRINT]) & set(cells[FINGERPRINT])

    assert len(changed()) == len(cells)
    assert len(changed(execution={"workers": 1}, evaluation={"resamples": 999})) == len(cells)
    assert len(changed(leakage={"strides_s": [LONG_S]})) == len(cells) / 2
    assert not changed(splits={"split_seed": 1})
    assert not changed(training={"learning_rate": 2e-3})
    assert not changed(leakage={"steps": 601})
    assert not changed(leakage={"recordings": 12})
    assert not changed(small.recordings.assign_attrs(data_hash="other"))


@pytest.mark.parametrize(
    ("only", "message"),
    [
        ({"real_gyros": 6}, "only={'real_gyros': 6} leaves nothing of the leak study: 3 real"),
        ({"window_s": 30}, r"leaves nothing of the leak study: .* 10 s, seeds \[0\]"),
    ],
)
def test_an_only_that_leaves_nothing_is_refused(small, only, message):
    with pytest.raises(InputError, match=message):
        replace(small, only=Only(**only)).plan()


def test_a_recording_without_a_window_is_not_used(small, as_stored, caplog):
    recordings = small.recordings.copy(deep=True)
    recordings.angular_rate.loc[{"recording": 3}][..., ::5] = np.nan
    p = small.parameters
    leakage = p.leakage.model_copy(update={"strides_s": [LONG_S], "steps": 1})
    lossy = replace(small, recordings=recordings)
    lossy = replace(lossy, parameters=p.model_copy(update={"leakage": leakage}))
    cells = lossy.plan()
    assert "leakage memsense, 10 s windows: 5 of 60 lost more than 10%" in caplog.text
    runs = [as_stored(run, f"run{number}") for number, run in enumerate(lossy.train(cells))]
    tested = {n for run in lossy.evaluate(cells, runs) for n in run.artifacts[ERRORS].recording}
    assert tested == {1, 2, *range(4, 13)}  # the twelfth one in its place
    lossy.recordings.angular_rate[..., ::5] = np.nan
    with pytest.raises(InputError, match="recordings with a window of 10 s .*, got 0; lower"):
        lossy.plan()


def test_runs_are_marked_and_apart(cells, trained):
    assert {run.tags[FINGERPRINT] for run in trained} == set(cells[FINGERPRINT])
    for run in trained:
        assert run.study == run.params["study"] == "leakage"
        assert run.params["leak"] in LEAKS
        assert run.params["window_stride_s"] in (LONG_S, SHORT_S)
        assert (run.params["recordings"], run.params["channels"]) == (11, 16)
        assert run.params["folds"] == (1 if run.params["leak"] == TEST_IN_TRAINING else 5)


def test_only_the_leak_that_chooses_the_epoch_sees_a_test_loss(trained):
    for run in trained:
        chooses = run.params["leak"] == BEST_EPOCH_ON_TEST
        assert ("val_loss" in run.history) == chooses
        assert (run.artifacts[WEIGHTS]["best"] is not None) == chooses


def test_choosing_the_epoch_on_test_is_all_that_it_changes(trained):
    for one, other in zip(of(trained, NO_LEAK), of(trained, BEST_EPOCH_ON_TEST), strict=True):
        assert one.params["fold"] == other.params["fold"]
        for name, weights in one.artifacts[WEIGHTS]["last"].items():
            assert torch.equal(weights, other.artifacts[WEIGHTS]["last"][name])


def test_what_is_trained_is_not_trained_again(small, cells, evaluated, monkeypatch):
    monkeypatch.setattr(nodes, "run_trainings", lambda jobs, *_: iter(jobs and 1 / 0))
    assert small.train(cells, evaluated) == []
    assert small.evaluate(cells, evaluated) == []


def test_only_what_is_missing_is_trained(small, cells, evaluated):
    (run,) = small.train(cells, evaluated[1:])
    assert run.tags[FINGERPRINT] == evaluated[0].fingerprint


# evaluation


def test_the_errors_are_those_of_all_windows_each_tested_once(evaluated):
    for leak, estimator in report.WAYS:
        errors = pd.concat([run.load(ERRORS) for run in of(evaluated, leak, estimator)])
        assert len(errors) == 11 * 263 * 3
        assert not errors.duplicated(["recording", "start", "axis"]).any()
        assert set(errors.recording) == set(range(1, 12))
        assert set(errors.start) == set(range(0, 1051, 4))


def test_errors_of_the_mean_and_the_constant_are_those_computed_by_hand(small, evaluated):
    run = of(evaluated, NO_LEAK)[0]
    errors = run.load(ERRORS)
    rates = small.recordings.angular_rate.sel(imu=1).to_numpy().astype(np.float64)
    whole = rates.mean(axis=-1)
    trained = sorted({*range(1, 12)} - set(errors.recording))
    constant = whole[np.array(trained) - 1].mean(axis=0)
    for row in errors.sample(30, random_state=1).itertuples():
        axis, number = "xyz".index(row.axis), row.recording - 1
        window = rates[number, axis, row.start : row.start + 250]
        assert row.mean_error_dps == pytest.approx(window.mean() - whole[number, axis], abs=1e-9)
        assert row.constant_error_dps == pytest.approx(
            constant[axis] - whole[number, axis], abs=1e-9
        )


def test_metrics_cannot_be_taken_for_those_of_other_studies(evaluated):
    for run in evaluated:
        names = {name for name in run.metrics if not name.startswith("ceiling")}
        assert names
        assert all("_strided" in name for name in names)
        assert "beats_oracle_p" not in run.metrics
        assert run.tags[EVALUATED_WITH]


def test_a_report_of_another_study_takes_no_run_of_the_leak_study(small, evaluated, make_study):
    p = small.parameters
    sensors = {"memsense": p.studies["real2real"].sensors["memsense"]}
    study = p.studies["real2real"].model_copy(update={"sensors": sensors})
    disguised = [replace(run, study="real2real") for run in evaluated]
    settings = (p.leakage.training(p.training, 1), p.splits, p.virtual_gyros, p.evaluation)
    results, _, _ = pool_results(study, "test", [10.0], [0], *settings, disguised)
    assert results.run_ids.isna().all()
    assert results.missing.notna().all()


# the report


def test_leaks_gain_what_the_honest_split_does_not(results):
    honest, constant = (
        way(results, NO_LEAK)["accuracy_gain_pct"],
        way(results, NO_LEAK)["constant_accuracy_gain_pct"],
    )
    ceiling = way(results, NO_LEAK)["ceiling_accuracy_gain_pct"]
    assert honest < ceiling + 10
    assert way(results, WINDOW_SPLIT)["accuracy_gain_pct"] > ceiling
    assert way(results, TEST_IN_TRAINING)["accuracy_gain_pct"] > ceiling
    assert way(results, BEST_EPOCH_ON_TEST)["accuracy_gain_pct"] >= honest
    assert constant < ceiling


def test_windows_that_do_not_overlap_gain_less_by_a_window_split(results):
    far, near = (way(results, WINDOW_SPLIT, stride_s=s) for s in (LONG_S, SHORT_S))
    assert far["accuracy_gain_pct"] < near["accuracy_gain_pct"] - 10
    assert (far["windows"], near["windows"]) == (55, 11 * 263)


def test_the_check_against_the_oracle_finds_the_leaks_and_not_the_honest_split(results):
    for stride_s in (LONG_S, SHORT_S):
        for estimator in (CNN, CNN_SHUFFLED):
            honest = way(results, NO_LEAK, estimator, stride_s)
            assert honest["beats_oracle_p"] > report.ONE_SIDED
    for leak in (WINDOW_SPLIT, TEST_IN_TRAINING):
        assert way(results, leak)["beats_oracle_p"] < report.ONE_SIDED


def test_shuffled_labels_do_not_beat_the_constant(results):
    for stride_s in (LONG_S, SHORT_S):
        assert way(results, NO_LEAK, CNN_SHUFFLED, stride_s)["over_constant_dps2_hi"] > 0
    # and the check has the power to see that a network does
    assert way(results, WINDOW_SPLIT)["over_constant_dps2_hi"] < 0


def test_the_table_shows_the_ways_side_by_side(small, results):
    table = report.results_table(results, small.parameters.published)
    assert table["Window stride s"].tolist() == [LONG_S, SHORT_S]
    assert table["Published S/A %"].tolist() == ["75/75"] * 2
    assert table["Shuffled beats the constant"].tolist() == ["no"] * 2
    assert "Windows split at random" in table["Beats the oracle"][1]
    assert "Honest split" not in table["Beats the oracle"][1]
    assert table["Source"].eq("test (simulated)").all()
    gain = way(results, WINDOW_SPLIT)["accuracy_gain_pct"]
    shown = table["Windows split at random S/A %"][1]
    assert shown.split("/")[1].split()[0] == f"{gain:.0f}"
    assert to_markdown(table).count("\n") == 4
    assert "tabular" in to_latex(table)


def test_the_figure_shows_every_way_with_the_ceiling_and_the_published_gain(small, results):
    p = small.parameters
    sensors = {name: sensor.model_dump() for name, sensor in p.sensors.items()}
    figure = report.accuracy_against_stride(results, p.published, p.leakage, sensors)
    (ax,) = figure.axes
    labels = ax.get_legend_handles_labels()[1]
    assert set(report.WAYS.values()) < set(labels)
    assert {"running mean", "published, 6 gyroscopes"} < set(labels)
    assert ax.get_ylabel()
    assert ax.get_xlabel()
    assert [tick.get_text() for tick in ax.get_xticklabels()] == ["0.16\n= 1 hop", "10\n62.5 hops"]
    plt.close(figure)


def test_the_curve_is_that_of_all_recordings_used(evaluated):
    curve = evaluated[0].load(CURVE)
    assert set(curve.recording) == set(range(1, 12))
    assert set(curve.windows) == {"all"}
