"""Scaled training examples from recordings, of which few are in memory at a time."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
import pandas as pd
import xarray as xr

from gyro_pipeline.conventions import InputError
from gyro_pipeline.learning.packing import Layout, aligned_zeros
from gyro_pipeline.physics.bias import windows_at

_READ_AT_ONCE = 16
"""Number of recordings: enough for fast access to the file, few enough for the memory."""


@dataclass(frozen=True)
class NetworkInput:
    """IMUs side by side as one input of the network, and their windows.

    Attributes:
        recordings: ``angular_rate`` (imu, recording, axis, sample), of one length, NaN where
            masked; may be backed by a file.
        imus: The IMUs side by side; a single one for Method 2.
        numbers: Numbers of the recordings.
        biases: Biases of the recordings, shape (recordings, gyroscopes), deg/s.
        starts: First samples of the windows of each recording, which may overlap.
    """

    recordings: xr.DataArray
    imus: tuple[int, ...]
    numbers: tuple[int, ...]
    biases: np.ndarray
    starts: tuple[np.ndarray, ...]

    @property
    def windows(self) -> int:
        """Number of windows."""
        return sum(map(len, self.starts))

    def samples(self) -> Iterator[np.ndarray]:
        """The recordings one by one, shape (gyroscopes, samples), deg/s."""
        rows = self.recordings.get_index("recording").get_indexer(pd.Index(self.numbers))
        imus = self.recordings.get_index("imu").get_indexer(pd.Index(self.imus))
        for first in range(0, len(rows), _READ_AT_ONCE):
            batch = rows[first : first + _READ_AT_ONCE]
            # reading a range is far faster than reading single recordings
            part = self.recordings.isel(imu=_around(imus), recording=_around(batch)).load()
            samples = part.transpose("recording", "imu", "axis", "sample").to_numpy()
            for row in batch - batch.min():
                yield samples[row, imus - imus.min()].reshape(-1, samples.shape[-1])


def with_shuffled_labels(device: NetworkInput, generator: np.random.Generator) -> NetworkInput:
    """The device with its biases permuted between recordings: a leak detector.

    Each gyroscope is permuted independently. Windows then say nothing about their bias, and only
    the constant of the device can be learned. A network that is better than that on test recordings
    has information about them.
    """
    return replace(device, biases=generator.permuted(device.biases.T, axis=-1).T)


@dataclass(frozen=True)
class Scaling:
    """Scaling fitted to training data only: the network sees (x - centre) / scale.

    One scale for all gyroscopes keeps the paper's loss, the mean squared error in deg/s, up to a
    constant factor.

    Attributes:
        centres: Values subtracted from inputs and targets, by device, (gyroscopes,), deg/s.
        input_scale: Root mean square of the centred samples, deg/s.
        target_scale: Root mean square of the centred biases, deg/s.
    """

    centres: list[np.ndarray]
    input_scale: float
    target_scale: float


@dataclass(frozen=True)
class Examples:
    """Scaled examples: inputs (n, *layout's shape) and targets (n, gyroscopes), float32."""

    inputs: np.ndarray
    targets: np.ndarray


def device_centres(devices: Sequence[NetworkInput], centring: str) -> list[np.ndarray]:
    """The centres of devices: the means of their gyroscopes, or one mean for all.

    Args:
        devices: Training devices.
        centring: ``per_device`` or ``global``.

    Returns:
        Shape (gyroscopes,) for each device, deg/s.
    """
    means = [device.biases.mean(axis=0) for device in devices]
    if centring == "per_device":
        return means
    weights = [len(device.numbers) for device in devices]
    overall = np.average([mean.mean() for mean in means], weights=weights)
    return [np.full_like(mean, overall) for mean in means]


def training_examples(
    devices: Sequence[NetworkInput], layout: Layout, centring: str
) -> tuple[Examples, Scaling]:
    """All windows of the training devices, scaled, with the scaling fitted to them."""
    centres = device_centres(devices, centring)
    examples = _centred(devices, centres, layout)
    input_scale = _root_mean_square(examples.inputs, layout)
    if not np.isfinite(input_scale):
        raise InputError("training samples are not all finite; repair or leave out a recording")
    target_scale = float(np.sqrt(np.mean(np.square(examples.targets, dtype=np.float64))))
    if not target_scale > 0:
        raise InputError(
            "training targets do not differ from their centre, so there is nothing to learn; with "
            "centring per_device at least two training recordings are needed"
        )
    examples.inputs[...] /= input_scale
    examples.targets[...] /= target_scale
    return examples, Scaling(centres, input_scale, target_scale)


def scaled_examples(device: NetworkInput, layout: Layout, scaling: Scaling) -> Examples:
    """Windows of other recordings of the first training device, scaled as in training."""
    examples = _centred([device], scaling.centres[:1], layout)
    examples.inputs[...] /= scaling.input_scale
    examples.targets[...] /= scaling.target_scale
    return examples


def _centred(
    devices: Sequence[NetworkInput], centres: Sequence[np.ndarray], layout: Layout
) -> Examples:
    n = sum(device.windows for device in devices)
    inputs = aligned_zeros((n, *layout.shape))
    targets = np.empty((n, layout.gyroscopes), np.float32)
    start = 0
    for device, centre in zip(devices, centres, strict=True):
        recordings = zip(device.samples(), device.biases, device.starts, strict=True)
        for samples, bias, starts in recordings:
            centred = samples - centre[:, None].astype(np.float32)
            rows = slice(start, start + len(starts))
            windows = windows_at(centred, layout.window, starts)
            layout.write(windows, inputs[rows])
            targets[rows] = bias - centre
            start = rows.stop
    return Examples(inputs, targets)


def _around(positions: np.ndarray) -> slice:
    """The smallest slice with all of the positions."""
    return slice(int(positions.min()), int(positions.max()) + 1)


def _root_mean_square(inputs: np.ndarray, layout: Layout) -> float:
    """Root mean square of samples, without the zeros that pad them."""
    squares = sum(float(np.vdot(window, window)) for window in inputs)
    return float(np.sqrt(squares / (len(inputs) * layout.samples)))
