"""Bias of a stationary recording: its mean, and the settling time of the running mean.

Masked samples are NaN and do not count.
"""

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray


def recording_mean(samples: NDArray[np.floating]) -> NDArray[np.float64]:
    """Mean of each recording, the paper's ground truth (Stolero & Klein, arXiv 2409.00488).

    Args:
        samples: (..., n), deg/s; NaN where masked.

    Returns:
        (...), deg/s.
    """
    return np.asarray(np.nanmean(samples, axis=-1, dtype=np.float64))


def sample_sigma(samples: NDArray[np.floating]) -> NDArray[np.float64]:
    """Standard deviation of the samples of each recording about its mean.

    Args:
        samples: (..., n), deg/s; NaN where masked.

    Returns:
        (...), deg/s.
    """
    # with the argument dtype, NumPy would still round deviations to the precision of the samples
    return np.asarray(np.nanstd(samples.astype(np.float64), axis=-1, ddof=1))


def fill_masked(samples: NDArray[np.floating]) -> NDArray[np.floating]:
    """Replace masked samples by the mean of the others, which does not change the mean.

    Args:
        samples: (..., n), deg/s; NaN where masked.

    Returns:
        (..., n); the input itself if no sample is masked.
    """
    masked = np.isnan(samples)
    if not masked.any():
        return samples
    means = recording_mean(samples)[..., None].astype(samples.dtype)
    return np.where(masked, means, samples)


def runs(mask: NDArray[np.bool_]) -> NDArray[np.integer]:
    """Start and end, exclusive, of each run of true values, (run, 2)."""
    edges = np.concatenate([[False], mask, [False]])
    return np.flatnonzero(edges[1:] != edges[:-1]).reshape(-1, 2)


def windows_at(
    samples: NDArray[np.floating], size: int, starts: NDArray[np.integer]
) -> NDArray[np.floating]:
    """Windows of a recording, with masked samples replaced by the mean of their window.

    Args:
        samples: (..., n), deg/s; NaN where masked.
        size: Samples of a window.
        starts: First samples of the windows, which may overlap, (windows,).

    Returns:
        (..., windows, size), a copy.
    """
    return fill_masked(sliding_window_view(samples, size, axis=-1)[..., starts, :])


def settling_time_s(
    samples: NDArray[np.floating], rate_hz: float, tolerance_dps: float
) -> NDArray[np.float64]:
    """Earliest time from which the running mean stays within a band around the whole mean.

    Args:
        samples: (..., n), deg/s; NaN where masked.
        rate_hz: Samples per second.
        tolerance_dps: Half width of the band, deg/s.

    Returns:
        (...), s, between one sample period and the whole recording.
    """
    recordings = samples.reshape(-1, samples.shape[-1])
    # one recording at a time, as the float64 running means of all would take much memory
    times = [_settling_count(row, tolerance_dps) / rate_hz for row in recordings]
    return np.array(times, dtype=np.float64).reshape(samples.shape[:-1])


def _settling_count(recording: NDArray[np.floating], tolerance_dps: float) -> float:
    """Number of samples after which the running mean no longer leaves the band."""
    measured = np.flatnonzero(~np.isnan(recording))
    if not measured.size:
        return np.nan
    sums = np.cumsum(recording[measured], dtype=np.float64)
    running_mean = sums / np.arange(1, measured.size + 1)
    outside = np.flatnonzero(np.abs(running_mean - running_mean[-1]) > tolerance_dps)
    return float(measured[outside[-1] + 1] + 1) if outside.size else 1.0
