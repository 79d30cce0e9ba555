"""Logs in the array layout of the published authors' files."""

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
"""What the three axes of a file are, in the order in which the published files have them."""

_WHOLE = "all"
"""The key of a file whose recordings are not split into train and test."""

Order = tuple[str, ...]
Shape = tuple[int, ...]


class ArrayLogs(LogSource):
    """Lists what 3-D ``.npy`` files hold: recordings, gyroscopes, samples, in any order, deg/s.

    Gyroscopes come three to an IMU, IMU by IMU, in the order x, y, z. Counts are read from the
    files, never required. Samples are judged by the quality control, where they are read.

    Args:
        sensor, sensors, source, path, metadata: As :class:`~.log_source.LogSource` takes them.
        files: Names of the files: ``{"train": name, "test": name}``, or ``{"all": name}``.
        axes_order: ``recording``, ``gyroscope`` and ``sample`` in the order of the files'
            axes; needed only where their shapes leave it open.

    Raises:
        InputError: An unknown sensor, or an entry that is not as described here.
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
                f"{sensor}: files: expected a train and a test file, which are not the same one, "
                f"or all, one file to be split, got {dict(files)}"
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
            Recordings of the train file come first and those of the test file are numbered on.

        Raises:
            InputError: As the cause of Kedro's ``DatasetError``, a file that cannot be used.
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
        """Map one file, refusing what is not three axes of real numbers."""
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
                f"{error}. It is truncated, of another format, or holds pickled objects, which are "
                f"never loaded; replace or delete {path}"
            ) from error
        if array.dtype.kind not in "iuf" or array.ndim != len(LAYOUT) or array.size == 0:
            raise InputError(
                f"{where}: expected real numbers in deg/s along 3 axes (recordings, gyroscopes, "
                f"samples in any order), got {array.dtype} of shape {array.shape}"
            )
        return array

    def _order(self, shapes: Mapping[str, Shape]) -> Order:
        """Tell which axis is which, by the shapes where they allow only one answer."""
        given = self._axes_order
        plausible = [
            order
            for order in permutations(LAYOUT)
            if all(_is_plausible(order, shape) for shape in shapes.values())
        ]
        if len(plausible) == 1 and given in (None, plausible[0]):
            return plausible[0]
        if given and len(plausible) != 1 and all(_in_threes(given, s) for s in shapes.values()):
            return given
        listed = [f"[{', '.join(order)}]" for order in plausible]
        raise InputError(
            f"{self._sensor} {', '.join(f'{name} of shape {s}' for name, s in shapes.items())}: "
            "axes_order in the catalog entry in catalog.yml: expected "
            f"[{', '.join(LAYOUT)}] in the order of the file's axes, got {list(given or [])}. By "
            "their lengths, gyroscopes in threes and far more samples than recordings or "
            f"gyroscopes, they can be {' or '.join(listed) or 'none'}"
        )


def _is_plausible(order: Order, shape: Shape, least_ratio: int = 4) -> bool:
    """Whether there are so many times more samples than recordings or gyroscopes."""
    samples = shape[order.index("sample")]
    return _in_threes(order, shape) and samples >= least_ratio * sorted(shape)[1]


def _in_threes(order: Order, shape: Shape) -> bool:
    return shape[order.index("gyroscope")] % len(AXES) == 0


def _read(path: Path, order: Order, imu: int, recording: int) -> Log:
    """One recording of one IMU, out of a file that was found to be in order."""
    array = np.lib.format.open_memmap(path, mode="r")
    recordings_first = array.transpose([order.index(name) for name in LAYOUT])
    gyroscopes = slice(len(AXES) * imu, len(AXES) * (imu + 1))
    return Log(recordings_first[recording, gyroscopes].T.astype(np.float64))
