"""Why recordings were rejected, for messages."""

import re

import pandas as pd

NAMED = 10
"""So many are named in a message; all are in the table of their quality."""


def reasons(rejected: pd.DataFrame) -> list[str]:
    """Why recordings were rejected, each reason once, with the recordings that it is of.

    Args:
        rejected: Rows of the table of quality: ``imu, recording, file, findings``.
    """
    texts = [
        re.sub(rf"file: .*?{re.escape(file)}", "file", str(findings))  # its path says no reason
        for file, findings in zip(rejected.file, rejected.findings, strict=True)
    ]
    lines = []
    for reason, alike in rejected.groupby(pd.Series(texts, rejected.index), sort=False):
        row, more = alike.iloc[0], f", and {len(alike) - 1} more" if len(alike) > 1 else ""
        lines.append(f"IMU {row.imu} recording {row.recording}, {row.file}{more}: {reason}")
    further = len(lines) - NAMED
    rest = [f"and {further} other reasons, in the table of their quality"] if further > 0 else []
    return lines[:NAMED] + rest
