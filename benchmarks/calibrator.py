"""What the calibrator reaches, beside what it must (docs/calibrator.md).

    python benchmarks/calibrator.py                  # all of it, 20 minutes on two cores
    python benchmarks/calibrator.py coverage turned  # some sections
    python benchmarks/calibrator.py --count 200      # fewer calibrations a world
    python benchmarks/calibrator.py --full           # four times as many

Base: N 3.3 mdps sqrt(s), white, turn-on spread 0.31 mdps, a history of 14 calibrations of 30 s that is
right, latitude 32 degrees, axis z vertical, at rest, 20 samples a second. One factor varies at a
time. A cell falls short only where its 99 % Clopper-Pearson interval lies outside the bounds.
"""

import argparse
import os
import time
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path

import numpy as np
from scipy import stats

from gyro_pipeline.calibrator import Calibration, Calibrator, Circumstances, read_type
from gyro_pipeline.calibrator.device_types import type_of
from gyro_pipeline.calibrator.filter import FLICKER_S, Filter, own
from gyro_pipeline.conventions import MDPS
from gyro_pipeline.parameters import ReaderOptions
from gyro_pipeline.physics.allan import (
    NoiseFigures,
    allan_variance,
    averaging_times_s,
    fit_noise,
)
from gyro_pipeline.physics.noise import simulate_noise, warm_up
from gyro_pipeline.physics.recording_model import (
    noise_covariances,
    outside_noise,
    profiles,
)
from gyro_pipeline.readers import read_log

EARTH, LATITUDE, RATE = 4.178, 32.0, 20.0
MARKS = (1, 3, 10, 30, 60)
HISTORY_S, PAST = 30, 14
SLOPE = 5.0  # mdps a degree, in worlds with a ramp
STATED: list[float] = []  # standard deviations that VQF states, mdps

Rule = Callable[..., np.ndarray]


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
    """One calibration: errors and standard deviations (mark, 3), mdps, and the stop."""

    error: np.ndarray
    sigma: np.ndarray
    mean: np.ndarray  # error of the plain mean
    stop: tuple[np.ndarray, np.ndarray] | None
    stop_s: float
    dropped: np.ndarray
    seen_s: float  # when the history was first dropped on any axis
    rest: str
    codes: tuple[str, ...] = field(default=())


def kind_of(world: World):
    """The type, as fitted to 30 devices of it: a little is left open."""
    noise = {"noise_mdps_rts": world.white} if world.known else {}
    settling = dict(
        zip(("amplitude_mdps", "spread_mdps", "time_constant_s"), world.warm_up or (), strict=False)
    )
    return type_of(
        {
            "type": "simulated", **noise, "flicker_mdps": world.flicker,
            "random_walk_mdps_per_rts": world.walk, "turn_on_mdps": world.type_tau or world.tau,
            "turn_on_factor": 1.3,
            "walk_mdps_per_rtday": 0.03, "walk_factor": 2.0, "warm_up": settling or None,
            **({"temperature_spread_mdps_per_c": 5.0} if world.ramp else {}),
        },
        "benchmark",
    )  # fmt: skip


def earth(heading: float) -> np.ndarray:
    """The Earth's rate on x, y, z (up), mdps."""
    across = EARTH * np.cos(np.radians(LATITUDE))
    up = EARTH * np.sin(np.radians(LATITUDE))
    return np.array([across * np.cos(heading), -across * np.sin(heading), up])


def own_variance(world: World, seconds: float) -> np.ndarray:
    filter_ = Filter.start(kind_of(replace(world, known=True)).noise, 0.5, np.zeros(3))
    return own(filter_.ahead(round(seconds / 0.5))).variance[-1] / MDPS**2


def noise(rng, world: World, seconds: float) -> np.ndarray:
    """Noise (n, 3), mdps, and the walk in it ends where it ends: (n, 3)."""
    count = round(FLICKER_S * world.rate)
    short = round(seconds * world.rate)
    figures = np.full(3, world.white), world.lag1
    if world.flicker:
        samples = simulate_noise(rng, (3, count), world.rate, *figures, world.flicker)[:, :short]
    else:
        samples = simulate_noise(rng, (3, short), world.rate, *figures)
    return samples.T.astype(np.float64)


def one(world: World, history_variance: np.ndarray, seed: Sequence[int]) -> Result:
    """One device with its history, and one calibration of it."""
    rng = np.random.default_rng(seed)
    level, heading = rng.uniform(-500, 500, 3), rng.uniform(0, 2 * np.pi)
    past = []
    for _ in range(world.past):
        if world.turn is None:
            heading = rng.uniform(0, 2 * np.pi)
        bias = level + rng.normal(0, world.tau, 3) + earth(heading)
        mean = bias + rng.normal(0, np.sqrt(history_variance))
        up = np.array([0, 0, 1.0]) if world.accel_ug else None
        warmth = 25 + rng.normal(0, 0.5) if world.ramp else None
        mean = mean + (SLOPE * (warmth - 25) if warmth else 0)
        past.append(
            Calibration(mean * MDPS, history_variance * MDPS**2, temperature_c=warmth, up=up)
        )
    heading = rng.uniform(0, 2 * np.pi) if world.turn is None else heading + np.radians(world.turn)
    bias = level + rng.normal(0, world.tau, 3) + earth(heading) + world.step
    return measured(rng, world, past, bias)


def measured(rng, world: World, past, bias: np.ndarray) -> Result:
    count = round(world.longest_s * world.rate)
    samples = noise(rng, world, world.longest_s) + bias
    time_s = (np.arange(count) + 0.5) / world.rate
    walk = np.zeros((count, 3))
    if world.walk:
        walk = np.cumsum(rng.normal(0, world.walk / np.sqrt(world.rate), (count, 3)), axis=0)
    if world.warm_up:
        mean, spread, constant_s = world.warm_up
        samples += warm_up(rng.normal(mean, spread, 3), constant_s, count, world.rate).T
    warmth = None
    if world.ramp:
        warmth = 25 + world.ramp * time_s / world.longest_s
        walk = walk + (SLOPE * (warmth - 25))[:, None]
    samples = (samples + walk) * MDPS
    accel = None
    if world.accel_ug:
        accel = rng.normal([0, 0, 1], world.accel_ug * 1e-6 * np.sqrt(world.rate / 2), (count, 3))
    if world.disturb:
        world.disturb(rng, samples, world.rate, *([accel] if accel is not None else []))
    if world.step_dps:
        samples = np.rint(samples / world.step_dps) * world.step_dps
    stamps = time_s + world.jitter / world.rate * rng.uniform(-0.5, 0.5, count)
    kept = rng.uniform(size=count) >= world.lost
    if world.gap_s:
        kept &= np.abs(time_s - world.longest_s / 2) > world.gap_s / 2
    now = Circumstances(same_heading=world.declared, latitude_deg=LATITUDE)
    age = 0.0 if world.warm_up else None
    calibrator = Calibrator(kind_of(world), world.rate, past, now, world.target * MDPS, age)
    marks = [mark for mark in MARKS if mark <= world.longest_s]
    error, sigma, plain, stop, stop_s, seen_s = [], [], [], None, np.inf, np.inf
    edges = sorted({*marks, *range(1, world.longest_s + 1)})
    first, state = 0, None
    for edge in edges:
        if stop is not None and edge not in marks:
            continue
        last = round(edge * world.rate)
        rows = np.flatnonzero(kept[first:last]) + first
        state = calibrator.update(
            stamps[rows], samples[rows], None if accel is None else accel[rows],
            None if warmth is None else warmth[rows],
        )  # fmt: skip
        truth = bias + walk[last - 1]
        off = state.bias_dps / MDPS - truth
        if stop is None and state.done:
            stop, stop_s = (off, state.sigma_dps / MDPS), edge
        if "dropped" in state.history:
            seen_s = min(seen_s, edge)
        if edge in marks:
            error.append(off)
            sigma.append(state.sigma_dps / MDPS)
            plain.append(samples[:last].mean(axis=0) / MDPS - truth)
        first = last
    final = calibrator.finish()
    dropped = np.array([outcome == "dropped" for outcome in final.history])
    codes = tuple(reason.code for reason in final.reasons)
    return Result(
        np.array(error),
        np.array(sigma),
        np.array(plain),
        stop,
        stop_s,
        dropped,
        seen_s,
        final.rest,
        codes,
    )


def many(pool, world: World, count: int, seed: int) -> list[Result]:
    variance = own_variance(world, HISTORY_S)
    seeds = [(seed, number) for number in range(count)]
    return list(pool.map(partial(one, world, variance), seeds, chunksize=20))


def share(inside: np.ndarray) -> str:
    """A share with its 99 % Clopper-Pearson interval."""
    inside = np.asarray(inside).ravel()
    hits, n = int(inside.sum()), inside.size
    low = stats.beta.ppf(0.005, hits, n - hits + 1) if hits else 0.0
    high = stats.beta.ppf(0.995, hits + 1, n - hits) if hits < n else 1.0
    return f"{hits / max(n, 1):.3f} [{low:.3f}, {high:.3f}]"


def slow_rotation(rng, samples, rate, accel=None, *, rate_mdps: float, axis: int) -> None:
    """A steady rotation about an axis from the start, felt by the accelerometer."""
    samples[:, axis] += rate_mdps * MDPS
    if accel is not None and axis != 2:
        angle = np.radians(rate_mdps * MDPS) * (np.arange(len(samples)) + 0.5) / rate
        other = 1 - axis
        accel[:, other] += (1 if axis == 0 else -1) * np.sin(angle)


def rocking(rng, samples, rate, accel=None, *, size_dps: float, period_s: float) -> None:
    phase = rng.uniform(0, 2 * np.pi)
    samples[:, 0] += size_dps * np.sin(
        2 * np.pi * np.arange(len(samples)) / rate / period_s + phase
    )


def knock(rng, samples, rate, accel=None, *, size_dps: float = 2.0) -> None:
    start = int(len(samples) * rng.uniform(0.3, 0.7))
    length = max(int(0.3 * rate), 2)
    shape = np.sin(2 * np.pi * np.arange(length) / length)
    samples[start : start + length] += size_dps * shape[:, None]


KNOCK, SPIN = knock, partial(slow_rotation, rate_mdps=9, axis=2)
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


def stop_table(pool, worlds: dict[str, World], count: int, seed: int) -> None:
    """Coverage and RMSE at the stop, by axis and by what became of the history."""
    head = "world|target|median stop, s|RMSE|x / y / z|all, 99 % interval|dropped in"
    head += "|used / dropped / none|not at rest|said"
    print(f"| {head.replace('|', ' | ')} |\n|{'---|' * 10}")
    for number, (name, world) in enumerate(worlds.items()):
        results = many(pool, world, count, seed + number)
        stops = [r for r in results if r.stop is not None]
        inside = np.array([covered(*r.stop) for r in stops]).reshape(-1, 3)
        drops = np.array([r.dropped for r in stops]).reshape(-1, 3)
        kinds = {
            "used": ~drops & (world.past > 0),
            "dropped": drops,
            "none": ~drops & (world.past == 0),
        }
        outcome = ", ".join(
            f"{k} {inside[m].mean():.3f} of {m.sum()}" for k, m in kinds.items() if m.any()
        )
        codes = Counter(code for r in results for code in r.codes if code not in SILENT)
        cells = (
            name, f"{world.target:g}", f"{np.median([r.stop_s for r in results]):g}",
            f"{rms(np.array([r.stop[0] for r in stops])):.2f}" if stops else "–",
            " / ".join(f"{x:.3f}" for x in inside.mean(axis=0)), share(inside),
            f"{np.mean([r.dropped.any() for r in results]):.4f}", outcome,
            str(sum(r.rest != "still" for r in results)),
            ", ".join(f"{code} {n}" for code, n in codes.most_common(3)),
        )  # fmt: skip
        print(f"| {' | '.join(cells)} |", flush=True)


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
    marks = [m for m in MARKS if m <= World().longest_s]
    print(
        "| world | "
        + " | ".join(f"{m} s" for m in marks)
        + " | dropped | seen by 10 s |\n|---|"
        + "---|" * (len(marks) + 2)
    )
    for number, (name, world) in enumerate(TURNED.items()):
        results = many(pool, world, count, 200 + number)
        error, sigma, plain = (
            np.array([getattr(r, key) for r in results]) for key in ("error", "sigma", "mean")
        )
        cells = [
            f"{rms(error[:, i]):.2f} / {rms(error[:, i]) / rms(plain[:, i]):.2f} / {covered(error[:, i], sigma[:, i]).mean():.3f}"
            for i in range(len(marks))
        ]
        seen = np.mean([r.seen_s <= 10 for r in results])
        print(
            f"| {name} | {' | '.join(cells)} | {np.mean([r.dropped.any() for r in results]):.4f} | {seen:.3f} |",
            flush=True,
        )


def drops(pool, count: int) -> None:
    print(
        "\n## History dropped where it holds, up to 60 s; must be at most 0.005 of calibrations\n"
    )
    for name, world in {
        "base": World(longest_s=60),
        "flicker 3": World(longest_s=60, flicker=3, target=2.5),
    }.items():
        results = many(pool, world, count, 300)
        error, sigma = (np.array([getattr(r, key) for r in results]) for key in ("error", "sigma"))
        print(
            f"{name}: {share(np.array([r.dropped.any() for r in results]))}; RMSE at 10 s {rms(error[:, 2]):.3f}, at 1 s {rms(error[:, 0]):.3f}",
            flush=True,
        )


def filters(pool, count: int) -> None:
    print(
        "\n## The filter alone: RMSE over the exact best linear estimate; must be at most 1.005\n"
    )
    worlds = {
        "white": World(),
        "flicker 3": World(flicker=3),
        "walk 1": World(walk=1),
        "warm-up 5±2, 20 s": World(warm_up=(5, 2, 20)),
    }
    print("| world | prior | 1 s | 3 s | 10 s | 30 s |\n|---|---|---|---|---|---|")
    for name, world in worlds.items():
        for prior in (None, 0.31):
            cells = [f"{against_exact(world, seconds, prior):.5f}" for seconds in (1, 3, 10, 30)]
            print(f"| {name} | {'flat' if prior is None else 'narrow'} | {' | '.join(cells)} |")


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
    squares = lambda w: (
        w @ covariance @ w - 2 * w @ now + seconds * world.walk**2 + spread * (1 - w.sum()) ** 2
    )  # noqa: E731
    filter_, columns = Filter.start(kind_of(replace(world)).noise, 0.5, np.zeros(3), 0.0), []
    for unit_block in [None, *range(blocks)]:
        current = filter_
        for block in range(blocks):
            current, _ = current.update(np.full(3, 1.0 if block == unit_block else 0.0))
        last = own([current]).row(0)
        gain = 1.0 if prior is None else spread / (spread + last.start_variance[0] / MDPS**2)
        columns.append(last.bias[0] + last.follows[0] * (gain - 1) * last.start[0])
    own_weights = np.array(columns[1:]) - columns[0]
    return float(np.sqrt(squares(own_weights) / squares(weights)))


REST = {
    "white": World(longest_s=30),
    "white, accelerometer": World(longest_s=30, accel_ug=100),
    "lag-1 -0.15": World(longest_s=30, lag1=-0.15),
    "flicker 3": World(longest_s=30, flicker=3, target=2.5),
    "noise not known": World(longest_s=30, known=False, past=0),
    "knock": World(longest_s=30, disturb=knock),
    **{
        f"rocking {size:g} deg/s, {period:g} s": World(longest_s=30, disturb=partial(rocking, size_dps=size, period_s=period))
        for size in (0.05, 0.3) for period in (0.4, 4.0)
    },
    **{
        f"slow rotation {rate:g} mdps about {name}": World(longest_s=10, past=0, accel_ug=100, disturb=partial(slow_rotation, rate_mdps=rate, axis=axis))
        for rate in (3.13, 30, 300) for axis, name in ((0, "x (horizontal)"), (2, "z (vertical)"))
    },
}  # fmt: skip


def rest(pool, count: int) -> None:
    print(
        "\n## At rest or not; at rest 'moving' must be at most 6 in 3,000, 3.13 mdps about x seen in 0.95\n"
    )
    print(
        "| world | still | moving | unsure | a motion cut | rotation seen |\n|---|---|---|---|---|---|"
    )
    for number, (name, world) in enumerate(REST.items()):
        results = many(pool, world, count, 400 + number)
        rests = [r.rest for r in results]
        cut, turn = (sum(code in r.codes for r in results) for code in ("cut", "rotation"))
        print(
            f"| {name} | {rests.count('still')} | {rests.count('moving')} | {rests.count('unsure')} | {cut} | {turn} of {len(results)} |",
            flush=True,
        )


def speed(pool, count: int) -> None:
    print("\n## Speed at 1,000 Hz; must be 1e6 samples a second of processor time\n")
    rng = np.random.default_rng(1)
    samples = rng.normal(0, 0.1, (120_000, 3))
    times = np.arange(len(samples)) / 1000
    for seconds in (1, 10, 120):
        best = np.inf
        for _ in range(3):
            calibrator = Calibrator(kind_of(World()), 1000.0, target_dps=1e-3)
            start = time.process_time()
            for first in range(0, len(samples), seconds * 1000):
                part = slice(first, first + seconds * 1000)
                calibrator.update(times[part], samples[part])
            best = min(best, time.process_time() - start)
        print(f"chunks of {seconds} s: {len(samples) / best:.3g} samples a second", flush=True)


def mean_of(seconds: float) -> Rule:
    return lambda samples, accel, rate: samples[: round(seconds * rate)].mean(axis=0)


def ardupilot(samples, accel, rate) -> np.ndarray:
    """Two means of 0.25 s, one after the other, within 0.1 deg/s; else the best pair of 30 s."""
    size = round(0.25 * rate)
    means = samples[: len(samples) // size * size].reshape(-1, size, 3).mean(axis=1)
    apart = np.linalg.norm(np.diff(means, axis=0), axis=1)
    close = np.flatnonzero(apart < 0.1)
    first = close[0] if close.size else apart.argmin()
    return means[first : first + 2].mean(axis=0)


def by_vqf(samples, accel, rate) -> np.ndarray:
    from vqf import VQF

    filter_ = VQF(1 / rate)
    filter_.updateBatch(
        np.ascontiguousarray(np.radians(samples)), np.ascontiguousarray(accel * 9.81)
    )
    bias, sigma = filter_.getBiasEstimate()
    STATED.append(np.degrees(sigma) / MDPS)
    return np.degrees(bias)


def by_fusion(samples, accel, rate) -> np.ndarray:
    import imufusion

    bias, settings = imufusion.Bias(), imufusion.BiasSettings()
    settings.sample_rate = rate
    bias.set_settings(settings)
    for sample in samples:
        bias.update(sample)
    return np.array(bias.get_offset())


RULES: dict[str, Rule] = {
    "ArduPilot, a pair of 0.25 s": ardupilot,
    "Betaflight, iNav: mean of 1.25 s": mean_of(1.25),
    "mean of 3 s": mean_of(3),
    "Xsens: mean of 6 s": mean_of(6),
    "PX4: mean of 10 s": mean_of(10),
    "mean of the window": mean_of(1e6),
    "VQF": by_vqf,
    "Fusion, cold": by_fusion,
}


def rules(pool, count: int) -> None:
    print("\n## Rules of practice on the same windows: RMSE, mdps, by length of the window\n")
    count = min(count, 200)
    windows = {"simulated": list(simulated_windows(count)), "Memsense": list(memsense_windows())}
    print("| rule | simulated 1 s | 30 s | Memsense 1 s | 10 s | 30 s |\n|---|---|---|---|---|---|")
    for name, rule in RULES.items():
        try:
            print(f"| {name} | {' | '.join(rule_cells(windows, rule))} |", flush=True)
        except ImportError as error:
            print(f"| {name} | {error} |")
    if STATED:
        print(f"(VQF states {np.median(STATED):.3g} mdps)")
    for name, same in (("no history", None), ("history", True)):
        cells = rule_cells(windows, partial(by_calibrator, with_history=same))
        print(f"| calibrator, {name} | {' | '.join(cells)} |", flush=True)


@dataclass
class Window:
    """A window, its truth in deg/s with the variance of that, and the history before it."""

    samples: np.ndarray
    seconds: int
    rate: float
    truth: np.ndarray
    variance: np.ndarray
    past: list
    kind: object


def simulated_windows(count: int) -> Iterable[Window]:
    world, rate = World(), 100.0
    variance = own_variance(world, HISTORY_S)
    for number in range(count):
        rng = np.random.default_rng((900, number))
        level = rng.uniform(-500, 500, 3)
        biases = level + rng.normal(0, world.tau, (PAST + 1, 3)) + earth(rng.uniform(0, 2 * np.pi))
        means = biases[:-1] + rng.normal(0, np.sqrt(variance), (PAST, 3))
        past = [Calibration(m * MDPS, variance * MDPS**2) for m in means]
        samples = (biases[-1] + noise(rng, replace(world, rate=rate), 30)) * MDPS
        for seconds in (1, 30):
            part = samples[: round(seconds * rate)]
            yield Window(part, seconds, rate, biases[-1] * MDPS, np.zeros(3), past, kind_of(world))


def memsense_windows() -> Iterable[Window]:
    """Windows from the start of each recording; the truth is the mean of what comes after them."""
    path = real_data() / "memsense_test_real.npy"
    if not path.exists():
        return
    kind, past = read_type("memsense"), []
    for recording in np.load(path):
        for seconds in (1, 10, 30):
            edge = seconds * 250
            rest = recording[:, edge:]
            variance = kind.noise.white**2 * 250 / rest.shape[1]
            window = recording[:, :edge].T
            yield Window(window, seconds, 250.0, rest.mean(axis=1), variance, list(past), kind)
        calibrator = Calibrator(kind, 250.0, past, Circumstances(same_heading=True))
        calibrator.update(None, recording.T)
        past.append(calibrator.evidence())


def by_calibrator(samples, accel, rate, *, window: Window, with_history: bool | None) -> np.ndarray:
    past = window.past if with_history else []
    calibrator = Calibrator(window.kind, rate, past, Circumstances(same_heading=True))
    return calibrator.update(None, samples).bias_dps


def rule_cells(windows: dict[str, list[Window]], rule: Rule) -> Iterable[str]:
    """RMSE of a rule; the variance of a measured truth is taken off."""
    for source, lengths in (("simulated", (1, 30)), ("Memsense", (1, 10, 30))):
        for seconds in lengths:
            chosen = [w for w in windows[source] if w.seconds == seconds]
            squares = [np.square(applied(rule, w) - w.truth) - w.variance for w in chosen]
            yield f"{np.sqrt(max(np.mean(squares), 0)) / MDPS:.2f}" if chosen else "–"


def applied(rule: Rule, window: Window) -> np.ndarray:
    rng = np.random.default_rng(1)
    accel = rng.normal([0, 0, 1], 1e-3, window.samples.shape)
    more = {"window": window} if isinstance(rule, partial) else {}
    return rule(window.samples, accel, window.rate, **more)


def real(pool, count: int) -> None:
    memsense()
    dot()


def memsense() -> None:
    """The eleven recordings in order, as calibrations of one device."""
    windows = list(memsense_windows())
    print(
        "\n## Memsense, eleven recordings in order: σ and RMSE against the rest, mdps, x / y / z\n"
    )
    print("| window | history | σ | RMSE | within 1.96 √(σ² + truth's) |\n|---|---|---|---|---|")
    for seconds in (1, 10, 30):
        for with_history in (False, True):
            states = [
                (w, state_of(w, with_history)) for w in windows
                if w.seconds == seconds and (w.past or not with_history)
            ]  # fmt: skip
            sigma = np.array([s.sigma_dps for _, s in states]) / MDPS
            error = np.array([s.bias_dps - w.truth for w, s in states]) / MDPS
            truth = states[0][0].variance / MDPS**2
            squares = np.mean(error**2, axis=0) - truth
            inside = np.abs(error) <= 1.96 * np.sqrt(sigma**2 + truth)
            cells = " / ".join(f"{x:.2f}" for x in np.median(sigma, axis=0))
            rmse = " / ".join(f"{np.sign(x) * np.sqrt(abs(x)):.2f}" for x in squares)
            print(
                f"| {seconds} s | {'yes' if with_history else 'no'} | {cells} | {rmse} | {inside.mean():.2f} of {inside.size} |"
            )
    print("\nMedian seconds to a target (* from the look-ahead: the recording is too short):\n")
    for target in (1.0, 2.0):
        for with_history in (False, True):
            times = [
                seconds_to(w, with_history, target)
                for w in windows
                if w.seconds == 30 and (w.past or not with_history)
            ]
            cells = " / ".join(f"{x:g}{'*' if x > 52 else ''}" for x in np.median(times, axis=0))
            print(f"{target:g} mdps, history {'yes' if with_history else 'no'}: {cells}")


def state_of(window: Window, with_history: bool, target: float | None = None, seconds: float = 1e9):
    past = window.past if with_history else []
    target_dps = None if target is None else target * MDPS
    now = Circumstances(same_heading=True)
    calibrator = Calibrator(window.kind, window.rate, past, now, target_dps)
    return calibrator.update(None, window.samples[: round(min(seconds * window.rate, 1e9))])


def seconds_to(window: Window, with_history: bool, target: float) -> np.ndarray:
    """Seconds of each axis, as the first half second says."""
    return 0.5 + state_of(window, with_history, target, 0.5).seconds_left


def dot() -> None:
    """Noise from the other four units; 10 s windows of all five."""
    paths = sorted(real_data().glob("dot_x_stat_*.csv"))
    if not paths:
        return
    logs = [dot_samples(path) for path in paths]
    fits = [[allan_fit(samples[:, axis]) for axis in range(3)] for samples in logs]
    inside, errors, sigmas = [], [], []
    for unit, samples in enumerate(logs):
        others = np.array([fits[other] for other in range(len(logs)) if other != unit])
        white, flicker = np.sqrt(np.mean(others**2, axis=0)).T / MDPS
        content = {
            "type": "dot",
            "noise_mdps_rts": white.tolist(),
            "flicker_mdps": flicker.tolist(),
        }
        kind = type_of({**content, "noise_spread": 0.1}, "benchmark")
        for start in range(0, len(samples) - 1200 + 1, 1200):
            window, rest = (
                samples[start : start + 1200],
                np.delete(samples, slice(start, start + 1200), 0),
            )
            calibrator = Calibrator(kind, 120.0)
            state = calibrator.update(None, window)
            truth = [
                outside_noise(NoiseFigures(w * MDPS, f * MDPS, 0.0), len(samples), 120.0, start, 1200)
                for w, f in zip(white, flicker, strict=True)
            ]  # fmt: skip
            error = state.bias_dps - rest.mean(axis=0)
            inside.append(np.abs(error) <= 2 * np.sqrt(state.sigma_dps**2 + truth))
            errors.append(error / MDPS)
            sigmas.append(state.sigma_dps / MDPS)
    print("\n## DOT, five units, 10 s windows, noise from the other four; must be 0.90 to 0.98\n")
    print(f"|error| <= 2 sqrt(sigma^2 + truth's): {share(np.array(inside))}")
    print(
        f"RMSE against the rest {rms(np.array(errors)):.2f}, median sigma {np.median(sigmas):.2f} mdps"
    )


def dot_samples(path: Path) -> np.ndarray:
    """Rates without the rows that hold no measurement."""
    samples = read_log(path, ReaderOptions()).samples[1:12990]
    return samples[np.isfinite(samples).all(axis=1)]


def allan_fit(samples: np.ndarray) -> tuple[float, float]:
    times = averaging_times_s(len(samples), 120.0)
    variance, _ = allan_variance(samples, 120.0, times)
    figures = fit_noise(times, variance, len(samples) / 120.0, 8 / 120.0)
    return figures.white, figures.instability


def real_data() -> Path:
    """Where the real recordings are; see CONTRIBUTING.md."""
    return Path(os.environ.get("GYRO_PIPELINE_REAL_DATA", "none"))


SECTIONS: dict[str, Callable[..., None]] = {
    "filters": filters, "coverage": coverage, "pairs": pairs, "turned": turned, "drops": drops, "rest": rest,
    "rules": rules, "real": real, "speed": speed,
}  # fmt: skip


def main(arguments: Iterable[str] | None = None) -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("sections", nargs="*", choices=list(SECTIONS), default=list(SECTIONS))
    parser.add_argument("--count", type=int, default=1000, help="calibrations a world")
    parser.add_argument("--full", action="store_true", help="4,000 calibrations a world")
    parser.add_argument("--workers", type=int, default=2)
    options = parser.parse_args(arguments)
    with ProcessPoolExecutor(options.workers) as pool:
        for name in options.sections:
            SECTIONS[name](pool, 4000 if options.full else options.count)


if __name__ == "__main__":
    main()
