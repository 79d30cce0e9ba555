"""Labelled arrays as netCDF files."""

from pathlib import Path
from typing import Any, Final

import numpy as np
import xarray as xr
from kedro.io import AbstractDataset

from gyro_pipeline.conventions import InputError, Missing
from gyro_pipeline.datasets.atomic import replacing

_ENGINE: Final = "h5netcdf"


class Recordings(AbstractDataset[xr.Dataset, xr.Dataset | Missing]):
    """Keeps recordings in one netCDF file and reads them lazily.

    What ``load`` returns stays in the file until values are asked for, and again afterwards, so
    it is small to hold and is handed to another process as a reference to the file.

    Args:
        filepath: The netCDF file.
        made_by: The command that makes it. Where it is given and there is no file, ``load``
            returns it as :class:`Missing`, so that a report can say what it lacks.
        metadata: For other tools, such as Kedro-Viz.
    """

    def __init__(
        self, filepath: str, made_by: str | None = None, metadata: dict[str, Any] | None = None
    ) -> None:
        self._filepath = Path(filepath)
        self._made_by = made_by
        self.metadata = metadata

    def load(self) -> xr.Dataset | Missing:
        """Open the file.

        Returns:
            What was saved, with the values still in the file.

        Raises:
            InputError: As the cause of Kedro's ``DatasetError``, a damaged file.
        """
        if self._made_by and not self._exists():
            return Missing((self._made_by,))
        return open_recordings(self._filepath)

    def save(self, data: xr.Dataset) -> None:
        """Write the file under a temporary name and rename it; open readers keep the old one.

        Args:
            data: Labelled arrays. It may itself be read from the same file.
        """
        # in place of the encodings that variables read from a file carry, which say how they were
        # stored there and not what they hold now
        encoding = {name: {"_FillValue": None} for name in data.variables}
        with replacing(self._filepath) as temporary:
            data.to_netcdf(temporary, engine=_ENGINE, encoding=encoding)

    def _exists(self) -> bool:
        return self._filepath.is_file()

    def _describe(self) -> dict[str, Any]:
        return {"filepath": str(self._filepath)}


def open_recordings(path: Path) -> xr.Dataset:
    """Open a file that :class:`Recordings` wrote, with the values still in it.

    Raises:
        InputError: A damaged file.
    """
    try:
        recordings = xr.open_dataset(
            path,
            engine=_ENGINE,
            cache=False,  # values once read would be pickled, and kept in memory
        )
    except FileNotFoundError:
        raise
    except Exception as error:  # a damaged file fails in many ways
        raise InputError(
            f"{path}: expected a netCDF file written by this project, but: {error}. "
            "It is damaged; delete it and run the pipeline that makes it again"
        ) from error
    # netCDF gives NumPy numbers, which JSON does not take
    recordings.attrs = {name: _plain(value) for name, value in recordings.attrs.items()}
    return recordings


def _plain(value: Any) -> Any:
    return value.item() if isinstance(value, np.generic) else value
