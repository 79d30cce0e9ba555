"""Noise figures from the overlapping Allan variance.

IEEE Std 952 models the Allan variance at averaging time t as

    sigma^2(t) = N^2 / t + (2 ln 2 / pi) B^2 + K^2 t / 3

with white noise N (angle random walk), bias instability B (flicker noise, whose floor is
0.664 B) and rate random walk K. For white noise the mean of t seconds has standard deviation
N / sqrt(t), which is why N and not the sample sigma is used everywhere: the two differ as soon
as successive samples are correlated.
"""

from dataclasses import dataclass

import allantools
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import nnls

from gyro_pipeline.conventions import InputError

SHORTEST_FIT_SAMPLES = 8
"""Shorter averages show how successive samples are correlated (by an anti-alias filter), for which
the model has no term: a lag-1 correlation rho changes N^2 by the factor
1 - 3 rho / (m (1 + 2 rho)) at m samples, 8 % at m = 8 for rho = -0.15."""

FLICKER_FLOOR = 2 * np.log(2) / np.pi
"""Allan variance of flicker noise in units of B^2."""

_POINTS = 20
_LONGEST_FRACTION = 5  # of the recording: beyond, too few independent averages are left
_TERMS = 3


@dataclass(frozen=True)
class NoiseFigures:
    """The three terms of the Allan variance (IEEE Std 952)."""

    white: float
    """N, deg/s * sqrt(s)."""
    instability: float
    """B, deg/s."""
    random_walk: float
    """K, deg/s / sqrt(s)."""


def averaging_times_s(n_samples: int, rate_hz: float) -> NDArray[np.float64]:
    """Averaging times for one recording, spaced evenly in the logarithm.

    Args:
        n_samples: Length of the recording.
        rate_hz: Samples per second.

    Returns:
        (m,), s: increasing whole multiples of the sample period, from one sample to a fifth of
        the recording; at most 20, fewer where the recording is short.
    """
    longest = max(1, n_samples // _LONGEST_FRACTION)
    factors = np.unique(np.rint(np.geomspace(1, longest, _POINTS)))
    return factors / rate_hz


def allan_variance(
    samples: NDArray[np.floating], rate_hz: float, times_s: NDArray[np.floating]
) -> NDArray[np.float64]:
    """Overlapping Allan variance of one recording (NIST SP1065, equation 11).

    Args:
        samples: (n,), deg/s.
        rate_hz: Samples per second.
        times_s: (m,), s, whole multiples of the sample period, in any order.

    Returns:
        (m,), (deg/s)^2, in the order of ``times_s``; NaN where the recording holds NaN.

    Raises:
        InputError: An averaging time is no multiple of the sample period or too long. allantools
            itself would move or drop it without a word.
    """
    factors = np.rint(times_s * rate_hz).astype(int)
    longest = (samples.size - 1) // 2
    if not np.allclose(factors, times_s * rate_hz, rtol=1e-9) or factors.min() < 1:
        raise InputError(
            f"averaging times: expected whole multiples of the sample period {1 / rate_hz:g} s, "
            f"got {times_s}"
        )
    if factors.max() > longest:
        raise InputError(
            f"averaging time {times_s.max():g} s: a recording of {samples.size / rate_hz:g} s "
            f"allows {longest / rate_hz:g} s at most"
        )
    if np.isnan(samples).any():  # allantools cuts NaN off the ends
        return np.full(factors.shape, np.nan)
    unique, position = np.unique(factors, return_inverse=True)  # allantools sorts as well
    _, deviation, _, _ = allantools.oadev(
        samples.astype(np.float64), rate=rate_hz, data_type="freq", taus=unique / rate_hz
    )
    return np.asarray(deviation[position] ** 2)


def fit_noise(
    times_s: NDArray[np.floating],
    variance: NDArray[np.floating],
    duration_s: float,
    shortest_s: float,
) -> NoiseFigures:
    """Fit N, B and K, none of them negative, to an Allan variance.

    Least squares on relative errors, since the variance spans decades. The relative scatter of a
    measured Allan variance is sqrt(2 / degrees of freedom), of which there are about
    ``duration_s / t``, so a point weighs by their root.

    Args:
        times_s: (m,), s, averaging times.
        variance: (m,), (deg/s)^2, usually the mean over many recordings.
        duration_s: Length of one recording.
        shortest_s: Shorter averaging times are left out; ``SHORTEST_FIT_SAMPLES`` sample periods
            where successive samples may be correlated.

    Returns:
        The noise figures.

    Raises:
        InputError: Fewer than three averaging times are left, or a variance is not positive.
    """
    kept = times_s >= shortest_s * (1 - 1e-9)  # a time that is equal but for rounding is kept
    times, measured = times_s[kept].astype(np.float64), variance[kept].astype(np.float64)
    if times.size < _TERMS or not np.all(measured > 0):
        raise InputError(
            f"noise fit: expected at least {_TERMS} averaging times from {shortest_s:g} s on, each "
            f"with a positive Allan variance, got {measured} at {times} s; the recording must be "
            "longer, without NaN and not constant"
        )
    terms = np.stack([1 / times, np.full_like(times, FLICKER_FLOOR), times / 3], axis=1)
    weight = np.sqrt(duration_s / times) / measured
    squares, _ = nnls(terms * weight[:, None], measured * weight)
    white, instability, random_walk = np.sqrt(squares)
    return NoiseFigures(float(white), float(instability), float(random_walk))
