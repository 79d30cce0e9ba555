"""The Kalman filter of one stretch at rest: block means in, the bias and its variance out.

The mean of block k of each axis is

    y_k = X_k c + walk + flicker + white noise,    c = (bias at the start, warm-up's amplitude)

with X_k = (1, mean of exp(-t / time constant) in the block). The rate random walk starts at 0 with
the stretch, flicker is the sum of three AR(1) processes, and white noise has variance N^2 / block.
The filter runs over y and over the columns of X with the same gains, so its residuals are white:
e_y of variance S, and e_X. Generalised least squares, the sequential form of
:class:`gyro_pipeline.physics.recording_model.WindowModel`, then gives

    information = sum of e_X e_X' / S,    c = information^-1 (sum of e_X e_y / S)

so an unknown bias needs no large prior variance. Everything but y is independent of the data, so
the variance at any later time is known in advance.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

FLICKER_S = 120.0  # slower flicker than a cycle in twice this time is turn-on bias
# Three AR(1) processes. Their block means have, in estimates from 1 to 30 s, the covariance of
# B = 1 in recordings of FLICKER_S (tests/calibrator/test_filter.py).
_TIME_CONSTANTS_S = np.array([0.19990, 1.57091, 13.58328])
_VARIANCES = np.array([0.826513, 0.602418, 0.896548])
_WITHIN_BLOCK = 0.009284  # faster flicker, as white noise of a block of 0.5 s

_FREE_DPS = 1.0  # standard deviation of the warm-up amplitude where the power-on time is unknown


@dataclass(frozen=True, eq=False)
class Noise:
    """Noise figures of three axes (IEEE Std 952), (3,) each, and the warm-up."""

    white: Array  # N, deg/s * sqrt(s)
    instability: Array  # B, deg/s
    random_walk: Array  # K, deg/s / sqrt(s)
    # Mean and standard deviation of the amplitude at power-on, deg/s; time constant, s.
    warm_up: tuple[Array, Array, float] | None = None

    @property
    def floor_dps(self) -> Array:
        """The flicker floor of the Allan deviation, (3,): no average has a smaller error."""
        return np.sqrt(2 * np.log(2) / np.pi) * self.instability


class Estimate(NamedTuple):
    """An estimate from the data alone, (..., 3); variances are infinite before the first block.

    The current bias is ``transfer`` times the bias at the start, plus an independent part.
    """

    bias: Array  # the current one
    variance: Array
    start: Array  # the bias at the start
    start_variance: Array
    transfer: Array
    squares: Array  # sum of squared residuals over their variances
    freedom: Array  # (..., 1), degrees of freedom of the squares


class _Step(NamedTuple):
    """How the four processes, the walk first, move over a time step (exact integrals)."""

    keep: Array  # (4,), F
    forget: Array  # (4, 4), F F'
    read: Array  # (4,), H: the mean over the step, per value at its start
    added: Array  # (3, 4, 4), Q
    shared: Array  # (3, 4), covariance of the noise added to the end and to the mean
    white: Array  # (3,), R


@lru_cache(maxsize=64)
def _step(noise: Noise, step_s: float) -> _Step:
    d = step_s / _TIME_CONSTANTS_S
    decay, mean = np.exp(-d), -np.expm1(-d) / d
    flicker = noise.instability[:, None] ** 2 * _VARIANCES
    walk = noise.random_walk[:, None] ** 2 * step_s
    within = flicker * (2 * (d - 1 + decay) / d**2 - mean**2)
    white = noise.white**2 / step_s + _WITHIN_BLOCK * noise.instability**2
    return _Step(
        keep=(keep := np.append(1.0, decay)),
        forget=keep[:, None] * keep,
        read=np.append(1.0, mean),
        added=np.hstack([walk, flicker * (1 - decay**2)])[:, :, None] * np.eye(4),
        shared=np.hstack([walk / 2, flicker * (1 - decay) ** 2 / d]),
        white=white + walk[:, 0] / 3 + within.sum(axis=1),
    )


class Filter(NamedTuple):
    """The immutable state after some blocks: an update returns a new filter.

    In a :meth:`stack` of several filters, arrays have a leading axis.
    """

    noise: Noise
    block_s: float
    age_s: float | None  # from power-on to the start; None: the warm-up amplitude is free
    time_s: float  # since the start, gaps included
    reference: Array  # (3,), deg/s, the mean of the first block, subtracted from the data
    blocks: NDArray[np.integer] | int  # number of them so far
    states: Array  # (3, 4, 1 + p), walk and flicker in y and in each column of X
    covariance: Array  # (3, 4, 4), covariance of the states, (deg/s)^2
    information: Array  # (3, p, p), about c
    weighted: Array  # (3, p), the sum of e_X e_y / S
    squares: Array  # (3,), the sum of e_y^2 / S

    @classmethod
    def start(cls, noise: Noise, block_s: float, age_s: float | None = None) -> Self:
        """The filter before the first block."""
        p, zero = 1 if noise.warm_up is None else 2, np.zeros(3)
        flicker = noise.instability[:, None] ** 2 * _VARIANCES
        covariance = np.hstack([np.zeros((3, 1)), flicker])[:, :, None] * np.eye(4)
        information, weighted, squares = np.zeros((3, p, p)), np.zeros((3, p)), zero
        if noise.warm_up is not None:  # the prior of the amplitude counts as one more datum
            mean, spread, _ = noise.warm_up
            if age_s is None:
                mean, spread = zero, np.full(3, _FREE_DPS)
            information[:, 1, 1], weighted[:, 1] = 1 / spread**2, mean / spread**2
            squares = (mean / spread) ** 2
        sums = np.zeros((3, 4, 1 + p)), covariance, information, weighted, squares
        return cls(noise, block_s, age_s, 0.0, zero, 0, *sums)

    def update(self, mean: Array | None) -> tuple[Self, Array]:
        """Process the mean of a block, (3,), deg/s; None predicts the variances without data.

        The second result is the innovation (3,) in standard deviations; 0 at the first block.
        """
        reference = self.reference if self.blocks or mean is None else mean
        step = _step(self.noise, self.block_s)
        to_mean = self.covariance @ step.read
        variance = to_mean @ step.read + step.white
        columns = self._columns(0.0 if mean is None else mean - reference)
        residuals = columns - step.read @ self.states
        e_y, e_x = residuals[:, 0], residuals[:, 1:]
        added = step.keep * to_mean + step.shared
        gain, scaled = added / variance[:, None], e_x / variance[:, None]
        skipped = self.skip(self.block_s)
        following = skipped._replace(
            reference=reference,
            blocks=self.blocks + 1,
            states=skipped.states + gain[:, :, None] * residuals[:, None, :],
            covariance=skipped.covariance - added[..., None] * gain[:, None],
            information=self.information + scaled[:, :, None] * e_x[:, None, :],
            weighted=self.weighted + scaled * e_y[:, None],
            squares=self.squares + e_y**2 / variance,
        )
        if mean is None or not self.blocks:
            return following, np.zeros(3)
        c, covariance = self._constants()
        spread = variance + (_matvec(covariance, e_x) * e_x).sum(axis=1)
        return following, (e_y - (e_x * c).sum(axis=1)) / np.sqrt(spread)

    def skip(self, seconds: float) -> Self:
        """Move on over a gap without data."""
        step = _step(self.noise, seconds)
        return self._replace(
            time_s=self.time_s + seconds,
            states=step.keep[:, None] * self.states,
            covariance=step.forget * self.covariance + step.added,
        )

    def _columns(self, y: Array | float) -> Array:
        """Y about the reference and the columns of X, 1 and the mean decay, (3, 1 + p)."""
        columns = np.ones((3, self.states.shape[-1]))
        columns[:, 0] = y
        if self.noise.warm_up is not None:
            length = self.block_s / self.noise.warm_up[2]
            columns[:, 2] = self._decay() * -np.expm1(-length) / length
        return columns

    def _decay(self) -> float:
        """The share that is left of the warm-up amplitude at power-on, or else at the start."""
        constant_s = self.noise.warm_up[2] if self.noise.warm_up else np.inf
        return float(np.exp(-(self.time_s + (self.age_s or 0.0)) / constant_s))

    def _constants(self) -> tuple[Array, Array]:
        """The constants c from the data alone, (..., p), and their covariance, (..., p, p)."""
        scalar = self.information.shape[-1] == 1
        covariance = np.asarray(1 / self.information if scalar else np.linalg.inv(self.information))
        return _matvec(covariance, self.weighted), covariance

    def warm_up(self) -> tuple[Array, Array]:
        """The remaining warm-up and its standard deviation, (3,), deg/s."""
        c, covariance = self._constants()
        return self._decay() * c[:, -1], self._decay() * np.sqrt(covariance[:, -1, -1])

    def stack(self, filters: Sequence[Self]) -> Self:
        """Later filters of the same stretch, stacked along a leading axis."""
        arrays = (np.array(values) for values in list(zip(*filters, strict=True))[4:])
        return self.__class__(*self[:4], *arrays)

    def ahead(self, blocks: int) -> tuple[Self, Self]:
        """The filter after some future blocks, and the stack of the filters after each of them."""
        filters = [self]
        for _ in range(blocks):
            filters.append(filters[-1].update(None)[0])
        return filters[-1], self.stack(filters[1:])

    def estimate(self) -> Estimate:
        """The estimate from the data alone; of a stack, one for each filter."""
        if not np.all(self.blocks):
            unknown, infinite, zero = np.full(3, np.nan), np.full(3, np.inf), np.zeros(3)
            return Estimate(unknown, infinite, unknown, infinite, zero + 1, zero, zero[:1])
        c, covariance = self._constants()
        walk = self.states[..., 0, :]  # in y, and in each column of X
        gradient = -walk[..., 1:]  # of the bias now, with respect to c
        gradient[..., 0] += 1
        shared = _matvec(covariance, gradient)
        free = self.noise.warm_up is not None and self.age_s is None
        return Estimate(
            bias=self.reference + walk[..., 0] + (gradient * c).sum(axis=-1),
            variance=self.covariance[..., 0, 0] + (shared * gradient).sum(axis=-1),
            start=self.reference + c[..., 0],
            start_variance=covariance[..., 0, 0],
            transfer=shared[..., 0] / covariance[..., 0, 0],
            squares=self.squares - (c * self.weighted).sum(axis=-1),
            freedom=np.maximum(np.asarray(self.blocks, float)[..., None] - 1 - free, 0),
        )


def _matvec(matrices: Array, vectors: Array) -> Array:
    return np.asarray((matrices @ vectors[..., None])[..., 0])
