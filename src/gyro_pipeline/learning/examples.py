"""From recordings to scaled training examples, few recordings in memory at a time."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
import pandas as pd
import xarray as xr

from gyro_pipeline.conventions import InputError
from gyro_pipeline.learning.packing import Layout, aligned_zeros
from gyro_pipeline.physics.bias import windows_at

_READ_AT_ONCE = 16
"""Recordings: enough that finding them in the file costs little, few enough to hold."""


@dataclass(frozen=True)
class Device:
    """IMUs seen side by side as one input of the network, and their windows to use.

    Attributes:
        recordings: ``angular_rate`` (imu, recording, axis, sample), of one length, NaN where
            masked; may be backed by a file.
        imus: The IMUs side by side, one for Method 2.
        numbers: Recording numbers to use.
        biases: Biases of these recordings, shape (recordings, gyroscopes), deg/s.
        starts: First samples of the windows to use of each recording, which may overlap.
    """

    recordings: xr.DataArray
    imus: tuple[int, ...]
    numbers: tuple[int, ...]
    biases: np.ndarray
    starts: tuple[np.ndarray, ...]

    @property
    def windows(self) -> int:
        """How many windows are used."""
        return sum(map(len, self.starts))

    def samples(self) -> Iterator[np.ndarray]:
        """The recordings one by one, shape (gyroscopes, samples), deg/s."""
        rows = self.recordings.get_index("recording").get_indexer(pd.Index(self.numbers))
        imus = self.recordings.get_index("imu").get_indexer(pd.Index(self.imus))
        for first in range(0, len(rows), _READ_AT_ONCE):
            wanted = rows[first : first + _READ_AT_ONCE]
            # what lies between them as well, as single ones are found far more slowly
            part = self.recordings.isel(imu=_around(imus), recording=_around(wanted)).load()
            read = part.transpose("recording", "imu", "axis", "sample").to_numpy()
            for row in wanted - wanted.min():
                yield read[row, imus - imus.min()].reshape(-1, read.shape[-1])


def with_shuffled_labels(device: Device, generator: np.random.Generator) -> Device:
    """The device with its biases permuted between the recordings used: a leak detector.

    Each gyroscope is permuted on its own. What a window says about its bias is then lost, and all
    that is left to learn is the device's constant. A network that does better on test recordings
    has seen something of them.
    """
    return replace(device, biases=generator.permuted(device.biases.T, axis=-1).T)


@dataclass(frozen=True)
class Scaling:
    """Fitted on training data only: the network sees (x - centre) / scale.

    One scale for all gyroscopes keeps the paper's loss, the mean squared error in deg/s, up to a
    constant factor.

    Attributes:
        centres: Subtracted from each device's gyroscopes, inputs and targets, deg/s.
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


def device_centres(devices: Sequence[Device], centring: str) -> list[np.ndarray]:
    """What to subtract from each device: its own gyroscopes' means, or one mean for all.

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
    devices: Sequence[Device], layout: Layout, centring: str
) -> tuple[Examples, Scaling]:
    """All windows of the training devices, and the scaling that they fix."""
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


def scaled_examples(device: Device, layout: Layout, scaling: Scaling) -> Examples:
    """Windows of other recordings of the first training device, scaled as in training."""
    examples = _centred([device], scaling.centres[:1], layout)
    examples.inputs[...] /= scaling.input_scale
    examples.targets[...] /= scaling.target_scale
    return examples


def _centred(devices: Sequence[Device], centres: Sequence[np.ndarray], layout: Layout) -> Examples:
    n = sum(device.windows for device in devices)
    inputs = aligned_zeros((n, *layout.shape))
    targets = np.empty((n, layout.gyroscopes), np.float32)
    start = 0
    for device, centre in zip(devices, centres, strict=True):
        used = zip(device.samples(), device.biases, device.starts, strict=True)
        for samples, bias, starts in used:
            centred = samples - centre[:, None].astype(np.float32)
            rows = slice(start, start + len(starts))
            windows = windows_at(centred, layout.window, starts)
            layout.write(windows, inputs[rows])
            targets[rows] = bias - centre
            start = rows.stop
    return Examples(inputs, targets)


def _around(positions: np.ndarray) -> slice:
    return slice(int(positions.min()), int(positions.max()) + 1)


def _root_mean_square(inputs: np.ndarray, layout: Layout) -> float:
    """Over samples, not over the zeros that pad them."""
    squares = sum(float(np.vdot(window, window)) for window in inputs)
    return float(np.sqrt(squares / (len(inputs) * layout.samples)))
