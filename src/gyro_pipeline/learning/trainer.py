"""The training loop: mean squared error, Adam, a stepped learning rate (paper, section III-D)."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pandas as pd
import torch
from torch import Tensor
from torch.nn import functional

from gyro_pipeline.learning.examples import Examples
from gyro_pipeline.learning.network import CalibrationNetwork
from gyro_pipeline.parameters import Training

StateDict = dict[str, Tensor]

_VALIDATION_BATCH = 1024


@dataclass(frozen=True)
class Trained:
    """Weights and the way to them.

    Attributes:
        last: Weights at the last epoch (the paper's).
        best: Weights at the epoch of the lowest validation loss; None without validation.
        best_epoch: That epoch, counted from 1.
        history: Columns ``epoch, learning_rate, train_loss`` and, if validated, ``val_loss``;
            losses are squared errors in units of the target scale.
    """

    last: StateDict
    best: StateDict | None
    best_epoch: int | None
    history: pd.DataFrame


def train(
    network: CalibrationNetwork,
    training: Examples,
    validation: Examples | None,
    schedule: Training,
    shuffling: torch.Generator,
    after_epoch: Callable[[], None],
) -> Trained:
    """Train on the device the network is on; equal inputs give equal weights.

    Args:
        network: Initialised; it is trained in place.
        training: Examples, kept on the device for the whole training.
        validation: Examples to watch, never to train on; may be None.
        schedule: Epochs, batch size, learning rate and its decay.
        shuffling: Draws the order of the examples; nothing else is random.
        after_epoch: Called after every epoch.

    Returns:
        Weights and history.

    Raises:
        FloatingPointError: If the loss is no longer finite.
    """
    device = next(network.parameters()).device
    inputs, targets = _tensors(training, device)
    watched = None if validation is None else _tensors(validation, device)
    optimizer = torch.optim.Adam(network.parameters(), lr=schedule.learning_rate, fused=True)
    decay = torch.optim.lr_scheduler.StepLR(optimizer, schedule.decay_every, schedule.decay)
    rows, best, lowest = [], None, np.inf
    for epoch in range(1, schedule.epochs + 1):
        total = torch.zeros((), device=device)
        order = torch.randperm(len(inputs), generator=shuffling).to(device)
        for batch in order.split(schedule.batch_size):
            loss = functional.mse_loss(network.forward_packed(inputs[batch]), targets[batch])
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
            total += loss.detach() * len(batch)
        row = {
            "epoch": epoch,
            "learning_rate": float(decay.get_last_lr()[0]),
            "train_loss": float(total) / len(inputs),
        }
        decay.step()
        if watched is not None:
            row["val_loss"] = _loss(network, *watched)
            if row["val_loss"] < lowest:
                lowest, best = row["val_loss"], (epoch, _weights(network))
        if not np.isfinite(row["train_loss"]):
            raise FloatingPointError(f"the loss is {row['train_loss']} in epoch {epoch}")
        rows.append(row)
        after_epoch()
    best_epoch, best_weights = best or (None, None)
    return Trained(_weights(network), best_weights, best_epoch, pd.DataFrame(rows))


@torch.no_grad()
def predict(network: CalibrationNetwork, inputs: Tensor) -> Tensor:
    """Network outputs for packed inputs of any number, shape (n, gyroscopes)."""
    return torch.cat([network.forward_packed(part) for part in inputs.split(_VALIDATION_BATCH)])


def _loss(network: CalibrationNetwork, inputs: Tensor, targets: Tensor) -> float:
    return float(functional.mse_loss(predict(network, inputs), targets))


def _tensors(examples: Examples, device: torch.device) -> tuple[Tensor, Tensor]:
    return torch.from_numpy(examples.inputs).to(device), torch.from_numpy(examples.targets).to(
        device
    )


def _weights(network: CalibrationNetwork) -> StateDict:
    return {name: value.detach().cpu().clone() for name, value in network.state_dict().items()}
