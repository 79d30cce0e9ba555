"""Stand-in until the quality control is merged."""

from dataclasses import dataclass

import numpy as np

from gyro_pipeline.logs import KEPT, REJECTED, REPAIRED, Finding, Log
from gyro_pipeline.parameters import Quality


@dataclass(frozen=True)
class Inspected:
    """What quality control says about a recording."""

    outcome: str
    start: int
    stop: int
    findings: tuple[Finding, ...]


def inspect(log: Log, rate_hz: float, quality: Quality) -> Inspected:
    """Longest finite stretch."""
    bad = ~np.isfinite(log.samples).all(1)
    edges = np.flatnonzero(np.diff(np.concatenate(([True], bad, [True])).astype(int)))
    starts, stops = edges[::2], edges[1::2]
    if not starts.size or (np.ptp(log.samples[~bad], axis=0) == 0).any():
        return Inspected(REJECTED, 0, 0, (*log.findings, Finding("constant", REJECTED, "no")))
    longest = (stops - starts).argmax()
    found = log.findings
    if bad.any():
        found += (Finding("non-finite values", REPAIRED, f"{bad.sum()} rows"),)
    worst = [o for o in (REJECTED, REPAIRED, KEPT) if o in {f.outcome for f in found}]
    return Inspected((worst or [KEPT])[0], int(starts[longest]), int(stops[longest]), found)
