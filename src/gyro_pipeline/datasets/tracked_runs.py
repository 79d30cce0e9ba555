"""Runs in an MLflow store as catalog datasets."""

import json
import logging
import os
import platform
import re
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import cached_property, partial
from pathlib import Path
from typing import Any
from urllib.parse import urlencode

import pandas as pd
import psutil
from alembic.util.exc import CommandError
from kedro.io import AbstractDataset
from mlflow import MlflowClient
from mlflow.artifacts import download_artifacts
from mlflow.entities import (
    Dataset,
    DatasetInput,
    Experiment,
    InputTag,
    Metric,
    Param,
    Run,
    RunStatus,
    RunTag,
)
from mlflow.exceptions import MlflowException
from mlflow.utils.file_utils import local_file_uri_to_path
from sqlalchemy.exc import SQLAlchemyError

from gyro_pipeline.conventions import InputError
from gyro_pipeline.datasets.run_store import (
    check_answers,
    check_not_moved,
    count_finished,
    ready_store,
)
from gyro_pipeline.datasets.stored import digest_of
from gyro_pipeline.datasets.tracked_models import log_model, model_fit_uri, model_of
from gyro_pipeline.datasets.unsaved_fits import keep_fit, kept_fits
from gyro_pipeline.estimators.base import Estimator
from gyro_pipeline.fingerprints import fingerprint
from gyro_pipeline.tracking import (
    DESCRIPTION,
    EVALUATED_WITH,
    FINGERPRINT,
    HISTORY,
    LAYOUT,
    LAYOUT_TAG,
    EvaluatedRun,
    FittedRun,
    StoredRun,
)

logger = logging.getLogger(__name__)

_TRAINED = "trained"
"""Tag, set last: the time at which the last fit ended. A run without it lacks fits."""

_FITS = "fits"
"""Folder of the fits that are not the model."""

_FIT, _ARTIFACT, _METRICS, _PARAMS = "fit.", "artifact.", "digest.metrics", "digest.params"
"""Tags, or their prefixes, with the digests of fits by fold, of artifacts by name, of the metrics
of the evaluation and of the parameters. A part of a run without such a tag counts as missing."""

_MODEL_FOLD = "model_fold"
"""Tag: the fold whose fit is the model of the run, and is stored only there."""

_OWNER = "process"
"""Tag: the process that writes a run, and the time of its last write, as ``host pid started
written``."""

_SILENT_S = 24 * 3600
"""A process of another machine counts as dead after this time without a write."""

_ABOUT = """Study `{study}` of gyro_pipeline. One run is one row of the study: an estimator, its
training set, a window length and a seed.

`accuracy_gain_pct` says by how much the estimator's error is below that of the mean of the window,
`time_saving_pct` how much shorter its window may be for the same error: both over all windows of
the test recordings. Names that end in `_first` are over first windows only. `scores.csv` has the
rest."""

# A progress bar for each small artifact would hide everything else on a terminal.
os.environ.setdefault("MLFLOW_ENABLE_ARTIFACTS_PROGRESS_BAR", "false")
# MLflow would repeat a request for four minutes without a word.
os.environ.setdefault("MLFLOW_HTTP_REQUEST_MAX_RETRIES", "3")

USER_INTERFACE = "http://127.0.0.1:5000"
"""Default address of ``mlflow ui``."""

_SHARED_VIEW = "mlflow.sharedViewState."
"""Prefix of an experiment's tags with views of its runs, which the user interface opens by name."""

_COLUMNS = {
    "params": ("estimator", "real_gyros", "virtual_gyros", "window_s", "seed"),
    "metrics": ("rmse_mdps", "accuracy_gain_pct", "time_saving_pct", "coverage_95_pct"),
}
_VIEW = {
    "orderByKey": "metrics.`accuracy_gain_pct`",
    "orderByAsc": False,
    "startTime": "ALL",
    "lifecycleFilter": "Active",
    "datasetsFilter": [],
    "modelVersionFilter": "All Runs",
    "selectedColumns": [f"{kind}.`{name}`" for kind in _COLUMNS for name in _COLUMNS[kind]],
}

_CURVE_POINTS = 50

_stores_with_warning: set[str] = set()


class TrackedRuns(AbstractDataset[FittedRun | EvaluatedRun, list[StoredRun]]):
    """The runs of the store, optionally of a single study, source or sensor.

    ``load`` returns the runs, newest first: trained runs, and runs that a dead process left
    unfinished, which are set KILLED and can be continued. ``save`` takes one item at a time: a
    :class:`FittedRun` begins a run or adds to an unfinished one, an :class:`EvaluatedRun`
    completes a run and sets it FINISHED.
    """

    def __init__(
        self,
        path: str,
        source: str | None = None,
        sensor: str | None = None,
        study: str | None = None,
        metadata: dict[str, Any] | None = None,
    ) -> None:
        """Select a part of the store.

        Args:
            path: SQLite file of the store, unless ``MLFLOW_TRACKING_URI`` is set.
            source: Only runs on logs from this source; None for all.
            sensor: Only runs on this sensor; None for all.
            study: Only runs of this study, which is the MLflow experiment; None for all.
            metadata: For Kedro plugins.
        """
        self._path = Path(path)
        filters = {"source": source, "sensor": sensor}
        self.only = {key: value for key, value in filters.items() if value}
        self.study = study
        self.metadata = metadata
        self.provenance: dict[str, str] = {}
        """Tags of every new run; set once per ``kedro run``."""
        self.changed: frozenset[str] = frozenset()
        """Names of settings that differ from ``conf/base``; names of runs state their values."""
        self._kept = self._path.parent / "data" / "06_models"
        self._unfinished: dict[tuple[str, str], tuple[str, set[str]]] = {}
        """Id and completed folds, by study and fingerprint, of runs to which fits are added."""

    def load(self) -> list[StoredRun]:
        """All selected runs, newest first.

        Raises:
            InputError: The store is damaged, is not an MLflow store, or was moved.
        """
        self.check_reachable()
        self._save_kept(self.study)
        experiments = self._experiments()
        if not experiments:
            return []
        studies = {e.experiment_id: e.name for e in experiments}
        search = partial(self._client.search_runs, list(studies))
        # all pages first, as ended runs drop out of the search results
        for run in list(_pages(partial(search, "attributes.status = 'RUNNING'"))):
            if _is_dead(run.data.tags.get(_OWNER, "")):
                self._client.set_terminated(run.info.run_id, "KILLED")
        self._warn_of_older_runs()
        filters = [f"tags.{LAYOUT_TAG} = '{LAYOUT}'"]
        filters += [f"params.{key} = '{value}'" for key, value in self.only.items()]
        runs = [
            self._stored(self._checked(run), studies[run.info.experiment_id])
            for run in _pages(partial(search, " and ".join(filters)))
            if _TRAINED in run.data.tags or _can_be_continued(run)
        ]
        return sorted(runs, key=lambda run: run.started_ms, reverse=True)

    def state(self) -> Any:
        """The number of FINISHED runs of the study; a constant for all studies together.

        A server is not queried: its runs always count as changed.
        """
        if self.study is None:
            return ""
        if not self._is_own_file:
            return time.time()
        return count_finished(self._path, self.study, self.only) if self._path.exists() else 0

    def save(self, data: FittedRun | EvaluatedRun) -> None:
        """Add a fit to its run, or complete an evaluated run.

        A fit that a server does not take is kept in a file, and saved when the server answers.
        """
        if isinstance(data, EvaluatedRun):
            self._save_evaluated(data)
            return
        try:
            self.check_reachable()
            self._save_kept(data.run.study)
            self._save_fitted(data)
        except (InputError, MlflowException, SQLAlchemyError, OSError) as error:
            is_refusal = isinstance(error, InputError) and error.__cause__ is None
            if self._is_own_file or is_refusal:
                raise
            self._unfinished.clear()
            if keep_fit(self._kept, data):
                logger.warning(
                    "the run store does not answer; fits are kept in %s until it does, by the next "
                    "run at the latest (%s)",
                    *(self._kept, " ".join(str(error).split())),
                )

    def _save_kept(self, study: str | None) -> None:
        """Save the fits that were kept while the server did not answer."""
        for path, fitted in kept_fits(self._kept, study):
            same = self._same_runs(fitted)
            if not any(fitted.fold in _fits(run) for run in same):  # an answer may have been lost
                self._save_fitted(fitted)
            path.unlink()

    @cached_property
    def _uri(self) -> str:
        return os.environ.get("MLFLOW_TRACKING_URI") or f"sqlite:///{self._path}"

    @cached_property
    def _is_own_file(self) -> bool:
        return not os.environ.get("MLFLOW_TRACKING_URI")

    @cached_property
    def _client(self) -> MlflowClient:
        if self._is_own_file:
            ready_store(self._path)
        try:
            client = MlflowClient(tracking_uri=self._uri)
        except (CommandError, MlflowException) as error:  # alembic checks the database's layout
            raise InputError(
                f"{self._uri}: not a run store that this MLflow can open ({error}); move it away, "
                "or run `mlflow db upgrade` on it"
            ) from error
        if self._is_own_file:
            for experiment in _pages(client.search_experiments):
                check_not_moved(experiment, self._path)
        return client

    def check_reachable(self) -> None:
        """Check that a server or database answers before a run computes results for it.

        Raises:
            InputError: It does not answer.
        """
        if not self._is_own_file:
            check_answers(self._uri)

    def _experiments(self) -> list[Experiment]:
        experiments = _pages(self._client.search_experiments)
        return [e for e in experiments if self.study in (None, e.name)]

    def _warn_of_older_runs(self) -> None:
        """Log the number of runs of an older layout, once for each store."""
        if self._uri in _stores_with_warning:
            return
        _stores_with_warning.add(self._uri)
        client = self._client
        experiments = [e.experiment_id for e in _pages(client.search_experiments)]
        older = f"tags.{LAYOUT_TAG} IS NULL"
        runs = _pages(partial(client.search_runs, experiments, older))
        if count := sum(FINGERPRINT in run.data.tags for run in runs):
            logger.warning("%d runs of an older layout are not read", count)

    def _stored(self, run: Run, study: str) -> StoredRun:
        return StoredRun(
            run_id=run.info.run_id,
            experiment_id=run.info.experiment_id,
            study=study,
            finished=run.info.status == RunStatus.to_string(RunStatus.FINISHED),
            trained=_TRAINED in run.data.tags,
            started_ms=run.info.start_time,
            params=run.data.params,
            tags=run.data.tags,
            metrics=run.data.metrics,
            fits=_fits(run),
            load=partial(self._load_artifact, run),
            load_fit=partial(self._load_fit, run),
        )

    def _load_artifact(self, run: Run, name: str) -> Any:
        with self._downloaded(run, _ARTIFACT + name) as path:
            return _READERS[path.suffix](path)

    def _load_fit(self, run: Run, fold: str) -> Estimator:
        with self._downloaded(run, _FIT + fold) as path:
            return Estimator.load(path)

    def _uri_of(self, run: Run, tag: str) -> str:
        """Address of the fit or artifact whose digest a tag holds."""
        fold = tag.removeprefix(_FIT)
        if tag.startswith(_ARTIFACT):
            return f"{run.info.artifact_uri}/{tag.removeprefix(_ARTIFACT)}"
        if fold == run.data.tags.get(_MODEL_FOLD):
            return model_fit_uri(self._client, run)
        return f"{run.info.artifact_uri}/{_fit_folder(fold)}"

    @contextmanager
    def _downloaded(self, run: Run, tag: str) -> Iterator[Path]:
        """Download a fit or an artifact and check its digest."""
        run_id, uri = run.info.run_id, self._uri_of(run, tag)
        with tempfile.TemporaryDirectory() as folder:
            try:
                path = Path(download_artifacts(uri, dst_path=folder, tracking_uri=self._uri))
                digest = digest_of(path)
                intact = digest == run.data.tags.get(tag)
                # it may have been evaluated since it was loaded
                intact = intact or digest == self._client.get_run(run_id).data.tags.get(tag)
            except (MlflowException, FileNotFoundError):
                intact = False
            if not intact:
                self._reset(run, [tag])
                raise InputError(
                    f"run {run_id}: {uri} is missing or damaged; type the same command again, "
                    "which makes it again"
                )
            yield path

    def _checked(self, run: Run) -> Run:
        """A run after a reset of its damaged or missing parts."""
        tags = run.data.tags
        if run.data.params and tags.get(_PARAMS) != _digest_of(run.data.params):
            raise InputError(
                f"run {run.info.run_id}: its parameters were changed after it was made; delete it "
                f"with `mlflow runs delete --run-id {run.info.run_id}`, and it is made again"
            )
        parts = [tag for tag in tags if tag.startswith((_FIT, _ARTIFACT))]
        broken = [tag for tag in parts if self._is_broken(run, tag)]
        metrics = tags.get(_METRICS, "")
        if metrics and metrics != _metrics_tag(run.data.metrics, metrics.split()[1:]):
            broken.append(_METRICS)
        return self._reset(run, broken) if broken else run

    def _is_broken(self, run: Run, tag: str) -> bool:
        """Whether a fit or an artifact on this machine is missing or damaged."""
        uri = self._uri_of(run, tag)
        if not uri.startswith("file:"):
            return False  # checked when it is downloaded
        path = Path(local_file_uri_to_path(uri))
        return not path.exists() or digest_of(path) != run.data.tags[tag]

    def _reset(self, run: Run, broken: Sequence[str]) -> Run:
        """Mark parts of a run as missing, so that it is trained or evaluated again."""
        run_id, tags = run.info.run_id, run.data.tags
        fits = [tag for tag in broken if tag.startswith(_FIT)]
        if _ARTIFACT + HISTORY in broken and _MODEL_FOLD in tags:
            fits.append(_FIT + tags[_MODEL_FOLD])
        outdated = {*broken, *fits, *([_TRAINED] if fits else []), EVALUATED_WITH}
        for tag in sorted(outdated & tags.keys()):
            self._client.delete_tag(run_id, tag)
        self._client.update_run(run_id, "KILLED")
        logger.warning(
            "run %s: damaged or missing: %s; it is %s again",
            *(run_id, ", ".join(broken), "trained" if fits else "evaluated"),
        )
        return self._client.get_run(run_id)

    def _save_fitted(self, fitted: FittedRun) -> None:
        key = (fitted.run.study, fitted.run.fingerprint)
        if key not in self._unfinished:
            self._unfinished[key] = self._begin(fitted)
        run_id, fits = self._unfinished[key]
        tags = {_OWNER: _this_process()}
        if fitted.is_model:
            run = self._client.get_run(run_id)
            tags[_FIT + fitted.fold] = log_model(
                self._client, run, fitted.estimator, fitted.example
            )
            tags |= self._log_losses(run_id, fitted)
            tags[_MODEL_FOLD] = fitted.fold
        else:
            with tempfile.TemporaryDirectory() as folder:
                fitted.estimator.save(Path(folder))
                tags[_FIT + fitted.fold] = digest_of(Path(folder))
                self._client.log_artifacts(run_id, folder, _fit_folder(fitted.fold))
        fits.add(fitted.fold)
        if fits >= set(fitted.run.folds):
            tags[_TRAINED] = str(fitted.ended_ms)
            del self._unfinished[key]
            if not self._is_own_file and self._is_duplicate(fitted):
                self._client.delete_run(run_id)
                return
        self._client.log_batch(run_id, tags=_tags(tags))

    def _is_duplicate(self, fitted: FittedRun) -> bool:
        """Whether another project trained the same run at the same time and ended first."""
        others = any(_TRAINED in run.data.tags for run in self._same_runs(fitted))
        if others:
            logger.warning("%s: another project has trained it meanwhile", fitted.run.name)
        return others

    def _same_runs(self, fitted: FittedRun) -> Iterable[Run]:
        same = f"tags.{LAYOUT_TAG} = '{LAYOUT}' and tags.{FINGERPRINT} = '{fitted.run.fingerprint}'"
        study = self._experiment_id(fitted.run.study)
        return _pages(partial(self._client.search_runs, [study], same))

    def _begin(self, fitted: FittedRun) -> tuple[str, set[str]]:
        """Continue the unfinished run that a fit belongs to, or create a run."""
        identity, experiment_id = fitted.run, self._experiment_id(fitted.run.study)
        run = next((run for run in self._same_runs(fitted) if _can_be_continued(run)), None)
        if run is None:
            tags = self._tags_of(fitted)
            changed = self.changed & identity.params.keys()
            differences = sorted(f"{key} {identity.params[key]}" for key in changed)
            env = self.provenance.get("kedro_env", "base")
            name = ", ".join([identity.name, *differences]) + f" ({env})" * (env != "base")
            run = self._client.create_run(experiment_id, fitted.started_ms, tags, name)
        else:
            self._client.update_run(run.info.run_id, "RUNNING")
            self._client.set_tag(run.info.run_id, _OWNER, _this_process())
        inputs = run.inputs.dataset_inputs if run.inputs else []
        if not (run.data.params and inputs):  # a killed process may have stored only the first
            params = [Param(key, str(value)) for key, value in identity.params.items()]
            self._client.log_batch(run.info.run_id, params=params)
            self._client.log_inputs(run.info.run_id, [_dataset(fitted.dataset)])
        return str(run.info.run_id), set(_fits(run))

    def _tags_of(self, fitted: FittedRun) -> dict[str, str]:
        run = fitted.run
        columns = ("sensor", "estimator")
        return {
            **self.provenance,
            **{key: str(run.params[key]) for key in columns if key in run.params},
            "study": run.study,
            "recommended": str(fitted.estimator.recommended),
            **run.tags,
            FINGERPRINT: run.fingerprint,
            LAYOUT_TAG: LAYOUT,
            _OWNER: _this_process(),
            DESCRIPTION: run.note,
            _PARAMS: _digest_of({key: str(value) for key, value in run.params.items()}),
        }

    def _log_losses(self, run_id: str, fitted: FittedRun) -> dict[str, str]:
        losses = fitted.estimator.losses
        if losses is None:
            return {}
        self._client.log_batch(run_id, metrics=_thinned(losses, fitted.ended_ms))
        return self._log_artifacts(run_id, {HISTORY: losses})

    def _save_evaluated(self, evaluated: EvaluatedRun) -> None:
        run = self._client.get_run(evaluated.run_id)
        now_ms = int(time.time() * 1000)  # MLflow shows the newest value of a metric
        metrics = [
            Metric(key, value, now_ms, 0, model_id=model_of(run))
            for key, value in evaluated.metrics.items()
        ]
        self._client.log_batch(evaluated.run_id, metrics=metrics)
        tags = self._log_artifacts(evaluated.run_id, evaluated.artifacts)
        tags |= {**evaluated.tags, _METRICS: _metrics_tag(evaluated.metrics, evaluated.metrics)}
        self._client.log_batch(evaluated.run_id, tags=_tags(tags))
        trained_ms = int(run.data.tags[_TRAINED])
        self._client.set_terminated(evaluated.run_id, "FINISHED", trained_ms)

    def _experiment_id(self, study: str) -> str:
        existing = self._client.get_experiment_by_name(study)
        if existing is not None and existing.lifecycle_stage == "deleted":
            raise InputError(
                f"experiment {study} was deleted in the store; bring it back with `mlflow "
                f"experiments restore --experiment-id {existing.experiment_id}`, or remove it for "
                "good with `mlflow gc`"
            )
        if existing is not None:
            experiment_id = existing.experiment_id
        else:
            folder = self._path.parent / "mlruns" / study
            location = folder.as_uri() if self._is_own_file else None
            experiment_id = self._client.create_experiment(study, location)
        if existing is None or DESCRIPTION not in existing.tags:
            about = _ABOUT.format(study=study)
            self._client.set_experiment_tag(experiment_id, DESCRIPTION, about)
        return str(experiment_id)

    def _log_artifacts(self, run_id: str, artifacts: Mapping[str, Any]) -> dict[str, str]:
        """Store artifacts and return the tags with their digests."""
        tags = {}
        with tempfile.TemporaryDirectory() as folder:
            for name, content in artifacts.items():
                path = Path(folder, name)
                _WRITERS[path.suffix](content, path)
                tags[_ARTIFACT + name] = digest_of(path)
            self._client.log_artifacts(run_id, folder)
        return tags

    def _exists(self) -> bool:
        return not self._is_own_file or self._path.exists()

    def _describe(self) -> dict[str, Any]:
        return {"path": str(self._path), "study": self.study, **self.only}


def run_link(runs: Sequence[TrackedRuns]) -> str | None:
    """Address at which MLflow's user interface shows the runs of a study, the best run first.

    A tag of the experiment stores the filter and the columns of this view.

    Args:
        runs: Datasets of the same study. The view is narrowed to their source and sensor if these
            do not differ.

    Returns:
        The address; None if the study has no runs.
    """
    first = runs[0]
    experiment = next(iter(first._experiments()), None)
    if experiment is None:
        return None
    filters, name = [f"tags.{LAYOUT_TAG} = '{LAYOUT}'"], "runs"
    for key in ("source", "sensor"):
        values = {dataset.only[key] for dataset in runs if key in dataset.only}
        if len(values) == 1:
            (value,) = values
            filters.append(f"params.{key} = '{value}'")
            name += f"_{value}"
    view = json.dumps(_VIEW | {"searchFilter": " and ".join(filters)})
    if experiment.tags.get(_SHARED_VIEW + name) != view:
        first._client.set_experiment_tag(experiment.experiment_id, _SHARED_VIEW + name, view)
    server = first._uri.rstrip("/") if first._uri.startswith("http") else USER_INTERFACE
    query = urlencode({"workflowType": "machine_learning", "viewStateShareKey": name})
    return f"{server}/#/experiments/{experiment.experiment_id}/runs?{query}"


def _dataset(recordings: Mapping[str, str]) -> DatasetInput:
    """The recordings that a run was fitted to, as MLflow shows them."""
    rest = {key: value for key, value in recordings.items() if key not in ("name", "digest")}
    dataset = Dataset(
        name=recordings["name"],
        digest=recordings["digest"],
        source_type="local",
        source=json.dumps({"uri": recordings["source"]}),
        profile=json.dumps(rest),
    )
    return DatasetInput(dataset, [InputTag("mlflow.data.context", "training")])


def _fits(run: Run) -> frozenset[str]:
    return frozenset(tag.removeprefix(_FIT) for tag in run.data.tags if tag.startswith(_FIT))


def _fit_folder(fold: str) -> str:
    return f"{_FITS}/{re.sub('[^a-zA-Z0-9-]', '_', fold)}"


def _digest_of(texts: Mapping[str, str]) -> str:
    return fingerprint(dict(texts))


def _metrics_tag(metrics: Mapping[str, float], names: Iterable[str]) -> str:
    """A digest of selected metrics, and their names."""
    values = {name: repr(metrics.get(name)) for name in names}
    return " ".join([fingerprint(values), *sorted(values)])


def _tags(tags: Mapping[str, str]) -> list[RunTag]:
    return [RunTag(key, value) for key, value in tags.items()]


def _this_process() -> str:
    process = psutil.Process()
    return f"{platform.node()} {process.pid} {process.create_time()} {time.time():.0f}"


def _can_be_continued(run: Run) -> bool:
    """Whether a run lacks fits that no other living process is adding."""
    if _TRAINED in run.data.tags:
        return False
    owner = run.data.tags.get(_OWNER, "")
    running = run.info.status == RunStatus.to_string(RunStatus.RUNNING)
    by_this_process = owner.split()[:-1] == _this_process().split()[:-1]
    return not running or by_this_process or _is_dead(owner)


def _pages(search: Callable[..., Any]) -> Iterable[Any]:
    token = None
    while True:
        page = search(page_token=token)
        yield from page
        token = page.token
        if not token:
            return


def _is_dead(owner: str) -> bool:
    """Whether a run's process has ended, or has not written for long from another machine."""
    parts = owner.split()
    if len(parts) != len(_this_process().split()):
        return False
    host, pid, created, written = parts
    if host != platform.node():
        return time.time() - float(written) > _SILENT_S
    try:
        return str(psutil.Process(int(pid)).create_time()) != created
    except psutil.NoSuchProcess:
        return True


def _thinned(losses: pd.DataFrame, ended_ms: int) -> list[Metric]:
    """About 50 points of each curve; all of them are an artifact."""
    step = -(-len(losses) // _CURVE_POINTS)
    rows = losses.iloc[::-step].iloc[::-1]  # always including the last epoch
    return [
        Metric(name, float(value), ended_ms, int(epoch))
        for name in rows.columns.intersection(["train_loss", "val_loss"])
        for epoch, value in zip(rows["epoch"], rows[name], strict=True)
    ]


_WRITERS: dict[str, Callable[[Any, Path], Any]] = {
    ".parquet": lambda content, path: content.to_parquet(path),
    ".csv": lambda content, path: content.to_csv(path, index=False),
}
_READERS: dict[str, Callable[[Path], Any]] = {
    ".parquet": pd.read_parquet,
    ".csv": pd.read_csv,
}
