"""Estimators: a window in, a bias and its standard deviation out."""

from collections.abc import Callable, Mapping

from gyro_pipeline.estimators.averages import Median, RunningMean, TrimmedMean
from gyro_pipeline.estimators.base import (
    ORIENTATION_NOTE,
    Estimates,
    Estimator,
    FittedEstimator,
)
from gyro_pipeline.estimators.linear import BestLinear, Ridge
from gyro_pipeline.estimators.networks import ResidualNetwork, WindowMeanNetwork
from gyro_pipeline.estimators.shrinkage import EmpiricalBayes, LastCalibration, TrainingMean
from gyro_pipeline.estimators.training import TrainingRecordings

__all__ = [
    "DEFAULT",
    "ESTIMATORS",
    "ORIENTATION_NOTE",
    "BestLinear",
    "EmpiricalBayes",
    "Estimates",
    "Estimator",
    "FittedEstimator",
    "LastCalibration",
    "Median",
    "ResidualNetwork",
    "Ridge",
    "RunningMean",
    "TrainingMean",
    "TrainingRecordings",
    "TrimmedMean",
    "WindowMeanNetwork",
]

ESTIMATORS: Mapping[str, Callable[[], FittedEstimator]] = {
    "mean": RunningMean,
    "median": Median,
    "trimmed_mean": TrimmedMean,
    "training_mean": TrainingMean,
    "last_calibration": LastCalibration,
    "empirical_bayes": EmpiricalBayes,
    "empirical_bayes_pooled": lambda: EmpiricalBayes(pooled=True),
    "best_linear": BestLinear,
    "best_linear_allan": lambda: BestLinear(noise="allan"),
    "best_linear_warm_up": lambda: BestLinear(warm_up=True),
    "best_linear_history": lambda: BestLinear(history=True),
    "ridge": Ridge,
    "ridge_same_time": lambda: Ridge(same_time=True),
    "window_mean_network": WindowMeanNetwork,
    "residual_network": ResidualNetwork,
}
"""All estimators but the paper's network, by the name that runs and tables give them."""

DEFAULT = "best_linear"
"""What to use where nothing else is known: its sigma holds on coloured noise as well."""
