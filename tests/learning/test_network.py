import numpy as np
import pytest
import torch
from torch import nn

from gyro_pipeline.conventions import InputError
from gyro_pipeline.learning.network import Architecture, CalibrationNetwork
from gyro_pipeline.learning.packing import pack, packed_shape

# gyroscopes, window, kernel, stride, pool; 5 channels and 7 hidden units
SIZES = [
    (3, 120, 10, 10, 4),  # everything a multiple of the stride
    (3, 123, 12, 5, 3),  # kernel and window are no multiples of the stride
    (6, 100, 3, 7, 2),  # kernel shorter than the stride: samples are skipped
    (6, 97, 20, 10, 3),  # the kernel is two strides; the window leaves a rest
    (12, 60, 7, 1, 5),  # stride one
    (3, 25, 25, 4, 1),  # the kernel is the window
    (12, 26, 25, 4, 1),  # one output, one sample unseen
    (3, 43, 4, 10, 1),  # the last block is cut short by the window's end
]


def architecture(gyroscopes, window, kernel, stride, pool):
    return Architecture(gyroscopes, window, 5, kernel, stride, pool, hidden=7)


def channel_by_channel(hidden_weight, a):
    """The hidden layer's weights for features flattened as (channel, time), not (time, channel)."""
    by_time = hidden_weight.reshape(a.hidden, a.pooled, a.channels)
    return by_time.transpose(1, 2).reshape(a.hidden, -1)


def networks(a, seed=0):
    """Ours, and the paper's written down layer by layer (section III-D) with equal weights."""
    torch.manual_seed(seed)
    ours = CalibrationNetwork(a).double()
    paper = nn.Sequential(
        nn.Conv1d(a.gyroscopes, a.channels, a.kernel, a.stride),
        nn.LeakyReLU(0.1),
        nn.MaxPool1d(a.pool),
        nn.Flatten(),
        nn.Linear(((a.window - a.kernel) // a.stride + 1) // a.pool * a.channels, a.hidden),
        nn.LeakyReLU(0.1),
        nn.Linear(a.hidden, a.gyroscopes),
    ).double()
    with torch.no_grad():
        weights = ours.state_dict()
        weights["hidden.weight"] = channel_by_channel(weights["hidden.weight"], a)
        for theirs, weight in zip(paper.parameters(), weights.values(), strict=True):
            theirs.copy_(weight)
    return ours, paper


def windows_of(a, n=9):
    """The same windows as (n, gyroscopes, window) and packed, float64."""
    plain = np.random.default_rng(1).normal(size=(n, a.gyroscopes, a.window))
    packed = pack(plain.transpose(1, 0, 2), a, out=np.zeros((n, *packed_shape(a))))
    return torch.from_numpy(plain), torch.from_numpy(packed)


@pytest.mark.parametrize("sizes", SIZES)
def test_plain_and_packed_windows_give_what_the_papers_network_gives(sizes):
    a = architecture(*sizes)
    ours, paper = networks(a)
    plain, packed = windows_of(a)
    expected = paper(plain)
    assert expected.shape == (9, a.gyroscopes)
    assert expected.std(dim=0).min() > 1e-3  # the outputs tell the windows apart
    torch.testing.assert_close(ours(plain), expected, rtol=0, atol=1e-12)
    torch.testing.assert_close(ours.forward_packed(packed), expected, rtol=0, atol=1e-12)


@pytest.mark.parametrize("sizes", SIZES)
def test_gradients_are_those_of_the_papers_network(sizes):
    a = architecture(*sizes)
    ours, paper = networks(a)
    plain, packed = windows_of(a)
    wanted = torch.from_numpy(np.random.default_rng(2).normal(size=(9, a.gyroscopes)))
    nn.functional.mse_loss(paper(plain), wanted).backward()
    for forward, inputs in ((ours, plain), (ours.forward_packed, packed)):
        ours.zero_grad()
        nn.functional.mse_loss(forward(inputs), wanted).backward()
        got = {name: value.grad for name, value in ours.named_parameters()}
        got["hidden.weight"] = channel_by_channel(got["hidden.weight"], a)
        for theirs, (name, gradient) in zip(paper.parameters(), got.items(), strict=True):
            assert theirs.grad.abs().max() > 0, name
            torch.testing.assert_close(gradient, theirs.grad, rtol=0, atol=1e-12, msg=name)


@pytest.mark.parametrize(
    ("window", "kernel", "stride", "pool"),
    [(9, 10, 10, 1), (5, 10, 3, 1), (49, 10, 10, 5), (20, 10, 10, 3)],
)
def test_a_window_too_short_for_the_network_is_refused(window, kernel, stride, pool):
    with pytest.raises(InputError, match=f"window of {window} samples is too short") as refused:
        architecture(3, window, kernel, stride, pool)
    for size in (f"kernel {kernel}", f"stride {stride}", f"pool {pool}"):
        assert size in str(refused.value)


def test_the_shortest_window_that_fits_is_accepted():
    shortest = architecture(3, 50, 10, 10, 5)
    assert (shortest.convolved, shortest.pooled) == (5, 1)
    assert CalibrationNetwork(shortest)(torch.zeros(2, 3, 50)).shape == (2, 3)
