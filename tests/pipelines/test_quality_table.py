import pandas as pd
import pytest

from gyro_pipeline.pipelines.reporting.recordings import recording_quality


def quality(*rows, sensor="dot"):
    """A table of the raw-logs stage, from outcome and findings of each IMU's one recording."""
    return pd.DataFrame(
        {
            **{"sensor": sensor, "imu": imu, "recording": 1, "file": f"{imu}.csv"},
            **{"outcome": outcome, "rows": 130, "rate_hz": 120.0, "findings": findings},
            "start": None if outcome == "rejected" else 1,
            "stop": None if outcome == "rejected" else 120,
        }
        for imu, (outcome, findings) in enumerate(rows, 1)
    )


@pytest.fixture
def five():
    return quality(
        ("kept", "zero rows: row 0, cut"),
        ("kept", None),
        ("rejected", "motion: rows 5 to 9"),
        ("repaired", "dropouts: row 120, cut"),
        ("kept", None),
    )


def test_counts_come_first_then_what_is_not_simply_kept_the_worst_first(five):
    table = recording_quality(five)
    assert table.fillna("").to_dict("list") == {
        "Sensor": ["dot"] * 4,
        "IMU": ["all 5", "3", "4", "1"],
        "Recording": ["all 5", "1", "1", "1"],
        "File": ["", "3.csv", "4.csv", "1.csv"],
        "Outcome": ["3 kept, 1 repaired, 1 rejected", "rejected", "repaired", "kept"],
        "Rows used": ["119 of each", "none of 130", "1 to 119 of 130", "1 to 119 of 130"],
        "Findings": [
            "in 3 recordings",
            "motion: rows 5 to 9",
            "dropouts: row 120, cut",
            "zero rows: row 0, cut",
        ],
    }
