"""Estimators: functions from a window to a bias and its standard deviation.

Only the estimator that is used is imported: a list of names does not need PyTorch.
"""

import importlib
import json
from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, Any

from gyro_pipeline.conventions import InputError

if TYPE_CHECKING:
    from gyro_pipeline.estimators.base import Estimator
    from gyro_pipeline.parameters import Training

_HERE = "gyro_pipeline.estimators."
_LEARNING = "gyro_pipeline.learning."

ESTIMATORS: Mapping[str, tuple[str, Mapping[str, Any]]] = {
    "mean": (f"{_HERE}averages:RunningMean", {}),
    "median": (f"{_HERE}averages:Median", {}),
    "trimmed_mean": (f"{_HERE}averages:TrimmedMean", {}),
    "training_mean": (f"{_HERE}shrinkage:TrainingMean", {}),
    "last_calibration": (f"{_HERE}shrinkage:LastCalibration", {}),
    "empirical_bayes": (f"{_HERE}shrinkage:EmpiricalBayes", {}),
    "empirical_bayes_pooled": (f"{_HERE}shrinkage:PooledEmpiricalBayes", {}),
    "best_linear": (f"{_HERE}linear:BestLinear", {"warm_up": None}),
    "best_linear_fallback": (f"{_HERE}linear:BestLinear", {"warm_up": None, "fallback": True}),
    "best_linear_allan": (f"{_HERE}linear:BestLinear", {"noise": "allan"}),
    "best_linear_warm_up": (f"{_HERE}linear:BestLinear", {"warm_up": True}),
    "best_linear_history": (f"{_HERE}linear:BestLinear", {"history": True}),
    "ridge": (f"{_HERE}linear:Ridge", {}),
    "ridge_same_time": (f"{_HERE}linear:Ridge", {"same_time": True}),
    "window_mean_network": (f"{_HERE}networks:WindowMeanNetwork", {}),
    "residual_network": (f"{_HERE}networks:ResidualNetwork", {}),
    "single_gyroscope": (f"{_LEARNING}network:SingleGyroscope", {}),
    "lstm": (f"{_LEARNING}sequences:LSTM", {}),
    "tcn": (f"{_LEARNING}sequences:TCN", {}),
    "cnn": (f"{_LEARNING}network:CalibrationNetwork", {}),
    "cnn_shuffled": (f"{_LEARNING}network:CalibrationNetwork", {"shuffled": True}),
}
"""The class and the options of each estimator, by its name in runs and tables.

A class is an :class:`~gyro_pipeline.estimators.base.Estimator`, or an ``nn.Module``, which
:class:`~gyro_pipeline.estimators.nn_module.ModuleEstimator` trains.
"""

DEFAULT = "best_linear"
"""The default choice: its sigma holds on coloured noise as well, and it models a warm-up, and a
correlation between axes, if the recordings show one."""

ORIENTATION_NOTE = (
    "uses a stored prior, which holds only in the orientation and at the latitude it was learned in"
)


def entry(name: str) -> str:
    """The path of the class of an estimator, ``package.module:Class``.

    Args:
        name: One of ``ESTIMATORS``, or ``package.module:Class`` of a user's estimator or network;
            settings may follow, as in ``cnn learning_rate=0.001 channels=16``.

    Raises:
        InputError: The name is neither.
    """
    word = name.partition(" ")[0]
    path, _ = ESTIMATORS.get(word, (word, {}))
    module, _, kind = path.partition(":")
    if not (module and kind):
        raise InputError(
            f"unknown estimator {word!r}; expected one of {', '.join(ESTIMATORS)}, or your own as "
            "package.module:Class"
        )
    return path


def own_classes(names: Iterable[str]) -> list[str]:
    """Paths of the estimators in a list that are a user's, ``package.module:Class``."""
    return sorted({entry(name) for name in names if name.partition(" ")[0] not in ESTIMATORS})


def named_settings(name: str) -> dict[str, Any]:
    """The settings that follow the word in the name of an estimator.

    Raises:
        InputError: A setting is not of the form key=value, or is there twice.
    """
    settings = {}
    for part in name.split()[1:]:
        key, equals, text = part.partition("=")
        if not (key and equals and text) or key in settings:
            raise InputError(f"estimator {name!r}: expected key=value once, got {part!r}")
        try:
            settings[key] = json.loads(text)
        except ValueError:  # a word, such as per_device
            settings[key] = text
    return settings


def named_class(name: str) -> type:
    """The class of an estimator or a network.

    Args:
        name: As for :func:`entry`.

    Raises:
        InputError: There is no such class.
    """
    module, _, kind = entry(name).partition(":")
    try:
        imported: type = getattr(importlib.import_module(module), kind)
    except (ModuleNotFoundError, AttributeError) as error:
        raise InputError(
            f"estimator {name!r}: {error}; expected package.module:Class, of a module that Python "
            "finds, such as a file in src"
        ) from error
    return imported


def estimator_class(name: str) -> "type[Estimator]":
    """The class of an estimator; for a network, the class that trains it.

    Args:
        name: As for :func:`entry`.

    Raises:
        InputError: There is no such class, or it is neither an estimator nor a network.
    """
    from gyro_pipeline.estimators.base import Estimator  # noqa: PLC0415 - takes xarray

    named = named_class(name)
    if isinstance(named, type) and issubclass(named, Estimator):
        return named
    from gyro_pipeline.estimators.nn_module import ModuleEstimator  # noqa: PLC0415 - PyTorch
    from gyro_pipeline.learning.design import is_network  # noqa: PLC0415

    if is_network(named):
        return ModuleEstimator
    raise InputError(
        f"estimator {name!r}: expected a subclass of gyro_pipeline.estimators.base.Estimator or of "
        f"torch.nn.Module, got {named!r}"
    )


def make_estimator(name: str, training: "Training", seed: int) -> "Estimator":
    """Make an estimator that is not fitted yet.

    Args:
        name: As for :func:`entry`. Settings that are fields of ``training`` replace them; others
            are options of the estimator or network.
        training: Sizes and schedule of a network, used only by seeded estimators.
        seed: Seed of a seeded estimator.

    Raises:
        InputError: There is no such estimator, or a setting is unknown.
    """
    kind: Any = estimator_class(name)
    options = named_settings(name)
    _, fixed = ESTIMATORS.get(name.partition(" ")[0], (name, {}))
    try:
        if not kind.seeded:
            return kind(**{**fixed, **options})
        changes = {key: options.pop(key) for key in [*options] if key in training.schedule}
        settings = training.model_validate(training.model_dump() | changes)
        network = {} if issubclass(named_class(name), kind) else {"network": entry(name)}
        estimator = kind(training=settings, seed=seed, **network, **fixed, **options)
    except (TypeError, ValueError) as error:
        raise InputError(f"estimator {name!r}: {' '.join(str(error).split())}") from error
    estimator.settings = estimator.settings or settings.model_dump()
    return estimator


def settings_of(name: str, training: "Training") -> dict[str, Any]:
    """The settings of a seeded estimator, which are stored with runs; empty for any other.

    Args:
        name: As for :func:`entry`.
        training: As for :func:`make_estimator`.
    """
    seeded = estimator_class(name).seeded
    return dict(make_estimator(name, training, seed=0).settings) if seeded else {}
