"""Recordings that are copies of one another, exact or nearly so.

Two recordings of a sensor share no noise. Copies do, also where one has a little noise added, an
offset, a factor, a shift of a sample, or was resampled. Their phase correlation (Kuglin & Hines
1975) shows it: the mean over frequencies of the cosine of the difference of their phases. A hum or
a drift that recordings share is in few frequencies, and so does not count.
"""

from dataclasses import dataclass

import numpy as np
import scipy
from numpy.typing import NDArray

SAMPLES = 4096
"""Of a recording that are compared, the first ones."""

LARGEST = 0.3
"""Correlation above which recordings are copies; by chance 0.08 among all pairs of 400."""

_LAGS = 3
_CHANCE = 7.0  # standard deviations, for short recordings


@dataclass(frozen=True)
class NearCopy:
    """Two recordings, by their place in the list, and their correlation."""

    first: int
    second: int
    correlation: float


def near_copies(recordings: NDArray[np.floating]) -> list[NearCopy]:
    """Pairs of recordings of which one is a copy of the other, on some axis.

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
        heard = sizes > 1e-9 * samples * np.nanmax(np.abs(recordings), initial=1.0)
        phases = np.divide(spectra, sizes, out=np.zeros_like(spectra), where=heard)
        phases = phases.astype(np.complex64)
        for turn in turns.astype(np.complex64):  # shifts forward; backward ones are transposed
            np.maximum(most, (phases @ (phases * turn).conj().T).real / turn.size, out=most)
    most = np.triu(np.maximum(most, most.T), 1)
    limit = max(LARGEST, _CHANCE / np.sqrt(samples))
    pairs = zip(*(places.tolist() for places in np.nonzero(most > limit)), strict=True)
    return [NearCopy(first, second, float(most[first, second])) for first, second in pairs]
