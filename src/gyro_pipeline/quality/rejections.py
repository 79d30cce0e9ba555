"""Summarises why recordings were rejected, for messages."""

import re

import pandas as pd

NAMED = 10
"""Most reasons in a message; the quality table has all of them."""


def reasons(rejected: pd.DataFrame) -> list[str]:
    """The reasons for which recordings were rejected, each once, with its first recording.

    Args:
        rejected: Rows of the quality table: ``imu, recording, file, findings``.
    """
    texts = [
        re.sub(rf"file: .*?{re.escape(file)}", "file", str(findings))  # paths differ by recording
        for file, findings in zip(rejected.file, rejected.findings, strict=True)
    ]
    lines = []
    for reason, rows in rejected.groupby(pd.Series(texts, rejected.index), sort=False):
        row, others = rows.iloc[0], f", and {len(rows) - 1} more" if len(rows) > 1 else ""
        lines.append(f"IMU {row.imu} recording {row.recording}, {row.file}{others}: {reason}")
    further = len(lines) - NAMED
    rest = [f"and {further} other reasons, in the table of their quality"] if further > 0 else []
    return lines[:NAMED] + rest
