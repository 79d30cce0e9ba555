"""The file of a run store: made complete or not at all, and refused where it cannot be used."""

import errno
import os
import socket
import sqlite3
from collections.abc import Mapping
from contextlib import closing
from functools import cache
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
"""How long to wait for another process that writes to the store."""

_ANSWER_S = 5
_PORTS = {"http": 80, "https": 443, "postgresql": 5432, "mysql": 3306, "mssql": 1433}

_MOVED = "type `python -m gyro_pipeline.store --artifacts-in mlruns`"


def make_store(path: Path) -> None:
    """Make a store that is complete or not there: MLflow cannot use one that is half made."""
    with replacing(path) as temporary:
        MlflowClient(f"sqlite:///{temporary}")


def ready_store(path: Path) -> None:
    """Make the store if there is none, and see that it can be used and written to.

    Raises:
        InputError: It is damaged, or missing beside the artifacts of its runs.
        OSError: It cannot be written to.
    """
    if not path.exists() or not path.stat().st_size:
        artifacts = path.parent / "mlruns"
        if count := sum(1 for _ in artifacts.glob("*/*/artifacts")):
            raise InputError(
                f"{path}: there is no store, or an empty one, beside {artifacts} with the "
                f"artifacts of {count} runs; put the store back, or move {artifacts} away to begin "
                "without these runs"
            )
        make_store(path)
    check_store(path)
    check_writable(path)
    check_writable(path.parent / "mlruns" / "artifacts")
    if not os.access(path, os.W_OK):
        raise PermissionError(errno.EACCES, os.strerror(errno.EACCES), str(path))


@cache
def check_answers(uri: str) -> None:
    """Ask a server or a database once whether it is there.

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
    except (
        OSError,
        sqlalchemy.exc.SQLAlchemyError,
        ImportError,
    ) as error:  # requests' are OSErrors
        raise InputError(
            f"{uri}: the run store of MLFLOW_TRACKING_URI does not answer ({error}); start it, "
            "correct the address, or unset the variable to use mlflow.db"
        ) from error


def check_store(path: Path) -> None:
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


def count_finished(path: Path, study: str, params: Mapping[str, str]) -> int:
    """How many runs of a study, with these parameters, are FINISHED and not deleted.

    It asks the file itself, as MLflow takes seconds to open a store.

    Raises:
        InputError: The file is no run store.
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
        check_store(path)  # it says what is wrong with the file
        return 0


def check_not_moved(experiment: Experiment, store: Path) -> None:
    """Refuse to write artifacts where the store used to be, or where the original of a copy is."""
    location = experiment.artifact_location
    if not location.startswith("file:"):
        return
    folder, own = Path(local_file_uri_to_path(location)), store.parent.resolve()
    is_ours = folder.name == experiment.name  # MLflow itself takes the experiment's number
    if is_ours and own not in {parent.resolve() for parent in folder.parents}:
        raise InputError(
            f"{store}: the artifacts of {experiment.name} are to be in {folder.parent}, which is "
            f"not beside this store; if the project was copied or moved, {_MOVED}"
        )
