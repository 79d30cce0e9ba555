"""Files that a stage stores for other stages, protected against changes.

Beside each file is its record, ``<name>.made.json``: the digest of its bytes, the settings behind
it, and the digests of the stored files that it was computed from.
"""

import hashlib
import json
import os
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from kedro.io import AbstractDataset

from gyro_pipeline.conventions import InputError
from gyro_pipeline.datasets.atomic import replacing

Record = dict[str, Any]

_REPAIR = "type kedro run, with the --env that it belongs to, to make it again"

_digests: dict[tuple[int, ...], str] = {}
"""Digests by file identity, which a rename keeps, so that a process reads each file once."""


class StoredFile(AbstractDataset[Any, Any]):
    """Base of datasets of one file; a subclass defines ``_read`` and ``_write``.

    Args:
        filepath: The file.
        metadata: For other tools, such as Kedro-Viz.

    Attributes:
        settings: The settings that affect the content, by name; set for each run.
        sources: The stored files that the content is computed from; set for each run.
    """

    def __init__(self, filepath: str, metadata: dict[str, Any] | None = None) -> None:
        self._filepath = Path(filepath)
        self.metadata = metadata
        self.settings: Mapping[str, Any] = {}
        self.sources: Sequence[StoredFile] = ()

    def load(self) -> Any:
        """Read the file.

        Raises:
            InputError: The file was changed or damaged; as the cause of Kedro's ``DatasetError``.
        """
        check_content(self._filepath)
        return self._read(self._filepath)

    def save(self, data: Any) -> None:
        """Write the file under a temporary name, then its record, and rename it."""
        with replacing(self._filepath) as temporary:
            self._write(data, temporary)
            self._record(temporary)

    def state(self) -> str | None:
        """Digest of the file; None if it is missing, changed or damaged."""
        record = record_of(self._filepath)
        return record["digest"] if record and _is_intact(self._filepath, record) else None

    def check_made_with(self, settings: Mapping[str, Any]) -> None:
        """Refuse a file that was computed with other settings or from other files.

        Args:
            settings: The settings of this run, by name.

        Raises:
            InputError: A setting or a file differs; the message names it.
        """
        problem = _difference(self._filepath, settings)
        if problem and self._exists():
            raise InputError(f"{problem}; {_REPAIR}")

    def _read(self, path: Path) -> Any:
        raise NotImplementedError

    def _write(self, data: Any, path: Path) -> None:
        raise NotImplementedError

    def _record(self, temporary: Path) -> None:
        """Write the record of a complete file that still has a temporary name."""
        folder = self._filepath.parent
        sources = {
            os.path.relpath(source._filepath, folder): (record_of(source._filepath) or {}).get(
                "digest"
            )
            for source in self.sources
        }
        status = temporary.stat()
        record = {
            "digest": digest_of(temporary),
            "bytes": status.st_size,
            "changed_ns": status.st_mtime_ns,
            "settings": self.settings,
            "sources": sources,
        }
        with replacing(_record_path(self._filepath)) as path:
            path.write_text(json.dumps(record, indent=1))

    def _exists(self) -> bool:
        return self._filepath.is_file()

    def _describe(self) -> dict[str, Any]:
        return {"filepath": str(self._filepath)}


def check_content(path: Path) -> str:
    """Check that a file is as it was written, and return its digest.

    Raises:
        InputError: The file is missing, changed or damaged, or has no record.
    """
    if not path.exists():
        raise InputError(f"{path}: no such file; type kedro run, which makes it, first")
    for _ in range(2):  # a run may replace the file and its record between the two reads
        record, digest = record_of(path), digest_of(path)
        if record is not None and digest == record["digest"]:
            return digest
    problem = "has no record of how it was made" if record is None else "is damaged or changed"
    raise InputError(f"{path}: {problem}, so it may not be what was written; {_REPAIR}")


def digest_of(path: Path) -> str:
    """SHA-256 of a file, or of all files in a folder with their names."""
    if path.is_dir():
        files = sorted(file for file in path.rglob("*") if file.is_file())
        parts = [(file.relative_to(path).as_posix(), digest_of(file)) for file in files]
        return hashlib.sha256(json.dumps(parts).encode()).hexdigest()
    status = path.stat()
    identity = status.st_dev, status.st_ino, status.st_size, status.st_mtime_ns
    if identity not in _digests:
        with path.open("rb") as file:
            _digests[identity] = hashlib.file_digest(file, "sha256").hexdigest()
    return _digests[identity]


def record_of(path: Path) -> Record | None:
    """The record of a stored file; None if it is missing or damaged."""
    try:
        record = json.loads(_record_path(path).read_text())
    except (FileNotFoundError, ValueError):
        return None
    complete = isinstance(record, dict) and {"digest", "settings", "sources"} <= record.keys()
    return record if complete else None


def _is_intact(path: Path, record: Record) -> bool:
    if not path.is_file():
        return False
    status = path.stat()
    unchanged = [status.st_size, status.st_mtime_ns] == [
        record.get("bytes"),
        record.get("changed_ns"),
    ]
    return unchanged or digest_of(path) == record["digest"]


def _difference(path: Path, settings: Mapping[str, Any]) -> str | None:
    """The first difference in the settings or sources of a file, or of its sources, from now."""
    record = record_of(path)
    if record is None:  # loading the file raises an error
        return None
    for key, value in record["settings"].items():
        if settings.get(key) != value:
            before, now = dict(_leaves(value, key)), dict(_leaves(settings.get(key), key))
            names = sorted(before.keys() | now.keys())
            name = next(name for name in names if before.get(name) != now.get(name))
            return f"{path}: made with {name} {before.get(name)}, this run has {now.get(name)}"
    for relative, digest in record["sources"].items():
        source = Path(os.path.normpath(path.parent / relative))
        source_record = record_of(source)
        if source_record is not None and source_record["digest"] != digest:
            return f"{path}: made from another {source} than there is now"
        if problem := _difference(source, settings):
            return problem
    return None


def _leaves(tree: Any, name: str) -> Iterator[tuple[str, Any]]:
    """The values in a tree of settings, with their dotted names."""
    if not isinstance(tree, Mapping) or not tree:
        yield name, tree
        return
    for key, value in tree.items():
        yield from _leaves(value, f"{name}.{key}")


def _record_path(path: Path) -> Path:
    return path.with_name(f"{path.name}.made.json")
