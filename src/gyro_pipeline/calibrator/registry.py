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
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from filelock import FileLock, Timeout

from gyro_pipeline.calibrator.device_types import DeviceType, read_type
from gyro_pipeline.calibrator.history import Calibration, Circumstances, Prior
from gyro_pipeline.calibrator.state import State
from gyro_pipeline.conventions import MDPS, InputError

VARIABLE = "GYRO_CALIBRATE_REGISTRY"
"""The environment variable that names the folder."""

SCHEMA = 1
DAY_S = 86400.0

_NAME = re.compile(r"[\w][\w.-]{0,63}")
_LOCK_S = 10.0
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

    def settings(self) -> dict[str, Any]:
        """What ``device.toml`` says; nothing where there is none."""
        try:
            said = tomllib.loads(self.settings_path.read_text("utf-8"))
        except FileNotFoundError:
            return {}
        except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
            raise InputError(
                f"{self.settings_path}: expected TOML, but: {error}; correct it"
            ) from error
        if extra := set(said) - _KEYS:
            expected = ", ".join(sorted(_KEYS))
            raise InputError(
                f"{self.settings_path}: expected {expected}, got {sorted(extra)}; correct it"
            )
        return said

    def lines(self) -> list[dict[str, Any]]:
        """All whole lines of its history, the oldest first."""
        try:
            content = self.lines_path.read_bytes()
        except FileNotFoundError:
            return []
        parsed = (_parsed(line) for line in content.split(b"\n"))
        return [line for line in parsed if line is not None]

    def calibrations(self) -> list[dict[str, Any]]:
        """Those that count: at rest, and not withdrawn since."""
        return [line for line in self._kept().values() if line["rest"] == "still"]

    def _kept(self) -> dict[str, dict[str, Any]]:
        """All that are not withdrawn, by their hashes."""
        kept: dict[str, dict[str, Any]] = {}
        for line in self.lines():
            if line["event"] == "calibration":
                kept.setdefault(line["hash"], line)
            elif line["event"] == "forget":
                kept.pop(line["of"], None)
        return kept

    def check_writable(self) -> None:
        """Say before anything is measured if nothing can be stored.

        Raises:
            RegistryError: With the reason.
        """
        with self._locked(), open(self.lines_path, "ab"):
            pass

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

    def write_model(self, prior: Prior, noise_mdps: list[float | None]) -> None:
        """Replace ``model.json``, which people and other programs read, by what is known now."""
        axes = [
            {
                key: [round(value / MDPS, 4), round(sigma / MDPS, 4)]
                for key, (value, sigma) in axis.items()
            }
            for axis in prior.fitted
        ]
        units = "mdps, mdps a square root of a day, mdps a degree; each with its standard deviation"
        model = {"schema": SCHEMA, "units": units, "noise_mdps_rts": noise_mdps, "axes": axes}
        with self._locked():
            temporary = self.folder / "model.json.new"
            temporary.write_text(json.dumps(model, indent=1) + "\n", "utf-8")
            os.replace(temporary, self.folder / "model.json")

    def create(self, device_type: str | None) -> None:
        """Start ``device.toml`` for people to go on with, where there is none."""
        if self.settings_path.exists():
            return
        kind = f'type = "{device_type}"' if device_type else '# type = "consumer"'
        text = (
            f"{kind}\n# mounted = true     # the heading repeats at each calibration\n"
            '# latitude = 32.1    # degrees\n# notes = ""\n'
        )
        with self._locked():
            self.settings_path.write_text(text, "utf-8")

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
    """The line of a calibration.

    Args:
        evidence: Its own data's word.
        state: Its answer.
        source: ``hash``, ``time`` (POSIX), ``since_power_on_s``, ``name`` and ``version``.
        range_c: The least and the most temperature.
    """
    warmth = evidence.temperature_c
    usable = state.rest == "still" and bool(np.isfinite(evidence.variance).all())
    return {
        "event": "calibration",
        **source,
        "seconds": state.seconds_at_rest,
        "mean_dps": evidence.mean.tolist() if usable else None,
        "variance_dps2": evidence.variance.tolist() if usable else None,
        "temperature_c": None if warmth is None else [warmth, *range_c],
        "gravity": None if evidence.up is None else evidence.up.tolist(),
        "rest": state.rest,
        "outcome": list(evidence.outcome),
        "noise_mdps_rts": (evidence.noise / MDPS).tolist()
        if evidence.freedom and evidence.noise is not None
        else None,
        "noise_freedom": evidence.freedom,
        "reasons": [reason.sentence for reason in state.reasons],
    }


def devices(registry: Path) -> list[Device]:
    """All devices of a registry, by name."""
    if not registry.is_dir():
        return []
    names = sorted(
        path.name
        for path in registry.iterdir()
        if (path / "device.toml").exists() or (path / "calibrations.jsonl").exists()
    )
    return [Device(registry, name) for name in names]
