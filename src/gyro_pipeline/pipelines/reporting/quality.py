"""The table of how the raw logs were found."""

from collections import Counter
from typing import Any

import pandas as pd

from gyro_pipeline.conventions import Missing
from gyro_pipeline.logs import KEPT, REJECTED, REPAIRED

_WORST_FIRST = (REJECTED, REPAIRED, KEPT)
_SHOWN = 20
"""So many recordings of a sensor have a row of their own."""


def recording_quality(
    **tables: pd.DataFrame | Missing,
) -> tuple[pd.DataFrame | Missing, tuple[str, ...]]:
    """How many recordings were kept, repaired and rejected, and those that something was found in.

    Args:
        **tables: Of the raw-logs stage, a row per IMU and recording; those that are there are used.

    Returns:
        A row per sensor, and below it the recordings that are not simply kept, the worst first.
        Nothing is named as lacking: what lacks this table lacks the recordings as well.
    """
    there = [table for table in tables.values() if isinstance(table, pd.DataFrame)]
    rows = [row for table in there for row in _of_sensor(table)]
    return (pd.DataFrame(rows) if rows else Missing(())), ()


def _of_sensor(table: pd.DataFrame) -> list[dict[str, Any]]:
    counts, used = Counter(table.outcome), (table.stop - table.start).dropna()
    noted = table[(table.outcome != KEPT) | table.findings.notna()]
    noted = noted.sort_values("outcome", key=lambda one: one.map(_WORST_FIRST.index), kind="stable")
    rows = [
        {
            "Sensor": table.sensor.iloc[0],
            "IMU": f"all {table.imu.nunique()}",
            "Recording": f"all {len(table)}",
            "File": None,
            "Outcome": ", ".join(f"{counts[outcome]} {outcome}" for outcome in _WORST_FIRST[::-1]),
            "Rows used": _range(used) if len(used) else "none",
            "Findings": f"in {len(noted)} recordings" if len(noted) else "none",
        }
    ]
    rows += [_of_recording(row) for _, row in noted.head(_SHOWN).iterrows()]
    if len(noted) > _SHOWN:
        rest = {name: None for name in rows[0]} | {"Sensor": rows[0]["Sensor"]}
        rows.append(rest | {"Findings": f"in {len(noted) - _SHOWN} further recordings"})
    return rows


def _range(rows: pd.Series) -> str:
    """How many rows the shortest and the longest recording have."""
    lowest, highest = f"{rows.min():.0f}", f"{rows.max():.0f}"
    return f"{lowest} of each" if lowest == highest else f"{lowest} to {highest}"


def _of_recording(row: pd.Series) -> dict[str, Any]:
    used = "none" if pd.isna(row.stop) else f"{row.start:.0f} to {row.stop - 1:.0f}"
    return {
        "Sensor": row.sensor,
        "IMU": str(row.imu),
        "Recording": str(row.recording),
        "File": row.file,
        "Outcome": row.outcome,
        "Rows used": f"{used} of {row.rows}",
        "Findings": row.findings,
    }
