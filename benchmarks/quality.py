"""What quality control finds, what it wrongly rejects, and how long it takes.

    python benchmarks/quality.py                # everything, half a minute
    python benchmarks/quality.py --repeat 10    # a tenth of the recordings

Noise is that of the four embedded sensors (conf/base/globals.yml) at their rates, 13,000 samples a
recording; every other disturbance is drawn here. Its last results: benchmarks/README.md.
"""

import argparse
import timeit
from collections import Counter
from collections.abc import Callable, Iterable
from pathlib import Path

import numpy as np
import yaml
from numpy.typing import NDArray
from scipy import signal

from gyro_pipeline.conventions import AXES, MDPS
from gyro_pipeline.logs import KEPT, Log
from gyro_pipeline.parameters import Quality, Sensor
from gyro_pipeline.physics import damage, stationarity
from gyro_pipeline.physics.noise import simulate_noise, warm_up
from gyro_pipeline.protocol.quality import Inspected, inspect

CONF = Path(__file__).parents[1] / "conf" / "base"
QUALITY = Quality(**yaml.safe_load((CONF / "parameters/stages.yml").read_text())["quality"])
SENSORS = {
    name: Sensor(**entry)
    for name, entry in yaml.safe_load((CONF / "globals.yml").read_text())["sensors"].items()
}
FLICKER = 3 * MDPS

Samples = NDArray[np.float64]
Disturb = Callable[[np.random.Generator, Samples, float], None]


def at_rest(
    generator: np.random.Generator,
    sensor: Sensor,
    flicker_dps: float = 0.0,
    lag1: float | None = None,
    warm_up_mdps: float = 0.0,
    warm_up_s: float = 30.0,
    samples: int = 13_000,
) -> Samples:
    """One recording at rest, (n, 3), deg/s."""
    simulated, rate_hz = sensor.simulated, sensor.rate_hz
    rates = simulate_noise(
        generator,
        (len(AXES), samples),
        rate_hz,
        np.array(simulated.noise_mdps_rts) * MDPS,
        simulated.lag1_correlation if lag1 is None else lag1,
        flicker_dps,
    ).T.astype(np.float64)
    if warm_up_mdps:
        signs = generator.choice([-1, 1], len(AXES))
        amplitudes = signs * warm_up_mdps * MDPS * generator.normal(1, 0.25, len(AXES))
        rates += warm_up(amplitudes, warm_up_s, samples, rate_hz).T
    return rates + generator.uniform(-1, 1, len(AXES)) * simulated.unit_bias_dps


def turn(generator: np.random.Generator, rates: Samples, rate_hz: float) -> None:
    """A turn of 2 s by hand: a raised cosine of 5 to 60 deg/s about some axis."""
    length = round(2 * rate_hz)
    start = generator.integers(rates.shape[0] - length)
    shape = 0.5 - 0.5 * np.cos(2 * np.pi * np.arange(length) / length)
    rates[start : start + length, generator.integers(3)] += (
        generator.choice([-1, 1]) * generator.uniform(5, 60) * shape
    )


def rotation(generator: np.random.Generator, rates: Samples, rate_hz: float) -> None:
    """0.5 deg/s about some axis, from between a tenth and nine tenths of the recording on."""
    start = int(generator.uniform(0.1, 0.9) * rates.shape[0])
    rates[start:, generator.integers(3)] += generator.choice([-1, 1]) * 0.5


def slow_onset(generator: np.random.Generator, rates: Samples, rate_hz: float) -> None:
    """The same, but reached within 5 s."""
    start = int(generator.uniform(0.1, 0.9) * rates.shape[0])
    ramp = np.clip((np.arange(rates.shape[0]) - start) / (5 * rate_hz), 0, 1)
    rates[:, generator.integers(3)] += generator.choice([-1, 1]) * 0.5 * ramp


def small_step(generator: np.random.Generator, rates: Samples, rate_hz: float) -> None:
    """0.1 deg/s about some axis, from between a tenth and nine tenths of the recording on."""
    start = int(generator.uniform(0.1, 0.9) * rates.shape[0])
    rates[start:, generator.integers(3)] += generator.choice([-1, 1]) * 0.1


def shock(generator: np.random.Generator, rates: Samples, rate_hz: float) -> None:
    """A half sine of 3 to 50 deg/s, 3 samples to 0.2 s long, on all axes in some direction."""
    length = generator.integers(3, round(0.2 * rate_hz) + 1)
    start = generator.integers(rates.shape[0] - length)
    direction = generator.normal(size=3)
    peak = generator.uniform(3, 50) * direction / np.linalg.norm(direction)
    shape = np.sin(np.pi * (np.arange(length) + 0.5) / length)
    rates[start : start + length] += shape[:, None] * peak


def carried(generator: np.random.Generator, rates: Samples, rate_hz: float) -> None:
    """Carried about gently throughout: noise below 1 Hz of 2 deg/s."""
    sections = signal.butter(2, 1.0, fs=rate_hz, output="sos")
    sway = signal.sosfilt(sections, generator.normal(size=rates.shape), axis=0)
    rates += 2 * sway / sway.std(axis=0)


def vibration(generator: np.random.Generator, rates: Samples, rate_hz: float) -> None:
    """25 Hz of four times the noise's standard deviation, for 2 s."""
    length = round(2 * rate_hz)
    start = generator.integers(rates.shape[0] - length)
    wave = np.sin(2 * np.pi * 25 / rate_hz * np.arange(length))[:, None]
    rates[start : start + length] += 4 * rates.std(axis=0) * wave


DISTURBED: dict[str, tuple[Disturb, set[str]]] = {
    "2 s turn, 5 to 60 deg/s": (turn, {"motion"}),
    "0.5 deg/s from midway": (rotation, {"motion"}),
    "0.5 deg/s from midway, within 5 s": (slow_onset, {"motion"}),
    "0.1 deg/s from midway": (small_step, {"motion"}),
    "shock, 3 to 50 deg/s": (shock, {"shocks"}),
    "carried throughout, 2 deg/s": (carried, {"motion", "noise level"}),
    "vibration for 2 s, 4 sigma": (vibration, {"motion", "shocks"}),
}
AT_REST: dict[str, dict[str, object]] = {
    "white, lag 1 of the sensor": {},
    "lag-1 correlation -0.15": {"lag1": -0.15},
    "flicker 3 mdps": {"flicker_dps": FLICKER},
    "warm-up 20 +- 5 mdps": {"warm_up_mdps": 20.0},
    "flicker and warm-up": {"flicker_dps": FLICKER, "warm_up_mdps": 20.0},
    "warm-up 300 +- 75 mdps, within 5 s": {"warm_up_mdps": 300.0, "warm_up_s": 5.0},
}


def tally(inspected: Iterable[Inspected]) -> tuple[Counter[str], Counter[str]]:
    """How recordings end, and which checks have findings."""
    outcomes, checks = Counter[str](), Counter[str]()
    for one in inspected:
        outcomes[one.outcome] += 1
        checks.update({finding.check for finding in one.findings})
    return outcomes, checks


def show_found(generator: np.random.Generator, count: int) -> None:
    """Share of disturbances that the right check finds."""
    print(f"\nof {count} recordings of each sensor with one disturbance: found; how they end")
    for name, (disturb, right) in DISTURBED.items():
        for sensor_name, sensor in SENSORS.items():
            found, outcomes = 0, Counter[str]()
            for _ in range(count):
                rates = at_rest(generator, sensor)
                disturb(generator, rates, sensor.rate_hz)
                one = inspect(Log(rates), sensor.rate_hz, QUALITY)
                outcomes[one.outcome] += 1
                found += any(f.check in right and f.outcome != KEPT for f in one.findings)
            print(f"{name:36s} {sensor_name:9s} {found:4d}  {dict(outcomes)}")


def show_rest(generator: np.random.Generator, count: int) -> None:
    """What happens to recordings at rest."""
    print(f"\nof {count} recordings at rest, a quarter of each sensor: how they end; findings")
    for name, options in AT_REST.items():
        outcomes, checks = tally(
            inspect(Log(at_rest(generator, sensor, **options)), sensor.rate_hz, QUALITY)  # type: ignore[arg-type]
            for sensor in SENSORS.values()
            for _ in range(count // len(SENSORS))
        )
        print(f"{name:36s} {dict(outcomes)}  {dict(checks)}")


def show_margins(generator: np.random.Generator, count: int) -> None:
    """False alarms of the motion test against the nominal ones, at higher levels."""
    print(f"\nfalse alarms of the changes of means, of {count} recordings of dot; nominal: found")
    levels = (1e-1, 1e-2, 1e-3, 1e-4, 1e-6)
    for name, options in AT_REST.items():
        alarms = Counter[float]()
        for _ in range(count):
            rates = at_rest(generator, SENSORS["dot"], **options)  # type: ignore[arg-type]
            size = round(QUALITY.block_s * SENSORS["dot"].rate_hz)
            blocks = stationarity.Blocks.of(np.ascontiguousarray(rates.T), size)
            means = stationarity.Means.of(blocks, np.ones(len(blocks.starts), bool))
            lags = [round(lag_s / QUALITY.block_s) for lag_s in QUALITY.lags_s]
            for level in levels:
                alarms[level] += bool(stationarity.changes(means, lags, level).any())
        print(f"{name:36s} " + "  ".join(f"{level:g}: {alarms[level]}" for level in levels))


def show_flat_tops(generator: np.random.Generator, count: int) -> None:
    """False alarms of saturation, by quantisation step, beside clipped noise."""
    print(f"\nof {count} axes of Gaussian noise, flat tops by step in sigma; clipped at 2 sigma")
    for step in (0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1, 1.5, 2):
        tops = np.zeros(2, int)
        for _ in range(count):
            level = generator.uniform(-1, 1)
            rates = step * np.round(generator.normal(level, 1, (1, 13_000)) / step)
            tops += [damage.saturated(x).any() for x in (rates, np.minimum(rates, level + 2))]
        print(f"{step:5g}  {tops[0]}  {tops[1]}")


def show_time(generator: np.random.Generator) -> None:
    """Milliseconds for 13,000 x 3 samples, the best of 7 x 50."""
    print("\nmilliseconds per recording of 13,000 x 3")
    clean = at_rest(generator, SENSORS["sparkfun"])
    rate_hz = SENSORS["sparkfun"].rate_hz
    kinds = {"clean": clean, "step of 30 mdps": 0.03 * np.round(clean / 0.03), "shock": clean + 0}
    shock(generator, kinds["shock"], rate_hz)
    kinds["one NaN"] = clean + 0
    kinds["one NaN"][40] = np.nan
    for name, rates in kinds.items():
        log = Log(rates)
        best = min(timeit.repeat(lambda: inspect(log, rate_hz, QUALITY), number=50, repeat=7)) / 50  # noqa: B023
        print(f"{name:20s} {1e3 * best:.2f}")


def main() -> None:
    """Print all tables."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--repeat", type=int, default=100, help="recordings per disturbance")
    count = parser.parse_args().repeat
    generator = np.random.default_rng(20240910)
    show_found(generator, count)
    show_rest(generator, 10 * count)
    show_margins(generator, 5 * count)
    show_flat_tops(generator, 20 * count)
    show_time(generator)


if __name__ == "__main__":
    main()
