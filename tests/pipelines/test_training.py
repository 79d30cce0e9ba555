"""What each run is fitted to, which fits are made, and what decides that none is needed."""

import sys
from dataclasses import replace
from itertools import product

import numpy as np
import pytest

from gyro_pipeline.conventions import InputError
from gyro_pipeline.datasets.tables import Table
from gyro_pipeline.estimators import estimator_class
from gyro_pipeline.parameters import Only
from gyro_pipeline.pipelines.training import nodes
from gyro_pipeline.pipelines.training.nodes import TrainingSets
from gyro_pipeline.studies import CNN, LEFT_OUT, MEAN, run_spec, study_rows
from gyro_pipeline.tracking import FINGERPRINT

STARTS = range(0, 801, 200)
PARTS = ("nothing", "own", "real", "all")
THEIRS = "a_strangers_estimators"
pytestmark = pytest.mark.slow
STRANGER = """
import numpy as np
from gyro_pipeline.estimators.base import Estimator


class All(Estimator):
    uses = "all"

    def _fit(self, training):
        self.given = list(training.windows.itertuples(index=False, name=None))
        self.size, self.device = training.size, training.device
        self.seen = set(training.real.data_vars)
        self.firsts = {
            (*place, number): recording[:, 0]
            for place, one in training.imus.items()
            for number, recording in zip(one.numbers.tolist(), one.rates)
        }

    def _estimate(self, windows):
        return windows.samples.mean(axis=-1), np.nan


class Real(All):
    uses = "real"


class Own(All):
    uses = "own"


class Nothing(All):
    uses, fewest_recordings = "nothing", 0
"""


@pytest.fixture(scope="module")
def strange(world, make_study, tmp_path_factory):
    """A study of the estimators of a file outside of the package."""
    folder = tmp_path_factory.mktemp("elsewhere")
    (folder / f"{THEIRS}.py").write_text(STRANGER)
    names = [f"{THEIRS}:{part.title()}" for part in PARTS]
    study = make_study("some", names, real_gyros=[3, 6], virtual_gyros=[0, 6])
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(folder)
        yield replace(world, study=study)
    sys.modules.pop(THEIRS, None)


@pytest.fixture(scope="module")
def few(make_recordings, make_world, make_study):
    """Recordings of one IMU, so few that they make a k-fold: ``few(count, estimators)``."""

    def made(count, estimators):
        bias = np.random.default_rng(count).normal(0, 0.01, (1, count, 3))
        recordings = make_recordings(bias, 1040, 20.0, 0.003)
        return make_world(recordings, study=make_study("some", estimators))

    return made


def test_every_row_is_fitted_to_exactly_the_training_set_that_it_names(strange):
    drawn = strange.raw.assign(true_bias=strange.raw.angular_rate.isel(sample=0, drop=True))
    fits = {fit.run.fingerprint: fit for fit in replace(strange, raw=drawn).train()}
    assert len(fits) == 1 + 1 + 1 + 2 + 4  # the running mean; rows of the same part are one run
    given = strange.study, "sparkfun", "test", strange.windows_s, strange.seeds, strange.only
    rows = [row for row in study_rows(*given) if row.estimator != MEAN]
    assert len(rows) == 4 * 4
    runs = {spec: key for key, spec in strange.specs.items()}
    for row in rows:
        part, fit = row.estimator.rpartition(":")[2].lower(), fits[runs[run_spec(row, False)]]
        real = {"nothing": 0, "own": 1}.get(part, row.real_gyros // 3)
        virtual = row.virtual_gyros // 3 if part == "all" else 0
        roles = {number: "validation" if number > 8 else "train" for number in range(1, 11)}
        places = product(range(1, 1 + real), roles, STARTS)
        expected = [(roles[number], "real", imu, number, start) for imu, number, start in places]
        places = product(range(1, 1 + virtual), range(1, 6), STARTS)
        expected += [("train", "virtual", *place) for place in places]
        assert fit.estimator.given == expected, row
        assert (fit.estimator.size, fit.estimator.device) == (200, 1)
        # nothing of what was drawn
        assert fit.estimator.seen == {"angular_rate", "samples", "recording_mean"}
        sources = {"real": strange.raw, "virtual": strange.virtual}
        for (origin, imu, number), first in fit.estimator.firsts.items():
            samples = sources[origin].angular_rate.sel(imu=imu, recording=number)
            np.testing.assert_array_equal(first, samples[:, 0])
        assert len(fit.estimator.firsts) == 10 * real + 5 * virtual
        params = fit.run.params
        assert (params["real_gyros"], params["virtual_gyros"]) == (3 * real, 3 * virtual)


def test_of_unseen_devices_every_fold_trains_on_all_others(strange, make_study):
    study = make_study("some", [f"{THEIRS}:Own"], real_gyros=[3])
    unseen = replace(strange, study=study.model_copy(update={"protocol": "leave_one_device_out"}))
    fits = {fit.fold: fit for fit in unseen.train() if fit.run.params["estimator"] != MEAN}
    places = {fold: {row[2:4] for row in fit.estimator.given} for fold, fit in fits.items()}
    numbers = range(1, 11)  # others were made together with those that test
    assert places["without IMU 1"] == {(2, number) for number in numbers}
    assert places["without IMU 2"] == {(1, number) for number in numbers}
    assert places["all recordings"] == {(imu, n) for imu in (1, 2) for n in range(1, 15)}
    assert [fold for fold, fit in fits.items() if fit.is_model] == ["all recordings"]


def test_the_leak_studys_networks_see_what_their_protocol_gives_them(world, make_study):
    changes = {"protocol": "k_fold", "recordings": 6, "folds": 3, "strides_s": [10.0, 20.0]}
    also = {name: [CNN] for name in ("window_split", "test_in_training", "best_epoch_on_test")}
    study = make_study("leakage").model_copy(update=changes | {"also": also})
    leaks = replace(world, study=study)
    sets = TrainingSets(leaks.windows, leaks.recordings, None)
    assert len(leaks.specs) == 2 * (1 + 4)  # no two strides and no two protocols are one run
    for spec in leaks.specs.values():
        network = nodes.make_estimator(CNN, leaks.training, 0)
        for fold, training in sets.of(spec).items():
            job, rows = network.job(training), sets.table_of(spec)
            tests = rows[(rows.fold == fold) & (rows.role == "test")]
            tested = set(zip(tests.recording, tests.start, strict=True))
            trained, watched = (
                set()
                if one is None
                else {(n, s) for n, own in zip(one.numbers, one.starts, strict=True) for s in own}
                for one in (job.devices[0], job.validation)
            )
            shares = {number for number, _ in trained} & {number for number, _ in tested}
            assert bool(trained & tested) == (spec.protocol == "test_in_training")
            assert bool(shares) == (spec.protocol in {"test_in_training", "window_split"})
            assert watched == (tested if spec.protocol == "best_epoch_on_test" else set())


def test_folds_are_fits_of_one_run_and_a_kill_loses_only_what_was_running(few, as_stored, caplog):
    world = few(5, ["empirical_bayes", CNN])
    whole = {(fit.run.fingerprint, fit.fold): fit for fit in world.train()}
    names = [*(f"fold {number}" for number in range(5)), "all recordings"]
    assert len(world.plan) == 3
    assert set(whole) == {(key, fold) for key in world.specs for fold in names}
    for fit in whole.values():
        assert (fit.run.folds, fit.run.params["folds"]) == (tuple(names), 5)
        assert fit.is_model == (fit.fold == "all recordings")
    for stop in (1, 8):
        stored = as_stored(list(whole.values())[:stop])
        caplog.clear()
        with caplog.at_level("INFO", "gyro_pipeline"):
            rest = world.train(tracked=stored)
        complete = sum(run.trained for run in stored)
        told = f"3 runs planned, {complete} skipped (made before), 0 shared with another study, "
        assert told + f"{3 - complete} to fit" in caplog.text
        assert {(fit.run.fingerprint, fit.fold) for fit in rest} == set(list(whole)[stop:])
        for fit in rest:
            twin = whole[fit.run.fingerprint, fit.fold]
            assert fit.run == twin.run
            if fit.run.params["estimator"] == CNN:
                assert bits(fit) == bits(twin)


def bits(fit, weights="last"):
    return {name: w.numpy().tobytes() for name, w in fit.estimator._artifact[weights].items()}


def test_of_few_recordings_what_cannot_be_fitted_is_left_out_and_named_first(few, caplog):
    names = [MEAN, "empirical_bayes", "ridge", "best_linear", CNN]
    plan = few(2, names).plan.set_index("estimator")[LEFT_OUT]
    left_out = {name for name, problem in plan.items() if problem}
    # each fold has one recording to learn from
    assert left_out == {name for name in names if estimator_class(name).fewest_recordings > 1} | {
        name for name in names if estimator_class(name).seeded
    }
    for name in left_out:
        assert plan[name].startswith("fold 0: ")
        assert f"sparkfun {name} " in caplog.text
    fitted = {fit.run.params["estimator"] for fit in few(2, names).train()}
    assert fitted == set(names) - left_out


def changed(world, **changes):
    """Runs whose fingerprints a change of the world changes."""
    before, after = world.fingerprints, replace(world, **changes).fingerprints
    assert before.keys() == after.keys()
    return {key for key in before if before[key] != after[key]}


@pytest.fixture(scope="module")
def varied(world, make_study):
    """Estimators that use each part of a training set."""
    names = ["median", "best_linear", "residual_network", CNN]
    study = make_study("some", names, real_gyros=[3, 6], virtual_gyros=[0, 6])
    return replace(world, study=study)


def test_a_fingerprint_knows_no_study_and_changes_with_no_narrowing(varied, make_study):
    names = [CNN, "median"]
    other = replace(varied, study=make_study("other", names, real_gyros=[3, 6]))
    assert other.fingerprints.items() <= varied.fingerprints.items()
    narrowed = replace(varied, only=Only(real_gyros=6, virtual_gyros=0)).fingerprints
    assert narrowed.items() <= varied.fingerprints.items()
    assert len(set(varied.fingerprints.values())) == len(varied.fingerprints) == 1 + 1 + 1 + 2 + 4


def test_a_setting_changes_the_runs_that_depend_on_it_and_no_other(varied):
    """Reports find runs by fingerprint, so that the others are found whatever they carry."""
    for group, change, affected in (
        ("training", {"hidden": 5}, lambda key: key[0] == CNN),
        ("virtual_gyros", {"seed": 1}, lambda key: key[2]),
        ("splits", {"training_windows": "first"}, lambda key: key[1]),
        ("splits", {"fold_validation_recordings": 1}, lambda key: False),  # this is a hold-out
    ):
        settings = getattr(varied, group).model_copy(update=change)
        expected = {key for key in varied.fingerprints if affected(key)}
        assert changed(varied, **{group: settings}) == expected, change


def test_everything_changes_with_the_recordings_their_labels_and_with_those_that_test(varied):
    everything = set(varied.fingerprints)
    assert changed(varied, raw=varied.raw.assign_attrs(data_hash="of others")) == everything
    roles = varied.raw.split.to_numpy().copy()
    roles[10] = "train"
    moved = varied.raw.assign_coords(split=("recording", roles))
    assert changed(varied, raw=moved) == everything
    ends = varied.raw.angular_rate.isel(sample=0, drop=True).astype(float)
    cut = varied.recordings.assign(recording_mean=varied.recordings.recording_mean + 1e-9 * ends)
    given = varied.study, cut, varied.windows, [10.0], [0], varied.only, varied.training
    plan = nodes.plan_runs(*given, varied.virtual)
    assert len(plan) == len(everything)
    assert not {*plan[FINGERPRINT]} & {*varied.fingerprints.values()}


def test_what_a_study_has_is_skipped_and_what_another_has_is_shared(
    world, fitted, stored, make_study, caplog, monkeypatch
):
    def refuse(jobs, *_):
        assert [job.name for job in jobs] == []
        return iter(())

    monkeypatch.setattr(nodes, "run_fits", refuse)
    assert world.train(tracked=stored) == []
    other = replace(world, study=make_study("real2real", real_gyros=[3, 6]))
    with caplog.at_level("INFO", "gyro_pipeline"):
        shared = other.train(tracked=stored)
    told = "3 runs planned, 0 skipped (made before), 3 shared with another study, 0 to fit"
    assert told in caplog.text
    twins = {fit.run.fingerprint: fit for fit in fitted}
    assert {fit.run.fingerprint for fit in shared} == set(other.specs)
    for fit in shared:
        twin = twins[fit.run.fingerprint]
        if fit.run.params["estimator"] == CNN:
            assert bits(fit) == bits(twin)
            assert fit.estimator.losses is twin.estimator.losses
        assert fit.run.study == fit.run.params["study"] == "real2real"
        assert {**fit.run.params, "study": "augmentation"} == twin.run.params
        assert (fit.run.name, fit.run.folds, fit.is_model) == (twin.run.name, ("hold-out",), True)
    with pytest.raises(InputError, match=r"sparkfun: real2real needs 9 gyroscopes, .* hold 6"):
        replace(world, study=make_study("real2real", real_gyros=[9])).train()


def test_a_plan_comes_back_from_its_file_as_it_was(few, tmp_path):
    world = few(3, ["median", "best_linear"])
    plan = world.plan.assign(**{FINGERPRINT: ["0123456789012345", "12e4567890123456", "1"]})
    table = Table(str(tmp_path / "plan.csv"))
    table.save(plan)
    assert nodes.possible_runs(table.load()) == nodes.possible_runs(plan)
    assert len(nodes.possible_runs(plan)) == 2


def test_runs_carry_what_they_are_and_an_example_of_their_windows(world, fitted):
    for fit in fitted:
        spec, params = world.specs[fit.run.fingerprint], fit.run.params
        assert vars(spec).items() <= params.items()
        assert params["folds"] == 1
        engine = {"engine": fit.estimator.engine} if fit.estimator.seeded else {}
        assert fit.run.tags == {"data_hash": world.raw.data_hash, "simulated": "0"} | engine
        assert fit.dataset["digest"] == world.raw.data_hash
        assert f"{spec.real_gyros}+{spec.virtual_gyros} 10 s" in fit.run.name
        assert fit.example.shape == (1, 3, 200)
        assert np.isfinite(fit.estimator.estimate(fit.example)[0]).all()
