"""What a tracked run is: the contract between the stages and the run store.

Parameter names are the fields of :class:`gyro_pipeline.studies.Cell` and the hyper-parameters;
metric names are built by :func:`metric_name`. Users query them: changing one breaks notebooks.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import pandas as pd

from gyro_pipeline.conventions import ALL, BEST, FIRST, LAST, PAPER

FINGERPRINT = "fingerprint"
"""Tag: hash of all that the training depends on. Equal fingerprints need one training."""

TRAINED_IN = "trained_in"
"""Tag: the study whose training this run shares."""

EVALUATED_WITH = "evaluated_with"
"""Tag: hash of how the run was evaluated. Another hash evaluates again, without training."""

WEIGHTS, HISTORY = "weights.pt", "history.csv"
ERRORS, CURVE = "errors.parquet", "running_mean_curve.parquet"
"""Artifacts of a run."""


@dataclass(frozen=True)
class TrainedRun:
    """What one training leaves: saved as a new run that still waits for its evaluation."""

    study: str
    params: Mapping[str, Any]
    tags: Mapping[str, str]
    started_ms: int
    ended_ms: int
    history: pd.DataFrame | None = None
    artifacts: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class EvaluatedRun:
    """What one evaluation adds to its run, which then is FINISHED."""

    run_id: str
    metrics: Mapping[str, float]
    tags: Mapping[str, str]
    artifacts: Mapping[str, Any]


@dataclass(frozen=True)
class StoredRun:
    """A trained run as the store has it; ``load(name)`` fetches one of its artifacts."""

    run_id: str
    experiment_id: str
    study: str
    finished: bool
    started_ms: int
    params: Mapping[str, str]
    tags: Mapping[str, str]
    metrics: Mapping[str, float]
    load: Callable[[str], Any]

    @property
    def fingerprint(self) -> str:
        """Hash of all that the training depended on."""
        return self.tags[FINGERPRINT]


def metric_name(
    base: str, windows: str = FIRST, weights: str = LAST, truth: str = PAPER, bound: str = ""
) -> str:
    """Name of a metric: the base and what differs from first window, last epoch, truth (a).

    Args:
        base: E.g. ``test_rmse_dps``.
        windows: ``first`` or ``all``.
        weights: ``last`` or ``best``.
        truth: ``paper``, ``disjoint`` or ``true``.
        bound: ``lo`` or ``hi`` for an end of the 95 % interval.
    """
    parts = [base]
    parts += [ALL] if windows == ALL else []
    parts += [BEST] if weights == BEST else []
    parts += [truth] if truth != PAPER else []
    parts += [bound] if bound else []
    return "_".join(parts)
