"""One network trained against a plain PyTorch loop, and many at once against each alone."""

import copy
from functools import partial

import numpy as np
import pandas as pd
import pytest
import torch
from torch import nn

from gyro_pipeline.learning.batched import Learner, obstacle, train_together
from gyro_pipeline.learning.examples import Examples
from gyro_pipeline.learning.network import Architecture, CalibrationNetwork
from gyro_pipeline.learning.packing import pack, packed_shape
from gyro_pipeline.learning.trainer import TorchEngine, predict, train

# gyroscopes, window, channels, kernel, stride, pool, hidden
ARCHITECTURES = {
    "three taps": Architecture(3, 63, 6, 12, 5, 3, 16),  # 11 outputs, pooled by 3
    "kernel shorter than stride": Architecture(6, 200, 5, 3, 7, 2, 7),
}
SIZES = ARCHITECTURES["three taps"]
SHAPE = packed_shape(SIZES)
CPU = torch.device("cpu")


def drawn(n, seed=0, a=SIZES, dtype=np.float32):
    """Packed windows of noise around a bias that the targets hold."""
    generator = np.random.default_rng(seed)
    bias = generator.normal(size=(n, a.gyroscopes))
    windows = bias[..., None] + generator.normal(scale=2, size=(n, a.gyroscopes, a.window))
    out = np.zeros((n, *packed_shape(a)), dtype)
    return Examples(pack(windows.transpose(1, 0, 2), a, out=out), bias.astype(dtype))


def network(seed=0, make=lambda: CalibrationNetwork(**vars(SIZES))):
    torch.manual_seed(seed)
    return make()


def shuffled(seed=5):
    return torch.Generator().manual_seed(seed)


def outputs(one, weights, examples):
    restored = copy.deepcopy(one)
    restored.load_state_dict(weights)
    return predict(restored, torch.from_numpy(examples.inputs))


def test_fifty_steps_are_those_of_a_plain_pytorch_loop_with_rates_that_fall(schedule):
    examples, called = drawn(155, dtype=np.float64), []  # ten batches; the last one is smaller
    ours = network().double()
    theirs, untrained = copy.deepcopy(ours), copy.deepcopy(ours.state_dict())
    tick = partial(called.append, 1)
    result = train(ours, examples, None, schedule(), shuffled(), tick, TorchEngine)
    assert len(called) == 5
    np.testing.assert_allclose(result.losses.learning_rate, [1e-3, 1e-3, 1e-4, 1e-4, 1e-5])

    inputs, targets = map(torch.from_numpy, (examples.inputs, examples.targets))
    generator, optimizer = shuffled(), torch.optim.Adam(theirs.parameters(), lr=1e-3)
    for epoch in range(5):
        optimizer.param_groups[0]["lr"] = 1e-3 * 0.1 ** (epoch // 2)
        for batch in torch.randperm(155, generator=generator).split(16):
            optimizer.zero_grad()
            nn.functional.mse_loss(theirs.forward_packed(inputs[batch]), targets[batch]).backward()
            optimizer.step()
    expected, got = predict(theirs, inputs), outputs(ours, result.last, examples)
    spread = float(targets.std())
    moved = expected - outputs(ours, untrained, examples)
    assert float(moved.std()) > 0.01 * spread  # the steps went somewhere
    torch.testing.assert_close(got, expected, rtol=0, atol=1e-12 * spread)


def test_best_weights_are_those_of_the_lowest_validation_loss(schedule):
    examples, validation, one = drawn(24), drawn(200, seed=1), network()
    settings = schedule(epochs=40, learning_rate=1e-2, decay_every=40)
    result = train(one, examples, validation, settings, shuffled())
    history = result.losses.set_index("epoch")
    best_epoch = history.val_loss.idxmin()
    assert 1 < best_epoch < 40  # it over-fits, as so few examples make it
    for weights, epoch in ((result.best, best_epoch), (result.last, 40)):
        errors = outputs(one, weights, validation).numpy() - validation.targets
        assert np.mean(errors**2) == pytest.approx(history.val_loss[epoch], rel=1e-5)


def test_a_training_ends_once_the_rates_to_come_sum_to_less_than_asked(schedule):
    whole, early, all_to_come = (
        train(network(), drawn(24), None, schedule(epochs=6, **ends), shuffled()).losses
        for ends in ({}, {"stop_below": 1.5e-4}, {"stop_below": 0.0})
    )  # rates 1e-3, 1e-3, 1e-4, 1e-4, 1e-5, 1e-5
    assert early.epoch.tolist() == [1, 2, 3]  # after it 1e-4 + 2e-5 are to come
    pd.testing.assert_frame_equal(early, whole[:3])
    assert len(all_to_come) == 6


def learners(make=lambda: CalibrationNetwork(**vars(SIZES)), n=75, watched=21, **how):
    """Two sets of examples, each with two seeds."""
    dtype = getattr(torch, np.dtype(how.get("dtype", np.float32)).name)

    def learner(at, seed):
        data = drawn(n, at, **how), drawn(watched, 9 + at, **how) if watched else None
        return Learner(network(seed, make).to(dtype), *data, shuffled(seed))

    return [learner(at, seed) for at in (0, 1) for seed in (0, 1)]


def together(given, training, device=CPU):
    given = [Learner(**vars(one) | {"shuffling": one.shuffling.clone_state()}) for one in given]
    return train_together(given, training, device)


def assert_those_alone(given, training, tolerance=1e-5, device=CPU):
    """Estimates of the last and the best weights, and losses, are the same."""
    for one, got in zip(given, together(given, training, device), strict=True):
        data, shuffling = (one.training, one.validation), one.shuffling.clone_state()
        expected = train(copy.deepcopy(one.network), *data, training, shuffling)
        spread = float(one.training.targets.std())
        for ours, theirs in ((got.last, expected.last), (got.best, expected.best)):
            if theirs is not None:
                pair = (outputs(one.network, weights, one.training) for weights in (ours, theirs))
                torch.testing.assert_close(*pair, rtol=0, atol=tolerance * spread)
        losses = max(tolerance, 1e-6)  # the reference adds them in float32
        pd.testing.assert_frame_equal(got.losses, expected.losses, rtol=losses)


@pytest.mark.parametrize("architecture", ARCHITECTURES)
def test_networks_trained_together_are_those_trained_alone(architecture, schedule):
    """In batches of 16, the last of which has 11; each has its own best epoch."""
    a = ARCHITECTURES[architecture]
    given = learners(lambda: CalibrationNetwork(**vars(a)), a=a, dtype=np.float64)
    assert_those_alone(given, schedule(), tolerance=1e-12)


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


@pytest.mark.slow
def test_so_are_other_networks_that_vmap_can_batch_and_what_cannot_be_batched_is_told(schedule):
    assert obstacle(Computed(dilated()), SHAPE, CPU) is None
    assert_those_alone(learners(lambda: Computed(dilated())), schedule(epochs=2))
    for layer, reason in (
        (nn.LSTM(SHAPE[1], 3), "rule not implemented for aten::lstm"),
        (Computed(nn.BatchNorm1d(13)), "depends on the other windows of the batch"),
        (Computed(nn.Dropout(0.1)), "called random operation"),
    ):
        assert reason in obstacle(layer, SHAPE, CPU)


@pytest.mark.parametrize(
    ("changes", "watched"),
    [({"steps": 23}, 3), ({"epochs": 6, "stop_below": 1.5e-4}, None), ({"batch_size": 500}, 40)],
)
def test_every_schedule_is_that_of_one_with_and_without_validation(changes, watched, schedule):
    assert_those_alone(learners(watched=watched), schedule(**changes))


def test_a_loss_that_is_no_longer_finite_ends_the_training(schedule):
    given = learners()
    given[2].training.inputs[36] = np.nan
    with pytest.raises(FloatingPointError, match="the loss is nan in epoch 1"):
        together(given, schedule())
    with pytest.raises(FloatingPointError, match="the loss is nan in epoch 1"):
        train(network(), given[2].training, None, schedule(), shuffled())


@pytest.mark.skipif(not torch.cuda.is_available(), reason="there is no GPU here")
@pytest.mark.parametrize("architecture", ARCHITECTURES)
def test_on_a_gpu_networks_are_the_same(architecture, schedule):
    a, cuda = ARCHITECTURES[architecture], torch.device("cuda")
    assert obstacle(CalibrationNetwork(**vars(a)), packed_shape(a), cuda) is None
    assert_those_alone(learners(lambda: CalibrationNetwork(**vars(a)), a=a), schedule(), 1e-4, cuda)
