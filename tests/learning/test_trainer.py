import numpy as np
import pandas as pd
import pytest
import torch
from torch import nn

from gyro_pipeline.learning import fused
from gyro_pipeline.learning.examples import Examples
from gyro_pipeline.learning.fused import FusedEngine
from gyro_pipeline.learning.network import Architecture, CalibrationNetwork
from gyro_pipeline.learning.packing import pack, packed_shape
from gyro_pipeline.learning.trainer import TorchEngine, predict, train
from gyro_pipeline.parameters import Training

SIZES = Architecture(3, 63, 6, 12, 5, 3, 16)


def schedule(**changes):
    given = {
        **{"centring": "per_device", "channels": 6, "kernel": 12, "stride": 5, "pool": 3},
        **{"hidden": 16, "epochs": 5, "batch_size": 16, "learning_rate": 1e-3},
        **{"decay": 0.1, "decay_every": 2},
    }
    return Training(**given | changes)


def drawn(n, dtype=np.float32, seed=0):
    """Windows (n, 3, 63) of noise around a bias that the targets hold, and the same packed."""
    generator = np.random.default_rng(seed)
    bias = generator.normal(size=(n, 3))
    windows = (bias[..., None] + generator.normal(scale=2, size=(n, 3, 63))).astype(dtype)
    packed = pack(windows.transpose(1, 0, 2), SIZES, out=np.zeros((n, *packed_shape(SIZES)), dtype))
    return windows, Examples(packed, bias.astype(dtype))


def network(seed=0):
    torch.manual_seed(seed)
    return CalibrationNetwork(**vars(SIZES))


def ordered(seed=5):
    return torch.Generator().manual_seed(seed)


def trained(examples, validation=None, of=None, **changes):
    return train(
        of or network(), examples, validation, schedule(**changes), ordered(), lambda: None
    )


def loss_of(weights, examples):
    """Mean squared error of stored weights, on plain windows' equivalent, in NumPy."""
    restored = CalibrationNetwork(**vars(SIZES))
    restored.load_state_dict(weights)
    with torch.no_grad():
        outputs = restored.forward_packed(torch.from_numpy(examples.inputs)).numpy()
    return np.mean((outputs - examples.targets) ** 2, dtype=np.float64)


def papers_network(ours):
    """The paper's network layer by layer (section III-D), features flattened (channel, time)."""
    a = SIZES
    paper = nn.Sequential(
        nn.Conv1d(3, a.channels, a.kernel, a.stride),
        nn.LeakyReLU(0.1),
        nn.MaxPool1d(a.pool),
        nn.Flatten(),
        nn.Linear(3 * a.channels, a.hidden),
        nn.LeakyReLU(0.1),
        nn.Linear(a.hidden, 3),
    ).to(next(ours.parameters()).dtype)
    weights = {name: value.detach().clone() for name, value in ours.state_dict().items()}
    by_time = weights["hidden.weight"].reshape(a.hidden, 3, a.channels)
    weights["hidden.weight"] = by_time.transpose(1, 2).reshape(a.hidden, -1)
    with torch.no_grad():
        for theirs, weight in zip(paper.parameters(), weights.values(), strict=True):
            theirs.copy_(weight)
    return paper


@pytest.mark.parametrize(
    ("engine", "dtype", "tolerance"),
    [
        (TorchEngine, np.float64, 1e-12),
        (FusedEngine, np.float32, 1e-5),
    ],
)
def test_fifty_steps_are_those_of_a_plain_pytorch_loop(engine, dtype, tolerance):
    if engine is FusedEngine and not fused.available():
        pytest.skip("the C step cannot be compiled here; the log says why")
    windows, examples = drawn(155, dtype)  # ten batches; the last one is smaller
    ours = network().to(torch.float64 if dtype is np.float64 else torch.float32)
    paper = papers_network(ours)
    untrained = paper(torch.from_numpy(windows)).detach()
    train(ours, examples, None, schedule(), ordered(), lambda: None, engine)

    inputs, targets = torch.from_numpy(windows), torch.from_numpy(examples.targets)
    generator, optimizer = ordered(), torch.optim.Adam(paper.parameters(), lr=1e-3)
    steps = 0
    for epoch in range(5):
        for group in optimizer.param_groups:
            group["lr"] = 1e-3 * 0.1 ** (epoch // 2)
        for batch in torch.randperm(155, generator=generator).split(16):
            optimizer.zero_grad()
            nn.functional.mse_loss(paper(inputs[batch]), targets[batch]).backward()
            optimizer.step()
            steps += 1
    assert steps == 50
    with torch.no_grad():
        expected, got = paper(inputs), predict(ours, torch.from_numpy(examples.inputs))
    spread = float(targets.std())
    assert float((expected - untrained).std()) > 0.01 * spread  # the steps went somewhere
    torch.testing.assert_close(got, expected, rtol=0, atol=tolerance * spread)


def test_history_has_a_row_per_epoch_and_the_rate_falls_on_the_clock():
    _, examples = drawn(40)
    called = []
    history = train(
        network(), examples, drawn(10)[1], schedule(), ordered(), lambda: called.append(1)
    ).history
    assert list(history.columns) == ["epoch", "learning_rate", "train_loss", "val_loss"]
    assert history.epoch.tolist() == [1, 2, 3, 4, 5]
    np.testing.assert_allclose(history.learning_rate, [1e-3, 1e-3, 1e-4, 1e-4, 1e-5], rtol=1e-12)
    assert len(called) == 5


def test_best_weights_are_those_of_the_lowest_validation_loss():
    _, examples = drawn(24)
    _, validation = drawn(200, seed=1)
    result = trained(examples, validation, epochs=40, learning_rate=1e-2, decay_every=40)
    history = result.history.set_index("epoch")
    assert result.best_epoch == history.val_loss.idxmin()
    assert 1 < result.best_epoch < 40  # it over-fits, as so few examples make it
    assert loss_of(result.best, validation) == pytest.approx(history.val_loss.min(), rel=1e-5)
    assert loss_of(result.last, validation) == pytest.approx(history.val_loss[40], rel=1e-5)


def test_a_loss_that_is_no_longer_finite_ends_the_training():
    _, examples = drawn(40)
    examples.inputs[7, 0, 0] = np.inf
    with pytest.raises(FloatingPointError, match="the loss is .* in epoch 1"):
        trained(examples)


def test_a_training_ends_once_the_rates_to_come_sum_to_less_than_asked():
    _, examples = drawn(24)
    whole = trained(examples, epochs=6)  # rates 1e-3, 1e-3, 1e-4, 1e-4, 1e-5, 1e-5
    early = trained(examples, epochs=6, stop_below=1.5e-4)
    assert early.history.epoch.tolist() == [1, 2, 3]  # after it 1e-4 + 2e-5 are to come
    pd.testing.assert_frame_equal(early.history, whole.history[:3])
    assert trained(examples, epochs=6, stop_below=0.0).history.epoch.iloc[-1] == 6
