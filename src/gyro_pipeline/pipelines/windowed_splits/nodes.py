"""Nodes of the windowed-splits stage. Windows are cut as views where they are used."""

import pandas as pd
import xarray as xr

from gyro_pipeline.parameters import Splits
from gyro_pipeline.protocol.splits import assign_roles


def split_recordings(recordings: xr.Dataset, splits: Splits) -> pd.DataFrame:
    """Roles of the recordings, by recording, before any window is cut.

    Args:
        recordings: With ``given_split`` where the source came split.
        splits: Counts and the seed.

    Returns:
        Columns ``fold, recording, role``.
    """
    numbers = recordings.recording.to_numpy().tolist()
    given = None
    if "given_split" in recordings:
        given = dict(zip(numbers, recordings.given_split.to_numpy().tolist(), strict=True))
    return assign_roles(numbers, splits, given)
