"""Windows: what an estimator sees of a recording.

This is where masked samples, those that hold no measurement, are dealt with: a window that lost
more than a share of its samples is dropped; in the others they become the window's own mean. So
nothing that sees windows meets NaN.
"""

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from gyro_pipeline.conventions import InputError
from gyro_pipeline.physics.bias import fill_masked


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
    largest_masked_share: float = 0.1,
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
        return fill_masked(sliding_window_view(samples, size, axis=-1)[..., starts, :])
    count = samples.shape[-1] // size
    return samples[..., : count * size].reshape(*samples.shape[:-1], count, size)
