"""Files that a stage stores for others: each is loaded as it was written, or not at all.

Beside a file is its record, ``<name>.made.json``: the digest of its bytes, the settings that it was
made with, and the digests of the stored files that it was made from.
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

_REPAIR = "type kedro run, with the --env that it belongs to, which makes it again"

_digests: dict[tuple[int, ...], str] = {}
"""Of files by their identity, which a rename keeps: each is read once by a process."""


class StoredFile(AbstractDataset[Any, Any]):
    """Base of datasets that keep one file: a subclass gives ``_read`` and ``_write``.

    Args:
        filepath: The file.
        metadata: For other tools, such as Kedro-Viz.

    Attributes:
        settings: The settings that decide what is saved, by name; set for each run.
        sources: The stored files that it is made from; likewise.
    """

    def __init__(self, filepath: str, metadata: dict[str, Any] | None = None) -> None:
        self._filepath = Path(filepath)
        self.metadata = metadata
        self.settings: Mapping[str, Any] = {}
        self.sources: Sequence[StoredFile] = ()

    def load(self) -> Any:
        """Read the file.

        Returns:
            What was saved.

        Raises:
            InputError: As the cause of Kedro's ``DatasetError``, a file that is not what was
                written.
        """
        check_content(self._filepath)
        return self._read(self._filepath)

    def save(self, data: Any) -> None:
        """Write the file under a temporary name, then its record, and rename it.

        Args:
            data: What the subclass keeps.
        """
        with replacing(self._filepath) as temporary:
            self._write(data, temporary)
            self._record(temporary)

    def state(self) -> str | None:
        """Digest of the file; None if it is not there, or is not what was written."""
        recorded = record_of(self._filepath)
        return recorded["digest"] if recorded and _is_intact(self._filepath, recorded) else None

    def check_made_with(self, settings: Mapping[str, Any]) -> None:
        """Refuse a file that other settings or other files made than there are now.

        Args:
            settings: Those of this run, by name.

        Raises:
            InputError: It says which, and what to type.
        """
        problem = _difference(self._filepath, settings)
        if problem and self._exists():
            raise InputError(f"{problem}; {_REPAIR}")

    def _read(self, path: Path) -> Any:
        raise NotImplementedError

    def _write(self, data: Any, path: Path) -> None:
        raise NotImplementedError

    def _record(self, written: Path) -> None:
        """Record what was written, under whatever name, and is about to get the file's name."""
        folder, sources = self._filepath.parent, {}
        for source in self.sources:
            recorded = record_of(source._filepath) or {}
            sources[os.path.relpath(source._filepath, folder)] = recorded.get("digest")
        status = written.stat()
        record = {
            "digest": digest_of(written),
            "bytes": status.st_size,
            "changed_ns": status.st_mtime_ns,
            "settings": self.settings,
            "sources": sources,
        }
        with replacing(_record_path(self._filepath)) as temporary:
            temporary.write_text(json.dumps(record, indent=1))

    def _exists(self) -> bool:
        return self._filepath.is_file()

    def _describe(self) -> dict[str, Any]:
        return {"filepath": str(self._filepath)}


def check_content(path: Path) -> str:
    """The digest of a file that is what was written.

    Args:
        path: The file.

    Raises:
        InputError: It is not there, was changed since, is damaged, or has no record.
    """
    if not path.exists():
        raise InputError(f"{path} is not there; first run what makes it, such as kedro run")
    recorded, digest = record_of(path), digest_of(path)
    if recorded is None or digest != recorded["digest"]:
        recorded = record_of(path)  # a run may have replaced both meanwhile
        digest = digest_of(path)
    if recorded is None or digest != recorded["digest"]:
        what = "has no record of how it was made" if recorded is None else "is damaged or changed"
        raise InputError(f"{path}: {what}, so it may not be what was written; {_REPAIR}")
    return digest


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
    """How a stored file was made; None if that cannot be told."""
    try:
        record = json.loads(_record_path(path).read_text())
    except (FileNotFoundError, ValueError):
        return None
    whole = isinstance(record, dict) and {"digest", "settings", "sources"} <= record.keys()
    return record if whole else None


def _is_intact(path: Path, record: Record) -> bool:
    if not path.is_file():
        return False
    status = path.stat()
    same = [status.st_size, status.st_mtime_ns] == [record.get("bytes"), record.get("changed_ns")]
    return same or digest_of(path) == record["digest"]


def _difference(path: Path, settings: Mapping[str, Any]) -> str | None:
    """How the making of a file, and of those that it was made from, differs from now."""
    record = record_of(path)
    if record is None:  # whoever loads it is told
        return None
    for key, value in record["settings"].items():
        if settings.get(key) != value:
            before, now = dict(_leaves(value, key)), dict(_leaves(settings.get(key), key))
            names = sorted(before.keys() | now.keys())
            name = next(name for name in names if before.get(name) != now.get(name))
            return f"{path}: made with {name} {before.get(name)}, this run has {now.get(name)}"
    for relative, digest in record["sources"].items():
        source = Path(os.path.normpath(path.parent / relative))
        there = record_of(source)
        if there is not None and there["digest"] != digest:
            return f"{path}: made from another {source} than there is now"
        problem = _difference(source, settings)
        if problem:
            return problem
    return None


def _leaves(tree: Any, name: str) -> Iterator[tuple[str, Any]]:
    """The values in a tree of settings by their names."""
    if not isinstance(tree, Mapping) or not tree:
        yield name, tree
        return
    for key, value in tree.items():
        yield from _leaves(value, f"{name}.{key}")


def _record_path(path: Path) -> Path:
    return path.with_name(f"{path.name}.made.json")
