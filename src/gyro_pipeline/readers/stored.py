"""Stored arrays and columns as a table: NumPy, MATLAB, HDF5 and Parquet."""

import zipfile
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import scipy.io
from numpy.typing import NDArray

from gyro_pipeline.conventions import AXES, InputError
from gyro_pipeline.readers import mat5
from gyro_pipeline.readers.table import Table, column

_NUMBERS, _TIMES, _TEXTS = "biuf", "mM", "US"  # NumPy's kinds


def guarded(path: Path, read: Callable[[Path], Table]) -> Table:
    """Read, and turn whatever a library raises on a damaged file into a message."""
    try:
        return read(path)
    except InputError:
        raise
    except Exception as error:  # each of the libraries fails in many ways
        raise InputError(
            f"{path}: expected a whole file, but: {str(error)[:200] or type(error).__name__}; it "
            "is damaged, copy it anew"
        ) from error


def read_parquet(path: Path) -> Table:
    """Read columns; units are in the attributes of the fields."""
    with pq.ParquetFile(path) as file:
        table = file.read(use_threads=False)
    names = tuple(_with_unit(field.name, field.metadata or {}) for field in table.schema)
    return Table(str(path), names, tuple(column(values)[0] for values in table.columns))


def read_npy(path: Path) -> Table:
    """Read an array (n, columns), or one of named fields."""
    try:  # maps the file, so that a damaged header cannot ask for more memory than there is
        array: NDArray[Any] = np.lib.format.open_memmap(path, mode="r")
    except ValueError as error:
        if "Python objects" not in str(error):
            raise
        raise InputError(
            f"{path}: expected numbers, got Python objects, which are never unpickled; save the "
            "columns of numbers alone"
        ) from error
    if array.ndim != 2 and array.dtype.names is None:  # noqa: PLR2004
        raise InputError(f"{path}: expected shape (n, 3), or named fields, got {array.shape}")
    return _of_arrays(path, array)


def read_npz(path: Path) -> Table:
    """Read named arrays; those of objects are never unpickled."""
    with zipfile.ZipFile(path) as archive:
        members = archive.namelist()
    if "[Content_Types].xml" in members:
        kind = "an Excel workbook, whatever its name; save it as CSV"
        raise InputError(f"{path}: expected a recording, got {kind}")
    if not members or not all(name.endswith(".npy") for name in members):
        shown = ", ".join(members[:5])
        raise InputError(f"{path}: expected a recording, got a zip archive ({shown}); unpack it")
    with np.load(path, allow_pickle=False) as arrays:
        return _of_arrays(path, {name: _member(arrays, name) for name in arrays})


def _member(archive: Any, name: str) -> NDArray[Any]:
    try:
        return np.asarray(archive[name])
    except ValueError as error:
        if "allow_pickle" in str(error):
            return np.empty(0, object)
        raise


def read_mat5(path: Path) -> Table:
    """Read arrays and structures of MATLAB 5 to 7."""
    mat5.check(path.read_bytes())
    variables = scipy.io.loadmat(path, simplify_cells=True)
    own = {name: value for name, value in variables.items() if not str(name).startswith("__")}
    return _of_arrays(path, own)


def read_hdf5(path: Path) -> Table:
    """Read MATLAB 7.3, which stores arrays transposed, and other HDF5 as it is."""
    with path.open("rb") as start:
        matlab = start.read(6) == b"MATLAB"
    arrays: dict[str, NDArray[Any]] = {}

    def add(name: str, data: Any) -> None:
        kind = data.attrs.get("MATLAB_class")
        if isinstance(data, h5py.Dataset) and kind != b"char" and not name.startswith("#"):
            array = np.asarray(data[()])
            transposed = matlab or kind is not None
            arrays[_with_unit(name.replace("/", "."), data.attrs)] = (
                array.T if transposed else array
            )

    with h5py.File(path) as file:
        file.visititems(add)
    return _of_arrays(path, arrays)


def _of_arrays(path: Path, stored: Any) -> Table:
    """Name columns: ``t`` of a vector, ``gyro.x`` of three columns or rows, ``all.0`` of others.

    What is in fields of arrays or structures is named by them: ``log.gyro`` is ``gyro`` of ``log``.
    """
    columns: dict[str, NDArray[Any]] = {}
    arrays = dict(_arrays_in(stored, ""))
    for name, array in arrays.items():
        if array.size < 2 or array.dtype.kind not in _NUMBERS + _TIMES + _TEXTS or array.ndim > 2:  # noqa: PLR2004
            continue
        if 1 in array.shape or array.ndim == 1:
            columns[name] = _values(array.reshape(-1))
            continue
        table = array.T if len(array) == len(AXES) < array.shape[1] else array
        rows, width = table.shape
        if width > rows:  # not a row a sample
            continue
        labels = AXES if width == len(AXES) else tuple(map(str, range(width)))
        for number, label in enumerate(labels):
            columns[_inside(name, label)] = _values(table[:, number])
    if not any(values.dtype == np.float64 for values in columns.values()):
        raise InputError(
            f"{path}: expected arrays of numbers with a row a sample, such as (n, 3), got "
            f"{', '.join(_described(*item) for item in arrays.items()) or 'none'}"
        )
    return Table(str(path), tuple(columns), tuple(columns.values()))


def _values(array: NDArray[Any]) -> NDArray[Any]:
    if array.dtype.kind in _NUMBERS:
        return np.array(array, np.float64)
    if array.dtype.kind in _TIMES:
        return array.astype(f"{array.dtype.kind}8[ns]")
    texts = [_text(text) or None for text in array.tolist()]
    return column(pa.chunked_array([pa.array(texts, pa.string())]))[0]


def _described(name: str, array: NDArray[Any]) -> str:
    if array.dtype.hasobject:
        return f"objects {name}, which are not read (save their columns as arrays, or as CSV)"
    return f"{array.dtype} {array.shape} {name}".rstrip()


def _arrays_in(stored: Any, name: str) -> Iterator[tuple[str, NDArray[Any]]]:
    """Arrays in arrays of fields and in mappings, by the names that lead to them."""
    if isinstance(stored, np.ndarray) and stored.dtype.names is None:
        yield name, stored
    elif isinstance(stored, np.ndarray):
        for label in stored.dtype.names:
            yield from _arrays_in(stored[label], _inside(name, label))
    elif isinstance(stored, Mapping):
        for label, inner in stored.items():
            yield from _arrays_in(inner, _inside(name, str(label)))


def _inside(name: str, label: str) -> str:
    stem, bracket, unit = name.partition(" [")
    return f"{stem}.{label}{bracket}{unit}" if name else label


def _with_unit(name: str, attributes: Mapping[Any, Any]) -> str:
    """A name, and the unit that attributes of its column give, in brackets."""
    for key, value in attributes.items():
        if _text(key).lower() in ("unit", "units"):
            units = value.tolist() if isinstance(value, np.ndarray | np.generic) else value
            texts = {_text(unit) for unit in (units if isinstance(units, list) else [units])} - {""}
            return f"{name} [{', '.join(sorted(texts))}]" if texts else name
    return name


def _text(value: Any) -> str:
    """A text, of bytes in UTF-8 or Latin 1; nothing of anything else."""
    if not isinstance(value, bytes):
        return value if isinstance(value, str) else ""
    try:
        return value.decode()
    except UnicodeDecodeError:
        return value.decode("latin-1")
