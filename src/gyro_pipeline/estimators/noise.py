"""Noise figures of a device from its training recordings."""

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from gyro_pipeline.estimators.base import duration_s, known_imus, samples_of
from gyro_pipeline.physics.allan import (
    SHORTEST_FIT_SAMPLES,
    NoiseFigures,
    allan_variance,
    averaging_times_s,
    fit_noise,
)


def allan_fit(recordings: xr.Dataset, imu: int) -> list[NoiseFigures]:
    """N, B and K of each axis, from the Allan variance averaged over recordings.

    Args:
        recordings: Training recordings.
        imu: The device; one that is not among them has the average of all.

    Returns:
        One per axis.
    """
    rate_hz = float(recordings.attrs["rate_hz"])
    times = averaging_times_s(recordings.sizes["sample"], rate_hz)
    shortest_s = SHORTEST_FIT_SAMPLES / rate_hz
    times = times[times >= shortest_s * (1 - 1e-9)]
    rates = np.concatenate([samples_of(recordings, one) for one in known_imus(recordings, imu)])
    return [
        fit_noise(
            times,
            np.mean([allan_variance(row, rate_hz, times) for row in rates[:, axis]], axis=0),
            duration_s(recordings),
            shortest_s,
        )
        for axis in range(rates.shape[1])
    ]


def white_noise(recordings: xr.Dataset, imu: int) -> NDArray[np.float64]:
    """N of each axis from :func:`allan_fit`, (axes,), deg/s sqrt(s)."""
    return np.array([figures.white for figures in allan_fit(recordings, imu)])
