"""Recordings that come one at a time, in one array cut to the shortest."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray


class Stack:
    """Keeps recordings whose length is not known before in one array: each is in memory once.

    Args:
        imus: Their numbers, in the order of the array.
        recordings: Likewise.
        channels: Of a recording.
    """

    def __init__(self, imus: Sequence[int], recordings: Sequence[int], channels: int) -> None:
        self._imus = {number: place for place, number in enumerate(imus)}
        self._recordings = {number: place for place, number in enumerate(recordings)}
        self._channels = channels
        self._added = np.zeros((len(imus), len(recordings)), dtype=bool)
        self._array: NDArray[np.float32] | None = None

    def add(self, imu: int, recording: int, samples: NDArray[np.float32]) -> None:
        """Keep a recording, (channels, n), or as much of it as the first one had."""
        if self._array is None:
            shape = (*self._added.shape, self._channels, samples.shape[-1])
            # memory is taken when it is written to, so a long first one costs nothing
            self._array = np.empty(shape, dtype=np.float32)
        where = self._imus[imu], self._recordings[recording]
        fitting = min(samples.shape[-1], self._array.shape[-1])
        self._array[where][:, :fitting] = samples[:, :fitting]
        self._added[where] = True

    def cut(self, kept: NDArray[np.bool_], samples: int) -> NDArray[np.float32] | None:
        """Take the array; afterwards nothing is left here.

        Args:
            kept: (imu, recording), what is to stay.
            samples: Of each recording; no more than the shortest of those to stay has.

        Returns:
            (imu, recording, channel, samples) of the IMUs and recordings of which something is to
            stay, in place of the old array; NaN where nothing is. None if nothing was added.
        """
        array, self._array = self._array, None
        if array is None:
            return None
        array[~(kept & self._added), :, :samples] = np.nan
        imus, recordings = np.flatnonzero(kept.any(1)), np.flatnonzero(kept.any(0))
        size = self._channels * samples
        flat = array.reshape(-1)
        # towards the front, so that nothing is overwritten before it was moved
        for place, (imu, recording) in enumerate((i, r) for i in imus for r in recordings):
            moved = array[imu, recording, :, :samples].reshape(-1)
            flat[place * size : (place + 1) * size] = moved
        shape = len(imus), len(recordings), self._channels, samples
        return flat[: int(np.prod(shape))].reshape(shape)
