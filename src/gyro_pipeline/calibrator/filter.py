"""The Kalman filter of one stretch at rest: block means in, the bias and its variance out.

The mean of block k of each axis is

    y_k = X_k c + walk + flicker + white noise,    c = (bias at the start, warm-up's amplitude)

with X_k = (1, mean of exp(-t / time constant) in the block). The rate random walk starts at 0 with
the stretch, flicker is the sum of three AR(1) processes, and white noise has variance N^2 / block.
The filter runs over y and over the columns of X with the same gains, so what it leaves of them is
white: e_y of variance S, and e_X. Then (generalised least squares, the sequential form of
:class:`gyro_pipeline.physics.recording_model.WindowModel`)

    information = sum of e_X e_X' / S,    c = information^-1 (sum of e_X e_y / S)

and a bias that nothing is known of needs no large variance anywhere. All but y is independent of
the data, so the variance at any later time is known now.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]

FLICKER_S = 120.0
"""Flicker counts down to one cycle in two such times; what is slower is turn-on bias."""

# Three AR(1) processes whose block means have, in the sums that estimates of 1 to 30 s make, the
# covariance of B = 1 in recordings of FLICKER_S: variances to 0.02 %, RMSE to 0.001 %
# (tests/calibrator/test_filter.py compares them with the exact ones).
_TIME_CONSTANTS_S = np.array([0.19990, 1.57091, 13.58328])
_VARIANCES = np.array([0.826513, 0.602418, 0.896548])
_WITHIN_BLOCK = 0.009284  # faster flicker, as white noise of a block of 0.5 s

_FREE_DPS = 1.0  # standard deviation of an amplitude that nothing is known of


@dataclass(frozen=True)
class Noise:
    """Noise figures of three axes (IEEE Std 952), and the warm-up.

    Attributes:
        white: N, (3,), deg/s * sqrt(s).
        instability: B, (3,), deg/s.
        random_walk: K, (3,), deg/s / sqrt(s).
        warm_up: Mean and standard deviation of the amplitude at power-on, each (3,), deg/s, and the
            time constant in seconds; None where the device has no warm-up.
    """

    white: Array
    instability: Array
    random_walk: Array
    warm_up: tuple[Array, Array, float] | None = None

    @property
    def floor_dps(self) -> Array:
        """(3,), below which no average comes: the flicker's floor of the Allan deviation."""
        return np.sqrt(2 * np.log(2) / np.pi) * self.instability


class Own(NamedTuple):
    """What the data alone say after each of n filters; infinite variances before the first block.

    The bias now is ``follows`` times the bias at the start, and something independent of it.
    """

    bias: Array  # (n, 3), now
    variance: Array  # (n, 3)
    start: Array  # (n, 3), the bias at the start
    start_variance: Array  # (n, 3)
    follows: Array  # (n, 3)
    squares: Array  # (n, 3), of the residuals over their variances
    freedom: Array  # (n, 1), degrees of freedom of those

    def row(self, number: int) -> "Own":
        """After one filter, (3,) each."""
        return Own(*(column[number] for column in self))


class _Steps:
    """What a step of some seconds does to the four processes, the walk first (exact integrals)."""

    def __init__(self, noise: Noise, step_s: float) -> None:
        d = step_s / _TIME_CONSTANTS_S
        decay = np.exp(-d)
        mean = -np.expm1(-d) / d  # of the block, per value at its start
        flicker = noise.instability[:, None] ** 2 * _VARIANCES
        walk = noise.random_walk[:, None] ** 2 * step_s
        self.keep = np.append(1.0, decay)  # F
        self.read = np.append(1.0, mean)  # H
        added = np.hstack([walk, flicker * (1 - decay**2)])
        self.added = added[:, :, None] * np.eye(4)  # Q
        self.shared = np.hstack([walk / 2, flicker * (1 - decay) ** 2 / d])  # of end and mean
        within = flicker * (2 * (d - 1 + decay) / d**2 - mean**2)
        white = noise.white**2 / step_s + _WITHIN_BLOCK * noise.instability**2
        self.white = white + walk[:, 0] / 3 + within.sum(axis=1)  # R
        self.fading = np.outer(self.keep, self.keep)


@dataclass(frozen=True)
class Filter:
    """State after some blocks; an update makes a new one, so that older ones can be gone back to.

    Attributes:
        noise: Of the sensor.
        block_s: Length of a block, seconds.
        age_s: Of the warm-up at the start, seconds since power-on; None: its amplitude is free.
        reference: (3,), deg/s, taken off the data.
        time_s: Seconds since the start, gaps included.
        blocks: How many were taken.
        states: (3, 4, 1 + p), of the walk and flicker, in y and in each column of X.
        covariance: (3, 4, 4), of the states, (deg/s)^2.
        information: (3, p, p), on c.
        weighted: (3, p), the sum of e_X e_y / S.
        squares: (3,), the sum of e_y^2 / S.
    """

    noise: Noise
    block_s: float
    age_s: float | None
    reference: Array
    time_s: float
    blocks: int
    states: Array
    covariance: Array
    information: Array
    weighted: Array
    squares: Array

    @classmethod
    def start(
        cls, noise: Noise, block_s: float, reference: ArrayLike, age_s: float | None = None
    ) -> Self:
        """The filter before the first block, near a reference such as the first block's mean."""
        p = 1 if noise.warm_up is None else 2
        flicker = noise.instability[:, None] ** 2 * _VARIANCES
        covariance = np.hstack([np.zeros((3, 1)), flicker])[:, :, None] * np.eye(4)
        information, weighted = np.zeros((3, p, p)), np.zeros((3, p))
        if noise.warm_up is not None:
            mean, spread, _ = noise.warm_up
            if age_s is None:
                mean, spread = np.zeros(3), np.full(3, _FREE_DPS)
            information[:, 1, 1] = 1 / spread**2
            weighted[:, 1] = mean / spread**2
        return cls(
            noise, block_s, age_s, np.asarray(reference, np.float64), 0.0, 0,
            np.zeros((3, 4, 1 + p)), covariance, information, weighted, np.zeros(3),
        )  # fmt: skip

    def update(self, mean: Array | None) -> tuple[Self, Array]:
        """Take the mean of a block, (3,), deg/s; None looks ahead: all but the data moves on.

        Returns:
            The next filter, and the block's innovation (3,) in units of its standard deviation;
            0 where nothing was known before.
        """
        steps = _steps(self.noise, self.block_s)
        to_mean = self.covariance @ steps.read
        variance = to_mean @ steps.read + steps.white
        left = self._columns(mean) - steps.read @ self.states
        gain = (steps.keep * to_mean + steps.shared) / variance[:, None]
        covariance = steps.fading * self.covariance + steps.added
        covariance -= (variance[:, None] * gain)[:, :, None] * gain[:, None, :]
        of_y, of_x = left[:, 0], left[:, 1:]
        scaled = of_x / variance[:, None]
        states = steps.keep[:, None] * self.states + gain[:, :, None] * left[:, None, :]
        following = type(self)(
            self.noise, self.block_s, self.age_s, self.reference, self.time_s + self.block_s,
            self.blocks + 1, states, covariance,
            self.information + scaled[:, :, None] * of_x[:, None, :],
            self.weighted + scaled * of_y[:, None], self.squares + of_y**2 / variance,
        )  # fmt: skip
        return following, self._innovation(of_y, of_x, variance)

    def skip(self, seconds: float) -> Self:
        """Move on over a gap without data."""
        steps = _steps(self.noise, seconds)
        covariance = steps.fading * self.covariance + steps.added
        states = steps.keep[:, None] * self.states
        return replace(self, time_s=self.time_s + seconds, states=states, covariance=covariance)

    def _columns(self, mean: Array | None) -> Array:
        """(3, 1 + p): y about the reference, 1, and the decay's mean in the block."""
        columns = np.ones((3, self.states.shape[-1]))
        columns[:, 0] = 0.0 if mean is None else mean - self.reference
        if self.noise.warm_up is not None:
            length = self.block_s / self.noise.warm_up[2]
            columns[:, 2] = self.decay() * -np.expm1(-length) / length
        return columns

    def decay(self) -> float:
        """What is left now of a warm-up's amplitude: of that at power-on, or at the start."""
        if self.noise.warm_up is None:
            return 0.0
        return float(np.exp(-(self.time_s + (self.age_s or 0.0)) / self.noise.warm_up[2]))

    def _innovation(self, of_y: Array, of_x: Array, variance: Array) -> Array:
        if not self.blocks:
            return np.zeros(3)
        c, uncertainty = self.constants()
        spread = variance + np.sum(_times(uncertainty, of_x) * of_x, axis=1)
        return np.asarray((of_y - np.sum(of_x * c, axis=1)) / np.sqrt(spread))

    def constants(self) -> tuple[Array, Array]:
        """The constants c by the data alone, (3, p), and their covariance, (3, p, p)."""
        uncertainty = _inverse(self.information)
        return _times(uncertainty, self.weighted), uncertainty

    def warm_up(self) -> tuple[Array, Array]:
        """How far the warm-up still is from its end, and the standard deviation, (3,), deg/s."""
        c, uncertainty = self.constants()
        return self.decay() * c[:, -1], self.decay() * np.sqrt(uncertainty[:, -1, -1])

    def ahead(self, blocks: int) -> list[Self]:
        """Filters of so many blocks to come: later variances, which are known now."""
        following = [self]
        for _ in range(blocks):
            following.append(following[-1].update(None)[0])
        return following[1:]


def own(filters: Sequence[Filter]) -> Own:
    """What filters of one stretch say by the data alone."""
    first, blocks = filters[0], np.array([[f.blocks] for f in filters], np.float64)
    if not first.blocks:
        unknown, infinite = np.full((1, 3), np.nan), np.full((1, 3), np.inf)
        none, one = np.zeros((1, 3)), np.ones((1, 3))
        return Own(unknown, infinite, unknown, infinite, one, none, none[:, :1])
    uncertainty = _inverse(np.array([f.information for f in filters]))
    weighted = np.array([f.weighted for f in filters])
    walk = np.array([f.states[:, 0] for f in filters])  # of y, and of each column
    c, on_c = _times(uncertainty, weighted), -walk[..., 1:]
    on_c[..., 0] += 1
    shared = _times(uncertainty, on_c)
    squares = np.array([f.squares for f in filters]) - np.sum(c * weighted, axis=-1)
    freedom = blocks - 1
    if first.noise.warm_up is not None:  # the amplitude's prior is one datum more
        mean, spread, _ = first.noise.warm_up
        free = first.age_s is None
        squares, freedom = squares + (0 if free else (mean / spread) ** 2), freedom - free
    of_walk = np.array([f.covariance[:, 0, 0] for f in filters])
    return Own(
        first.reference + walk[..., 0] + np.sum(on_c * c, axis=-1),
        of_walk + np.sum(shared * on_c, axis=-1),
        first.reference + c[..., 0],
        uncertainty[..., 0, 0],
        shared[..., 0] / uncertainty[..., 0, 0],
        squares,
        np.maximum(freedom, 0),
    )


def _inverse(matrices: Array) -> Array:
    return np.asarray(1 / matrices if matrices.shape[-1] == 1 else np.linalg.inv(matrices))


def _times(matrices: Array, vectors: Array) -> Array:
    return np.sum(matrices * vectors[..., None, :], axis=-1)


def _steps(noise: Noise, step_s: float) -> _Steps:
    """Those of the last few lengths are kept with the noise that they are of."""
    kept: dict[float, _Steps] = noise.__dict__.setdefault("_kept", {})
    if step_s not in kept:
        if len(kept) > 8:  # noqa: PLR2004 - gaps are of many lengths
            kept.clear()
        kept[step_s] = _Steps(noise, step_s)
    return kept[step_s]
