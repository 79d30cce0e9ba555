"""The training step in C, for one thread of a CPU: the packed path's results, several times faster.

The source, ``fused.c``, is compiled at first use by the system's C compiler into the user's cache.
Without a compiler nothing is lost but time: :func:`available` says no and training runs in PyTorch.
"""

import ctypes
import functools
import hashlib
import logging
import os
import shlex
import shutil
import subprocess
import tempfile
from ctypes import c_double, c_int64, c_void_p
from importlib import resources
from pathlib import Path

import numpy as np
import torch
from torch.nn import functional

from gyro_pipeline.learning.network import Architecture, CalibrationNetwork
from gyro_pipeline.learning.packing import packed_shape

logger = logging.getLogger(__name__)

_CACHE = "GYRO_PIPELINE_CACHE"
# Without -ffast-math: with it gcc links code that flushes denormals to zero in the whole process,
# and a loss that is not a number could pass for one.
_FLAGS = "-std=gnu11 -O3 -ffp-contract=fast -fno-math-errno -fno-trapping-math -shared -fPIC"
_NATIVE = ("-march=native", "-mcpu=native", "")
"""What compilers call this machine's processor; the last compiles for any."""
_LINE = 16
"""Floats of a cache line."""
_TIMEOUT_S = 120


@functools.cache
def available() -> bool:
    """Whether the fused step can be used here; if not, the reason is logged once."""
    try:
        _check()
    except (OSError, RuntimeError, subprocess.SubprocessError) as reason:
        logger.info("training in PyTorch, without the several times faster C step: %s", reason)
        return False
    return True


class FusedEngine:
    """The training of one network on one set of examples, with the state of its optimiser."""

    def __init__(
        self, network: CalibrationNetwork, inputs: np.ndarray, targets: np.ndarray, batch_size: int
    ) -> None:
        """Start from the network's weights; the network itself is not changed.

        Args:
            network: On the CPU.
            inputs: Packed windows, shape (n, blocks, width), float32, scaled; used where they are.
            targets: Shape (n, gyroscopes), float32, scaled; used where they are.
            batch_size: Examples per step.

        Raises:
            ValueError: If the examples do not fit the network or are not contiguous float32.
            RuntimeError: If the step could not be compiled; ask :func:`available` first.
        """
        a = network.architecture
        _demand("inputs", inputs, (len(inputs), *packed_shape(a)))
        _demand("targets", targets, (len(inputs), a.gyroscopes))
        self._library, self._batch_size, self._steps = _library(), batch_size, 0
        layout = _Layout(a)
        self._index = layout.index
        self._weights = _aligned(layout.floats)
        for name, value in network.state_dict().items():
            self._weights[self._index[name]] = value.numpy()
        self._engine = _Engine(**layout.sizes)
        scratch = self._library.fused_plan(self._engine, min(batch_size, len(inputs)))
        self._arrays = {
            "inputs": inputs,
            "targets": targets,
            "seen": layout.seen,
            "weights": self._weights,
            **{name: _aligned(layout.floats) for name in ("mean", "square", "gradient")},
            "scratch": _aligned(scratch),
        }
        for name, array in self._arrays.items():
            setattr(self._engine, name, array.ctypes.data)

    def epoch(self, order: np.ndarray, learning_rate: float) -> float:
        """Train on examples in this order, in batches; the last one may be smaller.

        Args:
            order: Indices of examples.
            learning_rate: Adam's.

        Returns:
            Mean squared error over these examples, each as it was before its batch's step.

        Raises:
            IndexError: If there is no example of some index, or no index.
        """
        order = np.ascontiguousarray(order, np.int64)
        examples, gyroscopes = self._arrays["targets"].shape
        if not (order.size and 0 <= order.min() and order.max() < examples):
            raise IndexError(f"order: expected indices from 0 to {examples - 1}, got {order}")
        total: float = self._library.fused_epoch(
            self._engine, order.ctypes.data, order.size, self._batch_size, self._steps, learning_rate
        )
        self._steps += -(-order.size // self._batch_size)
        return total / (order.size * gyroscopes)

    @torch.no_grad()
    def load_into(self, network: CalibrationNetwork) -> None:
        """Copy the weights as they are now into a network of the same architecture."""
        for name, value in network.state_dict().items():
            value.copy_(torch.from_numpy(self._weights[self._index[name]]))


class _Engine(ctypes.Structure):
    """``Engine`` in fused.c."""

    _fields_ = [
        *((name, c_int64) for name in "gyroscopes blocks width span channels".split()),
        *((name, c_int64) for name in "pool pooled hidden features tile chunk".split()),
        *((name, c_void_p) for name in "inputs targets seen weights mean square".split()),
        *((name, c_void_p) for name in "gradient scratch".split()),
    ]


class _Layout:
    """Sizes as fused.c wants them, and the place of each parameter in one array of them all."""

    def __init__(self, architecture: Architecture) -> None:
        a = architecture
        blocks, width = packed_shape(a)
        span, channels, hidden = -(-a.kernel // a.stride) * width, _up(a.channels, 8), _up(a.hidden, 16)
        features = _up(a.pooled * channels, 16)
        self.sizes = {
            "gyroscopes": a.gyroscopes,
            "blocks": blocks,
            "width": width,
            "span": span,
            "channels": channels,
            "pool": a.pool,
            "pooled": a.pooled,
            "hidden": hidden,
            "features": features,
        }
        gyroscope, channel, unit = (np.arange(n) for n in (a.gyroscopes, a.channels, a.hidden))
        feature = np.add.outer(np.arange(a.pooled) * channels, channel).ravel()
        tap, sample = np.divmod(np.arange(a.kernel), a.stride)
        kernel = np.add.outer(gyroscope * a.stride, tap * width + sample)
        sections = {  # in the order of Parameters in fused.c, with their padded sizes
            "hidden.weight": (np.add.outer(unit * features, feature), hidden * features),
            "hidden.bias": (unit, hidden),
            "output.weight": (np.add.outer(gyroscope * hidden, unit), a.gyroscopes * hidden),
            "convolution.weight": (np.add.outer(channel * span, kernel), channels * span),
            "convolution.bias": (channel, channels),
            "output.bias": (gyroscope, _up(a.gyroscopes, 8)),
        }
        self.floats = 0
        self.index = {}
        for name, (places, floats) in sections.items():
            self.index[name] = self.floats + places
            self.floats += floats
        self.seen = _aligned(span)
        self.seen[kernel] = 1


def _up(size: int, multiple: int) -> int:
    return -(-size // multiple) * multiple


def _aligned(floats: int) -> np.ndarray:
    """Zeros that start with a cache line."""
    room = np.zeros(floats + _LINE, np.float32)
    start = -room.ctypes.data // room.itemsize % _LINE
    return room[start : start + floats]


def _demand(name: str, array: np.ndarray, shape: tuple[int, ...]) -> None:
    if array.shape != shape or array.dtype != np.float32 or not array.flags.c_contiguous:
        raise ValueError(
            f"{name}: expected contiguous float32 of shape {shape}, "
            f"got {array.dtype} of shape {array.shape}"
        )


@functools.cache
def _library() -> ctypes.CDLL:
    """The compiled step, from the cache where it is there."""
    source = resources.files(__package__).joinpath("fused.c").read_bytes()
    compiler = _compiler()
    native, described = _native(compiler)
    command = [*compiler, *_FLAGS.split(), *native]
    key = hashlib.sha256(b"\0".join([source, *map(str.encode, command), described])).hexdigest()
    path = _cache() / f"fused-{key[:16]}.so"
    if not path.exists():
        _compile(command, source, path)
    library = ctypes.CDLL(str(path))
    library.fused_plan.argtypes = [ctypes.POINTER(_Engine), c_int64]
    library.fused_plan.restype = c_int64
    library.fused_epoch.argtypes = [
        *(ctypes.POINTER(_Engine), c_void_p, c_int64, c_int64, c_int64, c_double),
    ]
    library.fused_epoch.restype = c_double
    return library


def _compiler() -> list[str]:
    """``$CC``, which may have arguments, or the first compiler there is."""
    asked = shlex.split(os.environ.get("CC", ""))
    for command in [asked] if asked else [["cc"], ["gcc"], ["clang"]]:
        if shutil.which(command[0]):
            return command
    raise RuntimeError(f"no C compiler: {' '.join(asked) or 'cc, gcc, clang'} not found")


def _native(compiler: list[str]) -> tuple[list[str], bytes]:
    """Flags for this processor, and what the compiler says of it: version and instructions."""
    for flag in _NATIVE:
        command = [*compiler, *flag.split(), "-dM", "-E", "-x", "c", "-"]
        done = _run(command, b"")
        if done.returncode == 0:
            return flag.split(), done.stdout
    raise RuntimeError(f"{' '.join(command)} failed: {_last_line(done)}")


def _compile(command: list[str], source: bytes, path: Path) -> None:
    """Under a name of its own first: another process may do the same at the same time."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=path.parent) as folder:
        made = Path(folder) / path.name
        done = _run([*command, "-x", "c", "-", "-x", "none", "-o", str(made), "-lm"], source)
        if done.returncode != 0:
            raise RuntimeError(f"{' '.join(command)} failed: {_last_line(done)}")
        made.replace(path)


def _run(command: list[str], text: bytes) -> subprocess.CompletedProcess[bytes]:
    return subprocess.run(
        command, input=text, capture_output=True, timeout=_TIMEOUT_S, check=False
    )


def _last_line(done: subprocess.CompletedProcess[bytes]) -> str:
    lines = done.stderr.decode(errors="replace").strip().splitlines()
    return lines[-1] if lines else f"exit status {done.returncode}"


def _cache() -> Path:
    asked = os.environ.get(_CACHE)
    if asked:
        return Path(asked)
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "gyro_pipeline"


def _check() -> None:
    """A few steps of a small network that uses every part of the code, against PyTorch."""
    a = Architecture(3, 157, 19, 7, 3, 3, 18)
    random = np.random.default_rng(0)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        network = CalibrationNetwork(a)
    inputs = random.normal(size=(11, *packed_shape(a))).astype(np.float32)
    targets = random.normal(size=(11, 3)).astype(np.float32)
    engine = FusedEngine(network, inputs, targets, batch_size=4)
    got = [engine.epoch(np.arange(11), 1e-3) for _ in range(2)]
    trained = CalibrationNetwork(a)
    engine.load_into(trained)
    optimizer = torch.optim.Adam(network.parameters(), lr=1e-3)
    examples = torch.from_numpy(inputs), torch.from_numpy(targets)
    for expected in got:
        total = 0.0
        for x, y in zip(*(array.split(4) for array in examples), strict=True):
            loss = functional.mse_loss(network.forward_packed(x), y)
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
            total += float(loss) * len(x) / 11
