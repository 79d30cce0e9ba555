"""The registry of devices: a folder each, whose history is only ever appended to.

    <registry>/<device>/device.toml         written by people: type, mounted, latitude, notes
                        calibrations.jsonl  one line a calibration, note or withdrawal
                        model.json          derived: noise, level, tau, walk, slope
    <registry>/types/<type>.json

A line is written at once, under a lock, and synced before the call returns. A line that a crash cut
off is no line: it is left out, and the next one starts anew.
"""

import json
import os
import re
import shutil
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from filelock import FileLock, Timeout

from gyro_pipeline.calibrator.calibrator import Calibrator
from gyro_pipeline.calibrator.device_types import DeviceType, read_type
from gyro_pipeline.calibrator.history import Calibration, Circumstances
from gyro_pipeline.calibrator.state import STILL, State
from gyro_pipeline.conventions import MDPS, InputError

VARIABLE = "GYRO_CALIBRATE_REGISTRY"
"""The environment variable that names the folder."""

SCHEMA = 1
DAY_S = 86400.0

_NAME = re.compile(r"[\w][\w.-]{0,63}")
_LOCK_S = 10.0
_TEMPLATE = """# mounted = true     # the heading repeats at each calibration
# latitude = 32.1    # degrees
# notes = ""
"""
_KEYS = {"type", "mounted", "latitude", "frame", "notes"}


class RegistryError(Exception):
    """The registry cannot be written."""


@dataclass(frozen=True)
class Opened:
    """What is known of a device before its samples.

    Attributes:
        kind: Its type.
        history: Its calibrations.
        now: What is known of this one.
    """

    kind: DeviceType
    history: tuple[Calibration, ...] = ()
    now: Circumstances = Circumstances()


def registry_folder(path: str | Path | None = None) -> Path:
    """The folder that was named, the environment's, or the user's own for data."""
    if path or os.environ.get(VARIABLE):
        return Path(path or os.environ[VARIABLE])
    import platformdirs  # noqa: PLC0415 - not needed where a folder is named

    return Path(platformdirs.user_data_dir("gyro-calibrate"))


def opened(
    device: str | None, registry: str | Path | None = None, device_type: str | None = None,
    same_heading: bool | None = None, latitude_deg: float | None = None,
    started_at: float | None = None, without: str | None = None,
) -> Opened:  # fmt: skip
    """What the registry knows of a device; options that are given overrule its ``device.toml``.

    Args:
        device: Its name; None: a device without history.
        registry: Folder; see :func:`registry_folder`.
        device_type: Name of the type.
        same_heading: Whether the heading repeats.
        latitude_deg: Of the place.
        started_at: Of the calibration, POSIX seconds.
        without: Hash of the source whose own stored line is not to count.
    """
    folder = registry_folder(registry)
    said: Mapping[str, Any] = {}
    history: tuple[Calibration, ...] = ()
    if device is not None:
        here = Device(folder, device)
        said = here.settings()
        lines = [line for line in here.calibrations() if not without or line["hash"] != without]
        history = tuple(_evidence(line) for line in lines)
    heading = bool(said.get("mounted", False)) if same_heading is None else same_heading
    latitude = said.get("latitude") if latitude_deg is None else latitude_deg
    day = None if started_at is None else started_at / DAY_S
    now = Circumstances(day, same_heading=heading, latitude_deg=latitude)
    return Opened(read_type(device_type or said.get("type"), folder), history, now)


class Device:
    """A device's folder.

    Args:
        registry: The folder of all.
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
            said = tomllib.loads(self.settings_path.read_text("utf-8"))
        except (FileNotFoundError, NotADirectoryError):
            return {}
        except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
            text = f"{self.settings_path}: expected TOML, but: {error}; correct it"
            raise InputError(text) from error
        if extra := set(said) - _KEYS:
            expected = ", ".join(sorted(_KEYS))
            text = f"{self.settings_path}: expected {expected}, got {sorted(extra)}; correct it"
            raise InputError(text)
        return said

    def lines(self) -> list[dict[str, Any]]:
        """All whole lines of its history, the oldest first."""
        try:
            content = self.lines_path.read_bytes()
        except (FileNotFoundError, NotADirectoryError):
            return []
        parsed = (_parsed(line) for line in content.split(b"\n"))
        return [line for line in parsed if line is not None]

    def calibrations(self) -> list[dict[str, Any]]:
        """Those that count: at rest, and not withdrawn since."""
        return [line for line in self._kept().values() if line["rest"] == STILL]

    def _kept(self) -> dict[str, dict[str, Any]]:
        """All that are not withdrawn, by their hashes."""
        kept: dict[str, dict[str, Any]] = {}
        for line in self.lines():
            if line["event"] == "calibration":
                kept.setdefault(line["hash"], line)
            elif line["event"] == "forget":
                kept.pop(line["of"], None)
        return kept

    def append(self, line: Mapping[str, Any]) -> bool:
        """Write a line, synced; not if there is a calibration of the same hash.

        Returns:
            Whether it was written.

        Raises:
            RegistryError: The disk is full, or the folder cannot be written.
        """
        data = json.dumps({"schema": SCHEMA, **line}, allow_nan=False).encode() + b"\n"
        with self._locked():
            if line["event"] == "calibration" and line["hash"] in self._kept():
                return False
            _append(self.lines_path, data)
        return True

    def write_model(self, calibrator: Calibrator) -> None:
        """Replace ``model.json``, for people and other programs, by what is known now."""
        noise = np.sqrt(calibrator.scale) * calibrator.kind.noise.white / MDPS
        axes = [
            {key: [value / MDPS, sigma / MDPS] for key, (value, sigma) in axis.items()}
            for axis in calibrator.prior.fitted
        ]
        known = np.where(calibrator.freedom > 0, noise, np.nan)
        model = {
            "axes": axes,
            "noise_mdps_rts": [None if np.isnan(n) else n for n in known.tolist()],
        }
        with self._locked():
            temporary = self.model_path.with_suffix(".new")
            try:
                temporary.write_text(json.dumps(model, indent=1) + "\n", "utf-8")
                os.replace(temporary, self.model_path)
            finally:
                temporary.unlink(missing_ok=True)

    def model(self) -> dict[str, Any] | None:
        """What ``model.json`` holds, if it is there."""
        return json.loads(self.model_path.read_text("utf-8")) if self.model_path.exists() else None

    def create(self, device_type: str | None = None, settings: str = "") -> None:
        """Make the folder and the file for people, where they are not there.

        Raises:
            RegistryError: Nothing can be written; this is said before anything is measured.
        """
        kind = f'type = "{device_type}"' if device_type else '# type = "consumer"'
        with self._locked(), open(self.lines_path, "ab"):
            if not self.settings_path.exists():
                self.settings_path.write_text(settings or f"{kind}\n{_TEMPLATE}", "utf-8")

    def content(self) -> dict[str, Any]:
        """All of it, for one file."""
        settings = self.settings_path.read_text("utf-8") if self.settings_path.exists() else ""
        return {
            "schema": SCHEMA,
            "device": self.name,
            "device_toml": settings,
            "lines": self.lines(),
        }

    def restore(self, lines: Sequence[Mapping[str, Any]], settings: str) -> None:
        """Add what such a file holds and is not there yet."""
        self.create(settings=settings)
        there = self.lines()
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


def _append(path: Path, data: bytes) -> None:
    """All of the data at the end of a file, or none, on the disk."""
    descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_APPEND, 0o644)
    try:
        size = os.fstat(descriptor).st_size
        if size and os.pread(descriptor, 1, size - 1) != b"\n":
            data = b"\n" + data  # a crash cut the last line off
        try:
            written = os.write(descriptor, data)
            if written < len(data):
                raise OSError(28, "No space left on device")
            os.fsync(descriptor)
        except OSError:
            os.ftruncate(descriptor, size)
            raise
    finally:
        os.close(descriptor)


def _parsed(line: bytes) -> dict[str, Any] | None:
    try:
        content = json.loads(line)
    except ValueError:
        return None
    return content if isinstance(content, dict) and "event" in content else None


def _evidence(line: Mapping[str, Any]) -> Calibration:
    """What a stored line says."""
    warmth, up, noise = line["temperature_c"], line["gravity"], line["noise_mdps_rts"]
    return Calibration(
        np.array(line["mean_dps"]), np.array(line["variance_dps2"]),
        None if line["time"] is None else line["time"] / DAY_S,
        None if warmth is None else warmth[0], None if up is None else np.array(up),
        tuple(line["outcome"]), None if noise is None else np.array(noise) * MDPS,
        line["noise_freedom"],
    )  # fmt: skip


def line_of(
    evidence: Calibration, state: State, source: Mapping[str, Any], range_c: tuple[float, float]
) -> dict[str, Any]:
    """The line of a calibration, or of an attempt.

    Args:
        evidence: Its own data's word.
        state: Its answer.
        source: ``hash``, ``time`` (POSIX), ``source`` and what else is to be kept of it.
        range_c: The least and the most temperature.
    """
    usable = state.rest == STILL and bool(np.isfinite(evidence.variance).all())
    warmth, up, noise = evidence.temperature_c, evidence.up, evidence.noise
    return {
        "event": "calibration",
        **source,
        "seconds": state.seconds_at_rest,
        "mean_dps": evidence.mean.tolist() if usable else None,
        "variance_dps2": evidence.variance.tolist() if usable else None,
        "temperature_c": None if warmth is None else [warmth, *range_c],
        "gravity": None if up is None else up.tolist(),
        "rest": state.rest,
        "outcome": list(evidence.outcome),
        "noise_mdps_rts": (noise / MDPS).tolist()
        if noise is not None and evidence.freedom
        else None,
        "noise_freedom": evidence.freedom,
        "reasons": [reason.sentence for reason in state.reasons],
    }


def devices(registry: Path) -> list[Device]:
    """All devices of a registry, by name."""
    folders = sorted(registry.iterdir()) if registry.is_dir() else []
    return [Device(registry, path.name) for path in folders if (path / "device.toml").exists()]
