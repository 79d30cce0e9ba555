"""Files as tables of named columns, whichever way they are stored.

What a file is, its first bytes tell; its name and suffix are never asked.
"""

import zipfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import h5py
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import scipy.io
from numpy.typing import NDArray

from gyro_pipeline.conventions import AXES, InputError
from gyro_pipeline.readers import mat5
from gyro_pipeline.readers.headers import listed
from gyro_pipeline.readers.sniffing import open_text
from gyro_pipeline.readers.text import Values

_HDF5 = b"\x89HDF\r\n\x1a\n"
_MATLAB = b"MATLAB "
_USER_BLOCK = 512  # bytes of MATLAB's own header before HDF5 begins

_REFUSED = {
    b"\x1f\x8b": "a gzip archive; unpack it",
    b"BZh": "a bzip2 archive; unpack it",
    b"\xfd7zXZ": "an xz archive; unpack it",
    b"\x28\xb5\x2f\xfd": "a zstd archive; unpack it",
    b"7z\xbc\xaf": "a 7z archive; unpack it",
    b"\xd0\xcf\x11\xe0": "an Excel workbook (.xls), whatever its name; save it as CSV",
    b"%PDF": "a PDF document; export the recording as CSV",
}


class Table(Protocol):
    """A file whose header is known and whose columns are not read yet."""

    @property
    def names(self) -> tuple[str, ...]:
        """The header; an empty string for each column it says nothing of."""

    @property
    def preamble(self) -> str:
        """Lines of a text before its rows."""

    @property
    def in_seconds(self) -> frozenset[int]:
        """Numbers of columns of clock times or dates, which are read as seconds."""

    def read(self, columns: Sequence[int], lenient: int | None = None) -> Values:
        """Read columns.

        Args:
            columns: Their numbers, from 0.
            lenient: One of them, any share of which may be unreadable.

        Returns:
            Each of them, (n,), float64, NaN where a value is missing or cannot be read; and what
            was found and repaired.

        Raises:
            InputError: More is damaged than a few rows.
        """


def open_table(path: Path) -> Table:
    """Find out how a file is stored, and read its header.

    Raises:
        InputError: It cannot be read, is empty, or is of a kind that is not read.
    """
    try:
        with path.open("rb") as file:
            head = file.read(_USER_BLOCK + len(_HDF5))
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}") from error
    if not head:
        raise InputError(f"{path}: expected a recording, got an empty file; copy it anew")
    for magic, what in _REFUSED.items():
        if head.startswith(magic):
            raise InputError(f"{path}: expected a recording, got {what}")
    for recognised, opened in (
        (head.startswith(b"PAR1"), _Parquet.open),
        (head.startswith(b"\x93NUMPY"), _open_npy),
        (head.startswith(b"PK"), _open_npz),
        (head.startswith(_HDF5) or head[_USER_BLOCK:] == _HDF5, _open_hdf5),
        (head.startswith(_MATLAB), _open_mat5),
    ):
        if recognised:
            return _guarded(path, opened)
    return open_text(path)


def _guarded(path: Path, read: Callable[[Path], Any]) -> Any:
    """Turn whatever a library raises on a damaged file into a message."""
    try:
        return read(path)
    except InputError:
        raise
    except Exception as error:  # each of the libraries fails in many ways
        raise InputError(
            f"{path}: expected a whole file, but: {str(error)[:200] or type(error).__name__}; it "
            "is damaged, copy it anew"
        ) from error


@dataclass(frozen=True)
class _Parquet:
    path: Path
    names: tuple[str, ...]
    fields: tuple[str, ...]
    in_seconds: frozenset[int]
    preamble: str = ""

    @classmethod
    def open(cls, path: Path) -> "_Parquet":
        fields = list(pq.read_schema(path))
        times = [number for number, field in enumerate(fields) if _microseconds(field.type)]
        names = [_with_unit(field.name, field.metadata or {}) for field in fields]
        return cls(path, tuple(names), tuple(field.name for field in fields), frozenset(times))

    def read(self, columns: Sequence[int], lenient: int | None = None) -> Values:
        del lenient  # a column is of one type: all can be read or none
        names = [self.fields[number] for number in columns]
        if twice := {name for name in names if self.fields.count(name) > 1}:
            raise InputError(f"{self.path}: expected one column each, got twice {listed([*twice])}")

        def read(path: Path) -> list[NDArray[np.float64]]:
            with pq.ParquetFile(path) as file:
                table = file.read(columns=sorted({*names}), use_threads=False)
            return [self._numbers(name, table[name]) for name in names]

        return _guarded(self.path, read), ()

    def _numbers(self, name: str, column: Any) -> NDArray[np.float64]:
        kind = column.type
        if to := _microseconds(kind):
            micros = np.array(column.cast(to, safe=False).cast(pa.int64()).to_numpy(), np.float64)
            known = micros[np.isfinite(micros)]
            return (micros - known[:1] if len(known) else micros) * 1e-6
        if not (pa.types.is_integer(kind) or pa.types.is_floating(kind)):
            raise InputError(f"{self.path}: expected numbers in column {name!r}, got {kind}")
        return np.array(column.cast(pa.float64(), safe=False).to_numpy())


def _with_unit(name: str, attributes: Mapping[Any, Any]) -> str:
    """A name, and the unit that attributes of its column give, in brackets."""
    for key, value in attributes.items():
        if (key.decode() if isinstance(key, bytes) else key).lower() in ("unit", "units"):
            said = value.tolist() if isinstance(value, np.ndarray | np.generic) else value
            texts = {_text(one) for one in (said if isinstance(said, list) else [said])} - {""}
            return f"{name} [{', '.join(sorted(texts))}]" if texts else name
    return name


def _text(said: Any) -> str:
    """A text of bytes, in UTF-8 or Latin 1; nothing of anything else."""
    if not isinstance(said, bytes):
        return said if isinstance(said, str) else ""
    try:
        return said.decode()
    except UnicodeDecodeError:
        return said.decode("latin-1")


def _microseconds(kind: Any) -> Any:
    """Arrow's type of microseconds, for one of clock times, dates with times or durations."""
    if pa.types.is_time(kind):
        return pa.time64("us")
    if pa.types.is_timestamp(kind):
        return pa.timestamp("us", kind.tz)
    return pa.duration("us") if pa.types.is_duration(kind) else None


@dataclass(frozen=True)
class _Arrays:
    """Numeric arrays: vectors are a column each, matrices one a column, or a row where three are.

    What is in fields of arrays or structures is named by them: ``log.gyro`` is ``gyro`` of ``log``.
    """

    path: Path
    arrays: Mapping[str, NDArray[Any]]
    names: tuple[str, ...]
    preamble: str = ""
    in_seconds: frozenset[int] = frozenset()

    @classmethod
    def of(cls, path: Path, stored: Any) -> "_Arrays":
        """Name the columns: ``t`` of a vector, ``gyro.x`` of three, ``all.0`` of others."""
        columns: dict[str, NDArray[Any]] = {}
        arrays = dict(_arrays_in(stored, ""))
        for name, array in arrays.items():
            if array.size < 2 or array.dtype.kind not in "iuf" or array.ndim > 2:  # noqa: PLR2004
                continue
            if 1 in array.shape or array.ndim == 1:
                columns[name] = array.reshape(-1)
                continue
            of_rates = len(array) == len(AXES) < array.shape[1]
            table = array.T if of_rates else array
            rows, width = table.shape
            if width > rows:  # not a row a sample
                continue
            labels = AXES if width == len(AXES) else tuple(map(str, range(width)))
            for number, label in enumerate(labels):
                columns[_inside(name, label)] = table[:, number]
        if not columns:
            found = ", ".join(
                f"objects {name}, which are not read"
                if array.dtype.hasobject
                else f"{array.dtype} {array.shape} {name}".rstrip()
                for name, array in arrays.items()
            )
            raise InputError(
                f"{path}: expected arrays of numbers with a row a sample, such as (n, 3), got "
                f"{found or 'none'}"
            )
        return cls(path, columns, tuple(columns))

    def read(self, columns: Sequence[int], lenient: int | None = None) -> Values:
        del lenient  # numbers all
        found = {self.names[n]: self.arrays[self.names[n]] for n in columns}
        lengths = {name: len(values) for name, values in found.items()}
        if len({*lengths.values()}) > 1:
            raise InputError(f"{self.path}: expected columns of the same length, got {lengths}")
        return [np.array(found[self.names[n]], np.float64) for n in columns], ()


def _arrays_in(stored: Any, name: str) -> Iterator[tuple[str, NDArray[Any]]]:
    """Arrays in arrays of fields and in mappings, by the names that lead to them."""
    if isinstance(stored, np.ndarray) and stored.dtype.names is None:
        yield name, stored
    elif isinstance(stored, np.ndarray):
        for label in stored.dtype.names:
            yield from _arrays_in(stored[label], _inside(name, label))
    elif isinstance(stored, Mapping):
        for label, one in stored.items():
            yield from _arrays_in(one, _inside(name, label))


def _inside(name: str, label: str) -> str:
    return f"{name}.{label}" if name else label


def _open_npy(path: Path) -> _Arrays:
    # maps the file, so that a damaged header cannot ask for more memory than there is
    try:
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
    return _Arrays.of(path, array)


def _open_npz(path: Path) -> _Arrays:
    with zipfile.ZipFile(path) as archive:
        members = archive.namelist()
    if "[Content_Types].xml" in members:
        raise InputError(
            f"{path}: expected a recording, got an Excel workbook, whatever its name; save it as "
            "CSV"
        )
    if not members or not all(name.endswith(".npy") for name in members):
        raise InputError(f"{path}: expected a recording, got a zip archive; unpack it")
    with np.load(path, allow_pickle=False) as archive:
        return _Arrays.of(path, {name: _member(archive, name) for name in archive})


def _member(archive: Any, name: str) -> NDArray[Any]:
    """An array; of objects, which are never unpickled, an empty one."""
    try:
        return np.asarray(archive[name])
    except ValueError as error:
        if "allow_pickle" in str(error):
            return np.empty(0, object)
        raise


def _open_mat5(path: Path) -> _Arrays:
    mat5.check(path.read_bytes())
    return _Arrays.of(path, scipy.io.loadmat(path, simplify_cells=True))


def _open_hdf5(path: Path) -> _Arrays:
    """MATLAB 7.3, which stores arrays transposed; other HDF5 as it is."""
    with path.open("rb") as start:
        matlab = start.read(len(_MATLAB)) == _MATLAB
    arrays: dict[str, NDArray[Any]] = {}

    def add(name: str, data: Any) -> None:
        kind = data.attrs.get("MATLAB_class")
        if isinstance(data, h5py.Dataset) and kind != b"char" and not name.startswith("#"):
            array = np.asarray(data[()])
            arrays[_with_unit(name.replace("/", "."), data.attrs)] = (
                array.T if matlab or kind is not None else array
            )

    with h5py.File(path) as file:
        file.visititems(add)
    return _Arrays.of(path, arrays)
