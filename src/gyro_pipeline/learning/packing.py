"""Windows packed for training: a row is a block of ``stride`` samples of all gyroscopes.

In this layout the strided convolution over samples becomes a convolution with stride 1 over blocks,
whose samples are channels and adjacent in memory. The numbers are the same, padded with zeros; the
more the kernel overlaps itself, the larger the gain in speed.
"""

import math
from dataclasses import dataclass

import numpy as np

from gyro_pipeline.learning.network import Architecture

CACHE_LINE = 16
"""Floats in a cache line and in the widest registers. Rows are padded to a multiple of it."""


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
    """Memory layout of windows: packed for the paper's network, plain for any other.

    Attributes:
        gyroscopes: Channels of a window.
        window: Samples of a window.
        packed: Sizes of the paper's network; None for any other.
    """

    gyroscopes: int
    window: int
    packed: Architecture | None = None

    @property
    def shape(self) -> tuple[int, int]:
        """Shape of one window."""
        return packed_shape(self.packed) if self.packed else (self.gyroscopes, self.window)

    @property
    def samples(self) -> int:
        """Number of samples of a window that the network sees, of all gyroscopes."""
        covered = self.shape[0] * self.packed.stride if self.packed else self.window
        return self.gyroscopes * min(self.window, covered)

    def write(self, windows: np.ndarray, out: np.ndarray) -> None:
        """Write windows (gyroscopes, n, window) into zeros of shape (n, *shape)."""
        if self.packed:
            pack(windows, self.packed, out)
        else:
            out[...] = windows.transpose(1, 0, 2)


def aligned_zeros(shape: tuple[int, ...]) -> np.ndarray:
    """Float32 zeros aligned to a cache line, so that a register is filled from only one."""
    size = math.prod(shape)
    buffer = np.zeros(size + CACHE_LINE, np.float32)
    start = -(buffer.ctypes.data // buffer.itemsize) % CACHE_LINE
    return buffer[start : start + size].reshape(shape)
