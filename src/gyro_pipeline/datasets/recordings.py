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
from numpy.typing import NDArray

from gyro_pipeline.conventions import AXES, InputError, Missing
from gyro_pipeline.datasets.atomic import replacing
from gyro_pipeline.fingerprints import data_hash
from gyro_pipeline.logs import REJECTED, Finding, Listing, Recording

_ENGINE: Final = "h5netcdf"

_INSPECTION: Final = "inspection"
"""The variable (imu, recording) with all of a :class:`Recording` but its samples, as JSON."""

_PLACE: Final = ("imu", "recording")

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


class InspectedRecordings(AbstractDataset[Listing | Recording, list[Recording]]):
    """Keeps recordings one by one, as they are read, in a netCDF file beside the final one.

    A :class:`Listing` begins the file with what is there already of the recordings that it lists,
    from a reading that was interrupted or from the last complete one. A chunk holds a recording,
    so rejected and absent ones take no space. :class:`CompletedRecordings` ends it.

    Args:
        filepath: The final netCDF file.
        metadata: For other tools, such as Kedro-Viz.
    """

    def __init__(self, filepath: str, metadata: dict[str, Any] | None = None) -> None:
        self._final = Path(filepath)
        self._path = path_in_progress(self._final)
        self.metadata = metadata

    def load(self) -> list[Recording]:
        """All recordings that are there, by IMU and number, without their samples."""
        return list(_stored(self._source()))

    def save(self, data: Listing | Recording) -> None:
        """Begin a file for the recordings of a listing, or add one of them."""
        if isinstance(data, Recording):
            _append(self._path, data)
            return
        with replacing(self._path) as temporary:
            _begin(temporary, data.keys)
            for recording in _stored(self._source(), data.keys):
                if recording.key == data.keys.get(recording.place) and _intact(recording):
                    _append(temporary, recording)

    def _source(self) -> Path:
        return self._path if self._path.is_file() else self._final

    def _exists(self) -> bool:
        return self._source().is_file()

    def _describe(self) -> dict[str, Any]:
        return {"filepath": str(self._path)}


class CompletedRecordings(Recordings):
    """The final file of :class:`InspectedRecordings`, whose ``save`` takes what is still missing.

    Args:
        filepath, made_by, metadata: As :class:`Recordings` takes them.
    """

    def save(self, data: xr.Dataset) -> None:
        """Add labels to the recordings that were read, and rename their file.

        Args:
            data: ``samples`` (imu, recording), 0 for recordings that are not to be used, attributes
                and all that is not measured.
        """
        path = path_in_progress(self._filepath)
        _erase(path, data["samples"])
        data.to_netcdf(path, mode="a", engine=_ENGINE)
        os.replace(path, self._filepath)


def path_in_progress(final: Path) -> Path:
    """The file in which recordings are kept while others are still read."""
    return final.with_suffix(f".unfinished{final.suffix}")


def open_recordings(path: Path) -> xr.Dataset:
    """Open a file that :class:`Recordings` or :class:`CompletedRecordings` wrote.

    Returns:
        Its content, with the values still in the file. IMUs of which no recording can be used, and
        recordings of which no IMU's can, are left out.

    Raises:
        InputError: A damaged file.
    """
    try:
        recordings = xr.open_dataset(
            path,
            engine=_ENGINE,
            cache=False,  # values once read would be pickled, and kept in memory
            drop_variables=[_INSPECTION],
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
    if "samples" not in recordings:
        return recordings
    there = recordings["samples"].load() > 0
    for dimension, other in (("imu", "recording"), ("recording", "imu")):
        used = there.any(other).to_numpy()
        if not used.all():  # an index of single places makes reading slow
            recordings = recordings.isel({dimension: np.flatnonzero(used)})
    return recordings


def _plain(value: Any) -> Any:
    return value.item() if isinstance(value, np.generic) else value


def _begin(path: Path, places: Collection[tuple[int, int]]) -> None:
    """Write a file with the labels of all recordings that are listed, and none of them."""
    imus, numbers = (sorted(set(labels)) for labels in zip(*places, strict=True))
    text = h5py.string_dtype()
    with h5netcdf.File(path, "w") as file:
        sizes = {"imu": len(imus), "recording": len(numbers), "axis": len(AXES)}
        file.dimensions = sizes | {"sample": None}
        file.create_variable("imu", ("imu",), np.int64, data=np.array(imus))
        file.create_variable("recording", ("recording",), np.int64, data=np.array(numbers))
        file.create_variable("axis", ("axis",), text, data=np.array(AXES, object))
        file.create_variable(_INSPECTION, _PLACE, text)


def _append(path: Path, recording: Recording) -> None:
    """Write one recording to its place; last of all its description, which marks it as complete."""
    variables = recording.variables
    with h5py.File(path, "r+") as file:  # in a fifth of the time that h5netcdf takes to open it
        imu, number = (
            int(np.searchsorted(file[name][:], label))
            for name, label in zip(_PLACE, recording.place, strict=True)
        )
        if all(
            name in file and file[name].shape[-1] >= variables[name].shape[-1] for name in variables
        ):
            for name, values in variables.items():
                file[name][imu, number, ..., : values.shape[-1]] = values
            described = asdict(recording) | {"variables": list(variables)}
            file[_INSPECTION][imu, number] = json.dumps(described)
            return
    _make_room(path, variables)
    _append(path, recording)


def _intact(recording: Recording) -> bool:
    """Whether its samples are those that were written; a process may be killed while it writes."""
    rates = recording.variables.get("angular_rate")
    return rates is None or data_hash(rates, None) == recording.content


def _make_room(path: Path, variables: Mapping[str, NDArray[np.float32]]) -> None:
    """Add variables that are not there, and samples to those that are too short."""
    with h5netcdf.File(path, "r+") as file:
        for name, values in variables.items():
            if values.shape[-1] > file.dimensions["sample"].size:
                file.resize_dimension("sample", values.shape[-1])
            if name not in file.variables:
                axis = ("axis",) if values.ndim > 1 else ()
                layout = {"fillvalue": np.float32(np.nan), "chunks": (1, 1, *values.shape)}
                dimensions = (*_PLACE, *axis, "sample")
                variable = file.create_variable(name, dimensions, np.float32, **layout)
                variable.attrs["units"] = _UNITS[name]


def _stored(path: Path, wanted: Mapping[tuple[int, int], str] | None = None) -> Iterator[Recording]:
    """Recordings of a file by IMU and number; those whose key is wanted with their samples.

    A file that is not there, or so far as it is damaged, has none.
    """
    with suppress(OSError, KeyError, ValueError), h5py.File(path) as file:
        texts = file[_INSPECTION][:]
        for imu, number in np.argwhere(texts != b"").tolist():
            described = json.loads(texts[imu, number])
            described["findings"] = tuple(Finding(**one) for one in described["findings"])
            recording = Recording(**described | {"variables": {}})
            if wanted and recording.key and recording.key == wanted.get(recording.place):
                stretch = imu, number, ..., slice(recording.stop - recording.start)
                read = {name: file[name][stretch] for name in described["variables"]}
                recording = replace(recording, variables=read)
            yield recording


def _erase(path: Path, samples: xr.DataArray) -> None:
    """Take back what was kept of recordings that are not to be used after all."""
    with h5py.File(path, "r+") as file:
        described = file[_INSPECTION]
        for place in np.argwhere(samples.transpose(*_PLACE).to_numpy() == 0).tolist():
            text = described[tuple(place)]
            if text and json.loads(text)["outcome"] != REJECTED:
                for name in json.loads(text)["variables"]:
                    file[name][tuple(place)] = np.nan
                described[tuple(place)] = ""  # to be read again, should it be used some day
