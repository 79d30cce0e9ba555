"""Detection of recordings that are exact or near copies of one another.

Two recordings of a sensor share no noise. Copies do, even with a little noise added, an offset, a
factor, a shift of a sample, or after resampling. Their phase correlation (Kuglin & Hines 1975)
shows it: the mean over frequencies of the cosine of the difference of their phases. A common hum or
drift is in few frequencies, and so does not count.
"""

from dataclasses import dataclass

import numpy as np
import scipy
from numpy.typing import NDArray

SAMPLES = 4096
"""Number of samples that are compared, from the start of a recording."""

MAX_CORRELATION = 0.3
"""Recordings with a higher correlation are copies; chance makes 0.08 among 400 recordings."""

_LAGS = 3
_SIGMAS = 7.0  # standard deviations that are due to chance, for short recordings


@dataclass(frozen=True)
class NearCopy:
    """Two recordings, by their number in the list, and their correlation."""

    first: int
    second: int
    correlation: float


def near_copies(recordings: NDArray[np.floating]) -> list[NearCopy]:
    """Find pairs of recordings that are copies on at least one axis.

    Args:
        recordings: (n, axes, samples), deg/s; NaN where masked.
    """
    count, axes, samples = recordings.shape
    taper = np.hanning(samples)
    turns = np.exp(2j * np.pi * np.arange(_LAGS + 1)[:, None] * scipy.fft.rfftfreq(samples))
    most = np.zeros((count, count), np.float32)
    for axis in range(axes):
        rates = recordings[:, axis] - np.nanmean(recordings[:, axis], axis=-1, keepdims=True)
        spectra = scipy.fft.rfft(np.nan_to_num(rates) * taper)
        sizes = np.abs(spectra)
        significant = sizes > 1e-9 * samples * np.nanmax(np.abs(recordings), initial=1.0)
        phases = np.divide(spectra, sizes, out=np.zeros_like(spectra), where=significant)
        phases = phases.astype(np.complex64)
        for turn in turns.astype(np.complex64):  # shifts forward; backward ones are transposed
            np.maximum(most, (phases @ (phases * turn).conj().T).real / turn.size, out=most)
    most = np.triu(np.maximum(most, most.T), 1)
    limit = max(MAX_CORRELATION, _SIGMAS / np.sqrt(samples))
    pairs = zip(*(numbers.tolist() for numbers in np.nonzero(most > limit)), strict=True)
    return [NearCopy(first, second, float(most[first, second])) for first, second in pairs]
