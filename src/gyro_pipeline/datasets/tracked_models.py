"""The model of a run, as MLflow stores and serves it."""

import logging
from importlib.metadata import version
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import mlflow.pyfunc
import numpy as np
from mlflow import MlflowClient
from mlflow.entities import LoggedModelOutput, Run
from mlflow.models import Model, ModelSignature
from mlflow.types import ParamSchema, ParamSpec, Schema, TensorSpec

from gyro_pipeline.conventions import BIAS
from gyro_pipeline.datasets.stored import digest_of
from gyro_pipeline.estimators.base import Estimator
from gyro_pipeline.fingerprints import own_code
from gyro_pipeline.tracking import DESCRIPTION, MODEL

# MLflow logs for every model that its example is valid.
logging.getLogger("mlflow.pyfunc").setLevel(logging.WARNING)

_FIT = "fit"
_REQUIREMENTS = ("gyro-pipeline", "numpy", "torch", "xarray")
_EXAMPLE_DECIMALS = 6  # of the example, in deg/s, as it is stored as text

_DOUBLE = np.dtype(np.float64)
_SIGNATURE = ModelSignature(
    inputs=Schema([TensorSpec(_DOUBLE, (-1, -1, -1))]),
    outputs=Schema([TensorSpec(_DOUBLE, (-1, -1), name) for name in ("bias_dps", "sigma_dps")]),
    params=ParamSchema(
        [ParamSpec("target", "string", BIAS), ParamSpec("start_s", "double", [0.0], (-1,))]
    ),
)


def log_model(client: MlflowClient, run: Run, estimator: Estimator, example: np.ndarray) -> str:
    """Store a fit as the model of a run, replacing an incomplete one.

    Args:
        client: Client of the run's store.
        run: A run without a complete model.
        estimator: The fit.
        example: Windows (n, gyroscopes, samples), deg/s; the first becomes the input example.

    Returns:
        The digest of the fit.
    """
    model_id = model_of(run) or _new_model(client, run, estimator)
    with TemporaryDirectory() as folder:
        fit, model = Path(folder, _FIT), Path(folder, MODEL)
        fit.mkdir()
        estimator.save(fit)
        mlflow.pyfunc.save_model(
            model,
            loader_module="gyro_pipeline.estimators.served",
            data_path=fit,
            code_paths=[str(path) for path in own_code(estimator.source.__module__)] or None,
            mlflow_model=Model(artifact_path=MODEL, run_id=run.info.run_id, model_id=model_id),
            signature=_SIGNATURE,
            input_example=np.round(example[:1].astype(np.float64), _EXAMPLE_DECIMALS),
            pip_requirements=[f"{name}=={version(name)}" for name in _REQUIREMENTS],
        )
        digest = digest_of(model / "data" / _FIT)
        client.log_model_artifacts(model_id, str(model))
    client.finalize_logged_model(model_id, "READY")
    return digest


def model_fit_uri(client: MlflowClient, run: Run) -> str:
    """Address of the fit in the model of a run."""
    return f"{client.get_logged_model(str(model_of(run))).artifact_location}/data/{_FIT}"


def model_of(run: Run) -> str | None:
    """Id of the model of a run; None without a model."""
    outputs = run.outputs.model_outputs if run.outputs else []
    return outputs[0].model_id if outputs else None


def _new_model(client: MlflowClient, run: Run, estimator: Estimator) -> str:
    model: Any = client.create_logged_model(
        run.info.experiment_id,
        name=MODEL,
        source_run_id=run.info.run_id,
        tags={DESCRIPTION: run.data.tags[DESCRIPTION]},
        params=run.data.params,
        model_type=estimator.source.__name__,
    )
    client.log_outputs(run.info.run_id, [LoggedModelOutput(model.model_id, 0)])
    return str(model.model_id)
