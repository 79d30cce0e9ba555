"""The SQLite file of a run store: its creation and its checks."""

import errno
import os
import socket
import sqlite3
from collections.abc import Mapping
from contextlib import closing
from pathlib import Path
from urllib.parse import urlsplit

import requests
import sqlalchemy
from mlflow import MlflowClient
from mlflow.entities import Experiment
from mlflow.utils.file_utils import local_file_uri_to_path

from gyro_pipeline.conventions import InputError
from gyro_pipeline.datasets.atomic import check_writable, replacing

_BUSY_S = 20
"""Longest wait for another process that writes to the store."""

_ANSWER_S = 5
_PORTS = {"http": 80, "https": 443, "postgresql": 5432, "mysql": 3306, "mssql": 1433}

_MOVED = "type `python -m gyro_pipeline.store --artifacts-in mlruns`"


def make_store(path: Path) -> None:
    """Create a store completely or not at all, since MLflow cannot use an incomplete one."""
    with replacing(path) as temporary:
        MlflowClient(f"sqlite:///{temporary}")


def ready_store(path: Path) -> None:
    """Create the store if it does not exist, and check that it can be used and written to.

    Raises:
        InputError: The store is damaged, or missing although artifacts of its runs exist.
        OSError: The store cannot be written to.
    """
    if not path.exists() or not path.stat().st_size:
        artifacts = path.parent / "mlruns"
        if count := sum(1 for _ in artifacts.glob("*/*/artifacts")):
            raise InputError(
                f"{path}: no such file, or an empty one, but {artifacts} has the artifacts of "
                f"{count} runs; put the store back, or move {artifacts} away to begin without "
                "these runs"
            )
        make_store(path)
    check_store(path)
    check_writable(path)
    check_writable(path.parent / "mlruns" / "artifacts")
    if not os.access(path, os.W_OK):
        raise PermissionError(errno.EACCES, os.strerror(errno.EACCES), str(path))


def check_answers(uri: str) -> None:
    """Check that a server or a database answers.

    Raises:
        InputError: It does not answer.
    """
    address = urlsplit(uri)
    port = address.port or _PORTS.get(address.scheme.partition("+")[0])
    try:
        if address.hostname and port:
            socket.create_connection((address.hostname, port), timeout=_ANSWER_S).close()
        if address.scheme.startswith("http"):
            requests.get(f"{uri.rstrip('/')}/health", timeout=_ANSWER_S).raise_for_status()
        elif address.hostname:
            sqlalchemy.create_engine(uri).connect().close()
    # the errors of requests are OSErrors
    except (OSError, sqlalchemy.exc.SQLAlchemyError, ImportError) as error:
        raise InputError(
            f"{uri}: the run store of MLFLOW_TRACKING_URI does not answer ({error}); start it, "
            "correct the address, or unset the variable to use mlflow.db"
        ) from error


def check_store(path: Path) -> None:
    """Refuse a file that is not an MLflow store before MLflow writes into it."""
    advice = "move it away to start a new store"
    try:
        # writable, so that SQLite can roll back the unfinished transaction of a killed process
        uri = f"{path.resolve().as_uri()}?mode=rw"
        with closing(sqlite3.connect(uri, uri=True, timeout=_BUSY_S)) as connection:
            tables = {name for (name,) in connection.execute("select name from sqlite_master")}
            problems = [row[0] for row in connection.execute("pragma quick_check(1)")]
    except sqlite3.DatabaseError as error:
        raise InputError(f"{path}: not a readable SQLite file ({error}); {advice}") from error
    if problems != ["ok"]:
        raise InputError(f"{path}: a damaged SQLite file ({problems[0]}); {advice}")
    if tables and not {"experiments", "alembic_version"} <= tables:
        raise InputError(
            f"{path}: expected an MLflow store, got an SQLite file with tables "
            f"{', '.join(sorted(tables)[:5])}; {advice}"
        )


def count_finished(path: Path, study: str, params: Mapping[str, str]) -> int:
    """Count the FINISHED and not deleted runs of a study that have given parameters.

    This reads the file itself, as MLflow takes seconds to open a store.

    Raises:
        InputError: The file is not a run store.
    """
    query = (
        "select count(*) from runs join experiments using (experiment_id) where "
        "runs.status = 'FINISHED' and runs.lifecycle_stage = 'active' and experiments.name = ?"
    )
    for _ in params:
        query += " and run_uuid in (select run_uuid from params where key = ? and value = ?)"
    values = [study, *(part for pair in params.items() for part in pair)]
    try:
        with closing(sqlite3.connect(f"{path.resolve().as_uri()}?mode=ro", uri=True)) as connection:
            return int(connection.execute(query, values).fetchone()[0])
    except sqlite3.DatabaseError:
        check_store(path)  # raises an error that says what is wrong
        return 0


def check_not_moved(experiment: Experiment, store: Path) -> None:
    """Refuse a store that was moved or copied, as its artifact paths still name the old folder."""
    location = experiment.artifact_location
    if not location.startswith("file:"):
        return
    folder, project = Path(local_file_uri_to_path(location)), store.parent.resolve()
    created_here = folder.name == experiment.name  # MLflow would name it by the experiment's number
    if created_here and project not in {parent.resolve() for parent in folder.parents}:
        raise InputError(
            f"{store}: the artifacts of {experiment.name} would be written to {folder.parent}, "
            f"which is not beside this store; if the project was copied or moved, {_MOVED}"
        )
