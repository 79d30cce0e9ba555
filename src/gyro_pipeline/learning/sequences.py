"""Networks whose input is the sequence of block means of a window."""

import math

from torch import Tensor, nn
from torch.nn import functional

from gyro_pipeline.learning.network import SLOPE


class BlockMeans(nn.Module):
    """Block means, scaled so that white noise keeps its variance; an incomplete block is cut off.

    Training on sequences of all samples would take hours.

    Args:
        window: Samples of a window.
        rate_hz: Samples per second.
        block_s: Length of a block, seconds.
    """

    def __init__(self, window: int, rate_hz: float, block_s: float) -> None:
        super().__init__()
        self.size = min(window, max(1, round(block_s * rate_hz)))

    def forward(self, windows: Tensor) -> Tensor:
        """(n, gyroscopes, window) to (n, gyroscopes, blocks)."""
        return functional.avg_pool1d(windows, self.size) * math.sqrt(self.size)


class LSTM(nn.Module):
    """A long short-term memory whose last output is mapped linearly to the biases.

    Args:
        gyroscopes: Channels of a window.
        window: Samples of a window.
        rate_hz: Samples per second.
        units: Units of each layer.
        layers: Number of layers.
        block_s: See :class:`BlockMeans`.
    """

    def __init__(  # noqa: PLR0917 - its options
        self,
        gyroscopes: int,
        window: int,
        rate_hz: float,
        units: int = 32,
        layers: int = 1,
        block_s: float = 0.1,
    ) -> None:
        super().__init__()
        self.blocks = BlockMeans(window, rate_hz, block_s)
        self.memory = nn.LSTM(gyroscopes, units, layers, batch_first=True)
        self.output = nn.Linear(units, gyroscopes)

    def forward(self, windows: Tensor) -> Tensor:
        """(n, gyroscopes, window) to (n, gyroscopes)."""
        outputs, _ = self.memory(self.blocks(windows).transpose(1, 2))
        return self.output(outputs[:, -1])


class TCN(nn.Module):
    """A temporal convolutional network (Bai, Kolter & Koltun 2018, arXiv 1803.01271).

    Every level has two causal convolutions and a residual connection, and twice the dilation of the
    level before; the last time step is mapped linearly to the biases. There is no dropout.

    Args:
        gyroscopes, window, rate_hz, block_s: See :class:`LSTM`.
        filters: Channels of every level.
        taps: Kernel size of every convolution.
        levels: Number of levels; the taps of the last one are ``2 ** (levels - 1)`` blocks apart.
    """

    def __init__(  # noqa: PLR0917 - its options
        self,
        gyroscopes: int,
        window: int,
        rate_hz: float,
        block_s: float = 0.1,
        filters: int = 16,
        taps: int = 3,
        levels: int = 5,
    ) -> None:
        super().__init__()
        self.blocks = BlockMeans(window, rate_hz, block_s)
        self.input = nn.Conv1d(gyroscopes, filters, 1)
        self.convolutions = nn.ModuleList(
            nn.Conv1d(filters, filters, taps, dilation=2**level)
            for level in range(levels)
            for _ in range(2)
        )
        self.output = nn.Linear(filters, gyroscopes)

    def forward(self, windows: Tensor) -> Tensor:
        """(n, gyroscopes, window) to (n, gyroscopes)."""
        values = self.input(self.blocks(windows))
        for first, second in zip(self.convolutions[::2], self.convolutions[1::2], strict=True):
            values = values + _causal(second, _causal(first, values))
        return self.output(values[:, :, -1])


def _causal(convolution: nn.Module, values: Tensor) -> Tensor:
    """Outputs of a causal convolution, which see no later values."""
    assert isinstance(convolution, nn.Conv1d)
    before = (convolution.kernel_size[0] - 1) * convolution.dilation[0]
    return functional.leaky_relu(convolution(functional.pad(values, (before, 0))), SLOPE)
