"""Networks of one kind trained together, as a model with an additional dimension.

``torch.func.vmap`` turns the loss of one network into the losses of all. Every network has its
examples and their order, and ends with the weights of
:func:`gyro_pipeline.learning.trainer.train`, up to rounding.
"""

import copy
import os
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import torch
from torch import Tensor, nn
from torch.func import functional_call, stack_module_state, vmap
from torch.nn import functional
from tqdm import tqdm

from gyro_pipeline.learning.examples import Examples
from gyro_pipeline.learning.trainer import Losses, StateDict, Trained, forward_of, weights_of
from gyro_pipeline.parameters import Training


@dataclass(frozen=True)
class Learner:
    """A network to train.

    Attributes:
        network: Initialised; it is not changed.
        training: Training examples; learners with the same object share its memory.
        validation: Validation examples; may be None.
        shuffling: Draws the order of the examples; nothing else is random.
    """

    network: nn.Module
    training: Examples
    validation: Examples | None
    shuffling: torch.Generator


def train_together(
    learners: Sequence[Learner], schedule: Training, device: torch.device, label: str = ""
) -> list[Trained]:
    """Train networks of one kind together, on equal numbers of examples.

    Args:
        learners: The networks; :func:`obstacle` must return None for them.
        schedule: Epochs, batch size, learning rate and its decay.
        device: Device to train on.
        label: Label of the progress bar on a terminal, which counts epochs.

    Raises:
        FloatingPointError: If a loss is no longer finite.
    """
    stack = _StackedNetworks([learner.network for learner in learners], device)
    training = _SharedExamples([learner.training for learner in learners], device)
    parts = [learner.validation for learner in learners if learner.validation is not None]
    validation = _SharedExamples(parts, device) if parts else None
    losses = [Losses() for _ in learners]
    rates = schedule.learning_rates(training.size).tolist()
    for rate in tqdm(rates, label, leave=False, unit="epoch", disable=None):
        orders = [torch.randperm(training.size, generator=item.shuffling) for item in learners]
        means = stack.train(training, torch.stack(orders), rate, schedule.batch_size)
        val_means: Sequence[float | None] = [None] * len(learners)
        if validation is not None:
            val_means = stack.validate(validation, schedule.batch_size)
        for number, history in enumerate(losses):
            weights = partial(stack.weights, number)
            history.add(rate, means[number], val_means[number], weights)
    return [history.trained(stack.weights(number)) for number, history in enumerate(losses)]


def obstacle(network: nn.Module, shape: Sequence[int], device: torch.device) -> str | None:
    """The reason why networks of a kind cannot be trained together; None if they can.

    A step of two networks is tried. ``vmap`` must support all operations, and these must be
    deterministic. Outputs must not depend on other windows of the batch.

    Args:
        network: Initialised; it is not changed.
        shape: Shape of the input for a window.
        device: Device to train on.
    """
    inputs = torch.rand((2, 2, *shape), generator=torch.Generator().manual_seed(0)).to(device)
    stack = _StackedNetworks([network] * 2, device)
    try:
        with warnings.catch_warnings():
            warnings.filterwarnings("error", message=".*batching rule")
            outputs = stack.outputs(inputs)
            outputs.sum().backward()
            first = stack.outputs(inputs[:, :1])
    except (RuntimeError, UserWarning) as reason:
        return str(reason).split(". ")[0]
    if not torch.allclose(outputs[:, :1], first, rtol=1e-3, atol=1e-5):
        return "its output for a window depends on the other windows of the batch"
    return None


class _SharedExamples:
    """Examples of networks on the device, in equal numbers; shared examples are stored once."""

    def __init__(self, parts: Sequence[Examples], device: torch.device) -> None:
        distinct = {id(part): part for part in parts}
        numbers = {key: number for number, key in enumerate(distinct)}
        inputs = [torch.from_numpy(part.inputs) for part in distinct.values()]
        targets = [torch.from_numpy(part.targets) for part in distinct.values()]
        self._inputs = torch.stack(inputs).to(device)
        self._targets = torch.stack(targets).to(device)
        self._numbers = torch.tensor([[numbers[id(part)]] for part in parts], device=device)
        self.size = len(parts[0].inputs)

    def __getitem__(self, rows: Tensor) -> tuple[Tensor, Tensor]:
        """Inputs and targets of the rows of each network, (networks, n), or of all, (1, n)."""
        return self._inputs[self._numbers, rows], self._targets[self._numbers, rows]


class _StackedNetworks:
    """Networks as one model, whose tensors have a row for each network."""

    def __init__(self, networks: Sequence[nn.Module], device: torch.device) -> None:
        os.environ.setdefault("CUBLAS_WORKSPACE_CONFIG", ":4096:8")  # required by the next line
        torch.use_deterministic_algorithms(True)
        self._device = device
        self._networks = [copy.deepcopy(network).to(device) for network in networks]
        self._parameters, self._buffers = stack_module_state(self._networks)
        self._optimizer = torch.optim.Adam(self._parameters.values(), fused=True)
        self._template = copy.deepcopy(self._networks[0])
        self._template.forward = forward_of(self._template)

    def train(
        self, examples: _SharedExamples, orders: Tensor, rate: float, batch_size: int
    ) -> list[float]:
        """Train for an epoch, with the examples of each network in its order, (networks, n).

        Returns:
            The mean training loss of each network.
        """
        self._optimizer.param_groups[0]["lr"] = rate
        total = torch.zeros(len(orders), device=self._device)
        for rows in orders.to(self._device).split(batch_size, 1):
            losses = self._losses(*examples[rows])
            self._optimizer.zero_grad()
            losses.sum().backward()
            self._optimizer.step()
            total += losses.detach() * rows.shape[1]
        return (total / orders.shape[1]).tolist()

    @torch.no_grad()
    def validate(self, examples: _SharedExamples, batch_size: int) -> list[float]:
        """The mean validation loss of each network."""
        rows = torch.arange(examples.size, device=self._device)[None].split(batch_size, 1)
        parts = [self._losses(*examples[batch]) * batch.shape[1] for batch in rows]
        return (torch.stack(parts).sum(0) / examples.size).tolist()

    def outputs(self, inputs: Tensor) -> Tensor:
        """Outputs of each network for its windows, (networks, n, gyroscopes)."""

        def single(parameters: StateDict, buffers: StateDict, windows: Tensor) -> Tensor:
            return functional_call(self._template, (parameters, buffers), (windows,))

        return vmap(single)(self._parameters, self._buffers, inputs)

    def weights(self, number: int) -> StateDict:
        """The weights of a network."""
        rows = {name: row[number] for name, row in (self._parameters | self._buffers).items()}
        self._networks[number].load_state_dict(rows, strict=False)
        return weights_of(self._networks[number])

    def _losses(self, inputs: Tensor, targets: Tensor) -> Tensor:
        errors = functional.mse_loss(self.outputs(inputs), targets, reduction="none")
        return errors.mean(dim=(1, 2))
