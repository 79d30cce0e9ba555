"""A training as a pure function: all inputs are arguments, all results are returned."""

import time
from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd
import torch

from gyro_pipeline.conventions import InputError
from gyro_pipeline.learning import fused
from gyro_pipeline.learning.design import Design, network_class
from gyro_pipeline.learning.examples import (
    Examples,
    NetworkInput,
    Scaling,
    scaled_examples,
    training_examples,
)
from gyro_pipeline.learning.fused import FusedEngine
from gyro_pipeline.learning.network import CalibrationNetwork
from gyro_pipeline.learning.packing import aligned_zeros
from gyro_pipeline.learning.trainer import (
    TorchEngine,
    Trained,
    do_nothing,
    one_thread,
    predict,
    train,
)
from gyro_pipeline.parameters import Training

# Measured costs of the step in C, in training samples of three gyroscopes.
_SAMPLE_S = 0.8e-9
"""Seconds of a training sample."""
_EPOCH_OVERHEAD = 800_000
"""Cost of an epoch besides its training samples, mostly validation."""
_LARGE = 15_000_000
"""With this number of samples, each costs twice as much as with a few that stay in the caches."""
_RECORDING_WORK = 500_000
"""Cost of reading, scaling and packing a recording."""


@dataclass(frozen=True)
class TrainingJob:
    """A network to train.

    Attributes:
        design: Class and arguments of the network.
        devices: Training devices and their windows; the first is the estimated device.
        validation: The first device with its validation windows; None without validation.
        settings: The schedule.
        seed: Seed of the initial weights and the order of examples.
        cell: A key that is equal for jobs that differ only in their seeds, which can share
            examples; None if it is unknown.
    """

    design: Design
    devices: Sequence[NetworkInput]
    validation: NetworkInput | None
    settings: Training
    seed: int
    cell: Hashable = None

    @property
    def windows(self) -> int:
        """Number of training examples."""
        return sum(device.windows for device in self.devices)

    @property
    def validation_windows(self) -> int:
        """Number of validation examples."""
        return self.validation.windows if self.validation else 0

    @property
    def recordings(self) -> int:
        """Number of recordings to read; IMUs side by side count once."""
        used = [*self.devices, *([self.validation] if self.validation else [])]
        return sum(len(device.numbers) for device in used)

    @property
    def work(self) -> float:
        """Estimated cost of the training, in samples of three gyroscopes."""
        epochs = len(self.settings.learning_rates(self.windows))
        if network_class(self.design.path) is CalibrationNetwork:
            samples = self.windows * self.design.window * len(self.devices[0].imus)
            epoch = samples * (1 + samples / _LARGE) + _EPOCH_OVERHEAD
        else:
            batch = min(self.windows, self.settings.batch_size)
            epoch = self.windows / batch * step_s(self.design, batch) / _SAMPLE_S
        return self.recordings * _RECORDING_WORK + epochs * epoch


_STEPS_S: dict[str, float] = {}
"""Seconds of a training step by design and batch."""


def step_s(design: Design, batch: int) -> float:
    """Seconds of a training step in PyTorch on one thread, measured once in each process.

    Raises:
        InputError: A step fails.
    """
    key = f"{design} {batch}"
    if key not in _STEPS_S:
        inputs = np.zeros((batch, *design.layout.shape), np.float32)
        targets = np.zeros((batch, design.gyroscopes), np.float32)
        with one_thread(), torch.random.fork_rng(devices=[]):
            engine = TorchEngine(design.build(seed=0), inputs, targets, batch)
            try:
                engine.epoch(np.arange(batch), 0.0)  # the first step takes longer
                started = time.perf_counter()
                engine.epoch(np.arange(batch), 0.0)
            except RuntimeError as error:
                raise InputError(f"{design}: a training step failed: {error}") from error
        _STEPS_S[key] = time.perf_counter() - started
    return _STEPS_S[key]


@dataclass(frozen=True)
class TrainedNetwork:
    """The result of a training: an artifact to store, losses, start time and engine."""

    artifact: Mapping[str, Any]
    losses: pd.DataFrame
    started: float
    engine: str


def run_training(job: TrainingJob, after_epoch: Callable[[], None] = do_nothing) -> TrainedNetwork:
    """Run a training on one thread of the processor.

    Args:
        job: The training.
        after_epoch: Called after every epoch.

    Returns:
        Weights at the last and the best validation epoch, with everything that estimates need.
    """
    started = time.time()
    torch.set_num_threads(1)
    torch.use_deterministic_algorithms(True)
    examples, validation, scaling = prepare_examples(job)
    network = job.design.build(job.seed)
    compiled = type(network) is CalibrationNetwork and fused.available()
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(job.seed)  # for dropout and similar layers
        trained = train(
            network,
            examples,
            validation,
            job.settings,
            shuffling(job.seed),
            after_epoch,
            FusedEngine if compiled else TorchEngine,
        )
    artifact = artifact_of(job.design, scaling, trained)
    return TrainedNetwork(artifact, trained.losses, started, "fused" if compiled else "cpu")


def prepare_examples(job: TrainingJob) -> tuple[Examples, Examples | None, Scaling]:
    """Training and validation examples with their scaling, which do not depend on the seed."""
    layout = job.design.layout
    examples, scaling = training_examples(job.devices, layout, job.settings.centring)
    if job.validation is None:
        return examples, None, scaling
    return examples, scaled_examples(job.validation, layout, scaling), scaling


def artifact_of(design: Design, scaling: Scaling, trained: Trained) -> dict[str, Any]:
    """The artifact of a training: plain values and tensors."""
    return {
        "network": vars(design),
        "scaling": {
            "centre": torch.from_numpy(scaling.centres[0]),
            "input_scale": scaling.input_scale,
            "target_scale": scaling.target_scale,
        },
        "last": trained.last,
        "best": trained.best,
    }


def shuffling(seed: int) -> torch.Generator:
    """The generator of the order of examples."""
    return torch.Generator().manual_seed(seed)


class StoredNetwork:
    """A network restored from its artifact, which estimates biases from windows."""

    def __init__(self, artifact: Mapping[str, Any], weights: str) -> None:
        """Restore a network.

        Args:
            artifact: The artifact of a :class:`TrainedNetwork`.
            weights: ``last`` or ``best``.
        """
        self._scaling = artifact["scaling"]
        design = Design(**artifact["network"])
        self._layout = design.layout
        self._network = design.build(seed=0).eval()
        self._network.load_state_dict(artifact[weights])

    def biases(self, windows: np.ndarray) -> np.ndarray:
        """Estimate the biases of all gyroscopes of windows.

        Args:
            windows: Shape (n, gyroscopes, window), deg/s.

        Returns:
            Shape (n, gyroscopes), deg/s.
        """
        centre = self._scaling["centre"].numpy()
        scaled = (windows - centre[:, None].astype(np.float32)) / self._scaling["input_scale"]
        inputs = aligned_zeros((len(windows), *self._layout.shape))
        self._layout.write(scaled.transpose(1, 0, 2), inputs)
        with one_thread():
            outputs = predict(self._network, torch.from_numpy(inputs)).double().numpy()
        return np.asarray(centre + self._scaling["target_scale"] * outputs)
