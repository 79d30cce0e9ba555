"""The training step in C for a CPU thread: the same results, several times faster.

The source, ``fused.c``, is compiled at first use by the C compiler of the system into the cache of
the user. Without a compiler :func:`available` is false, and training runs in PyTorch, more slowly.
"""

import ctypes
import functools
import hashlib
import logging
import os
import shutil
import subprocess
import tempfile
from pathlib import Path

import numpy as np
import torch
from torch import nn

from gyro_pipeline.learning.network import Architecture, CalibrationNetwork
from gyro_pipeline.learning.packing import CACHE_LINE, aligned_zeros, packed_shape
from gyro_pipeline.learning.trainer import TorchEngine

logger = logging.getLogger(__name__)

SOURCE = Path(__file__).with_name("fused.c")

_CACHE = "GYRO_PIPELINE_CACHE"
# Without -ffast-math: gcc would link code that flushes denormals to zero in the whole process, and
# NaN as a loss would not be detected.
_FLAGS = "-std=gnu11 -O3 -ffp-contract=fast -fno-math-errno -fno-trapping-math -shared -fPIC"
_NATIVE = ("-march=native", "-mcpu=native", "")
"""Flags for the processor of this machine; the last one compiles for any processor."""
_TIMEOUT_S = 120

# Floats that fit into a second-level cache of 1 MB; measured, not critical.
_WINDOW_CHUNK, _WINDOWS, _WEIGHTS = 20 << 10, 64 << 10, 128 << 10


@functools.cache
def available() -> bool:
    """Whether the fused step can be used; if not, the reason is logged once."""
    try:
        _check()
    except (OSError, RuntimeError, subprocess.SubprocessError) as reason:
        logger.info("training in PyTorch, not in the several times faster C step: %s", reason)
        return False
    return True


class FusedEngine:
    """The training of a network on a set of examples, with the state of the optimiser."""

    def __init__(
        self, network: CalibrationNetwork, inputs: np.ndarray, targets: np.ndarray, batch_size: int
    ) -> None:
        """Start from the network's weights; the network itself is not changed.

        Args:
            network: On the CPU.
            inputs: Packed windows, shape (n, blocks, width), float32, scaled and finite (the
                maximum ignores NaN); used in place.
            targets: Shape (n, gyroscopes), float32, scaled; used in place.
            batch_size: Examples per step.

        Raises:
            ValueError: If the examples do not fit the network, are of another type or not
                contiguous.
            RuntimeError: If the step could not be compiled; call :func:`available` first.
        """
        a = network.architecture
        _check_array("inputs", inputs, (len(inputs), *packed_shape(a)))
        _check_array("targets", targets, (len(inputs), a.gyroscopes))
        self._library, self._batch_size, self._steps = _library(), batch_size, 0
        layout = _Layout(a, min(batch_size, len(inputs)))
        self._index = layout.index
        self._arrays = {name: aligned_zeros((floats,)) for name, floats in layout.arrays.items()}
        self._arrays |= {"inputs": inputs, "targets": targets}
        self._arrays["seen"][layout.seen] = 1
        self._weights = self._arrays["weights"]
        for name, value in network.state_dict().items():
            self._weights[self._index[name]] = value.numpy()
        addresses = {name: array.ctypes.data for name, array in self._arrays.items()}
        for name, start in layout.starts.items():
            addresses[name.replace(".", "_")] = self._weights[start:].ctypes.data
        self._engine = _Engine(**layout.sizes, **addresses)

    def epoch(self, order: np.ndarray, learning_rate: float) -> float:
        """Train on examples in the given order, in batches; the last one may be smaller.

        Args:
            order: Indices of examples.
            learning_rate: Adam's.

        Returns:
            Mean squared error over the examples, each before the step of its batch.

        Raises:
            IndexError: If an index is out of range, or the order is empty.
        """
        examples, gyroscopes = self._arrays["targets"].shape
        if not (len(order) and 0 <= order.min() and order.max() < examples):
            raise IndexError(f"order: expected indices from 0 to {examples - 1}, got {order}")
        padded = np.append(order, order[:1]).astype(np.int64)  # the C code looks one ahead
        squares = self._library.fused_epoch(
            ctypes.byref(self._engine),
            padded.ctypes.data,
            len(order),
            self._batch_size,
            self._steps,
            learning_rate,
        )
        self._steps += -(-len(order) // self._batch_size)
        return float(squares) / (len(order) * gyroscopes)

    @torch.no_grad()
    def load_into(self, network: nn.Module) -> None:
        """Copy the current weights into a network of the same architecture."""
        for name, value in network.state_dict().items():
            value.copy_(torch.from_numpy(self._weights[self._index[name]]))


_SIZES = """gyroscopes blocks width span channels pool pooled hidden features tile chunk refetch
    kernel_row floats"""
_ARRAYS = """weights mean square gradient hidden_weight hidden_bias output_weight output_bias
    convolution_weight convolution_bias seen inputs targets kernels biases active d_active
    feature d_feature place"""


class _Engine(ctypes.Structure):
    """``Engine`` in fused.c."""

    _fields_ = [
        *((name, ctypes.c_int64) for name in _SIZES.split()),
        *((name, ctypes.c_void_p) for name in _ARRAYS.split()),
    ]


class _Layout:
    """Sizes and arrays of fused.c, and the index of each parameter in ``weights``."""

    def __init__(self, architecture: Architecture, batch_size: int) -> None:
        s = _padded_sizes(architecture)
        s |= _cache_sizes(s, batch_size)
        self.index: dict[str, np.ndarray] = {}
        self.starts: dict[str, int] = {}
        floats = 0
        for name, (index, size) in _parameters(architecture, s).items():
            self.index[name], self.starts[name] = index + floats, floats
            floats += size
        self.seen = self.index["convolution.weight"][0] - self.starts["convolution.weight"]
        self.sizes = s | {"floats": floats}
        self.arrays = {
            **dict.fromkeys(("weights", "mean", "square", "gradient"), floats),
            **dict.fromkeys(("active", "d_active"), s["tile"] * s["hidden"]),
            **dict.fromkeys(("feature", "place"), s["tile"] * s["features"]),
            "d_feature": s["tile"] * (s["chunk"] * s["channels"] + 16),
            "kernels": s["span"] // 2 * s["kernel_row"],
            "biases": s["kernel_row"],
            "seen": s["span"],
        }


def _padded_sizes(architecture: Architecture) -> dict[str, int]:
    a = architecture
    blocks, width = packed_shape(a)
    channels = _up(a.channels, 8)
    return {
        "gyroscopes": a.gyroscopes,
        "blocks": blocks,
        "width": width,
        "span": -(-a.kernel // a.stride) * width,
        "channels": channels,
        "pool": a.pool,
        "pooled": a.pooled,
        "hidden": _up(a.hidden, 16),
        "features": _up(a.pooled * channels, 16),
        "kernel_row": 2 * _up(channels, 16),
    }


def _cache_sizes(sizes: dict[str, int], batch_size: int) -> dict[str, int]:
    """Numbers of examples and pooled times that are processed together, to stay in the cache."""
    s = sizes
    by_window = _WINDOW_CHUNK // (s["pool"] * s["width"])
    by_weights = _WEIGHTS // (4 * s["hidden"] * s["channels"])  # weights, gradient and two means
    chunk = min(by_window, by_weights, s["pooled"] + 1)
    # Windows of a tile are still in the cache when they are needed again. If the hidden weights do
    # not fit into the cache, reading them again for every tile would cost more than it saves.
    few_weights = 4 * s["hidden"] * s["features"] <= _WEIGHTS
    by_tile = _WINDOWS // (s["blocks"] * s["width"]) + 1
    tile = min(batch_size, by_tile) if few_weights else batch_size
    refetch = int(tile * s["blocks"] * s["width"] > 2 * _WINDOWS)  # no longer in the cache
    return {"tile": _up(tile, 4), "chunk": max(2, chunk // 2 * 2), "refetch": refetch}


def _parameters(
    architecture: Architecture, sizes: dict[str, int]
) -> dict[str, tuple[np.ndarray, int]]:
    """Indices of the values of each parameter in its padded array, and the size of the array."""
    a, s = architecture, sizes
    unit, gyroscope, channel = (np.arange(n) for n in (a.hidden, a.gyroscopes, a.channels))
    feature = np.add.outer(np.arange(a.pooled) * s["channels"], channel).ravel()
    tap, sample = np.divmod(np.arange(a.kernel), a.stride)
    kernel = np.add.outer(gyroscope * a.stride, tap * s["width"] + sample)
    return {
        "hidden.weight": (np.add.outer(unit * s["features"], feature), s["hidden"] * s["features"]),
        "hidden.bias": (unit, s["hidden"]),
        "output.weight": (np.add.outer(gyroscope * s["hidden"], unit), a.gyroscopes * s["hidden"]),
        "output.bias": (gyroscope, _up(a.gyroscopes, CACHE_LINE)),
        "convolution.weight": (
            np.add.outer(channel * s["span"], kernel),
            s["channels"] * s["span"],
        ),
        "convolution.bias": (channel, s["channels"]),
    }


def _up(size: int, multiple: int) -> int:
    return -(-size // multiple) * multiple


def _check_array(name: str, array: np.ndarray, shape: tuple[int, ...]) -> None:
    if array.shape != shape or array.dtype != np.float32 or not array.flags.c_contiguous:
        raise ValueError(
            f"{name}: expected contiguous float32 of shape {shape}, "
            f"got {array.dtype} of shape {array.shape}"
        )


@functools.cache
def _library() -> ctypes.CDLL:
    """The compiled step, from the cache if possible."""
    compiler = _compiler()
    native, described = _native(compiler)
    command = [*compiler, *_FLAGS.split(), *native]
    parts = [SOURCE.read_bytes(), " ".join(command).encode(), described]
    key = hashlib.sha256(b"\0".join(parts)).hexdigest()
    name = f"fused-{key[:16]}"
    path = _compiled(name) or _compile(command, name)
    library = ctypes.CDLL(str(path))  # releases the interpreter lock while it runs
    library.fused_epoch.restype = ctypes.c_double
    library.fused_epoch.argtypes = [
        *(ctypes.POINTER(_Engine), ctypes.c_void_p),
        *(ctypes.c_int64, ctypes.c_int64, ctypes.c_int64, ctypes.c_double),
    ]
    return library


def _compiled(name: str) -> Path | None:
    """The cached step if it belongs to this user and is undamaged, since its code will run."""
    for path in _cache().glob(f"{name}-*.so"):
        owned = not hasattr(os, "getuid") or path.stat().st_uid == os.getuid()
        if owned and path.stem == f"{name}-{_digest(path)}":
            return path
        logger.warning("%s is damaged or another user's: the step is compiled again", path)
        if owned:
            path.unlink(missing_ok=True)
    return None


def _digest(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()[:16]


def _compiler() -> list[str]:
    """``$CC``, which may have arguments, or the first of cc, gcc and clang."""
    configured = os.environ.get("CC", "").split()
    for command in [configured] if configured else [["cc"], ["gcc"], ["clang"]]:
        if shutil.which(command[0]):
            return command
    raise RuntimeError(f"no C compiler: {' '.join(configured) or 'cc, gcc or clang'} not found")


def _native(compiler: list[str]) -> tuple[list[str], bytes]:
    """Flags for this processor, and the macros of the compiler: its version and instructions.

    The macros are part of the cache key, so another processor or compiler compiles the step again.
    """
    for flag in _NATIVE:
        command = [*compiler, *flag.split(), "-dM", "-E", "-x", "c", "-"]
        done = _run(command)
        if done.returncode == 0:
            return flag.split(), done.stdout
    raise RuntimeError(_failure(command, done))


def _compile(command: list[str], name: str) -> Path:
    """Compile into a temporary folder first, since other processes may do the same."""
    cache = _cache()
    cache.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=cache) as folder:
        library = Path(folder) / "step.so"
        command = [*command, str(SOURCE), "-lm", "-o", str(library)]
        done = _run(command)
        if done.returncode != 0:
            raise RuntimeError(_failure(command, done))
        return library.replace(cache / f"{name}-{_digest(library)}.so")


def _run(command: list[str]) -> subprocess.CompletedProcess[bytes]:
    return subprocess.run(command, input=b"", capture_output=True, timeout=_TIMEOUT_S, check=False)


def _failure(command: list[str], done: subprocess.CompletedProcess[bytes]) -> str:
    lines = done.stderr.decode(errors="replace").splitlines() or [f"status {done.returncode}"]
    message = next((line for line in lines if "error" in line), lines[-1])
    return f"{' '.join(command)}: {message.strip()}"


def _cache() -> Path:
    if folder := os.environ.get(_CACHE):
        return Path(folder)
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "gyro_pipeline"


def _check() -> None:
    """Train a small network that runs all of the code, and compare it with PyTorch."""
    a = Architecture(gyroscopes=3, window=157, channels=19, kernel=19, stride=7, pool=3, hidden=18)
    random = np.random.default_rng(0)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        network, got = (CalibrationNetwork(**vars(a)) for _ in range(2))
    inputs = random.normal(size=(11, *packed_shape(a))).astype(np.float32)
    targets = random.normal(size=(11, a.gyroscopes)).astype(np.float32)
    engine = FusedEngine(network, inputs, targets, batch_size=4)
    engine.epoch(np.arange(11), learning_rate=1e-3)
    engine.load_into(got)
    reference = TorchEngine(network, inputs, targets, batch_size=4)
    reference.epoch(np.arange(11), learning_rate=1e-3)
    for name, expected in network.state_dict().items():
        if not torch.allclose(got.state_dict()[name], expected, rtol=0, atol=1e-5):
            raise RuntimeError(f"after compilation {name} differs from PyTorch's")
