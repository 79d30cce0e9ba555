"""What quality control finds, what it wrongly rejects, and how long it takes.

    python benchmarks/quality.py                # everything, some five minutes
    python benchmarks/quality.py --repeat 10    # a tenth of the recordings

Disturbances and warm-ups are added to the noise of the four sensors of conf/base/globals.yml at
their rates, 13,000 samples a recording. Its last results: benchmarks/README.md.
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
from gyro_pipeline.logs import KEPT, REJECTED, Log
from gyro_pipeline.parameters import Quality, Sensor
from gyro_pipeline.physics.noise import simulate_noise, warm_up
from gyro_pipeline.quality import Inspected, inspect

CONF = Path(__file__).parents[1] / "conf" / "base"
QUALITY = Quality(**yaml.safe_load((CONF / "parameters/stages.yml").read_text())["quality"])
SENSORS = {
    name: Sensor(**entry)
    for name, entry in yaml.safe_load((CONF / "globals.yml").read_text())["sensors"].items()
}
FLICKER, SAMPLES = 3 * MDPS, 13_000

Samples = NDArray[np.float64]
Disturb = Callable[[np.random.Generator, Samples, float], None]


def at_rest(
    generator: np.random.Generator,
    sensor: Sensor,
    flicker_dps: float = 0.0,
    warm_up_mdps: float = 0.0,
    warm_up_s: float = 30.0,
) -> Samples:
    """One recording at rest, (n, 3), deg/s."""
    simulated, rate_hz = sensor.simulated, sensor.rate_hz
    rates = simulate_noise(
        generator,
        (len(AXES), SAMPLES),
        rate_hz,
        np.array(simulated.noise_mdps_rts) * MDPS,
        simulated.lag1_correlation,
        flicker_dps,
    ).T.astype(np.float64)
    if warm_up_mdps:
        signs = generator.choice([-1, 1], len(AXES))
        amplitudes = signs * warm_up_mdps * MDPS * generator.normal(1, 0.25, len(AXES))
        rates += warm_up(amplitudes, warm_up_s, SAMPLES, rate_hz).T
    return rates + generator.uniform(-1, 1, len(AXES)) * simulated.unit_bias_dps


def turn(generator: np.random.Generator, rates: Samples, rate_hz: float) -> None:
    """A turn of 2 s by hand: a raised cosine of 5 to 60 deg/s about some axis."""
    length = round(2 * rate_hz)
    start = generator.integers(rates.shape[0] - length)
    shape = 0.5 - 0.5 * np.cos(2 * np.pi * np.arange(length) / length)
    rates[start : start + length, generator.integers(3)] += (
        generator.choice([-1, 1]) * generator.uniform(5, 60) * shape
    )


def slow_onset(generator: np.random.Generator, rates: Samples, rate_hz: float) -> None:
    """0.5 deg/s about some axis, reached within 5 s."""
    start = int(generator.uniform(0.1, 0.9) * rates.shape[0])
    ramp = np.clip((np.arange(rates.shape[0]) - start) / (5 * rate_hz), 0, 1)
    rates[:, generator.integers(3)] += generator.choice([-1, 1]) * 0.5 * ramp


def step(size_dps: float) -> Disturb:
    """A rate about some axis, from between a tenth and nine tenths of the recording on."""

    def disturb(generator: np.random.Generator, rates: Samples, rate_hz: float) -> None:
        start = int(generator.uniform(0.1, 0.9) * rates.shape[0])
        rates[start:, generator.integers(3)] += generator.choice([-1, 1]) * size_dps

    return disturb


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


def spike(generator: np.random.Generator, rates: Samples, rate_hz: float) -> None:
    """One sample of one axis, off by nine times the noise's standard deviation."""
    row, axis = generator.integers(rates.shape[0]), generator.integers(3)
    rates[row, axis] += generator.choice([-1, 1]) * 9 * rates[:, axis].std()


def sway(amplitude_dps: float, period_s: float) -> Disturb:
    """A sinusoid about one axis throughout, from some phase on."""

    def disturb(generator: np.random.Generator, rates: Samples, rate_hz: float) -> None:
        phases = 2 * np.pi * (np.arange(rates.shape[0]) / rate_hz / period_s + generator.random())
        rates[:, generator.integers(3)] += amplitude_dps * np.sin(phases)

    return disturb


DISTURBED: dict[str, tuple[Disturb, set[str]]] = {
    "2 s turn, 5 to 60 deg/s": (turn, {"motion"}),
    "0.5 deg/s from midway": (step(0.5), {"motion"}),
    "0.5 deg/s from midway, within 5 s": (slow_onset, {"motion"}),
    "0.1 deg/s from midway": (step(0.1), {"motion"}),
    "0.05 deg/s from midway": (step(0.05), {"motion"}),
    "shock, 3 to 50 deg/s": (shock, {"motion", "shocks", "spikes", "start"}),
    "carried throughout, 2 deg/s": (carried, {"motion", "noise level"}),
    "vibration for 2 s, 4 sigma": (vibration, {"motion", "shocks"}),
    "one sample of 9 sigma": (spike, {"shocks", "spikes"}),
}
WARM_UPS: dict[str, dict[str, float]] = {
    "20 +- 5 mdps, 30 s": {"warm_up_mdps": 20.0},
    "20 +- 5 mdps, 30 s, flicker 3 mdps": {"flicker_dps": FLICKER, "warm_up_mdps": 20.0},
    "300 +- 75 mdps, 5 s": {"warm_up_mdps": 300.0, "warm_up_s": 5.0},
}
COLOURS: dict[str, dict[str, float]] = {
    "white": {},
    "lag-1 correlation -0.15": {"lag1_correlation": -0.15},
    "flicker 3 mdps": {"flicker_dps": FLICKER},
}
LENGTHS = ((5, 120), (10, 60), (50, 10), (108, 5), (250, 1), (1000, 1))
"""Sample rate, Hz, and minutes."""


def show_found(generator: np.random.Generator, count: int) -> None:
    """How many disturbances the right check finds, and how the recordings end."""
    print(f"\nof {count} recordings of each sensor with one disturbance: found; how they end")
    for name, (disturb, right) in DISTURBED.items():
        for sensor_name, sensor in SENSORS.items():
            found, outcomes = 0, Counter[str]()
            for _ in range(count):
                rates = at_rest(generator, sensor)
                disturb(generator, rates, sensor.rate_hz)
                inspected = inspect(Log(rates), sensor.rate_hz, QUALITY)
                outcomes[inspected.outcome] += 1
                found += any(f.check in right and f.outcome != KEPT for f in inspected.findings)
            print(f"{name:36s} {sensor_name:9s} {found:4d}  {dict(outcomes)}")


def show_sways(generator: np.random.Generator, count: int) -> None:
    """How many recordings with a sinusoid are rejected, by amplitude and period."""
    periods = (1, 2, 5, 10, 20)
    print(f"\nof {count} recordings with a sway, a quarter of each sensor: rejected; periods in s")
    print(" " * 12 + "".join(f"{period:5d}" for period in periods))
    for amplitude_dps in (0.1, 0.2, 0.5, 1.0):
        rejected = []
        for period_s in periods:
            outcomes = Counter[str]()
            for sensor in SENSORS.values():
                for _ in range(count // len(SENSORS)):
                    rates = at_rest(generator, sensor)
                    sway(amplitude_dps, period_s)(generator, rates, sensor.rate_hz)
                    outcomes[inspect(Log(rates), sensor.rate_hz, QUALITY).outcome] += 1
            rejected.append(outcomes[REJECTED])
        print(f"{amplitude_dps:6g} deg/s" + "".join(f"{number:5d}" for number in rejected))


def tally(inspected: Iterable[Inspected]) -> str:
    """How recordings end, and which checks have findings."""
    outcomes, checks = Counter[str](), Counter[str]()
    for recording in inspected:
        outcomes[recording.outcome] += 1
        checks.update({finding.check for finding in recording.findings})
    return f"{dict(outcomes)}  {dict(checks)}"


def show_warm_ups(generator: np.random.Generator, count: int) -> None:
    """What happens to recordings at rest whose bias settles."""
    print(
        f"\nof {count} recordings with a warm-up, a quarter of each sensor: how they end; findings"
    )
    for name, options in WARM_UPS.items():
        ends = tally(
            inspect(Log(at_rest(generator, sensor, **options)), sensor.rate_hz, QUALITY)  # type: ignore[arg-type]
            for sensor in SENSORS.values()
            for _ in range(count // len(SENSORS))
        )
        print(f"{name:36s} {ends}")


def show_rest(generator: np.random.Generator, count: int) -> None:
    """What happens to recordings at rest, N 5 mdps sqrt(s), at any rate and of any length."""
    print(f"\nof {count} recordings at rest: how they end; findings")
    for rate_hz, minutes in LENGTHS:
        for name, noise in COLOURS.items():
            shape = (len(AXES), 60 * minutes * rate_hz)
            draws = (
                simulate_noise(generator, shape, rate_hz, 5 * MDPS, **noise) for _ in range(count)
            )
            ends = tally(inspect(still(draw), rate_hz, QUALITY) for draw in draws)
            print(f"{rate_hz:4d} Hz, {minutes:3d} min, {name:24s} {ends}")
    few, shape = count // 10, (len(AXES), 36_000)
    draws = (
        simulate_noise(generator, shape, 5, 5 * MDPS, random_walk_dps_rts=0.1 * MDPS)
        for _ in range(few)
    )
    ends = tally(inspect(still(draw), 5, QUALITY) for draw in draws)
    print(f"of {few}, walk of 0.1 mdps/sqrt(s), 5 Hz, 2 h: {ends}")
    sections = signal.butter(2, 5, fs=1000, output="sos")
    draws = (
        signal.sosfilt(sections, generator.normal(0, 0.55, (len(AXES), 61_000)))[:, 1000:]
        for _ in range(few)
    )
    ends = tally(inspect(still(draw), 1000, QUALITY) for draw in draws)
    print(f"of {few}, 0.05 deg/s below 5 Hz, 1 kHz, 1 min: {ends}")


def still(noise: Samples) -> Log:
    """A log of noise, (3, n), about three biases."""
    return Log(noise.T.astype(np.float64) + [0.31, -0.72, 0.05])


def show_time(generator: np.random.Generator) -> None:
    """Milliseconds for 13,000 x 3 samples, the best of 7 x 50."""
    print("\nmilliseconds per recording of 13,000 x 3")
    clean = at_rest(generator, SENSORS["sparkfun"])
    rate_hz = SENSORS["sparkfun"].rate_hz
    warm = warm_up(0.2, 20, len(clean), rate_hz)
    kinds = {
        "clean": clean,
        "step of 30 mdps": 0.03 * np.round(clean / 0.03),
        "warm-up": clean + warm[:, None],
        "shock": clean + 0,
        "one NaN": clean + 0,
    }
    shock(generator, kinds["shock"], rate_hz)
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
    show_sways(generator, count)
    show_warm_ups(generator, 10 * count)
    show_time(generator)
    show_rest(generator, 10 * count)


if __name__ == "__main__":
    main()
