"""Nodes of the training stage: plan the runs of a study, and fit the missing ones."""

import logging
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
import pandas as pd
import xarray as xr

from gyro_pipeline.conventions import (
    ALL_RECORDINGS,
    AXES,
    ORIGIN_REAL,
    ORIGIN_VIRTUAL,
    TEST,
    UNSEEN,
    InputError,
)
from gyro_pipeline.estimators import (
    entry,
    estimator_class,
    make_estimator,
    own_classes,
    settings_of,
)
from gyro_pipeline.estimators.base import Estimator
from gyro_pipeline.estimators.fitting import FitJob, run_fits
from gyro_pipeline.estimators.training_set import TrainingSet
from gyro_pipeline.fingerprints import code_hash, data_hash, fingerprint
from gyro_pipeline.parameters import Execution, Only, Splits, Study, Training, VirtualGyros
from gyro_pipeline.physics.bias import fill_masked
from gyro_pipeline.studies import (
    LEFT_OUT,
    RunSpec,
    possible_runs,
    run_params,
    run_specs,
    study_rows,
)
from gyro_pipeline.tracking import (
    FINGERPRINT,
    HISTORY,
    FittedRun,
    RunIdentity,
    StoredRun,
    by_fingerprint,
)
from gyro_pipeline.windows import window_size

logger = logging.getLogger(__name__)


@dataclass
class TrainingSets:
    """Training sets of the runs of a study and sensor, each made once."""

    windows: pd.DataFrame  # the windows table
    recordings: xr.Dataset  # real recordings
    virtual: xr.Dataset | None  # virtual recordings, if the study uses some
    _cache: dict[Any, dict[str, TrainingSet]] = field(default_factory=dict)

    def of(self, spec: RunSpec) -> dict[str, TrainingSet]:
        """The training set of each fold of a run, by the name of the fold.

        Raises:
            InputError: There are fewer IMUs than the run needs.
        """
        key = spec.protocol, spec.window_s, spec.window_stride_s
        counts = spec.method, spec.real_imus, spec.virtual_imus
        if (key, counts) not in self._cache:
            rows = self.table_of(spec)
            self._cache[key, counts] = {
                str(fold): self._training_set(spec, in_fold, _estimated_device(in_fold, rows))
                for fold, in_fold in rows.groupby("fold", observed=True, sort=False)
            }
        return self._cache[key, counts]

    @cached_property
    def _without_drawn_values(self) -> xr.Dataset:
        """Real recordings without the drawn values of simulated data."""
        return self.recordings[["angular_rate", "samples", "recording_mean"]]

    def table_of(self, spec: RunSpec) -> pd.DataFrame:
        """Rows of the windows table with the protocol, window and stride of a run."""
        w = self.windows
        chosen = w.protocol == spec.protocol
        chosen &= (w.window_s == spec.window_s) & (w.window_stride_s == spec.window_stride_s)
        return w[chosen]

    def _training_set(self, spec: RunSpec, rows: pd.DataFrame, device: int) -> TrainingSet:
        """The training set of a fold, with the estimated IMU first, if it trains, then others."""
        learned = rows[rows.role != TEST]
        real = sorted(
            learned.imu[learned.origin == ORIGIN_REAL].unique().tolist(),
            key=lambda imu: (imu != device, imu),
        )
        if spec.real_imus > len(real):
            raise InputError(
                f"{spec.sensor}: {spec.study} needs {spec.real_gyros} gyroscopes, the "
                f"{spec.source} recordings hold {len(AXES) * len(real)} that train; narrow with "
                "--params=only.real_gyros=..."
            )
        # the model of a study on unseen devices is trained on all of them, one more than in a fold
        imus = {
            ORIGIN_REAL: real[: spec.real_imus + (device == UNSEEN)],
            ORIGIN_VIRTUAL: range(1, 1 + spec.virtual_imus),
        }
        used = [(learned.origin == origin) & learned.imu.isin(i) for origin, i in imus.items()]
        attributes, samples = self.recordings.attrs, self.recordings.sizes["sample"]
        return TrainingSet(
            self._without_drawn_values,
            self.virtual if spec.virtual_imus else None,
            learned[used[0] | used[1]],
            window_size(spec.window_s, attributes["rate_hz"], samples, spec.sensor),
            device,
            tuple(imus[ORIGIN_REAL]) if spec.method == 1 else (),
        )


def _estimated_device(fold: pd.DataFrame, table: pd.DataFrame) -> int:
    """The IMU that a fit of a fold estimates: the one that tests, in the fold or else in any.

    It is UNSEEN in a fold of all recordings if several IMUs test in the others.
    """
    for rows in (fold, table):
        tested = rows.imu[rows.role == TEST].unique()
        if len(tested):
            return int(tested[0]) if len(tested) == 1 else UNSEEN
    return UNSEEN


def plan_runs(  # noqa: PLR0913, PLR0917 - a node's arguments are its datasets
    study: Study,
    recordings: xr.Dataset,
    windows: pd.DataFrame,
    windows_s: list[float],
    seeds: list[int],
    only: Only,
    training: Training,
    virtual: xr.Dataset | None = None,
) -> pd.DataFrame:
    """List the runs that a study needs on a sensor, before anything is trained.

    Args:
        study: The study with its grid.
        recordings: Real recordings.
        windows: The windows table.
        windows_s: Calibration times, seconds.
        seeds: Seeds of estimators that draw at random.
        only: Filters of the grid.
        training: Hyper-parameters, part of the fingerprints of seeded estimators.
        virtual: Virtual recordings, if the study uses some.

    Returns:
        A row per run: the fields of :class:`~gyro_pipeline.studies.RunSpec`; the ``fingerprint``
        of everything that it depends on; and ``left_out``, why it cannot be made.

    Raises:
        InputError: There are fewer IMUs than the grid needs.
    """
    sensor, source = recordings.attrs["sensor"], recordings.attrs["source"]
    rows = study_rows(study, sensor, source, windows_s, seeds, only)
    sets, settings = TrainingSets(windows, recordings, virtual), study.training_of(training)
    runs = []
    for spec in run_specs(rows, study.unseen_devices):
        folds = sets.of(spec)
        content = _content(spec, sets, settings)
        problem = _missing_imu(spec, sets) or _problem(spec, folds, settings)
        if problem:
            logger.warning("%s is left out: %s", _name(spec), problem)
        runs.append(vars(spec) | {FINGERPRINT: fingerprint(content), LEFT_OUT: problem})
    return pd.DataFrame(runs)


def _check_plan(specs: Mapping[str, RunSpec], sets: TrainingSets, settings: Training) -> None:
    """Refuse other data, windows or settings than those of the plan.

    Raises:
        InputError: A run would get the fingerprint of another one.
    """
    for key, spec in specs.items():
        if fingerprint(_content(spec, sets, settings)) != key:
            raise InputError(
                f"{_name(spec)}: its plan was made with other data or settings than the current "
                f"ones; type kedro run --pipeline={spec.study}, without options that skip its plan"
            )


def _content(spec: RunSpec, sets: TrainingSets, settings: Training) -> list[Any]:
    """Everything that a run depends on: code, settings, data and windows, but not its study."""
    estimator = estimator_class(spec.estimator)
    used = [sets.recordings, *([sets.virtual] if spec.virtual_imus and sets.virtual else [])]
    # a user's estimator may use any other one by its name
    package = ["gyro_pipeline.estimators"] if own_classes([spec.estimator]) else []
    fitting = ["gyro_pipeline.estimators.fitting", estimator.__module__, *package]
    return [
        code_hash(__name__, *fitting, entry(spec.estimator)),
        {name: value for name, value in vars(spec).items() if name not in ("study", "seed")},
        [(data.attrs["data_hash"], _labels_hash(data)) for data in used],
        {fold: _hash(training_set.windows) for fold, training_set in sets.of(spec).items()},
        _hash(_tests(sets.table_of(spec))),
        [spec.seed, settings_of(spec.estimator, settings)] if estimator.seeded else [],
    ]


def _labels_hash(recordings: xr.Dataset) -> str:
    return data_hash(recordings.recording_mean.load().to_numpy(), None)


def _hash(windows: pd.DataFrame) -> str:
    return data_hash(pd.util.hash_pandas_object(windows, index=False).to_numpy(), None)


def _tests(table: pd.DataFrame) -> pd.DataFrame:
    tests = table[table.role == TEST]
    return tests[["fold", "imu", "recording", "start"]].reset_index(drop=True)


def _problem(spec: RunSpec, folds: Mapping[str, TrainingSet], settings: Training) -> str:
    """The reason why an estimator cannot be fitted in a fold; empty if it can in all folds.

    Raises:
        InputError: The settings do not fit the windows.
    """
    estimator = make_estimator(spec.estimator, settings, spec.seed)
    for fold, training_set in folds.items():
        try:
            estimator.check(training_set)
        except InputError as error:
            return f"{fold}: {spec.estimator} cannot be fitted: {error}"
    estimator.work(next(iter(folds.values())))  # refuses a schedule without an epoch
    return ""


def _missing_imu(spec: RunSpec, sets: TrainingSets) -> str:
    """The reason why IMUs side by side are not the same in training and in all tests."""
    if spec.method != 1:
        return ""
    first = tuple(sets.recordings.imu.to_numpy()[: spec.real_imus].tolist())
    for fold, training_set in sets.of(spec).items():
        if training_set.side_by_side != first:
            return f"{fold}: expected IMUs {first} to train, got {training_set.side_by_side}"
    tests = _tests(sets.table_of(spec)).recording.unique()
    samples = sets.recordings["samples"].isel(imu=slice(spec.real_imus)).sel(recording=tests)
    lacking = tests[(samples == 0).any("imu").to_numpy()]
    if not len(lacking):
        return ""
    return f"recording {lacking[0]} tests: expected {spec.real_imus} IMUs side by side to have it"


def train(  # noqa: PLR0913, PLR0917 - a node's arguments are its datasets
    study: Study,
    plan: pd.DataFrame,
    all_runs: list[StoredRun],
    recordings: xr.Dataset,
    windows: pd.DataFrame,
    training: Training,
    splits: Splits,
    virtual_gyros: VirtualGyros,
    execution: Execution,
    virtual: xr.Dataset | None = None,
) -> Iterator[FittedRun]:
    """Fit the planned estimators that no study has fitted yet; each fit is saved when it ends.

    Args:
        study: The study.
        plan: The plan from :func:`plan_runs`.
        all_runs: All runs on these logs, of any study.
        recordings: Real recordings, which workers read only in part.
        windows: The windows table.
        training: Hyper-parameters.
        splits: Settings that are stored with each run.
        virtual_gyros: Settings that are stored with each run.
        execution: How estimators are fitted.
        virtual: Virtual recordings, if the study uses some.

    Yields:
        The fits of runs, which are evaluated later.

    Raises:
        InputError: The plan was made with other recordings, windows or settings.
    """
    sets, settings = TrainingSets(windows, recordings, virtual), study.training_of(training)
    specs = possible_runs(plan)
    _check_plan(specs, sets, settings)
    in_study = by_fingerprint([run for run in all_runs if run.study == study.experiment])
    trained = by_fingerprint([run for run in all_runs if run.trained])
    missing = {
        key: [f for f in sets.of(spec) if key not in in_study or f not in in_study[key].fits]
        for key, spec in specs.items()
        if key not in in_study or not in_study[key].trained
    }
    shared = [key for key in missing if key in trained]
    label = f"{study.experiment} {recordings.attrs['sensor']}"
    logger.info(
        "%s: %d runs planned, %d skipped (made before), %d shared with another study, %d to fit",
        *(label, len(specs), len(specs) - len(missing), len(shared), len(missing) - len(shared)),
    )

    def fitted_run(key: str, fold: str, estimator: Any, start: float, end: float) -> FittedRun:
        spec = specs[key]
        params = run_params(spec, study, training, splits, virtual_gyros)
        return _fitted_run(spec, key, params, sets, fold, estimator, start, end)

    for key in shared:
        for fold in missing[key]:
            now = time.time()
            yield fitted_run(key, fold, _load_fit(trained[key], fold), now, now)
    jobs = [
        FitJob(key, _name(spec), fold, spec.estimator, settings, spec.seed, sets.of(spec)[fold])
        for key, spec in specs.items()
        if key in missing and key not in shared
        for fold in missing[key]
    ]
    for job, fit in run_fits(jobs, execution, label):
        yield fitted_run(job.key, job.fold, fit.estimator, fit.started, fit.ended)


def _load_fit(run: StoredRun, fold: str) -> Estimator:
    """The fit of another study's run; a network gets its losses, which are stored separately."""
    estimator = run.load_fit(fold)
    if "train_loss" in run.metrics:
        estimator.losses = run.load(HISTORY)
    return estimator


def _fitted_run(  # noqa: PLR0917 - contents of a stored fit
    spec: RunSpec,
    key: str,
    params: Mapping[str, Any],
    sets: TrainingSets,
    fold: str,
    estimator: Any,
    start: float,
    end: float,
) -> FittedRun:
    folds, attributes = sets.of(spec), sets.recordings.attrs
    is_model = fold == ALL_RECORDINGS or ALL_RECORDINGS not in folds and fold == next(iter(folds))
    tags = {"data_hash": attributes["data_hash"], "simulated": str(attributes["simulated"])}
    tags |= {"engine": estimator.engine} if estimator.seeded else {}
    return FittedRun(
        run=RunIdentity(
            study=spec.study,
            fingerprint=key,
            params=dict(params) | {"folds": sum(name != ALL_RECORDINGS for name in folds)},
            tags=tags,
            folds=tuple(folds),
            name=_name(spec),
            note=_note(spec, folds),
        ),
        fold=fold,
        estimator=estimator,
        started_ms=int(1000 * start),
        ended_ms=int(1000 * end),
        is_model=is_model,
        example=_example(spec, folds[fold], sets.recordings),
        dataset={
            "name": f"{spec.sensor} recordings",
            "digest": attributes["data_hash"],
            "source": attributes["source"],
        },
    )


def _example(spec: RunSpec, training_set: TrainingSet, recordings: xr.Dataset) -> np.ndarray:
    """A window in the shape of the estimator's input, (1, gyroscopes, samples), deg/s."""
    visible = recordings.isel(imu=slice(spec.real_imus if spec.method == 1 else 1))
    common = (visible["samples"] > 0).all("imu").to_numpy()
    first = int(common.argmax())  # the first recording that all IMUs have
    window = visible.angular_rate.isel(recording=first, sample=slice(training_set.size))
    samples = window.transpose("imu", "axis", "sample").to_numpy()
    return fill_masked(samples.reshape(1, -1, training_set.size)).astype(np.float32)


def _name(spec: RunSpec) -> str:
    """The name of a run: sensor, estimator, training set, window and seed."""
    stride = spec.window_stride_s
    parts = [
        spec.sensor,
        spec.estimator,
        f"{spec.real_gyros}+{spec.virtual_gyros}" + " side by side" * (spec.method == 1),
        f"{spec.window_s:g} s" + f" every {stride:g} s" * (stride != spec.window_s),
    ]
    parts += [spec.protocol] if spec.protocol != "by_recording" else []
    parts += [f"seed {spec.seed}"] if estimator_class(spec.estimator).seeded else []
    return " ".join(parts)


def _note(spec: RunSpec, folds: Mapping[str, TrainingSet]) -> str:
    """A description of a run and its training set, in two sentences."""
    fold = ALL_RECORDINGS if ALL_RECORDINGS in folds else next(iter(folds))
    windows, fits = folds[fold].windows, sum(name != ALL_RECORDINGS for name in folds)
    amounts = " and ".join(
        f"{len(rows)} windows of {len(rows[['imu', 'recording']].drop_duplicates())} {origin!s} "
        "recordings"
        for origin, rows in windows.groupby("origin", observed=True)
    )
    target = f"once more, to {fold}" if fold == ALL_RECORDINGS else f"to the {fold}"
    return (
        f"The model `{spec.estimator}` estimates the bias of {spec.sensor} from {spec.window_s:g} "
        f"s; it was fitted {target}: {amounts or 'no windows'} ({spec.real_gyros} real and "
        f"{spec.virtual_gyros} virtual gyroscopes, source {spec.source}). The metrics are those of "
        f"the protocol {spec.protocol} with {fits} fit{'s' * (fits > 1)}, none of which saw its "
        "test recordings unless the protocol is a leak."
    )
