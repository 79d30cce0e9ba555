"""The registry of devices: a folder each, whose history is only ever appended to.

    <registry>/<device>/device.toml         written by people: type, mounted, latitude, frame, notes
                        calibrations.jsonl  one line a calibration, note or withdrawal
                        model.json          derived: noise, level, tau, walk, slope
    <registry>/types/<type>.json

A line is written at once, under a lock, and synced before the call returns. A line that a crash cut
off is ignored, and the next one starts on a new line.
"""

import json
import os
import re
import shutil
import tomllib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from filelock import FileLock, Timeout

from gyro_pipeline.calibrator.calibrator import Calibrator
from gyro_pipeline.calibrator.device_types import validated
from gyro_pipeline.calibrator.history import STILL, Calibration
from gyro_pipeline.conventions import AXES, MDPS, InputError

VARIABLE = "GYRO_CALIBRATE_REGISTRY"
"""The environment variable that names the folder."""

SET = "set"
"""In place of a hash, what was set by hand."""

_NAME = re.compile(r"[\w][\w.-]{0,63}")
_LOCK_S = 10.0
_ROOM = 4096  # bytes, more than a line takes
_TEMPLATE = """{type}
# mounted = true     # the heading repeats at each calibration
# latitude = 32.1    # degrees
# notes = ""
"""
_KEYS = {"type", "mounted", "latitude", "frame", "notes"}

_OF_TYPE = ("flicker_mdps", "random_walk_mdps_per_rts")

Line = dict[str, Any]


class RegistryError(Exception):
    """The registry cannot be written."""


def registry_folder(path: str | Path | None = None) -> Path:
    """The folder that was named, the environment's, or the user's own for data."""
    if path or os.environ.get(VARIABLE):
        return Path(path or os.environ[VARIABLE])
    import platformdirs  # noqa: PLC0415 - not needed where a folder is named

    return Path(platformdirs.user_data_dir("gyro-calibrate"))


def devices(registry: Path) -> list["Device"]:
    """All devices of a registry, by name."""
    return [Device(registry, path.parent.name) for path in sorted(registry.glob("*/device.toml"))]


class Device:
    """A device's folder.

    Args:
        registry: The folder of all devices.
        name: Letters, digits, ``.``, ``-`` and ``_``.
    """

    def __init__(self, registry: Path, name: str) -> None:
        if not _NAME.fullmatch(name) or name == "types":
            text = "expected letters, digits, '.', '-' and '_', 64 at most, and not 'types'"
            raise InputError(f"device: {text}, got {name!r}; give another name")
        self.name, self.folder = name, registry / name
        self.lines_path = self.folder / "calibrations.jsonl"
        self.settings_path = self.folder / "device.toml"
        self.model_path = self.folder / "model.json"

    def settings(self) -> dict[str, Any]:
        """What ``device.toml`` says; nothing where there is none."""
        try:
            content = tomllib.loads(_read(self.settings_path).decode())
        except ValueError as error:
            text = f"{self.settings_path}: expected TOML, but: {error}; correct it"
            raise InputError(text) from error
        if extra := set(content) - _KEYS:
            expected = ", ".join(sorted(_KEYS))
            text = f"{self.settings_path}: expected {expected}, got {sorted(extra)}; correct it"
            raise InputError(text)
        return content

    def lines(self) -> list[Line]:
        """All whole lines of its history, the oldest first."""
        parsed = map(_parsed, _read(self.lines_path).split(b"\n"))
        return [line for line in parsed if line is not None]

    def calibrations(self) -> dict[str, Calibration]:
        """All that were not withdrawn since, by hash, attempts as well."""
        kept: dict[str, Calibration] = {}
        for number, line in enumerate(self.lines(), 1):
            if line["event"] in ("calibration", SET):
                calibration = validated(Calibration, line, f"{self.lines_path}: line {number}")
                if calibration.event == SET:
                    kept.pop(SET, None)
                kept.setdefault(calibration.hash, calibration)
            elif line["event"] == "forget":
                kept.pop(line["of"], None)
        return kept

    def history(self, without: str | None = None) -> list[Calibration]:
        """The calibrations that count, but for that of one hash; or what was set by hand alone."""
        kept = self.calibrations()
        if SET in kept:
            return [kept[SET]]
        return [c for key, c in kept.items() if c.rest == STILL and c.mean_dps and key != without]

    def attempt(self, without: str | None = None) -> int:
        """Number of the next attempt: one more than those that just did not do."""
        past = [c for key, c in self.calibrations().items() if key not in (SET, without)]
        numbers = [n for n, c in enumerate(reversed(past)) if c.reached]
        return 1 + (numbers[0] if numbers else len(past))

    def append(self, line: Mapping[str, Any] | Calibration) -> bool:
        """Write a line, synced; not if there is a calibration of the same hash.

        Returns:
            Whether it was written.

        Raises:
            RegistryError: The disk is full, or the folder cannot be written.
        """
        line = asdict(line) if isinstance(line, Calibration) else {"schema": 1, **line}
        data = json.dumps(line, allow_nan=False).encode() + b"\n"
        with self._locked():
            if line["event"] == "calibration" and line["hash"] in self.calibrations():
                return False
            _append(self.lines_path, data)
        return True

    def write_model(self, calibrator: Calibrator) -> None:
        """Replace ``model.json``, for people and other programs, by what is known now."""
        setup, fitted = calibrator.setup, calibrator.best.prior.fitted or ({},) * len(AXES)
        noise, freedom = setup.factor * setup.noise.white / MDPS, np.maximum(setup.known[1], 1e-9)
        sigma = noise / np.sqrt(2 * freedom)
        types = {k: getattr(setup.device_type, k) for k in _OF_TYPE}  # not fitted: no uncertainty
        model = {
            name: {key: [v / MDPS, s / MDPS] for key, (v, s) in fitted[axis].items()}
            | ({"noise": [float(noise[axis]), float(sigma[axis])]} if freedom[axis] >= 1 else {})
            for axis, name in enumerate(AXES)
        }
        temporary = self.model_path.with_suffix(".new")
        with self._locked():
            temporary.write_text(json.dumps(model | types, indent=1) + "\n", "utf-8")
            os.replace(temporary, self.model_path)

    def model(self) -> dict[str, Any]:
        """What ``model.json`` holds; nothing where there is none."""
        return dict(json.loads(_read(self.model_path) or "{}"))

    def create(self, device_type: str | None = None, settings: str = "") -> None:
        """Make the folder and ``device.toml``, where they are not there.

        Raises:
            RegistryError: Nothing can be written; this is said before anything is measured.
        """
        of_type = f'type = "{device_type}"' if device_type else '# type = "consumer"'
        with self._locked():
            size = _append(self.lines_path, b" " * _ROOM)  # is there room for a line?
            os.truncate(self.lines_path, size)
            if not self.settings_path.exists():
                self.settings_path.write_text(settings or _TEMPLATE.format(type=of_type), "utf-8")

    def content(self) -> dict[str, Any]:
        """All of it, for one file."""
        settings = _read(self.settings_path).decode()
        return {"device": self.name, "device_toml": settings, "lines": self.lines()}

    def restore(self, content: Mapping[str, Any]) -> None:
        """Add what such a file holds and is not there yet."""
        lines, there = list(content["lines"]), self.lines()
        self.create(settings=content["device_toml"])
        for line in lines:
            if line not in there:
                self.append(line)

    def remove(self) -> None:
        """Remove the folder and all that is in it."""
        shutil.rmtree(self.folder)

    @contextmanager
    def _locked(self) -> Iterator[None]:
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            with FileLock(self.folder / ".lock", timeout=_LOCK_S):
                yield
        except Timeout as error:
            text = f"{self.folder}: another process has held its lock for {_LOCK_S:g} s"
            raise RegistryError(f"{text}; end it, or give --no-store") from error
        except OSError as error:
            text = f"{self.folder}: nothing can be stored: {error.strerror or error}"
            raise RegistryError(f"{text}; give another --registry, or --no-store") from error


def _read(path: Path) -> bytes:
    """A file's content, empty where it is not there."""
    try:
        return path.read_bytes()
    except (FileNotFoundError, NotADirectoryError):
        return b""


def _append(path: Path, data: bytes) -> int:
    """All of the data at the end of a file, or none, on the disk; returns where it begins."""
    with open(path, "a+b", buffering=0) as file:
        size = file.seek(0, os.SEEK_END)
        if size and os.pread(file.fileno(), 1, size - 1) != b"\n":
            data = b"\n" + data  # a crash cut the last line off
        try:
            if os.write(file.fileno(), data) < len(data):
                raise OSError(28, "No space left on device")
            os.fsync(file.fileno())
        except OSError:
            file.truncate(size)
            raise
        return size


def _parsed(line: bytes) -> Line | None:
    try:
        content = json.loads(line)
    except ValueError:
        return None
    return content if isinstance(content, dict) and "event" in content else None
