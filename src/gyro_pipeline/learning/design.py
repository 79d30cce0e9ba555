"""Which network is trained: its class, by name, and what it is made with."""

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

_GIVEN = ("gyroscopes", "window", "rate_hz")


@dataclass(frozen=True)
class Design:
    """A network that can be built; equal designs and seeds give equal networks.

    Attributes:
        path: ``package.module:Class`` of an ``nn.Module`` of (gyroscopes, window, ``**options``),
            whose ``forward`` takes scaled windows (n, gyroscopes, window) to biases
            (n, gyroscopes).
        gyroscopes: Channels of a window.
        window: Samples.
        options: All of its other arguments.
    """

    path: str
    gyroscopes: int
    window: int
    options: Mapping[str, Any]

    @property
    def layout(self) -> Layout:
        """How its windows lie in memory."""
        if network_class(self.path) is not CalibrationNetwork:
            return Layout(self.gyroscopes, self.window)
        packed = Architecture(self.gyroscopes, self.window, **self.options)
        return Layout(self.gyroscopes, self.window, packed)

    def build(self, seed: int) -> nn.Module:
        """The network with its initial weights, without touching the global random state.

        Raises:
            InputError: The options or the window do not suit the class.
        """
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            try:
                return network_class(self.path)(self.gyroscopes, self.window, **self.options)
            except (TypeError, ValueError, RuntimeError) as error:
                raise InputError(f"{self}: {error}") from error

    def check(self) -> None:
        """Refuse a network that cannot be built, or returns no bias for each gyroscope.

        Raises:
            InputError: Saying what was expected.
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
        """The class and what it is made with, as Python would show it."""
        options = "".join(f", {name}={value!r}" for name, value in self.options.items())
        return f"{self.path}({self.gyroscopes}, {self.window}{options})"


def network_class(path: str) -> type[nn.Module]:
    """The class of a network by its name, ``package.module:Class``."""
    module, _, name = path.partition(":")
    kind: type[nn.Module] = getattr(importlib.import_module(module), name)
    return kind


def is_network(kind: object) -> bool:
    """Whether it is a class of networks."""
    return isinstance(kind, type) and issubclass(kind, nn.Module)


def options_of(
    path: str, sizes: NetworkSizes, given: Mapping[str, Any], rate_hz: float | None = None
) -> dict[str, Any]:
    """All that a network is made with, beside the shape of its windows.

    Args:
        path: Of its class.
        sizes: Values of options that have no default: those that the paper leaves open.
        given: Options that were asked for.
        rate_hz: Samples per second, for a class that has an argument of this name.

    Raises:
        InputError: The class has no such option.
    """
    arguments = inspect.signature(network_class(path)).parameters.values()
    any_number = (inspect.Parameter.VAR_POSITIONAL, inspect.Parameter.VAR_KEYWORD)
    named = [argument for argument in arguments if argument.kind not in any_number]
    options = {argument.name: argument.default for argument in named if argument.name not in _GIVEN}
    unknown = [] if len(named) < len(arguments) else [*given.keys() - options.keys()]
    if twice := options.keys() & Training.model_fields.keys() - NetworkSizes.model_fields.keys():
        raise InputError(f"{path}: {twice.pop()!r} is a setting of training; rename the option")
    if unknown:
        raise InputError(f"{path} has no option {unknown[0]!r}; it has {', '.join(options)}")
    for name, default in options.items():
        if default is inspect.Parameter.empty and name in NetworkSizes.model_fields:
            options[name] = getattr(sizes, name)
    options |= given
    lacking = [name for name, value in options.items() if value is inspect.Parameter.empty]
    if lacking:
        raise InputError(f"{path}: option {lacking[0]!r} has no default; give it a value")
    wants_rate = rate_hz is not None and "rate_hz" in {argument.name for argument in named}
    return options | ({"rate_hz": rate_hz} if wants_rate else {})
