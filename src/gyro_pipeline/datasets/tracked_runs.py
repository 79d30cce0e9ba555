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

from gyro_pipeline.conventions import InputError
from gyro_pipeline.datasets.atomic import check_writable
from gyro_pipeline.datasets.run_store import (
    check_not_moved,
    check_store,
    count_finished,
    make_store,
)
from gyro_pipeline.datasets.tracked_models import log_model, model_fit_uri, model_of
from gyro_pipeline.estimators.base import Estimator
from gyro_pipeline.tracking import (
    DESCRIPTION,
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
"""Tag, set last: when the last fit ended. A run without it lacks fits."""

_FITS, _END = "fits", "; "
"""Tag, and folder of artifacts: the folds whose fits are stored. MLflow cuts very long tags."""

_MODEL_FOLD = "model_fold"
"""Tag: the fold whose fit is the model of the run, and is stored nowhere else."""

_OWNER = "process"
"""Tag: the process that writes a run, as ``host pid started``."""

_ABOUT = """Study `{study}` of gyro_pipeline. One run is one row of the study: an estimator, its
training set, a window length and a seed.

`accuracy_gain_pct` says by how much the estimator's error is below that of the mean of the window,
`time_saving_pct` how much shorter its window may be for the same error: both over all windows of
the test recordings. Names that end in `_first` are over first windows only. `scores.csv` has the
rest."""

# One bar for each small artifact would bury everything else on a terminal.
os.environ.setdefault("MLFLOW_ENABLE_ARTIFACTS_PROGRESS_BAR", "false")

USER_INTERFACE = "http://127.0.0.1:5000"
"""Where ``mlflow ui`` listens unless told otherwise."""

_SHARED_VIEW = "mlflow.sharedViewState."
"""Start of a tag of an experiment: a view of its runs, which the user interface opens by name."""

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

_told_of_older_runs: set[str] = set()


class TrackedRuns(AbstractDataset[FittedRun | EvaluatedRun, list[StoredRun]]):
    """Runs of one study, or of all, of one source, or of all, and of one sensor, or of all.

    Loading returns the runs, newest first: trained ones, and those that a dead process left
    unfinished, which are ended as KILLED and can be continued. Saving takes one item at a time: a
    :class:`FittedRun` begins a run or adds to an unfinished one, an :class:`EvaluatedRun`
    completes it and sets it FINISHED.
    """

    def __init__(
        self,
        path: str,
        source: str | None = None,
        sensor: str | None = None,
        study: str | None = None,
        metadata: dict[str, Any] | None = None,
    ) -> None:
        """Describe a part of the store.

        Args:
            path: SQLite file of the store; ``MLFLOW_TRACKING_URI`` wins where set.
            source: Only runs on logs from there; None for all.
            sensor: Only runs on this sensor; None for all.
            study: Only runs of this study, which is the MLflow experiment; None for all.
            metadata: For Kedro plugins.
        """
        self._path = Path(path)
        wanted = {"source": source, "sensor": sensor}
        self.only = {key: value for key, value in wanted.items() if value}
        self.study = study
        self.metadata = metadata
        self.provenance: dict[str, str] = {}
        """Tags that every new run gets; set once per ``kedro run``."""
        self.changed: frozenset[str] = frozenset()
        """Names of settings that differ from those of ``conf/base``; their values are in names."""
        self._begun: dict[tuple[str, str], tuple[str, set[str]]] = {}
        """Runs that fits are added to, by study and fingerprint: the id, and the folds so far."""

    def load(self) -> list[StoredRun]:
        """Runs, newest first.

        Raises:
            InputError: If the store is damaged, is no MLflow store, or was moved.
        """
        experiments = self._experiments()
        if not experiments:
            return []
        studies = {e.experiment_id: e.name for e in experiments}
        search = partial(self._client.search_runs, list(studies))
        # all pages first: what is ended is no longer on the next one
        for run in list(_pages(partial(search, "attributes.status = 'RUNNING'"))):
            if _is_dead(run.data.tags.get(_OWNER, "")):
                self._client.set_terminated(run.info.run_id, "KILLED")
        self._tell_of_older_runs()
        wanted = [f"tags.{LAYOUT_TAG} = '{LAYOUT}'"]
        wanted += [f"params.{key} = '{value}'" for key, value in self.only.items()]
        stored = [
            self._stored(run, studies[run.info.experiment_id])
            for run in _pages(partial(search, " and ".join(wanted)))
            if _TRAINED in run.data.tags or _is_left(run)
        ]
        return sorted(stored, key=lambda run: run.started_ms, reverse=True)

    def state(self) -> Any:
        """How many runs of the study are FINISHED; nothing of all studies, which decides no result.

        What a server holds is not asked for: it always counts as changed.
        """
        if self.study is None:
            return ""
        if not self._is_own_file:
            return time.time()
        return count_finished(self._path, self.study, self.only) if self._path.exists() else 0

    def save(self, data: FittedRun | EvaluatedRun) -> None:
        """Add a fit to its run, or complete an evaluated run."""
        if isinstance(data, FittedRun):
            self._save_fitted(data)
        else:
            self._save_evaluated(data)

    @cached_property
    def _uri(self) -> str:
        return os.environ.get("MLFLOW_TRACKING_URI") or f"sqlite:///{self._path}"

    @cached_property
    def _is_own_file(self) -> bool:
        return not os.environ.get("MLFLOW_TRACKING_URI")

    @cached_property
    def _client(self) -> MlflowClient:
        if self._is_own_file:
            if not self._path.exists():
                make_store(self._path)
            check_store(self._path)
            check_writable(self._path.parent / "mlruns" / "artifacts")
        try:
            client = MlflowClient(tracking_uri=self._uri)
        except Exception as error:  # alembic and SQLAlchemy have no common base
            raise InputError(
                f"{self._uri}: not a run store that this MLflow can open ({error}); move it away, "
                "or run `mlflow db upgrade` on it"
            ) from error
        if self._is_own_file:
            for experiment in _pages(client.search_experiments):
                check_not_moved(experiment, self._path)
        return client

    def _experiments(self) -> list[Experiment]:
        experiments = _pages(self._client.search_experiments)
        return [e for e in experiments if self.study in (None, e.name)]

    def _tell_of_older_runs(self) -> None:
        """Count the runs of all studies that are not read, once for each store."""
        if self._uri in _told_of_older_runs:
            return
        _told_of_older_runs.add(self._uri)
        client = self._client
        everywhere = [e.experiment_id for e in _pages(client.search_experiments)]
        wanted = f"tags.{LAYOUT_TAG} IS NULL"
        runs = _pages(partial(client.search_runs, everywhere, wanted))
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
        with self._downloaded(run, f"{run.info.artifact_uri}/{name}") as path:
            return _READERS[path.suffix](path)

    def _load_fit(self, run: Run, fold: str) -> Estimator:
        if fold == run.data.tags.get(_MODEL_FOLD):
            source = model_fit_uri(self._client, run)
        else:
            source = f"{run.info.artifact_uri}/{_fit_folder(fold)}"
        with self._downloaded(run, source) as path:
            return Estimator.load(path)

    @contextmanager
    def _downloaded(self, run: Run, uri: str) -> Iterator[Path]:
        with tempfile.TemporaryDirectory() as folder:
            try:
                path = download_artifacts(uri, dst_path=folder, tracking_uri=self._uri)
            except (MlflowException, OSError) as error:
                raise InputError(
                    f"run {run.info.run_id}: {uri} cannot be read ({error}); delete the run, and "
                    "the next `kedro run` makes it again"
                ) from error
            yield Path(path)

    def _save_fitted(self, fitted: FittedRun) -> None:
        key = (fitted.run.study, fitted.run.fingerprint)
        if key not in self._begun:
            self._begun[key] = self._begin(fitted)
        (run_id, fits), tags = self._begun[key], {}
        if fitted.is_model:
            run = self._client.get_run(run_id)
            log_model(self._client, run, fitted.estimator, fitted.example)
            self._log_history(run_id, fitted)
            tags[_MODEL_FOLD] = fitted.fold
        else:
            with tempfile.TemporaryDirectory() as folder:
                fitted.estimator.save(Path(folder))
                self._client.log_artifacts(run_id, folder, _fit_folder(fitted.fold))
        fits.add(fitted.fold)
        tags[_FITS] = "".join(f"{fold}{_END}" for fold in sorted(fits))
        if fits >= set(fitted.run.folds):
            tags[_TRAINED] = str(fitted.ended_ms)
            del self._begun[key]
        self._client.log_batch(run_id, tags=_tags(tags))

    def _begin(self, fitted: FittedRun) -> tuple[str, set[str]]:
        """The run that a fit is added to: one that was left unfinished, or a new one."""
        experiment_id, wanted = self._experiment_id(fitted.run.study), fitted.run
        left = _pages(
            partial(
                self._client.search_runs,
                [experiment_id],
                f"tags.{LAYOUT_TAG} = '{LAYOUT}' and tags.{FINGERPRINT} = '{wanted.fingerprint}'",
            )
        )
        run = next((run for run in left if _is_left(run)), None)
        if run is None:
            tags = self._tags_of(fitted)
            differs = [f"{key} {wanted.params[key]}" for key in self.changed & wanted.params.keys()]
            env = self.provenance.get("kedro_env", "base")
            name = ", ".join([wanted.name, *sorted(differs)])
            name += f" ({env})" * (env != "base")
            run = self._client.create_run(experiment_id, fitted.started_ms, tags, name)
        else:
            self._client.update_run(run.info.run_id, "RUNNING")
            self._client.set_tag(run.info.run_id, _OWNER, _this_process())
        inputs = run.inputs.dataset_inputs if run.inputs else []
        if not (run.data.params and inputs):  # also where a kill came between the two
            params = [Param(key, str(value)) for key, value in wanted.params.items()]
            self._client.log_batch(run.info.run_id, params=params)
            self._client.log_inputs(run.info.run_id, [_dataset(fitted.dataset)])
        return str(run.info.run_id), set(_fits(run))

    def _tags_of(self, fitted: FittedRun) -> dict[str, str]:
        run = fitted.run
        shown = {key: str(run.params[key]) for key in ("sensor", "estimator") if key in run.params}
        return {
            **self.provenance,
            **shown,
            "study": run.study,
            "recommended": str(fitted.estimator.recommended),
            **run.tags,
            FINGERPRINT: run.fingerprint,
            LAYOUT_TAG: LAYOUT,
            _OWNER: _this_process(),
            DESCRIPTION: run.note,
        }

    def _log_history(self, run_id: str, fitted: FittedRun) -> None:
        history = fitted.estimator.history
        if history is not None:
            self._client.log_batch(run_id, metrics=_thinned(history, fitted.ended_ms))
            self._log_artifacts(run_id, {HISTORY: history})

    def _save_evaluated(self, evaluated: EvaluatedRun) -> None:
        run = self._client.get_run(evaluated.run_id)
        now_ms = int(time.time() * 1000)  # MLflow shows the newest value of a metric
        metrics = [
            Metric(key, value, now_ms, 0, model_id=model_of(run))
            for key, value in evaluated.metrics.items()
        ]
        self._client.log_batch(evaluated.run_id, metrics=metrics)
        self._log_artifacts(evaluated.run_id, evaluated.artifacts)
        self._client.log_batch(evaluated.run_id, tags=_tags(evaluated.tags))
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
            own = self._path.parent / "mlruns" / study
            location = own.as_uri() if self._is_own_file else None
            experiment_id = self._client.create_experiment(study, location)
        if existing is None or DESCRIPTION not in existing.tags:
            about = _ABOUT.format(study=study)
            self._client.set_experiment_tag(experiment_id, DESCRIPTION, about)
        return str(experiment_id)

    def _log_artifacts(self, run_id: str, artifacts: Mapping[str, Any]) -> None:
        with tempfile.TemporaryDirectory() as folder:
            for name, content in artifacts.items():
                path = Path(folder, name)
                _WRITERS[path.suffix](content, path)
            self._client.log_artifacts(run_id, folder)

    def _exists(self) -> bool:
        return not self._is_own_file or self._path.exists()

    def _describe(self) -> dict[str, Any]:
        return {"path": str(self._path), "study": self.study, **self.only}


def run_link(runs: Sequence[TrackedRuns]) -> str | None:
    """Address at which MLflow's user interface shows the runs of a study, the best first.

    A tag of the experiment holds the filter and the columns of that view.

    Args:
        runs: Datasets of one study; the view is narrowed to their source and sensor if all that
            name one agree.

    Returns:
        The link; None if the study has no runs.
    """
    first = runs[0]
    experiment = next(iter(first._experiments()), None)
    if experiment is None:
        return None
    wanted, name = [f"tags.{LAYOUT_TAG} = '{LAYOUT}'"], "runs"
    for key in ("source", "sensor"):
        values = {dataset.only[key] for dataset in runs if key in dataset.only}
        if len(values) == 1:
            (value,) = values
            wanted.append(f"params.{key} = '{value}'")
            name += f"_{value}"
    view = json.dumps(_VIEW | {"searchFilter": " and ".join(wanted)})
    if experiment.tags.get(_SHARED_VIEW + name) != view:
        first._client.set_experiment_tag(experiment.experiment_id, _SHARED_VIEW + name, view)
    server = first._uri.rstrip("/") if first._uri.startswith("http") else USER_INTERFACE
    query = urlencode({"workflowType": "machine_learning", "viewStateShareKey": name})
    return f"{server}/#/experiments/{experiment.experiment_id}/runs?{query}"


def _dataset(described: Mapping[str, str]) -> DatasetInput:
    """The recordings that a run was fitted to, as MLflow shows them."""
    rest = {key: value for key, value in described.items() if key not in ("name", "digest")}
    dataset = Dataset(
        name=described["name"],
        digest=described["digest"],
        source_type="local",
        source=json.dumps({"uri": described["source"]}),
        profile=json.dumps(rest),
    )
    return DatasetInput(dataset, [InputTag("mlflow.data.context", "training")])


def _fits(run: Run) -> frozenset[str]:
    *whole, _ = run.data.tags.get(_FITS, "").split(_END)
    return frozenset(whole)


def _fit_folder(fold: str) -> str:
    return f"{_FITS}/{re.sub('[^a-zA-Z0-9-]', '_', fold)}"


def _tags(tags: Mapping[str, str]) -> list[RunTag]:
    return [RunTag(key, value) for key, value in tags.items()]


def _this_process() -> str:
    process = psutil.Process()
    return f"{platform.node()} {process.pid} {process.create_time()}"


def _is_left(run: Run) -> bool:
    """Whether a run lacks fits that nobody else is about to add."""
    if _TRAINED in run.data.tags:
        return False
    owner = run.data.tags.get(_OWNER, "")
    running = run.info.status == RunStatus.to_string(RunStatus.RUNNING)
    return not running or owner == _this_process() or _is_dead(owner)


def _pages(search: Callable[..., Any]) -> Iterable[Any]:
    token = None
    while True:
        page = search(page_token=token)
        yield from page
        token = page.token
        if not token:
            return


def _is_dead(owner: str) -> bool:
    """Whether a run's process ran on this machine and is gone."""
    host, pid, created = owner.split() if owner.count(" ") == 2 else ("", "", "")  # noqa: PLR2004
    if host != platform.node():
        return False
    try:
        return str(psutil.Process(int(pid)).create_time()) != created
    except psutil.NoSuchProcess:
        return True


def _thinned(history: pd.DataFrame, ended_ms: int) -> list[Metric]:
    """About 50 points of each curve: the whole history is an artifact."""
    step = -(-len(history) // _CURVE_POINTS)
    rows = history.iloc[::-step].iloc[::-1]  # the last epoch is always among them
    return [
        Metric(name, float(value), ended_ms, int(epoch))
        for name in rows.columns.intersection(["train_loss", "val_loss"])
        for epoch, value in zip(rows["epoch"], rows[name], strict=True)
    ]


_WRITERS: dict[str, Callable[[Any, Path], Any]] = {
    ".parquet": lambda content, path: content.to_parquet(path),
    ".csv": lambda content, path: content.to_csv(path, index=False),
    ".json": lambda content, path: path.write_text(json.dumps(content, indent=1)),
}
_READERS: dict[str, Callable[[Path], Any]] = {
    ".parquet": pd.read_parquet,
    ".csv": pd.read_csv,
    ".json": lambda path: json.loads(path.read_text()),
}
