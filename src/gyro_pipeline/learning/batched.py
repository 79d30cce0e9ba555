"""Many networks of one shape trained at once, as one batched model on one device.

The networks share nothing but the steps' clock: each has its own examples, their order, its
learning rate and a last batch that may be smaller, and gets the weights that
:func:`gyro_pipeline.learning.trainer.train` gives it, up to rounding. On a GPU a step is a graph,
captured once and replayed; elsewhere the same code is called.

All kernels repeat themselves: no two threads add into one place.
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from math import prod
from typing import Any

import numpy as np
import pandas as pd
import torch
from torch import Tensor
from torch.nn import functional
from torch.nn.utils import parameters_to_vector

from gyro_pipeline.learning.examples import Examples
from gyro_pipeline.learning.network import SLOPE, Architecture, CalibrationNetwork
from gyro_pipeline.learning.trainer import StateDict, Trained
from gyro_pipeline.parameters import Training

CHUNK = 256
"""Steps that are sent to the device together; their losses come back together."""
_BETAS, _EPSILON = (0.9, 0.999), 1e-8
"""Adam's, as in PyTorch."""
_WARM_UPS = 3


@dataclass(frozen=True)
class Learner:
    """A network to train.

    Attributes:
        network: Initialised; it is not changed.
        cell: Which examples are its own, counted from 0; seeds of a cell share them.
        shuffling: Draws the order of the examples; nothing else is random.
    """

    network: CalibrationNetwork
    cell: int
    shuffling: torch.Generator


def train_together(
    learners: Sequence[Learner],
    cells: Iterable[tuple[Examples, Examples | None]],
    schedule: Training,
    device: torch.device,
    after_steps: Callable[[int], None],
) -> Iterator[tuple[int, Trained]]:
    """Train networks of one architecture in lock step; those that are finished are dropped.

    Args:
        learners: The networks.
        cells: Training and validation examples of each cell, as they come; they are joined on the
            device and stay there.
        schedule: Of all networks.
        device: Where to train.
        after_steps: Told how many steps all networks made since it was last called.

    Yields:
        The number of a learner and its result, when it is finished.

    Raises:
        FloatingPointError: If a loss is no longer finite.
    """
    data = _Data.on(device, cells)
    courses = [
        _Course(number, one, data.places[one.cell], schedule) for number, one in enumerate(learners)
    ]
    weights = [parameters_to_vector(one.network.parameters()).detach() for one in learners]
    state, done = _initial_state(torch.stack(weights).to(device)), 0
    while courses:
        last = min(course.steps for course in courses)
        state = _stage(courses, data, state, schedule, range(done, last), after_steps)
        ended = [course.steps == last for course in courses]
        for at in np.flatnonzero(ended):
            yield courses[at].number, courses[at].trained(state["weights"][at], state["best"][at])
        going_on = torch.tensor(np.flatnonzero(np.logical_not(ended)), device=device)
        state = {name: values[going_on] for name, values in state.items()}
        courses, done = [courses[at] for at in going_on.tolist()], last


@dataclass(frozen=True)
class _Data:
    """All examples of all cells: inputs (n, blocks, width), targets (n, gyroscopes).

    ``places`` holds the rows of each cell's training and validation examples.
    """

    inputs: Tensor
    targets: Tensor
    places: list[tuple[range, range]]

    @classmethod
    def on(cls, device: torch.device, cells: Iterable[tuple[Examples, Examples | None]]) -> "_Data":
        inputs, targets, places, end = [], [], [], 0
        for training, validation in cells:
            n, watched = len(training.inputs), 0 if validation is None else len(validation.inputs)
            places.append((range(end, end + n), range(end + n, end + n + watched)))
            end += n + watched
            for part in (training, validation):
                if part is not None:
                    inputs.append(torch.from_numpy(part.inputs).to(device))
                    targets.append(torch.from_numpy(part.targets).to(device))
        return cls(torch.cat(inputs), torch.cat(targets), places)


class _Course:
    """One network's way through its epochs, as the host knows it."""

    def __init__(
        self, number: int, learner: Learner, places: tuple[range, range], schedule: Training
    ) -> None:
        self.number, (self.rows, self.watched) = number, places
        self._network, self._shuffling = learner.network, learner.shuffling
        self._batch_size, self.rates = schedule.batch_size, schedule.learning_rates(len(self.rows))
        self.per_epoch = -(-len(self.rows) // self._batch_size)
        self.steps = self.per_epoch * len(self.rates)
        self._drawn = torch.empty((0, self._batch_size), dtype=torch.int64)
        self._history: list[dict[str, Any]] = []
        self._lowest, self._best_epoch = np.inf, 0

    @property
    def architecture(self) -> Architecture:
        return self._network.architecture

    def batches(self, steps: int) -> Tensor:
        """Rows of the examples of the next steps, shape (steps, batch)."""
        while len(self._drawn) < steps:
            order = torch.randperm(len(self.rows), generator=self._shuffling) + self.rows.start
            self._drawn = torch.cat([self._drawn, _in_batches(order, self._batch_size)])
        given, self._drawn = self._drawn[:steps], self._drawn[steps:]
        return given

    def add_epoch(self, summed: float, val_loss: float) -> None:
        """Note what an epoch came to, from the sum of its losses over examples."""
        epoch, loss = len(self._history) + 1, summed / len(self.rows)
        if not np.isfinite(loss):
            raise FloatingPointError(f"the loss is {loss} in epoch {epoch}")
        row = {"epoch": epoch, "learning_rate": self.rates[epoch - 1], "train_loss": loss}
        if self.watched:
            row["val_loss"] = val_loss
            if val_loss < self._lowest:
                self._lowest, self._best_epoch = val_loss, epoch
        self._history.append(row)

    def trained(self, last: Tensor, best: Tensor) -> Trained:
        """The result, from the weights at the end."""
        kept = self._state_dict(best) if self._best_epoch else None
        history = pd.DataFrame(self._history)
        return Trained(self._state_dict(last), kept, self._best_epoch or None, history)

    def _state_dict(self, weights: Tensor) -> StateDict:
        named = dict(self._network.named_parameters())
        parts = weights.cpu().split([value.numel() for value in named.values()])
        return {
            name: part.reshape(value.shape).clone()
            for (name, value), part in zip(named.items(), parts, strict=True)
        }


def _in_batches(rows: Tensor, batch_size: int) -> Tensor:
    """Shape (batches, batch); what the last one lacks is its last row again, to be ignored."""
    places = torch.arange(-(-len(rows) // batch_size) * batch_size).clamp_(max=len(rows) - 1)
    return rows[places].view(-1, batch_size)


def _stage(
    courses: Sequence[_Course],
    data: _Data,
    state: dict[str, Tensor],
    schedule: Training,
    steps: range,
    after_steps: Callable[[int], None],
) -> dict[str, Tensor]:
    """Make steps that all these networks make; their state after them."""
    stack = _Stack(courses, data, state, schedule)
    running = None
    for first in range(steps.start, steps.stop, CHUNK):
        # made while the device is still at work on the chunk before
        chunk = _chunk(courses, range(first, min(first + CHUNK, steps.stop)), schedule)
        if running:
            _collect(courses, running, stack.log(), after_steps)
        stack.run(chunk)
        running = chunk
    if running:
        _collect(courses, running, stack.log(), after_steps)
    return stack.state


def _chunk(courses: Sequence[_Course], steps: range, schedule: Training) -> dict[str, Tensor]:
    """What consecutive steps need beside the weights.

    Returns:
        The batches' ``rows`` (steps, networks, batch) and ``sizes``, how many of these count;
        ``rates``, learning rates over Adam's correction of the mean; whether the step has
        ``ended`` an epoch, all (steps, networks); and ``corrections`` (steps, 1), Adam's of the
        root mean square.
    """
    step = np.arange(steps.start, steps.stop)[:, None]
    n = np.array([len(course.rows) for course in courses])
    per_epoch = np.array([course.per_epoch for course in courses])
    epoch, place = np.divmod(step, per_epoch)
    ended = place == per_epoch - 1
    left = n - place * schedule.batch_size
    by_network = [course.rates[own] for course, own in zip(courses, epoch.T, strict=True)]
    rates = np.stack(by_network, axis=1) / (1 - _BETAS[0] ** (step + 1))
    return {
        "rows": torch.stack([course.batches(len(steps)) for course in courses], 1),
        "sizes": torch.from_numpy(np.minimum(left, schedule.batch_size)),
        "rates": torch.from_numpy(rates),
        "corrections": torch.from_numpy(np.sqrt(1 - _BETAS[1] ** (step + 1))),
        "ended": torch.from_numpy(ended),
    }


def _collect(
    courses: Sequence[_Course],
    chunk: dict[str, Tensor],
    log: np.ndarray,
    after_steps: Callable[[int], None],
) -> None:
    """Tell the networks the losses of the epochs that a chunk ended."""
    for step, network in chunk["ended"].nonzero().tolist():
        courses[network].add_epoch(*log[step, :, network].tolist())
    after_steps(len(chunk["ended"]))


def _initial_state(weights: Tensor) -> dict[str, Tensor]:
    """Everything that a network carries from step to step; networks are the first dimension."""
    zeros = torch.zeros_like(weights)
    return {
        "weights": weights,
        "mean": zeros,  # Adam's, of the gradient
        "square": zeros,  # Adam's, of its square
        "summed": zeros[:, 0],  # losses of the epoch's examples so far
        "lowest": torch.full_like(zeros[:, 0], torch.inf),  # validation loss
        "best": weights,  # weights then
    }


class _Stack:
    """The networks on the device: one step of all of them, and what the end of an epoch asks for.

    A step finds what it needs by a counter on the device, which it advances itself. So it is the
    same work on the same memory every time, without a word from the host.
    """

    def __init__(
        self,
        courses: Sequence[_Course],
        data: _Data,
        state: dict[str, Tensor],
        schedule: Training,
    ) -> None:
        weights, shape = state["weights"], (CHUNK, len(courses))
        batch_size = schedule.batch_size
        self._architecture, self._data = courses[0].architecture, data
        self._places = torch.arange(batch_size, device=weights.device)
        self._watched = _watched(courses, batch_size, weights)
        self._watched_sizes = sum(sizes for _, sizes in self._watched)
        self._at = self._places.new_zeros(1)
        self._log = weights.new_zeros((CHUNK, 2, len(courses)))
        self._chunk = {
            "rows": self._places.new_zeros((*shape, batch_size)),
            "sizes": weights.new_ones(shape),
            "rates": weights.new_zeros(shape),
            "corrections": weights.new_ones((CHUNK, 1)),
            "ended": weights.new_zeros(shape, dtype=torch.bool),
        }
        self.state = {name: torch.zeros_like(values) for name, values in state.items()}
        if _has_graphs(weights.device):
            self._capture()
        for name, values in state.items():
            self.state[name].copy_(values)

    def run(self, chunk: dict[str, Tensor]) -> None:
        """Make the steps of a chunk; on a GPU this returns while they run."""
        self._at.zero_()
        for name, values in chunk.items():
            self._chunk[name][: len(values)].copy_(values)
        for ended in chunk["ended"].any(1).tolist():
            self._step()
            if ended:
                self._end_epochs()

    def log(self) -> np.ndarray:
        """By step: summed training loss and mean validation loss, shape (CHUNK, 2, networks)."""
        return self._log.cpu().numpy()

    def _step(self) -> None:
        chunk = {name: values[self._at][0] for name, values in self._chunk.items()}
        weights = self.state["weights"].detach().requires_grad_()
        summed = self._losses(weights, chunk["rows"], chunk["sizes"])
        (gradients,) = torch.autograd.grad((summed / chunk["sizes"]).sum(), weights)
        self.state["summed"].add_(summed.detach())
        _adam(self.state, gradients, chunk["rates"][:, None], chunk["corrections"])
        self._at.add_(1)

    @torch.no_grad()
    def _end_epochs(self) -> None:
        """Validate all, but keep and reset only what belongs to those whose epoch has ended."""
        state, last = self.state, self._at - 1
        ended, total = self._chunk["ended"][last][0], torch.zeros_like(state["summed"])
        for rows, sizes in self._watched:
            total += self._losses(state["weights"], rows, sizes)
        losses = total / self._watched_sizes  # 0 / 0 = NaN without validation: never the lowest
        better = ended & (losses < state["lowest"])
        state["lowest"].copy_(torch.where(better, losses, state["lowest"]))
        state["best"].copy_(torch.where(better[:, None], state["weights"], state["best"]))
        self._log.index_copy_(0, last, torch.stack([state["summed"], losses])[None])
        state["summed"].masked_fill_(ended, 0)

    def _losses(self, weights: Tensor, rows: Tensor, sizes: Tensor) -> Tensor:
        """Mean squared errors, summed over the examples that count, shape (networks,)."""
        outputs = _outputs(self._architecture, weights, self._data.inputs[rows])
        errors = functional.mse_loss(outputs, self._data.targets[rows], reduction="none").mean(2)
        return errors.masked_fill(self._places >= sizes[:, None], 0).sum(1)

    def _capture(self) -> None:
        """Record both as graphs, after they have run on a side stream as PyTorch asks for.

        What these runs leave in the state is overwritten afterwards.
        """
        side = torch.cuda.Stream()
        side.wait_stream(torch.cuda.current_stream())
        with torch.cuda.stream(side):
            for _ in range(_WARM_UPS):
                self._at.zero_()
                self._step()
                self._end_epochs()
        torch.cuda.current_stream().wait_stream(side)
        step, end_epochs = torch.cuda.CUDAGraph(), torch.cuda.CUDAGraph()
        with torch.cuda.graph(step):
            self._step()
        with torch.cuda.graph(end_epochs):
            self._end_epochs()
        self._step, self._end_epochs = step.replay, end_epochs.replay  # type: ignore[method-assign]


def _has_graphs(device: torch.device) -> bool:
    return device.type == "cuda"


def _watched(
    courses: Sequence[_Course], batch_size: int, weights: Tensor
) -> list[tuple[Tensor, Tensor]]:
    """Validation in batches: rows (networks, batch), and how many of them count."""
    most = max(len(course.watched) for course in courses)
    batches = []
    for first in range(0, most, batch_size):
        rows = torch.zeros((len(courses), batch_size), dtype=torch.int64)
        parts = [course.watched[first : first + batch_size] for course in courses]
        for row, part in zip(rows, parts, strict=True):
            row[: len(part)] = torch.tensor(part)
        sizes = torch.tensor([len(part) for part in parts])
        batches.append((rows.to(weights.device), sizes.to(weights)))
    return batches


def _adam(state: dict[str, Tensor], gradients: Tensor, rates: Tensor, correction: Tensor) -> None:
    """One step of Adam, in place; the rates are already over the correction of the mean."""
    mean, square = state["mean"], state["square"]
    mean.lerp_(gradients, 1 - _BETAS[0])
    square.mul_(_BETAS[1]).addcmul_(gradients, gradients, value=1 - _BETAS[1])
    state["weights"].sub_(rates * mean / (square.sqrt() / correction + _EPSILON))


def _outputs(a: Architecture, weights: Tensor, packed: Tensor) -> Tensor:
    """What every network says to its own windows; see ``CalibrationNetwork.forward_packed``.

    Args:
        a: The networks' sizes.
        weights: Shape (networks, parameters), in the order of the module's.
        packed: Shape (networks, n, blocks, width).

    Returns:
        Shape (networks, n, gyroscopes).
    """
    kernel, kernel_bias, hidden, hidden_bias, output, output_bias = _parameters(a, weights)
    taps, width, used = -(-a.kernel // a.stride), packed.shape[3], a.pooled * a.pool
    # (networks, channels, gyroscopes, kernel) -> (networks, 1, width, taps * channels)
    kernel = functional.pad(kernel, (0, taps * a.stride - a.kernel)).unflatten(3, (taps, a.stride))
    kernel = kernel.permute(0, 2, 4, 3, 1).flatten(3).flatten(1, 2)
    kernel = functional.pad(kernel, (0, 0, 0, width - kernel.shape[1])).unsqueeze(1)
    # One product for each window, so that the kernel's gradient has as many to add in parallel.
    by_tap = (packed @ kernel).unflatten(3, (taps, a.channels))
    convolved = by_tap[:, :, :used, 0]  # (networks, n, used, channels)
    for tap in range(1, taps):
        convolved = convolved + by_tap[:, :, tap : tap + used, tap]
    pooled = convolved.unflatten(2, (a.pooled, a.pool)).max(3).values
    features = functional.leaky_relu(pooled + kernel_bias[:, None, None], SLOPE).flatten(2)
    units = functional.leaky_relu(hidden_bias[:, None].baddbmm(features, hidden.mT), SLOPE)
    return output_bias[:, None].baddbmm(units, output.mT)


def _parameters(a: Architecture, weights: Tensor) -> list[Tensor]:
    """The rows of (networks, parameters) in their shapes, networks first."""
    shapes = [
        *((a.channels, a.gyroscopes, a.kernel), (a.channels,)),
        *((a.hidden, a.pooled * a.channels), (a.hidden,)),
        *((a.gyroscopes, a.hidden), (a.gyroscopes,)),
    ]
    parts = weights.split([prod(shape) for shape in shapes], 1)
    return [part.unflatten(1, shape) for part, shape in zip(parts, shapes, strict=True)]
