"""Files as tables of named columns, whichever way they are stored.

What a file is, its first bytes tell; its name and suffix are never asked.
"""

import zipfile
from collections.abc import Callable, Mapping, Sequence
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
    in_seconds: frozenset[int]
    preamble: str = ""

    @classmethod
    def open(cls, path: Path) -> "_Parquet":
        fields = list(pq.read_schema(path))
        times = [number for number, field in enumerate(fields) if _is_time(field.type)]
        return cls(path, tuple(field.name for field in fields), frozenset(times))

    def read(self, columns: Sequence[int], lenient: int | None = None) -> Values:
        del lenient  # a column is of one type: all can be read or none
        names = [self.names[number] for number in columns]
        if twice := {name for name in names if self.names.count(name) > 1}:
            raise InputError(f"{self.path}: expected one column each, got twice {listed([*twice])}")

        def read(path: Path) -> list[NDArray[np.float64]]:
            with pq.ParquetFile(path) as file:
                table = file.read(columns=sorted({*names}), use_threads=False)
            return [self._numbers(name, table[name]) for name in names]

        return _guarded(self.path, read), ()

    def _numbers(self, name: str, column: Any) -> NDArray[np.float64]:
        kind = column.type
        if _is_time(kind):
            to = pa.time64("us") if pa.types.is_time(kind) else pa.timestamp("us", kind.tz)
            micros = column.cast(to, safe=False).cast(pa.int64()).to_numpy()
            return (micros - (micros[:1] if len(micros) else 0)) * 1e-6
        if not (pa.types.is_integer(kind) or pa.types.is_floating(kind)):
            raise InputError(f"{self.path}: expected numbers in column {name!r}, got {kind}")
        return np.array(column.cast(pa.float64(), safe=False).to_numpy())


def _is_time(kind: Any) -> bool:
    return pa.types.is_timestamp(kind) or pa.types.is_time(kind)


@dataclass(frozen=True)
class _Arrays:
    """Numeric arrays: vectors are a column each, matrices one a column of theirs."""

    path: Path
    arrays: Mapping[str, NDArray[Any]]
    names: tuple[str, ...]
    preamble: str = ""
    in_seconds: frozenset[int] = frozenset()

    @classmethod
    def of(cls, path: Path, arrays: Mapping[str, NDArray[Any]]) -> "_Arrays":
        """Name the columns: ``t`` of a vector, ``gyro.x`` of three, ``all.0`` of others."""
        columns: dict[str, NDArray[Any]] = {}
        for name, array in arrays.items():
            if array.size < 2 or array.dtype.kind not in "iuf" or array.ndim > 2:  # noqa: PLR2004
                continue
            if 1 in array.shape or array.ndim == 1:
                columns[name] = array.reshape(-1)
                continue
            rows, width = array.shape
            if width > rows:  # not a row a sample
                continue
            labels = AXES if width == len(AXES) else tuple(map(str, range(width)))
            for number, label in enumerate(labels):
                columns[f"{name}.{label}" if name else label] = array[:, number]
        if not columns:
            found = ", ".join(
                f"{array.dtype} {array.shape} {name}" for name, array in arrays.items()
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


def _open_npy(path: Path) -> _Arrays:
    # maps the file, so that a damaged header cannot ask for more memory than there is
    array: NDArray[Any] = np.lib.format.open_memmap(path, mode="r")
    if array.ndim != 2:  # noqa: PLR2004
        raise InputError(f"{path}: expected shape (n, 3), got {array.shape}")
    return _Arrays.of(path, {"": array})


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
    with np.load(path, allow_pickle=False) as arrays:
        return _Arrays.of(path, dict(arrays))


def _open_mat5(path: Path) -> _Arrays:
    arrays = scipy.io.loadmat(path)
    return _Arrays.of(path, {n: a for n, a in arrays.items() if isinstance(a, np.ndarray)})


def _open_hdf5(path: Path) -> _Arrays:
    """MATLAB 7.3, which stores arrays transposed; other HDF5 as it is."""
    with path.open("rb") as start:
        matlab = start.read(len(_MATLAB)) == _MATLAB
    with h5py.File(path) as file:
        arrays = {
            name: data[()].T if matlab or "MATLAB_class" in data.attrs else data[()]
            for name, data in file.items()
            if isinstance(data, h5py.Dataset) and data.attrs.get("MATLAB_class") != b"char"
        }
    return _Arrays.of(path, arrays)
