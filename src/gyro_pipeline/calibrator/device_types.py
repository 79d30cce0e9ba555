"""Properties that all devices of a type share: noise, turn-on spread, temperature, warm-up.

A type is a file, ``<registry>/types/<type>.json`` or one that ships with the package. A person
writes it, or :func:`type_of_models` makes it from the fits of the pipeline. Its keys are the fields
of :class:`DeviceType`; docs/calibrator.md explains them.
"""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache, cached_property
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from gyro_pipeline.calibrator.filter import FLICKER_S, Array, Noise
from gyro_pipeline.conventions import MDPS, InputError

if TYPE_CHECKING:
    from gyro_pipeline.physics.recording_model import RecordingModel

Axes = float | tuple[float, float, float]  # for all axes, or for x, y and z


_POSITIVE = {"noise_mdps_rts", "turn_on_factor", "walk_factor", "warm_up: time_constant_s"}
_OF_ANY_SIGN = {"temperature_slope_mdps_per_c", "warm_up: amplitude_mdps"}


@dataclass(frozen=True)
class WarmUp:
    """A warm-up: the bias decays exponentially from an amplitude at power-on."""

    amplitude_mdps: Axes
    spread_mdps: Axes
    time_constant_s: float


@dataclass(frozen=True)
class DeviceType:
    """A device type, as its file states it. Without N, the log alone shows the noise."""

    type: str = "unknown"
    noise_mdps_rts: Axes | None = None  # N
    noise_spread: float = 0.0  # relative spread of N from device to device
    flicker_mdps: Axes = 0.0  # B
    random_walk_mdps_per_rts: Axes = 0.0  # K
    turn_on_mdps: Axes = 10.0  # median of tau
    turn_on_factor: float = 3.0  # one standard deviation of tau, as a factor
    walk_mdps_per_rtday: Axes = 3.0  # median of the level's walk
    walk_factor: float = 4.0
    conflict_mdps: Axes = 5.0  # standard deviation of a wrong history
    temperature_slope_mdps_per_c: Axes = 0.0
    temperature_spread_mdps_per_c: Axes = 0.0  # of the slope; 0: the temperature is not used
    least_change_mdps: float = 20.0  # a smaller change within half a minute is no motion
    warm_up: WarmUp | None = None
    schema: int = 1
    about: str = ""
    sources: dict[str, str] = field(default_factory=dict)

    def dps(self, name: str) -> Array:
        """A field that is in mdps, converted to deg/s, (3,)."""
        return _axes_dps(getattr(self, name))

    @cached_property
    def noise(self) -> Noise:
        """The noise figures of the type; N is 1 where it is unknown."""
        white = np.ones(3) if self.noise_mdps_rts is None else self.dps("noise_mdps_rts")
        warm_up = None
        if self.warm_up is not None:
            spread = _axes_dps(np.maximum(self.warm_up.spread_mdps, 1e-3))
            warm_up = _axes_dps(self.warm_up.amplitude_mdps), spread, self.warm_up.time_constant_s
        random_walk = self.dps("random_walk_mdps_per_rts")
        return Noise(white, self.dps("flicker_mdps"), random_walk, warm_up)

    @property
    def noise_freedom(self) -> float:
        """Degrees of freedom of N before a log is read; infinite where N is known exactly."""
        if self.noise_mdps_rts is None:
            return 0.0
        return 1 / (2 * self.noise_spread**2) if self.noise_spread else np.inf


def _axes_dps(mdps: ArrayLike) -> Array:
    return np.broadcast_to(np.asarray(mdps, np.float64) * MDPS, 3)


def read_type(name: str | None, registry: Path | None = None) -> DeviceType:
    """Read a type by its name, from the registry or else from those that ship with the package.

    Args:
        name: None for a device of unknown type.
        registry: The folder of all devices.

    Raises:
        InputError: There is no such type, or its file is invalid.
    """
    if name in (None, DeviceType.type):
        return DeviceType()
    for folder in _folders(registry):
        if (path := folder / f"{name}.json").is_file():
            try:
                content = json.loads(path.read_text("utf-8"))
            except ValueError as error:
                raise InputError(f"{path}: expected JSON, but: {error}; correct it") from error
            return type_of(content, str(path))
    raise InputError(
        f"type: expected {', '.join(type_names(registry))}, got {name!r}; "
        "write a file types/<type>.json in the registry, or leave --type out"
    )


def type_names(registry: Path | None = None) -> list[str]:
    """Names of all types, those in the registry and those that ship with the package."""
    paths = [path for folder in _folders(registry) if folder.is_dir() for path in folder.iterdir()]
    return sorted({path.name.removesuffix(".json") for path in paths})


def _folders(registry: Path | None) -> list[Any]:
    in_registry = [] if registry is None else [registry / "types"]
    return [*in_registry, files("gyro_pipeline.calibrator") / "types"]


def type_of(content: Mapping[str, Any], where: str) -> DeviceType:
    """The device type that the content of a file describes."""
    device_type: DeviceType = validated(DeviceType, content, where)
    warm_up = vars(device_type.warm_up) if device_type.warm_up else {}
    figures = {f"warm_up: {name}": value for name, value in warm_up.items()}
    for name, value in {**vars(device_type), **figures}.items():
        if not isinstance(value, float | tuple) or name in _OF_ANY_SIGN:
            continue
        least = "more than 0" if name in _POSITIVE else "0 or more"
        if not (np.min(value) > 0 or (np.min(value) == 0 and name not in _POSITIVE)):
            raise InputError(f"{where}: {name}: expected {least}, got {value}; correct it")
    return device_type


def validated(kind: Any, content: Mapping[str, Any], where: str) -> Any:
    """A dataclass made from the content of a file; an ``InputError`` names the first bad key."""
    from pydantic import ValidationError  # noqa: PLC0415

    try:
        return _adapter(kind).validate_python(content)
    except ValidationError as error:
        first = error.errors()[0]
        text = ": ".join([where, *map(str, first["loc"][:1]), first["msg"].lower()])
        raise InputError(f"{text}, got {first['input']!r}; correct it") from error


@cache
def _adapter(kind: Any) -> Any:
    from pydantic import ConfigDict, TypeAdapter, with_config  # noqa: PLC0415

    return TypeAdapter(with_config(ConfigDict(extra="forbid", allow_inf_nan=False))(kind))


def type_of_models(
    name: str, models: Sequence[Sequence["RecordingModel"]], source: str
) -> dict[str, Any]:
    """The content of a type file, from the models that the pipeline fitted to several devices.

    Args:
        name: Name of the type.
        models: (device, axis), as :func:`gyro_pipeline.physics.reml.fit_recording_model` returns
            them; flicker slower than ``FLICKER_S`` counts as turn-on spread.
        source: The recordings that the models were fitted to.
    """
    figures = [
        [(m.noise.white, m.noise.instability, m.noise.random_walk) for m in device]
        for device in models
    ]
    white, flicker, walk = np.moveaxis(np.array(figures), -1, 0) / MDPS
    slower = [[np.log(m.samples / m.rate_hz / FLICKER_S) / np.pi for m in d] for d in models]
    variances = np.array([[m.covariance[0, 0] for m in device] for device in models]) / MDPS**2
    logs = np.log(np.maximum(variances + np.array(slower) * flicker**2, 1e-4)) / 2
    relative = np.std(white / np.sqrt(np.mean(white**2, axis=0)), axis=0, ddof=len(models) > 1)
    rms = {"noise_mdps_rts": white, "flicker_mdps": flicker, "random_walk_mdps_per_rts": walk}
    return {
        "type": name,
        **{key: np.sqrt(np.mean(v**2, axis=0)).round(4).tolist() for key, v in rms.items()},
        "noise_spread": round(float(max(relative.max(), 0.02)), 3),
        "turn_on_mdps": np.exp(logs.mean(axis=0)).round(4).tolist(),
        "turn_on_factor": round(float(np.clip(np.exp(logs.std()), 1.5, 4)), 2),
        "sources": {"all": source},
    }
