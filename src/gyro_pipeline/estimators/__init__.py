"""Estimators: a window in, a bias and its standard deviation out.

Nothing is imported but the estimator that is asked for: a list of names costs no PyTorch.
"""

import importlib
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from gyro_pipeline.conventions import InputError

if TYPE_CHECKING:
    from gyro_pipeline.estimators.base import Estimator
    from gyro_pipeline.parameters import Training

_HERE = "gyro_pipeline.estimators."

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
    "cnn": (f"{_HERE}paper_network:PaperNetwork", {}),
    "cnn_shuffled": (f"{_HERE}paper_network:PaperNetwork", {"shuffled": True}),
}
"""The class and the options of each estimator, by the name that runs and tables give it."""

DEFAULT = "best_linear"
"""What to use where nothing else is known: its sigma holds on coloured noise as well, and it models
a warm-up if the recordings show one."""

ORIENTATION_NOTE = (
    "uses a stored prior, which holds only in the orientation and at the latitude it was learned in"
)


def entry(name: str) -> str:
    """Where the class of an estimator is, as ``package.module:Class``.

    Args:
        name: One of ``ESTIMATORS``, or the same of an estimator of one's own.

    Raises:
        InputError: It is neither.
    """
    path, _ = ESTIMATORS.get(name, (name, {}))
    module, _, kind = path.partition(":")
    if not (module and kind):
        raise InputError(
            f"unknown estimator {name!r}; there are {', '.join(ESTIMATORS)}, and those of your "
            "own: package.module:Class"
        )
    return path


def estimator_class(name: str) -> "type[Estimator]":
    """The class of an estimator.

    Args:
        name: As for :func:`entry`.

    Raises:
        InputError: There is no such class, or it is no estimator.
    """
    from gyro_pipeline.estimators.base import Estimator  # noqa: PLC0415 - takes xarray

    module, _, kind = entry(name).partition(":")
    try:
        found = getattr(importlib.import_module(module), kind)
    except (ModuleNotFoundError, AttributeError) as error:
        raise InputError(
            f"estimator {name!r}: {error}; expected package.module:Class, of a module that Python "
            "finds, such as a file in src"
        ) from error
    if not (isinstance(found, type) and issubclass(found, Estimator)):
        raise InputError(
            f"estimator {name!r}: expected a subclass of gyro_pipeline.estimators.base.Estimator, "
            f"got {found!r}"
        )
    return found


def make_estimator(name: str, training: "Training", seed: int) -> "Estimator":
    """An estimator that is yet to be fitted.

    Args:
        name: As for :func:`entry`.
        training: Sizes and schedule of a network; only an estimator that is seeded gets them.
        seed: Likewise.

    Raises:
        InputError: There is no such estimator.
    """
    kind = estimator_class(name)
    _, options = ESTIMATORS.get(name, (name, {}))
    given = {"training": training, "seed": seed} if kind.seeded else {}
    return kind(**given, **options)
