"""How often 95 % intervals hold the truth: of results, and of ceilings estimated from recordings.

    python benchmarks/coverage.py                    # 1,000 worlds of each kind, two minutes
    python benchmarks/coverage.py --worlds 100

A world is a set of simulated recordings of white noise, judged like those of a study: empirical
Bayes learns from some, and its A and S at 10 s have an interval over those that test. The truth is
the same figure with the squares of all worlds pooled. `bootstrap` is the percentile bootstrap over
recordings that was used before. The ceiling of a world is worked out from its training recordings;
its truth is that of the drawn values. The last part is the power of the check against the oracle:
how often it finds a leak. Results: benchmarks/README.md.
"""

import argparse
from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import product

import numpy as np
from numpy.typing import NDArray

from gyro_pipeline.conventions import PAPER
from gyro_pipeline.physics.allan import NoiseFigures
from gyro_pipeline.physics.ceiling import (
    ceiling_rmse,
    oracle,
    pooled,
    running_mean_rmse,
)
from gyro_pipeline.physics.history import BiasHistory
from gyro_pipeline.physics.recording_model import constant_bias, joint_squares
from gyro_pipeline.physics.turn_on import (
    axes_are_correlated,
    guarded_spread,
    joint_draws,
    spread_draws,
    turn_on_spread,
)
from gyro_pipeline.pipelines.evaluation.ceilings import with_draws
from gyro_pipeline.scoring.scores import (
    Estimate,
    SquaredErrors,
    WeightedCurve,
    beats_oracle,
    holm,
    leave_one_out,
    score,
    with_interval,
)

Array = NDArray[np.float64]
RATE_HZ, WINDOW_S, RESAMPLES = 4, 10, 1000
SIGNIFICANT = 0.001  # of the oracle check, after Holm's correction
SIZE = WINDOW_S * RATE_HZ


@dataclass(frozen=True)
class Kind:
    """What worlds of a kind are drawn from: N, tau (axes,), mdps; T, seconds; and counts."""

    noise: Array
    spread: Array
    recording_s: int
    training: int
    tested: int

    def draw(self, generator: np.random.Generator, count: int) -> Array:
        """Recordings (count, axes, samples), mdps, about biases of 0."""
        shape = count, self.noise.size, self.recording_s * RATE_HZ
        bias = generator.standard_normal(shape[:2]) * self.spread
        white = generator.standard_normal(shape) * (self.noise * np.sqrt(RATE_HZ))[:, None]
        return white + bias[..., None]


SPARKFUN = np.full(3, 3.3), np.full(3, 0.31), 87
MEMSENSE = np.array([5.3, 4.7, 6.0]), np.array([0.4, 0.0, 2.0]), 52
KINDS = {
    "SparkFun, 80 train, 20 test": Kind(*SPARKFUN, 80, 20),
    "SparkFun, leave one out of 11": Kind(*SPARKFUN, 11, 0),
    "Memsense, leave one out of 11": Kind(*MEMSENSE, 11, 0),
}


def windows_of(rates: Array) -> Array:
    """Means of all non-overlapping windows, (recordings, windows, axes)."""
    count = rates.shape[-1] // SIZE
    cut = rates[..., : count * SIZE].reshape(*rates.shape[:-1], count, SIZE)
    return cut.mean(axis=-1).swapaxes(1, 2)


def estimated(kind: Kind, training: Array, windows: Array) -> Array:
    """Empirical Bayes from training means (n, axes), of windows (..., axes); N is known."""
    averaging = kind.noise**2 / kind.recording_s
    scatter = training.var(axis=0) * len(training)
    given = zip(scatter, averaging, strict=True)
    spread = np.array([guarded_spread(s, len(training) - 1, v) for s, v in given])
    prior = np.sqrt(spread**2 + (spread**2 + averaging) / len(training))
    times = WINDOW_S, kind.recording_s, PAPER
    return oracle(windows, training.mean(axis=0), prior, kind.noise, *times)


def judged(kind: Kind, generator: np.random.Generator) -> tuple[Array, Array, Array, Array]:
    """Errors (recordings, windows, axes) of empirical Bayes and the mean; rates and truths."""
    rates = kind.draw(generator, kind.training + kind.tested)
    truths = rates.mean(axis=-1)
    tests = range(kind.training, len(rates)) if kind.tested else range(len(rates))
    windows, errors = windows_of(rates), []
    for number in tests:
        others = truths[: kind.training] if kind.tested else np.delete(truths, number, axis=0)
        errors.append(estimated(kind, others, windows[number]) - truths[number])
    chosen = list(tests)
    return np.stack(errors), windows[chosen] - truths[chosen, None], rates[chosen], truths[chosen]


def squares(errors: Array) -> SquaredErrors:
    """Sums over windows and axes by recording."""
    flat = errors.reshape(len(errors), -1)
    return SquaredErrors(np.sum(flat**2, axis=1), np.full(len(flat), flat.shape[1]))


def curve(rates: Array, truths: Array, first: bool, weights: Array) -> WeightedCurve:
    """The running-mean curve, as the evaluation makes it."""
    running = np.concatenate([np.zeros((*truths.shape, 1)), np.cumsum(rates, axis=-1)], axis=-1)
    lengths = np.arange(1, rates.shape[-1] + 1)
    sums, counts = [], []
    for length in lengths.tolist():
        ends = np.arange(length, rates.shape[-1] + 1, length)[: 1 if first else None]
        means = (running[..., ends] - running[..., ends - length]) / length
        off = squares(means - truths[..., None])
        sums.append(off.sums)
        counts.append(off.counts)
    errors = SquaredErrors(np.stack(sums, axis=1), np.stack(counts, axis=1))
    return WeightedCurve.of(lengths / RATE_HZ, errors, weights)


def bootstrap(own: SquaredErrors, mean: SquaredErrors, generator: np.random.Generator) -> Estimate:
    """A in percent with the interval that was used before."""
    count = own.sums.size
    weights = generator.multinomial(count, np.full(count, 1 / count), size=RESAMPLES)
    gains = 100 * (1 - np.sqrt(own.mean(weights) / mean.mean(weights)))
    plain = np.ones((1, count))
    value = 100 * (1 - np.sqrt(own.mean(plain) / mean.mean(plain))[0])
    return Estimate(float(value), *map(float, np.quantile(gains, [0.025, 0.975])))


def results(kind: Kind, worlds: int) -> Iterator[str]:
    """Rows of the table of results: first and all windows."""
    for first in (True, False):
        part = slice(1) if first else slice(None)
        found: dict[str, list[Estimate]] = {"bootstrap": [], "A": [], "S": []}
        own_sum = mean_sum = 0.0
        savings = []
        for seed in range(worlds):
            generator = np.random.default_rng([seed, kind.training, kind.recording_s])
            errors, of_mean, rates, truths = judged(kind, generator)
            own, mean = squares(errors[:, part]), squares(of_mean[:, part])
            weights = leave_one_out(own.sums.size)
            falling = curve(rates, truths, first, weights)
            scores = score(own, mean, falling, WINDOW_S, weights)
            found["A"].append(scores["accuracy_gain_pct"])
            found["S"].append(scores["time_saving_pct"])
            found["bootstrap"].append(bootstrap(own, mean, generator))
            own_sum, mean_sum = own_sum + own.sums.sum(), mean_sum + mean.sums.sum()
            savings.append(scores["time_saving_pct"].value)
        ratio = np.sqrt(own_sum / mean_sum)
        saving = 100 * (1 - ratio**2) * (1 - WINDOW_S / kind.recording_s)
        truth = {"A": 100 * (1 - ratio), "bootstrap": 100 * (1 - ratio), "S": saving}
        cells = [covered(found[name], truth[name]) for name in ("bootstrap", "A", "S")]
        spread = np.std([one.value for one in found["A"]])
        name = "first" if first else "all"
        yield f"| {name} windows | {truth['A']:.1f} | {spread:.1f} | {' | '.join(cells)} |"


def covered(intervals: list[Estimate], truth: float) -> str:
    """Share of the intervals that hold the truth, %; and below and above it, where they miss."""
    ends = [(one.lo, one.hi) for one in intervals if one.lo is not None and one.hi is not None]
    lo, hi = np.array(ends).T
    held = np.mean((lo <= truth) & (truth <= hi))
    lacking = f", none for {len(intervals) - len(ends)}" if len(ends) < len(intervals) else ""
    return f"{100 * held:.1f} (width {np.median(hi - lo):.0f}{lacking})"


def ceilings(kind: Kind, worlds: int) -> str:
    """A row of the table of ceilings: before, by jackknife, and as it is done."""
    times = WINDOW_S, kind.recording_s, PAPER

    def gain(spread: Array) -> Array:
        best = pooled(ceiling_rmse(kind.noise, spread, *times))
        return 100 * (1 - best / pooled(running_mean_rmse(kind.noise, *times)))

    averaging = kind.noise**2 / kind.recording_s
    found: dict[str, list[Estimate]] = {"bootstrap": [], "jackknife-t": [], "draws": []}
    for seed in range(worlds):
        generator = np.random.default_rng([seed, kind.training, kind.recording_s])
        means = kind.draw(generator, kind.training).mean(axis=-1)
        value = float(gain(turn_on_spread(means, averaging)))
        chosen = generator.integers(len(means), size=(len(means), RESAMPLES))
        samples = {
            "bootstrap": turn_on_spread(means[chosen], averaging),
            "draws": spread_draws(means, averaging, RESAMPLES),
        }
        for name, sample in samples.items():
            ends = np.quantile(gain(sample), [0.025, 0.975])
            found[name].append(Estimate(value, *map(float, ends)))
        others = [np.delete(means, place, axis=0) for place in range(len(means))]
        left = turn_on_spread(np.stack(others, axis=1), averaging)
        ratios = 1 - np.append(value, gain(left)) / 100
        ratio = with_interval(ratios, positive=True)
        assert ratio.lo is not None and ratio.hi is not None
        found["jackknife-t"].append(Estimate(value, 100 * (1 - ratio.hi), 100 * (1 - ratio.lo)))
    truth = float(gain(kind.spread))
    return f"{truth:.1f} | {' | '.join(covered(one, truth) for one in found.values())} |"


def history_ceiling(kind: Kind, step: float, worlds: int) -> str:
    """A row of the table of ceilings with history: biases walk by `step` a recording, mdps.

    The ceiling of a world is that of the recordings that test, given all earlier ones; its truth is
    that of the drawn walk and spread. Axes are alike, so one stands for all.
    """
    count, noise, spread = kind.training + kind.tested, kind.noise[0], kind.spread[0]
    model = constant_bias(kind.recording_s * RATE_HZ, RATE_HZ, NoiseFigures(noise, 0, 0), 0, spread)
    numbers, trained = np.arange(1, 1 + count), slice(kind.training)

    def gain(history: BiasHistory) -> Array:
        followed = history.extended(numbers, labels)
        variances = [followed.next_bias(number)[1] for number in numbers[kind.training :].tolist()]
        times = WINDOW_S, kind.recording_s, PAPER
        best = ceiling_rmse(noise, np.sqrt(np.mean(variances, axis=0)), *times)
        return np.asarray(100 * (1 - best / running_mean_rmse(noise, *times)))

    limits = []
    for seed in range(worlds):
        generator = np.random.default_rng([seed, 11])
        labels = np.cumsum(step * generator.standard_normal(count))
        labels += np.hypot(spread, noise / np.sqrt(kind.recording_s)) * generator.standard_normal(
            count
        )
        history = BiasHistory.fit(numbers[trained], labels[trained], model)
        drawn = history.draws(RESAMPLES, seed)
        limits.append(with_draws(np.append(gain(history), gain(drawn))))
    truth = float(gain(replace(history, step=step, deviation=spread)))
    return f"{truth:.1f} | {covered(limits, truth)} |"


def joint_ceiling(kind: Kind, correlation: float, worlds: int) -> str:
    """A row of the table of ceilings from the windows of all axes, whose biases are correlated.

    It is worked out in the worlds where the correlation is significant.
    """
    samples, size = kind.recording_s * RATE_HZ, WINDOW_S * RATE_HZ
    models = [
        constant_bias(samples, RATE_HZ, NoiseFigures(noise, 0, 0), 0, max(spread, 1e-3))
        for noise, spread in zip(kind.noise, kind.spread, strict=True)
    ]
    mean = pooled(running_mean_rmse(kind.noise, WINDOW_S, kind.recording_s, PAPER))
    unit = correlation + (1 - correlation) * np.eye(kind.noise.size)
    drawn, averaging = unit * np.outer(kind.spread, kind.spread), kind.noise**2 / kind.recording_s

    def gain(covariances: Array) -> Array:
        best = joint_squares(models, 0, size, PAPER, covariances)
        return np.asarray(100 * (1 - np.sqrt(best) / mean))

    limits = []
    for seed in range(worlds):
        generator = np.random.default_rng([seed, 13])
        of_means = drawn + np.diag(averaging)
        means = generator.multivariate_normal(np.zeros(len(drawn)), of_means, kind.training)
        if axes_are_correlated(means):
            limits.append(with_draws(gain(joint_draws(means, averaging, 400))))
    truth = float(gain(drawn[None])[0])
    return f"{truth:.1f} | {100 * len(limits) / worlds:.0f} | {covered(limits, truth)} |"


def power(worlds: int, checks: int) -> str:
    """How often a leak in a share of the test recordings is found, that halves their errors."""
    kind, found = KINDS["SparkFun, 80 train, 20 test"], []
    times, others = (WINDOW_S, kind.recording_s, PAPER), [1.0] * (checks - 1)
    for share in (0.25, 0.5, 1.0):
        p_values = []
        for seed in range(worlds):
            rates = kind.draw(np.random.default_rng([seed, 7]), kind.tested)
            truths, windows = rates.mean(axis=-1), windows_of(rates)
            best = oracle(windows, np.zeros(3), kind.spread, kind.noise, *times) - truths[:, None]
            leaky = best.copy()
            leaky[: round(share * kind.tested)] /= 2
            p_values.append(holm([beats_oracle(squares(leaky), squares(best)), *others])[0])
        hits = np.mean(np.array(p_values) < SIGNIFICANT)
        found.append(f"{100 * hits:.0f} % where it is in {share:.0%}")
    return ", ".join(found)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n", 1)[0])
    parser.add_argument("--worlds", type=int, default=1000)
    worlds = parser.parse_args().worlds
    print("| | A, % | its scatter | bootstrap, before | A | S |\n|---|---|---|---|---|---|")
    for name, kind in KINDS.items():
        print(f"| **{name}** | | | | | |")
        for row in results(kind, worlds):
            print(row, flush=True)
    head = "ceiling from | A, % | bootstrap, before | jackknife-t | now"
    print(f"\n| {head} |\n|---|---|---|---|---|")
    for name, kind in KINDS.items():
        learned = f"{name.split(',')[0]}, {kind.training} recordings"
        print(f"| {learned} | {ceilings(kind, worlds)}", flush=True)
    print("\n| ceiling jointly over axes from, correlation | A, % | shown, % | now |")
    print("|---|---|---|---|")
    for (name, kind), correlation in product(KINDS.items(), (0.8, 0.95)):
        learned = f"{name.split(',')[0]}, {kind.training} recordings, {correlation:g}"
        print(f"| {learned} | {joint_ceiling(kind, correlation, worlds)}", flush=True)
    print("\n| ceiling with history from 80 recordings, step | A, % | now |\n|---|---|---|")
    for step in (0.0, 0.1, 0.3, 1.0):
        limit = history_ceiling(KINDS["SparkFun, 80 train, 20 test"], step, worlds)
        print(f"| {step:g} mdps | {limit}", flush=True)
    print(f"\nThe oracle check, 48 comparisons, leak that halves errors: {power(worlds, 48)}")


if __name__ == "__main__":
    main()
