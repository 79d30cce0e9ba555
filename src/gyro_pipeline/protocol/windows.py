"""Windows: what an estimator sees of a recording.

This is where masked samples, those that hold no measurement, are dealt with: a window that lost
more than a share of its samples is dropped; in the others they become the window's own mean. So
nothing that sees windows meets NaN.
"""

from collections.abc import Sequence

import numpy as np
import xarray as xr
from numpy.lib.stride_tricks import sliding_window_view

from gyro_pipeline.conventions import InputError
from gyro_pipeline.physics.bias import fill_masked
from gyro_pipeline.protocol.recordings import one_by_one

LARGEST_MASKED_SHARE = 0.1
"""Of a window's samples: where more are masked, the window is left out."""


def window_size(window_s: float, rate_hz: float, recording_samples: int, where: str) -> int:
    """Samples of a window.

    Args:
        window_s: Calibration time T0, seconds.
        rate_hz: Sample rate, Hz.
        recording_samples: Samples of a whole recording.
        where: What an error message calls the recordings, e.g. the sensor.

    Raises:
        InputError: If the window is longer than the recording.
    """
    size = round(window_s * rate_hz)
    if not 1 <= size <= recording_samples:
        raise InputError(
            f"{where}: a window of {window_s:g} s is {size} samples at {rate_hz:.5g} Hz, but a "
            f"recording has {recording_samples} ({recording_samples / rate_hz:.4g} s); "
            "choose windows_s within it"
        )
    return size


def window_starts(samples: int, size: int, stride: int) -> np.ndarray:
    """First samples of all windows that fit into a recording, ``stride`` samples apart."""
    return np.arange(0, samples - size + 1, stride)


def usable_starts(
    masked: np.ndarray,
    size: int,
    starts: np.ndarray | None = None,
    largest_masked_share: float = LARGEST_MASKED_SHARE,
) -> np.ndarray:
    """First samples of the windows that are not dropped.

    Args:
        masked: Whether a sample of the recording holds no measurement, shape (n,).
        size: Samples per window.
        starts: First samples of the windows; None for all non-overlapping ones from the start on.
        largest_masked_share: Of a window's samples that may be masked.
    """
    if starts is None:
        starts = window_starts(len(masked), size, size)
    if not masked.any():
        return starts
    before = np.concatenate([[0], np.cumsum(masked)])
    return starts[before[starts + size] - before[starts] <= largest_masked_share * size]


def cut_windows(samples: np.ndarray, size: int, starts: np.ndarray | None = None) -> np.ndarray:
    """Windows of a recording; all non-overlapping ones from its start unless others are named.

    Args:
        samples: Shape (..., n); NaN where masked.
        size: Samples per window.
        starts: First samples of the windows, which may overlap.

    Returns:
        Shape (..., windows, size), without the windows that :func:`usable_starts` drops, and
        without NaN. Where none is masked and ``starts`` are None a view, n // size windows, where
        the last n % size samples are in none; else a copy.
    """
    masked = np.isnan(samples).reshape(-1, samples.shape[-1]).any(axis=0)
    if masked.any():
        starts = usable_starts(masked, size, starts)
    if starts is not None:
        return windows_at(samples, size, starts)
    count = samples.shape[-1] // size
    return samples[..., : count * size].reshape(*samples.shape[:-1], count, size)


def windows_at(samples: np.ndarray, size: int, starts: np.ndarray) -> np.ndarray:
    """Windows (..., windows, size) of samples (..., n), none dropped, without NaN."""
    return fill_masked(sliding_window_view(samples, size, axis=-1)[..., starts, :])


class UsableWindows:
    """How many non-overlapping windows the recordings of a sensor, all of one length, give.

    A recording without one trains no network and tests none.

    Args:
        recordings: Each is read once, here.
    """

    def __init__(self, recordings: xr.Dataset) -> None:
        self._samples = recordings.sizes["sample"]
        self._masked: dict[tuple[int, int], np.ndarray | None] = {}
        for imu, number, samples in one_by_one(recordings):
            masked = np.isnan(samples).any(axis=0)
            self._masked[imu, number] = masked if masked.any() else None

    def count(self, imus: Sequence[int], number: int, size: int) -> int:
        """Windows of ``size`` samples of IMUs side by side; 0 where one lacks the recording."""
        return len(self._starts(imus, number, size))

    def losses(self, size: int) -> str:
        """Which windows of ``size`` samples are left out, in words; empty where none is."""
        starts = {place: self._starts(place[:1], place[1], size) for place in self._masked}
        total = len(starts) * (self._samples // size)
        dropped = total - sum(map(len, starts.values()))
        if not dropped:
            return ""
        parts = [
            f"{dropped} of {total} lost more than {LARGEST_MASKED_SHARE:.0%} of their samples and "
            "are left out"
        ]
        late = [place for place, own in starts.items() if len(own) and own[0]]
        lost = [place for place, own in starts.items() if not len(own)]
        if late:
            first = starts[late[0]][0] // size + 1
            parts.append(f"the first one used of {_named(late)} is window {first}")
        if lost:
            parts.append(f"none is left of {_named(lost)}, so it trains no network and tests none")
        return "; ".join(parts)

    def _starts(self, imus: Sequence[int], number: int, size: int) -> np.ndarray:
        places = [(imu, number) for imu in imus]
        if not all(place in self._masked for place in places):
            return np.empty(0, np.intp)
        masked = np.zeros(self._samples, bool)
        for place in places:
            own = self._masked[place]
            masked |= False if own is None else own
        return usable_starts(masked, size)


def _named(places: Sequence[tuple[int, int]]) -> str:
    """The first place, and how many more there are."""
    imu, number = places[0]
    more = f" (and of {len(places) - 1} more)" if len(places) > 1 else ""
    return f"IMU {imu} recording {number}{more}"
