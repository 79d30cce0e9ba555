"""What a tracked run is: the contract between the stages and the run store.

One row of a study is one run. Parameter names are the fields of its run spec and the
hyper-parameters; metric names are those of :class:`EvaluatedRun`. Users query them: changing one
breaks notebooks.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from gyro_pipeline.estimators.base import Estimator

LAYOUT = "3"
"""Layout of runs. Earlier ones carry no such tag and are never read: their metrics meant else."""

LAYOUT_TAG = "layout"

FINGERPRINT = "fingerprint"
"""Tag: hash of all that the fits depend on. Equal fingerprints need one run."""

EVALUATED_WITH = "evaluated_with"
"""Tag: hash of how the run was evaluated. Another hash evaluates again, without training."""

HISTORY, SCORES, ERRORS = "history.csv", "scores.csv", "errors.parquet"
CURVE = "running_mean_curve.parquet"
"""Artifacts of a run."""

DESCRIPTION = "mlflow.note.content"
"""Tag: the description of a run, a model or an experiment in MLflow's user interface."""

MODEL = "model"
"""Name of the model of a run: ``mlflow.pyfunc.load_model("runs:/RUN/model")``."""


@dataclass(frozen=True)
class RunIdentity:
    """The run that a fit belongs to.

    Attributes:
        study: Name of the MLflow experiment.
        fingerprint: Hash of all that the fits depend on.
        params: What the row of the study asks for.
        tags: More marks, to filter by.
        folds: Folds of the protocol; the run is trained when each has its fit.
        name: What a list of runs shows.
        note: Two sentences on what was trained on what.
    """

    study: str
    fingerprint: str
    params: Mapping[str, Any]
    tags: Mapping[str, str]
    folds: tuple[str, ...]
    name: str
    note: str


@dataclass(frozen=True)
class FittedRun:
    """One fit of a run: saved as it ends, so that a kill loses only what was running.

    Attributes:
        run: The run that the fit belongs to.
        fold: One of the folds of the run.
        estimator: The fitted estimator.
        started_ms: When fitting began, milliseconds since 1970.
        ended_ms: When it ended.
        is_model: Whether this fit is the one that users of the run load.
        example: A few windows (n, gyroscopes, samples), deg/s, to try the model with.
        dataset: ``name``, ``digest`` and ``source`` of the recordings, and more to show.
    """

    run: RunIdentity
    fold: str
    estimator: "Estimator"
    started_ms: int
    ended_ms: int
    is_model: bool
    example: np.ndarray
    dataset: Mapping[str, str]


@dataclass(frozen=True)
class EvaluatedRun:
    """What an evaluation adds to its run, which then is FINISHED.

    Attributes:
        run_id: The run.
        metrics: ``rmse_mdps``, ``mean_rmse_mdps``, ``ceiling_rmse_mdps``, ``accuracy_gain_pct``
            with ``_lo`` and ``_hi``, ``time_saving_pct``, ``equivalent_time_s``,
            ``coverage_95_pct``, ``train_loss``, ``val_loss``: over all windows, with the weights
            of the last epoch; ``accuracy_gain_pct_first`` and ``time_saving_pct_first``: over the
            first window of each recording, the paper's way.
        tags: Among them EVALUATED_WITH.
        artifacts: By file name: SCORES, ERRORS.
    """

    run_id: str
    metrics: Mapping[str, float]
    tags: Mapping[str, str]
    artifacts: Mapping[str, Any]


@dataclass(frozen=True)
class StoredRun:
    """A run as the store has it.

    Attributes:
        finished: Whether it was evaluated.
        trained: Whether it has the fits of all its folds; an untrained run can be continued.
        fits: The folds whose fits are stored.
        load: Fetches an artifact by its name.
        load_fit: Fetches the fitted estimator of a fold.
    """

    run_id: str
    experiment_id: str
    study: str
    finished: bool
    trained: bool
    started_ms: int
    params: Mapping[str, str]
    tags: Mapping[str, str]
    metrics: Mapping[str, float]
    fits: frozenset[str]
    load: Callable[[str], Any]
    load_fit: Callable[[str], "Estimator"]

    @property
    def fingerprint(self) -> str:
        """Hash of all that the fits depend on."""
        return self.tags[FINGERPRINT]
