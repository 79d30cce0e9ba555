from collections import Counter
from dataclasses import replace
from itertools import product

import pytest

from gyro_pipeline.conventions import HOLD_OUT, LEAKS, NO_LEAK, TEST_IN_TRAINING, InputError
from gyro_pipeline.estimators import ESTIMATORS
from gyro_pipeline.fingerprints import fingerprint
from gyro_pipeline.parameters import Only
from gyro_pipeline.studies import (
    CNN,
    CNN_SHUFFLED,
    LEAKAGE,
    MEAN,
    RESIDUAL_NETWORK,
    Cell,
    LeakCell,
    leak_cells,
    leak_params,
    leak_sensors,
    over_folds,
    run_params,
    study_cells,
    used_sensors,
)


@pytest.fixture(scope="module")
def base(parameters):
    return parameters("base")


def cells_of(parameters, study, **only):
    """All cells of a study, on all its sensors."""
    p = parameters
    asked = p.studies[study]
    return [
        cell
        for sensor in asked.sensors
        for cell in study_cells(asked, sensor, p.source, p.windows_s, p.seeds, Only(**only))
    ]


def networks(cells):
    return [cell for cell in cells if cell.estimator == CNN]


def distinct(cells):
    return {fingerprint(cell.content) for cell in cells}


CELL = Cell("real2real", 2, "dot", "simulated", 6, 12, 10.0, 0, HOLD_OUT, CNN)
ALONE = Cell("input_channels", 1, "sparkfun", "simulated", 3, 0, 10.0, 0, HOLD_OUT, CNN)


# the grids


def test_augmentation_is_24_networks_and_4_running_means(base):
    cells = cells_of(base, "augmentation")
    grid = product(["sparkfun", "dot"], [3, 12], [0, 12, 24], [10.0, 30.0])
    named = [(c.sensor, c.real_gyros, c.virtual_gyros, c.window_s) for c in networks(cells)]
    assert sorted(named) == sorted(grid)
    residual = [c for c in cells if c.estimator == RESIDUAL_NETWORK]
    named = [(c.sensor, c.real_gyros, c.virtual_gyros, c.window_s) for c in residual]
    assert sorted(named) == sorted(product(["sparkfun", "dot"], [3, 12], [0, 12, 24], [10.0, 30.0]))
    means = [(c.sensor, c.window_s) for c in cells if c.estimator == MEAN]
    assert sorted(means) == [("dot", 10), ("dot", 30), ("sparkfun", 10), ("sparkfun", 30)]
    assert {(c.method, c.seed, c.fold, c.source) for c in networks(cells)} == {
        (2, 0, HOLD_OUT, "simulated")
    }


@pytest.mark.parametrize(
    ("study", "method", "gyroscopes"),
    [
        ("real2real", 2, {"sparkfun": 4, "dot": 4, "ng": 2, "memsense": 2}),
        ("input_channels", 1, {"sparkfun": 4}),
    ],
)
def test_the_other_grids_are_the_papers(base, study, method, gyroscopes):
    cells = networks(cells_of(base, study))
    counts = [(c.sensor, c.real_gyros, c.window_s) for c in cells]
    expected = [
        (s, 3 * n, w) for s, m in gyroscopes.items() for n in range(1, 1 + m) for w in (10, 30)
    ]
    assert sorted(counts) == sorted(expected)
    assert {(c.method, c.virtual_gyros) for c in cells} == {(method, 0)}


def test_the_three_studies_of_the_paper_need_46_trainings(base):
    studies = ("augmentation", "real2real", "input_channels")
    cells = sum((cells_of(base, study) for study in studies), [])
    assert len(networks(cells)) == 24 + 24 + 8
    assert len(distinct(networks(cells))) == 46
    assert len(distinct([c for c in cells if c.estimator == MEAN])) == 8


def test_the_estimators_study_is_all_of_them_at_five_windows_on_every_sensor(base):
    cells = cells_of(base, "estimators")
    named = Counter((c.estimator, c.sensor, c.window_s) for c in cells)
    every = product((*ESTIMATORS, CNN), base.sensors, (1.0, 2.0, 5.0, 10.0, 30.0))
    assert named == Counter(every)
    fitted = [c for c in cells if c.estimator not in (MEAN, CNN)]
    assert {(c.method, c.real_gyros, c.seed, c.fold) for c in fitted} == {(0, 3, 0, HOLD_OUT)}
    assert {(c.method, c.real_gyros, c.virtual_gyros) for c in networks(cells)} == {(2, 3, 0)}


def test_estimators_are_the_same_for_every_seed_and_narrowed_like_networks(base, parameters):
    full, one = (cells_of(p, "estimators") for p in (parameters("full"), base))
    assert [c for c in full if c.estimator != CNN] == [c for c in one if c.estimator != CNN]
    narrowed = cells_of(base, "estimators", sensor="dot", window_s=10, real_gyros=3)
    assert [c.estimator for c in narrowed] == [*ESTIMATORS, CNN]
    assert cells_of(base, "estimators", real_gyros=6) == []
    assert cells_of(base, "estimators", virtual_gyros=12) == []


def test_full_is_five_seeds_of_base(base, parameters):
    full = parameters("full")
    cells = networks(cells_of(full, "augmentation"))
    assert len(cells) == len(distinct(cells)) == 5 * 24
    one_seed = networks(cells_of(base, "augmentation"))
    assert [c for c in cells if c.seed == 0] == one_seed
    assert sum(c.estimator == MEAN for c in cells_of(full, "augmentation")) == 4


# what a cell depends on


def test_one_imu_is_the_same_in_both_methods(base):
    two = replace(ALONE, study="real2real", method=2)
    assert ALONE.content == two.content
    assert replace(ALONE, real_gyros=6).content != replace(two, real_gyros=6).content
    shared = distinct(networks(cells_of(base, "input_channels")))
    assert len(shared & distinct(networks(cells_of(base, "real2real")))) == 2  # one per window


def test_content_is_everything_but_the_study():
    assert replace(CELL, study="augmentation").content == CELL.content
    others = {
        "method": 1,
        "sensor": "sparkfun",
        "source": "published",
        "real_gyros": 9,
        "virtual_gyros": 24,
        "window_s": 30.0,
        "seed": 1,
        "fold": 0,
        "estimator": MEAN,
    }
    assert set(others) == set(Cell.names()) - {"study"}
    for name, value in others.items():
        assert replace(CELL, **{name: value}).content != CELL.content, name


def test_gyroscopes_are_axes():
    assert (CELL.real_imus, CELL.virtual_imus) == (2, 4)


# only


@pytest.mark.parametrize(
    ("only", "count", "means"),
    [
        ({}, 24, 4),
        ({"sensor": "dot"}, 12, 2),
        ({"window_s": 10}, 12, 2),
        ({"real_gyros": 3}, 12, 4),
        ({"virtual_gyros": 0}, 8, 4),
        ({"sensor": "dot", "window_s": 10, "real_gyros": 12, "seed": 0}, 3, 1),
        ({"fold": 0}, 24, 4),  # folds are known only with the data
        ({"seed": 7}, 0, 0),
        ({"sensor": "ng"}, 0, 0),
        ({"window_s": 20}, 0, 0),
    ],
)
def test_only_narrows(base, only, count, means):
    whole, cells = cells_of(base, "augmentation"), cells_of(base, "augmentation", **only)
    assert set(cells) <= set(whole)
    assert len(networks(cells)) == count
    assert len(cells) == 2 * count + means  # a residual network beside each
    for name in set(only) - {"fold"}:
        assert {getattr(cell, name) for cell in networks(cells)} <= {only[name]}
    # a running mean stays wherever a network of its window does
    windows = [{(c.sensor, c.window_s) for c in some} for some in (cells, networks(cells))]
    assert windows[0] == windows[1]


def test_used_sensors_are_those_with_cells_left(base, parameters):
    everything = used_sensors(base)
    assert everything["augmentation"] == ["sparkfun", "dot"]
    assert everything["real2real"] == ["sparkfun", "dot", "ng", "memsense"]
    narrowed = used_sensors(parameters("base", only={"sensor": "dot", "real_gyros": 6}))
    assert {study: sensors for study, sensors in narrowed.items() if sensors} == {
        "real2real": ["dot"]
    }
    memsense = used_sensors(parameters("memsense_real"))
    assert {study: sensors for study, sensors in memsense.items() if sensors} == {
        "real2real": ["memsense"],
        "estimators": ["memsense"],
        "unseen_devices": ["memsense"],  # refused later: the file has one IMU
    }


# folds


def test_networks_are_repeated_in_every_fold_and_running_means_are_not(base):
    cells = cells_of(base, "real2real", sensor="memsense", real_gyros=3)
    folded = over_folds(cells, range(11), Only())
    assert [c.fold for c in folded if c.estimator == MEAN] == [HOLD_OUT] * 2
    for window_s in (10, 30):
        folds = [c.fold for c in networks(folded) if c.window_s == window_s]
        assert folds == list(range(11))
    assert sum(c.estimator == RESIDUAL_NETWORK for c in folded) == 2
    assert len(distinct(folded)) == 2 + 2 + 22


def test_an_estimator_without_a_network_is_one_run_over_all_folds(base):
    cells = cells_of(base, "estimators", sensor="memsense", window_s=10)
    folded = [c for c in over_folds(cells, range(11), Only()) if c.estimator != CNN]
    assert {c.fold for c in folded} == {HOLD_OUT}
    assert len(folded) == len(ESTIMATORS)


def test_only_narrows_folds(base):
    cells = cells_of(base, "real2real", sensor="memsense", real_gyros=3)
    folded = over_folds(cells, range(11), Only(fold=4))
    assert {c.fold for c in networks(folded)} == {4}
    assert sum(c.estimator == MEAN for c in folded) == 2
    assert over_folds(cells, [HOLD_OUT], Only(fold=HOLD_OUT)) == cells


def test_a_fold_that_is_none_is_refused(base):
    cells = cells_of(base, "real2real", sensor="memsense")
    with pytest.raises(InputError, match="only.fold=11: memsense has folds 0, 1, 2"):
        over_folds(cells, range(11), Only(fold=11))


# run parameters

IDENTITY = "study method sensor source real_gyros virtual_gyros window_s seed fold estimator"


def params_of(base, cell, folds=1, **training):
    changed = base.training.model_copy(update=training)
    return run_params(cell, folds, changed, base.splits, base.virtual_gyros)


def test_a_network_carries_its_identity_and_all_it_was_made_with(base):
    params = params_of(base, CELL, channels=17)
    names = IDENTITY.split()
    assert {name: params[name] for name in names} == {n: getattr(CELL, n) for n in names}
    assert params["folds"] == 1
    assert params["channels"] == 17
    assert set(type(base.training).model_fields) <= set(params)
    assert params["split_seed"] == base.splits.split_seed


def test_a_running_mean_carries_its_identity_alone(base):
    mean = replace(CELL, estimator=MEAN, method=0, real_gyros=0, virtual_gyros=0)
    assert set(params_of(base, mean)) == {*IDENTITY.split(), "folds"}


def test_the_validation_count_is_that_of_the_split(base):
    assert params_of(base, CELL)["validation_recordings"] == 8
    assert params_of(base, replace(CELL, fold=3), folds=11)["validation_recordings"] == 2


def test_jitter_is_recorded_with_virtual_gyroscopes(base):
    assert params_of(base, CELL)["turn_on_jitter_mdps"] == base.virtual_gyros.turn_on_jitter_mdps
    assert "turn_on_jitter_mdps" not in params_of(base, replace(CELL, virtual_gyros=0))


# the leak study


def leak_grid(parameters):
    return leak_cells(parameters.leakage, "memsense", "simulated", [0, 1])


def test_every_stride_has_every_way_of_training_the_honest_split_first(base):
    cells = leak_grid(base)
    ways = [(NO_LEAK, CNN), (NO_LEAK, CNN_SHUFFLED), *((leak, CNN) for leak in LEAKS[1:])]
    assert len(ways) == 5
    for stride_s in base.leakage.strides_s:
        there = [c for c in cells if c.window_stride_s == stride_s]
        assert list(dict.fromkeys((c.leak, c.estimator) for c in there)) == ways
        for way in ways:
            folds = [c.fold for c in there if (c.leak, c.estimator) == way and c.seed == 1]
            assert folds == ([HOLD_OUT] if way[0] == TEST_IN_TRAINING else list(range(5)))
    assert len(distinct(cells)) == len(cells) == 7 * 2 * (4 * 5 + 1)


def test_no_cell_of_another_study_is_one_of_the_leak_study(base):
    others = [cell for study in base.studies for cell in cells_of(base, study)]
    assert not distinct(leak_grid(base)) & distinct(others)
    assert LEAKAGE not in base.studies


def test_runs_of_the_leak_study_carry_the_leak_and_the_stride_and_no_others_do(base):
    p = base
    cell = leak_grid(p)[0]
    params = leak_params(cell, p.training, p.leakage, p.splits)
    assert (
        params.items()
        >= {
            "study": "leakage",
            "leak": "none",
            "window_stride_s": 10,
            "folds": 5,
            "recordings": 11,
            "fold": 0,
            "split_seed": p.splits.split_seed,
            "channels": p.training.channels,
        }.items()
    )
    for other in (CELL, ALONE):
        carried = run_params(other, 1, p.training, p.splits, p.virtual_gyros)
        assert not {"leak", "window_stride_s"} & carried.keys()
    assert {"leak", "window_stride_s"} == set(LeakCell.names()) - set(Cell.names())


def test_only_narrows_the_leak_study_to_a_sensor(base):
    wide = base.leakage.model_copy(update={"sensors": ["memsense", "dot"]})
    assert leak_sensors(wide, Only()) == ["memsense", "dot"]
    assert leak_sensors(wide, Only(sensor="dot")) == ["dot"]
    assert leak_sensors(wide, Only(sensor="ng")) == []
