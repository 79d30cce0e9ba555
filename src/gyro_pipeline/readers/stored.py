"""Reads arrays and columns of NumPy, MATLAB, HDF5 and Parquet files as a table.

A recording has more samples than columns, so the longer side of an array is its rows. Libraries are
imported where they are used, as most files are texts.
"""

import zipfile
from collections.abc import Iterator, Mapping
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gyro_pipeline.conventions import AXES, IN_READER, InputError
from gyro_pipeline.parameters import ReaderOptions
from gyro_pipeline.readers import mat5
from gyro_pipeline.readers.table import Reader, Table, column


def check_claim(path: Path, size: float, options: ReaderOptions) -> None:
    """Refuse a file whose values would take more bytes of memory than the options allow.

    A small file can claim any number of values, so this is checked before they are read.
    """
    if size > 1e6 * options.largest_mb:
        raise InputError(
            f"{path}: expected at most {options.largest_mb:g} MB of values, the file claims "
            f"{size / 1e6:.4g} MB; if it is right, type a larger `largest_mb` {IN_READER}"
        )


def read_parquet(path: Path, options: ReaderOptions) -> Table:
    """Read the columns of a Parquet file."""
    import pyarrow as pa  # noqa: PLC0415
    import pyarrow.parquet as pq  # noqa: PLC0415

    with pq.ParquetFile(path) as file:
        check_claim(path, 8.0 * file.metadata.num_rows * file.metadata.num_columns, options)
        table = file.read(use_threads=False)
    plain = [
        values.cast(values.type.value_type) if pa.types.is_dictionary(values.type) else values
        for values in table.columns
    ]
    return Table(str(path), tuple(table.column_names), tuple(column(v.to_numpy()) for v in plain))


def read_npy(path: Path, options: ReaderOptions) -> Table:
    """Read the array of a ``.npy`` file, with columns or named fields."""
    # mapped, so that a damaged header cannot claim more memory than exists
    return _of_arrays(path, {"": np.lib.format.open_memmap(path, mode="r")}, options)


def read_zip(path: Path, options: ReaderOptions) -> Table:
    """Read the arrays of a ``.npz`` file; objects are never unpickled."""
    with zipfile.ZipFile(path) as archive:
        members = archive.namelist()
        size = sum(member.file_size for member in archive.infolist())
    if "[Content_Types].xml" in members:
        raise InputError(f"{path}: expected a recording, got an Excel workbook; save it as CSV")
    if not members or not all(name.endswith(".npy") for name in members):
        files = ", ".join(members[:5])
        raise InputError(f"{path}: expected a recording, got a zip archive ({files}); unpack it")
    check_claim(path, size, options)
    arrays: dict[str, NDArray[Any]] = {}
    with np.load(path, allow_pickle=False) as stored:
        for name in stored:
            with suppress(ValueError):  # raised for objects; damage raises BadZipFile
                arrays[name] = stored[name]
    return _of_arrays(path, arrays, options)


def read_mat(path: Path, options: ReaderOptions) -> Table:
    """Read arrays and structures of MATLAB 5 to 7."""
    import scipy.io  # noqa: PLC0415

    mat5.check(path.read_bytes(), partial(check_claim, path, options=options))
    variables = scipy.io.loadmat(path, simplify_cells=True)
    variables = {k: v for k, v in variables.items() if not k.startswith("__")}
    return _of_arrays(path, variables, options)


def read_hdf5(path: Path, options: ReaderOptions) -> Table:
    """Read HDF5, also of MATLAB 7.3, whose cells refer to groups named ``#…``."""
    import h5py  # noqa: PLC0415

    datasets: list[Any] = []

    def add(name: str, data: Any) -> None:
        if isinstance(data, h5py.Dataset) and not name.startswith("#"):
            datasets.append(data)

    with h5py.File(path) as file:
        file.visititems(add)
        for data in datasets:
            if data.external or data.is_virtual:
                raise InputError(
                    f"{path}: expected a recording, got {data.name}, whose values are in another "
                    "file, which is not opened; copy them into this file"
                )
        check_claim(path, sum(8.0 * data.size for data in datasets), options)
        arrays = {data.name[1:].replace("/", "."): np.asarray(data[()]) for data in datasets}
    return _of_arrays(path, arrays, options)


READERS: dict[bytes, Reader] = {
    b"PAR1": read_parquet,
    b"\x93NUMPY": read_npy,
    b"PK": read_zip,
    b"\x89HDF\r\n\x1a\n": read_hdf5,
    b"MATLAB 7.3": read_hdf5,
    b"MATLAB ": read_mat,
}
"""Readers by the first bytes of a file."""


def _of_arrays(path: Path, stored: Mapping[str, Any], options: ReaderOptions) -> Table:
    """Name the columns of arrays: ``t`` for a vector, ``gyro.x`` for three columns, else ``all.0``.

    Fields of arrays and structures are named by their path: ``log.gyro`` is ``gyro`` in ``log``.
    """
    arrays = dict(_arrays_in(stored, ""))
    check_claim(path, sum(8.0 * array.size for array in arrays.values()), options)
    columns: dict[str, NDArray[Any]] = {}
    for name, array in arrays.items():
        rows = np.squeeze(array)
        if rows.size < 2 or rows.ndim > 2 or rows.dtype.kind not in "biufmMUS":  # noqa: PLR2004
            continue
        if rows.ndim == 1:
            columns[name] = column(rows)
            continue
        rows = rows.T if len(rows) < len(rows.T) else rows
        labels = AXES if len(rows.T) == len(AXES) else map(str, range(len(rows.T)))
        for label, values in zip(labels, rows.T, strict=True):
            columns[f"{name}.{label}".strip(".")] = column(values)
    if not any(values.dtype == np.float64 for values in columns.values()):
        shapes = ", ".join(f"{a.dtype} {a.shape} {name}".rstrip() for name, a in arrays.items())
        raise InputError(
            f"{path}: expected arrays of numbers with a row per sample, such as (n, 3), got "
            f"{shapes or 'none'}; arrays of objects are not read: save their columns as arrays"
        )
    return Table(str(path), tuple(columns), tuple(columns.values()))


def _arrays_in(stored: Any, name: str) -> Iterator[tuple[str, NDArray[Any]]]:
    """Arrays in arrays of fields and in mappings, with their dotted paths."""
    if isinstance(stored, np.ndarray) and stored.dtype.names is None:
        yield name, stored
    elif isinstance(stored, np.ndarray | Mapping):
        labels = stored if isinstance(stored, Mapping) else stored.dtype.names
        for label in labels:
            yield from _arrays_in(stored[label], f"{name}.{label}".strip("."))
