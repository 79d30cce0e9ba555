"""The training loop: mean squared error, Adam, a stepped learning rate (paper, section III-D)."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import pandas as pd
import torch
from torch import Tensor, nn
from torch.nn import functional

from gyro_pipeline.learning.examples import Examples
from gyro_pipeline.parameters import Training

StateDict = dict[str, Tensor]


def do_nothing() -> None:
    """Do nothing after an epoch."""


_VALIDATION_BATCH = 1024


@dataclass(frozen=True)
class Trained:
    """The result of a training: weights and losses.

    Attributes:
        last: Weights at the last epoch (the paper's).
        best: Weights at the epoch of the lowest validation loss; None without validation.
        losses: Columns ``epoch, learning_rate, train_loss`` and, if validated, ``val_loss``;
            losses are squared errors in units of the target scale.
    """

    last: StateDict
    best: StateDict | None
    losses: pd.DataFrame


class Losses:
    """The losses of a training epoch by epoch, and the weights of the best one."""

    def __init__(self) -> None:
        self._rows: list[dict[str, float]] = []
        self._lowest: float = np.inf
        self._best: StateDict | None = None

    def add(
        self, rate: float, loss: float, val_loss: float | None, weights: Callable[[], StateDict]
    ) -> None:
        """Add an epoch; ``weights`` is called if its validation loss is the lowest so far.

        Raises:
            FloatingPointError: If the training loss is not finite.
        """
        epoch = len(self._rows) + 1
        if not np.isfinite(loss):
            raise FloatingPointError(f"the loss is {loss} in epoch {epoch}")
        row = {"epoch": epoch, "learning_rate": rate, "train_loss": loss}
        self._rows.append(row if val_loss is None else row | {"val_loss": val_loss})
        if val_loss is not None and val_loss < self._lowest:
            self._lowest, self._best = val_loss, weights()

    def trained(self, last: StateDict) -> Trained:
        """The result, with the weights at the last epoch."""
        return Trained(last, self._best, pd.DataFrame(self._rows))


class Engine(Protocol):
    """Trains a network on a set of examples, an epoch at a time."""

    def epoch(self, order: np.ndarray, learning_rate: float) -> float:
        """Train on examples in the given order, batch by batch; returns the mean loss."""

    def load_into(self, network: nn.Module) -> None:
        """Copy the current weights into a network."""


class TorchEngine:
    """The reference engine: autograd and Adam in PyTorch, on the device of the network.

    Args:
        network: Trained in place.
        inputs: Scaled windows in the layout of the network; they stay on the device.
        targets: Shape (n, gyroscopes), scaled.
        batch_size: Examples per step; the last one of an epoch may be smaller.
    """

    def __init__(
        self, network: nn.Module, inputs: np.ndarray, targets: np.ndarray, batch_size: int
    ) -> None:
        self._network, self._batch_size = network, batch_size
        self._forward = forward_of(network)
        self._inputs, self._targets = _tensors(Examples(inputs, targets), _device(network))
        self._optimizer = torch.optim.Adam(network.parameters(), fused=True)

    def epoch(self, order: np.ndarray, learning_rate: float) -> float:
        """See :class:`Engine`."""
        for group in self._optimizer.param_groups:
            group["lr"] = learning_rate
        self._network.train()
        total = torch.zeros((), device=self._inputs.device)
        for batch in torch.from_numpy(order).to(self._inputs.device).split(self._batch_size):
            outputs = self._forward(self._inputs.index_select(0, batch))
            loss = functional.mse_loss(outputs, self._targets.index_select(0, batch))
            self._optimizer.zero_grad()
            loss.backward()
            self._optimizer.step()
            total += loss.detach() * len(batch)
        return float(total) / len(order)

    def load_into(self, network: nn.Module) -> None:
        """See :class:`Engine`."""
        network.load_state_dict(self._network.state_dict())


def train(
    network: nn.Module,
    training: Examples,
    validation: Examples | None,
    schedule: Training,
    shuffling: torch.Generator,
    after_epoch: Callable[[], None] = do_nothing,
    engine: Callable[..., Engine] = TorchEngine,
) -> Trained:
    """Train a network; equal inputs give equal weights.

    Args:
        network: Initialised; it is trained in place.
        training: Training examples, used in place.
        validation: Validation examples; may be None.
        schedule: Epochs, batch size, learning rate and its decay.
        shuffling: Draws the order of the examples; nothing else is random.
        after_epoch: Called after every epoch.
        engine: Class of the engine.

    Returns:
        Weights and losses.

    Raises:
        FloatingPointError: If the loss is no longer finite.
    """
    steps = engine(network, training.inputs, training.targets, schedule.batch_size)
    held_out = None if validation is None else _tensors(validation, _device(network))
    losses = Losses()
    for rate in schedule.learning_rates(len(training.inputs)).tolist():
        order = torch.randperm(len(training.inputs), generator=shuffling).numpy()
        loss = steps.epoch(order, rate)
        steps.load_into(network)
        val_loss = None if held_out is None else _loss(network, *held_out)
        losses.add(rate, loss, val_loss, lambda: weights_of(network))
        after_epoch()
    return losses.trained(weights_of(network))


@torch.no_grad()
def predict(network: nn.Module, inputs: Tensor) -> Tensor:
    """Outputs of a network for inputs in its layout, (n, gyroscopes)."""
    forward = forward_of(network.eval())
    return torch.cat([forward(part) for part in inputs.split(_VALIDATION_BATCH)])


@contextmanager
def one_thread() -> Iterator[None]:
    """Use one thread, as results of PyTorch for a few windows depend on the number of threads."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)


def forward_of(network: nn.Module) -> Callable[[Tensor], Tensor]:
    """The forward function of a network; for the paper's, the fast one for packed windows."""
    forward: Callable[[Tensor], Tensor] = getattr(network, "forward_packed", network.forward)
    return forward


def weights_of(network: nn.Module) -> StateDict:
    """A copy of the weights on the CPU."""
    return {name: value.detach().cpu().clone() for name, value in network.state_dict().items()}


def _loss(network: nn.Module, inputs: Tensor, targets: Tensor) -> float:
    return float(functional.mse_loss(predict(network, inputs), targets))


def _device(network: nn.Module) -> torch.device:
    return next(network.parameters()).device


def _tensors(examples: Examples, device: torch.device) -> tuple[Tensor, Tensor]:
    arrays = examples.inputs, examples.targets
    inputs, targets = (torch.from_numpy(array).to(device) for array in arrays)
    return inputs, targets
