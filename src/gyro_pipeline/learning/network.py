"""The paper's network (section III-D), for plain windows or windows packed for speed."""

from dataclasses import dataclass
from functools import wraps

from torch import Tensor, nn
from torch.nn import functional

from gyro_pipeline.conventions import InputError

SLOPE = 0.1
"""Negative slope of the LeakyReLU (paper, section III-D)."""


@dataclass(frozen=True)
class Architecture:
    """Sizes of the network; the paper leaves all but the first two open."""

    gyroscopes: int
    window: int
    channels: int
    kernel: int
    stride: int
    pool: int
    hidden: int

    def __post_init__(self) -> None:
        """Refuse windows that are too short for the pooling.

        Raises:
            InputError: It names the sizes.
        """
        if self.window < self.kernel or self.pooled < 1:
            raise InputError(
                f"a window of {self.window} samples is too short for kernel {self.kernel}, stride "
                f"{self.stride} and pool {self.pool}; choose smaller ones under training"
            )

    @property
    def convolved(self) -> int:
        """Outputs of the convolution, per channel."""
        return (self.window - self.kernel) // self.stride + 1

    @property
    def pooled(self) -> int:
        """Outputs of the pooling, per channel."""
        return self.convolved // self.pool


class CalibrationNetwork(nn.Module):
    """The paper's network: convolution, LeakyReLU, max-pool, flatten, linear, LeakyReLU, linear.

    LeakyReLU is monotonic, so it may follow the pooling, where it has only a quarter of the values;
    and features are flattened time by time, which needs no copy for packed windows. Neither changes
    the function that the network computes.
    """

    def __init__(  # noqa: PLR0917 - sizes that the paper leaves open
        self,
        gyroscopes: int,
        window: int,
        channels: int,
        kernel: int,
        stride: int,
        pool: int,
        hidden: int,
    ) -> None:
        super().__init__()
        a = Architecture(gyroscopes, window, channels, kernel, stride, pool, hidden)
        self.architecture = a
        self.convolution = nn.Conv1d(a.gyroscopes, a.channels, a.kernel, a.stride)
        self.hidden = nn.Linear(a.pooled * a.channels, a.hidden)
        self.output = nn.Linear(a.hidden, a.gyroscopes)

    def forward(self, windows: Tensor) -> Tensor:
        """Biases of plain windows.

        Args:
            windows: Shape (n, gyroscopes, window), scaled.

        Returns:
            Shape (n, gyroscopes), scaled.
        """
        convolved = self.convolution(windows)  # (n, channels, convolved)
        pooled = functional.max_pool1d(convolved, self.architecture.pool)
        return self._head(pooled.transpose(1, 2))

    def forward_packed(self, packed: Tensor) -> Tensor:
        """Biases of windows from :func:`gyro_pipeline.learning.packing.pack`, several times faster.

        Args:
            packed: Shape (n, blocks, width), scaled.

        Returns:
            Shape (n, gyroscopes), scaled.
        """
        a = self.architecture
        taps, width = -(-a.kernel // a.stride), packed.shape[2]
        # (channels, gyroscopes, kernel) -> (channels, width, 1, taps): one tap is one block.
        weight = functional.pad(self.convolution.weight, (0, taps * a.stride - a.kernel))
        weight = weight.unflatten(2, (taps, a.stride)).permute(0, 1, 3, 2).flatten(1, 2)
        weight = functional.pad(weight, (0, 0, 0, width - weight.shape[1])).unsqueeze(2)
        # Time is the image's row, since kernels work on several outputs of one row at once.
        image = packed.unsqueeze(1).permute(0, 3, 1, 2)  # (n, width, 1, blocks), channels last
        convolved = functional.conv2d(image, weight, self.convolution.bias)
        pooled = functional.max_pool2d(convolved, (1, a.pool))  # (n, channels, 1, pooled)
        return self._head(pooled.squeeze(2).transpose(1, 2))

    def _head(self, pooled: Tensor) -> Tensor:
        features = functional.leaky_relu(pooled, SLOPE).flatten(1)  # (n, pooled * channels)
        return self.output(functional.leaky_relu(self.hidden(features), SLOPE))


class SingleGyroscope(nn.Module):
    """The paper's network with one input channel and one bias, shared by all gyroscopes.

    The paper compares itself with such a predecessor (Engelsman & Klein, arXiv 2210.04568). Its
    layers are unknown to us, so they are those of the paper's network here.
    """

    @wraps(CalibrationNetwork.__init__)  # type: ignore[misc]
    def __init__(self, gyroscopes: int, window: int, **sizes: int) -> None:
        super().__init__()
        self.network = CalibrationNetwork(1, window, **sizes)

    def forward(self, windows: Tensor) -> Tensor:
        """Biases of windows (n, gyroscopes, window), each from the samples of its gyroscope."""
        single = windows.flatten(0, 1).unsqueeze(1)
        return self.network(single).reshape(windows.shape[:2])
