"""Bias of a stationary recording: its mean, and how long the running mean takes to settle."""

import numpy as np
from numpy.typing import NDArray


def recording_mean(samples: NDArray[np.floating]) -> NDArray[np.float64]:
    """Mean of each recording, the paper's ground truth (Stolero & Klein, arXiv 2409.00488).

    Args:
        samples: (..., n), deg/s.

    Returns:
        (...), deg/s; NaN for a recording that holds NaN.
    """
    return np.asarray(np.mean(samples, axis=-1, dtype=np.float64))


def settling_time_s(
    samples: NDArray[np.floating], rate_hz: float, tolerance_dps: float
) -> NDArray[np.float64]:
    """Earliest time from which the running mean stays within a band around the whole mean.

    Args:
        samples: (..., n), deg/s.
        rate_hz: Samples per second.
        tolerance_dps: Half width of the band, deg/s.

    Returns:
        (...), s, between one sample period and the whole recording; NaN for a recording that
        holds NaN.
    """
    counts = np.arange(1, samples.shape[-1] + 1)
    recordings = samples.reshape(-1, samples.shape[-1])
    # one recording at a time: its running mean is float64, the whole set would be twice the input
    times = [_settled_count(row, counts, tolerance_dps) / rate_hz for row in recordings]
    return np.array(times, dtype=np.float64).reshape(samples.shape[:-1])


def _settled_count(
    recording: NDArray[np.floating], counts: NDArray[np.integer], tolerance_dps: float
) -> float:
    """Number of samples after which the running mean no longer leaves the band."""
    running_mean = np.cumsum(recording, dtype=np.float64) / counts
    if np.isnan(running_mean[-1]):
        return np.nan
    outside = np.flatnonzero(np.abs(running_mean - running_mean[-1]) > tolerance_dps)
    return float(counts[outside[-1] + 1]) if outside.size else 1.0
