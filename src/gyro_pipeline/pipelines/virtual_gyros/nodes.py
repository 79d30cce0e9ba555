"""Nodes of the virtual-gyroscopes stage."""

import zlib

import numpy as np
import pandas as pd
import xarray as xr

from gyro_pipeline.conventions import AXES, DIMENSIONS, MDPS, TRAIN, InputError
from gyro_pipeline.fingerprints import data_hash
from gyro_pipeline.parameters import VirtualGyros
from gyro_pipeline.physics.bias import recording_mean
from gyro_pipeline.recordings import common_length


def synthesise(
    recordings: xr.Dataset, bias: pd.DataFrame, virtual_gyros: VirtualGyros
) -> xr.Dataset:
    """Simulate virtual gyroscopes like the real ones in training (paper, section IV-A).

    Each has a bias, drawn uniformly between the smallest and the largest measured one, and in every
    recording white noise with the sample sigma of the real gyroscopes.

    Args:
        recordings: Real recordings, with their rate, common length and ``split``.
        bias: Ground truth of the real recordings, of which training recordings are used.
        virtual_gyros: Counts, turn-on jitter and seed.

    Returns:
        Recordings in the layout of the real ones, with ``recording_mean`` (imu, recording, axis).
        The attribute ``train_recordings`` is the number of recordings of each IMU that train, and
        ``drawn_from`` lists the real recordings that biases and noise were drawn from.

    Raises:
        InputError: If the split is a k-fold: each fold would need gyroscopes of its own.
    """
    sensor = recordings.attrs["sensor"]
    if "split" not in recordings.coords:
        raise InputError(
            f"{sensor}: virtual gyroscopes need a hold-out, got {recordings.sizes['recording']} "
            "recordings, so few that they make a k-fold; set virtual_gyros to 0 in this study"
        )
    drawn_from = recordings.recording[recordings.split == TRAIN].to_numpy()
    training = bias[bias.recording.isin(drawn_from)]
    sigma = np.sqrt(np.mean(training.sample_sigma_dps**2))
    generator = np.random.default_rng([virtual_gyros.seed, zlib.crc32(sensor.encode())])
    shape = (virtual_gyros.imus, virtual_gyros.recordings, len(AXES))
    limits = training.bias_dps.min(), training.bias_dps.max()
    unit_bias = generator.uniform(*limits, size=(shape[0], 1, shape[2]))
    jitter = generator.standard_normal(shape) * virtual_gyros.turn_on_jitter_mdps * MDPS
    samples = generator.standard_normal((*shape, common_length(recordings)), dtype=np.float32)
    samples *= np.float32(sigma)
    samples += (unit_bias + jitter)[..., None].astype(np.float32)
    labels = {"imu": np.arange(1, shape[0] + 1), "recording": np.arange(1, shape[1] + 1)}
    return xr.Dataset(
        {
            "angular_rate": (DIMENSIONS, samples),
            "samples": (DIMENSIONS[:2], np.full(shape[:2], samples.shape[-1])),
            "recording_mean": (DIMENSIONS[:-1], recording_mean(samples)),
        },
        coords=labels | {"axis": list(AXES)},
        attrs={
            "sensor": sensor,
            "source": recordings.attrs["source"],
            "simulated": 1,
            "rate_hz": recordings.attrs["rate_hz"],
            "train_recordings": virtual_gyros.train_recordings,
            "drawn_from": drawn_from,
            "data_hash": data_hash(samples, [sensor, "virtual"]),
        },
    )
