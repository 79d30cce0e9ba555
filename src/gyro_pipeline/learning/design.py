"""The design of a network: its class, by name, and its arguments."""

import importlib
import inspect
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import torch
from torch import nn

from gyro_pipeline.conventions import InputError
from gyro_pipeline.learning.network import Architecture, CalibrationNetwork
from gyro_pipeline.learning.packing import Layout
from gyro_pipeline.parameters import NetworkSizes, Training

_FIXED_ARGUMENTS = ("gyroscopes", "window", "rate_hz")


@dataclass(frozen=True)
class Design:
    """A network that can be built; equal designs and seeds give equal networks.

    Attributes:
        path: ``package.module:Class`` of an ``nn.Module`` of (gyroscopes, window, ``**options``),
            whose ``forward`` takes scaled windows (n, gyroscopes, window) to biases
            (n, gyroscopes).
        gyroscopes: Channels of a window.
        window: Samples of a window.
        options: All other arguments.
    """

    path: str
    gyroscopes: int
    window: int
    options: Mapping[str, Any]

    @property
    def layout(self) -> Layout:
        """The memory layout of windows."""
        if network_class(self.path) is not CalibrationNetwork:
            return Layout(self.gyroscopes, self.window)
        packed = Architecture(self.gyroscopes, self.window, **self.options)
        return Layout(self.gyroscopes, self.window, packed)

    def build(self, seed: int) -> nn.Module:
        """The network with its initial weights, without touching the global random state.

        Raises:
            InputError: The class does not accept the options or the window.
        """
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            try:
                return network_class(self.path)(self.gyroscopes, self.window, **self.options)
            except (TypeError, ValueError, RuntimeError) as error:
                raise InputError(f"{self}: {error}") from error

    def check(self) -> None:
        """Refuse a network that cannot be built or does not return a bias for each gyroscope.

        Raises:
            InputError: The error of the class, or the expected and the actual output.
        """
        windows = torch.zeros((2, self.gyroscopes, self.window))
        try:
            outputs = self.build(0).eval()(windows)
        except (TypeError, ValueError, RuntimeError, NotImplementedError) as error:
            raise InputError(f"{self}: windows {tuple(windows.shape)}: {error}") from error
        shape = getattr(outputs, "shape", type(outputs).__name__)
        if shape != windows.shape[:2]:
            expected = tuple(windows.shape[:2])
            raise InputError(f"{self}: expected an output of shape {expected}, got {shape}")

    def __str__(self) -> str:
        """The class with its arguments, as a Python expression."""
        options = "".join(f", {name}={value!r}" for name, value in self.options.items())
        return f"{self.path}({self.gyroscopes}, {self.window}{options})"


def network_class(path: str) -> type[nn.Module]:
    """The class of a network by its name, ``package.module:Class``."""
    module, _, name = path.partition(":")
    kind: type[nn.Module] = getattr(importlib.import_module(module), name)
    return kind


def is_network(kind: object) -> bool:
    """Whether an object is a class of networks."""
    return isinstance(kind, type) and issubclass(kind, nn.Module)


def options_of(
    path: str, sizes: NetworkSizes, chosen: Mapping[str, Any], rate_hz: float | None = None
) -> dict[str, Any]:
    """All arguments of a network besides the shape of its windows.

    Args:
        path: Path of the class.
        sizes: Values of options without a default, which the paper leaves open.
        chosen: Options that the user chose.
        rate_hz: Samples per second, for a class with an argument of this name.

    Raises:
        InputError: The class has no such option.
    """
    arguments = inspect.signature(network_class(path)).parameters.values()
    variadic = (inspect.Parameter.VAR_POSITIONAL, inspect.Parameter.VAR_KEYWORD)
    named = [argument for argument in arguments if argument.kind not in variadic]
    options = {
        argument.name: argument.default
        for argument in named
        if argument.name not in _FIXED_ARGUMENTS
    }
    unknown = [] if len(named) < len(arguments) else [*chosen.keys() - options.keys()]
    if clash := options.keys() & Training.model_fields.keys() - NetworkSizes.model_fields.keys():
        raise InputError(f"{path}: {clash.pop()!r} is a setting of training; rename the option")
    if unknown:
        raise InputError(f"{path} has no option {unknown[0]!r}; it has {', '.join(options)}")
    for name, default in options.items():
        if default is inspect.Parameter.empty and name in NetworkSizes.model_fields:
            options[name] = getattr(sizes, name)
    options |= chosen
    lacking = [name for name, value in options.items() if value is inspect.Parameter.empty]
    if lacking:
        raise InputError(f"{path}: option {lacking[0]!r} has no default; give it a value")
    wants_rate = rate_hz is not None and "rate_hz" in {argument.name for argument in named}
    return options | ({"rate_hz": rate_hz} if wants_rate else {})
