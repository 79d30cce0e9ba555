"""The C step against PyTorch, and what happens where it cannot be had."""

import numpy as np
import pytest
import torch
from torch.nn import functional

from gyro_pipeline.learning import fused
from gyro_pipeline.learning.fused import FusedEngine
from gyro_pipeline.learning.network import Architecture, CalibrationNetwork
from gyro_pipeline.learning.packing import pack


def _missing() -> str:
    try:
        fused._compiler()
    except RuntimeError as reason:
        return str(reason)
    return ""


# Where there is a compiler the step must compile: a mistake in fused.c fails, it does not skip.
needs_compiler = pytest.mark.skipif(bool(_missing()), reason=_missing())

TINY = Architecture(3, 101, 5, 7, 3, 3, 17)
# gyroscopes, window, channels, kernel, stride, pool, hidden; batch size
TRAININGS = {
    "default": (Architecture(3, 1494, 8, 10, 10, 8, 32), 64),
    "12 gyroscopes, several tiles and chunks": (Architecture(12, 4483, 8, 10, 10, 8, 32), 16),
    "large hidden layer, several chunks": (Architecture(3, 1500, 16, 25, 5, 4, 64), 16),
    "no size a round one": (TINY, 64),
    "kernel shorter than stride": (Architecture(6, 200, 5, 3, 7, 2, 7), 16),
    "kernel is the window": (Architecture(3, 25, 25, 25, 4, 1, 9), 16),
    "last block cut short": (Architecture(3, 43, 3, 4, 10, 1, 7), 16),
    "wide kernel": (Architecture(24, 300, 40, 29, 10, 3, 64), 64),
}


@pytest.fixture(autouse=True)
def _as_if_new():
    """Nothing is remembered before or after but what was compiled."""
    forget()
    yield
    forget()


def forget():
    fused.available.cache_clear()
    fused._library.cache_clear()


def network(a, seed=0):
    torch.manual_seed(seed)
    return CalibrationNetwork(**vars(a))


def examples(a, n=150, seed=1):
    """Noise around a bias that the targets hold."""
    generator = np.random.default_rng(seed)
    bias = generator.normal(size=(a.gyroscopes, n, 1))
    windows = bias + generator.normal(scale=2, size=(a.gyroscopes, n, a.window))
    targets = np.ascontiguousarray(bias[..., 0].T, np.float32)
    return pack(windows.astype(np.float32), a), targets


def plain_loop(of, inputs, targets, batch_size, epochs, rate):
    """PyTorch's steps on the network itself; the mean loss of each epoch."""
    x, y = torch.from_numpy(inputs), torch.from_numpy(targets)
    optimizer = torch.optim.Adam(of.parameters(), lr=rate)
    losses = []
    for order in epochs:
        total = 0.0
        for batch in torch.from_numpy(order).split(batch_size):
            loss = functional.mse_loss(of.forward_packed(x[batch]), y[batch])
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
            total += loss.item() * len(batch)
        losses.append(total / len(order))
    return losses


@needs_compiler
@pytest.mark.slow
@pytest.mark.parametrize("training", TRAININGS)
def test_fifty_steps_are_those_of_pytorch(training):
    a, batch_size = TRAININGS[training]
    inputs, targets = examples(a)
    generator, count = np.random.default_rng(2), 17 if batch_size == 64 else 5
    epochs = [generator.permutation(150) for _ in range(count)]  # 51 or 50 steps, some smaller
    ours, theirs = network(a), network(a)
    engine = FusedEngine(ours, inputs, targets, batch_size)
    losses = [engine.epoch(order, 1e-4) for order in epochs]
    expected = plain_loop(theirs, inputs, targets, batch_size, epochs, 1e-4)
    assert losses == pytest.approx(expected, rel=1e-6)

    with torch.no_grad():
        x = torch.from_numpy(inputs)
        untrained = ours.forward_packed(x)
        engine.load_into(ours)
        got, expected = ours.forward_packed(x), theirs.forward_packed(x)
    spread = float(targets.std())
    assert float((expected - untrained).std()) > 0.005 * spread  # the steps went somewhere
    torch.testing.assert_close(got, expected, rtol=0, atol=1e-5 * spread)
    for name, value in theirs.state_dict().items():
        torch.testing.assert_close(ours.state_dict()[name], value, rtol=0, atol=1e-5, msg=name)


@needs_compiler
@pytest.mark.parametrize("parameter", [name for name, _ in network(TINY).named_parameters()])
def test_a_weight_that_is_not_finite_ends_in_the_loss(parameter):
    inputs, targets = examples(TINY)
    broken = network(TINY)
    with torch.no_grad():
        dict(broken.named_parameters())[parameter].view(-1)[1] = np.nan
    assert not np.isfinite(FusedEngine(broken, inputs, targets, 64).epoch(np.arange(150), 0))
    # numbers too small to be normal are kept in the process
    assert np.float32(1e-30) * np.full(16, 1e-10, np.float32).max() > 0


@needs_compiler
def test_examples_that_do_not_fit_and_orders_of_others_are_refused():
    x, y = examples(TINY)
    for inputs, targets, told in (
        (x.astype(np.float64), y, "inputs: .* float64 of shape"),
        (x[:, :-1], y, r"inputs: expected .* \(150, 34, 16\), .* \(150, 33, 16\)"),
        (x, y[1:], r"targets: expected .* \(150, 3\), .* \(149, 3\)"),
    ):
        with pytest.raises(ValueError, match=told):
            FusedEngine(network(TINY), inputs, targets, 64)
    for order in ([0, 150], [-1, 3]):
        with pytest.raises(IndexError, match="indices from 0 to 149"):
            FusedEngine(network(TINY), x, y, 64).epoch(np.array(order, np.int64), 1e-3)


def refusal(caplog):
    """The one line that says why there is no C step."""
    caplog.clear()
    caplog.set_level("INFO", logger="gyro_pipeline")
    assert not fused.available()
    assert not fused.available()
    (record,) = [r for r in caplog.records if r.name == fused.__name__]
    assert record.levelname == "INFO"
    assert "\n" not in record.getMessage()
    return record.getMessage()


def test_without_a_compiler_it_is_said_once_and_training_goes_on(monkeypatch, caplog, tmp_path):
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.delenv("CC", raising=False)
    assert "no C compiler: cc, gcc or clang not found" in refusal(caplog)
    with pytest.raises(RuntimeError, match="no C compiler"):
        FusedEngine(network(TINY), *examples(TINY), 64)
    monkeypatch.setenv("CC", "no-such-compiler -O1")  # is asked for, and not replaced
    forget()
    assert "no C compiler: no-such-compiler -O1 not found" in refusal(caplog)


def test_a_source_that_does_not_compile_or_is_not_kept_is_no_error(monkeypatch, caplog, tmp_path):
    broken = 'case "$*" in *-dM*) exit 0;; esac; echo "error: what is a vector" >&2; exit 1'
    (tmp_path / "cc").write_text(f"#!/bin/sh\n{broken}\n")
    (tmp_path / "cc").chmod(0o755)
    monkeypatch.setenv("CC", str(tmp_path / "cc"))
    monkeypatch.setenv("GYRO_PIPELINE_CACHE", str(tmp_path / "cache"))
    assert "error: what is a vector" in refusal(caplog)
    assert list((tmp_path / "cache").iterdir()) == []
    monkeypatch.setenv("GYRO_PIPELINE_CACHE", str(tmp_path / "cc" / "folder"))
    forget()
    assert "Not a directory" in refusal(caplog)


@needs_compiler
@pytest.mark.slow
def test_a_step_that_computes_something_else_is_not_used(monkeypatch, caplog):
    monkeypatch.setenv("CC", " ".join([*fused._compiler(), "-Dsqrtf=fabsf"]))
    assert "differs from PyTorch's" in refusal(caplog)


@needs_compiler
@pytest.mark.slow
def test_what_is_compiled_is_kept_for_the_same_processor_and_compiler(monkeypatch, tmp_path):
    monkeypatch.delenv("GYRO_PIPELINE_CACHE")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert fused.available()
    forget()
    with monkeypatch.context() as patch:
        patch.setattr(fused, "_compile", lambda *_: pytest.fail("compiled again"))
        assert fused.available()
    flags, described = fused._native(fused._compiler())
    assert b"__VERSION__" in described
    assert b"__x86_64__" in described or b"__aarch64__" in described
    monkeypatch.setattr(fused, "_native", lambda _: (flags, described + b"#define __NEWER__ 1\n"))
    forget()
    assert fused.available()
    assert len(list((tmp_path / "gyro_pipeline").iterdir())) == 2
