"""Warm-up: a bias that settles after power-on, measured from recordings, and its consequences.

The bias is b + a exp(-t / time constant), with an amplitude a that is about the same at every
power-on. The running mean of the first T0 seconds then differs from the mean of the recording by a
times

    d = w(T0) - w(T),    w(t) = (time constant / t) (1 - exp(-t / time constant))

An estimator that knows the device can correct this difference by a constant.
"""

from dataclasses import dataclass

import numpy as np
import scipy
from numpy.typing import ArrayLike, NDArray

from gyro_pipeline.conventions import PAPER
from gyro_pipeline.physics.ceiling import ceiling_rmse, pooled, running_mean_rmse
from gyro_pipeline.physics.recording_model import block_edges, block_means, profiles

Array = NDArray[np.float64]

_BLOCK_S = 1.0
LAST = 0.25
"""Share of a recording, at its end, whose mean is subtracted."""


@dataclass(frozen=True)
class Settling:
    """Mean rate against time after power-on, less the mean of each recording's last part.

    Attributes:
        time_s: (m,), centres of the blocks.
        rate: (axes, m), deg/s, mean over the recordings.
        half: Half of its 95 % interval over recordings, same shape; NaN for a single recording.
    """

    time_s: Array
    rate: Array
    half: Array


def settling(recordings: NDArray[np.floating], rate_hz: float) -> Settling:
    """The common settling of recordings after power-on.

    Args:
        recordings: (n, axes, samples), deg/s, from power-on; no NaN.
        rate_hz: Samples per second.
    """
    edges = block_edges(recordings.shape[-1], round(_BLOCK_S * rate_hz))
    means = block_means(recordings, edges)
    last = means.shape[-1] - max(1, round(LAST * means.shape[-1]))
    centred = means - means[..., last:].mean(axis=-1, keepdims=True)
    time_s = (edges[:-1] + edges[1:]) / 2 / rate_hz
    return Settling(time_s, centred.mean(axis=0), _half(centred))


@dataclass(frozen=True)
class CommonWarmUp:
    """The common amplitude of recordings, for a time constant.

    Attributes:
        amplitude: (axes,), deg/s.
        half: Half of its 95 % interval over recordings, (axes,), deg/s.
        p: Chance of an amplitude at least as large where there is no warm-up, (axes,); NaN for a
            single recording.
    """

    amplitude: Array
    half: Array
    p: Array

    @property
    def bound(self) -> Array:
        """The largest absolute amplitude within the interval, (axes,), deg/s."""
        return np.asarray(np.abs(self.amplitude) + self.half)


def fit_common_warm_up(
    recordings: NDArray[np.floating], rate_hz: float, time_constant_s: float
) -> CommonWarmUp:
    """Fit the amplitude and the level of each recording by least squares; average the amplitudes.

    Args:
        recordings: (n, axes, samples), deg/s, from power-on; no NaN.
        rate_hz: Samples per second.
        time_constant_s: Time constant of all recordings.
    """
    edges = block_edges(recordings.shape[-1], round(_BLOCK_S * rate_hz))
    decay = profiles(edges, rate_hz, time_constant_s)[:, 1]
    shape = decay - decay.mean()
    amplitudes = block_means(recordings, edges) @ shape / (shape @ shape)
    mean, freedom = amplitudes.mean(axis=0), len(amplitudes) - 1
    p = 2 * scipy.stats.t.sf(np.abs(mean) / _standard_error(amplitudes), freedom)
    return CommonWarmUp(mean, _half(amplitudes), np.asarray(p))


def amplitude_needed(
    gain: float,
    noise: ArrayLike,
    turn_on_spread: ArrayLike,
    window_s: float,
    recording_s: float,
    time_constant_s: ArrayLike,
) -> Array:
    """Amplitude of the warm-up that would make an accuracy gain in first windows the ceiling.

    The best estimator knows the amplitude, so a warm-up does not change its error. The running
    mean's error increases by a d.

    Args:
        gain: A, a fraction.
        noise: N of each axis, deg/s sqrt(s).
        turn_on_spread: tau of each axis, deg/s.
        window_s: T0.
        recording_s: T.
        time_constant_s: Time constants of the warm-up, any shape.

    Returns:
        deg/s, same shape as ``time_constant_s``; 0 where the gain needs no warm-up.
    """
    lengths_and_truth = window_s, recording_s, PAPER
    best = pooled(ceiling_rmse(noise, turn_on_spread, *lengths_and_truth))
    mean = pooled(running_mean_rmse(noise, *lengths_and_truth))
    error = np.sqrt(np.maximum((best / (1 - gain)) ** 2 - mean**2, 0.0))
    time = np.asarray(time_constant_s, np.float64)
    of_window, of_recording = (
        time / length * -np.expm1(-length / time) for length in (window_s, recording_s)
    )
    return np.asarray(error / (of_window - of_recording))


def _half(values: Array) -> Array:
    """Half of the 95 % interval of a mean over the first axis."""
    return np.asarray(scipy.stats.t.ppf(0.975, len(values) - 1) * _standard_error(values))


def _standard_error(values: Array) -> Array:
    """Standard error of a mean over the first axis; NaN for a single value."""
    n = len(values)
    if n == 1:
        return np.full(values.shape[1:], np.nan)
    return np.asarray(values.std(axis=0, ddof=1) / np.sqrt(n))
