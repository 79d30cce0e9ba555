"""What the calibrator reaches, beside what it must (docs/calibrator.md).

    python benchmarks/calibrator.py                  # all of it, 20 minutes on two cores
    python benchmarks/calibrator.py coverage turned  # some sections
    python benchmarks/calibrator.py --count 200      # fewer calibrations a world
    python benchmarks/calibrator.py --full           # four times as many

Base: N 3.3 mdps sqrt(s), white, turn-on spread 0.31 mdps, a history of 14 calibrations of 30 s
that is right, latitude 32 degrees, axis z vertical, at rest, 20 samples a second. One factor varies
at a time, then some pairs. Rules of practice and real data: calibrator_rules.py. A cell falls short
only where its 99 % Clopper-Pearson interval lies outside the bounds.
"""

import argparse
import time
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field, replace
from functools import lru_cache, partial
from itertools import product

import numpy as np
from scipy import stats

from gyro_pipeline.calibrator import Calibration, Calibrator, Circumstances
from gyro_pipeline.calibrator.device_types import type_of
from gyro_pipeline.calibrator.filter import FLICKER_S, Filter
from gyro_pipeline.conventions import MDPS
from gyro_pipeline.physics.noise import simulate_noise, warm_up
from gyro_pipeline.physics.recording_model import (
    noise_covariances,
    profiles,
)

EARTH, LATITUDE, RATE = 4.178, 32.0, 20.0
MARKS = (1, 3, 10, 30, 60)
HISTORY_S, PAST = 30, 14
SLOPE = 5.0  # mdps a degree, in worlds with a ramp


@dataclass(frozen=True)
class World:
    """What is varied; mdps, seconds, degrees."""

    white: float = 3.3
    flicker: float = 0.0
    walk: float = 0.0
    lag1: float = 0.0
    warm_up: tuple[float, float, float] | None = None
    tau: float = 0.31
    type_tau: float | None = None  # what the type says, where it is wrong
    past: int = PAST
    declared: bool = True
    turn: float | None = 0.0  # about the vertical; None: any heading at each calibration
    step: float = 0.0  # of the level, on all axes
    ramp: float = 0.0  # degrees Celsius over the calibration
    target: float = 1.0
    longest_s: int = 30
    rate: float = RATE
    accel_ug: float | None = None
    disturb: Callable[[np.random.Generator, np.ndarray, float], None] | None = None
    known: bool = True  # whether the type's noise is
    step_dps: float = 0.0  # of an int16
    lost: float = 0.0  # share of samples lost at random
    jitter: float = 0.0  # of stamps, of the period
    gap_s: float = 0.0  # one gap in the middle


@dataclass
class Result:
    """One calibration: errors and standard deviations, mdps, at the marks and at the stop."""

    error: list = field(default_factory=list)
    sigma: list = field(default_factory=list)
    mean: list = field(default_factory=list)  # error of the plain mean
    stop: tuple[np.ndarray, np.ndarray] | None = None
    stop_s: float = np.inf
    seen_s: float = np.inf  # when the history was first dropped on any axis
    dropped: np.ndarray | None = None
    rest: str = ""
    codes: tuple[str, ...] = ()


@lru_cache
def kind_of(world: World):
    """The type, as fitted to 30 devices of it: a little is left open."""
    content = {
        "type": "simulated", "noise_mdps_rts": world.white, "flicker_mdps": world.flicker,
        "random_walk_mdps_per_rts": world.walk, "turn_on_mdps": world.type_tau or world.tau,
        "turn_on_factor": 1.3, "walk_mdps_per_rtday": 0.03, "walk_factor": 2.0,
        "temperature_spread_mdps_per_c": 5.0 * (world.ramp > 0),
    }  # fmt: skip
    if world.warm_up:
        keys = "amplitude_mdps", "spread_mdps", "time_constant_s"
        content["warm_up"] = dict(zip(keys, world.warm_up, strict=True))
    if not world.known:
        del content["noise_mdps_rts"]
    return type_of(content, "benchmark")


def earth(heading: float) -> np.ndarray:
    """The Earth's rate on x, y, z (up), mdps."""
    across = EARTH * np.cos(np.radians(LATITUDE))
    up = EARTH * np.sin(np.radians(LATITUDE))
    return np.array([across * np.cos(heading), -across * np.sin(heading), up])


def own_variance(world: World, seconds: float) -> np.ndarray:
    filter_ = Filter.start(kind_of(replace(world, known=True)).noise, 0.5)
    return filter_.ahead(round(seconds / 0.5))[0].estimate().variance / MDPS**2


def noise(rng, world: World) -> np.ndarray:
    """(n, 3), mdps; flicker as in a recording of ``FLICKER_S``."""
    count = round(world.longest_s * world.rate)
    drawn = max(count, round(FLICKER_S * world.rate)) if world.flicker else count
    figures = world.rate, np.full(3, world.white), world.lag1, world.flicker
    return simulate_noise(rng, (3, drawn), *figures)[:, :count].T.astype(np.float64)


def device(rng, world: World, variance: np.ndarray) -> tuple[list[Calibration], np.ndarray]:
    """The calibrations of a device, each of this variance, and its next bias, mdps."""
    level, heading = rng.uniform(-500, 500, 3), rng.uniform(0, 2 * np.pi)
    up, past = (0.0, 0.0, 1.0) if world.accel_ug else None, []
    for _ in range(world.past):
        if world.turn is None:
            heading = rng.uniform(0, 2 * np.pi)
        bias = level + rng.normal(0, world.tau, 3) + earth(heading)
        mean = bias + rng.normal(0, np.sqrt(variance))
        warmth = 25 + rng.normal(0, 0.5) if world.ramp else None
        mean = (mean + (SLOPE * (warmth - 25) if warmth else 0)) * MDPS
        temperature = warmth and (warmth, warmth, warmth)
        own = mean, variance * MDPS**2
        past.append(Calibration(*map(tuple, own), temperature_c=temperature, gravity=up))
    heading = rng.uniform(0, 2 * np.pi) if world.turn is None else heading + np.radians(world.turn)
    return past, level + rng.normal(0, world.tau, 3) + earth(heading) + world.step


def calibrate(world: World, history_variance: np.ndarray, seed: Sequence[int]) -> Result:
    """One calibration of one device."""
    rng = np.random.default_rng(seed)
    past, bias = device(rng, world, history_variance)
    time_s, samples, accel, warmth, truth = simulated(rng, world, bias)
    age_s = 0.0 if world.warm_up else None
    now = Circumstances(None, age_s, world.declared, LATITUDE)
    calibrator = Calibrator(kind_of(world), world.rate, past, now, world.target * MDPS)
    kept = rng.uniform(size=len(time_s)) >= world.lost
    kept &= np.abs(time_s - world.longest_s / 2) >= world.gap_s / 2
    stamps = time_s + world.jitter / world.rate * rng.uniform(-0.5, 0.5, len(time_s))
    result, first = Result(), 0
    for edge in range(1, world.longest_s + 1):
        if result.stop is not None and edge not in MARKS:
            continue
        last = round(edge * world.rate)
        rows = np.flatnonzero(kept[first:last]) + first
        beside = (None if x is None else x[rows] for x in (accel, warmth))
        state = calibrator.update(stamps[rows], samples[rows], *beside)
        error, sigma = state.bias_dps / MDPS - truth[last - 1], state.sigma_dps / MDPS
        if result.stop is None and state.done:
            result.stop, result.stop_s = (error, sigma), edge
        if "dropped" in state.history:
            result.seen_s = min(result.seen_s, edge)
        if edge in MARKS:
            result.error.append(error)
            result.sigma.append(sigma)
            result.mean.append(samples[:last].mean(axis=0) / MDPS - truth[last - 1])
        first = last
    state = calibrator.finish()
    result.dropped = np.array([outcome == "dropped" for outcome in state.history])
    result.rest, result.codes = state.rest, tuple(reason.code for reason in state.reasons)
    return result


def simulated(rng, world: World, bias: np.ndarray):
    """Times, rates (deg/s), accelerations and temperatures, and the bias at each sample, mdps."""
    count = round(world.longest_s * world.rate)
    time_s = (np.arange(count) + 0.5) / world.rate
    truth = bias + np.cumsum(rng.normal(0, world.walk / np.sqrt(world.rate), (count, 3)), axis=0)
    warmth = 25 + world.ramp * time_s / world.longest_s if world.ramp else None
    truth += 0 if warmth is None else SLOPE * (warmth - 25)[:, None]
    samples = noise(rng, world) + truth
    if world.warm_up:
        mean, spread, constant_s = world.warm_up
        samples += warm_up(rng.normal(mean, spread, 3), constant_s, count, world.rate).T
    samples, accel = samples * MDPS, None
    if world.accel_ug:
        accel = rng.normal([0, 0, 1], world.accel_ug * 1e-6 * np.sqrt(world.rate / 2), (count, 3))
    if world.disturb:
        world.disturb(rng, samples, world.rate, accel)
    if world.step_dps:
        samples = np.rint(samples / world.step_dps) * world.step_dps
    return time_s, samples, accel, warmth, truth


def many(pool, world: World, count: int, seed: int) -> list[Result]:
    variance = own_variance(world, HISTORY_S)
    seeds = [(seed, number) for number in range(count)]
    return list(pool.map(partial(calibrate, world, variance), seeds, chunksize=20))


def share(inside: np.ndarray) -> str:
    """A share with its 99 % Clopper-Pearson interval."""
    inside = np.asarray(inside).ravel()
    hits, n = int(inside.sum()), inside.size
    low = stats.beta.ppf(0.005, hits, n - hits + 1) if hits else 0.0
    high = stats.beta.ppf(0.995, hits + 1, n - hits) if hits < n else 1.0
    return f"{hits / max(n, 1):.3f} [{low:.3f}, {high:.3f}]"


def slow_rotation(rng, samples, rate, accel, *, rate_mdps: float, axis: int) -> None:
    """A steady rotation about an axis from the start, felt by the accelerometer."""
    samples[:, axis] += rate_mdps * MDPS
    if accel is not None and axis < UP:
        angle = np.radians(rate_mdps * MDPS) * (np.arange(len(samples)) + 0.5) / rate
        other = 1 - axis
        accel[:, other] += (1 if axis == 0 else -1) * np.sin(angle)


def rocking(rng, samples, rate, accel, *, size_dps: float, period_s: float) -> None:
    phase = rng.uniform(0, 2 * np.pi)
    samples[:, 0] += size_dps * np.sin(
        2 * np.pi * np.arange(len(samples)) / rate / period_s + phase
    )


def knock(rng, samples, rate, accel, *, size_dps: float = 2.0) -> None:
    start = int(len(samples) * rng.uniform(0.3, 0.7))
    length = max(int(0.3 * rate), 2)
    shape = np.sin(2 * np.pi * np.arange(length) / length)
    samples[start : start + length] += size_dps * shape[:, None]


KNOCK, SPIN = knock, partial(slow_rotation, rate_mdps=9, axis=2)
UP = 2
SILENT = {"heading", "rotation_bound"}


def covered(error: np.ndarray, sigma: np.ndarray) -> np.ndarray:
    return np.abs(error) <= 1.96 * sigma


def rms(x: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(x))))


COVERAGE = {
    "base": World(),
    "no history": World(past=0),
    "flicker 3": World(flicker=3, target=2.5),
    "flicker 3, no history": World(flicker=3, past=0, target=2.5),
    "walk 0.3": World(walk=0.3, target=1.5),
    "walk 0.3, no history": World(walk=0.3, past=0, target=1.5),
    "warm-up 5±1, 30 s": World(warm_up=(5, 1, 30)),
    "warm-up 5±1, 30 s, no history": World(warm_up=(5, 1, 30), past=0, target=1.5),
    "lag-1 -0.15": World(lag1=-0.15),
    "noise not known, no history": World(known=False, past=0, target=1.5),
    "tau 2": World(tau=2.0),
    "any heading, not declared": World(turn=None, declared=False),
    "int16, 2 mdps a step": World(step_dps=2e-3),
    "jitter 50 %, 5 % lost": World(jitter=0.5, lost=0.05),
    "gap of 3 s": World(gap_s=3.0, past=0, target=0.7),
}


def coverage(pool, count: int) -> None:
    print("\n## Coverage of 95 % intervals at the stop, per axis; must be 0.935 to 0.965\n")
    stop_table(pool, COVERAGE, count, 100)


def table(head: str) -> None:
    print(f"| {head.replace('|', ' | ')} |\n|{'---|' * (head.count('|') + 1)}")


def row(*cells) -> None:
    print(f"| {' | '.join(map(str, cells))} |", flush=True)


def stop_table(pool, worlds: dict[str, World], count: int, seed: int) -> None:
    """Coverage and RMSE at the stop, by axis and by what became of the history."""
    table(
        "world|target|median stop, s|RMSE|x / y / z|all, 99 % interval|dropped in"
        "|used / dropped / none|not at rest|said"
    )
    for number, (name, world) in enumerate(worlds.items()):
        results = many(pool, world, count, seed + number)
        stops = [r for r in results if r.stop is not None]
        inside = np.array([covered(*r.stop) for r in stops]).reshape(-1, 3)
        drops = np.array([r.dropped for r in stops]).reshape(-1, 3)
        kinds = {"used" if world.past else "none": ~drops, "dropped": drops}
        outcome = [f"{k} {inside[m].mean():.3f} of {m.sum()}" for k, m in kinds.items() if m.any()]
        codes = Counter(code for r in results for code in r.codes if code not in SILENT)
        row(
            name, f"{world.target:g}", f"{np.median([r.stop_s for r in results]):g}",
            f"{rms(np.array([r.stop[0] for r in stops])):.2f}" if stops else "–",
            " / ".join(f"{x:.3f}" for x in inside.mean(axis=0)), share(inside),
            f"{np.mean([r.dropped.any() for r in results]):.4f}", ", ".join(outcome),
            sum(r.rest != "still" for r in results),
            ", ".join(f"{code} {n}" for code, n in codes.most_common(3)),
        )  # fmt: skip


PAIRS = {
    "temperature ramp of 4 °C": World(ramp=4.0, target=1.5),
    "ramp, warm-up": World(ramp=4.0, warm_up=(5, 1, 30), target=1.5),
    "flicker 3, knock": World(flicker=3, disturb=KNOCK, target=2.5),
    "flicker 3, any heading, not declared": World(flicker=3, turn=None, declared=False, target=3),
    "flicker 3, turned 90°": World(flicker=3, turn=90, target=2.5),
    "flicker 3, tau 2": World(flicker=3, tau=2.0, target=2.5),
    "walk 0.3, gap of 3 s": World(walk=0.3, gap_s=3.0, past=0, target=1.5),
    "warm-up 5±1, int16": World(warm_up=(5, 1, 30), step_dps=2e-3),
    "lag-1 -0.15, 5 % lost": World(lag1=-0.15, lost=0.05),
    "turned 90°, knock": World(turn=90, disturb=KNOCK),
    "stepped 10, noise not known": World(step=10, known=False, target=1.5),
    "jitter 50 %, knock": World(jitter=0.5, disturb=KNOCK),
    "cannot be mended: 9 mdps about the vertical": World(past=0, accel_ug=100, disturb=SPIN),
    "cannot be mended: tau 5, type says 0.31, one calibration": World(past=1, tau=5, type_tau=0.31),
}


def pairs(pool, count: int) -> None:
    print("\n## Pairs of factors, at the stop\n")
    stop_table(pool, PAIRS, count, 500)


TURNED = {
    **{f"not declared, turned {t}°": World(declared=False, turn=t) for t in (0, 30, 90, 180)},
    "not declared, any heading": World(declared=False, turn=None),
    **{f"declared, turned {t}°": World(turn=t) for t in (0, 30, 90, 180)},
    **{f"level stepped by {s}": World(step=s) for s in (3, 10, 50)},
}


def turned(pool, count: int) -> None:
    print("\n## History that is wrong: RMSE, mdps / over the mean's / coverage, all axes\n")
    marks = [mark for mark in MARKS if mark <= World().longest_s]
    table(f"world|{'|'.join(f'{m} s' for m in marks)}|dropped|by 10 s")
    for number, (name, world) in enumerate(TURNED.items()):
        results = many(pool, world, count, 200 + number)
        dropped = np.mean([r.dropped.any() for r in results])
        seen = np.mean([r.seen_s <= marks[2] for r in results])
        cells = [mark_cell(results, i) for i in range(len(marks))]
        row(name, *cells, f"{dropped:.4f}", f"{seen:.3f}")


def mark_cell(results: list[Result], mark: int) -> str:
    error, sigma, plain = (
        np.array([getattr(r, key)[mark] for r in results]) for key in ("error", "sigma", "mean")
    )
    return f"{rms(error):.2f} / {rms(error) / rms(plain):.2f} / {covered(error, sigma).mean():.3f}"


def drops(pool, count: int) -> None:
    print(
        "\n## History dropped where it holds, up to 60 s; must be at most 0.005 of calibrations\n"
    )
    narrow = World(flicker=3, target=2.5)
    for name, world in {"base": World(), "flicker 3": narrow}.items():
        results = many(pool, replace(world, longest_s=60), count, 300)
        dropped = share(np.array([r.dropped.any() for r in results]))
        print(f"{name}: {dropped}; at 1 s {mark_cell(results, 0)}; at 10 s {mark_cell(results, 2)}")
    prior = World().tau ** 2 * (1 + 1 / PAST) + own_variance(World(), HISTORY_S)[0] / PAST
    best = 1 / np.sqrt(1 / prior + 1 / own_variance(World(), 10)[0])
    print(f"(base: the narrow prior alone has an RMSE of {best:.3f} at 10 s; at most 1.12 of it)")


def filters(pool, count: int) -> None:
    print(
        "\n## The filter alone: RMSE over the exact best linear estimate; must be at most 1.005\n"
    )
    settling = World(warm_up=(5, 2, 20))
    worlds = {"white": World(), "flicker 3": World(flicker=3), "walk 1": World(walk=1)}
    table("world|prior|1 s|3 s|10 s|30 s")
    for name, world in (worlds | {"warm-up 5±2, 20 s": settling}).items():
        for prior in (None, 0.31):
            cells = [f"{against_exact(world, seconds, prior):.5f}" for seconds in (1, 3, 10, 30)]
            row(name, "flat" if prior is None else "narrow", *cells)


def against_exact(world: World, seconds: int, prior: float | None) -> float:
    """The filter's RMSE under the exact covariance over the least, in mdps."""
    rate, blocks = 100, 2 * seconds
    edges = np.arange(blocks + 1) * 50
    unit = noise_covariances(edges, round(FLICKER_S * rate), rate)
    covariance = np.tensordot(np.square([world.white, world.flicker, world.walk]), unit, axes=1)
    now = world.walk**2 * (edges[:-1] + edges[1:] + 1) / 2 / rate
    if world.warm_up:
        decay = profiles(edges, rate, world.warm_up[2])[:, 1]
        covariance = covariance + world.warm_up[1] ** 2 * np.outer(decay, decay)
    spread = 1e8 if prior is None else prior**2
    total = covariance + spread
    weights = np.linalg.solve(total, now + spread)

    def squares(w: np.ndarray) -> float:
        own_part = w @ covariance @ w - 2 * w @ now + seconds * world.walk**2
        return own_part + spread * (1 - w.sum()) ** 2

    filter_, columns = Filter.start(kind_of(replace(world)).noise, 0.5, 0.0), []
    for unit_block in [None, *range(blocks)]:
        current = filter_
        for block in range(blocks):
            current, _ = current.update(np.full(3, 1.0 if block == unit_block else 0.0))
        last = current.estimate()
        gain = 1.0 if prior is None else spread / (spread + last.start_variance[0] / MDPS**2)
        columns.append(last.bias[0] + last.transfer[0] * (gain - 1) * last.start[0])
    own_weights = np.array(columns[1:]) - columns[0]
    return float(np.sqrt(squares(own_weights) / squares(weights)))


SLOW = World(longest_s=10, past=0, accel_ug=100)
REST = {
    "white": World(),
    "white, accelerometer": World(accel_ug=100),
    "lag-1 -0.15": World(lag1=-0.15),
    "flicker 3": World(flicker=3, target=2.5),
    "noise not known": World(known=False, past=0),
    "knock": World(disturb=knock),
}
for size, period in ((0.05, 0.4), (0.05, 4.0), (0.3, 0.4), (0.3, 4.0)):
    by = partial(rocking, size_dps=size, period_s=period)
    REST[f"rocking {size:g} deg/s, {period:g} s"] = World(disturb=by)
for size, axis in ((3.13, 0), (30, 0), (300, 0), (3.13, 1), (3.13, 2), (30, 2), (300, 2)):
    by = partial(slow_rotation, rate_mdps=size, axis=axis)
    REST[f"slow rotation {size:g} mdps about {'xyz'[axis]}"] = replace(SLOW, disturb=by)


def rest(pool, count: int) -> None:
    print("\n## At rest or not: 'moving' in at most 6 of 3,000, 3.13 mdps about x seen in 0.95\n")
    table("world|still|moving|unsure|a motion cut|rotation seen")
    for number, (name, world) in enumerate(REST.items()):
        results = many(pool, world, count, 400 + number)
        rests = [r.rest for r in results]
        cells = [rests.count(word) for word in ("still", "moving", "unsure")]
        cells += [sum(code in r.codes for r in results) for code in ("cut", "rotation")]
        row(name, *cells)


def speed(pool, count: int) -> None:
    print("\n## Speed at 1,000 Hz; must be 1e6 samples a second of processor time\n")
    rng = np.random.default_rng(1)
    samples = rng.normal(0, 0.1, (120_000, 3))
    times = np.arange(len(samples)) / 1000
    past = [Calibration((0.0, 0.0, 0.0), (1e-6,) * 3)] * PAST
    for seconds, history in product((1, 10, 120), ([], past)):
        best = np.inf
        for _ in range(3):
            calibrator = Calibrator(kind_of(World()), 1000.0, history, target_dps=1e-3)
            start = time.process_time()
            for first in range(0, len(samples), seconds * 1000):
                part = slice(first, first + seconds * 1000)
                calibrator.update(times[part], samples[part])
            best = min(best, time.process_time() - start)
        told = f"{'history' if history else 'no history'}: {len(samples) / best:.3g}"
        print(f"chunks of {seconds} s, {told} samples a second", flush=True)


SECTIONS = {f.__name__: f for f in (filters, coverage, pairs, turned, drops, rest, speed)}


def main(arguments: Iterable[str] | None = None) -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("sections", nargs="*", help=", ".join(SECTIONS))
    parser.add_argument("--count", type=int, default=1000, help="calibrations a world")
    parser.add_argument("--full", action="store_true", help="4,000 calibrations a world")
    parser.add_argument("--workers", type=int, default=2)
    options = parser.parse_args(arguments)
    with ProcessPoolExecutor(options.workers) as pool:
        for name in options.sections or SECTIONS:
            SECTIONS[name](pool, 4000 if options.full else options.count)


if __name__ == "__main__":
    main()
