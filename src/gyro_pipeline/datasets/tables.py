"""Tables as CSV or Parquet files."""

from pathlib import Path
from typing import Any

import pandas as pd
from kedro.io import AbstractDataset
from kedro_datasets._typing import TablePreview

from gyro_pipeline.datasets.atomic import check_made, replacing
from gyro_pipeline.tracking import FINGERPRINT


class Table(AbstractDataset[pd.DataFrame, pd.DataFrame]):
    """Keeps a table without its index; numbers come back exactly as they were.

    Args:
        filepath: The file, ``.csv`` or, for long tables, ``.parquet``.
        metadata: For other tools, such as Kedro-Viz.
    """

    def __init__(self, filepath: str, metadata: dict[str, Any] | None = None) -> None:
        self._filepath = Path(filepath)
        self.metadata = metadata

    def load(self) -> pd.DataFrame:
        """Read the table; an empty cell is a missing value, and nothing else is."""
        check_made(self._filepath)
        return read_table(self._filepath)

    def save(self, data: pd.DataFrame) -> None:
        """Write the table.

        Args:
            data: Its columns are stored, its index is not.
        """
        with replacing(self._filepath) as temporary:
            write = data.to_parquet if self._filepath.suffix == ".parquet" else data.to_csv
            write(temporary, index=False)

    def preview(self, nrows: int = 40) -> TablePreview:
        """Show the first rows in Kedro-Viz.

        Args:
            nrows: How many.

        Returns:
            Columns and rows as Kedro-Viz takes them.
        """
        return TablePreview(read_table(self._filepath).head(nrows).to_dict(orient="split"))

    def _exists(self) -> bool:
        return self._filepath.is_file()

    def _describe(self) -> dict[str, Any]:
        return {"filepath": str(self._filepath)}


def read_table(path: Path) -> pd.DataFrame:
    """Read a table that :class:`Table` wrote."""
    if path.suffix == ".parquet":
        return pd.read_parquet(path)
    texts = {FINGERPRINT: str}  # some look like numbers
    return pd.read_csv(path, keep_default_na=False, na_values=[""], dtype=texts)
