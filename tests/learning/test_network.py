"""The paper's network, on plain and on packed windows, and the other networks there are."""

import numpy as np
import pytest
import torch
from torch import nn

from gyro_pipeline.conventions import InputError
from gyro_pipeline.learning.design import Design, options_of
from gyro_pipeline.learning.network import Architecture, CalibrationNetwork
from gyro_pipeline.learning.packing import pack, packed_shape

# gyroscopes, window, kernel, stride, pool; 5 channels and 7 hidden units
SIZES = [
    (3, 123, 12, 5, 3),  # kernel and window are no multiples of the stride
    (6, 100, 3, 7, 2),  # kernel shorter than the stride: samples are skipped
    (3, 25, 25, 4, 1),  # the kernel is the window
    (3, 43, 4, 10, 1),  # the last block is cut short by the window's end
]
HERE = "gyro_pipeline.learning"
OTHERS = [f"{HERE}.network:SingleGyroscope", f"{HERE}.sequences:LSTM", f"{HERE}.sequences:TCN"]


def architecture(gyroscopes, window, kernel, stride, pool):
    return Architecture(gyroscopes, window, 5, kernel, stride, pool, hidden=7)


def channel_by_channel(hidden_weight, a):
    """The hidden layer's weights for features flattened as (channel, time), not (time, channel)."""
    by_time = hidden_weight.reshape(a.hidden, a.pooled, a.channels)
    return by_time.transpose(1, 2).reshape(a.hidden, -1)


def networks(a):
    """Ours, and the paper's written down layer by layer (section III-D) with equal weights."""
    torch.manual_seed(0)
    ours = CalibrationNetwork(**vars(a)).double()
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


@pytest.mark.parametrize("sizes", SIZES)
def test_outputs_and_gradients_are_those_of_the_papers_network(sizes):
    a = architecture(*sizes)
    ours, paper = networks(a)
    windows = np.random.default_rng(1).normal(size=(9, a.gyroscopes, a.window))
    packed = pack(windows.transpose(1, 0, 2), a, out=np.zeros((9, *packed_shape(a))))
    wanted = torch.from_numpy(np.random.default_rng(2).normal(size=(9, a.gyroscopes)))
    expected = paper(torch.from_numpy(windows))
    assert expected.std(dim=0).min() > 1e-3  # the outputs tell the windows apart
    nn.functional.mse_loss(expected, wanted).backward()
    for forward, inputs in ((ours, windows), (ours.forward_packed, packed)):
        ours.zero_grad()
        outputs = forward(torch.from_numpy(inputs))
        torch.testing.assert_close(outputs, expected, rtol=0, atol=1e-12)
        nn.functional.mse_loss(outputs, wanted).backward()
        got = {name: value.grad for name, value in ours.named_parameters()}
        got["hidden.weight"] = channel_by_channel(got["hidden.weight"], a)
        for theirs, (name, gradient) in zip(paper.parameters(), got.items(), strict=True):
            assert theirs.grad.abs().max() > 0, name
            torch.testing.assert_close(gradient, theirs.grad, rtol=0, atol=1e-12, msg=name)


def test_a_window_too_short_for_the_network_is_refused():
    for window, kernel, stride, pool in ((9, 10, 10, 1), (49, 10, 10, 5), (20, 10, 10, 3)):
        sizes = f"kernel {kernel}, stride {stride} and pool {pool}"
        told = f"window of {window} samples is too short for {sizes}"
        with pytest.raises(InputError, match=told):
            architecture(3, window, kernel, stride, pool)
    assert architecture(3, 50, 10, 10, 5).pooled == 1


@pytest.mark.parametrize("path", OTHERS)
def test_other_networks_see_plain_windows_and_learn_from_all_of_them(path, schedule):
    design = Design(path, 3, 100, options_of(path, schedule(), {}, rate_hz=20.0))
    design.check()
    windows = torch.randn((4, 3, 100), generator=torch.Generator().manual_seed(0))
    plain = np.zeros((4, *design.layout.shape), np.float32)
    design.layout.write(windows.numpy().transpose(1, 0, 2), plain)
    np.testing.assert_array_equal(plain, windows.numpy())
    network = design.build(seed=1)
    twins = zip(network.parameters(), design.build(1).parameters(), strict=True)
    assert all(torch.equal(one, twin) for one, twin in twins)
    windows.requires_grad_()
    network(windows).sum().backward()
    assert (windows.grad.abs().amax(dim=2) > 0).all()  # each window and gyroscope
    assert all(parameter.grad is not None for parameter in network.parameters())


def test_the_seed_decides_the_initial_weights_and_leaves_the_global_state_alone():
    sizes = {"channels": 5, "kernel": 12, "stride": 5, "pool": 3, "hidden": 7}
    design = Design(f"{HERE}.network:CalibrationNetwork", 3, 123, sizes)
    before = torch.random.get_rng_state()
    vector = nn.utils.parameters_to_vector
    first, same, other = (vector(design.build(seed).parameters()) for seed in (0, 0, 1))
    assert torch.equal(first, same)
    assert not torch.isclose(first, other).any()
    assert torch.equal(torch.random.get_rng_state(), before)


def test_a_single_gyroscope_is_estimated_from_its_own_samples(schedule):
    network = Design(OTHERS[0], 3, 100, options_of(OTHERS[0], schedule(), {})).build(0)
    windows = torch.randn((2, 3, 100))
    other = windows.clone()
    other[:, 1] += 1
    same = (network(windows) == network(other)).all(dim=0)
    assert same.tolist() == [True, False, True]
    turned = network(windows[:, [2, 0, 1]])
    torch.testing.assert_close(turned, network(windows)[:, [2, 0, 1]])


def test_what_cannot_be_a_network_is_refused_before_it_is_trained(schedule):
    for path, options, told in (
        (OTHERS[1], {"width": 3}, "has no option 'width'; it has units, layers, block_s"),
        (OTHERS[1], {"units": "many"}, r"LSTM\(3, 100, units='many'"),
        ("torch.nn:Linear", {}, "option 'in_features' has no default"),
        ("torch.nn:Identity", {}, r"output of shape \(2, 3\), got .*\[2, 3, 100\]"),
    ):
        with pytest.raises(InputError, match=told):
            Design(path, 3, 100, options_of(path, schedule(), options, 20.0)).check()
