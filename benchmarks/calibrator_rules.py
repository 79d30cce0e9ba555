"""The calibrator beside the rules of practice, and on real recordings.

    GYRO_PIPELINE_REAL_DATA=folder python benchmarks/calibrator_rules.py

The rules are those of docs/calibrator.md; VQF and Fusion are run by their own packages, where they
are installed (the extra [bench]). CONTRIBUTING.md says which real recordings are read.
"""

import os
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path

import numpy as np
from calibrator import (
    HISTORY_S,
    MDPS,
    PAST,
    World,
    earth,
    kind_of,
    noise,
    own_variance,
    rms,
    row,
    share,
    table,
)

from gyro_pipeline.calibrator import Calibration, Calibrator, Circumstances, read_type
from gyro_pipeline.calibrator.device_types import type_of
from gyro_pipeline.parameters import ReaderOptions
from gyro_pipeline.physics.allan import NoiseFigures, allan_variance, averaging_times_s, fit_noise
from gyro_pipeline.physics.recording_model import outside_noise
from gyro_pipeline.readers import read_log

ARDUPILOT_DPS = 0.1
LENGTH_S = 52  # of a Memsense recording
SECONDS = (1, 10, 30)
STATED: list[float] = []  # standard deviations that VQF states, mdps

Rule = Callable[..., np.ndarray]


def mean_of(seconds: float) -> Rule:
    return lambda samples, accel, rate: samples[: round(seconds * rate)].mean(axis=0)


def ardupilot(samples, accel, rate) -> np.ndarray:
    """Two means of 0.25 s, one after the other, within 0.1 deg/s; else the best pair of 30 s."""
    size = round(0.25 * rate)
    means = samples[: len(samples) // size * size].reshape(-1, size, 3).mean(axis=1)
    apart = np.linalg.norm(np.diff(means, axis=0), axis=1)
    close = np.flatnonzero(apart < ARDUPILOT_DPS)
    first = close[0] if close.size else apart.argmin()
    return means[first : first + 2].mean(axis=0)


def by_vqf(samples, accel, rate) -> np.ndarray:
    from vqf import VQF  # noqa: PLC0415 - may be missing

    filter_ = VQF(1 / rate)
    filter_.updateBatch(
        np.ascontiguousarray(np.radians(samples)), np.ascontiguousarray(accel * 9.81)
    )
    bias, sigma = filter_.getBiasEstimate()
    STATED.append(np.degrees(sigma) / MDPS)
    return np.degrees(bias)


def by_fusion(samples, accel, rate) -> np.ndarray:
    import imufusion  # noqa: PLC0415 - may be missing

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


def rules(count: int = 200) -> None:
    print("\n## Rules of practice on the same windows: RMSE, mdps, by length of the window\n")
    windows = {"simulated": list(simulated_windows(count)), "Memsense": list(memsense_windows())}
    table("rule|simulated 1 s|30 s|Memsense 1 s|10 s|30 s")
    for name, rule in RULES.items():
        try:
            row(name, *rule_cells(windows, lambda w, rule=rule: applied(rule, w)))
        except ImportError as error:
            row(name, error)
    print(f"(VQF states {np.median(STATED or [np.nan]):.3g} mdps)")
    for name, with_history in (("no history", False), ("history", True)):
        cells = rule_cells(windows, lambda w, h=with_history: state_of(w, h).bias_dps)
        row(f"calibrator, {name}", *cells)


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
        past = [Calibration(tuple(m * MDPS), tuple(variance * MDPS**2)) for m in means]
        samples = (biases[-1] + noise(rng, replace(world, rate=rate))) * MDPS
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
        for seconds in SECONDS:
            edge = seconds * 250
            rest = recording[:, edge:]
            variance = kind.noise.white**2 * 250 / rest.shape[1]
            window = recording[:, :edge].T
            yield Window(window, seconds, 250.0, rest.mean(axis=1), variance, list(past), kind)
        calibrator = Calibrator(kind, 250.0, past, Circumstances(same_heading=True))
        calibrator.update(None, recording.T)
        past.append(calibrator.calibration())


def state_of(window: Window, with_history: bool, target: float | None = None, seconds: float = 1e3):
    past, now = window.past if with_history else [], Circumstances(same_heading=True)
    target_dps = None if target is None else target * MDPS
    calibrator = Calibrator(window.kind, window.rate, past, now, target_dps)
    return calibrator.update(None, window.samples[: round(seconds * window.rate)])


def rule_cells(windows: dict[str, list[Window]], bias_of: Callable) -> Iterable[str]:
    """RMSE of a rule; the variance of a measured truth is taken off."""
    for source, lengths in (("simulated", (1, 30)), ("Memsense", (1, 10, 30))):
        for seconds in lengths:
            chosen = [w for w in windows[source] if w.seconds == seconds]
            squares = [np.square(bias_of(w) - w.truth) - w.variance for w in chosen]
            yield f"{np.sqrt(max(np.mean(squares), 0)) / MDPS:.2f}" if chosen else "–"


def applied(rule: Rule, window: Window) -> np.ndarray:
    accel = np.random.default_rng(1).normal([0, 0, 1], 1e-3, window.samples.shape)
    return rule(window.samples, accel, window.rate)


def memsense() -> None:
    """The eleven recordings in order, as calibrations of one device."""
    windows = list(memsense_windows())
    if not windows:
        return
    print("\n## Memsense, eleven in order: σ and RMSE against the rest, mdps, x / y / z\n")
    table("window|history|σ|RMSE|within 1.96 √(σ² + truth's)")
    for seconds, with_history in product(SECONDS, (False, True)):
        chosen = [w for w in windows if w.seconds == seconds and (w.past or not with_history)]
        states = [state_of(w, with_history) for w in chosen]
        sigma = np.array([s.sigma_dps for s in states]) / MDPS
        error = np.array([s.bias_dps - w.truth for w, s in zip(chosen, states, strict=True)]) / MDPS
        truth = chosen[0].variance / MDPS**2
        squares = np.mean(error**2, axis=0) - truth
        inside = np.abs(error) <= 1.96 * np.sqrt(sigma**2 + truth)
        rmse = per_axis(np.sign(squares) * np.sqrt(np.abs(squares)))
        covered = f"{inside.mean():.2f} of {inside.size}"
        row(f"{seconds} s", with_history, per_axis(np.median(sigma, axis=0)), rmse, covered)
    print("\nMedian seconds to a target (* from the look-ahead: the recording is too short):\n")
    for target, with_history in product((1.0, 2.0), (False, True)):
        chosen = [w for w in windows if w.seconds == SECONDS[-1] and (w.past or not with_history)]
        # of each axis, as the first half second says
        left = [0.5 + state_of(w, with_history, target, 0.5).seconds_left for w in chosen]
        median = np.median(left, axis=0)
        cells = " / ".join(f"{x:g}{'*' if x > LENGTH_S else ''}" for x in median)
        print(f"{target:g} mdps, history {'yes' if with_history else 'no'}: {cells}")


def per_axis(values: np.ndarray) -> str:
    return " / ".join(f"{x:.2f}" for x in values)


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
        white, flicker = np.sqrt(np.mean(others**2, axis=0)).T
        content = {"noise_mdps_rts": white / MDPS, "flicker_mdps": flicker / MDPS}
        kind = type_of({"type": "dot", "noise_spread": 0.1, **content}, "benchmark")
        figures = [NoiseFigures(w, f, 0) for w, f in zip(white, flicker, strict=True)]
        for start in range(0, len(samples) - 1200 + 1, 1200):
            part = slice(start, start + 1200)
            state = Calibrator(kind, 120.0).update(None, samples[part])
            truth = [outside_noise(f, len(samples), 120.0, start, 1200) for f in figures]
            error = state.bias_dps - np.delete(samples, part, 0).mean(axis=0)
            inside.append(np.abs(error) <= 2 * np.sqrt(state.sigma_dps**2 + truth))
            errors.append(error / MDPS)
            sigmas.append(state.sigma_dps / MDPS)
    print("\n## DOT, five units, 10 s windows, noise from the other four; must be 0.90 to 0.98\n")
    print(f"|error| <= 2 sqrt(sigma^2 + truth's): {share(np.array(inside))}")
    print(
        f"RMSE against the rest {rms(np.array(errors)):.2f}, median σ {np.median(sigmas):.2f} mdps"
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


if __name__ == "__main__":
    rules()
    memsense()
    dot()
