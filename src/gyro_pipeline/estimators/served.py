"""The model of a run for MLflow: the ``loader_module`` of a pyfunc model.

``mlflow.pyfunc.load_model(uri).predict(windows)`` takes a float64 array of windows (n, gyroscopes,
samples) in deg/s. Its parameters are ``target``, ``"bias"`` or ``"recording_mean"``, and
``start_s``, a list with the start of each window, or of all windows, in seconds after power-on.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from gyro_pipeline.conventions import BIAS

if TYPE_CHECKING:
    from gyro_pipeline.estimators.base import Estimator


class ServedEstimator:
    """A fitted estimator with the interface of MLflow's pyfunc models."""

    def __init__(self, estimator: "Estimator") -> None:
        self.estimator = estimator

    def predict(
        self, model_input: np.ndarray, params: Mapping[str, Any] | None = None
    ) -> dict[str, np.ndarray]:
        """Estimate the biases of windows.

        Args:
            model_input: (n, gyroscopes, samples), deg/s.
            params: ``target`` and ``start_s``, both optional.

        Returns:
            ``bias_dps`` and ``sigma_dps``, each (n, gyroscopes), deg/s; NaN where the estimator
            gives no standard deviation.
        """
        options = {"target": BIAS, "start_s": [0.0]} | dict(params or {})
        bias, sigma = self.estimator.estimate(
            np.asarray(model_input), target=options["target"], start_s=options["start_s"]
        )
        return {"bias_dps": np.array(bias), "sigma_dps": np.array(sigma)}


def _load_pyfunc(path: str) -> ServedEstimator:
    """Load the model's data folder; MLflow calls it by this name."""
    from gyro_pipeline.estimators.base import Estimator  # noqa: PLC0415 - imports estimators

    return ServedEstimator(Estimator.load(Path(path)))
