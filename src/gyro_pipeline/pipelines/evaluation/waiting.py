"""Which runs of a plan wait for their evaluation."""

import logging
from collections.abc import Iterator, Sequence
from typing import Any

import pandas as pd

from gyro_pipeline.tracking import EVALUATED_WITH, FINGERPRINT, StoredRun

logger = logging.getLogger(__name__)


def waiting(
    cells: pd.DataFrame, runs: Sequence[StoredRun], judged_with: str, label: str
) -> Iterator[tuple[dict[Any, Any], StoredRun]]:
    """The runs of a plan that were not judged this way before; how many is logged at the end.

    Args:
        cells: The plan.
        runs: The study's trained runs, newest first.
        judged_with: Hash of how runs are judged now.
        label: What the log calls the plan.

    Yields:
        The cell and its run.
    """
    trained = {run.fingerprint: run for run in reversed(runs)}
    judged = 0
    for cell in cells.to_dict("records"):
        run = trained[cell[FINGERPRINT]]
        if run.finished and run.tags.get(EVALUATED_WITH) == judged_with:
            continue
        yield cell, run
        judged += 1
    logger.info("%s: %d runs evaluated, %d skipped", label, judged, len(cells) - judged)
