"""The file of a run store: made complete or not at all, and refused where it cannot be used."""

import sqlite3
from collections.abc import Mapping
from contextlib import closing
from pathlib import Path

from mlflow import MlflowClient
from mlflow.entities import Experiment
from mlflow.utils.file_utils import local_file_uri_to_path

from gyro_pipeline.conventions import InputError
from gyro_pipeline.datasets.atomic import replacing

_BUSY_S = 20
"""How long to wait for another process that writes to the store."""

_MOVED = "type `python -m gyro_pipeline.store --artifacts-in mlruns`"


def make_store(path: Path) -> None:
    """Make a store that is complete or not there: MLflow cannot use one that is half made."""
    with replacing(path) as temporary:
        MlflowClient(f"sqlite:///{temporary}")


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
