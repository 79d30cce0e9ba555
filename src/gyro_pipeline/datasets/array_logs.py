"""Logs in the array layout of the published authors' files."""

from collections.abc import Mapping, Sequence
from functools import partial
from itertools import permutations
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

WHOLE = "all"
"""The key of a file whose recordings are not split into train and test."""

_DOMINANCE = 4
"""So many times more samples than recordings or gyroscopes tell the sample axis from the others."""

Order = tuple[str, ...]


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
        _check_entry(sensor, files, axes_order)
        self._files = {split: files[split] for split in ("train", "test", WHOLE) if split in files}
        self._axes_order = None if axes_order is None else tuple(axes_order)

    def load(self) -> Logs:
        """List the recordings of all files; their samples are read later, one at a time.

        Returns:
            Recordings of the train file come first and those of the test file are numbered on.

        Raises:
            InputError: As the cause of Kedro's ``DatasetError``, a file that cannot be used.
        """
        shapes = {name: self._open(name).shape for name in self._files.values()}
        order = self._order(shapes)
        counts = [dict(zip(order, shape, strict=True)) for shape in shapes.values()]
        entries, first = list[LogEntry](), 1
        for (split, name), count in zip(self._files.items(), counts, strict=True):
            entries += self._entries(split, name, order, count, first)
            first += count["recording"]
        entries.sort(key=lambda entry: (entry.imu, entry.recording))
        return Logs(self._sensor, self._source, False, self.entry.rate_hz, entries)

    def _exists(self) -> bool:
        return all((self._path / name).is_file() for name in self._files.values())

    def _describe(self) -> dict[str, Any]:
        return super()._describe() | {"files": self._files, "axes_order": self._axes_order}

    def _open(self, name: str) -> NDArray[Any]:
        """Map one file, refusing what is not three axes of real numbers."""
        where = f"{self._sensor} {name}"
        if not (self._path / name).is_file():
            raise InputError(
                f"{where}: no such file in {self._path}; put it there, or choose another source"
            )
        try:
            # reads the header only, and unlike numpy.load can never unpickle
            array: NDArray[Any] = np.lib.format.open_memmap(self._path / name, mode="r")
        except Exception as error:  # a damaged header fails in many ways
            raise InputError(
                f"{where}: expected a plain numeric .npy file as numpy.save writes it, but: "
                f"{error}. It is truncated, of another format, or holds pickled objects, which are "
                f"never loaded; replace or delete {self._path / name}"
            ) from error
        if array.dtype.kind not in "iuf":
            raise InputError(f"{where}: expected real numbers in deg/s, got dtype {array.dtype}")
        if array.ndim != len(LAYOUT):
            raise InputError(
                f"{where}: expected 3 axes (recordings, gyroscopes, samples in any order), got "
                f"shape {array.shape}"
            )
        if array.size == 0:
            raise InputError(f"{where}: expected recordings, got none: shape {array.shape}")
        return array

    def _order(self, shapes: Mapping[str, tuple[int, ...]]) -> Order:
        """Tell which axis is which, from the shapes where they allow only one answer."""
        candidates = [
            order
            for order in permutations(LAYOUT)
            if all(_plausible(order, shape) for shape in shapes.values())
        ]
        given = self._axes_order
        if len(candidates) == 1 and given in (None, candidates[0]):
            return candidates[0]
        if given is None:
            problem = f"cannot tell which axis is which; add axes_order: {_listed(LAYOUT)}, sorted"
            problem += " as the axes of the file are, to the catalog entry"
        elif len(candidates) == 1:
            problem = f"axes_order says {_listed(given)}, the shape something else; correct it"
        elif not all(_in_threes(given, shape) for shape in shapes.values()):
            problem = f"axes_order says {_listed(given)}, which makes gyroscopes not divisible by 3"
        else:
            return given
        files = ", ".join(_shapes(shapes))
        found = " or ".join(_listed(order) for order in candidates) or "none"
        raise InputError(
            f"{self._sensor} {files}: {problem}. Orders with gyroscopes divisible by 3 and at "
            f"least {_DOMINANCE} times more samples than recordings or gyroscopes: {found}"
        )

    def _entries(
        self, split: str, name: str, order: Order, count: Mapping[str, int], first: int
    ) -> list[LogEntry]:
        """The recordings of one file, IMU by IMU, numbered from ``first`` on."""
        path, imus = self._path / name, count["gyroscope"] // len(AXES)
        state = path.stat()
        file = [str(path), state.st_size, state.st_mtime_ns, order]
        return [
            LogEntry(
                imu + 1,
                first + recording,
                f"{name} recording {recording + 1}",
                partial(_read, path, order, imu, recording),
                size=state.st_size // (imus * count["recording"]),
                key=fingerprint([*file, imu, recording]),
                split=None if split == WHOLE else split,
            )
            for imu in range(imus)
            for recording in range(count["recording"])
        ]


def _check_entry(sensor: str, files: Mapping[str, str], axes_order: Sequence[str] | None) -> None:
    if set(files) not in ({"train", "test"}, {WHOLE}):
        raise InputError(f"{sensor}: files: expected train and test, or all, got {sorted(files)}")
    if len(set(files.values())) < len(files):
        raise InputError(
            f"{sensor}: files: train and test name the same file, {files['train']}; recordings "
            "to test on must be others than those trained on. Name it all to have it split"
        )
    if axes_order is not None and sorted(axes_order) != sorted(LAYOUT):
        raise InputError(
            f"{sensor}: axes_order: expected {', '.join(LAYOUT)} in the order of the file's "
            f"axes, got {list(axes_order)}"
        )


def _plausible(order: Order, shape: tuple[int, ...]) -> bool:
    size = dict(zip(order, shape, strict=True))
    others = max(size["recording"], size["gyroscope"])
    return _in_threes(order, shape) and size["sample"] >= _DOMINANCE * others


def _in_threes(order: Order, shape: tuple[int, ...]) -> bool:
    return shape[order.index("gyroscope")] % len(AXES) == 0


def _read(path: Path, order: Order, imu: int, recording: int) -> Log:
    """One recording of one IMU, out of a file that was found to be in order."""
    array = np.lib.format.open_memmap(path, mode="r")
    recordings_first = array.transpose([order.index(name) for name in LAYOUT])
    gyroscopes = slice(len(AXES) * imu, len(AXES) * (imu + 1))
    return Log(recordings_first[recording, gyroscopes].T.astype(np.float64))


def _shapes(shapes: Mapping[str, tuple[int, ...]]) -> list[str]:
    return [f"{name} of shape {shape}" for name, shape in shapes.items()]


def _listed(order: Order) -> str:
    return f"[{', '.join(order)}]"
