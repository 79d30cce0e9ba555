"""See what the run store holds, and tell it where its artifacts are after a move.

``python -m gyro_pipeline.store`` in the folder of ``mlflow.db``. MLflow writes down for every run
where its artifacts are, as an absolute path, and has no command that changes it.
"""

import argparse
import sqlite3
import sys
from collections.abc import Sequence
from contextlib import closing
from pathlib import Path
from urllib.parse import unquote, urlparse

import pandas as pd

from gyro_pipeline.conventions import InputError

_STUDIES = "select experiment_id, name, lifecycle_stage, artifact_location from experiments"
_COUNTS = "select lifecycle_stage, count(*) from runs where experiment_id = ? group by 1"
_MOVE_STUDY = "update experiments set artifact_location = ? where experiment_id = ?"
_MOVE_RUNS = "update runs set artifact_uri = ? || substr(artifact_uri, ?) where experiment_id = ?"
_MOVE_MODELS = (
    "update logged_models set artifact_location = ? || substr(artifact_location, ?) "
    "where experiment_id = ?"
)
_MB = 1e6


def describe(store: Path) -> pd.DataFrame:
    """What there is of each study.

    Args:
        store: SQLite file.

    Returns:
        A row per study: its runs, those that only MLflow's ``gc`` still has to remove, and the size
        of its artifacts in MB, NaN where they are not in a folder of this machine.
    """
    rows = []
    with closing(sqlite3.connect(f"{store.resolve().as_uri()}?mode=ro", uri=True)) as db:
        for number, name, stage, location in db.execute(_STUDIES).fetchall():
            counts = dict(db.execute(_COUNTS, [number]).fetchall())
            rows.append(
                {
                    "id": number,
                    "study": name + (" (deleted)" if stage == "deleted" else ""),
                    "runs": counts.get("active", 0),
                    "deleted": counts.get("deleted", 0),
                    "artifacts MB": _size_mb(location),
                    "artifacts in": location,
                }
            )
    return pd.DataFrame(rows)


def relocate(store: Path, location: str) -> int:
    """Tell the store that the folder of all artifacts now is another one.

    Args:
        store: SQLite file.
        location: A folder, or an address such as ``mlflow-artifacts:``; it has a folder for each
            study, named as before.

    Returns:
        How many runs were told.

    Raises:
        InputError: Artifacts are not there.
    """
    base = location.rstrip("/") if _is_address(location) else Path(location).absolute().as_uri()
    with closing(sqlite3.connect(f"{store.resolve().as_uri()}?mode=rw", uri=True)) as db, db:
        told = 0
        for number, name, _, old in db.execute(_STUDIES).fetchall():
            new = f"{base}/{old.rpartition('/')[2]}"
            runs = db.execute(_MOVE_RUNS, [new, len(old) + 1, number]).rowcount
            folder = _folder(new)
            if runs and folder is not None and not folder.is_dir():
                raise InputError(f"{folder}: artifacts of {name} are not there; move them first")
            db.execute(_MOVE_MODELS, [new, len(old) + 1, number])
            db.execute(_MOVE_STUDY, [new, number])
            told += runs
    return told


def main(arguments: Sequence[str] | None = None) -> None:
    """Print what the store holds, after a relocation if that is asked for."""
    parser = argparse.ArgumentParser("python -m gyro_pipeline.store", description=__doc__)
    parser.add_argument("--store", type=Path, default=Path("mlflow.db"), help="SQLite file")
    parser.add_argument(
        "--artifacts-in",
        metavar="FOLDER",
        help="where they are now, e.g. mlruns or mlflow-artifacts:",
    )
    given = parser.parse_args(arguments)
    try:
        if not given.store.is_file():
            raise InputError(f"{given.store}: there is no store")
        if given.artifacts_in:
            relocate(given.store, given.artifacts_in)
        table = describe(given.store)
    except InputError as error:
        sys.exit(f"error: {error}")
    sys.stdout.write(f"{table.to_string(index=False, na_rep='not here')}\n")
    sys.stdout.write(f"{given.store}: {given.store.stat().st_size / _MB:.1f} MB\n")


def _is_address(location: str) -> bool:
    return ":" in location.partition("/")[0]


def _folder(location: str) -> Path | None:
    """The folder that a location names; None if it is elsewhere."""
    parts = urlparse(location)
    return Path(unquote(parts.path)) if parts.scheme in ("", "file") else None


def _size_mb(location: str) -> float:
    folder = _folder(location)
    if folder is None or not folder.is_dir():
        return float("nan")
    return round(sum(p.stat().st_size for p in folder.rglob("*") if p.is_file()) / _MB, 1)


if __name__ == "__main__":
    main()
