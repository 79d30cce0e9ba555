import importlib.util
import inspect
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
import torch

from gyro_pipeline.conventions import InputError
from gyro_pipeline.parameters import Execution, Grid, Only, Study
from gyro_pipeline.pipelines.training import nodes
from gyro_pipeline.pipelines.training.nodes import Devices
from gyro_pipeline.studies import CNN, CNN_SHUFFLED, HOLD_OUT, MEAN, Cell
from gyro_pipeline.tracking import FINGERPRINT, HISTORY, TRAINED_IN, WEIGHTS

KEYS = ["estimator", "method", "real_gyros", "virtual_gyros", "window_s", "seed", "fold"]


def fingerprints(world, **changes):
    """By cell, whatever the study."""
    cells = replace(world, **changes).plan()
    return {tuple(row[:-1]): row[-1] for row in cells[[*KEYS, FINGERPRINT]].to_numpy().tolist()}


def networks(prints):
    return {key: value for key, value in prints.items() if key[0] == CNN}


def cell(**changes):
    given = {
        "study": "augmentation",
        "method": 2,
        "sensor": "sparkfun",
        "source": "test",
        "real_gyros": 3,
        "virtual_gyros": 0,
        "window_s": 10.0,
        "seed": 0,
        "fold": HOLD_OUT,
        "estimator": CNN,
    }
    return Cell(**given | changes)


def devices(world, **changes):
    w = replace(world, **changes)
    labelled = nodes.labelled_bias(w.bias)
    return Devices(w.recordings, labelled, w.roles, w.virtual, w.virtual_gyros)


# plan


def test_a_plan_is_the_grid_with_one_running_mean_for_each_window(world):
    cells = replace(world, windows_s=[10.0, 20.0], seeds=[0, 1]).plan()
    assert (cells.estimator == MEAN).sum() == 2
    rows = cells[cells.estimator == CNN][KEYS[2:6]].to_numpy().tolist()
    grid = [[r, v, w, s] for r in (3, 6) for v in (0, 6) for w in (10, 20) for s in (0, 1)]
    assert sorted(rows) == sorted(grid)
    assert cells[FINGERPRINT].is_unique
    assert set(cells.folds) == {1}


def test_fingerprints_know_no_study(world, make_study):
    augmentation = fingerprints(world)
    real2real = fingerprints(world, study=make_study("real2real", real_gyros=[3, 6]))
    common = augmentation.keys() & real2real.keys()
    assert len(common) == 3  # two networks and the running mean
    assert all(augmentation[key] == real2real[key] for key in common)


def test_one_imu_is_the_same_cell_in_both_methods_and_two_are_not(world, make_study):
    augmentation = fingerprints(world)
    channels = fingerprints(world, study=make_study("input_channels", method=1, real_gyros=[3, 6]))
    one, two = ((CNN, m, 3, 0, 10.0, 0, HOLD_OUT) for m in (1, 2))
    assert channels[one] == augmentation[two]
    assert channels[CNN, 1, 6, 0, 10.0, 0, HOLD_OUT] not in augmentation.values()


@pytest.mark.parametrize(
    "change", [{"hidden": 5}, {"epochs": 4}, {"learning_rate": 0.1}, {"centring": "global"}]
)
def test_every_network_changes_with_a_hyper_parameter_and_no_running_mean(world, change):
    training = world.training.model_copy(update=change)
    before, after = fingerprints(world), fingerprints(world, training=training)
    assert not set(networks(before).values()) & set(networks(after).values())
    assert set(before.values()) & set(after.values()) == {before[MEAN, 0, 0, 0, 10.0, 0, HOLD_OUT]}


def test_a_network_changes_with_the_roles_of_its_recordings(world, make_roles):
    swapped = fingerprints(world, roles=make_roles(14, test=4, validation=3))
    assert not set(networks(fingerprints(world)).values()) & set(swapped.values())


def test_everything_changes_with_the_recordings(world):
    other = world.recordings.assign_attrs(data_hash="other")
    before, after = fingerprints(world), fingerprints(world, recordings=other)
    assert not set(before.values()) & set(after.values())


def test_only_cells_with_virtual_gyroscopes_change_with_them(world):
    other = world.virtual.assign_attrs(data_hash="other")
    before, after = fingerprints(world), fingerprints(world, virtual=other)
    assert {key for key in before if before[key] != after[key]} == {
        key for key in before if key[KEYS.index("virtual_gyros")]
    }


def test_narrowing_changes_no_fingerprint(world):
    narrowed = fingerprints(world, only=Only(real_gyros=6, virtual_gyros=0))
    assert len(narrowed) == 2
    assert narrowed.items() <= fingerprints(world).items()


def with_source(module, source, folder):
    path = folder / "changed.py"
    path.write_text(source)
    spec = importlib.util.spec_from_file_location(module.__name__, path)
    changed = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(changed)
    return changed


def test_training_code_counts_and_its_comments_do_not(world, monkeypatch, tmp_path):
    before = fingerprints(world)
    source = inspect.getsource(nodes.packing)
    commented = with_source(nodes.packing, "# a remark\n" + source, tmp_path)
    monkeypatch.setattr(nodes, "packing", commented)
    assert fingerprints(world) == before
    changed = with_source(nodes.packing, source + "\nMORE = 1\n", tmp_path)
    monkeypatch.setattr(nodes, "packing", changed)
    assert not set(networks(fingerprints(world)).values()) & set(before.values())


def test_a_k_fold_makes_a_run_of_every_fold_and_one_running_mean(world, make_study):
    roles = pd.concat([world.roles.assign(fold=fold) for fold in range(3)])
    cells = replace(
        world, roles=roles, virtual=None, study=make_study("real2real", real_gyros=[3])
    ).plan()
    assert cells[cells.estimator == CNN].fold.tolist() == [0, 1, 2]
    assert cells[cells.estimator == MEAN].fold.tolist() == [HOLD_OUT]
    assert set(cells.folds) == {3}


def test_more_gyroscopes_than_the_recordings_hold_are_refused(world, make_study):
    study = make_study("real2real", real_gyros=[9])
    with pytest.raises(InputError, match=r"sparkfun: 9 gyroscopes asked by real2real, .* hold 6"):
        replace(world, study=study).plan()


def test_a_window_longer_than_the_recordings_is_refused(world):
    with pytest.raises(InputError, match=r"window of 60 s is 1200 samples .* has 1040"):
        replace(world, windows_s=[60.0]).plan()


def test_recordings_that_an_imu_lacks_are_refused_side_by_side_and_left_out_else(world, make_study):
    gappy = world.recordings.copy(deep=True)
    gappy.angular_rate[1, 3], gappy["samples"][1, 3] = np.nan, 0
    study = make_study("input_channels", method=1, real_gyros=[6])
    with pytest.raises(InputError, match=r"sparkfun recording 4: expected 2 IMUs side by side"):
        replace(world, recordings=gappy, study=study).plan()
    replace(world, recordings=gappy).plan()
    job = devices(world, recordings=gappy).job("", cell(real_gyros=6), world.training)
    assert [device.numbers for device in job.devices] == [
        tuple(range(1, 9)),
        (1, 2, 3, 5, 6, 7, 8),
    ]


# devices


def test_method_2_trains_on_more_devices_the_test_imu_first(world):
    job = devices(world).job("", cell(real_gyros=6, virtual_gyros=3), world.training)
    assert [device.imus for device in job.devices] == [(1,), (2,), (1,)]
    assert [device.numbers for device in job.devices] == [
        tuple(range(1, 9)),
        tuple(range(1, 9)),
        tuple(range(1, 6)),  # the first of the virtual recordings
    ]
    real = world.recordings.angular_rate.sel(imu=2, recording=3).to_numpy()
    np.testing.assert_array_equal(list(job.devices[1].samples())[2], real)
    virtual = world.virtual.angular_rate.sel(imu=1, recording=5).to_numpy()
    np.testing.assert_array_equal(list(job.devices[2].samples())[4], virtual)
    assert job.window == 200


def test_method_1_sees_the_imus_side_by_side(world):
    job = devices(world).job("", cell(method=1, real_gyros=6), world.training)
    (device,) = job.devices
    first = world.recordings.angular_rate.sel(recording=1).to_numpy().reshape(6, -1)
    np.testing.assert_array_equal(next(device.samples()), first)
    assert job.validation.imus == (1, 2)
    assert job.architecture.gyroscopes == 6


def test_validation_and_test_recordings_are_withheld_for_every_imu(world):
    job = devices(world).job("", cell(real_gyros=6), world.training)
    assert {number for device in job.devices for number in device.numbers} == set(range(1, 9))
    assert (job.validation.imus, job.validation.numbers) == ((1,), (9, 10))


@pytest.mark.parametrize(
    ("number", "role", "message"),
    [
        (3, "test", r"sparkfun fold -1: recording 3 .*: train \(IMU 1, 2\), test \(IMU 1\); .*"),
        (3, "validation", r"recording 3 .*: train \(IMU 1, 2\), validation \(IMU 1\); .* together"),
        (12, "validation", r"recording 12 .*: validation \(IMU 1\), test \(IMU 1\)"),
    ],
)
def test_a_training_that_would_use_a_recording_twice_is_refused(world, number, role, message):
    """Here the roles themselves are bad; the plan would refuse them, and so does each training."""
    second = pd.DataFrame({"fold": HOLD_OUT, "recording": [number], "role": role})
    leaky = devices(world, roles=pd.concat([world.roles, second]))
    with pytest.raises(InputError, match=message):
        leaky.job("", cell(real_gyros=6), world.training)


def test_imus_recorded_together_cannot_get_a_role_each(world, monkeypatch):
    """IMU 2 is made to train on what IMU 1 is tested on."""
    honest = Devices._real

    def leaky(self, imus, fold, role, window):
        role = "test" if imus == (2,) and role == "train" else role
        return honest(self, imus, fold, role, window)

    monkeypatch.setattr(Devices, "_real", leaky)
    message = r"recording 11 .*: train \(IMU 2\), test \(IMU 1\); .* for all IMUs recorded together"
    with pytest.raises(InputError, match=message):
        devices(world).job("", cell(real_gyros=6), world.training)


def test_shuffled_labels_are_those_of_other_recordings_of_the_same_gyroscope(world):
    honest = devices(world).job("", cell(real_gyros=6), world.training)
    shuffled = devices(world).job("", cell(real_gyros=6, estimator=CNN_SHUFFLED), world.training)
    for one, other in zip(honest.devices, shuffled.devices, strict=True):
        assert one.numbers == other.numbers
        assert not np.array_equal(one.biases(), other.biases())
        np.testing.assert_array_equal(
            np.sort(one.biases(), axis=0), np.sort(other.biases(), axis=0)
        )
    np.testing.assert_array_equal(honest.validation.biases(), shuffled.validation.biases())


def test_seeds_have_shuffled_labels_of_their_own_and_share_no_examples(world):
    made = devices(world)
    jobs = [
        made.job("", cell(estimator=CNN_SHUFFLED, seed=seed), world.training) for seed in (0, 0, 1)
    ]
    first, again, other = (job.devices[0].biases() for job in jobs)
    np.testing.assert_array_equal(first, again)
    assert not np.array_equal(first, other)
    assert jobs[0].cell == jobs[1].cell != jobs[2].cell


def test_targets_are_the_ground_truth(world):
    job = devices(world).job("", cell(real_gyros=6), world.training)
    means = world.recordings.angular_rate.mean("sample", dtype=np.float64)
    for imu, device in enumerate(job.devices, start=1):
        expected = means.sel(imu=imu, recording=list(device.numbers))
        np.testing.assert_allclose(device.biases(), expected, rtol=1e-12)


# train


def test_runs_carry_their_identity_and_what_made_them(world, trained):
    cells = world.plan()
    assert [run.tags[FINGERPRINT] for run in trained if run.params["estimator"] == MEAN] == (
        cells[FINGERPRINT][cells.estimator == MEAN].tolist()
    )
    assert {run.tags[FINGERPRINT] for run in trained} == set(cells[FINGERPRINT])
    by_print = cells.set_index(FINGERPRINT)
    for run in trained:
        row = by_print.loc[run.tags[FINGERPRINT]]
        assert {name: run.params[name] for name in Cell.names()} == row[Cell.names()].to_dict()
        assert run.study == "augmentation"
        assert run.tags["data_hash"] == world.recordings.data_hash
        assert run.tags["simulated"] == "0"
        if run.params["estimator"] == CNN:
            assert world.training.model_dump().items() <= run.params.items()
            assert set(run.artifacts) == {WEIGHTS, HISTORY}
            assert run.history.epoch.tolist() == [1, 2, 3]
            assert {"train_loss", "val_loss"} <= set(run.history)
        assert ("turn_on_jitter_mdps" in run.params) == (run.params["virtual_gyros"] > 0)


def test_training_again_gives_the_same_weights(world, trained):
    cells = world.plan()
    last = trained[-1]
    again = world.train(cells=cells[cells[FINGERPRINT] == last.tags[FINGERPRINT]])
    assert len(again) == 1
    for name, weights in again[0].artifacts[WEIGHTS]["last"].items():
        assert torch.equal(weights, last.artifacts[WEIGHTS]["last"][name])


def test_training_all_at_once_gives_the_same_runs(world, trained):
    """The same plan, the same identities, and weights that differ by rounding."""
    at_once = world.train(execution=Execution(executor="batched", workers=None))
    found = {run.tags[FINGERPRINT]: run for run in at_once}
    assert len(found) == len(trained)
    for run in trained:
        twin = found[run.tags[FINGERPRINT]]
        assert twin.params == run.params
        if run.params["estimator"] == CNN:
            assert twin.tags["engine"].startswith("batched c")  # pu or uda
            assert run.tags["engine"] in {"fused", "cpu"}
            for name, weights in run.artifacts[WEIGHTS]["last"].items():
                got = twin.artifacts[WEIGHTS]["last"][name]
                torch.testing.assert_close(got, weights, rtol=0, atol=1e-5)
            pd.testing.assert_frame_equal(twin.history, run.history, rtol=1e-4)


def test_jobs_that_differ_in_their_seed_alone_are_of_one_cell(world):
    cells = [cell(seed=0), cell(seed=1), cell(virtual_gyros=3)]
    first, seed, more = (devices(world).job("", one, world.training) for one in cells)
    assert first.cell == seed.cell != more.cell


def test_seeds_differ(world, trained):
    only = Only(real_gyros=3, virtual_gyros=0)
    other = replace(world, seeds=[1], only=only).train()[-1]
    twin = next(r for r in trained if r.params | {"seed": 1} == dict(other.params))
    name = "output.weight"
    assert not torch.equal(
        other.artifacts[WEIGHTS]["last"][name], twin.artifacts[WEIGHTS]["last"][name]
    )


@pytest.fixture
def no_training(monkeypatch):
    def refuse(jobs, *_):
        assert [job.name for job in jobs] == []
        return iter(())

    monkeypatch.setattr(nodes, "run_trainings", refuse)


@pytest.mark.usefixtures("no_training")
def test_what_the_study_has_is_skipped(world, stored, caplog):
    caplog.set_level("INFO", logger="gyro_pipeline")
    assert world.train(tracked=stored) == []
    assert "5 runs planned, 5 skipped (trained before), 0 shared" in caplog.text


@pytest.mark.usefixtures("no_training")
def test_what_another_study_has_is_shared_and_not_trained(world, stored, make_study):
    real2real = replace(world, study=make_study("real2real", real_gyros=[3, 6]))
    shared = real2real.train(tracked=stored)
    assert len(shared) == 3
    for run in shared:
        twin = next(one for one in stored if one.fingerprint == run.tags[FINGERPRINT])
        assert run.tags[TRAINED_IN] == "augmentation"
        assert (run.study, run.params["study"]) == ("real2real", "real2real")
        assert {k: str(v) for k, v in run.params.items() if k != "study"}.items() <= (
            twin.params.items()
        )
        if run.params["estimator"] == CNN:
            assert run.artifacts[WEIGHTS] is twin.load(WEIGHTS)
            assert run.history is twin.load(HISTORY)


@pytest.mark.usefixtures("no_training")
def test_a_run_shared_twice_names_the_study_that_trained_it(world, stored, make_study):
    handed_on = [
        replace(run, study="real2real", tags={**run.tags, TRAINED_IN: "input_channels"})
        for run in stored
    ]
    runs = world.train(tracked=handed_on)
    assert {run.tags[TRAINED_IN] for run in runs} == {"input_channels"}


def test_only_what_is_missing_is_trained(world, stored):
    kept = [run for run in stored if run.params["real_gyros"] != "6"]
    (first, second) = world.train(tracked=kept)
    assert first.params["real_gyros"] == second.params["real_gyros"] == 6


# estimators without a network


def of_estimators(world, *names, roles=None):
    grid = Grid(method=2, real_gyros=[3])
    study = Study(
        experiment="estimators",
        estimators=list(names),
        windows_s=[5.0, 20.0],
        sensors={"sparkfun": grid},
    )
    return replace(world, study=study, virtual=None, roles=world.roles if roles is None else roles)


def test_estimators_are_planned_at_the_windows_of_their_study_and_leave_nothing_to_train(world):
    asked = of_estimators(world, "ridge", "best_linear")
    cells = asked.plan()
    named = cells[["estimator", "window_s"]].to_numpy().tolist()
    assert named == [[n, w] for n in (MEAN, "ridge", "best_linear") for w in (5.0, 20.0)]
    runs = asked.train()
    assert len(runs) == 6
    assert all(not run.artifacts and run.history is None for run in runs)
    assert {run.params["fold"] for run in runs} == {HOLD_OUT}


def test_they_change_with_the_recordings_that_test(world, make_roles):
    names = [MEAN, "ridge"]
    same, fewer = make_roles(14, test=4, validation=3), make_roles(14, test=3, validation=2)
    plain, validated, tested = (
        of_estimators(world, *names, roles=roles).plan()[FINGERPRINT].tolist()
        for roles in (world.roles, same, fewer)
    )
    assert plain == validated  # fitted to those that train and those that validate
    assert not set(plain) & set(tested)


def test_an_unknown_estimator_is_refused_with_those_there_are(world):
    with pytest.raises(
        InputError, match="estimators: unknown estimator 'oracle'; there are cnn, m"
    ):
        of_estimators(world, "oracle").plan()
