"""Logs as loggers write them: a folder of files, one a recording."""

import logging
import os
import re
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NoReturn

from pydantic import ValidationError

from gyro_pipeline import readers
from gyro_pipeline.conventions import InputError
from gyro_pipeline.datasets.log_source import LogSource
from gyro_pipeline.fingerprints import fingerprint, package_hash
from gyro_pipeline.logs import LogEntry, Logs
from gyro_pipeline.parameters import ReaderOptions

_LOG = logging.getLogger(__name__)

_NAMED = 5
"""So many files are named in a message."""

_HIDDEN = re.compile(r"(^|/)(\.|~\$)")  # the latter while Excel has a file open
_LARGEST = 10**18 - 1  # of the numbers in names; fits an integer
_PART = re.compile(r"\{(imu|recording)(:name)?\}|(\*)")

Matches = Mapping[str, re.Match[str]]
"""By a file's path in the folder, what the pattern says of it."""


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
        self._pattern = pattern
        self._regex = _compiled(f"{sensor}: pattern {pattern} in the catalog entry", pattern)
        try:
            self._options = ReaderOptions.model_validate(reader or {})
        except ValidationError as error:
            raise InputError(f"{sensor}: reader in the catalog entry: {error}") from error
        readers.check_format(self._options.format, f"{sensor}: reader in the catalog entry")
        columns = self._options.columns
        self._side_by_side: list[int] = list(columns) if isinstance(columns, Mapping) else []
        if self._side_by_side and "imu" in self._regex.groupindex:
            raise InputError(
                f"{sensor}: columns in the catalog entry's reader name IMUs "
                f"{', '.join(map(str, self._side_by_side))} in each file, and {{imu}} in the "
                f"pattern {pattern} says that a file is of one; leave one of the two out"
            )
        if cache is not None:
            _LOG.info("%s: cache in the catalog entry is no longer needed; remove it", sensor)

    def load(self) -> Logs:
        """List the recordings; their files are read later, one at a time.

        Raises:
            InputError: As the cause of Kedro's ``DatasetError``, no such folder, no file that
                matches, or two files of one recording.
        """
        places = self._places(self._matching())
        settings: list[Any] = [self._options.model_dump(mode="json"), self.entry.rate_hz]
        settings.append(package_hash(readers))
        entries = [
            self._listed(name, imu, recording, settings)
            for name, (own, recording) in places.items()
            for imu in self._side_by_side or [own]
        ]
        if "{recording" not in self._pattern and "*" in self._pattern:
            _LOG.info(
                "%s: recordings of each IMU are numbered in the order of the files' names: %s",
                *(self._sensor, _shown([f"{name} is {n}" for name, (_, n) in places.items()])),
            )
        imus = len({entry.imu for entry in entries})
        if self.entry.imus not in (None, imus):
            _LOG.warning(
                "%s: files of %d IMUs in %s, where globals.yml says imus: %d",
                *(self._sensor, imus, self._path, self.entry.imus),
            )
        entries.sort(key=lambda entry: (entry.imu, entry.recording))
        return Logs(self._sensor, self._source, False, self.entry.rate_hz, entries)

    def _exists(self) -> bool:
        return self._path.is_dir()

    def _describe(self) -> dict[str, Any]:
        reader = self._options.model_dump(exclude_defaults=True)
        return super()._describe() | {"pattern": self._pattern, "reader": reader}

    def _listed(self, name: str, imu: int, recording: int, settings: Sequence[Any]) -> LogEntry:
        """One IMU of one file."""
        path = self._path / name
        try:
            state = path.stat()
        except OSError as error:
            raise InputError(
                f"{self._sensor} {path}: cannot be read: {error.strerror}; correct the link, or "
                "remove it"
            ) from error
        which = {"imu": imu} if self._side_by_side else {}
        return LogEntry(
            *(imu, recording, name),
            read=partial(readers.read_log, path, self._options, self.entry.rate_hz, **which),
            size=state.st_size,
            key=fingerprint([str(path), state.st_size, state.st_mtime_ns, which, settings]),
        )

    def _matching(self) -> Matches:
        """Paths in the folder that the pattern describes, 2 before 10."""
        if not self._path.is_dir():
            raise InputError(
                f"{self._sensor} {self._path}: no such folder; put the files there, or name "
                "another path in the catalog"
            )
        paths = (path.relative_to(self._path).as_posix() for path in _files(self._path))
        names = sorted((name for name in paths if not _HIDDEN.search(name)), key=_natural)
        matches = {name: match for name in names if (match := self._regex.fullmatch(name))}
        others = [name for name in names if name not in matches]
        where = f"{self._sensor} {self._path}"
        if not matches:
            raise InputError(
                f"{where}: expected files like {self._pattern}, got {_shown(others) or 'none'}; "
                "correct the pattern in the catalog, or the files' names"
            )
        if others:
            _LOG.info(
                "%s: %d files are not like %s: %s",
                *(where, len(others), self._pattern, _shown(others)),
            )
        return matches

    def _places(self, matches: Matches) -> dict[str, tuple[int, int]]:
        """IMU and recording of each path."""
        imus, recordings = (self._numbers(part, matches) for part in ("imu", "recording"))
        counts, taken = Counter[int](), dict[tuple[int, int], str]()
        for name in matches:
            imu = imus.get(name, 1)
            counts[imu] += 1
            place = imu, recordings.get(name, counts[imu] if "*" in self._pattern else 1)
            other = taken.setdefault(place, name)
            if other != name:
                raise InputError(
                    f"{self._sensor}: {other} and {name} are both recording {place[1]} of IMU "
                    f"{imu} by the pattern {self._pattern}; remove one of them, or correct the "
                    "pattern in the catalog"
                )
        return {name: place for place, name in taken.items()}

    def _numbers(self, part: str, matches: Matches) -> dict[str, int]:
        """What one part of each path says, as a number; nothing where there is no such part."""
        if part not in self._regex.groupindex:
            return {}
        texts = {name: match[part] for name, match in matches.items()}
        if f"{{{part}:name}}" in self._pattern:
            order = {text: number for number, text in enumerate(dict.fromkeys(texts.values()), 1)}
            named = _shown([f"{text} is {number}" for text, number in order.items()])
            _LOG.info("%s: %d %ss by name: %s", self._sensor, len(order), part, named)
            return {name: order[text] for name, text in texts.items()}
        numbers = {name: int(text[-4000:]) for name, text in texts.items()}
        for name, number in numbers.items():
            if not 1 <= number <= _LARGEST:
                raise InputError(
                    f"{self._sensor}: {name}: expected numbers from 1 to {_LARGEST:.0e} for "
                    f"{{{part}}}; write {{{part}:name}} to have them numbered in their order"
                )
        return numbers


def _files(folder: Path) -> Iterator[Path]:
    """All files in a folder and in those below it, also behind links, but not in circles."""
    for here, inner, names in os.walk(folder, followlinks=True):
        above = {os.path.realpath(path) for path in (Path(here), *Path(here).parents)}
        inner[:] = [name for name in inner if os.path.realpath(Path(here, name)) not in above]
        yield from (Path(here, name) for name in names)


def _compiled(where: str, pattern: str) -> re.Pattern[str]:
    """The pattern as a regular expression."""

    def refuse(problem: str) -> NoReturn:
        raise InputError(f"{where}: {problem}")

    if not isinstance(pattern, str):
        refuse("expected a text such as imu{imu}/*.csv")
    if set("{}") & set(_PART.sub("", pattern)):
        refuse("expected {imu}, {recording}, {imu:name}, {recording:name} and * as its parts")
    if touching := re.search(r"[}*](\{.*?\}|\*)", pattern):
        refuse(f"expected a character before {touching[1]}, or it cannot be told where it begins")
    if digit := re.search(r"\{(imu|recording)\}([0-9])", pattern):
        refuse(f"expected no digit behind a number, which would belong to it, got {digit[2]}")
    written, last = "", 0
    for part in _PART.finditer(pattern):
        name, named, _ = part.groups()
        if f"<{name}>" in written:
            refuse(f"{{{name}}} is there twice")
        text = "[^/]+?" if named else "[0-9]+"
        written += re.escape(pattern[last : part.start()])
        written += f"(?P<{name}>{text})" if name else "[^/]*"
        last = part.end()
    return re.compile(written + re.escape(pattern[last:]))


def _natural(path: str) -> list[tuple[int, int | str]]:
    """Sorts 2 before 10."""
    return [
        (0, int(text)) if text.isdecimal() else (1, text) for text in re.findall(r"\d+|\D+", path)
    ]


def _shown(names: Sequence[str]) -> str:
    """The first of them."""
    return ", ".join(names[:_NAMED]) + (", …" if len(names) > _NAMED else "")
