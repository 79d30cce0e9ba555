"""Tables as CSV or Parquet files."""

from pathlib import Path

import pandas as pd
from kedro_datasets._typing import TablePreview

from gyro_pipeline.datasets.stored import StoredFile
from gyro_pipeline.tracking import FINGERPRINT


class Table(StoredFile):
    """Stores a table without its index; numbers are read back exactly.

    The file is a ``.csv`` or, for long tables, a ``.parquet``. Only an empty cell is a missing
    value.
    """

    def preview(self, nrows: int = 40) -> TablePreview:
        """Show the first rows in Kedro-Viz.

        Args:
            nrows: Number of rows.
        """
        return TablePreview(read_table(self._filepath).head(nrows).to_dict(orient="split"))

    def _read(self, path: Path) -> pd.DataFrame:
        return read_table(path)

    def _write(self, data: pd.DataFrame, path: Path) -> None:
        write_table(data, path)


def write_table(data: pd.DataFrame, path: Path) -> None:
    """Write a table without its index."""
    write = data.to_parquet if path.suffix == ".parquet" else data.to_csv
    write(path, index=False)


def read_table(path: Path) -> pd.DataFrame:
    """Read a table that :func:`write_table` wrote."""
    if path.suffix == ".parquet":
        return pd.read_parquet(path)
    texts = {FINGERPRINT: str}  # some fingerprints look like numbers
    return pd.read_csv(path, keep_default_na=False, na_values=[""], dtype=texts)
