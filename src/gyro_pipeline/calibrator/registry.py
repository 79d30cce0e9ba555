"""The registry of devices: each has a folder, and its history is append-only.

docs/calibrator.md lists the files. A line is written in one call, under a lock, and synced before
the call returns. A line that a crash cut off is ignored, and the next one starts on a new line.
"""

import json
import os
import re
import tomllib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from filelock import FileLock, Timeout

from gyro_pipeline.calibrator.device_types import validated
from gyro_pipeline.calibrator.history import STILL, Calibration
from gyro_pipeline.calibrator.stretch import Setup
from gyro_pipeline.conventions import AXES, MDPS, InputError

SET = "set"  # stands in place of a hash where a bias was typed in

_VARIABLE = "GYRO_CALIBRATE_REGISTRY"  # environment variable with the folder of the registry
_NAME = re.compile(r"[\w][\w.-]{0,63}")
_LOCK_TIMEOUT_S = 10.0
_MAX_LINE_BYTES = 4096
_TEMPLATE = """{type}
# mounted = true     # the heading repeats at each calibration
# latitude = 32.1    # degrees
# notes = ""
"""
_KEYS = {"note": "text", "forget": "of"}  # that these events need
_TYPE_FIGURES = ("flicker_mdps", "random_walk_mdps_per_rts")

Line = dict[str, Any]


class RegistryError(Exception):
    """The registry cannot be written."""


def registry_folder(path: str | Path | None = None) -> Path:
    """The given folder, or that of the environment variable, or the user's folder for data."""
    if path or os.environ.get(_VARIABLE):
        return Path(path or os.environ[_VARIABLE])
    import platformdirs  # noqa: PLC0415 - not needed where a folder is named

    return Path(platformdirs.user_data_dir("gyro-calibrate"))


@dataclass(frozen=True)
class Settings:
    """The content of ``device.toml``, which people write."""

    type: str | None = None
    mounted: bool = False  # whether the heading repeats
    latitude: float | None = None  # degrees
    frame: Any = None
    notes: Any = None


class Device:
    """The folder of a device in a registry; a name has letters, digits, ``.``, ``-`` and ``_``."""

    def __init__(self, registry: Path, name: str) -> None:
        if not _NAME.fullmatch(name) or name == "types":
            text = "expected letters, digits, '.', '-' and '_', 64 at most, and not 'types'"
            raise InputError(f"device: {text}, got {name!r}; give another name")
        self.name, self.folder = name, registry / name
        self.lines_path = self.folder / "calibrations.jsonl"
        self.settings_path = self.folder / "device.toml"
        self.model_path = self.folder / "model.json"

    @classmethod
    def all(cls, registry: Path) -> "list[Device]":
        """All devices of a registry, by name."""
        return [cls(registry, path.parent.name) for path in sorted(registry.glob("*/device.toml"))]

    def settings(self) -> Settings:
        """The settings in ``device.toml``; the defaults where there is none."""
        return _settings(_read(self.settings_path).decode("utf-8", "replace"), self.settings_path)

    def lines(self) -> list[Line]:
        """All complete lines of the history, the oldest first.

        Raises:
            InputError: A line is broken, other than by a crash that cut it off.
        """
        lines = []
        for number, text in enumerate(_read(self.lines_path).splitlines(), 1):
            if text.rstrip().endswith(b"}"):
                line: Any = text
                with suppress(ValueError):
                    line = json.loads(text)
                _checked(line, f"{self.lines_path}: line {number}")
                lines.append(line)
        return lines

    def calibrations(self) -> dict[str, Calibration]:
        """Calibrations and failed attempts that were not withdrawn, by hash."""
        stored: dict[str, Calibration] = {}
        for line in self.lines():
            if line["event"] == "forget":
                stored.pop(line["of"], None)
            elif line["event"] != "note":
                calibration = _checked(line, str(self.lines_path))
                if calibration.event == SET:
                    stored.pop(SET, None)
                stored.setdefault(calibration.hash, calibration)
        return stored

    def knocks(self) -> int:
        """Number of knocks that were noted."""
        return sum(bool(line.get("knocked")) for line in self.lines())

    def history(self, without: str | None = None) -> list[Calibration]:
        """The calibrations that count, except that of one hash; only the bias typed in if any."""
        stored = self.calibrations()
        if SET in stored:
            return [stored[SET]]
        return [c for key, c in stored.items() if c.rest == STILL and c.mean_dps and key != without]

    def attempt(self, without: str | None = None) -> int:
        """Number of the next attempt, counted from the last one that reached its target."""
        past = [c for key, c in self.calibrations().items() if key not in (SET, without)]
        numbers = [n for n, c in enumerate(reversed(past)) if c.reached]
        return 1 + (numbers[0] if numbers else len(past))

    def append(self, line: Mapping[str, Any] | Calibration) -> bool:
        """Append a line and sync it, unless a calibration with the same hash is stored.

        Returns:
            Whether the line was written.

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

    def write_model(self, setup: Setup) -> None:
        """Replace ``model.json``, which people and other programs read, by the current model."""
        fitted = setup.unseen_prior.fitted or ({},) * len(AXES)
        noise = setup.noise_factor * setup.noise.white / MDPS
        freedom = np.maximum(setup.noise_prior[1], 1e-9)
        sigma = noise / np.sqrt(2 * freedom)
        figures = {key: getattr(setup.device_type, key) for key in _TYPE_FIGURES}  # without σ
        model = {
            name: {key: [v / MDPS, s / MDPS] for key, (v, s) in fitted[axis].items()}
            | ({"noise": [float(noise[axis]), float(sigma[axis])]} if freedom[axis] >= 1 else {})
            for axis, name in enumerate(AXES)
        }
        temporary = self.model_path.with_suffix(".new")
        with self._locked():
            temporary.write_text(json.dumps(model | figures, indent=1) + "\n", "utf-8")
            os.replace(temporary, self.model_path)

    def model(self) -> dict[str, Any]:
        """The figures in ``model.json`` of each axis, with their σ; empty where there is none."""
        try:
            content = json.loads(_read(self.model_path) or "{}")
            for axis in content.keys() & set(AXES):
                np.reshape([*content[axis].values()], (-1, 2)).astype(float)
            return dict(content)
        except (AttributeError, TypeError, ValueError) as error:
            text = f"{self.model_path}: expected figures, each with its σ, but: {error}"
            raise InputError(f"{text}; remove it, the next calibration writes it") from error

    def create(self, device_type: str | None = None, settings: str = "") -> None:
        """Create the folder and ``device.toml`` where they are missing; check that a line fits.

        Raises:
            RegistryError: Nothing can be written.
        """
        type_line = f'type = "{device_type}"' if device_type else '# type = "consumer"'
        with self._locked():
            size = _append(self.lines_path, b" " * _MAX_LINE_BYTES)  # is there room for a line?
            os.truncate(self.lines_path, size)
            if not self.settings_path.exists():
                self.settings_path.write_text(settings or _TEMPLATE.format(type=type_line), "utf-8")

    def content(self) -> dict[str, Any]:
        """Settings and history of the device, to save in one file."""
        settings = _read(self.settings_path).decode()
        return {"device": self.name, "device_toml": settings, "lines": self.lines()}

    def restore(self, content: Mapping[str, Any], where: str) -> None:
        """Add the lines of a saved device that are not stored yet, and its settings if missing.

        Raises:
            InputError: A line or the settings are invalid; then nothing is added.
        """
        lines, stored = list(content["lines"]), self.lines()
        _settings(content["device_toml"], f"{where}: device_toml")
        for number, line in enumerate(lines, 1):
            _checked(line, f"{where}: line {number}")
        self.create(settings=content["device_toml"])
        for line in lines:
            if line not in stored:
                self.append(line)

    @contextmanager
    def _locked(self) -> Iterator[None]:
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            with FileLock(self.folder / ".lock", timeout=_LOCK_TIMEOUT_S):
                yield
        except Timeout as error:
            text = f"{self.folder}: another process has held its lock for {_LOCK_TIMEOUT_S:g} s"
            raise RegistryError(f"{text}; end it, or give --no-store") from error
        except OSError as error:
            text = f"{self.folder}: nothing can be stored: {error.strerror or error}"
            raise RegistryError(f"{text}; give another --registry, or --no-store") from error


def _settings(text: str, where: str | Path) -> Settings:
    """The settings in the text of ``device.toml``."""
    try:
        content = tomllib.loads(text)
    except ValueError as error:
        raise InputError(f"{where}: expected TOML, but: {error}; correct it") from error
    if extra := sorted(content.keys() - (keys := Settings.__dataclass_fields__.keys())):
        raise InputError(f"{where}: expected {', '.join(sorted(keys))}, got {extra}; correct it")
    settings: Settings = validated(Settings, content, str(where))
    return settings


def _checked(line: Any, where: str) -> Any:
    """The event in a line of the history."""
    event = str(line.get("event")) if isinstance(line, dict) else None
    if event in _KEYS and isinstance(line.get(_KEYS[event]), str):
        return line
    if event not in ("calibration", SET):
        text = f"expected JSON of a calibration, a note with text, or forget with of, got {line}"
        raise InputError(f"{where}: {text:.200}; correct it, or remove the line")
    calibration = validated(Calibration, line, where)
    if min(calibration.variance_dps2 or [0]) < 0:
        text = f"variance_dps2: expected 0 or more, got {calibration.variance_dps2}; correct it"
        raise InputError(f"{where}: {text}")
    return calibration


def _read(path: Path) -> bytes:
    """The content of a file; empty where there is none."""
    try:
        return path.read_bytes()
    except (FileNotFoundError, NotADirectoryError):
        return b""


def _append(path: Path, data: bytes) -> int:
    """Append all of the data to a file and sync it, or nothing; returns the size before."""
    with open(path, "a+b", buffering=0) as file:
        size = file.seek(0, os.SEEK_END)
        if size and os.pread(file.fileno(), 1, size - 1) != b"\n":
            data = b"\n" + data  # a crash cut off the last line
        try:
            if os.write(file.fileno(), data) < len(data):
                raise OSError(28, "No space left on device")
            os.fsync(file.fileno())
        except OSError:
            file.truncate(size)
            raise
        return size
