"""Labelled arrays as netCDF files, and recordings that arrive one by one."""

import json
import os
from collections.abc import Collection, Iterator, Mapping
from contextlib import suppress
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any, Final

import h5netcdf
import h5py
import numpy as np
import xarray as xr
from kedro.io import AbstractDataset

from gyro_pipeline.conventions import AXES, InputError, Missing
from gyro_pipeline.datasets.atomic import replacing
from gyro_pipeline.fingerprints import data_hash
from gyro_pipeline.logs import Finding, Listing, Recording

_ENGINE: Final = "h5netcdf"

_INSPECTION: Final = "inspection"
"""The variable (imu, recording) with all of a :class:`Recording` but its samples, as JSON."""
_PLACE: Final = ("imu", "recording")
_TEXT: Final = h5py.string_dtype()
_UNITS: Final = {"angular_rate": "deg/s", "temperature_c": "degrees Celsius", "acceleration_g": "g"}


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
            data: Labelled arrays. They may themselves be read from the same file. Those with
                ``samples``, 0 for recordings that are not to be used, but without
                ``angular_rate`` complete what :class:`InspectedRecordings` has kept.
        """
        if "samples" in data and "angular_rate" not in data:
            path = path_in_progress(self._filepath)
            _erase(path, data["samples"])
            data.to_netcdf(path, mode="a", engine=_ENGINE)
            os.replace(path, self._filepath)
            return
        # in place of the encodings that variables read from a file carry, which say how they were
        # stored there and not what they hold now
        encoding = {name: {"_FillValue": None} for name in data.variables}
        with replacing(self._filepath) as temporary:
            data.to_netcdf(temporary, engine=_ENGINE, encoding=encoding)

    def _exists(self) -> bool:
        return self._filepath.is_file()

    def _describe(self) -> dict[str, Any]:
        return {"filepath": str(self._filepath)}


class InspectedRecordings(AbstractDataset[Listing | Recording, list[Recording]]):
    """Keeps recordings one by one, as they are read, in a netCDF file beside the final one.

    A :class:`Listing` begins the file with what is there already of the recordings that it lists,
    from a reading that was interrupted or from the last complete one. A chunk holds a recording,
    so rejected and absent ones take no space. :class:`Recordings` completes the file.

    Args:
        filepath: The final netCDF file.
        metadata: For other tools, such as Kedro-Viz.
    """

    def __init__(self, filepath: str, metadata: dict[str, Any] | None = None) -> None:
        self._final = Path(filepath)
        self._path = path_in_progress(self._final)
        self._file: h5py.File | None = None  # stays open, as opening takes longer than writing
        self.metadata = metadata

    def load(self) -> list[Recording]:
        """All recordings that are there, by IMU and number, without their samples."""
        self._release()
        return list(_stored(self._source()))

    def save(self, data: Listing | Recording) -> None:
        """Begin a file for the recordings of a listing, or add one of them."""
        if isinstance(data, Listing):
            self._release()
            with replacing(self._path) as temporary:
                _begin(temporary, data.keys)
                with h5py.File(temporary, "r+") as file:
                    for recording in _stored(self._source(), data.keys):
                        _append(file, recording)
        else:
            self._file = self._file or h5py.File(self._path, "r+")
            _append(self._file, data)

    def _source(self) -> Path:
        return self._path if self._path.is_file() else self._final

    def _exists(self) -> bool:
        return self._source().is_file()

    def _release(self) -> None:
        if self._file is not None:
            self._file.close()
            self._file = None

    def _describe(self) -> dict[str, Any]:
        return {"filepath": str(self._path)}


def path_in_progress(final: Path) -> Path:
    """The file in which recordings are kept while others are still read."""
    return final.with_suffix(f".unfinished{final.suffix}")


def open_recordings(path: Path) -> xr.Dataset:
    """Open a file that :class:`Recordings` wrote.

    Returns:
        Its content, with the values still in the file. IMUs of which no recording can be used, and
        recordings of which no IMU's can, are left out.

    Raises:
        InputError: A damaged file.
    """
    try:  # values that are cached once read would be pickled, and kept in memory
        lazy = xr.open_dataset(path, engine=_ENGINE, cache=False, drop_variables=[_INSPECTION])
    except FileNotFoundError:
        raise
    except Exception as error:  # a damaged file fails in many ways
        raise InputError(
            f"{path}: expected a netCDF file written by this project, but: {error}. "
            "It is damaged; delete it and run the pipeline that makes it again"
        ) from error
    # netCDF gives NumPy numbers, which JSON does not take
    plain = {key: v.item() if isinstance(v, np.generic) else v for key, v in lazy.attrs.items()}
    recordings = lazy.assign_attrs(plain)
    if "samples" not in recordings:
        return recordings
    there = recordings["samples"].load() > 0
    for dimension, other in (("imu", "recording"), ("recording", "imu")):
        used = there.any(other).to_numpy()
        if not used.all():  # an index of single places makes reading slow
            recordings = recordings.isel({dimension: np.flatnonzero(used)})
    return recordings


def _begin(path: Path, places: Collection[tuple[int, int]]) -> None:
    """Write a file with the labels of all recordings that are listed, and none of them."""
    imus, numbers = (np.unique(labels) for labels in zip(*places, strict=True))
    with h5netcdf.File(path, "w") as file:
        sizes = {"imu": len(imus), "recording": len(numbers), "axis": len(AXES)}
        file.dimensions = sizes | {"sample": None}
        file.create_variable("imu", ("imu",), np.int64, data=imus)
        file.create_variable("recording", ("recording",), np.int64, data=numbers)
        file.create_variable("axis", ("axis",), _TEXT, data=np.array(AXES, object))
        file.create_variable(_INSPECTION, _PLACE, _TEXT)


def _append(file: h5py.File, recording: Recording) -> None:
    """Write one recording to its place; last of all its description, which marks it as complete."""
    index = tuple(
        int(np.searchsorted(file[name][:], label))
        for name, label in zip(_PLACE, recording.place, strict=True)
    )
    for name, values in recording.variables.items():
        stored = file.get(name)
        if stored is None or stored.shape[-1] < values.shape[-1]:
            _make_room(file, name, values)
            stored = file[name]
        stored[(*index, ..., slice(values.shape[-1]))] = values
    described = asdict(replace(recording, variables={})) | {"variables": list(recording.variables)}
    file[_INSPECTION][index] = json.dumps(described)
    file.flush()  # a process that is killed later loses nothing of it


def _make_room(file: h5py.File, name: str, values: np.ndarray) -> None:
    """Add a variable that is not there, or samples to all of them."""
    with h5netcdf.File(file, "r+") as netcdf:
        if values.shape[-1] > netcdf.dimensions["sample"].size:
            netcdf.resize_dimension("sample", values.shape[-1])
        if name not in netcdf.variables:
            dimensions = (*_PLACE, *(["axis"] if values.ndim > 1 else []), "sample")
            layout = {"fillvalue": np.float32(np.nan), "chunks": (1, 1, *values.shape)}
            variable = netcdf.create_variable(name, dimensions, np.float32, **layout)
            variable.attrs["units"] = _UNITS[name]


def _stored(path: Path, wanted: Mapping[tuple[int, int], str] | None = None) -> Iterator[Recording]:
    """Recordings of a file by IMU and number, without their samples.

    Where keys are given, only those that have them, with their samples, if these are as they were
    written; a process may be killed while it writes. A damaged file has what can be read of it.
    """
    with suppress(OSError, KeyError, ValueError), h5py.File(path) as file:
        texts = file[_INSPECTION][:]
        for index in np.argwhere(texts != b"").tolist():
            described = json.loads(texts[*index])
            names = described.pop("variables")
            findings = tuple(Finding(**finding) for finding in described.pop("findings"))
            recording = Recording(**described, findings=findings)
            if wanted is None:
                yield recording
            elif recording.key and recording.key == wanted.get(recording.place):
                stretch = (*index, ..., slice(recording.stop - recording.start))
                kept = {name: file[name][stretch] for name in names}
                if not kept or data_hash(kept["angular_rate"], None) == recording.content:
                    yield replace(recording, variables=kept)


def _erase(path: Path, samples: xr.DataArray) -> None:
    """Take back what was kept of recordings that are not to be used after all."""
    with h5py.File(path, "r+") as file:
        described = file[_INSPECTION]
        for index in map(tuple, np.argwhere(samples.transpose(*_PLACE).to_numpy() == 0)):
            names = json.loads(described[index] or "{}").get("variables", [])
            for name in names:
                file[name][index] = np.nan
            if names:
                described[index] = ""  # to be read again, should it be used some day
