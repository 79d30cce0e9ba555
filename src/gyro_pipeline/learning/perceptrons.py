"""Small networks trained together, each on its part of the same examples."""

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from gyro_pipeline.learning.trainer import one_thread

_HIDDEN, _BATCH, _LEARNING_RATE, _WEIGHT_DECAY = 32, 256, 6e-3, 1e-2
_STEPS = 400


@dataclass(frozen=True)
class Perceptrons:
    """K networks with two hidden layers of 32 tanh units, float64.

    Attributes:
        layers: Weights (K, inputs, outputs) and offsets (K, 1, outputs) of each layer.
    """

    layers: list[tuple[Tensor, Tensor]]

    @torch.no_grad()
    def __call__(self, inputs: NDArray[np.float64]) -> NDArray[np.float64]:
        """Outputs (K, n, outputs) of all networks for the same inputs (n, d)."""
        networks = len(self.layers[0][0])
        return self.forward(torch.from_numpy(inputs).expand(networks, -1, -1)).numpy()

    def forward(self, values: Tensor) -> Tensor:
        """Outputs (K, n, outputs) of the networks for their inputs (K, n, d)."""
        *hidden, (weights, offsets) = self.layers
        for inner, inner_offsets in hidden:
            values = torch.tanh(torch.baddbmm(inner_offsets, values, inner))
        return torch.baddbmm(offsets, values, weights)


@one_thread()  # with more threads, networks of this size only wait
def train_perceptrons(
    inputs: NDArray[np.float64],
    targets: NDArray[np.float64],
    used: NDArray[np.bool_],
) -> Perceptrons:
    """Train networks with squared errors and AdamW, with one-cycle learning rates.

    Args:
        inputs: (n, d), of the order of 1.
        targets: (n, outputs), of the order of 1.
        used: Whether each network is trained on an example, (K, n); at least one is needed.

    Returns:
        The networks; before training their output is 0.
    """
    generator = torch.Generator().manual_seed(0)
    x, y = torch.from_numpy(inputs), torch.from_numpy(targets)
    rows = [torch.from_numpy(np.flatnonzero(mask)) for mask in used]
    networks = Perceptrons(_initial(len(used), inputs.shape[1], targets.shape[1], generator))
    parameters = [tensor for layer in networks.layers for tensor in layer]
    optimizer = torch.optim.AdamW(parameters, _LEARNING_RATE, weight_decay=_WEIGHT_DECAY)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, _LEARNING_RATE, total_steps=_STEPS)
    for _ in range(_STEPS):
        picks = [r[torch.randint(len(r), (_BATCH,), generator=generator)] for r in rows]
        batch = torch.stack(picks)
        loss = torch.square(networks.forward(x[batch]) - y[batch]).mean(dim=(1, 2)).sum()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        schedule.step()
    return Perceptrons(
        [(weights.detach(), offsets.detach()) for weights, offsets in networks.layers]
    )


def _initial(
    networks: int, inputs: int, outputs: int, generator: torch.Generator
) -> list[tuple[Tensor, Tensor]]:
    sizes = [(inputs, _HIDDEN), (_HIDDEN, _HIDDEN), (_HIDDEN, outputs)]
    layers = []
    for i, (incoming, outgoing) in enumerate(sizes):
        shape = (networks, incoming, outgoing)
        weights = torch.randn(shape, generator=generator, dtype=torch.float64) / np.sqrt(incoming)
        if i == len(sizes) - 1:
            weights = torch.zeros_like(weights)
        offsets = torch.zeros((networks, 1, outgoing), dtype=torch.float64)
        layers.append((weights.requires_grad_(), offsets.requires_grad_()))
    return layers
