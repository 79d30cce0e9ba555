"""Logs in a folder of a logger's files, one file per recording."""

import logging
import os
import re
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from itertools import count
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from gyro_pipeline import readers
from gyro_pipeline.conventions import InputError
from gyro_pipeline.datasets.log_source import LogSource
from gyro_pipeline.fingerprints import code_hash, fingerprint
from gyro_pipeline.logs import LogEntry, Logs, printable
from gyro_pipeline.parameters import ReaderOptions

_LOG = logging.getLogger(__name__)

_HIDDEN = re.compile(r"(^|/)(\.|~\$)")  # Excel writes ~$ files while it has a file open
_PARTS = {
    "{imu}": "0*(?P<imu>[0-9]{1,18})",
    "{recording}": "0*(?P<recording>[0-9]{1,18})",
    "{imu:name}": "(?P<imu>[^/]+?)",
    "{recording:name}": "(?P<recording>[^/]+?)",
    "*": "[^/]*",
}
"""Parts of a pattern and their regular expressions."""
_AMBIGUOUS = re.compile(r"[}*][{*]|\{(imu|recording)\}[0-9]")
"""Adjacent parts of a pattern, which do not determine where the first one ends."""

Matches = Mapping[str, re.Match[str]]
"""The pattern's match of each file, by its path in the folder."""


class FileLogs(LogSource):
    """Lists the files of a folder that match a pattern, each a recording of an IMU.

    If the reader's option ``columns`` names several IMUs, each file has a recording of each IMU.

    Args:
        sensor, source, path, sensors, metadata: As for :class:`~.log_source.LogSource`.
        pattern: Pattern of the files' paths in the folder; by default all files in it. ``{imu}``
            and ``{recording}`` stand for numbers; ``{imu:name}`` and ``{recording:name}`` for
            names, which are numbered in their order; ``*`` for any text without a slash. Without an
            IMU all files belong to IMU 1; without a recording the files of an IMU are numbered in
            their order.
        reader: How the files are read (:class:`gyro_pipeline.parameters.ReaderOptions`).

    Raises:
        InputError: The sensor is unknown, or the pattern or the reader options are invalid.
    """

    def __init__(
        self,
        sensor: str,
        source: str,
        path: str,
        sensors: Mapping[str, Mapping[str, Any]] | None = None,
        pattern: str = "*",
        reader: Mapping[str, Any] | None = None,
        metadata: dict[str, Any] | None = None,
    ) -> None:
        super().__init__(sensor, sensors, source, path, metadata)
        self._pattern = str(pattern)
        self._regex = _compile(f"{sensor}: pattern in the catalog entry", self._pattern)
        where = f"{sensor}: reader in the catalog entry"
        try:
            self._options = ReaderOptions.model_validate(reader or {})
        except ValidationError as error:
            raise InputError(f"{where}: {error}") from error
        columns = self._options.columns
        self._side_by_side = list(columns) if isinstance(columns, Mapping) else []
        if self._side_by_side and "imu" in self._regex.groupindex:
            raise InputError(
                f"{where}: columns name several IMUs in each file, but {{imu}} in the pattern "
                f"{pattern} says that a file has a single IMU; remove one of the two"
            )
        self._messages: set[str] = set()

    def load(self) -> Logs:
        """List the recordings; their files are read later, one at a time.

        Raises:
            InputError: The folder does not exist, no file matches, or two files are the same
                recording; as the cause of Kedro's ``DatasetError``.
        """
        rate_hz, reader = self.entry.rate_hz, code_hash("gyro_pipeline.readers")
        settings = [self._options.model_dump(mode="json"), rate_hz, reader]
        entries = [
            self._entry(name, imu, recording, settings)
            for (file_imu, recording), name in self._files_by_recording(self._matching()).items()
            for imu in self._side_by_side or [file_imu]
        ]
        imus = len({entry.imu for entry in entries})
        if self.entry.imus not in (None, imus):
            stated = f"globals.yml says imus: {self.entry.imus}"
            self._log_once(f"files of {imus} IMUs, where {stated}", logging.WARNING)
        entries.sort(key=lambda entry: (entry.imu, entry.recording))
        return Logs(self._sensor, self._source, False, rate_hz, entries)

    def _exists(self) -> bool:
        return self._path.is_dir()

    def _describe(self) -> dict[str, Any]:
        reader = self._options.model_dump(exclude_defaults=True)
        return super()._describe() | {"pattern": self._pattern, "reader": reader}

    def _log_once(self, message: str, level: int = logging.INFO) -> None:
        """Log a message once, although several nodes load the source."""
        if message not in self._messages:
            self._messages.add(message)
            _LOG.log(level, "%s %s: %s", self._sensor, self._path, message)

    def _entry(self, name: str, imu: int, recording: int, settings: list[Any]) -> LogEntry:
        """The entry of an IMU of a file."""
        path = self._path / name
        state = path.stat() if path.exists() else path.lstat()  # reading rejects a broken link
        columns_of = {"imu": imu} if self._side_by_side else {}
        return LogEntry(
            *(imu, recording, printable(name)),
            read=partial(readers.read_log, path, self._options, self.entry.rate_hz, **columns_of),
            size=state.st_size,
            key=fingerprint([str(path), state.st_size, state.st_mtime_ns, columns_of, settings]),
        )

    def _matching(self) -> Matches:
        """Paths in the folder that match the pattern, 2 before 10."""
        where = f"{self._sensor} {self._path}"
        if not self._path.is_dir():
            raise InputError(
                f"{where}: no such folder; put the files there, or name another path in the catalog"
            )
        paths = (path.relative_to(self._path).as_posix() for path in _files(self._path))
        names = sorted((name for name in paths if not _HIDDEN.search(name)), key=_natural)
        matches = {name: match for name in names if (match := self._regex.fullmatch(name))}
        others = [name for name in names if name not in matches]
        if not matches:
            raise InputError(
                f"{where}: expected files like {self._pattern}, got {_first(others) or 'none'}; "
                "correct the pattern in the catalog, or the files' names"
            )
        if others:
            self._log_once(f"{len(others)} files are not like {self._pattern}: {_first(others)}")
        return matches

    def _files_by_recording(self, matches: Matches) -> dict[tuple[int, int], str]:
        """The file of each IMU and recording."""
        imus, recordings = (self._numbers(part, matches) for part in ("imu", "recording"))
        if "recording" not in self._regex.groupindex and "*" in self._pattern:
            counters = defaultdict[int, Iterator[int]](partial(count, 1))
            recordings = [next(counters[imu]) for imu in imus]
            self._log_once(
                "recordings of each IMU are numbered in the order of the files' names: "
                + _first([f"{name} is {n}" for name, n in zip(matches, recordings, strict=True)])
            )
        files = dict[tuple[int, int], str]()
        for name, imu, recording in zip(matches, imus, recordings, strict=True):
            other = files.setdefault((imu, recording), name)
            if other != name:
                raise InputError(
                    f"{self._sensor}: {printable(f'{other} and {name}')} are both recording "
                    f"{recording} of IMU {imu} by the pattern {self._pattern}; remove one of "
                    "them, or correct the pattern in the catalog"
                )
        return files

    def _numbers(self, part: str, matches: Matches) -> list[int]:
        """The number in a part of each path, or the number of its name; 1 without the part."""
        if part not in self._regex.groupindex:
            return [1] * len(matches)
        texts = [match[part] for match in matches.values()]  # numbers lack leading zeros
        if f"{{{part}:name}}" in self._pattern:
            numbers = {text: number for number, text in enumerate(dict.fromkeys(texts), 1)}
            order = _first([f"{text} is {number}" for text, number in numbers.items()])
            self._log_once(f"{len(numbers)} {part}s by name: {order}")
            return [numbers[text] for text in texts]
        if "0" in texts:
            raise InputError(
                f"{self._sensor}: expected numbers from 1 for {{{part}}} in {self._pattern}, got "
                f"0; write {{{part}:name}} to have them numbered in their order"
            )
        return [int(text) for text in texts]


def _files(folder: Path) -> Iterator[Path]:
    """All files in a folder and its subfolders, following links unless these lead in circles."""
    for root, folders, names in os.walk(folder, followlinks=True):
        parents = {os.path.realpath(path) for path in (Path(root), *Path(root).parents)}
        folders[:] = [name for name in folders if os.path.realpath(Path(root, name)) not in parents]
        yield from (Path(root, name) for name in names)


def _compile(where: str, pattern: str) -> re.Pattern[str]:
    """Translate a pattern to a regular expression."""
    pieces = re.split("({})".format("|".join(map(re.escape, _PARTS))), pattern)
    duplicates = any(pattern.count(f"{{{part}") > 1 for part in ("imu", "recording"))
    if duplicates or re.search("[{}]", "".join(pieces[::2])) or _AMBIGUOUS.search(pattern):
        raise InputError(
            f"{where}: expected {{imu}} or {{imu:name}}, {{recording}} or {{recording:name}}, each "
            "once, and *, separated by characters that are not digits, such as imu{imu}/*.csv, "
            f"got {pattern}"
        )
    return re.compile("".join(_PARTS.get(piece, re.escape(piece)) for piece in pieces))


def _natural(path: str) -> str:
    """A key that sorts 2 before 10."""
    return re.sub(r"\d+", lambda number: number[0].zfill(18), path)


def _first(names: Sequence[str], most: int = 5) -> str:
    return ", ".join(map(printable, names[:most])) + (", …" if len(names) > most else "")
