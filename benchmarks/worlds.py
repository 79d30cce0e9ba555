"""Fixed simulated worlds, each with its optimum, on which any estimator can be scored.

    python benchmarks/worlds.py                                   # all worlds and estimators
    python benchmarks/worlds.py --worlds white flicker            # some worlds
    python benchmarks/worlds.py --estimators best_linear my.module:MyEstimator

A world is one IMU with 80 recordings to learn from and 400 that test: 87 s at 20 Hz, N = 3.3 mdps
sqrt(s) and a turn-on spread of 0.31 mdps on each axis unless it says otherwise, unit biases of +-
0.5 deg/s. Scores are over all windows of 10 s: the RMSE of the estimator over that of the optimum
in the same windows, for truth (a), the mean of the recording, and truth (c), the bias; and how
often the stated 95 % interval holds truth (a).

The optimum knows all that was drawn but the noise and the bias: in a Gaussian world it is the
conditional mean given the samples of the window on all axes, from the dense covariance of a
recording; in the bimodal one a mixture of two. For heavy tails and steps it is the best linear
estimate, which others may beat.

This file shares no code with the package's simulator or with its models of a recording. A world
never changes under its name: change VERSION with any of them, and cite it. Results:
benchmarks/README.md.
"""

import argparse
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np
import pandas as pd
import xarray as xr
from numpy.typing import NDArray
from scipy import linalg, signal

from gyro_pipeline.conventions import (
    AXES,
    BIAS,
    DIMENSIONS,
    MDPS,
    ORIGIN_REAL,
    RECORDING_MEAN,
    TRAIN,
    VALIDATION,
)
from gyro_pipeline.estimators import ESTIMATORS, make_estimator
from gyro_pipeline.estimators.training_set import TrainingSet
from gyro_pipeline.pipeline_registry import base_parameters
from gyro_pipeline.scoring.scores import prior_conflict

VERSION = 1
RATE_HZ, SAMPLES, SIZE = 20, 1740, 200
TRAINED, TESTED, VALIDATED = 80, 400, 8
WHITE, SPREAD = 3.3, 0.31
TARGETS = {"a": RECORDING_MEAN, "c": BIAS}
CONFLICT = 1e-3

Array = NDArray[np.float64]
Generator = np.random.Generator
TIME_S = (np.arange(SAMPLES) + 0.5) / RATE_HZ
LAGS_S = np.abs(TIME_S[:, None] - TIME_S)
EARLIER_S = np.minimum(TIME_S[:, None], TIME_S)


@dataclass(frozen=True)
class Part:
    """A part of a recording, in mdps.

    Attributes:
        draw: Samples (recordings, axes, samples) from a generator and that shape.
        covariance: Of the samples of a recording, (samples, samples).
        mean: Of the samples, (samples,).
    """

    draw: Callable[[Generator, tuple[int, ...]], Array]
    covariance: Array
    mean: Array = field(default_factory=lambda: np.zeros(SAMPLES))


def white(noise: float, degrees: float = np.inf) -> Part:
    """White noise N; of Student's t with few degrees of freedom, the same variance."""
    sigma = noise * np.sqrt(RATE_HZ)

    def draw(generator: Generator, shape: tuple[int, ...]) -> Array:
        if np.isinf(degrees):
            return sigma * generator.standard_normal(shape)
        return sigma * generator.standard_t(degrees, shape) * np.sqrt((degrees - 2) / degrees)

    return Part(draw, sigma**2 * np.eye(SAMPLES))


def relaxing(sigma: float, time_constant_s: float) -> Part:
    """A stationary AR(1) process."""
    rho = np.exp(-1 / (RATE_HZ * time_constant_s))

    def draw(generator: Generator, shape: tuple[int, ...]) -> Array:
        steps = sigma * np.sqrt(1 - rho**2) * generator.standard_normal(shape)
        steps[..., 0] /= np.sqrt(1 - rho**2)
        return np.asarray(signal.lfilter([1.0], [1.0, -rho], steps, axis=-1))

    return Part(draw, sigma**2 * np.exp(-LAGS_S / time_constant_s))


def flicker(instability: float) -> list[Part]:
    """Bias instability B: AR(1) processes whose time constants are even in the logarithm.

    Together they have the one-sided density B^2 / (pi f) from one cycle in two recordings on.
    """
    constants = np.geomspace(0.02, SAMPLES / RATE_HZ / np.pi, 16)
    step = np.log(constants[1] / constants[0])
    return [relaxing(instability * np.sqrt(step / np.pi), one) for one in constants.tolist()]


def walk(random_walk: float) -> Part:
    """Rate random walk K, from 0 at power-on."""

    def draw(generator: Generator, shape: tuple[int, ...]) -> Array:
        steps = generator.standard_normal(shape) / np.sqrt(RATE_HZ)
        steps[..., 0] /= np.sqrt(2)
        return random_walk * np.cumsum(steps, axis=-1)

    return Part(draw, random_walk**2 * EARLIER_S)


def steps(a_second: float, size: float) -> Part:
    """Steps at random times, of normal sizes."""

    def draw(generator: Generator, shape: tuple[int, ...]) -> Array:
        counts = generator.poisson(a_second / RATE_HZ, shape)
        return np.cumsum(np.sqrt(counts) * size * generator.standard_normal(shape), axis=-1)

    return Part(draw, a_second * size**2 * (EARLIER_S + 0.5 / RATE_HZ))


def profile(shape: Array, mean: float, spread: float) -> Part:
    """A shape in time with an amplitude of its own at each power-on."""

    def draw(generator: Generator, of: tuple[int, ...]) -> Array:
        return generator.normal(mean, spread, of[:-1])[..., None] * shape

    return Part(draw, spread**2 * np.outer(shape, shape), mean * shape)


@dataclass(frozen=True)
class World:
    """What recordings are drawn from.

    Attributes:
        parts: Of the noise and of what settles.
        correlation: Of the turn-on bias between axes.
        modes: Distance of the two values about which the turn-on bias is drawn, mdps.
        trend: Of the bias, mdps a recording.
        turned: Change of the bias on x, y and z in the recordings that test, mdps.
        optimum: What it is.
    """

    parts: Sequence[Part] = (white(WHITE),)
    correlation: float = 0.0
    modes: float = 0.0
    trend: float = 0.0
    turned: tuple[float, float, float] = (0.0, 0.0, 0.0)
    optimum: str = "exact"

    def draw(self, seed: int) -> tuple[Array, Array, Array]:
        """Rates (recordings, axes, samples), biases and their expected value, mdps."""
        generator = np.random.default_rng([VERSION, seed])
        shape = TRAINED + TESTED, len(AXES)
        unit = generator.uniform(-500, 500, len(AXES)) + np.zeros(shape)
        unit += self.trend * np.arange(shape[0])[:, None]
        unit[TRAINED:] += self.turned
        bias = unit + generator.multivariate_normal(np.zeros(3), self.turn_on, shape[0])
        bias += self.modes / 2 * generator.choice([-1, 1], shape)
        rates = np.repeat(bias[..., None], SAMPLES, axis=-1)
        for part in self.parts:
            rates += part.draw(generator, rates.shape)
        return rates, bias, unit

    @property
    def turn_on(self) -> Array:
        """Covariance of the turn-on bias between axes, mdps^2."""
        return SPREAD**2 * (self.correlation + (1 - self.correlation) * np.eye(len(AXES)))

    def best(self, windows: Array, unit: Array, start: int) -> dict[str, Array]:
        """The optimum's estimates from windows (recordings, axes, size), mdps, by truth."""
        inside = slice(start, start + SIZE)
        mean = np.sum([part.mean for part in self.parts], axis=0)
        if self.modes:
            return self._of_two(windows.mean(axis=-1), unit)
        noise = np.sum([part.covariance for part in self.parts], axis=0)
        ones = np.ones((SIZE, SIZE))
        seen = np.kron(np.eye(len(AXES)), noise[inside, inside]) + np.kron(self.turn_on, ones)
        off = windows - unit[..., None] - mean[inside]
        with_bias = np.kron(self.turn_on, np.ones((1, SIZE)))
        with_rest = np.kron(np.eye(len(AXES)), noise[:, inside].mean(axis=0)[None])
        solved = linalg.solve(seen, off.reshape(len(off), -1).T, assume_a="pos")
        biases = unit + (with_bias @ solved).T
        return {"a": biases + mean.mean() + (with_rest @ solved).T, "c": biases}

    def _of_two(self, means: Array, unit: Array) -> dict[str, Array]:
        """Of a bias about one of two values, in white noise: a mixture of two posteriors."""
        variance = WHITE**2 * RATE_HZ / SIZE
        centres = unit[..., None] + self.modes / 2 * np.array([-1, 1])
        off = means[..., None] - centres
        weights = np.exp(
            -(off**2 - off.min(axis=-1, keepdims=True) ** 2) / 2 / (SPREAD**2 + variance)
        )
        posteriors = centres + SPREAD**2 / (SPREAD**2 + variance) * off
        biases = np.sum(weights * posteriors, axis=-1) / weights.sum(axis=-1)
        share = SIZE / SAMPLES
        return {"a": share * means + (1 - share) * biases, "c": biases}


AR1_S = 0.1
AR1 = np.exp(-1 / (RATE_HZ * AR1_S))
SETTLING = profile(np.exp(-TIME_S / 30), 5.0, 1.0)
LINEAR = "best linear"
WORLDS = {
    "white": World(),
    "AR(1)": World([relaxing(WHITE * np.sqrt(RATE_HZ * (1 - AR1) / (1 + AR1)), AR1_S)]),
    "flicker": World([white(WHITE), *flicker(3)]),
    "flicker and walk": World([white(WHITE), *flicker(3), walk(0.1)]),
    "strong flicker": World([white(WHITE), *flicker(10)]),
    "warm-up": World([white(WHITE), SETTLING]),
    "heavy tails": World([white(WHITE, degrees=3)], optimum=LINEAR),
    "correlated axes": World(correlation=0.8),
    "steps": World([white(WHITE), steps(0.02, 3)], optimum=LINEAR),
    "slow drift": World([white(WHITE), profile(TIME_S, 0.0, 0.02)]),
    "bimodal": World(modes=3.0),
    "trend": World(trend=0.02),
    "turned": World(turned=(-3.0, 3.0, 0.0)),
    "several": World([white(WHITE), *flicker(3), walk(0.1), SETTLING], correlation=0.8),
}


def dataset(rates: Array) -> xr.Dataset:
    """Recordings of IMU 1, in deg/s, in the layout of the conventions."""
    samples = (MDPS * rates)[None].astype(np.float32)
    coords = {"imu": [1], "recording": np.arange(1, 1 + len(rates)), "axis": list(AXES)}
    data = {
        "angular_rate": (DIMENSIONS, samples),
        "samples": (DIMENSIONS[:2], np.full(samples.shape[:2], SAMPLES)),
        "recording_mean": (DIMENSIONS[:3], samples.mean(axis=-1, dtype=np.float64)),
    }
    return xr.Dataset(data, coords, {"rate_hz": float(RATE_HZ), "sensor": "world"})


def training_set(rates: Array) -> TrainingSet:
    """All windows of the recordings to learn from; the last recordings validate."""
    numbers, starts = range(1, 1 + TRAINED), range(0, SAMPLES - SIZE + 1, SIZE)
    rows = pd.MultiIndex.from_product([numbers, starts], names=["recording", "start"])
    table = rows.to_frame(index=False).assign(role=TRAIN, origin=ORIGIN_REAL, imu=1)
    table.loc[table.recording > TRAINED - VALIDATED, "role"] = VALIDATION
    return TrainingSet(dataset(rates[:TRAINED]), None, table, SIZE, 1)


class Arena:
    """One drawn world, and the optimum's errors in it."""

    def __init__(self, name: str) -> None:
        self.world = WORLDS[name]
        seed = list(WORLDS).index(name)
        rates, bias, unit = self.world.draw(seed)
        self.training, tested = training_set(rates), rates[TRAINED:]
        starts = np.arange(0, SAMPLES - SIZE + 1, SIZE)
        self.starts_s, self.rates = starts / RATE_HZ, tested
        self.windows = np.stack([tested[..., s : s + SIZE] for s in starts], axis=1)
        self.means = tested.mean(axis=-1)
        self.truths = {"a": self.means[:, None], "c": bias[TRAINED:, None]}
        best = [
            self.world.best(self.windows[:, i], unit[TRAINED:], s) for i, s in enumerate(starts)
        ]
        of_truths = {truth: np.stack([one[truth] for one in best], axis=1) for truth in TARGETS}
        self.optimum = {t: rms(of_truths[t] - self.truths[t]) for t in TARGETS}
        trained = rates[:TRAINED].mean(axis=-1)
        self.warns = bool(prior_conflict(trained, self.means).min() < CONFLICT)

    def score(self, name: str) -> str:
        """RMSE over the optimum for truths (a) and (c), and coverage for (a), %."""
        estimator = make_estimator(name, base_parameters().training, 0).fit(self.training)
        numbers = np.arange(TRAINED + 1, 1 + TRAINED + TESTED)
        estimator = estimator.with_calibrations(numbers, MDPS * self.means)
        ratios, held = [], np.nan
        for truth, target in TARGETS.items():
            found = [
                estimator.estimate((MDPS * own).astype(np.float32), target, self.starts_s, number)
                for own, number in zip(self.windows, numbers.tolist(), strict=True)
            ]
            biases, sigmas = (np.stack(part) / MDPS for part in zip(*found, strict=True))
            errors = biases - self.truths[truth]
            ratios.append(rms(errors) / self.optimum[truth])
            if truth == "a" and np.isfinite(sigmas).all():
                held = 100 * np.mean(np.abs(errors) < 1.959964 * sigmas)
        return " / ".join(f"{ratio:.3g}" for ratio in ratios) + f" / {held:.0f}"


def rms(errors: Array) -> float:
    """Root of the mean square."""
    return float(np.sqrt(np.mean(errors**2)))


def learning_limit(optimum: float) -> float:
    """The least RMSE over the optimum for (c) in the world *warm-up*, if its means are learned.

    The means of bias and amplitude on each axis, and the time constant, which the axes share, are
    unknown; spreads and noise are known. The Cramer-Rao bound of the mean bias, from the recordings
    to learn from, adds to the square of the optimum.
    """
    shape = np.exp(-TIME_S / 30)
    unknown = np.stack([np.ones(SAMPLES), shape, 5 * shape * TIME_S / 30**2], axis=1)
    covariance = np.sum([part.covariance for part in WORLDS["warm-up"].parts], axis=0) + SPREAD**2
    information = TRAINED * unknown.T @ linalg.solve(covariance, unknown, assume_a="pos")
    of_means, shared = information[:2, :2], information[:2, 2]
    moved = linalg.solve(of_means, shared)
    variance = linalg.inv(of_means)[0, 0]
    variance += moved[0] ** 2 / (len(AXES) * (information[2, 2] - shared @ moved))
    return float(np.sqrt(1 + variance / optimum**2))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n", 1)[0])
    parser.add_argument("--worlds", nargs="+", default=list(WORLDS), choices=list(WORLDS))
    parser.add_argument("--estimators", nargs="+", default=list(ESTIMATORS))
    asked = parser.parse_args()
    print(f"version {VERSION}: RMSE over the optimum for (a) / (c) / coverage of 95 % for (a)\n")
    print(f"| world | optimum | (a), (c), mdps | warns | {' | '.join(asked.estimators)} |")
    print("|---" * (4 + len(asked.estimators)) + "|")
    for name in asked.worlds:
        arena = Arena(name)
        cells = [arena.score(estimator) for estimator in asked.estimators]
        limits = ", ".join(f"{value:.3g}" for value in arena.optimum.values())
        warns = "yes" if arena.warns else ""
        row = [name, arena.world.optimum, limits, warns, *cells]
        print(f"| {' | '.join(row)} |", flush=True)
        if name == "warm-up":
            limit = learning_limit(arena.optimum["c"])
    if "warm-up" in asked.worlds:
        print(f"\nwarm-up, (c): at least {limit:.2f} if mean and time constant are learned")


if __name__ == "__main__":
    main()
