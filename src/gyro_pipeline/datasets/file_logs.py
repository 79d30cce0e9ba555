"""Logs as loggers write them: a folder of files, one a recording."""

import glob
import importlib
import logging
import os
import pkgutil
import re
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from gyro_pipeline import readers
from gyro_pipeline.conventions import InputError
from gyro_pipeline.datasets.atomic import check_writable
from gyro_pipeline.datasets.log_source import LogSource
from gyro_pipeline.datasets.parse_cache import Reading
from gyro_pipeline.fingerprints import code_hash, fingerprint
from gyro_pipeline.logs import Log, LogEntry, Logs
from gyro_pipeline.parameters import ReaderOptions

_LOG = logging.getLogger(__name__)

_NAMED = 5
"""So many files that do not match are named."""

_KEPT = ".reading"
"""Suffix of what is kept of a file; no logger's."""

_HIDDEN = re.compile(r"(^|/)(\.|~\$)")  # the latter while Excel has a file open
_DIGITS = 18  # of a number that fits an integer
_PART = re.compile(r"\{(imu|recording)(:name)?\}|(\*)")

Numbers = dict[str, tuple[int, int]]


class FileLogs(LogSource):
    """Lists the files of a folder that match a pattern, each one recording of one IMU.

    Args:
        sensor, source, path, sensors, metadata: As :class:`~.log_source.LogSource` takes them.
        pattern: Of the files' paths in the folder; by default all files in it. ``{imu}`` and
            ``{recording}`` stand for their numbers; ``{imu:name}`` and ``{recording:name}`` for
            names, which are numbered in their order; ``*`` for anything but a slash. Without an
            IMU all files are of IMU 1; without a recording the files of an IMU are numbered in
            their order.
        cache: ``{"path": folder}`` for what was read of the files, which are then parsed once
            only, also where a run was interrupted. (Kedro makes a ``path`` absolute.)
        reader: How the files are read (:class:`gyro_pipeline.parameters.ReaderOptions`).

    Raises:
        InputError: An unknown sensor; a pattern, cache or reader options that are not usable.
    """

    def __init__(
        self,
        sensor: str,
        source: str,
        path: str,
        sensors: Mapping[str, Mapping[str, Any]] | None = None,
        pattern: str = "*",
        cache: Mapping[str, str] | None = None,
        reader: Mapping[str, Any] | None = None,
        metadata: dict[str, Any] | None = None,
    ) -> None:
        super().__init__(sensor, sensors, source, path, metadata)
        self._pattern = pattern
        self._regex = _compiled(sensor, pattern)
        try:
            self._options = ReaderOptions.model_validate(reader or {})
        except ValidationError as error:
            raise InputError(f"{sensor}: reader in the catalog entry: {error}") from error
        readers.check_format(self._options.format, f"{sensor}: reader in the catalog entry")
        if cache is not None and not (
            isinstance(cache, Mapping) and cache.get("path") and isinstance(cache["path"], str)
        ):
            raise InputError(
                f"{sensor}: cache in the catalog entry: expected {{path: a folder}}, got {cache!r}"
            )
        self._cache = None if cache is None else Path(cache["path"])

    def load(self) -> Logs:
        """List the recordings; their files are read later, one at a time.

        Raises:
            InputError: As the cause of Kedro's ``DatasetError``, no such folder, no file that
                matches, two files of one recording, or a cache that cannot be written to.
        """
        found = self._matching()
        numbers = _numbered(self._sensor, self._pattern, found)
        self._say_order(numbers)
        imus = len({imu for imu, _ in numbers.values()})
        if self.entry.imus not in (None, imus):
            _LOG.warning(
                "%s: files of %d IMUs in %s, where globals.yml says imus: %d",
                *(self._sensor, imus, self._path, self.entry.imus),
            )
        readings = self._readings(found)
        entries = [
            LogEntry(*numbers[name], name, reading, (self._path / name).stat().st_size)
            for name, reading in readings.items()
        ]
        entries.sort(key=lambda entry: (entry.imu, entry.recording))
        return Logs(self._sensor, self._source, False, self.entry.rate_hz, entries)

    def _exists(self) -> bool:
        return self._path.is_dir()

    def _describe(self) -> dict[str, Any]:
        reader = self._options.model_dump(exclude_defaults=True)
        return super()._describe() | {"pattern": self._pattern, "reader": reader}

    def _matching(self) -> dict[str, re.Match[str]]:
        """Paths in the folder that the pattern describes, in their order."""
        where, names = f"{self._sensor} {self._path}", self._names()
        matches = {name: match for name in names if (match := self._regex.fullmatch(name))}
        others = [name for name in names if name not in matches]
        if not matches:
            raise InputError(
                f"{where}: expected files like {self._pattern}, got {_listed(others) or 'none'}; "
                "correct the pattern in the catalog, or the files' names"
            )
        if others:
            _LOG.info(
                "%s: %d files are not like %s: %s",
                *(where, len(others), self._pattern, _listed(others)),
            )
        return matches

    def _names(self) -> list[str]:
        """Paths of all files in the folder but hidden ones, 2 before 10."""
        if not self._path.is_dir():
            raise InputError(
                f"{self._sensor} {self._path}: no such folder; put the files there, or name "
                "another path in the catalog"
            )
        names = (path.relative_to(self._path).as_posix() for path in _files(self._path))
        return sorted((name for name in names if not _HIDDEN.search(name)), key=_natural)

    def _say_order(self, numbers: Numbers) -> None:
        """Say which file is which recording, where no number in its name does."""
        if "{recording" not in self._pattern and "*" in self._pattern:
            order = [f"{name} is {number}" for name, (_, number) in numbers.items()]
            _LOG.info(
                "%s: recordings of each IMU are numbered in the order of the files' names: %s",
                *(self._sensor, _listed(order)),
            )

    def _readings(self, names: Iterable[str]) -> dict[str, Callable[[], Log]]:
        """How each file is read, and where its reading is kept."""
        if self._cache is None:
            given = self._options, self.entry.rate_hz
            return {name: partial(readers.read_log, self._path / name, *given) for name in names}
        check_writable(self._cache / _KEPT)
        settings = [self._options.model_dump(mode="json"), self.entry.rate_hz, _readers_hash()]
        found = {}
        for name in names:
            path = self._path / name
            try:
                state = path.stat()
            except OSError as error:
                raise InputError(
                    f"{self._sensor} {path}: cannot be read: {error.strerror}; correct the link, "
                    "or remove it"
                ) from error
            key = fingerprint([str(path), state.st_size, state.st_mtime_ns, settings])
            kept_as = self._cache / f"{self._sensor}.{key}{_KEPT}"
            found[name] = Reading(path, self._options, self.entry.rate_hz, kept_as)
        self._tidy(self._cache, [one.kept_as for one in found.values()])
        return {**found}

    def _tidy(self, cache: Path, wanted: Sequence[Path]) -> None:
        """Say what is there of an earlier run, and remove what is of other files."""
        there = set(cache.glob(f"{glob.escape(self._sensor)}.*{_KEPT}"))  # and other files
        for path in there.difference(wanted):
            path.unlink(missing_ok=True)
        before = len(there.intersection(wanted))
        if before:
            _LOG.info("%s: %d of %d files were read before", self._sensor, before, len(wanted))


def _files(folder: Path) -> Iterator[Path]:
    """All files in a folder and in those below it, also behind links, but not in circles."""
    for here, inner, names in os.walk(folder, followlinks=True):
        above = {os.path.realpath(path) for path in (Path(here), *Path(here).parents)}
        inner[:] = [name for name in inner if os.path.realpath(Path(here, name)) not in above]
        yield from (Path(here, name) for name in names)


def _compiled(sensor: str, pattern: str) -> re.Pattern[str]:
    """The pattern as a regular expression."""
    if not isinstance(pattern, str):
        raise InputError(
            f"{sensor}: pattern in the catalog entry: expected a text such as imu{{imu}}/*.csv, "
            f"got {pattern!r}"
        )
    written, last, ends_in_digits = "", 0, False
    for part in _PART.finditer(pattern):
        name, named, _ = part.groups()
        _refuse_digits(sensor, pattern, pattern[last : part.start()] if ends_in_digits else "")
        ends_in_digits = bool(name) and not named
        if written and part.start() == last:
            raise InputError(
                f"{sensor}: pattern {pattern}: expected a character of the names before {part[0]}, "
                "or it cannot be told where it begins"
            )
        written += re.escape(pattern[last : part.start()])
        last = part.end()
        if f"<{name}>" in written:
            raise InputError(f"{sensor}: pattern {pattern}: {{{name}}} is there twice")
        text = "[^/]+?" if named else "[0-9]+"
        written += f"(?P<{name}>{text})" if name else "[^/]*"
    rest = pattern[last:]
    _refuse_digits(sensor, pattern, rest if ends_in_digits else "")
    if set("{}") & set(_PART.sub("", pattern)):
        raise InputError(
            f"{sensor}: pattern {pattern}: expected {{imu}}, {{recording}}, {{imu:name}}, "
            "{recording:name} and * as its parts"
        )
    return re.compile(written + re.escape(rest))


def _refuse_digits(sensor: str, pattern: str, behind_number: str) -> None:
    if behind_number[:1].isdigit():
        raise InputError(
            f"{sensor}: pattern {pattern}: expected no digit behind a number, got "
            f"{behind_number[0]!r}, or it cannot be told where the number ends"
        )


def _numbered(sensor: str, pattern: str, found: Mapping[str, re.Match[str]]) -> Numbers:
    """IMU and recording of each path."""
    imus = _numbers(sensor, pattern, "imu", found)
    recordings = _numbers(sensor, pattern, "recording", found)
    counts, taken = Counter[int](), dict[tuple[int, int], str]()
    for name in found:
        imu = imus.get(name, 1)
        counts[imu] += 1
        number = imu, recordings.get(name, counts[imu] if "*" in pattern else 1)
        other = taken.setdefault(number, name)
        if other != name:
            raise InputError(
                f"{sensor}: {other} and {name} are both recording {number[1]} of IMU {imu} by the "
                f"pattern {pattern}; remove one of them, or correct the pattern in the catalog"
            )
    _refuse_sparse(sensor, pattern, list(taken))
    return {name: number for number, name in taken.items()}


def _refuse_sparse(sensor: str, pattern: str, numbers: Sequence[tuple[int, int]]) -> None:
    """Refuse IMUs of which hardly any have the same recordings: all are stored side by side."""
    imus, recordings = (len({number[part] for number in numbers}) for part in (0, 1))
    if 2 * len(numbers) < imus * recordings:
        raise InputError(
            f"{sensor}: expected recordings of the same numbers of most IMUs, got {len(numbers)} "
            f"recordings of {imus} IMUs with {recordings} different numbers by the pattern "
            f"{pattern}; write * for the recording, to have those of an IMU numbered in their order"
        )


def _numbers(
    sensor: str, pattern: str, part: str, found: Mapping[str, re.Match[str]]
) -> dict[str, int]:
    """What one part of each path says, as a number; nothing where the pattern lacks the part."""
    texts = {name: match[part] for name, match in found.items() if part in match.groupdict()}
    if f"{{{part}:name}}" in pattern:
        order = {text: place for place, text in enumerate(dict.fromkeys(texts.values()), 1)}
        named = ", ".join(f"{text} is {place}" for text, place in list(order.items())[:_NAMED])
        _LOG.info("%s: %d %ss by name: %s", sensor, len(order), part, named)
        return {name: order[text] for name, text in texts.items()}
    for name, text in texts.items():
        if len(text.lstrip("0")) > _DIGITS:
            raise InputError(
                f"{sensor}: {name}: expected a number of at most {_DIGITS} digits for {{{part}}}; "
                f"write {{{part}:name}} to have them numbered in their order"
            )
    numbers = {name: int(text) for name, text in texts.items()}
    for name in (name for name, number in numbers.items() if number < 1):
        raise InputError(
            f"{sensor}: {name}: expected numbers from 1 on for {{{part}}}, got 0; write "
            f"{{{part}:name}} to have them numbered in their order"
        )
    return numbers


def _natural(path: str) -> list[tuple[int, int | str]]:
    """Sorts 2 before 10."""
    return [
        (0, int(text)) if text.isdecimal() else (1, text) for text in re.findall(r"\d+|\D+", path)
    ]


def _listed(names: Sequence[str]) -> str:
    """The first of them."""
    return ", ".join(names[:_NAMED]) + (", …" if len(names) > _NAMED else "")


def _readers_hash() -> str:
    """Of the code that reads: what another version has read does not count."""
    names = [
        module.name for module in pkgutil.walk_packages(readers.__path__, f"{readers.__name__}.")
    ]
    return code_hash([readers, *map(importlib.import_module, names)])
