"""One training as a pure job: everything it needs comes in, everything it makes goes out."""

import os
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
import pandas as pd
import torch

from gyro_pipeline.learning import fused
from gyro_pipeline.learning.examples import (
    Device,
    Scaling,
    scaled_examples,
    training_examples,
)
from gyro_pipeline.learning.fused import FusedEngine
from gyro_pipeline.learning.network import Architecture, CalibrationNetwork
from gyro_pipeline.learning.packing import pack, to_bfloat16
from gyro_pipeline.learning.trainer import TorchEngine, predict, train
from gyro_pipeline.parameters import Training

_EPOCH_OVERHEAD = 500_000
"""What an epoch costs beside its training samples, mostly validation, in samples; measured."""


@dataclass(frozen=True)
class TrainingJob:
    """A network to train.

    Attributes:
        name: Shown while it runs.
        devices: Training devices and recordings; the first holds the test IMU.
        validation: The test device on the validation recordings; None without.
        window: Samples.
        settings: The network's sizes and schedule.
        seed: Of the initial weights and the order of examples.
    """

    name: str
    devices: Sequence[Device]
    validation: Device | None
    window: int
    settings: Training
    seed: int

    @property
    def architecture(self) -> Architecture:
        """Sizes of the network."""
        gyroscopes = len(self.devices[0].imus) * self.devices[0].recordings.sizes["axis"]
        return sized(self.settings, gyroscopes, self.window)

    @property
    def epoch_work(self) -> float:
        """Estimated cost of an epoch, in samples of three gyroscopes."""
        per_recording = self.devices[0].recordings.sizes["sample"] // self.window
        windows = per_recording * sum(len(device.numbers) for device in self.devices)
        return windows * self.window * len(self.devices[0].imus) + _EPOCH_OVERHEAD

    @property
    def work(self) -> float:
        """Estimated cost of the training, in samples of three gyroscopes."""
        return self.epoch_work * len(self.settings.learning_rates())


@dataclass(frozen=True)
class TrainedNetwork:
    """What a training leaves: an artifact to store, the losses, when it started, and on what."""

    artifact: Mapping[str, Any]
    history: pd.DataFrame
    started: float
    engine: str


def run_training(job: TrainingJob, report: Callable[[float], None]) -> TrainedNetwork:
    """Run one training on one thread, or on the GPU where there is one.

    Args:
        job: What to train.
        report: Told the work done after every epoch.

    Returns:
        Weights at the last and the best validation epoch with all that an estimate needs.
    """
    started = time.time()
    device = "cuda" if torch.cuda.is_available() else "cpu"
    torch.set_num_threads(1)
    os.environ.setdefault("CUBLAS_WORKSPACE_CONFIG", ":4096:8")  # cuBLAS repeats itself with this
    torch.use_deterministic_algorithms(True, warn_only=device == "cuda")
    architecture = job.architecture
    examples, scaling = training_examples(job.devices, architecture, job.settings.centring)
    validation = (
        None if job.validation is None else scaled_examples(job.validation, architecture, scaling)
    )
    if job.settings.precision == "bfloat16":
        examples = replace(examples, inputs=to_bfloat16(examples.inputs))
    network = initial_network(architecture, job.seed)
    network.to(device)
    shuffling = torch.Generator().manual_seed(job.seed)
    compiled = device == "cpu" and fused.available(job.settings.precision)
    trained = train(
        network,
        examples,
        validation,
        job.settings,
        shuffling,
        after_epoch=lambda: report(job.epoch_work),
        engine=FusedEngine if compiled else TorchEngine,
    )
    artifact = {
        "architecture": asdict(architecture),
        "scaling": {
            "centre": torch.from_numpy(scaling.centres[0]),
            "input_scale": scaling.input_scale,
            "target_scale": scaling.target_scale,
        },
        "last": trained.last,
        "best": trained.best,
        "best_epoch": trained.best_epoch,
    }
    return TrainedNetwork(artifact, trained.history, started, "fused" if compiled else device)


def sized(settings: Training, gyroscopes: int, window: int) -> Architecture:
    """The network's sizes for an input of ``gyroscopes`` by ``window`` samples."""
    sizes = (settings.channels, settings.kernel, settings.stride, settings.pool, settings.hidden)
    return Architecture(gyroscopes, window, *sizes)


def initial_network(architecture: Architecture, seed: int) -> CalibrationNetwork:
    """PyTorch's default initial weights, drawn from ``seed`` without touching the global state."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        return CalibrationNetwork(architecture)


class NetworkEstimator:
    """A stored network as an estimator: windows in, biases out."""

    def __init__(self, artifact: Mapping[str, Any], weights: str) -> None:
        """Restore a network.

        Args:
            artifact: From :class:`TrainedNetwork`.
            weights: ``last`` or ``best``.
        """
        scaling = artifact["scaling"]
        self._scaling = Scaling(
            [scaling["centre"].numpy()], scaling["input_scale"], scaling["target_scale"]
        )
        self._network = CalibrationNetwork(Architecture(**artifact["architecture"]))
        self._network.load_state_dict(artifact[weights])

    def estimate(self, windows: np.ndarray) -> np.ndarray:
        """Biases of all gyroscopes the network sees.

        Args:
            windows: Shape (n, gyroscopes, window), deg/s.

        Returns:
            Shape (n, gyroscopes), deg/s.
        """
        centre = self._scaling.centres[0]
        scaled = (windows - centre[:, None].astype(np.float32)) / self._scaling.input_scale
        packed = pack(scaled.transpose(1, 0, 2), self._network.architecture)
        outputs = predict(self._network, torch.from_numpy(packed)).double().numpy()
        return centre + self._scaling.target_scale * outputs
