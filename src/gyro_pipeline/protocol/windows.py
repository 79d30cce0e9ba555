"""Windows: what an estimator sees of a recording."""

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from gyro_pipeline.conventions import InputError


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


def cut_windows(samples: np.ndarray, size: int, starts: np.ndarray | None = None) -> np.ndarray:
    """Windows of a recording; all non-overlapping ones from its start unless others are named.

    Args:
        samples: Shape (..., n).
        size: Samples per window.
        starts: First samples of the windows, which may overlap.

    Returns:
        Shape (..., windows, size). Without ``starts`` a view, n // size windows, where the last
        n % size samples are in none; with them a copy.
    """
    if starts is not None:
        return sliding_window_view(samples, size, axis=-1)[..., starts, :]
    count = samples.shape[-1] // size
    return samples[..., : count * size].reshape(*samples.shape[:-1], count, size)
