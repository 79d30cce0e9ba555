"""Simulated gyroscope noise: white (optionally with lag-1 correlation), flicker, random walk."""

import numpy as np
import scipy
from numpy.typing import ArrayLike, NDArray

from gyro_pipeline.conventions import InputError

_MA1_LIMIT = 0.5


def simulate_noise(
    generator: np.random.Generator,
    shape: tuple[int, ...],
    rate_hz: float,
    white_dps_rts: ArrayLike,
    lag1_correlation: float = 0.0,
    flicker_dps: float = 0.0,
    random_walk_dps_rts: float = 0.0,
) -> NDArray[np.float32]:
    """Zero-mean noise of stationary gyroscopes, independent between recordings.

    The mean of t seconds of the white part scatters by N / sqrt(t), so sigma = N sqrt(rate).
    With a lag-1 correlation it is the moving average x_i = e_i + theta e_(i-1), scaled so that its
    level at frequency zero remains N: sigma = N sqrt(rate / (1 + 2 lag1)).

    Args:
        generator: Source of randomness.
        shape: (..., n), n samples per recording.
        rate_hz: Samples per second.
        white_dps_rts: N, deg/s * sqrt(s), broadcast against ``shape[:-1]``.
        lag1_correlation: Correlation of successive samples of the white part, -0.5 to 0.5.
        flicker_dps: Bias instability B, deg/s; the floor of the Allan deviation is 0.664 B.
        random_walk_dps_rts: K, deg/s / sqrt(s), of a walk that starts at 0 at power-on; its
            variance after t seconds is K^2 t.

    Returns:
        (..., n), deg/s.

    Raises:
        InputError: The lag-1 correlation is not between -0.5 and 0.5.
    """
    if not -_MA1_LIMIT < lag1_correlation < _MA1_LIMIT:
        raise InputError(
            f"lag1_correlation: expected between -0.5 and 0.5, the limits for noise that is "
            f"correlated over one sample only, got {lag1_correlation}"
        )
    noise = generator.standard_normal(shape, dtype=np.float32)
    theta = 2 * lag1_correlation / (1 + np.sqrt(1 - 4 * lag1_correlation**2))
    if theta:
        _correlate(generator, noise, theta)
    scale = np.asarray(white_dps_rts, dtype=np.float64) * np.sqrt(rate_hz) / (1 + theta)
    noise *= scale[..., None].astype(np.float32)
    if flicker_dps:
        _add_flicker(generator, noise, flicker_dps)
    if random_walk_dps_rts:
        _add_random_walk(generator, noise, random_walk_dps_rts / np.sqrt(rate_hz))
    return noise


def warm_up(
    amplitude_dps: ArrayLike, time_constant_s: ArrayLike, samples: int, rate_hz: float
) -> NDArray[np.float64]:
    """Warm-up of the bias after power-on: amplitude times exp(-t / time constant).

    Args:
        amplitude_dps: (...), deg/s, at power-on.
        time_constant_s: (...), s, broadcast against the amplitudes.
        samples: n; sample i is taken at (i + 1/2) sample periods.
        rate_hz: Samples per second.

    Returns:
        (..., n), deg/s, to be added to noise and bias.
    """
    time_s = (np.arange(samples) + 0.5) / rate_hz
    decay = np.exp(-time_s / np.asarray(time_constant_s, np.float64)[..., None])
    return np.asarray(amplitude_dps, np.float64)[..., None] * decay


def _correlate(generator: np.random.Generator, noise: NDArray[np.float32], theta: float) -> None:
    """Replace white samples e by e_i + theta e_(i-1), in place."""
    for row in noise.reshape(-1, noise.shape[-1]):  # by recording, to keep temporaries small
        before = generator.standard_normal(dtype=np.float32)
        row[1:] += np.float32(theta) * row[:-1]
        row[0] += np.float32(theta) * before


def _add_flicker(
    generator: np.random.Generator, noise: NDArray[np.float32], instability_dps: float
) -> None:
    """Add noise of one-sided spectral density B^2 / (pi f), in place.

    This density has the Allan variance (2 ln 2 / pi) B^2 at every averaging time (IEEE Std 952
    states the two-sided density, which is half of it). Frequencies below one cycle in two
    recordings are left out: within a recording they are a constant, which is part of the turn-on
    spread. The spectrum has twice the length and half of the signal is used, because the inverse
    transform is periodic and would end a recording where it began.
    """
    length = scipy.fft.next_fast_len(2 * noise.shape[-1], real=True)
    k = np.arange(1, length // 2 + 1)
    # one-sided density = 2 |X_k|^2 length / rate for x_i = sum of X_k exp(2 pi j i k / length)
    amplitude = (instability_dps / (2 * np.sqrt(np.pi * k))).astype(np.float32)
    spectrum = np.zeros(k.size + 1, dtype=np.complex64)
    for row in noise.reshape(-1, noise.shape[-1]):
        parts = generator.standard_normal((k.size, 2), dtype=np.float32)
        spectrum[1:] = amplitude * parts.view(np.complex64)[:, 0]
        row[:] += scipy.fft.irfft(spectrum, length, norm="forward")[: row.size]


def _add_random_walk(
    generator: np.random.Generator, noise: NDArray[np.float32], step_dps: float
) -> None:
    """Add the running sum of independent steps, from the first sample on, in place."""
    for row in noise.reshape(-1, noise.shape[-1]):
        row[:] += step_dps * np.cumsum(generator.standard_normal(row.size))
