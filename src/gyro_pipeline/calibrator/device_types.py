"""What the devices of one type share: ``<registry>/types/<type>.json``, or one that ships.

A file is written by hand, or by :func:`type_of_models` from the pipeline's own fits. Its keys are
those of ``_TRIPLES`` (a number, or one for each of x, y, z), ``_NUMBERS``, ``warm_up`` and
``sources``; docs/calibrator.md explains them.
"""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from gyro_pipeline.calibrator.filter import FLICKER_S, Noise
from gyro_pipeline.calibrator.state import Array
from gyro_pipeline.conventions import AXES, MDPS, InputError

if TYPE_CHECKING:
    from gyro_pipeline.physics.recording_model import RecordingModel

UNKNOWN = "unknown"
"""The type of a device of which nothing is said: its noise is told from the log alone."""

_TRIPLES = {  # and what stands for one that a file leaves out
    "noise_mdps_rts": 1e3,
    "flicker_mdps": 0.0,
    "random_walk_mdps_per_rts": 0.0,
    "turn_on_mdps": 10.0,
    "walk_mdps_per_rtday": 3.0,
    "conflict_mdps": 5.0,
    "temperature_slope_mdps_per_c": 0.0,
    "temperature_spread_mdps_per_c": 0.0,
}
_NUMBERS = {
    "noise_spread": 0.0, "turn_on_factor": 3.0, "walk_factor": 4.0, "least_change_mdps": 20.0,
}  # fmt: skip
_WARM_UP = ("amplitude_mdps", "spread_mdps", "time_constant_s")
_TEXTS = {"schema", "type", "about", "sources", "warm_up"}


@dataclass(frozen=True)
class DeviceType:
    """A type in deg/s; arrays are (3,)."""

    name: str
    noise: Noise  # N is 1 where it is not known, and noise_freedom 0
    noise_freedom: float  # that N is worth before a log is seen; infinite: known
    turn_on: Array  # median of tau
    turn_on_factor: float  # one standard deviation of tau, as a factor
    walk: Array  # median of the level's walk, deg/s a square root of a day
    walk_factor: float
    wide: Array  # standard deviation of the wide prior
    slope: Array  # of the bias, deg/s a degree Celsius
    slope_spread: Array  # its standard deviation; 0: temperature is not used
    least_change: float  # smaller changes of the rate within half a minute are no motion


def read_type(name: str | None, registry: Path | None = None) -> DeviceType:
    """Read a type by its name: the registry's own, else one that ships; None: the unknown one.

    Raises:
        InputError: There is no such type, or its file is not as it should be.
    """
    if name in (None, UNKNOWN):
        return type_of({}, "the unknown type")
    for folder in _folders(registry):
        path = folder / f"{name}.json"
        if path.is_file():
            try:
                return type_of(json.loads(path.read_text("utf-8")), str(path))
            except json.JSONDecodeError as error:
                raise InputError(f"{path}: expected JSON, but: {error}; correct it") from error
    raise InputError(
        f"type: expected {', '.join(names(registry))}, got {name!r}; "
        "write a file types/<type>.json in the registry, or leave --type out"
    )


def names(registry: Path | None = None) -> list[str]:
    """Names of the types that ship and of the registry's own."""
    paths = [path for folder in _folders(registry) if folder.is_dir() for path in folder.iterdir()]
    return sorted({path.name.removesuffix(".json") for path in paths})


def _folders(registry: Path | None) -> list[Any]:
    own = [] if registry is None else [registry / "types"]
    return [*own, files("gyro_pipeline.calibrator") / "types"]


def type_of(content: Mapping[str, Any], where: str) -> DeviceType:
    """The type that a file's content describes.

    Raises:
        InputError: A key is unknown, or a value is not as it should be.
    """
    if extra := set(content) - {*_TRIPLES, *_NUMBERS, *_TEXTS}:
        known = ", ".join((*_TRIPLES, *_NUMBERS, "warm_up", "sources"))
        raise InputError(f"{where}: expected the keys {known}, got {sorted(extra)}; correct them")
    v = {key: _triple(content.get(key, default), key, where) for key, default in _TRIPLES.items()}
    n = {key: float(content.get(key, default)) for key, default in _NUMBERS.items()}
    white, spread = v["noise_mdps_rts"], n["noise_spread"]
    freedom = 1 / (2 * spread**2) if spread else np.inf
    noise = Noise(white, v["flicker_mdps"], v["random_walk_mdps_per_rts"], _warm_up(content, where))
    return DeviceType(
        str(content.get("type", UNKNOWN)), noise, freedom if "noise_mdps_rts" in content else 0.0,
        v["turn_on_mdps"], n["turn_on_factor"], v["walk_mdps_per_rtday"], n["walk_factor"],
        v["conflict_mdps"], v["temperature_slope_mdps_per_c"], v["temperature_spread_mdps_per_c"],
        n["least_change_mdps"] * MDPS,
    )  # fmt: skip


def _triple(value: Any, key: str, where: str) -> Array:
    """Three numbers in deg/s, of one or three in mdps."""
    try:
        triple = np.broadcast_to(np.asarray(value, np.float64), 3)
    except (TypeError, ValueError):
        triple = np.full(3, np.nan)
    if not np.all(np.isfinite(triple)):
        raise InputError(f"{where}: {key}: expected a number for each of {AXES}, got {value!r}")
    return triple * MDPS


def _warm_up(content: Mapping[str, Any], where: str) -> tuple[Array, Array, float] | None:
    if (given := content.get("warm_up")) is None:
        return None
    if set(given) != set(_WARM_UP):
        raise InputError(f"{where}: warm_up: expected {', '.join(_WARM_UP)}, got {sorted(given)}")
    mean, spread = (_triple(given[k], k, where) for k in ("amplitude_mdps", "spread_mdps"))
    return mean, np.maximum(spread, 1e-3 * MDPS), float(given["time_constant_s"])


def type_of_models(
    name: str, models: Sequence[Sequence["RecordingModel"]], source: str
) -> dict[str, Any]:
    """The content of a type's file, from what the pipeline fitted to several devices.

    Args:
        name: Of the type.
        models: (device, axis), as :func:`gyro_pipeline.physics.reml.fit_recording_model` returns
            them; flicker slower than ``FLICKER_S`` is counted as turn-on spread.
        source: Which recordings they were fitted to.
    """
    figures = [
        [(m.noise.white, m.noise.instability, m.noise.random_walk) for m in device]
        for device in models
    ]
    white, instability, walk = np.moveaxis(np.array(figures), -1, 0) / MDPS
    slower = [[np.log(m.samples / m.rate_hz / FLICKER_S) / np.pi for m in d] for d in models]
    variances = np.array([[m.covariance[0, 0] for m in device] for device in models]) / MDPS**2
    logs = np.log(np.maximum(variances + np.array(slower) * instability**2, 1e-4)) / 2
    relative = np.std(white / np.sqrt(np.mean(white**2, axis=0)), axis=0, ddof=len(models) > 1)
    rms = {"noise_mdps_rts": white, "flicker_mdps": instability, "random_walk_mdps_per_rts": walk}
    return {
        "schema": 1,
        "type": name,
        **{key: np.sqrt(np.mean(v**2, axis=0)).round(4).tolist() for key, v in rms.items()},
        "noise_spread": round(float(max(relative.max(), 0.02)), 3),
        "turn_on_mdps": np.exp(logs.mean(axis=0)).round(4).tolist(),
        "turn_on_factor": round(float(np.clip(np.exp(logs.std()), 1.5, 4)), 2),
        "sources": {"all": source},
    }
