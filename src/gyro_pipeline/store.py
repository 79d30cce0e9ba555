"""List the contents of the run store, and update the paths of its artifacts after a move.

Type ``python -m gyro_pipeline.store`` in the folder of ``mlflow.db``. MLflow stores an absolute
path to the artifacts of every run, and has no command that changes it.
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
    """Count the runs and the artifacts of each study.

    Args:
        store: SQLite file.

    Returns:
        A row per study: its runs, its deleted runs, which MLflow's ``gc`` removes for good, and the
        size of its artifacts in MB, NaN where they are not on this machine.
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
    """Update the store after the folder of all artifacts was moved.

    Args:
        store: SQLite file.
        location: The new folder, or an address such as ``mlflow-artifacts:``. It has a folder for
            each study, with the same name as before.

    Returns:
        Number of updated runs.

    Raises:
        InputError: The artifacts of a study are not in the folder.
    """
    base = location.rstrip("/") if _is_address(location) else Path(location).absolute().as_uri()
    with closing(sqlite3.connect(f"{store.resolve().as_uri()}?mode=rw", uri=True)) as db, db:
        updated = 0
        for number, name, _, old in db.execute(_STUDIES).fetchall():
            new = f"{base}/{old.rpartition('/')[2]}"
            runs = db.execute(_MOVE_RUNS, [new, len(old) + 1, number]).rowcount
            folder = _folder(new)
            if runs and folder is not None and not folder.is_dir():
                raise InputError(f"{folder}: artifacts of {name} are not there; move them first")
            db.execute(_MOVE_MODELS, [new, len(old) + 1, number])
            db.execute(_MOVE_STUDY, [new, number])
            updated += runs
    return updated


def main(arguments: Sequence[str] | None = None) -> None:
    """Relocate the artifacts if ``--artifacts-in`` is given, then list the store."""
    parser = argparse.ArgumentParser("python -m gyro_pipeline.store", description=__doc__)
    parser.add_argument("--store", type=Path, default=Path("mlflow.db"), help="SQLite file")
    parser.add_argument(
        "--artifacts-in",
        metavar="FOLDER",
        help="new folder of the artifacts, e.g. mlruns or mlflow-artifacts:",
    )
    options = parser.parse_args(arguments)
    store: Path = options.store
    try:
        if not store.is_file():
            raise InputError(f"{store}: no such file; type --store FILE, or change to its folder")
        if options.artifacts_in:
            relocate(store, options.artifacts_in)
        table = describe(store)
    except InputError as error:
        sys.exit(f"error: {error}")
    sys.stdout.write(f"{table.to_string(index=False, na_rep='not here')}\n")
    sys.stdout.write(f"{store}: {store.stat().st_size / _MB:.1f} MB\n")


def _is_address(location: str) -> bool:
    return ":" in location.partition("/")[0]


def _folder(location: str) -> Path | None:
    """The folder at a location; None if it is not on this machine."""
    parts = urlparse(location)
    return Path(unquote(parts.path)) if parts.scheme in ("", "file") else None


def _size_mb(location: str) -> float:
    folder = _folder(location)
    if folder is None or not folder.is_dir():
        return float("nan")
    return round(sum(p.stat().st_size for p in folder.rglob("*") if p.is_file()) / _MB, 1)


if __name__ == "__main__":
    main()
