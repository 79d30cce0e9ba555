"""Logs in the array layout of the files that the paper's authors publish."""

from collections.abc import Mapping, Sequence
from functools import partial
from itertools import permutations, product
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gyro_pipeline.conventions import AXES, InputError
from gyro_pipeline.datasets.log_source import LogSource
from gyro_pipeline.fingerprints import fingerprint
from gyro_pipeline.logs import Log, LogEntry, Logs

LAYOUT = ("recording", "gyroscope", "sample")
"""The three axes of a file, in the order of the published files."""

_WHOLE = "all"
"""Key of a file whose recordings are not split into train and test."""

Order = tuple[str, ...]
Shape = tuple[int, ...]


class ArrayLogs(LogSource):
    """Lists the recordings of 3-D ``.npy`` files, in deg/s, with axes in any order.

    The gyroscopes of each IMU follow each other in the order x, y, z. The files determine the
    numbers of recordings, gyroscopes and samples.

    Args:
        sensor, sensors, source, path, metadata: As for :class:`~.log_source.LogSource`.
        files: Names of the files: ``{"train": name, "test": name}``, or ``{"all": name}``.
        axes_order: ``recording``, ``gyroscope`` and ``sample`` in the order of the files' axes;
            needed only if their shapes are ambiguous.

    Raises:
        InputError: The sensor is unknown, or an argument is not as described here.
    """

    def __init__(
        self,
        sensor: str,
        sensors: Mapping[str, Mapping[str, Any]],
        source: str,
        path: str,
        files: Mapping[str, str],
        axes_order: Sequence[str] | None = None,
        metadata: dict[str, Any] | None = None,
    ) -> None:
        super().__init__(sensor, sensors, source, path, metadata)
        if set(files) not in ({"train", "test"}, {_WHOLE}) or len(set(files.values())) < len(files):
            raise InputError(
                f"{sensor}: files: expected train and test, two different files, or all, one file "
                f"to be split, got {dict(files)}"
            )
        if axes_order is not None and sorted(axes_order) != sorted(LAYOUT):
            raise InputError(
                f"{sensor}: axes_order: expected {', '.join(LAYOUT)} in the order of the file's "
                f"axes, got {list(axes_order)}"
            )
        self._files = {split: files[split] for split in ("train", "test", _WHOLE) if split in files}
        self._axes_order = None if axes_order is None else tuple(axes_order)

    def load(self) -> Logs:
        """List the recordings of all files; their samples are read later, one at a time.

        Returns:
            The recordings; those of the test file have the numbers after those of the train file.

        Raises:
            InputError: A file cannot be used; as the cause of Kedro's ``DatasetError``.
        """
        shapes = {name: self._open(name).shape for name in self._files.values()}
        order, entries, first = self._order(shapes), list[LogEntry](), 1
        for split, name in self._files.items():
            path, count = self._path / name, dict(zip(order, shapes[name], strict=True))
            imus, recordings = count["gyroscope"] // len(AXES), count["recording"]
            state = path.stat()
            file = [str(path), state.st_size, state.st_mtime_ns, order]
            entries += [
                LogEntry(
                    *(imu + 1, first + recording, f"{name} recording {recording + 1}"),
                    partial(_read, path, order, imu, recording),
                    size=state.st_size // (imus * recordings),
                    key=fingerprint([*file, imu, recording]),
                    split=None if split == _WHOLE else split,
                )
                for imu, recording in product(range(imus), range(recordings))
            ]
            first += recordings
        entries.sort(key=lambda entry: (entry.imu, entry.recording))
        return Logs(self._sensor, self._source, False, self.entry.rate_hz, entries)

    def _exists(self) -> bool:
        return all((self._path / name).is_file() for name in self._files.values())

    def _describe(self) -> dict[str, Any]:
        return super()._describe() | {"files": self._files, "axes_order": self._axes_order}

    def _open(self, name: str) -> NDArray[Any]:
        """Map a file to memory; refuse anything but three axes of real numbers."""
        where, path = f"{self._sensor} {name}", self._path / name
        if not path.is_file():
            raise InputError(
                f"{where}: no such file in {self._path}; put it there, or choose another source"
            )
        try:
            # reads the header only, and unlike numpy.load can never unpickle
            array: NDArray[Any] = np.lib.format.open_memmap(path, mode="r")
        except Exception as error:  # a damaged header fails in many ways
            raise InputError(
                f"{where}: expected a plain numeric .npy file as numpy.save writes it, but: "
                f"{error}. It is truncated, has another format, or contains pickled objects, which "
                f"are never loaded; replace or delete {path}"
            ) from error
        if array.dtype.kind not in "iuf" or array.ndim != len(LAYOUT) or array.size == 0:
            raise InputError(
                f"{where}: expected real numbers in deg/s along 3 axes (recordings, gyroscopes, "
                f"samples in any order), got {array.dtype} of shape {array.shape}"
            )
        return array

    def _order(self, shapes: Mapping[str, Shape]) -> Order:
        """Determine the order of the axes, by the shapes if these are unambiguous."""
        option = self._axes_order
        plausible = [
            order
            for order in permutations(LAYOUT)
            if all(_is_plausible(order, shape) for shape in shapes.values())
        ]
        if len(plausible) == 1 and option in (None, plausible[0]):
            return plausible[0]
        if option and len(plausible) != 1 and all(_has_triples(option, s) for s in shapes.values()):
            return option
        orders = [f"[{', '.join(order)}]" for order in plausible]
        raise InputError(
            f"{self._sensor} {', '.join(f'{name} of shape {s}' for name, s in shapes.items())}: "
            "axes_order in the catalog entry in catalog.yml: expected "
            f"[{', '.join(LAYOUT)}] in the order of the file's axes, got {list(option or [])}. By "
            "their lengths, gyroscopes in threes and far more samples than recordings or "
            f"gyroscopes, they can be {' or '.join(orders) or 'none'}"
        )


def _is_plausible(order: Order, shape: Shape, least_ratio: int = 4) -> bool:
    """Whether samples outnumber recordings and gyroscopes by at least a ratio."""
    samples = shape[order.index("sample")]
    return _has_triples(order, shape) and samples >= least_ratio * sorted(shape)[1]


def _has_triples(order: Order, shape: Shape) -> bool:
    return shape[order.index("gyroscope")] % len(AXES) == 0


def _read(path: Path, order: Order, imu: int, recording: int) -> Log:
    """Read a recording of an IMU from a file that was checked before."""
    array = np.lib.format.open_memmap(path, mode="r")
    recordings_first = array.transpose([order.index(name) for name in LAYOUT])
    gyroscopes = slice(len(AXES) * imu, len(AXES) * (imu + 1))
    return Log(recordings_first[recording, gyroscopes].T.astype(np.float64))
