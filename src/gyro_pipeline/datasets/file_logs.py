"""Logs as loggers write them: a folder of files, one a recording."""

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

_HIDDEN = re.compile(r"(^|/)(\.|~\$)")  # the latter while Excel has a file open
_PARTS = {
    "{imu}": "0*(?P<imu>[0-9]{1,18})",
    "{recording}": "0*(?P<recording>[0-9]{1,18})",
    "{imu:name}": "(?P<imu>[^/]+?)",
    "{recording:name}": "(?P<recording>[^/]+?)",
    "*": "[^/]*",
}
"""What a pattern is made of, as regular expressions."""
_UNCLEAR = re.compile(r"[}*][{*]|\{(imu|recording)\}[0-9]")  # where does the first part end?

Matches = Mapping[str, re.Match[str]]
"""The pattern's match of each file, by its path in the folder."""


class FileLogs(LogSource):
    """Lists the files of a folder that match a pattern, each one recording of one IMU.

    Where ``columns`` of the reader are given for several IMUs, each file is one of each of them.

    Args:
        sensor, source, path, sensors, metadata: As :class:`~.log_source.LogSource` takes them.
        pattern: Of the files' paths in the folder; by default all files in it. ``{imu}`` and
            ``{recording}`` stand for their numbers; ``{imu:name}`` and ``{recording:name}`` for
            names, which are numbered in their order; ``*`` for anything but a slash. Without an
            IMU all files are of IMU 1; without a recording the files of an IMU are numbered in
            their order.
        reader: How the files are read (:class:`gyro_pipeline.parameters.ReaderOptions`).
        cache: No longer needed; said once, and ignored.

    Raises:
        InputError: An unknown sensor; a pattern or reader options that are not usable.
    """

    def __init__(
        self,
        sensor: str,
        source: str,
        path: str,
        sensors: Mapping[str, Mapping[str, Any]] | None = None,
        pattern: str = "*",
        reader: Mapping[str, Any] | None = None,
        cache: Any = None,
        metadata: dict[str, Any] | None = None,
    ) -> None:
        super().__init__(sensor, sensors, source, path, metadata)
        self._pattern = str(pattern)
        self._regex = _compiled(f"{sensor}: pattern in the catalog entry", self._pattern)
        where = f"{sensor}: reader in the catalog entry"
        try:
            self._options = ReaderOptions.model_validate(reader or {})
        except ValidationError as error:
            raise InputError(f"{where}: {error}") from error
        columns = self._options.columns
        self._side_by_side = list(columns) if isinstance(columns, Mapping) else []
        if self._side_by_side and "imu" in self._regex.groupindex:
            raise InputError(
                f"{where}: columns name several IMUs in each file, and {{imu}} in the pattern "
                f"{pattern} says that a file is of one; leave one of the two out"
            )
        self._messages: set[str] = set()
        if cache is not None:
            self._say("cache in the catalog entry is no longer needed; remove it")

    def load(self) -> Logs:
        """List the recordings; their files are read later, one at a time.

        Raises:
            InputError: As the cause of Kedro's ``DatasetError``, no such folder, no file that
                matches, or two files of one recording.
        """
        rate_hz, reader = self.entry.rate_hz, code_hash("gyro_pipeline.readers")
        settings = [self._options.model_dump(mode="json"), rate_hz, reader]
        places = self._places(self._matching())
        entries = [
            self._entry(name, imu, recording, settings)
            for (own, recording), name in places.items()
            for imu in self._side_by_side or [own]
        ]
        imus = len({entry.imu for entry in entries})
        if self.entry.imus not in (None, imus):
            stated = f"globals.yml says imus: {self.entry.imus}"
            self._say(f"files of {imus} IMUs, where {stated}", logging.WARNING)
        entries.sort(key=lambda entry: (entry.imu, entry.recording))
        return Logs(self._sensor, self._source, False, rate_hz, entries)

    def _exists(self) -> bool:
        return self._path.is_dir()

    def _describe(self) -> dict[str, Any]:
        reader = self._options.model_dump(exclude_defaults=True)
        return super()._describe() | {"pattern": self._pattern, "reader": reader}

    def _say(self, message: str, level: int = logging.INFO) -> None:
        """Log a message once, although several nodes load the source."""
        if message not in self._messages:
            self._messages.add(message)
            _LOG.log(level, "%s %s: %s", self._sensor, self._path, message)

    def _entry(self, name: str, imu: int, recording: int, settings: list[Any]) -> LogEntry:
        """One IMU of one file."""
        path = self._path / name
        state = path.stat() if path.exists() else path.lstat()  # a broken link is rejected as read
        columns_of = {"imu": imu} if self._side_by_side else {}
        return LogEntry(
            *(imu, recording, printable(name)),
            read=partial(readers.read_log, path, self._options, self.entry.rate_hz, **columns_of),
            size=state.st_size,
            key=fingerprint([str(path), state.st_size, state.st_mtime_ns, columns_of, settings]),
        )

    def _matching(self) -> Matches:
        """Paths in the folder that the pattern describes, 2 before 10."""
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
            self._say(f"{len(others)} files are not like {self._pattern}: {_first(others)}")
        return matches

    def _places(self, matches: Matches) -> dict[tuple[int, int], str]:
        """The file of each IMU and recording."""
        imus, recordings = (self._numbers(part, matches) for part in ("imu", "recording"))
        if "recording" not in self._regex.groupindex and "*" in self._pattern:
            following = defaultdict[int, Iterator[int]](partial(count, 1))
            recordings = [next(following[imu]) for imu in imus]
            self._say(
                "recordings of each IMU are numbered in the order of the files' names: "
                + _first([f"{name} is {n}" for name, n in zip(matches, recordings, strict=True)])
            )
        places = dict[tuple[int, int], str]()
        for name, *place in zip(matches, imus, recordings, strict=True):
            other = places.setdefault((place[0], place[1]), name)
            if other != name:
                raise InputError(
                    f"{self._sensor}: {printable(f'{other} and {name}')} are both recording "
                    f"{place[1]} of IMU {place[0]} by the pattern {self._pattern}; remove one of "
                    "them, or correct the pattern in the catalog"
                )
        return places

    def _numbers(self, part: str, matches: Matches) -> list[int]:
        """The number that one part of each path says, or that its name gets; 1 without the part."""
        if part not in self._regex.groupindex:
            return [1] * len(matches)
        texts = [match[part] for match in matches.values()]  # of numbers without leading zeros
        if f"{{{part}:name}}" in self._pattern:
            numbers = {text: number for number, text in enumerate(dict.fromkeys(texts), 1)}
            order = _first([f"{text} is {number}" for text, number in numbers.items()])
            self._say(f"{len(numbers)} {part}s by name: {order}")
            return [numbers[text] for text in texts]
        if "0" in texts:
            raise InputError(
                f"{self._sensor}: expected numbers from 1 for {{{part}}} in {self._pattern}, got "
                f"0; write {{{part}:name}} to have them numbered in their order"
            )
        return [int(text) for text in texts]


def _files(folder: Path) -> Iterator[Path]:
    """All files in a folder and in those below it, also behind links, but not in circles."""
    for here, inner, names in os.walk(folder, followlinks=True):
        above = {os.path.realpath(path) for path in (Path(here), *Path(here).parents)}
        inner[:] = [name for name in inner if os.path.realpath(Path(here, name)) not in above]
        yield from (Path(here, name) for name in names)


def _compiled(where: str, pattern: str) -> re.Pattern[str]:
    """The pattern as a regular expression."""
    pieces = re.split("({})".format("|".join(map(re.escape, _PARTS))), pattern)
    twice = any(pattern.count(f"{{{part}") > 1 for part in ("imu", "recording"))
    if twice or re.search("[{}]", "".join(pieces[::2])) or _UNCLEAR.search(pattern):
        raise InputError(
            f"{where}: expected {{imu}} or {{imu:name}}, {{recording}} or {{recording:name}}, each "
            "once, and *, with a character between them that is no digit, such as imu{imu}/*.csv, "
            f"got {pattern}"
        )
    return re.compile("".join(_PARTS.get(piece, re.escape(piece)) for piece in pieces))


def _natural(path: str) -> str:
    """A key that sorts 2 before 10."""
    return re.sub(r"\d+", lambda number: number[0].zfill(18), path)


def _first(names: Sequence[str], most: int = 5) -> str:
    return ", ".join(map(printable, names[:most])) + (", …" if len(names) > most else "")
