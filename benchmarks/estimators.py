"""How good the estimators are, against what is possible and against the running mean.

    python benchmarks/estimators.py                    # everything
    python benchmarks/estimators.py --part white       # one part: white, cnn, warm_up, drifts,
                                                       # memsense, few, coverage, history
    python benchmarks/estimators.py --quick            # a fraction of the seeds

Simulated recordings are SparkFun's: N = 3.3 mdps sqrt(s), turn-on spread 0.31 mdps, 13000 samples
in 87 s. The real ones are read from the folder that GYRO_PIPELINE_REAL_DATA names; without it those
parts are left out. Figures are ratios of RMSE against truth (a), the mean of the recording, over
all non-overlapping windows. What each part shows, and its last results: benchmarks/README.md.
"""

import argparse
import os
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pandas as pd
import xarray as xr

from gyro_pipeline.conventions import (
    AXES,
    DIMENSIONS,
    MDPS,
    ORIGIN_REAL,
    PAPER,
    RECORDING_MEAN,
    TRAIN,
    VALIDATION,
)
from gyro_pipeline.estimators import ESTIMATORS, estimator_class, make_estimator
from gyro_pipeline.estimators.base import Estimator
from gyro_pipeline.estimators.training_set import TrainingSet
from gyro_pipeline.physics.allan import NoiseFigures
from gyro_pipeline.physics.bias import windows_at
from gyro_pipeline.physics.noise import simulate_noise, warm_up
from gyro_pipeline.physics.recording_model import RecordingModel, best_linear
from gyro_pipeline.pipeline_registry import base_parameters

SAMPLES, RECORDING_S = 13_000, 87.0
RATE_HZ = SAMPLES / RECORDING_S
N, SPREAD = 3.3 * MDPS, 0.31 * MDPS
FLICKER, RANDOM_WALK = 3 * MDPS, 0.1 * MDPS
WARM_UP = (20 * MDPS, 5 * MDPS, 30.0)
TESTED = 40
WINDOWS_S = (1, 2, 5, 10, 30)
MEMSENSE_RATE_HZ = 250.0
PUBLISHED_CONSTANT_DPS = 0.0014536

MODELS = {
    "white": RecordingModel(
        SAMPLES, RATE_HZ, NoiseFigures(N, 0, 0), np.zeros(1), np.array([[SPREAD**2]])
    ),
    "coloured": RecordingModel(
        SAMPLES, RATE_HZ, NoiseFigures(N, FLICKER, 0), np.zeros(1), np.array([[SPREAD**2]])
    ),
    "coloured_walk": RecordingModel(
        SAMPLES,
        RATE_HZ,
        NoiseFigures(N, FLICKER, RANDOM_WALK),
        np.zeros(1),
        np.array([[SPREAD**2]]),
    ),
    "warm_up": RecordingModel(
        SAMPLES,
        RATE_HZ,
        NoiseFigures(N, FLICKER, RANDOM_WALK),
        np.array([0, WARM_UP[0]]),
        np.diag([SPREAD**2, WARM_UP[1] ** 2]),
        WARM_UP[2],
    ),
}


def simulate(generator: np.random.Generator, model: RecordingModel, count: int) -> xr.Dataset:
    """Recordings of one IMU whose three axes follow the model, about biases of +- 0.5 deg/s."""
    noise = model.noise
    rates = simulate_noise(
        generator,
        (1, count, len(AXES), model.samples),
        model.rate_hz,
        noise.white,
        flicker_dps=noise.instability,
        random_walk_dps_rts=noise.random_walk,
    )
    drawn = generator.multivariate_normal(model.mean, model.covariance, (1, count, len(AXES)))
    bias = generator.uniform(-0.5, 0.5, len(AXES)) + drawn[..., 0]
    rates += bias[..., None].astype(np.float32)
    if model.mean.size > 1:
        decay = warm_up(drawn[..., 1], model.time_constant_s, model.samples, model.rate_hz)
        rates += decay.astype(np.float32)
    unit = bias - drawn[..., 0]
    data = {"angular_rate": (DIMENSIONS, rates), "unit_bias": (("axis",), unit[0, 0])}
    return labelled(data, count, model.rate_hz)


def labelled(data: dict[str, tuple], count: int, rate_hz: float) -> xr.Dataset:
    """Recordings of IMU 1 in the layout of the conventions."""
    coords = {"imu": [1], "recording": np.arange(1, 1 + count), "axis": list(AXES)}
    lengths = np.full((1, count), data["angular_rate"][1].shape[-1])
    means = data["angular_rate"][1].mean(axis=-1, dtype=np.float64)
    data |= {"samples": (DIMENSIONS[:2], lengths), "recording_mean": (DIMENSIONS[:3], means)}
    return xr.Dataset(data, coords, {"rate_hz": rate_hz, "sensor": "benchmark"})


def memsense() -> xr.Dataset | None:
    """The public Memsense recordings, if they are at hand."""
    folder = os.environ.get("GYRO_PIPELINE_REAL_DATA")
    if folder is None:
        return None
    rates = np.load(Path(folder) / "memsense_test_real.npy")
    return labelled({"angular_rate": (DIMENSIONS, rates[None])}, len(rates), MEMSENSE_RATE_HZ)


def windows_of(recordings: xr.Dataset, window_s: float) -> Iterator[tuple]:
    """Number, windows, their starts and the mean of each recording."""
    rate_hz = recordings.attrs["rate_hz"]
    size = round(window_s * rate_hz)
    for number in recordings.recording.to_numpy():
        samples = recordings.angular_rate.sel(imu=1, recording=number).to_numpy()
        starts = np.arange(0, samples.shape[-1] - size + 1, size)
        windows = windows_at(samples, size, starts).transpose(1, 0, 2)
        yield int(number), windows, starts / rate_hz, samples.mean(axis=-1, dtype=np.float64)


def fitted(name: str, recordings: xr.Dataset, window_s: float, validate: int = 0) -> Estimator:
    """An estimator, fitted to all windows of a length; the last recordings validate."""
    size = round(window_s * recordings.attrs["rate_hz"])
    numbers = recordings.recording.to_numpy()
    starts = np.arange(0, recordings.sizes["sample"] - size + 1, size)
    rows = pd.MultiIndex.from_product([numbers, starts], names=["recording", "start"])
    windows = rows.to_frame(index=False).assign(role=TRAIN, origin=ORIGIN_REAL, imu=1)
    windows.loc[windows.recording.isin(numbers[len(numbers) - validate :]), "role"] = VALIDATION
    training = TrainingSet(recordings, None, windows, size, 1)
    return make_estimator(name, base_parameters().training, 0).fit(training)


def judged(
    estimator: Estimator, tested: xr.Dataset, window_s: float
) -> tuple[np.ndarray, np.ndarray]:
    """Errors against the mean of the recording, and sigmas, both (windows, axes)."""
    errors, sigmas = [], []
    for number, windows, starts, truth in windows_of(tested, window_s):
        bias, sigma = estimator.estimate(windows, RECORDING_MEAN, starts, number)
        errors.append(bias - truth)
        sigmas.append(sigma)
    return np.concatenate(errors), np.concatenate(sigmas)


def rms(errors: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(errors))))


class Oracle:
    """The best estimate by one who knows the model."""

    def __init__(self, model: RecordingModel, unit_bias: np.ndarray) -> None:
        self._model, self._unit = model, unit_bias
        self._lines: dict = {}

    def estimate(self, windows, target, start_s, recording=None):
        biases = np.empty(windows.shape[:2])
        for i, start in enumerate(np.rint(start_s * self._model.rate_hz).astype(int)):
            key = int(start), windows.shape[-1]
            if key not in self._lines:
                self._lines[key] = best_linear(self._model, *key, PAPER)
            line = self._lines[key]
            # its weights were made for a unit bias of 0
            biases[i] = line(windows[i] - self._unit[:, None]) + self._unit
        return biases, np.full(biases.shape, np.nan)


def split(recordings: xr.Dataset, training: int) -> tuple[xr.Dataset, xr.Dataset]:
    """The first recordings, and the last TESTED ones."""
    return recordings.isel(recording=slice(training)), recordings.isel(
        recording=slice(-TESTED, None)
    )


def to_the_oracle(model: str, names: list[str], counts: list[int], seeds: int) -> None:
    """Mean and largest ratio to the oracle on the same windows, 10 s, over data seeds."""
    ratios: dict[tuple[str, int], list[float]] = {}
    for seed in range(seeds):
        made = simulate(np.random.default_rng([7, seed]), MODELS[model], max(counts) + TESTED)
        _, tested = split(made, 0)
        oracle = rms(judged(Oracle(MODELS[model], made.unit_bias.to_numpy()), tested, 10)[0])
        for count in counts:
            for name in names:
                estimator = fitted(name, split(made, count)[0], 10)
                error = rms(judged(estimator, tested, 10)[0])
                ratios.setdefault((name, count), []).append(error / oracle)
    for (name, count), values in ratios.items():
        mean, largest = np.mean(values), np.max(values)
        print(f"  {name:24} {count:3} recordings: {mean:6.3f} (largest {largest:.3f}, n={seeds})")


def white(quick: bool) -> None:
    print("\nSimulated white noise, 10 s: RMSE over that of the oracle")
    names = [
        *("empirical_bayes", "empirical_bayes_pooled", "best_linear", "best_linear_allan"),
        *("residual_network", "ridge", "window_mean_network", "training_mean", "mean"),
    ]
    to_the_oracle("white", names, [80, 10], 4 if quick else 20)


def cnn(quick: bool) -> None:
    seeds = 2 if quick else 20
    print("\nThe paper's network on the same white noise, 80 recordings, 10 s: last and best epoch")
    ratios: dict[str, list[float]] = {}
    for seed in range(seeds):
        made = simulate(np.random.default_rng([7, seed]), MODELS["white"], 80 + TESTED)
        training, tested = split(made, 80)
        oracle = rms(judged(Oracle(MODELS["white"], made.unit_bias.to_numpy()), tested, 10)[0])
        network = fitted("cnn", training, 10, base_parameters().splits.validation_recordings)
        for weights, variant in network.variants().items():
            ratios.setdefault(weights, []).append(rms(judged(variant, tested, 10)[0]) / oracle)
    for weights, found in ratios.items():
        print(f"  {weights:24} {np.mean(found):6.3f} (largest {np.max(found):.3f}, n={seeds})")


def warming(quick: bool) -> None:
    print(
        f"\nFlicker {FLICKER / MDPS:g} mdps, random walk {RANDOM_WALK / MDPS:g} mdps/sqrt(s), "
        f"warm-up 20 +- 5 mdps with 30 s; 10 s: RMSE over that of the exact oracle"
    )
    names = [
        *("best_linear_warm_up", "residual_network", "ridge_same_time", "best_linear", "ridge"),
        *("empirical_bayes", "mean"),
    ]
    to_the_oracle("warm_up", names, [80, 10], 2 if quick else 10)


def slow_and_fast(generator: np.random.Generator, count: int) -> xr.Dataset:
    """The warm-up of each axis and power-on with its own time constant, from 15 to 60 s."""
    made = simulate(generator, MODELS["coloured_walk"], count)
    constants_s = generator.uniform(15, 60, (1, count, len(AXES)))
    amplitudes = generator.normal(*WARM_UP[:2], constants_s.shape)
    return drifting(made, warm_up(amplitudes, constants_s, SAMPLES, RATE_HZ))


def heater(generator: np.random.Generator, count: int) -> xr.Dataset:
    """A drift of 20 +- 5 mdps that begins at a random time from 10 to 60 s and settles in 5 s."""
    made = simulate(generator, MODELS["coloured_walk"], count)
    on_s = generator.uniform(10, 60, (1, count, len(AXES), 1))
    size = generator.normal(*WARM_UP[:2], on_s.shape)
    since_s = np.maximum(np.arange(SAMPLES) / RATE_HZ - on_s, 0)
    return drifting(made, size * (1 - np.exp(-since_s / 5)))


def drifting(recordings: xr.Dataset, drift: np.ndarray) -> xr.Dataset:
    return recordings.assign(angular_rate=recordings.angular_rate + drift.astype(np.float32))


def drifts(quick: bool) -> None:
    seeds = 2 if quick else 20
    print(
        "\nDrifts that the linear model lacks, 80 recordings, 10 s: RMSE of the residual network "
        "over that of best_linear_warm_up on the same windows"
    )
    makers = {"time constants 15 to 60 s": slow_and_fast, "heater at a random time": heater}
    for name, make in makers.items():
        ratios = []
        for seed in range(seeds):
            training, tested = split(make(np.random.default_rng([8, seed]), 80 + TESTED), 80)
            network, linear = (
                rms(judged(fitted(one, training, 10), tested, 10)[0])
                for one in ("residual_network", "best_linear_warm_up")
            )
            ratios.append(network / linear)
        error = np.std(ratios, ddof=1) / np.sqrt(seeds)
        print(f"  {name:26} {np.mean(ratios):.3f} +- {error:.3f} (largest {np.max(ratios):.3f})")


def leave_one_out(recordings: xr.Dataset, name: str) -> dict:
    """Errors and sigmas by window length, every recording judged by what the others taught."""
    found: dict[float, list] = {window_s: [] for window_s in WINDOWS_S}
    for i in range(recordings.sizes["recording"]):
        others = np.delete(np.arange(recordings.sizes["recording"]), i)
        for window_s in WINDOWS_S:
            estimator = fitted(name, recordings.isel(recording=others), window_s)
            found[window_s].append(judged(estimator, recordings.isel(recording=[i]), window_s))
    return {
        w: [np.concatenate(part) for part in zip(*all_, strict=True)] for w, all_ in found.items()
    }


def real(quick: bool) -> None:
    recordings = memsense()
    if recordings is None:
        print("\nMemsense: left out, GYRO_PIPELINE_REAL_DATA is not set")
        return
    print(
        "\nMemsense, leave-one-recording-out: RMSE over that of the running mean at 1 2 5 10 30 s;"
    )
    print("share of errors within 1 and 2 sigma, over all of these windows' lengths from to")
    tried = [name for name in ESTIMATORS if not estimator_class(name).seeded]
    results = {name: leave_one_out(recordings, name) for name in tried}
    for name, found in results.items():
        ratios = [rms(found[w][0]) / rms(results["mean"][w][0]) for w in WINDOWS_S]
        shares = [
            [np.mean(np.abs(errors) < k * sigma) for errors, sigma in found.values()]
            for k in (1, 2)
        ]
        text = " ".join(f"{ratio:.3f}" for ratio in ratios)
        covered = " ".join(f"{min(s):.2f}-{max(s):.2f}" for s in shares)
        print(f"  {name:24} {text}   {covered if max(shares[1]) > 0 else '-'}")
    constant = rms(results["training_mean"][10][0])
    print(f"  constant: {constant:.7f} deg/s, published {PUBLISHED_CONSTANT_DPS}")


def few(quick: bool) -> None:
    names = ["empirical_bayes", "empirical_bayes_pooled", "best_linear", "residual_network"]
    resamples = 8 if quick else 50
    print(
        "\nFive training recordings: RMSE over that of the running mean at 1 2 5 10 30 s, "
        f"mean of {resamples} resamples"
    )
    sources = {
        name: simulate(np.random.default_rng([9, i]), MODELS[name], 300)
        for i, name in enumerate(("white", "coloured", "warm_up"))
    }
    real_ones = memsense()
    if real_ones is not None:
        sources["memsense"] = real_ones
    for source, recordings in sources.items():
        warming_up = ["best_linear_warm_up"] if source == "warm_up" else []
        ratios: dict[str, list] = {name: [] for name in names + warming_up}
        for resample in range(resamples):
            order = np.random.default_rng([11, resample]).permutation(recordings.sizes["recording"])
            training = recordings.isel(recording=np.sort(order[:5]))
            tested = recordings.isel(recording=np.sort(order[5 : 5 + TESTED]))
            mean = [rms(judged(fitted("mean", training, w), tested, w)[0]) for w in WINDOWS_S]
            for name, values in ratios.items():
                own = [rms(judged(fitted(name, training, w), tested, w)[0]) for w in WINDOWS_S]
                values.append(np.divide(own, mean))
        for name, values in ratios.items():
            text = " ".join(f"{value:.3f}" for value in np.mean(values, axis=0))
            print(f"  {source:9} {name:24} {text}   largest of one {np.max(values):.2f}")


def coverage(quick: bool) -> None:
    devices, tested = 2 if quick else 8, 150
    print(
        f"\nShare of errors within 1 and 2 sigma at 1 2 5 10 30 s; {devices} devices with 80 "
        f"training and {tested} test recordings each"
    )
    names = {
        "white": ("mean", "empirical_bayes", "best_linear", "residual_network"),
        "coloured": ("mean", "empirical_bayes", "best_linear", "residual_network"),
        "warm_up": ("best_linear_warm_up", "residual_network"),
    }
    for source, tried in names.items():
        shares: dict[str, list] = {name: [] for name in tried}
        for device in range(devices):
            generator = np.random.default_rng([13, len(source), device])
            made = simulate(generator, MODELS[source], 80 + tested)
            for name, found in shares.items():
                training, rest = (
                    made.isel(recording=part) for part in (slice(80), slice(80, None))
                )
                pairs = [judged(fitted(name, training, w), rest, w) for w in WINDOWS_S]
                found.append([[np.mean(np.abs(e) < k * s) for e, s in pairs] for k in (1, 2)])
        for name, found in shares.items():
            rows = ["  ".join(f"{x:.3f}" for x in row) for row in np.mean(found, axis=0)]
            print(f"  {source:9} {name:24} {'    '.join(rows)}")


def history(quick: bool) -> None:
    print("\nA bias that walks by 1 mdps from recording to recording, white noise, 10 s, 40 stored")
    print("calibrations, the next one tested: RMSE over that of the running mean")
    seeds = 10 if quick else 60
    names = ["mean", "training_mean", "last_calibration", "empirical_bayes", "best_linear_history"]
    errors: dict[str, list] = {name: [] for name in names}
    for seed in range(seeds):
        generator = np.random.default_rng([15, seed])
        made = simulate(generator, MODELS["white"], 41)
        walk = np.cumsum(generator.normal(0, 1 * MDPS, (1, 41, len(AXES))), axis=1)
        made["angular_rate"] = made.angular_rate + walk[..., None].astype(np.float32)
        for name in names:
            estimator = fitted(name, made.isel(recording=slice(40)), 10)
            errors[name].append(judged(estimator, made.isel(recording=[40]), 10)[0])
    for name in names:
        print(f"  {name:24} {rms(errors[name]) / rms(errors['mean']):.3f}")


PARTS = {
    "white": white,
    "cnn": cnn,
    "warm_up": warming,
    "drifts": drifts,
    "memsense": real,
    "few": few,
    "coverage": coverage,
    "history": history,
}


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--part", choices=PARTS, help="only this one")
    parser.add_argument("--quick", action="store_true", help="a fraction of the seeds")
    arguments = parser.parse_args()
    for name, part in PARTS.items():
        if arguments.part in (None, name):
            started = time.perf_counter()
            part(arguments.quick)
            print(f"  ({time.perf_counter() - started:.0f} s)", flush=True)


if __name__ == "__main__":
    main()
