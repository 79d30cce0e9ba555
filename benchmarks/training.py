"""How fast the network trains: our paths, PyTorch Lightning, skorch and plain loops on one core.

    pip install -e .[bench]                   # the peers; without them they are left out
    python benchmarks/training.py             # one core: ratios to Lightning, fraction of peak
    python benchmarks/training.py --scaling   # two processes against one
    python benchmarks/training.py --against COMMIT  # the step in C, and that of another commit
    python benchmarks/training.py --study     # the three studies, extrapolated from every network
    python benchmarks/training.py --memory    # peak memory and time against N and S
    python benchmarks/training.py --agreement # results of our paths over the whole schedule

All data are random and of the right shape; nothing is read and nothing is kept. What each part
measures, and its last results: benchmarks/README.md.
"""

import argparse
import contextlib
import copy
import ctypes
import importlib
import importlib.metadata
import importlib.util
import logging
import multiprocessing
import os
import platform
import shutil
import subprocess
import sys
import tempfile
import time
import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pandas as pd
import torch
import xarray as xr
from joblib import cpu_count
from kedro.config import OmegaConfigLoader
from torch import Tensor
from torch.nn import functional
from torch.utils.data import DataLoader, Sampler, TensorDataset

from gyro_pipeline.conventions import AXES, DIMENSIONS, HOLD_OUT, TEST, TRAIN
from gyro_pipeline.datasets.recordings import Recordings
from gyro_pipeline.estimators import entry, make_estimator
from gyro_pipeline.estimators.training_set import TrainingSet
from gyro_pipeline.executors import run_jobs
from gyro_pipeline.learning import fused
from gyro_pipeline.learning.design import Design, options_of
from gyro_pipeline.learning.examples import Examples, NetworkInput
from gyro_pipeline.learning.fused import FusedEngine
from gyro_pipeline.learning.jobs import (
    TrainingJob,
    run_training,
    shuffling,
)
from gyro_pipeline.learning.network import Architecture, CalibrationNetwork
from gyro_pipeline.learning.packing import pack
from gyro_pipeline.learning.trainer import Engine, TorchEngine, predict, train
from gyro_pipeline.parameters import Execution, Only, Parameters, Study, Training
from gyro_pipeline.pipelines.training.nodes import TrainingSets
from gyro_pipeline.pipelines.windowed_splits.nodes import split_windows
from gyro_pipeline.settings import CONFIG_LOADER_ARGS
from gyro_pipeline.splits import split_recordings
from gyro_pipeline.studies import CNN, RunSpec, run_specs, study_rows

BATCH, RATE = 64, 1e-4
STEPS_PER_EPOCH = 10
PEERS = ("lightning", "skorch")
LARGE = {"channels": 16, "kernel": 25, "stride": 5, "pool": 4, "hidden": 64}
SIZES = {  # name: (network, gyroscopes, samples of a window)
    "large-3x1500": (LARGE, 3, 1500),
    "large-12x1500": (LARGE, 12, 1500),
    "large-3x7500": (LARGE, 3, 7500),
    "large-12x7500": (LARGE, 12, 7500),
    "default-3x1494": ({}, 3, 1494),
    "default-12x1494": ({}, 12, 1494),
    "default-3x4483": ({}, 3, 4483),
    "default-12x4483": ({}, 12, 4483),
}
STUDY_SEEDS = 5
MEASURE_S = 0.5
"""A training is measured for so long, and for at least three epochs after the first."""
SCALING_LEAD_S, SCALING_S = 20, 5
"""Until all processes are training for sure; how long they are then watched."""
MEMORY_IMUS, MEMORY_SAMPLES = (1, 4, 12), (1500, 4500)
MEMORY_RECORDINGS, MEMORY_WINDOWS = 80, 4
AGREEMENT_SEEDS = 10
AGREEMENT_SPREAD, AGREEMENT_WINDOWS = 0.1, 640
"""Of the biases, in units of the samples' noise; in training, and as many to judge by."""
MEASURED = ["peak_MB", "preparation_s", "epoch_ms"]
STUDY = "study"


def main() -> None:
    """Run the part that is asked for."""
    arguments = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parts = arguments.add_mutually_exclusive_group()
    for part, meaning in (
        ("scaling", "two processes against one"),
        ("study", "time of the whole study"),
        ("memory", "peak memory against N and S"),
        ("agreement", "results of our paths over the whole schedule"),
    ):
        parts.add_argument(f"--{part}", action="store_true", help=meaning)
    parts.add_argument("--against", metavar="COMMIT", help="the step in C of another commit")
    arguments.add_argument("--sizes", nargs="+", choices=SIZES, default=list(SIZES))
    arguments.add_argument("--repetitions", type=int, default=5)
    arguments.add_argument("--steps", type=int, default=40, help="per repetition, on one core")
    options = arguments.parse_args()
    loader = OmegaConfigLoader(str(Path(__file__).parents[1] / "conf"), **CONFIG_LOADER_ARGS)
    parameters = Parameters(**loader["parameters"])
    torch.set_num_threads(1)
    print(machine())
    fused.available()  # compiled now, not while the clock runs
    with tempfile.TemporaryDirectory() as folder:
        if options.against:
            against(parameters, options.against, Path(folder), options.sizes, options.repetitions)
        elif options.scaling:
            scaling(parameters, Path(folder), options.repetitions)
        elif options.study:
            study(parameters, Path(folder))
        elif options.memory:
            memory(parameters, Path(folder))
        elif options.agreement:
            agreement(parameters)
        else:
            one_core(parameters, options.sizes, options.repetitions, options.steps)


# ------------------------------------------------------------------ the machine and its peaks


def machine() -> str:
    """What the results depend on."""
    cpuinfo = Path("/proc/cpuinfo")
    lines = cpuinfo.read_text().splitlines() if cpuinfo.exists() else []
    about = dict(line.split("\t: ", 1) for line in lines if "\t: " in line)
    about = {key.strip(): value for key, value in about.items()}
    model = f"{about.get('model name', platform.processor())}, family {about.get('cpu family')}"
    widest = [f for f in ("avx512f", "avx2", "avx") if f in about.get("flags", "").split()][:1]
    compiler = shutil.which(os.environ.get("CC", "cc").split()[0])
    told = [compiler, "--version"] if compiler else ["echo", "no C compiler"]
    first = subprocess.run(told, capture_output=True, text=True, check=False).stdout.split("\n")[0]
    versions = [f"{name} {_version(name)}" for name in ("torch", "numpy", *PEERS)]
    return "\n".join(
        [
            f"processor: {model}, {' '.join(widest)}, {cpu_count()} cores",
            f"compiler:  {first}",
            f"versions:  Python {platform.python_version()}, {', '.join(versions)}",
            f"load:      {os.getloadavg()[0]:.1f} processes before the start",
        ]
    )


def _version(package: str) -> str:
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return "not installed (left out)"


FMA_SOURCE = """
#if defined(__AVX512F__)
#define BYTES 64
#elif defined(__AVX__)
#define BYTES 32
#else
#define BYTES 16
#endif
typedef float vec __attribute__((vector_size(BYTES)));
double fma_loop(long n)
{
    vec sums[12] = {0}, factor = {0}, term = {0};
    factor += 0.5f, term += (float)n;
    for (int j = 0; j < 12; j++) sums[j] += (float)(n + j); /* else they are one and the same */
    for (long i = 0; i < n; i++)
        _Pragma("GCC unroll 16") for (int j = 0; j < 12; j++) sums[j] = sums[j] * factor + term;
    for (int j = 1; j < 12; j++) sums[0] += sums[j];
    return sums[0][0] > 0 ? 12.0 * 2 * (BYTES / 4) * n : 0; /* operations */
}
"""


def fma_peak() -> float | None:
    """Multiply-adds in registers, GFLOP/s of one core; None without a compiler."""
    compiler = os.environ.get("CC", "cc").split()
    flags = ["-O3", "-ffp-contract=fast", "-shared", "-fPIC", "-x", "c", "-"]
    if not shutil.which(compiler[0]):
        return None
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "fma.so"
        for native in ("-march=native", "-mcpu=native"):
            command = [*compiler, native, *flags, "-o", str(path)]
            done = subprocess.run(
                command, input=FMA_SOURCE, text=True, capture_output=True, check=False
            )
            if done.returncode == 0:
                break
        else:
            return None
        loop = ctypes.CDLL(str(path)).fma_loop
    loop.restype, loop.argtypes = ctypes.c_double, [ctypes.c_long]
    best = 0.0
    for _ in range(50):
        started = time.process_time()
        best = max(best, loop(10_000_000) / (time.process_time() - started))
    return best / 1e9


GEMM_PROGRAM = """
import time
import numpy, torch
torch.set_num_threads(1)
a = numpy.random.default_rng(0).random((2048, 2048), numpy.float32)
best = 0
for b in [a, torch.from_numpy(a)] * 10:
    started = time.process_time()
    b @ b
    best = max(best, 2 * 2048**3 / (time.process_time() - started))
print(best)
"""


def gemm_peak() -> float:
    """A product of two float32 matrices, by the faster of NumPy and PyTorch, GFLOP/s of one core.

    In a process of its own, as NumPy's threads are counted when it is imported.
    """
    names = ("OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "OMP_NUM_THREADS")
    alone = os.environ | dict.fromkeys(names, "1")
    command = [sys.executable, "-c", GEMM_PROGRAM]
    done = subprocess.run(command, env=alone, capture_output=True, text=True, check=True)
    return float(done.stdout) / 1e9


def peaks() -> dict[str, float]:
    """Best of many, GFLOP/s of one core."""
    measured = {"GEMM": gemm_peak()}
    multiply_add = fma_peak()
    if multiply_add is None:
        print("no C compiler: the multiply-add peak is not measured")
    else:
        measured["FMA"] = multiply_add
    print("peaks:     " + ", ".join(f"{k} {v:.0f} GFLOP/s" for k, v in measured.items()))
    return measured


def initial_network(a: Architecture, seed: int) -> CalibrationNetwork:
    torch.manual_seed(seed)
    return CalibrationNetwork(**vars(a))


def step_operations(a: Architecture, batch: int = BATCH) -> float:
    """Operations of one step, counted from the sizes as if nothing could be skipped.

    The convolution has a forward product and one for its weights' gradient, dense over all its
    outputs; a linear layer has these and one for its input's gradient.
    """
    convolution = a.convolved * a.channels * a.gyroscopes * a.kernel
    linear = a.pooled * a.channels * a.hidden + a.hidden * a.gyroscopes
    return 2.0 * batch * (2 * convolution + 3 * linear)


# --------------------------------------------------------------------- one core: ours and peers


Run = Callable[[int], float]
"""Train so many epochs and return the seconds; starting and ending a framework is not timed.

Seconds on the processor: of one process with one thread they are the clock's on an idle machine,
and on a shared one they leave out what others used.
"""


def one_core(parameters: Parameters, sizes: list[str], repetitions: int, steps: int) -> None:
    """All ways on the same work, in turns, so that all see the same disturbances."""
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})
    top = peaks()
    for name in sizes:
        changes, gyroscopes, window = SIZES[name]
        training = parameters.training.model_copy(update=changes)
        architecture = sized(training, gyroscopes, window).layout.packed
        ways, networks = prepared(architecture)
        for run in ways.values():
            run(1)
        epochs = -(-steps // STEPS_PER_EPOCH)
        seconds = pd.DataFrame(
            [{way: run(epochs) for way, run in ways.items()} for _ in range(repetitions)]
        )
        table = compared(seconds / (epochs * STEPS_PER_EPOCH), architecture, top)
        table["loss"] = [f"{networks[way]():.4f}" for way in ways]
        print(f"\n{name}, batch {BATCH}, {repetitions} x {epochs * STEPS_PER_EPOCH} steps")
        print(table.to_string(), flush=True)


def compared(
    seconds: pd.DataFrame, architecture: Architecture, top: dict[str, float]
) -> pd.DataFrame:
    """A row per way, from the seconds of a step in each repetition."""
    first = seconds.columns[0]
    ratios = seconds.rdiv(seconds[first], axis=0)
    rates = step_operations(architecture) / seconds.median() / 1e9
    table = pd.DataFrame(
        {
            "ms": (1e3 * seconds.median()).map("{:.2f}".format),
            f"x {first}": ratios.median().map("{:.2f}".format),
            "min to max": [f"{r.min():.2f} to {r.max():.2f}" for _, r in ratios.items()],
            "GFLOP/s": rates.map("{:.1f}".format),
        }
    )
    for name, peak in top.items():
        table[f"% of {name}"] = (100 * rates / peak).map("{:.0f}".format)
    return table


def prepared(a: Architecture) -> tuple[dict[str, Run], dict[str, Callable[[], float]]]:
    """All ways there are here, and the loss each has reached, to see that they do the same."""
    random = np.random.default_rng(0)
    n = BATCH * STEPS_PER_EPOCH
    windows = random.standard_normal((n, a.gyroscopes, a.window), np.float32)
    targets = random.standard_normal((n, a.gyroscopes), np.float32)
    x, y = torch.from_numpy(windows), torch.from_numpy(targets)
    packed = pack(windows.transpose(1, 0, 2), a)
    start = initial_network(a, 0)
    ways: dict[str, Run] = {}
    losses: dict[str, Callable[[], float]] = {}

    def add(way: str, make: Callable[[CalibrationNetwork], Run]) -> None:
        network = copy.deepcopy(start)
        ways[way] = make(network)
        losses[way] = lambda: loss(network, x, y)

    for peer, make in zip(PEERS, (lightning_way, skorch_way), strict=True):
        if importlib.util.find_spec(peer):
            add(peer, lambda network, make=make: make(network, x, y))
    add("DataLoader", lambda network: loop_way(network, batches(x, y)))
    add("tensors", lambda network: loop_way(network, TensorBatches(x, y)))
    add("packed", lambda network: engine_way(network, TorchEngine, packed, targets))
    if fused.available():
        add("fused", lambda network: engine_way(network, FusedEngine, packed, targets))
    else:
        print("fused is left out, as there is no C compiler")
    return ways, losses


@torch.no_grad()
def loss(network: CalibrationNetwork, x: Tensor, y: Tensor) -> float:
    return float(functional.mse_loss(network(x), y))


class Order(Sampler[int]):
    """Another order of n examples every epoch, the same ones for every way."""

    def __init__(self, n: int, seed: int = 0) -> None:
        self._n, self._shuffling = n, shuffling(seed)

    def drawn(self) -> Tensor:
        return torch.randperm(self._n, generator=self._shuffling)

    def __iter__(self) -> Iterator[int]:
        yield from self.drawn().tolist()

    def __len__(self) -> int:
        return self._n


def batches(x: Tensor, y: Tensor) -> DataLoader:
    """Loaded in this process; others would need cores of their own."""
    return DataLoader(TensorDataset(x, y), BATCH, sampler=Order(len(x)))


class TensorBatches:
    """Batches of tensors in memory, that of the device they are on."""

    def __init__(self, x: Tensor, y: Tensor, seed: int = 0) -> None:
        self._x, self._y, self._order = x, y, Order(len(x), seed)

    def __iter__(self) -> Iterator[tuple[Tensor, Tensor]]:
        for batch in self._order.drawn().to(self._x.device).split(BATCH):
            yield self._x[batch], self._y[batch]


def loop_way(
    network: CalibrationNetwork,
    epoch: DataLoader | TensorBatches,
    clock: Callable[[], float] = time.process_time,
) -> Run:
    optimizer = torch.optim.Adam(network.parameters(), lr=RATE)

    def run(epochs: int) -> float:
        started = clock()
        for _ in range(epochs):
            for x, y in epoch:
                optimizer.zero_grad()
                functional.mse_loss(network(x), y).backward()
                optimizer.step()
        return clock() - started

    return run


def engine_way(  # noqa: PLR0913, PLR0917 - what a way is made of
    network: CalibrationNetwork,
    engine: type[Engine],
    packed: np.ndarray,
    targets: np.ndarray,
    seed: int = 0,
    clock: Callable[[], float] = time.process_time,
) -> Run:
    steps = engine(network, packed, targets, BATCH)  # type: ignore[call-arg]
    order = Order(len(packed), seed)

    def run(epochs: int) -> float:
        started = clock()
        for _ in range(epochs):
            steps.epoch(order.drawn().numpy(), RATE)
            steps.load_into(network)
        return clock() - started

    return run


def skorch_way(network: CalibrationNetwork, x: Tensor, y: Tensor) -> Run:
    skorch = importlib.import_module("skorch")
    regressor = skorch.NeuralNetRegressor(
        network,
        optimizer=torch.optim.Adam,
        lr=RATE,
        batch_size=BATCH,
        train_split=None,
        iterator_train__sampler=Order(len(x)),
        verbose=0,
    ).initialize()

    def run(epochs: int) -> float:
        started = time.process_time()
        regressor.partial_fit(x, y, epochs=epochs)
        return time.process_time() - started

    return run


def lightning_way(network: CalibrationNetwork, x: Tensor, y: Tensor) -> Run:
    lightning = importlib.import_module("lightning")
    logging.getLogger("lightning.pytorch").setLevel(logging.ERROR)
    warnings.filterwarnings("ignore", module="lightning")
    loader, optimizer = batches(x, y), torch.optim.Adam(network.parameters(), lr=RATE)

    class Module(lightning.LightningModule):
        def __init__(self) -> None:
            super().__init__()
            self.network = network

        def training_step(self, batch: tuple[Tensor, Tensor], _: int) -> Tensor:
            return functional.mse_loss(self.network(batch[0]), batch[1])

        def configure_optimizers(self) -> torch.optim.Optimizer:
            return optimizer  # with its state from the repetitions before

    class Clock(lightning.Callback):
        def on_train_epoch_start(self, trainer, _) -> None:
            if trainer.current_epoch == 0:
                self.started = time.process_time()

        def on_train_epoch_end(self, *_) -> None:
            self.seconds = time.process_time() - self.started

    module = Module()

    def run(epochs: int) -> float:
        clock = Clock()
        trainer = lightning.Trainer(
            max_epochs=epochs,
            accelerator="cpu",
            devices=1,
            callbacks=[clock],
            logger=False,
            enable_checkpointing=False,
            enable_progress_bar=False,
            enable_model_summary=False,
        )
        trainer.fit(module, loader)
        return clock.seconds

    return run


# ------------------------------------------------------------------ the step in C, then and now

STEP_PROGRAM = """
import sys, time
import numpy as np, torch
from gyro_pipeline.learning.fused import FusedEngine
from gyro_pipeline.learning.jobs import shuffling
from gyro_pipeline.learning.network import Architecture, CalibrationNetwork
from gyro_pipeline.learning.packing import pack

torch.set_num_threads(1)
n, batch, *sizes = map(int, sys.argv[1:])
a = Architecture(*sizes)
random = np.random.default_rng(0)
windows = random.standard_normal((n, a.gyroscopes, a.window), np.float32)
targets = random.standard_normal((n, a.gyroscopes), np.float32)
packed = pack(windows.transpose(1, 0, 2), a)
torch.manual_seed(0)
try:
    network = CalibrationNetwork(**vars(a))
except TypeError:  # of an older commit
    network = CalibrationNetwork(a)
engine, order = FusedEngine(network, packed, targets, batch), shuffling(0)
for line in sys.stdin:
    started = time.process_time()
    for _ in range(int(line)):
        loss = engine.epoch(torch.randperm(n, generator=order).numpy(), 1e-4)
    print(time.process_time() - started, loss, flush=True)
"""
"""Of any commit: trains as many epochs as each line says, and prints the seconds and the loss."""


def against(  # noqa: PLR0917 - what the part is asked for
    parameters: Parameters, commit: str, folder: Path, sizes: list[str], repetitions: int
) -> None:
    """The same steps by this package and by that of a commit, in turns on one core."""
    project = Path(__file__).parents[1]
    archive = ["git", "-C", str(project), "archive", commit, "src"]
    files = subprocess.run(archive, capture_output=True, check=True).stdout
    subprocess.run(["tar", "-x", "-C", str(folder)], input=files, check=True)
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})
    sources = {commit: folder / "src", "here": project / "src"}
    for name in sizes:
        changes, gyroscopes, window = SIZES[name]
        changed = parameters.training.model_copy(update=changes)
        a = sized(changed, gyroscopes, window).layout.packed
        programs = {way: _step_program(source, a) for way, source in sources.items()}
        once = [_asked(program, 1)[0] for program in programs.values()]
        epochs = max(3, int(MEASURE_S / max(once)))
        ratios, losses = [], {}
        for _ in range(repetitions):
            seconds = {}
            for way, program in programs.items():
                seconds[way], losses[way] = _asked(program, epochs)
            ratios.append(seconds[commit] / seconds["here"])
        for program in programs.values():
            program.stdin.close()
            program.wait()
        ms = 1e3 * seconds["here"] / (epochs * STEPS_PER_EPOCH)
        reached = ", ".join(f"{loss:.6f}" for loss in losses.values())
        print(
            f"{name:16} {ms:6.3f} ms a step here, {np.median(ratios):.3f} times as fast as "
            f"{commit} ({min(ratios):.3f} to {max(ratios):.3f}); losses {reached}",
            flush=True,
        )


def _step_program(source: Path, a: Architecture) -> subprocess.Popen[str]:
    sizes = (a.gyroscopes, a.window, a.channels, a.kernel, a.stride, a.pool, a.hidden)
    numbers = map(str, (BATCH * STEPS_PER_EPOCH, BATCH, *sizes))
    program = subprocess.Popen(
        [sys.executable, "-c", STEP_PROGRAM, *numbers],
        env=os.environ | {"PYTHONPATH": str(source)},
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )
    _asked(program, 1)  # compiled now, not while the clock runs
    return program


def _asked(program: subprocess.Popen[str], epochs: int) -> tuple[float, float]:
    program.stdin.write(f"{epochs}\n")
    program.stdin.flush()
    seconds, loss = program.stdout.readline().split()
    return float(seconds), float(loss)


# ----------------------------------------------------------------- trainings of the whole study


class Enough(Exception):  # noqa: N818 - not an error: a training was measured for long enough
    """Ends a training from within its report of an epoch."""


def timed_training(job: TrainingJob) -> tuple[float, float, float]:
    """Seconds before the first epoch, of an epoch with its validation; share on the processor."""
    started, busy, ends = time.perf_counter(), -time.process_time(), []

    def after_epoch() -> None:
        ends.append(time.perf_counter())
        if len(ends) > 3 and ends[-1] - ends[0] > MEASURE_S:  # noqa: PLR2004 - see MEASURE_S
            raise Enough

    with contextlib.suppress(Enough):
        run_training(job, after_epoch)
    share = (busy + time.process_time()) / (time.perf_counter() - started)
    epoch_s = (ends[-1] - ends[0]) / (len(ends) - 1)
    return ends[0] - started - epoch_s, epoch_s, share


def recorded(path: Path, imus: int, recordings: int, samples: int) -> xr.Dataset:
    """White noise around random biases, in a file."""
    random = np.random.default_rng(0)
    coordinates = {
        "imu": np.arange(1, imus + 1),
        "recording": np.arange(1, recordings + 1),
        "axis": list(AXES),
    }
    shape = (imus, recordings, len(AXES))
    rates = random.standard_normal((*shape, samples), np.float32)
    bias = random.normal(size=shape)
    data = {
        "angular_rate": (DIMENSIONS, rates),
        "recording_mean": (DIMENSIONS[:-1], bias),
        "samples": (DIMENSIONS[:2], np.full(shape[:2], samples)),
    }
    Recordings(str(path)).save(xr.Dataset(data, coordinates))
    return Recordings(str(path)).load()


def study_jobs(parameters: Parameters, folder: Path) -> dict[RunSpec, TrainingJob]:
    """Every distinct training of the three studies, one seed each, longest first."""
    p, jobs, seen = parameters, {}, set()
    samples = max(sensor.samples for sensor in p.sensors.values())
    trained = p.virtual_gyros.train_recordings
    virtual = recorded(folder / "virtual.nc", p.virtual_gyros.imus, trained, samples)
    for name, sensor in p.sensors.items():
        real = recorded(folder / f"{name}.nc", sensor.imus, sensor.recordings, sensor.samples)
        given = {"sensor": name, "source": p.source, "rate_hz": sensor.rate_hz}
        real = real.assign_attrs(given)
        drawn = virtual.isel(sample=slice(sensor.samples)).assign_attrs(
            given | {"train_recordings": trained, "drawn_from": []}
        )
        for asked in p.studies.values():
            if not asked.default or name not in asked.sensors:
                continue
            for spec, training in _training_sets(p, asked, real, drawn):
                alike = spec.method, spec.sensor, spec.real_gyros, spec.virtual_gyros, spec.window_s
                if alike not in seen:
                    seen.add(alike)
                    job = make_estimator(CNN, p.training, seed=0).job(training)
                    jobs[spec] = replace(job, cell=len(seen))
    return dict(sorted(jobs.items(), key=lambda item: item[1].work, reverse=True))


def _training_sets(
    p: Parameters, asked: Study, real: xr.Dataset, drawn: xr.Dataset
) -> Iterator[tuple[RunSpec, TrainingSet]]:
    """What each network of a study trains on, as the pipeline's stages make it."""
    sensor, numbers = real.attrs["sensor"], real.recording.to_numpy().tolist()
    trained = p.sensors[sensor].train_recordings
    given = {n: TRAIN if n <= trained else TEST for n in numbers}
    roles = split_recordings(numbers, numbers, p.splits, given) or {}
    real = real.assign_coords(split=("recording", [roles[n] for n in numbers]))
    places = [(imu, n) for imu in real.imu.to_numpy().tolist() for n in numbers]
    contents = pd.DataFrame(places, columns=["imu", "recording"])
    contents = contents.assign(content=[str(place) for place in places], masked=[[]] * len(places))
    virtual = drawn if any(asked.grid_of(sensor).virtual_gyros) else None
    windows = split_windows(asked, real, contents, p.splits, p.windows_s, Only(), virtual)
    sets = TrainingSets(windows, real, virtual)
    rows = study_rows(asked, sensor, p.source, p.windows_s, [0], Only())
    for spec in run_specs([row for row in rows if row.estimator == CNN], unseen_devices=False):
        yield spec, sets.of(spec)[HOLD_OUT]


def study(parameters: Parameters, folder: Path) -> None:
    """Measure a few epochs of each with all cores busy; extrapolate to all epochs and seeds."""
    top, jobs = peaks(), study_jobs(parameters, folder)
    specs = {job.cell: spec for spec, job in jobs.items()}
    execution = Execution(executor="processes", workers=None)
    rows = []
    for job, (preparation_s, epoch_s, share) in run_jobs(
        list(jobs.values()), timed_training, execution, "networks"
    ):
        n, steps = job.windows, -(-job.windows // BATCH)
        minutes = (preparation_s + job.settings.epochs * epoch_s) / 60
        rows.append(
            {
                "study": specs[job.cell].study,
                "sensor": specs[job.cell].sensor,
                "gyros": f"{specs[job.cell].real_gyros}+{specs[job.cell].virtual_gyros}",
                "S": job.design.window,
                "windows": n,
                "preparation_s": preparation_s,
                "epoch_ms": 1e3 * epoch_s,
                "minutes": minutes,
                "busy": minutes * share,
                "steps": steps * job.settings.epochs,
                "GFLOP": job.settings.epochs * step_operations(job.design.layout.packed, n) / 1e9,
            }
        )
    table = pd.DataFrame(rows).sort_values("minutes", ascending=False)
    print(table.drop(columns=["busy", "steps", "GFLOP"]).round(2).to_string(index=False))
    augmentation = table[table.study == "augmentation"]
    _total(f"augmentation, {len(augmentation)} networks, 1 seed (make run)", augmentation, 1, top)
    _total(f"all studies, {len(table)} networks, {STUDY_SEEDS} seeds", table, STUDY_SEEDS, top)


def _total(what: str, table: pd.DataFrame, seeds: int, top: dict[str, float]) -> None:
    cores, sums = cpu_count(), seeds * table.sum(numeric_only=True)
    minutes = sums.minutes / cores
    rate = sums.GFLOP / (60 * cores * minutes)
    parts = ", ".join(f"{100 * rate / peak:.0f} % of {name}" for name, peak in top.items())
    print(
        f"{what}: {minutes:.1f} minutes on {cores} cores, "
        f"{sums.steps:.2e} steps, {1e9 * sums.GFLOP:.2e} operations, "
        f"{rate:.1f} GFLOP/s per core ({parts}); "
        f"preparation is {100 * sums.preparation_s / (60 * sums.minutes):.1f} %; "
        f"on the processor for {sums.busy / cores:.1f} minutes of it, others had the rest"
    )


# --------------------------------------------------------------- two processes against one


@dataclass(frozen=True)
class Watched:
    """A training watched from ``start`` on, in seconds since the epoch of the clock."""

    training: TrainingJob
    start: float
    work: float = 1.0


def epochs_per_second(job: Watched) -> float:
    """Epochs per second on the processor while all processes are at work."""
    ends, busy = [], []

    def after_epoch() -> None:
        ends.append(time.time())
        busy.append(time.process_time())
        if ends[-1] > job.start + SCALING_S:
            raise Enough

    with contextlib.suppress(Enough):
        run_training(job.training, after_epoch)
    if ends[0] > job.start or ends[-1] < job.start + SCALING_S:
        raise RuntimeError("a training did not last over the time watched; change SCALING_LEAD_S")
    watched = [spent for end, spent in zip(ends, busy, strict=True) if end >= job.start]
    return (len(watched) - 1) / (watched[-1] - watched[0])


def scaling(parameters: Parameters, folder: Path, repetitions: int) -> None:
    """Trainings side by side, each on a thread of its own, against one alone."""
    if cpu_count() < 2:  # noqa: PLR2004
        print("one core only: scaling is not measured")
        return
    jobs = study_jobs(parameters, folder)
    wanted = ("sparkfun", 12, 0)
    spec = next(s for s in jobs if (s.sensor, s.real_gyros, s.virtual_gyros) == wanted)
    endless = jobs[spec].settings.model_copy(update={"epochs": 10**6, "decay_every": 10**6})
    job = replace(jobs[spec], settings=endless)
    print(f"epochs per second of {job.windows} windows of {job.design.window} samples")
    ratios = []
    for _ in range(repetitions):
        rates = {}
        for workers in (1, 2):
            execution = Execution(executor="processes", workers=workers)
            watched = [Watched(job, time.time() + SCALING_LEAD_S)] * workers
            done = run_jobs(watched, epochs_per_second, execution, f"{workers} at once")
            rates[workers] = sum(rate for _, rate in done)
        ratios.append(rates[2] / rates[1])
        print(f"one {rates[1]:.1f}, two {rates[2]:.1f}: {ratios[-1]:.2f}", flush=True)
    print(f"median ratio {np.median(ratios):.2f}, {min(ratios):.2f} to {max(ratios):.2f}")


# ------------------------------------------------------------------- memory and time against N, S


def memory(parameters: Parameters, folder: Path) -> None:
    """Every training in a process of its own; recordings grow with S, their windows do not."""
    if not Path("/proc/self/status").exists():
        print("peak memory is read from /proc, which only Linux has")
        return
    jobs, rows = [], []
    for samples in MEMORY_SAMPLES:
        imus = max(MEMORY_IMUS)
        shape = (imus, MEMORY_RECORDINGS, MEMORY_WINDOWS * samples)
        data = recorded(folder / f"{samples}.nc", *shape)
        jobs += [
            _memory_job(parameters, data, method, imus, samples)
            for method in (1, 2)
            for imus in MEMORY_IMUS
        ]
    largest = max(study_jobs(parameters, folder).values(), key=_megabytes)
    jobs.append(replace(largest, cell=(STUDY, len(largest.devices))))
    spawn = multiprocessing.get_context("spawn")
    with spawn.Pool(1, maxtasksperchild=1) as fresh:
        for job, (megabytes, preparation_s, epoch_s) in zip(
            jobs, fresh.imap(peak_memory, jobs, chunksize=1), strict=True
        ):
            given = (*job.cell, job.design.window, _megabytes(job))
            rows.append((*given, megabytes, preparation_s, 1e3 * epoch_s))
    columns = ["method", "N", "S", "recordings_MB", *MEASURED]
    table = pd.DataFrame(rows, columns=columns).astype({"N": int})
    table["peak / recordings"] = table.peak_MB / table.recordings_MB
    print(table.round(3).to_string(index=False))
    table = table[table.method != STUDY]
    for method, group in table.groupby("method"):
        for column in MEASURED:
            _fit(f"method {method}, {column}", group.N * group.S, group[column])
    _fit("all, peak_MB against recordings_MB", table.recordings_MB, table.peak_MB)


def _memory_job(
    parameters: Parameters, data: xr.Dataset, method: int, imus: int, samples: int
) -> TrainingJob:
    """N IMUs side by side (method 1) or one after the other (method 2)."""
    numbers = tuple(range(1, MEMORY_RECORDINGS + 1))
    all_imus = tuple(range(1, imus + 1))
    inputs = [all_imus] if method == 1 else [(imu,) for imu in all_imus]
    starts = (np.arange(0, MEMORY_WINDOWS * samples, samples),) * len(numbers)
    devices = []
    for some in inputs:
        bias = data.recording_mean.sel(imu=list(some), recording=list(numbers))
        biases = bias.transpose("recording", "imu", "axis").to_numpy().reshape(len(numbers), -1)
        devices.append(NetworkInput(data.angular_rate, some, numbers, biases, starts))
    design = sized(parameters.training, devices[0].biases.shape[1], samples)
    return TrainingJob(design, devices, None, parameters.training, seed=0, cell=(method, imus))


def sized(training: Training, gyroscopes: int, window: int) -> Design:
    """The paper's network with these settings."""
    path = entry(CNN)
    return Design(path, gyroscopes, window, options_of(path, training, {}))


def _megabytes(job: TrainingJob) -> float:
    """All recordings of a training, in float32."""
    used = [*job.devices, *([job.validation] if job.validation else [])]
    rates = job.devices[0].recordings
    per_imu = rates.sizes["axis"] * rates.sizes["sample"]
    return 4e-6 * per_imu * sum(len(d.imus) * len(d.numbers) for d in used)


def peak_memory(job: TrainingJob) -> tuple[float, float, float]:
    """Peak memory above that after imports, MB; seconds before the first epoch and of an epoch.

    getrusage would do, but what it reports starts with the peak of the process that spawned.
    """
    before = _status("VmRSS")
    preparation_s, epoch_s, _ = timed_training(job)
    return _status("VmHWM") - before, preparation_s, epoch_s


def _status(key: str) -> float:
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith(f"{key}:")) * 1024 / 1e6


# ------------------------------------------------------- results over the whole schedule


def agreement(parameters: Parameters) -> None:
    """Train to the last epoch by each path, seed by seed; RMSE on windows that did not train."""
    architecture = sized(parameters.training, 3, 1494).layout.packed
    ways: dict[str, type[Engine]] = {"packed": TorchEngine}
    if fused.available():
        ways["fused"] = FusedEngine
    rows = []
    for seed in range(AGREEMENT_SEEDS):
        training, judging = (_learnable(architecture, seed, part) for part in range(2))
        row = {}
        for name, engine in ways.items():
            network = initial_network(architecture, seed)
            shuffling = torch.Generator().manual_seed(seed)
            nothing = lambda: None  # noqa: E731
            train(network, training, None, parameters.training, shuffling, nothing, engine)
            missed = predict(network, torch.from_numpy(judging.inputs)).numpy() - judging.targets
            row[name] = float(np.sqrt(np.mean(missed**2)))
        rows.append(row)
        print(f"seed {seed}: " + ", ".join(f"{k} {v:.6f}" for k, v in row.items()), flush=True)
    table = pd.DataFrame(rows)
    for name in table.columns[1:]:
        off = 100 * (table[name] / table["packed"] - 1)
        print(
            f"{name} against packed: mean difference {off.mean():+.3f} % "
            f"(standard error {off.sem():.3f}), largest {off.abs().max():.3f} %"
        )


def _learnable(a: Architecture, seed: int, part: int) -> Examples:
    """Noise around biases, as on a device whose mean was subtracted."""
    random = np.random.default_rng([seed, part])
    bias = AGREEMENT_SPREAD * random.standard_normal((AGREEMENT_WINDOWS, a.gyroscopes), np.float32)
    noise = random.standard_normal((a.gyroscopes, AGREEMENT_WINDOWS, a.window), np.float32)
    return Examples(pack(noise + bias.T[:, :, None], a), bias / np.float32(AGREEMENT_SPREAD))


def _fit(what: str, x: pd.Series, y: pd.Series) -> None:
    slope, start = np.polyfit(x, y, 1)
    off = np.abs(y - start - slope * x).max()
    print(
        f"{what}: {start:.3g} + {slope:.3g} x, largest deviation {off:.2g} "
        f"({100 * off / y.max():.0f} % of the largest)"
    )


if __name__ == "__main__":
    main()
