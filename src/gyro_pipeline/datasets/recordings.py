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

from gyro_pipeline.conventions import AXES, InputError
from gyro_pipeline.datasets.atomic import check_made, replacing
from gyro_pipeline.fingerprints import data_hash
from gyro_pipeline.logs import Finding, Listing, Recording

_ENGINE: Final = "h5netcdf"

_INSPECTION: Final = "inspection"
"""The variable (imu, recording) with all of a :class:`Recording` but its samples, as JSON."""
_PLACE: Final = ("imu", "recording")
_TEXT: Final = h5py.string_dtype()
_UNITS: Final = {"angular_rate": "deg/s", "temperature_c": "degrees Celsius", "acceleration_g": "g"}


class Recordings(AbstractDataset[xr.Dataset, xr.Dataset]):
    """Keeps recordings in one netCDF file and reads them lazily.

    What ``load`` returns stays in the file until values are asked for, and again afterwards, so
    it is small to hold and is handed to another process as a reference to the file.

    Args:
        filepath: The netCDF file.
        metadata: For other tools, such as Kedro-Viz.
    """

    def __init__(self, filepath: str, metadata: dict[str, Any] | None = None) -> None:
        self._filepath = Path(filepath)
        self.metadata = metadata

    def load(self) -> xr.Dataset:
        """Open the file.

        Returns:
            What was saved, with the values still in the file.

        Raises:
            InputError: As the cause of Kedro's ``DatasetError``, a damaged file.
        """
        check_made(self._filepath)
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

    used_up = True
    """:class:`Recordings` takes the file over: whoever labels recordings anew begins another."""

    def __init__(self, filepath: str, metadata: dict[str, Any] | None = None) -> None:
        self._final = Path(filepath)
        self._path = path_in_progress(self._final)
        self._writer: _Writer | None = None
        self.metadata = metadata

    def load(self) -> list[Recording]:
        """All recordings that are there, by IMU and number, without their samples."""
        self._release()
        return list(_stored(self._source()))

    def save(self, data: Listing | Recording) -> None:
        """Begin a file for the recordings of a listing, or add one of them."""
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
        """Nothing: it is what a reading goes on from, and decides no result."""
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

    The file stays open, as opening it takes longer than writing. A process that is killed loses at
    most the recordings of the last ``every_s`` seconds: their descriptions, which mark them as
    complete, are written together after their samples.
    """

    def __init__(self, path: Path, every_s: float = 1.0) -> None:
        self._file = h5py.File(path, "r+")
        self._index = [{int(n): i for i, n in enumerate(self._file[name])} for name in _PLACE]
        self._arrays = dict[str, h5py.Dataset]()
        self._texts = dict[tuple[int, ...], str]()
        self._every_s, self._due = every_s, time.monotonic()

    def add(self, recording: Recording) -> None:
        """Write the samples, and the description with those of the next ``every_s`` seconds."""
        index = tuple(of[n] for of, n in zip(self._index, recording.place, strict=True))
        for name, values in recording.variables.items():
            if name not in self._arrays or self._arrays[name].shape[-1] < values.shape[-1]:
                _make_room(self._file, name, values)
                self._arrays[name] = self._file[name]
            stored = self._arrays[name].id  # an assignment takes three times as long
            part = stored.get_space()
            part.select_hyperslab((*index, *[0] * values.ndim), (1, 1, *values.shape))
            stored.write(h5py.h5s.create_simple(values.shape), part, values)
        findings = [vars(finding) for finding in recording.findings]
        changed = {"findings": findings, "variables": list(recording.variables)}
        self._texts[index] = json.dumps(vars(recording) | changed)
        if time.monotonic() >= self._due:
            self._flush()

    def close(self) -> None:
        """Write what is left to write."""
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
    written. Of a damaged file, as a process that is killed may leave it, what can be read.
    """
    damage = OSError, KeyError, ValueError
    with suppress(*damage), h5py.File(path) as file:
        for index, text in np.ndenumerate(file[_INSPECTION][()]):
            if not text:
                continue
            described = json.loads(text)
            names = described.pop("variables")
            described["findings"] = tuple(Finding(**kind) for kind in described["findings"])
            recording = Recording(**described)
            if wanted is None:
                yield recording
            elif recording.key and recording.key == wanted.get(recording.place):
                stretch = (*index, ..., slice(recording.stop - recording.start))
                with suppress(*damage):  # each by itself, or one would hide the others
                    kept = {name: file[name][stretch] for name in names}
                    if not kept or data_hash(kept["angular_rate"], None) == recording.content:
                        yield replace(recording, variables=kept)


def _erase(path: Path, samples: xr.DataArray) -> None:
    """Take back what was kept of recordings that are not to be used after all."""
    with h5py.File(path, "r+") as file:
        texts = file[_INSPECTION][()]
        for index in map(tuple, np.argwhere(samples.transpose(*_PLACE).to_numpy() == 0)):
            names = json.loads(texts[index] or "{}").get("variables", [])
            for name in names:
                file[name][index] = np.nan
            if names:
                file[_INSPECTION][index] = ""  # to be read again, should it be used some day
