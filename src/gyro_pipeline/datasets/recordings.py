"""Labelled arrays as netCDF files, and recordings that arrive one by one."""

import json
import os
import time
from collections.abc import Collection, Iterator, Mapping
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import h5netcdf
import h5py
import numpy as np
import xarray as xr
from kedro.io import AbstractDataset
from xarray.backends import CachingFileManager, H5NetCDFStore

from gyro_pipeline.conventions import AXES, InputError
from gyro_pipeline.datasets.atomic import replacing, require_room
from gyro_pipeline.datasets.stored import StoredFile, check_content, digest_of
from gyro_pipeline.fingerprints import data_hash, fingerprint
from gyro_pipeline.logs import Finding, Listing, Recording, with_recordings

_ENGINE: Final = "h5netcdf"

_INSPECTION: Final = "inspection"
"""The variable (imu, recording) with each :class:`Recording` without its samples, as JSON."""
_SEAL: Final = "fingerprint"
"""Key of a hash of the rest of such a JSON text, which may be damaged in an incomplete file."""
_DIMENSIONS: Final = ("imu", "recording")
_TEXT: Final = h5py.string_dtype()
_UNITS: Final = {"angular_rate": "deg/s", "temperature_c": "degrees Celsius", "acceleration_g": "g"}


class Recordings(StoredFile):
    """Stores recordings in a netCDF file and reads them lazily.

    ``load`` returns arrays whose values are read from the file each time they are needed, so they
    take little memory and are sent to another process as a reference to the file. Any process that
    opens the file gets the content that was loaded, or an error.

    ``save`` takes labelled arrays, which may be read from the same file. Arrays with ``samples``, 0
    for recordings that are not to be used, but without ``angular_rate`` complete the file of
    :class:`InspectedRecordings`.
    """

    def save(self, data: xr.Dataset) -> None:
        """Write the file under a temporary name and rename it; open readers keep the old file."""
        if "samples" not in data or "angular_rate" in data:
            super().save(data)
            return
        path = path_in_progress(self._filepath)
        _erase(path, data["samples"])
        data.to_netcdf(path, mode="a", engine=_ENGINE)
        self._record(path)
        os.replace(path, self._filepath)

    def _read(self, path: Path) -> xr.Dataset:
        return open_recordings(path)

    def _write(self, data: xr.Dataset, path: Path) -> None:
        require_room(path, data.nbytes)
        # replaces the encodings of variables from a file, which describe the storage there
        encoding = {name: {"_FillValue": None} for name in data.variables}
        data.to_netcdf(path, engine=_ENGINE, encoding=encoding)


class InspectedRecordings(AbstractDataset[Listing | Recording, list[Recording]]):
    """Stores recordings one by one, as they are read, in a netCDF file beside the final file.

    Saving a :class:`Listing` begins the file with those of its recordings that an interrupted or
    the last complete run has stored. Each recording is a chunk, so rejected and absent recordings
    take no space. :class:`Recordings` completes the file.

    Args:
        filepath: The final netCDF file.
        metadata: For other tools, such as Kedro-Viz.
    """

    used_up = True
    """The content is gone after use: :class:`Recordings` renames the file."""

    def __init__(self, filepath: str, metadata: dict[str, Any] | None = None) -> None:
        self._final = Path(filepath)
        self._path = path_in_progress(self._final)
        self._writer: _Writer | None = None
        self.metadata = metadata

    def load(self) -> list[Recording]:
        """All stored recordings, ordered by IMU and number, without their samples."""
        self._release()
        return list(_stored(self._source()))

    def save(self, data: Listing | Recording) -> None:
        """Begin a file for the recordings of a listing, or add a recording."""
        if isinstance(data, Recording):
            self._writer = self._writer or _Writer(self._path)
            self._writer.add(data)
            return
        self._release()
        with replacing(self._path) as temporary:
            _begin(temporary, data.keys)
            writer = _Writer(temporary)
            for recording in _stored(self._source(), data.keys):
                writer.add(recording)
            writer.close()

    @staticmethod
    def state() -> str:
        """A constant, as the stored recordings only save time and affect no result."""
        return ""

    def _source(self) -> Path:
        return self._path if self._path.is_file() else self._final

    def _exists(self) -> bool:
        return self._source().is_file()

    def _release(self) -> None:
        if self._writer is not None:
            self._writer.close()
            self._writer = None

    def _describe(self) -> dict[str, Any]:
        return {"filepath": str(self._path)}


class _Writer:
    """Adds recordings to a file that :func:`_begin` wrote.

    The file stays open, as opening it takes longer than writing. The descriptions of recordings,
    which mark them as complete, are written every ``every_s`` seconds, after the samples. So a
    killed process loses the recordings of ``every_s`` seconds at most.
    """

    def __init__(self, path: Path, every_s: float = 1.0) -> None:
        self._file = h5py.File(path, "r+")
        self._indices = [
            {int(n): i for i, n in enumerate(self._file[name])} for name in _DIMENSIONS
        ]
        self._arrays = dict[str, h5py.Dataset]()
        self._texts = dict[tuple[int, ...], str]()
        self._every_s, self._due = every_s, time.monotonic()

    def add(self, recording: Recording) -> None:
        """Write the samples now, and the description within ``every_s`` seconds."""
        require_room(Path(self._file.filename), sum(v.nbytes for v in recording.variables.values()))
        index = tuple(
            indices[n] for indices, n in zip(self._indices, recording.labels, strict=True)
        )
        for name, values in recording.variables.items():
            if name not in self._arrays or self._arrays[name].shape[-1] < values.shape[-1]:
                _enlarge(self._file, name, values)
                self._arrays[name] = self._file[name]
            dataset = self._arrays[name].id  # an assignment to the array takes three times as long
            space = dataset.get_space()
            space.select_hyperslab((*index, *[0] * values.ndim), (1, 1, *values.shape))
            dataset.write(h5py.h5s.create_simple(values.shape), space, values)
        findings = [vars(finding) for finding in recording.findings]
        hashes = {name: data_hash(values, None) for name, values in recording.variables.items()}
        description = vars(recording) | {"findings": findings, "variables": hashes}
        self._texts[index] = json.dumps(description | {_SEAL: fingerprint(description)})
        if time.monotonic() >= self._due:
            self._flush()

    def close(self) -> None:
        """Write the remaining descriptions and close the file."""
        self._flush()
        self._file.close()

    def _flush(self) -> None:
        if self._texts:
            chosen = np.zeros(self._file[_INSPECTION].shape, bool)
            chosen[tuple(np.transpose(list(self._texts)))] = True
            self._file[_INSPECTION][chosen] = [self._texts[key] for key in sorted(self._texts)]
        self._file.flush()
        self._texts, self._due = {}, time.monotonic() + self._every_s


def path_in_progress(final: Path) -> Path:
    """The file that stores recordings while others are still read."""
    return final.with_suffix(f".unfinished{final.suffix}")


def open_recordings(path: Path) -> xr.Dataset:
    """Open a file that :class:`Recordings` wrote.

    Returns:
        Its content without unusable recordings (:func:`~gyro_pipeline.logs.with_recordings`), read
        lazily.

    Raises:
        InputError: The file is damaged.
    """
    files = CachingFileManager(_open_unchanged, str(path), check_content(path), mode="r")
    store = H5NetCDFStore(files, mode="r")
    # cached values would be kept in memory and pickled
    lazy = xr.open_dataset(store, cache=False, drop_variables=[_INSPECTION])
    # attributes are NumPy numbers, which json cannot write
    plain = {key: v.item() if isinstance(v, np.generic) else v for key, v in lazy.attrs.items()}
    recordings = lazy.assign_attrs(plain)
    return with_recordings(recordings) if "samples" in recordings else recordings


def _open_unchanged(path: str, digest: str, mode: str) -> h5netcdf.File:
    """Open a file if its digest is unchanged, also in a worker that was sent a reference."""
    if digest_of(Path(path)) != digest:
        raise InputError(
            f"{path}: replaced or changed since this run loaded it; type the same command again"
        )
    return h5netcdf.File(path, mode, decode_vlen_strings=True)


def _begin(path: Path, recordings: Collection[tuple[int, int]]) -> None:
    """Write a file with the labels of recordings, given as IMU and number, without samples."""
    imus, numbers = (np.unique(labels) for labels in zip(*recordings, strict=True))
    with h5netcdf.File(path, "w") as file:
        sizes = {"imu": len(imus), "recording": len(numbers), "axis": len(AXES)}
        file.dimensions = sizes | {"sample": None}
        file.create_variable("imu", ("imu",), np.int64, data=imus)
        file.create_variable("recording", ("recording",), np.int64, data=numbers)
        file.create_variable("axis", ("axis",), _TEXT, data=np.array(AXES, object))
        file.create_variable(_INSPECTION, _DIMENSIONS, _TEXT)


def _enlarge(file: h5py.File, name: str, values: np.ndarray) -> None:
    """Add a variable, and samples to all variables, until the values fit."""
    with h5netcdf.File(file, "r+") as netcdf:
        if values.shape[-1] > netcdf.dimensions["sample"].size:
            netcdf.resize_dimension("sample", values.shape[-1])
        if name not in netcdf.variables:
            dimensions = (*_DIMENSIONS, *(["axis"] if values.ndim > 1 else []), "sample")
            layout = {"fillvalue": np.float32(np.nan), "chunks": (1, 1, *values.shape)}
            variable = netcdf.create_variable(name, dimensions, np.float32, **layout)
            variable.attrs["units"] = _UNITS[name]


def _stored(path: Path, keys: Mapping[tuple[int, int], str] | None = None) -> Iterator[Recording]:
    """Recordings of a file, ordered by IMU and number, without their samples.

    With ``keys``, only the recordings with these keys and undamaged samples, including the samples.
    A file that a killed process left damaged is read as far as possible.
    """
    damage = OSError, KeyError, ValueError
    with suppress(*damage), h5py.File(path) as file:
        for index, text in np.ndenumerate(file[_INSPECTION][()]):
            if not text:
                continue
            description = json.loads(text)
            if description.pop(_SEAL) != fingerprint(description):
                continue
            hashes = description.pop("variables")
            description["findings"] = tuple(Finding(**kind) for kind in description["findings"])
            recording = Recording(**description)
            if keys is None:
                yield recording
            elif recording.key and recording.key == keys.get(recording.labels):
                stretch = (*index, ..., slice(recording.stop - recording.start))
                with suppress(*damage):  # damage to a recording must not hide the following ones
                    variables = {name: file[name][stretch] for name in hashes}
                    if hashes == {name: data_hash(v, None) for name, v in variables.items()}:
                        yield replace(recording, variables=variables)


def _erase(path: Path, samples: xr.DataArray) -> None:
    """Erase stored recordings whose number of samples is 0, as they are not to be used."""
    with h5py.File(path, "r+") as file:
        texts = file[_INSPECTION][()]
        for index in map(tuple, np.argwhere(samples.transpose(*_DIMENSIONS).to_numpy() == 0)):
            names = json.loads(texts[index] or "{}").get("variables", [])
            for name in names:
                file[name][index] = np.nan
            if names:
                file[_INSPECTION][index] = ""  # so that it is read again if it is needed later
