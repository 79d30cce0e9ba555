"""Windows packed for training: one block of ``stride`` samples of all gyroscopes per row.

In this layout the strided convolution over samples becomes one with stride 1 over blocks, with
the samples of a block as channels that lie side by side in memory. It holds the same numbers,
padded with zeros, and is faster the more the kernel overlaps itself.
"""

import math
from dataclasses import dataclass

import numpy as np

from gyro_pipeline.learning.network import Architecture

CACHE_LINE = 16
"""Floats of one; as many as the widest registers hold. Rows are padded to a multiple of it."""


def packed_shape(architecture: Architecture) -> tuple[int, int]:
    """Blocks and width of one packed window."""
    a = architecture
    blocks = a.convolved - 1 + -(-a.kernel // a.stride)
    return blocks, -(-a.gyroscopes * a.stride // CACHE_LINE) * CACHE_LINE


def pack(
    windows: np.ndarray, architecture: Architecture, out: np.ndarray | None = None
) -> np.ndarray:
    """Pack windows; samples that no convolution output sees are left out.

    Args:
        windows: Shape (gyroscopes, n, window), as cut from a recording.
        architecture: The network's sizes.
        out: Zeros of shape (n, blocks, width), float32, to write into.

    Returns:
        ``out``.
    """
    a = architecture
    gyroscopes, n, _ = windows.shape
    blocks, width = packed_shape(a)
    if out is None:
        out = aligned_zeros((n, blocks, width))
    # (n, blocks, gyroscopes, stride) view of the used part of each row
    cells = out[:, :, : gyroscopes * a.stride].reshape(n, blocks, gyroscopes, a.stride)
    full = min(a.window // a.stride, blocks)
    whole = windows[:, :, : full * a.stride].reshape(gyroscopes, n, full, a.stride)
    cells[:, :full] = whole.transpose(1, 2, 0, 3)
    if full < blocks:  # the last block is cut short by the window's end
        rest = windows[:, :, full * a.stride :]
        cells[:, full, :, : rest.shape[2]] = rest.transpose(1, 0, 2)
    return out


@dataclass(frozen=True)
class Layout:
    """How a network's windows lie in memory: packed for the paper's network, else as they are.

    Attributes:
        gyroscopes: Channels of a window.
        window: Samples.
        packed: Sizes of the paper's network; None of any other.
    """

    gyroscopes: int
    window: int
    packed: Architecture | None = None

    @property
    def shape(self) -> tuple[int, int]:
        """Of one window."""
        return packed_shape(self.packed) if self.packed else (self.gyroscopes, self.window)

    @property
    def samples(self) -> int:
        """How many of a window's samples the network sees, of all gyroscopes."""
        seen = self.shape[0] * self.packed.stride if self.packed else self.window
        return self.gyroscopes * min(self.window, seen)

    def write(self, windows: np.ndarray, out: np.ndarray) -> None:
        """Write windows (gyroscopes, n, window) into zeros of shape (n, *shape)."""
        if self.packed:
            pack(windows, self.packed, out)
        else:
            out[...] = windows.transpose(1, 0, 2)


def aligned_zeros(shape: tuple[int, ...]) -> np.ndarray:
    """Float32 zeros that start with a cache line, so that no register is filled from two."""
    size = math.prod(shape)
    room = np.zeros(size + CACHE_LINE, np.float32)
    start = -(room.ctypes.data // room.itemsize) % CACHE_LINE
    return room[start : start + size].reshape(shape)
