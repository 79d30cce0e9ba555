"""Noise figures from the overlapping Allan variance.

IEEE Std 952 models the Allan variance at averaging time t as

    sigma^2(t) = N^2 / t + (2 ln 2 / pi) B^2 + K^2 t / 3

with white noise N (angle random walk), bias instability B (flicker noise, whose floor is
0.664 B) and rate random walk K. For white noise the mean of t seconds has standard deviation
N / sqrt(t). N is used everywhere rather than the standard deviation of samples, since the two
are no longer equivalent if successive samples are correlated.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import scipy
from numpy.typing import NDArray

from gyro_pipeline.conventions import InputError
from gyro_pipeline.physics.bias import runs

SHORTEST_FIT_SAMPLES = 8
"""Shortest average for fits. Shorter ones show the correlation of successive samples (by an
anti-alias filter), for which the model has no term: a lag-1 correlation rho changes N^2 by the
factor 1 - 3 rho / (m (1 + 2 rho)) at m samples, 8 % at m = 8 for rho = -0.15."""

FLICKER_FLOOR = 2 * np.log(2) / np.pi
"""Allan variance of flicker noise in units of B^2."""

_POINTS = 20
_LONGEST_FRACTION = 5  # beyond a fifth of the recording, independent averages are too few
_TERMS = 3
_CLOSED = 10  # least ratio of an averaging time to a gap that is closed


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
    """Averaging times for a recording, spaced evenly in the logarithm.

    Args:
        n_samples: Length of the recording.
        rate_hz: Samples per second.

    Returns:
        (m,), s: increasing whole multiples of the sample period, from one sample to a fifth of
        the recording; at most 20, fewer for short recordings.
    """
    longest = max(1, n_samples // _LONGEST_FRACTION)
    factors = np.unique(np.rint(np.geomspace(1, longest, _POINTS)))
    return factors / rate_hz


def allan_variance(
    samples: NDArray[np.floating], rate_hz: float, times_s: NDArray[np.floating]
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Overlapping Allan variance of a recording (NIST SP1065, equation 11).

    It is the mean over the stretches between gaps, weighted by their numbers of differences. Gaps
    of up to a tenth of an averaging time are closed, as they hardly move samples; otherwise a few
    masked samples would make long averaging times impossible.

    Args:
        samples: (n,), deg/s; NaN where masked.
        rate_hz: Samples per second.
        times_s: (m,), s, whole multiples of the sample period, in any order.

    Returns:
        The variance (m,), (deg/s)^2, in the order of ``times_s``, and its number of differences,
        (m,). Where every stretch is shorter than two averages, these are NaN and 0.

    Raises:
        InputError: An averaging time is not a multiple of the sample period; allantools would
            silently change it.
    """
    factors = np.rint(times_s * rate_hz).astype(int)
    if not np.allclose(factors, times_s * rate_hz, rtol=1e-9) or factors.min() < 1:
        raise InputError(
            f"averaging times: expected whole multiples of the sample period {1 / rate_hz:g} s, "
            f"got {times_s}"
        )
    squares, counts = np.zeros(factors.shape), np.zeros(factors.shape, np.int64)
    gaps = runs(np.isnan(samples))  # start and end, exclusive, of each gap
    closed = np.searchsorted(np.sort(gaps[:, 1] - gaps[:, 0]), factors // _CLOSED, side="right")
    for group in (closed == number for number in np.unique(closed)):
        for stretch in _stretches(samples, gaps, factors[group].min() // _CLOSED):
            fits = group & (stretch.size > 2 * factors)
            count = np.where(fits, stretch.size - 2 * factors + 1, 0)
            squares[fits] += count[fits] * _overlapping(stretch, factors[fits], rate_hz)
            counts += count
    with np.errstate(invalid="ignore"):
        return squares / counts, counts


def fit_axes(
    times_s: NDArray[np.floating],
    variances: NDArray[np.floating],
    counts: NDArray[np.integer],
    duration_s: float | NDArray[np.floating],
    rate_hz: float,
) -> list[NoiseFigures]:
    """N, B and K of each axis from the Allan variances of several recordings.

    Args:
        times_s: Averaging times, (m,), seconds.
        variances: (recordings, axes, m), (deg/s)^2.
        counts: Numbers of differences, of a shape that broadcasts to that of the variances.
        duration_s: See :func:`fit_noise`.
        rate_hz: Samples per second.

    Raises:
        InputError: See :func:`fit_noise`.
    """
    shortest_s = SHORTEST_FIT_SAMPLES / rate_hz
    means = mean_variance(variances, counts)
    return [fit_noise(times_s, variance, duration_s, shortest_s) for variance in means]


def mean_variance(
    variances: NDArray[np.floating], counts: NDArray[np.integer]
) -> NDArray[np.float64]:
    """Mean of several recordings' Allan variances, weighted by their numbers of differences.

    Args:
        variances: (recordings, ..., m), (deg/s)^2.
        counts: The same shape, or one that broadcasts to it; 0 where a variance is NaN.

    Returns:
        (..., m), (deg/s)^2; NaN where no recording is long enough.
    """
    weights = np.broadcast_to(counts, variances.shape)
    with np.errstate(invalid="ignore"):
        return np.asarray(np.nansum(variances * weights, axis=0) / weights.sum(axis=0))


def _stretches(
    samples: NDArray[np.floating], gaps: NDArray[np.integer], longest: int
) -> Iterator[NDArray[np.floating]]:
    """Unmasked samples between gaps longer than ``longest`` samples; shorter gaps are closed."""
    ends = gaps[gaps[:, 1] - gaps[:, 0] > longest].ravel()
    for part in np.split(samples, ends)[::2]:
        yield part[~np.isnan(part)]


def _overlapping(
    samples: NDArray[np.floating], factors: NDArray[np.integer], rate_hz: float
) -> NDArray[np.float64]:
    """Overlapping Allan variance for averages of ``factors`` samples, in any order."""
    import allantools  # noqa: PLC0415 - it imports matplotlib

    if not factors.size:
        return np.empty(0)
    unique, position = np.unique(factors, return_inverse=True)  # allantools sorts as well
    _, deviation, _, _ = allantools.oadev(
        samples.astype(np.float64), rate=rate_hz, data_type="freq", taus=unique / rate_hz
    )
    return np.asarray(deviation[position] ** 2)


def fit_noise(
    times_s: NDArray[np.floating],
    variance: NDArray[np.floating],
    duration_s: float | NDArray[np.floating],
    shortest_s: float,
) -> NoiseFigures:
    """Fit nonnegative N, B and K to an Allan variance.

    This is a least-squares fit of relative errors, since the variance spans decades. The relative
    standard deviation of a measured Allan variance is sqrt(2 / degrees of freedom), with about
    ``duration_s / t`` degrees of freedom, whose root is the weight of a point.

    Args:
        times_s: (m,), s, averaging times.
        variance: (m,), (deg/s)^2, usually the mean over many recordings.
        duration_s: Length of a recording; if some recordings are too short for some averaging
            times, the length of the others for each time, (m,).
        shortest_s: Shorter averaging times are left out; ``SHORTEST_FIT_SAMPLES`` sample periods
            if successive samples may be correlated.

    Returns:
        The noise figures.

    Raises:
        InputError: Fewer than three averaging times have a variance, or one is not positive.
    """
    usable = (times_s >= shortest_s * (1 - 1e-9)) & ~np.isnan(variance)  # up to rounding
    times, measured = times_s[usable].astype(np.float64), variance[usable].astype(np.float64)
    if times.size < _TERMS or not np.all(measured > 0):
        raise InputError(
            f"noise fit: expected at least {_TERMS} averaging times from {shortest_s:g} s on, each "
            f"with a positive Allan variance, got {measured} at {times} s; the recording must be "
            "longer and not constant"
        )
    terms = np.stack([1 / times, np.full_like(times, FLICKER_FLOOR), times / 3], axis=1)
    durations_s = np.broadcast_to(duration_s, times_s.shape)[usable]
    weight = np.sqrt(durations_s / times) / measured
    squares, _ = scipy.optimize.nnls(terms * weight[:, None], measured * weight)
    white, instability, random_walk = np.sqrt(squares)
    return NoiseFigures(float(white), float(instability), float(random_walk))
