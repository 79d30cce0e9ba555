"""Many networks trained at once against each of them alone, in the reference trainer."""

import copy

import numpy as np
import pandas as pd
import pytest
import torch
from torch import nn

from gyro_pipeline.learning.batched import Learner, obstacle, train_together
from gyro_pipeline.learning.examples import Examples
from gyro_pipeline.learning.network import Architecture, CalibrationNetwork
from gyro_pipeline.learning.packing import pack, packed_shape
from gyro_pipeline.learning.trainer import predict, train
from gyro_pipeline.parameters import Training

# gyroscopes, window, channels, kernel, stride, pool, hidden
ARCHITECTURES = {
    "three taps": Architecture(3, 63, 6, 12, 5, 3, 16),  # 11 outputs, pooled by 3
    "kernel shorter than stride": Architecture(6, 200, 5, 3, 7, 2, 7),
}
SIZES = ARCHITECTURES["three taps"]
SHAPE = packed_shape(SIZES)
CPU = torch.device("cpu")


def schedule(**changes):
    given = {
        "centring": "per_device",
        **{"channels": 1, "kernel": 1, "stride": 1, "pool": 1, "hidden": 1},  # networks have theirs
        **{"epochs": 5, "batch_size": 16, "learning_rate": 1e-3, "decay": 0.1, "decay_every": 2},
    }
    return Training(**given | changes)


def drawn(n, seed, a=SIZES, dtype=np.float32):
    """Noise around a bias that the targets hold."""
    generator = np.random.default_rng(seed)
    bias = generator.normal(size=(n, a.gyroscopes))
    windows = bias[..., None] + generator.normal(scale=2, size=(n, a.gyroscopes, a.window))
    out = np.zeros((n, *packed_shape(a)), dtype)
    return Examples(pack(windows.transpose(1, 0, 2), a, out=out), bias.astype(dtype))


def seeded(make, seed):
    torch.manual_seed(seed)
    return make()


def learners(make=lambda: CalibrationNetwork(**vars(SIZES)), n=75, watched=21, seeds=(0, 1), **how):
    """Two sets of examples, each with every seed."""
    cells = [
        (drawn(n, at, **how), drawn(watched, 9 + at, **how) if watched else None) for at in (0, 1)
    ]
    dtype = getattr(torch, np.dtype(how.get("dtype", np.float32)).name)
    return [
        Learner(seeded(make, seed).to(dtype), *cell, torch.Generator().manual_seed(seed))
        for cell in cells
        for seed in seeds
    ]


def together(given, training, device=CPU):
    given = [Learner(**vars(one) | {"shuffling": one.shuffling.clone_state()}) for one in given]
    return train_together(given, training, device)


def alone(one, training):
    network, shuffling = copy.deepcopy(one.network), one.shuffling.clone_state()
    return train(network, one.training, one.validation, training, shuffling)


def outputs(one, weights):
    network = copy.deepcopy(one.network)
    network.load_state_dict(weights)
    return predict(network, torch.from_numpy(one.training.inputs))


def assert_those_alone(given, training, tolerance=1e-5, device=CPU):
    """Estimates of the last and the best weights, best epochs and losses are the same."""
    results = together(given, training, device)
    for one, got in zip(given, results, strict=True):
        expected, spread = alone(one, training), float(one.training.targets.std())
        assert got.best_epoch == expected.best_epoch
        for ours, theirs in ((got.last, expected.last), (got.best, expected.best)):
            if theirs is not None:
                pair = outputs(one, ours), outputs(one, theirs)
                torch.testing.assert_close(*pair, rtol=0, atol=tolerance * spread)
        losses = max(tolerance, 1e-6)  # the reference adds them in float32
        pd.testing.assert_frame_equal(got.history, expected.history, rtol=losses)
    return results


@pytest.mark.parametrize("architecture", ARCHITECTURES)
def test_networks_trained_together_are_those_trained_alone(architecture):
    """In batches of 16, the last of which has 11; each has its own best epoch."""
    a = ARCHITECTURES[architecture]
    given = learners(lambda: CalibrationNetwork(**vars(a)), a=a, dtype=np.float64)
    results = assert_those_alone(given, schedule(epochs=10), tolerance=1e-12)
    moved = outputs(given[0], results[0].last) - outputs(given[0], given[0].network.state_dict())
    assert float(moved.std()) > 0.01 * given[0].training.targets.std()  # after fifty steps


class Computed(nn.Module):
    """A network of one's own: something computed from the blocks, and a buffer of each seed."""

    def __init__(self, compute):
        super().__init__()
        self.compute, self.output = compute, nn.Linear(SHAPE[1], 3)
        self.register_buffer("places", torch.randn(SHAPE))

    def forward(self, inputs):
        return self.output(self.compute(inputs + self.places).mean(1))


def dilated():
    return nn.Sequential(nn.Conv1d(13, 6, 3), nn.GroupNorm(2, 6), nn.Conv1d(6, 13, 3, 1, 3, 2))


def test_so_are_other_networks_that_vmap_can_batch():
    assert obstacle(Computed(dilated()), SHAPE, CPU) is None
    assert_those_alone(learners(lambda: Computed(dilated())), schedule())


@pytest.mark.parametrize(
    ("layer", "reason"),
    [
        (lambda: nn.LSTM(SHAPE[1], 3), "rule not implemented for aten::lstm"),
        (lambda: Computed(nn.BatchNorm1d(13)), "depends on the other windows of the batch"),
        (lambda: Computed(nn.Dropout(0.1)), "called random operation"),
    ],
)
def test_what_cannot_be_batched_is_told(layer, reason):
    assert reason in obstacle(layer(), SHAPE, CPU)
    assert obstacle(CalibrationNetwork(**vars(SIZES)), SHAPE, CPU) is None


@pytest.mark.parametrize(
    ("changes", "watched"),
    [({"steps": 23}, 3), ({"epochs": 6, "stop_below": 1.5e-4}, None), ({"batch_size": 500}, 40)],
)
def test_every_schedule_is_that_of_the_reference_with_and_without_validation(changes, watched):
    assert_those_alone(learners(watched=watched), schedule(**changes))


def test_a_loss_that_is_no_longer_finite_ends_the_training():
    given = learners()
    given[2].training.inputs[36] = np.nan
    with pytest.raises(FloatingPointError, match="the loss is nan in epoch 1"):
        together(given, schedule())


@pytest.mark.skipif(not torch.cuda.is_available(), reason="there is no GPU here")
@pytest.mark.parametrize("architecture", ARCHITECTURES)
def test_on_a_gpu_networks_are_the_same(architecture):
    a, cuda = ARCHITECTURES[architecture], torch.device("cuda")
    assert obstacle(CalibrationNetwork(**vars(a)), packed_shape(a), cuda) is None
    assert_those_alone(learners(lambda: CalibrationNetwork(**vars(a)), a=a), schedule(), 1e-4, cuda)
