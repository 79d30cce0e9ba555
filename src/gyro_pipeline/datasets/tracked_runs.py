"""Runs in an MLflow store as catalog datasets."""

import json
import os
import platform
import sqlite3
import tempfile
import time
from collections.abc import Callable, Iterable, Mapping
from contextlib import closing
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import pandas as pd
import psutil
from kedro.io import AbstractDataset
from mlflow import MlflowClient
from mlflow.entities import Metric, Param, Run, RunStatus, RunTag, ViewType
from mlflow.exceptions import MlflowException
from mlflow.utils.file_utils import local_file_uri_to_path

from gyro_pipeline.conventions import InputError
from gyro_pipeline.datasets.atomic import check_writable, replacing
from gyro_pipeline.tracking import EvaluatedRun, StoredRun, TrainedRun

_TRAINED = "trained"
"""Tag, set last: the run holds all that its training made. Without it, a run is unfinished."""

_OWNER = "process"
"""Tag: the process that writes a run, as ``host pid started``."""

# One bar for each small artifact would bury everything else on a terminal.
os.environ.setdefault("MLFLOW_ENABLE_ARTIFACTS_PROGRESS_BAR", "false")

_BUSY_S = 20
"""How long to wait for another process that writes to the store."""

_MOVED = "if the store was moved, `python -m gyro_pipeline.store --artifacts-in mlruns` tells it so"

_CURVE_POINTS = 50
_LOG_BATCH = 1000  # most metrics that one call takes


class TrackedRuns(AbstractDataset[TrainedRun | EvaluatedRun, list[StoredRun]]):
    """Trained runs of one study, or of all, of one source, or of all, and of one sensor, or of all.

    Loading returns the trained runs, newest first, and ends what dead processes left unfinished as
    KILLED; of these, a trained run can still be evaluated. Saving takes one run at a time: a
    :class:`TrainedRun` becomes a run that waits for its evaluation, an :class:`EvaluatedRun`
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
        self._only = {key: value for key, value in wanted.items() if value}
        self._study = study
        self.metadata = metadata
        self.provenance: dict[str, str] = {}
        """Tags that every new run gets; set once per ``kedro run``."""

    def load(self) -> list[StoredRun]:
        """Trained runs, newest first.

        Raises:
            InputError: If the store is damaged or is no MLflow store.
        """
        experiments = {e.experiment_id: e.name for e in self._experiments()}
        if not experiments:
            return []
        search = partial(self._client.search_runs, list(experiments))
        # all pages first: what is ended is no longer on the next one
        for run in list(_pages(partial(search, "attributes.status = 'RUNNING'"))):
            if _is_dead(run.data.tags.get(_OWNER, "")):
                self._client.set_terminated(run.info.run_id, "KILLED")
        wanted = " and ".join(f"params.{key} = '{value}'" for key, value in self._only.items())
        trained = [
            self._stored(run, experiments[run.info.experiment_id])
            for run in _pages(partial(search, wanted))
            if _TRAINED in run.data.tags
        ]
        return sorted(trained, key=lambda run: run.started_ms, reverse=True)

    def save(self, data: TrainedRun | EvaluatedRun) -> None:
        """Add a trained run, or complete an evaluated one."""
        if isinstance(data, TrainedRun):
            self._save_trained(data)
        else:
            self._save_evaluated(data)

    @cached_property
    def _client(self) -> MlflowClient:
        uri = os.environ.get("MLFLOW_TRACKING_URI")
        if not uri:
            if not self._path.exists():
                _make_store(self._path)
            _check_store(self._path)
            check_writable(self._path.parent / "mlruns" / "artifacts")
            uri = f"sqlite:///{self._path}"
        try:
            return MlflowClient(tracking_uri=uri)
        except Exception as error:  # alembic and SQLAlchemy have no common base
            raise InputError(
                f"{uri}: not a run store that this MLflow can open ({error}); move it away, or "
                "run `mlflow db upgrade` on it"
            ) from error

    def _experiments(self) -> list[Any]:
        experiments = _pages(partial(self._client.search_experiments, ViewType.ACTIVE_ONLY))
        return [e for e in experiments if self._study in (None, e.name)]

    def _stored(self, run: Run, study: str) -> StoredRun:
        return StoredRun(
            run_id=run.info.run_id,
            experiment_id=run.info.experiment_id,
            study=study,
            finished=run.info.status == RunStatus.to_string(RunStatus.FINISHED),
            started_ms=run.info.start_time,
            params=run.data.params,
            tags=run.data.tags,
            metrics=run.data.metrics,
            load=partial(self._load_artifact, run.info.run_id),
        )

    def _load_artifact(self, run_id: str, name: str) -> Any:
        with tempfile.TemporaryDirectory() as folder:
            try:
                path = Path(self._client.download_artifacts(run_id, name, folder))
            except MlflowException as error:
                raise InputError(
                    f"run {run_id}: its artifact {name} cannot be read ({error}); {_MOVED}"
                ) from error
            return _READERS[path.suffix](path)

    def _save_trained(self, trained: TrainedRun) -> None:
        owner = psutil.Process()
        owned = {_OWNER: f"{platform.node()} {owner.pid} {owner.create_time()}"}
        tags = self.provenance | dict(trained.tags) | owned
        run = self._client.create_run(
            self._experiment_id(trained.study), trained.started_ms, tags, _run_name(trained.params)
        )
        run_id = run.info.run_id
        params = [Param(key, str(value)) for key, value in trained.params.items()]
        self._client.log_batch(run_id, params=params)
        if trained.history is not None:
            self._log_metrics(run_id, _thinned(trained.history, trained.ended_ms))
        self._log_artifacts(run_id, trained.artifacts)
        self._client.log_batch(run_id, tags=[RunTag(_TRAINED, str(trained.ended_ms))])

    def _save_evaluated(self, evaluated: EvaluatedRun) -> None:
        run = self._client.get_run(evaluated.run_id)
        now_ms = int(time.time() * 1000)  # MLflow shows the newest value of a metric
        metrics = [Metric(key, value, now_ms, 0) for key, value in evaluated.metrics.items()]
        self._log_metrics(evaluated.run_id, metrics)
        self._log_artifacts(evaluated.run_id, evaluated.artifacts)
        tags = [RunTag(key, value) for key, value in evaluated.tags.items()]
        self._client.log_batch(evaluated.run_id, tags=tags)
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
            _check_not_moved(existing.artifact_location)
            return str(existing.experiment_id)
        location = None
        if not os.environ.get("MLFLOW_TRACKING_URI"):
            location = (self._path.parent / "mlruns" / study).as_uri()
        return str(self._client.create_experiment(study, location))

    def _log_metrics(self, run_id: str, metrics: list[Metric]) -> None:
        for start in range(0, len(metrics), _LOG_BATCH):
            self._client.log_batch(run_id, metrics=metrics[start : start + _LOG_BATCH])

    def _log_artifacts(self, run_id: str, artifacts: Mapping[str, Any]) -> None:
        with tempfile.TemporaryDirectory() as folder:
            for name, content in artifacts.items():
                path = Path(folder, name)
                _WRITERS[path.suffix](content, path)
            self._client.log_artifacts(run_id, folder)

    def _exists(self) -> bool:
        return bool(os.environ.get("MLFLOW_TRACKING_URI")) or self._path.exists()

    def _describe(self) -> dict[str, Any]:
        return {"path": str(self._path), "study": self._study, **self._only}


def _make_store(path: Path) -> None:
    """MLflow takes seconds for it, and cannot use one that was left half made."""
    with replacing(path) as temporary:
        MlflowClient(f"sqlite:///{temporary}")


def _check_store(path: Path) -> None:
    """Refuse a file that is no MLflow store before MLflow would write into it."""
    advice = "move it away to start a new store"
    try:
        # Writable, so that SQLite can roll back what a killed process left half written.
        uri = f"{path.resolve().as_uri()}?mode=rw"
        with closing(sqlite3.connect(uri, uri=True, timeout=_BUSY_S)) as connection:
            tables = {name for (name,) in connection.execute("select name from sqlite_master")}
            sound = [row[0] for row in connection.execute("pragma quick_check(1)")]
    except sqlite3.DatabaseError as error:
        raise InputError(f"{path}: not a readable SQLite file ({error}); {advice}") from error
    if sound != ["ok"]:
        raise InputError(f"{path}: a damaged SQLite file ({sound[0]}); {advice}")
    if tables and not {"experiments", "alembic_version"} <= tables:
        raise InputError(
            f"{path}: expected an MLflow store, got an SQLite file with tables "
            f"{', '.join(sorted(tables)[:5])}; {advice}"
        )


def _check_not_moved(location: str) -> None:
    """Refuse to write artifacts where the store used to be."""
    if location.startswith("file:"):
        project = Path(local_file_uri_to_path(location)).parents[1]
        if not project.is_dir():
            raise InputError(f"{project}, where the store keeps artifacts, is not there; {_MOVED}")


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


def _run_name(params: Mapping[str, Any]) -> str:
    """Readable at a glance in a list of runs."""
    fold = f" fold {params['fold']}" if params["fold"] >= 0 else ""
    if "leak" in params:
        shuffled = " shuffled labels" if params["estimator"] == "cnn_shuffled" else ""
        return (
            f"{params['sensor']} leak {params['leak']}{shuffled} {params['window_s']:g} s every "
            f"{params['window_stride_s']:g} s seed {params['seed']}{fold}"
        )
    if params["estimator"] != "cnn":
        return f"{params['sensor']} {params['estimator']} {params['window_s']:g} s"
    return (
        f"{params['sensor']} {params['real_gyros']}+{params['virtual_gyros']} "
        f"{params['window_s']:g} s seed {params['seed']}{fold}"
    )


def _thinned(history: pd.DataFrame, ended_ms: int) -> list[Metric]:
    """About 50 points of each curve: the whole history is an artifact."""
    step = -(-len(history) // _CURVE_POINTS)
    rows = history.iloc[::-step].iloc[::-1]  # the last epoch is always among them
    return [
        Metric(name, float(value), ended_ms, int(epoch))
        for name in rows.columns.drop("epoch")
        for epoch, value in zip(rows["epoch"], rows[name], strict=True)
    ]


def _write_weights(content: Any, path: Path) -> None:
    import torch  # noqa: PLC0415 - 2 s that only runs with weights need

    torch.save(content, path)


def _read_weights(path: Path) -> Any:
    import torch  # noqa: PLC0415

    return torch.load(path, weights_only=True)


_WRITERS: dict[str, Callable[[Any, Path], Any]] = {
    ".parquet": lambda content, path: content.to_parquet(path),
    ".csv": lambda content, path: content.to_csv(path, index=False),
    ".json": lambda content, path: path.write_text(json.dumps(content, indent=1)),
    ".pt": _write_weights,
}
_READERS: dict[str, Callable[[Path], Any]] = {
    ".parquet": pd.read_parquet,
    ".csv": pd.read_csv,
    ".json": lambda path: json.loads(path.read_text()),
    ".pt": _read_weights,
}
