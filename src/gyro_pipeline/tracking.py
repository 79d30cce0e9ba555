"""Tracked runs: the contract between the stages and the run store.

Each distinct training of a study is a run, which several rows may share. The parameters of a run
are the fields of its run spec and the hyper-parameters; its metrics are listed in
:class:`EvaluatedRun`. Users query these names, so changing one breaks their notebooks.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from gyro_pipeline.estimators.base import Estimator

LAYOUT = "3"
"""Layout of runs. Older runs lack the tag and are never read: their metrics mean something else."""

LAYOUT_TAG = "layout"

FINGERPRINT = "fingerprint"
"""Tag: hash of everything that the fits depend on. Rows with equal fingerprints share a run."""

EVALUATED_WITH = "evaluated_with"
"""Tag: hash of everything that the evaluation depends on. If it changes, the run is evaluated again
without training."""

HISTORY, SCORES, ERRORS = "history.csv", "scores.csv", "errors.parquet"
CURVE = "running_mean_curve.parquet"
"""Artifacts of a run."""

DESCRIPTION = "mlflow.note.content"
"""Tag: the description of a run, a model or an experiment in MLflow's user interface."""

MODEL = "model"
"""Name of the model of a run: ``mlflow.pyfunc.load_model("runs:/RUN/model")``."""


@dataclass(frozen=True)
class RunIdentity:
    """Identity and description of a run.

    Attributes:
        study: Name of the MLflow experiment.
        fingerprint: Hash of everything that the fits depend on.
        params: Parameters of the row of the study.
        tags: Further tags to filter by.
        folds: Folds of the protocol; a run is trained when each has its fit.
        name: Name in lists of runs.
        note: Two sentences that describe the estimator and its training set.
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
    """A fit of a run, saved as soon as it ends, so that a kill loses only unfinished fits.

    Attributes:
        run: The run.
        fold: The fold of the run.
        estimator: The fitted estimator.
        started_ms: Start of fitting, milliseconds since 1970.
        ended_ms: End of fitting, milliseconds since 1970.
        is_model: Whether this fit is the one that users of the run load.
        example: A few example windows (n, gyroscopes, samples), deg/s.
        dataset: ``name``, ``digest`` and ``source`` of the recordings, and further information.
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
    """The results of an evaluation, which make its run FINISHED.

    Attributes:
        run_id: MLflow's id of the run.
        metrics: ``rmse_mdps``, ``mean_rmse_mdps``, ``ceiling_rmse_mdps``, ``accuracy_gain_pct``
            with ``_lo`` and ``_hi``, ``time_saving_pct``, ``equivalent_time_s``,
            ``coverage_95_pct``, ``train_loss``, ``val_loss``: over all windows, with the weights
            of the last epoch; ``accuracy_gain_pct_first`` and ``time_saving_pct_first``: over the
            first window of each recording, the paper's way.
        tags: Tags, including EVALUATED_WITH.
        artifacts: Artifacts by file name: SCORES, ERRORS and, of the running mean, CURVE.
    """

    run_id: str
    metrics: Mapping[str, float]
    tags: Mapping[str, str]
    artifacts: Mapping[str, Any]


@dataclass(frozen=True)
class StoredRun:
    """A run in the store.

    Attributes:
        finished: Whether it was evaluated.
        trained: Whether the fits of all its folds are stored; otherwise it can be continued.
        fits: The folds whose fits are stored.
        load: Loads an artifact by its name.
        load_fit: Loads the fitted estimator of a fold.
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
        """Hash of everything that the fits depend on."""
        return self.tags[FINGERPRINT]


def by_fingerprint(runs: Sequence[StoredRun]) -> dict[str, StoredRun]:
    """The newest run with each fingerprint, from runs as the store lists them: newest first."""
    return {run.fingerprint: run for run in reversed(runs)}
