"""Which rows the studies of the configuration have, and which runs these need."""

from dataclasses import replace
from itertools import product

import pytest

from gyro_pipeline import studies
from gyro_pipeline.estimators import ESTIMATORS, estimator_class
from gyro_pipeline.parameters import Only


@pytest.fixture(scope="module")
def base(parameters):
    return parameters("base")


def rows_of(p, study, **only):
    """All rows of a study, on all its sensors."""
    asked = p.studies[study]
    return [
        row
        for sensor in asked.sensors_among(p.sensors)
        for row in studies.study_rows(asked, sensor, p.source, p.windows_s, p.seeds, Only(**only))
    ]


def runs_of(p, study, **only):
    return studies.run_specs(rows_of(p, study, **only), p.studies[study].unseen_devices)


NAMES = ("augmentation", "dot", "simulated", "by_recording", "cnn")
ROW = studies.RunSpec(*NAMES, 2, 12, 24, 10.0, 10.0, seed=3)


def places(runs, estimator):
    """Sensor, real and virtual gyroscopes and window of an estimator's runs, sorted."""
    names = ("sensor", "real_gyros", "virtual_gyros", "window_s")
    found = [run for run in runs if run.estimator == estimator]
    return sorted(tuple(getattr(run, name) for name in names) for run in found)


def test_a_row_is_reduced_to_what_its_estimator_uses():
    for estimator, known, unseen in (
        ("median", (2, 0, 0, 0), (2, 0, 0, 0)),
        ("best_linear", (2, 3, 0, 0), (2, 12, 0, 0)),
        ("empirical_bayes_pooled", (2, 12, 0, 0), (2, 12, 0, 0)),
        ("cnn", (2, 12, 24, 3), (2, 12, 24, 3)),
    ):
        row = replace(ROW, estimator=estimator)
        for unseen_devices, expected in ((False, known), (True, unseen)):
            run = studies.run_spec(row, unseen_devices)
            assert (run.method, run.real_gyros, run.virtual_gyros, run.seed) == expected
            same = {"method": 0, "real_gyros": 0, "virtual_gyros": 0, "seed": 0}
            assert replace(run, **same) == replace(row, **same)
    row = replace(ROW, method=1, virtual_gyros=0)  # one IMU is the same in both methods
    methods = [studies.run_spec(replace(row, real_gyros=count), False).method for count in (3, 6)]
    assert methods == [2, 1]


@pytest.mark.parametrize(
    ("only", "networks", "means"),
    [
        ({"real_gyros": 3}, 12, 4),
        ({"sensor": "dot", "window_s": 10, "real_gyros": 12, "seed": 0}, 3, 1),
        ({"sensor": "ng"}, 0, 0),
    ],
)
def test_only_narrows_and_a_running_mean_stays_wherever_another_estimator_does(
    base, parameters, only, networks, means
):
    whole, rows = rows_of(base, "augmentation"), rows_of(base, "augmentation", **only)
    assert set(rows) <= set(whole)
    asked = [row for row in rows if row.estimator == "cnn"]
    assert len(asked) == networks
    # a residual network, a constant and the best linear estimator are beside each
    others = [row for row in rows if row.estimator not in ("cnn", "mean")]
    assert len(others) == 3 * networks
    assert len(rows) == 4 * networks + means
    for name, value in only.items():
        assert {getattr(row, name) for row in asked} <= {value}
    used = studies.used_sensors(parameters("base", only=only))["augmentation"]
    assert set(used) == {row.sensor for row in rows}


def test_augmentation_is_the_papers_grid_with_a_running_mean_for_each_window(base):
    grid = product(["dot", "sparkfun"], [3, 12], [0, 12, 24], [10.0, 30.0])
    runs = runs_of(base, "augmentation")
    assert places(runs, "cnn") == sorted(grid)
    # virtual gyroscopes teach it nothing: their rows are runs without them
    grid = product(["dot", "sparkfun"], [3, 12], [0], [10.0, 30.0])
    assert places(runs, "residual_network") == sorted(grid)
    grid = sorted(product(["dot", "sparkfun"], [3], [0], [10.0, 30.0]))
    for name in ("mean", "training_mean", "best_linear"):
        assert places(runs, name) == grid
    assert len(runs) == 24 + 8 + 3 * 4
    kinds = {(run.method, run.source, run.protocol) for run in runs}
    assert kinds == {(2, "simulated", "by_recording")}


def test_the_other_grids_are_the_papers_and_all_three_need_46_networks(base):
    imus = {"sparkfun": 4, "dot": 4, "ng": 2, "memsense": 2}
    grid = [(s, 3 * n, 0, w) for s, m in imus.items() for n in range(1, 1 + m) for w in (10, 30)]
    assert places(runs_of(base, "real2real"), "cnn") == sorted(grid)
    channels = runs_of(base, "input_channels")
    grid = product(["sparkfun"], (3, 6, 9, 12), [0], (10, 30))
    assert places(channels, "cnn") == list(grid)
    assert {(run.real_gyros > 3, run.method) for run in channels} == {(False, 2), (True, 1)}
    names = ("augmentation", "real2real", "input_channels")
    runs = {replace(run, study="") for study in names for run in runs_of(base, study)}
    assert sum(run.estimator == "cnn" for run in runs) == 46
    assert sum(run.estimator == "mean" for run in runs) == 8


def test_the_estimators_study_is_all_of_them_at_five_windows_on_every_sensor(base, parameters):
    runs = runs_of(base, "estimators")
    names = [name for name in ESTIMATORS if name == "cnn" or not estimator_class(name).seeded]
    named = [(run.estimator, run.sensor, run.window_s) for run in runs]
    assert sorted(named) == sorted(product(names, base.sensors, (1.0, 2.0, 5.0, 10.0, 30.0)))
    mine = parameters("base", sensors={"mine": {}})
    assert {row.sensor for row in rows_of(mine, "unseen_devices")} == {*base.sensors, "mine"}


def test_the_leak_study_has_every_way_of_training_at_every_stride(base):
    rows = rows_of(base, "leakage")
    ways = {(row.protocol, row.estimator) for row in rows}
    leaks = ("window_split", "test_in_training", "best_epoch_on_test")
    by_recording = {("k_fold", name) for name in ("mean", "training_mean", "cnn", "cnn_shuffled")}
    assert ways == by_recording | {(leak, "cnn") for leak in leaks}
    strides = base.studies["leakage"].strides_s
    found = {(row.protocol, row.estimator, row.window_stride_s) for row in rows}
    assert found == {(*way, stride) for way, stride in product(ways, strides)}
    others = [row for study in base.studies if study != "leakage" for row in rows_of(base, study)]
    assert {row.window_stride_s == row.window_s for row in others} == {True}
    assert {row.protocol for row in others} == {"by_recording", "leave_one_device_out"}


def test_a_run_carries_its_identity_and_the_settings_that_it_depends_on(base):
    def params_of(row, study="augmentation"):
        given = base.training, base.splits, base.virtual_gyros
        return studies.run_params(row, base.studies[study], *given)

    identity, splits = set(studies.RunSpec.names()), set(base.splits.model_dump()) - {"folds"}
    virtual = {f"virtual_{name}" for name in base.virtual_gyros.model_dump()}
    training = set(base.training.model_dump(exclude_none=True))
    assert set(params_of(ROW)) == identity | splits | virtual | training
    alone = replace(ROW, estimator="best_linear", virtual_gyros=0)
    assert set(params_of(alone)) == identity | splits
    leak = params_of(replace(ROW, virtual_gyros=0), "leakage")
    assert (leak["steps"], leak["channels"], leak["window_stride_s"]) == (3000, 16, 10.0)
    assert leak.items() >= {"study": "augmentation", "seed": 3, "real_gyros": 12}.items()


def test_a_sweep_is_a_run_for_every_combination_named_by_what_differs(parameters):
    p = parameters("base", sweep={"learning_rate": "1e-4/0.001", "units": [4, 8]})
    study = p.studies["sweep"].model_copy(update={"estimators": ["lstm", "ridge"]})
    rows = studies.study_rows(study, "sparkfun", "simulated", [10.0], [0], Only())
    combinations = product(("0.0001", "0.001"), (4, 8))
    expected = {f"lstm learning_rate={rate} units={units}" for rate, units in combinations}
    assert {row.estimator for row in rows} == {"mean", "ridge", *expected}
    last = next(row for row in rows if row.estimator == "lstm learning_rate=0.001 units=8")
    params = studies.run_params(last, study, p.training, p.splits, p.virtual_gyros)
    assert (params["learning_rate"], params["units"], params["layers"]) == (0.001, 8, 1)
    assert "channels" not in params
    assert studies.study_rows(p.studies["real2real"], "ng", "simulated", [10.0], [0], Only())
