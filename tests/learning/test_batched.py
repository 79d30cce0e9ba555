"""Many networks in one batched model against each of them alone, in the reference trainer."""

import copy
from contextlib import contextmanager, nullcontext
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest
import torch
from torch.nn.utils import parameters_to_vector

from gyro_pipeline.learning import batched
from gyro_pipeline.learning.batched import Learner, train_together
from gyro_pipeline.learning.examples import Examples
from gyro_pipeline.learning.network import Architecture, CalibrationNetwork
from gyro_pipeline.learning.packing import pack, packed_shape
from gyro_pipeline.learning.trainer import TorchEngine, predict, train
from gyro_pipeline.parameters import Training

# gyroscopes, window, channels, kernel, stride, pool, hidden
ARCHITECTURES = {
    "one tap": Architecture(3, 150, 4, 10, 10, 5, 8),
    "three taps": Architecture(3, 63, 6, 12, 5, 3, 16),  # 11 outputs, pooled by 3
    "kernel shorter than stride": Architecture(6, 200, 5, 3, 7, 2, 7),
    "stride one": Architecture(3, 40, 3, 7, 1, 5, 9),
}
THREE_TAPS = ARCHITECTURES["three taps"]
CELLS = (155, 96, 37, 5)
"""Training examples: of 16 to a batch, the last batches hold 11, 16, 5 and 5."""
WATCHED = 21


@pytest.fixture(autouse=True)
def one_thread():
    """More only get in each other's way on tensors so small."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


def schedule(**changes):
    given = {
        "centring": "per_device",
        **{"channels": 1, "kernel": 1, "stride": 1, "pool": 1, "hidden": 1},  # networks have theirs
        "epochs": 5,
        "batch_size": 16,
        "learning_rate": 1e-3,
        "decay": 0.1,
        "decay_every": 2,
    }
    return Training(**given | changes)


def drawn(a, n, seed, dtype=np.float32):
    """Noise around a bias that the targets hold."""
    generator = np.random.default_rng(seed)
    bias = generator.normal(size=(n, a.gyroscopes))
    windows = bias[..., None] + generator.normal(scale=2, size=(n, a.gyroscopes, a.window))
    out = np.zeros((n, *packed_shape(a)), dtype)
    return Examples(pack(windows.transpose(1, 0, 2), a, out=out), bias.astype(dtype))


def cells_of(a, sizes=CELLS, watched=WATCHED, dtype=np.float32):
    return [
        (drawn(a, n, seed, dtype), drawn(a, watched, 100 + seed, dtype) if watched else None)
        for seed, n in enumerate(sizes)
    ]


def shuffling(seed):
    return torch.Generator().manual_seed(seed)


def network(a, seed):
    torch.manual_seed(seed)
    return CalibrationNetwork(a)


def members(a, cells, seeds=(0, 1)):
    """Every cell with every seed."""
    dtype = torch.from_numpy(cells[0][0].inputs).dtype
    return [
        (network(a, seed).to(dtype), cell, seed) for cell in range(len(cells)) for seed in seeds
    ]


def together(networks, cells, training, device="cpu", after_steps=lambda steps: None):
    """Results in the order of the networks, and the order in which they came."""
    learners = [Learner(of, cell, shuffling(seed)) for of, cell, seed in networks]
    found = dict(train_together(learners, cells, training, torch.device(device), after_steps))
    return [found[number] for number in range(len(networks))], list(found)


def alone(of, examples, seed, training):
    of = copy.deepcopy(of)
    return train(of, *examples, training, shuffling(seed), lambda: None)


def outputs(a, weights, inputs):
    of = CalibrationNetwork(a)
    of.to(weights["output.bias"].dtype).load_state_dict(weights)
    return predict(of, torch.from_numpy(inputs))


def assert_same(a, got, expected, examples, tolerance=1e-5):
    inputs, spread = examples.inputs, float(examples.targets.std())
    for which in ("last", "best"):
        ours, theirs = getattr(got, which), getattr(expected, which)
        assert (ours is None) == (theirs is None)
        if theirs is not None:
            given = outputs(a, ours, inputs), outputs(a, theirs, inputs)
            torch.testing.assert_close(*given, rtol=0, atol=tolerance * spread)
    assert got.best_epoch == expected.best_epoch
    losses = max(tolerance, 1e-6)  # the reference adds them in float32
    pd.testing.assert_frame_equal(got.history, expected.history, rtol=losses)


@pytest.mark.parametrize(("dtype", "tolerance"), [(np.float32, 1e-5), (np.float64, 1e-12)])
@pytest.mark.parametrize("architecture", ARCHITECTURES)
def test_networks_trained_together_are_those_trained_alone(
    architecture, dtype, tolerance, monkeypatch
):
    monkeypatch.setattr(batched, "CHUNK", 7)  # epochs begin and end anywhere in it
    a, training = ARCHITECTURES[architecture], schedule()
    cells = cells_of(a, dtype=dtype)
    networks = members(a, cells)
    results, order = together(networks, cells, training)
    for (of, cell, seed), got in zip(networks, results, strict=True):
        expected = alone(of, cells[cell], seed, training)
        assert_same(a, got, expected, cells[cell][0], tolerance)
        assert len(got.history) == 5
    assert order == [6, 7, 4, 5, 2, 3, 0, 1]  # those with fewer steps are finished before
    started = outputs(a, networks[0][0].state_dict(), cells[0][0].inputs)
    moved = outputs(a, results[0].last, cells[0][0].inputs) - started
    assert float(moved.std()) > 0.01 * cells[0][0].targets.std()  # after fifty steps


def test_asked_for_steps_every_network_makes_them_whatever_its_examples():
    a, training, cells = THREE_TAPS, schedule(steps=30), cells_of(THREE_TAPS)
    networks = members(a, cells, seeds=[0])
    results, _ = together(networks, cells, training)
    assert [len(result.history) for result in results] == [3, 5, 10, 30]
    for (of, cell, seed), got in zip(networks, results, strict=True):
        assert_same(a, got, alone(of, cells[cell], seed, training), cells[cell][0])


def test_initial_networks_are_left_as_they_are():
    cells = cells_of(THREE_TAPS)
    networks = members(THREE_TAPS, cells)
    together(networks, cells, schedule(epochs=1))
    for of, _, seed in networks:
        for name, value in network(THREE_TAPS, seed).state_dict().items():
            assert torch.equal(of.state_dict()[name], value), name


def test_best_weights_are_those_of_each_networks_own_best_epoch():
    """So few examples make it over-fit, each network at its own time."""
    a = THREE_TAPS
    cells = cells_of(a, sizes=(24, 16, 40), watched=100)
    training = schedule(epochs=40, learning_rate=1e-2, decay_every=40)
    networks = members(a, cells, seeds=(0, 1, 2))
    results, _ = together(networks, cells, training)
    assert len({result.best_epoch for result in results}) > 2
    for (of, cell, seed), got in zip(networks, results, strict=True):
        assert 1 < got.best_epoch < 40
        expected = alone(of, cells[cell], seed, training)
        assert_same(a, got, expected, cells[cell][0], tolerance=1e-3)  # after 120 large steps


@pytest.mark.parametrize("watched", [(WATCHED, None), (None, None), (3, 40)])
def test_validation_may_be_there_or_not_and_of_any_size(watched):
    a, training = THREE_TAPS, schedule()
    cells = [
        (drawn(a, n, n), drawn(a, number, 9) if number else None)
        for n, number in zip((20, 30), watched, strict=True)
    ]
    networks = members(a, cells)
    results, _ = together(networks, cells, training)
    for (of, cell, seed), got in zip(networks, results, strict=True):
        assert ("val_loss" in got.history) == (watched[cell] is not None)
        assert_same(a, got, alone(of, cells[cell], seed, training), cells[cell][0])


def test_a_training_ends_once_the_rates_to_come_sum_to_less_than_asked():
    cells = cells_of(THREE_TAPS)
    networks = members(THREE_TAPS, cells)
    training = schedule(epochs=6, stop_below=1.5e-4)
    results, _ = together(networks, cells, training)
    for (of, cell, seed), got in zip(networks, results, strict=True):
        assert got.history.epoch.tolist() == [1, 2, 3]
        assert_same(THREE_TAPS, got, alone(of, cells[cell], seed, training), cells[cell][0])


def test_who_is_in_the_batch_changes_no_other_network():
    cells = cells_of(THREE_TAPS)
    networks = members(THREE_TAPS, cells)
    everyone, _ = together(networks, cells, schedule())
    few, _ = together(networks[:3], cells, schedule())
    for one, other in zip(few, everyone, strict=False):
        assert_same(THREE_TAPS, one, other, cells[0][0], tolerance=1e-6)


def test_two_runs_give_the_same_weights_bit_by_bit():
    cells = cells_of(THREE_TAPS)
    first, _ = together(members(THREE_TAPS, cells), cells, schedule())
    torch.manual_seed(5)
    second, _ = together(members(THREE_TAPS, cells), cells, schedule())
    for one, other in zip(first, second, strict=True):
        for name, value in one.last.items():
            assert torch.equal(value, other.last[name]), name
        assert one.history.equals(other.history)


def test_a_loss_that_is_no_longer_finite_ends_the_training():
    cells = cells_of(THREE_TAPS)
    cells[2][0].inputs[36] = np.nan
    with pytest.raises(FloatingPointError, match="the loss is nan in epoch 1"):
        together(members(THREE_TAPS, cells), cells, schedule())


def test_finished_networks_are_handed_out_before_the_others_go_on():
    cells = cells_of(THREE_TAPS, sizes=(160, 16))
    learners = [Learner(network(THREE_TAPS, 0), cell, shuffling(0)) for cell in (0, 1)]
    made = []
    results = train_together(learners, cells, schedule(), torch.device("cpu"), made.append)
    assert next(results)[0] == 1
    assert sum(made) == 5  # of the 50 that the other has before it
    assert next(results)[0] == 0
    assert sum(made) == 50


def test_only_networks_that_still_train_are_computed(monkeypatch):
    cells = cells_of(THREE_TAPS)
    computed, outputs_of = [], batched._outputs

    def counted(a, weights, packed):
        if weights.requires_grad:
            computed.append(len(weights))
        return outputs_of(a, weights, packed)

    monkeypatch.setattr(batched, "_outputs", counted)
    together(members(THREE_TAPS, cells), cells, schedule())
    assert computed == [8] * 5 + [6] * 10 + [4] * 15 + [2] * 20  # 1, 3, 6 and 10 steps an epoch


def test_steps_never_wait_for_the_device():
    """On the meta device nothing has a value, so asking for one is an error. Losses are asked for
    once in a chunk.
    """
    meta, training = torch.device("meta"), schedule()
    cells = cells_of(THREE_TAPS)
    networks = members(THREE_TAPS, cells)
    data = batched._Data.on(meta, cells)
    courses = [
        batched._Course(number, Learner(of, cell, shuffling(seed)), data.places[cell], training)
        for number, (of, cell, seed) in enumerate(networks)
    ]
    weights = torch.stack([parameters_to_vector(of.parameters()).detach() for of, *_ in networks])
    stack = batched._Stack(courses, data, batched._initial_state(weights.to(meta)), training)
    stack.run(batched._chunk(courses, range(5), training))
    with pytest.raises(NotImplementedError, match="meta"):
        stack.log()


class Recorded:
    """Stands in for a graph: a replay calls what was called while it was captured."""

    made, capturing = [], None

    def __init__(self):
        self.calls, self.replays = [], 0
        Recorded.made.append(self)

    @contextmanager
    def capture(self):
        Recorded.capturing = self
        yield
        Recorded.capturing = None

    def replay(self):
        self.replays += 1
        for call in self.calls:
            call()


def test_warming_up_and_capturing_leave_no_trace(monkeypatch):
    """All but the graphs themselves, which need a GPU."""

    def recorded(method):
        def call(stack):
            if Recorded.capturing:
                Recorded.capturing.calls.append(lambda: method(stack))
            method(stack)

        return call

    cells = cells_of(THREE_TAPS)
    expected, _ = together(members(THREE_TAPS, cells), cells, schedule())
    for name in ("_step", "_end_epochs"):
        monkeypatch.setattr(batched._Stack, name, recorded(getattr(batched._Stack, name)))
    stream = SimpleNamespace(wait_stream=lambda other: None)
    for name, stand_in in (
        ("Stream", lambda: stream),
        ("current_stream", lambda: stream),
        ("stream", nullcontext),
        ("CUDAGraph", Recorded),
        ("graph", Recorded.capture),
    ):
        monkeypatch.setattr(torch.cuda, name, stand_in)
    monkeypatch.setattr(batched, "_has_graphs", lambda device: True)
    monkeypatch.setattr(Recorded, "made", [])
    got, _ = together(members(THREE_TAPS, cells), cells, schedule())
    for one, other in zip(got, expected, strict=True):
        assert one.history.equals(other.history)
        for name, value in one.last.items():
            assert torch.equal(value, other.last[name]), name
    assert [graph.replays for graph in Recorded.made[::2]] == [5, 10, 15, 20]  # steps of a stage


needs_cuda = pytest.mark.skipif(not torch.cuda.is_available(), reason="there is no GPU here")


@needs_cuda
@pytest.mark.parametrize("architecture", ARCHITECTURES)
def test_on_a_gpu_the_steps_are_graphs_and_the_networks_the_same(architecture, monkeypatch):
    a, training = ARCHITECTURES[architecture], schedule()
    replayed, replay = [], torch.cuda.CUDAGraph.replay
    monkeypatch.setattr(
        torch.cuda.CUDAGraph, "replay", lambda graph: [replayed.append(graph), replay(graph)]
    )
    cells = cells_of(a)
    networks = members(a, cells)
    results, _ = together(networks, cells, training, "cuda")
    assert len(replayed) >= 50
    for (of, cell, seed), got in zip(networks, results, strict=True):
        assert_same(a, got, alone(of, cells[cell], seed, training), cells[cell][0], 1e-4)


@needs_cuda
def test_the_reference_trains_on_a_gpu_too():
    examples, watched = drawn(THREE_TAPS, 155, 0), drawn(THREE_TAPS, 21, 1)
    of = network(THREE_TAPS, 0).to("cuda")
    got = train(of, examples, watched, schedule(), shuffling(0), lambda: None, TorchEngine)
    expected = alone(network(THREE_TAPS, 0), (examples, watched), 0, schedule())
    assert_same(THREE_TAPS, got, expected, examples, tolerance=1e-4)
