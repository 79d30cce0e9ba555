"""Nodes of the ground-truth stage."""

from collections.abc import Callable

import numpy as np
import pandas as pd
import xarray as xr

from gyro_pipeline.conventions import MDPS
from gyro_pipeline.parameters import GroundTruth
from gyro_pipeline.physics.allan import (
    SHORTEST_FIT_SAMPLES,
    allan_variance,
    averaging_times_s,
    fit_noise,
)
from gyro_pipeline.physics.bias import recording_mean, settling_time_s

_KEYS = ["imu", "recording", "axis"]


def measure_allan_variance(recordings: xr.Dataset) -> xr.Dataset:
    """Overlapping Allan variance of every recording and axis.

    Args:
        recordings: Angular rates, deg/s.

    Returns:
        ``allan_variance`` (imu, recording, axis, time_s), (deg/s)^2; NaN for absent recordings.
    """
    rate_hz = recordings.attrs["rate_hz"]
    times_s = averaging_times_s(recordings.sizes["sample"], rate_hz)
    variance = xr.apply_ufunc(
        lambda samples: allan_variance(samples, rate_hz, times_s),
        recordings.angular_rate,
        input_core_dims=[["sample"]],
        output_core_dims=[["time_s"]],
        vectorize=True,
    )
    return variance.assign_coords(time_s=times_s).to_dataset(name="allan_variance")


def measure_bias(
    recordings: xr.Dataset, allan: xr.Dataset, ground_truth: GroundTruth
) -> pd.DataFrame:
    """The ground truth of the paper, the mean of each whole recording, and how good it is.

    Args:
        recordings: Angular rates, deg/s.
        allan: From :func:`measure_allan_variance`.
        ground_truth: The tolerance of the settling time.

    Returns:
        A row per present sensor, imu, recording and axis: ``bias_dps``; its standard error
        N / sqrt(T), ``standard_error_dps``; ``sample_sigma_dps``; and ``settling_time_s``, after
        which the running mean stays within the tolerance.
    """
    samples, rate_hz = recordings.angular_rate, recordings.attrs["rate_hz"]
    duration_s = recordings.sizes["sample"] / rate_hz
    tolerance_dps = ground_truth.tolerance_mdps * MDPS
    white = _noise_figures(allan, duration_s, rate_hz).white
    measured = xr.Dataset(
        {
            "bias_dps": _per_recording(recording_mean, samples),
            "standard_error_dps": white / np.sqrt(duration_s),
            # xarray's own would skip NaN, and round deviations to float32 on the way
            "sample_sigma_dps": _per_recording(
                lambda x: x.std(-1, ddof=1, dtype=np.float64), samples
            ),
            "settling_time_s": _per_recording(
                lambda x: settling_time_s(x, rate_hz, tolerance_dps), samples
            ),
        }
    )
    table = measured.to_dataframe(dim_order=_KEYS).reset_index().dropna(subset="bias_dps")
    columns = ["bias_dps", "standard_error_dps", "sample_sigma_dps", "settling_time_s"]
    table.insert(0, "sensor", recordings.attrs["sensor"])
    return table[["sensor", *_KEYS, *columns]].reset_index(drop=True)


def measure_noise(recordings: xr.Dataset, allan: xr.Dataset, bias: pd.DataFrame) -> pd.DataFrame:
    """Noise of every gyroscope, over all its recordings.

    Args:
        recordings: For their duration.
        allan: From :func:`measure_allan_variance`.
        bias: From :func:`measure_bias`.

    Returns:
        A row per sensor, imu and axis: ``sample_sigma_dps``, ``white_dps_rts`` (N),
        ``instability_dps`` (B) and ``random_walk_dps_per_rts`` (K), by IEEE Std 952.
    """
    rate_hz = recordings.attrs["rate_hz"]
    fitted = _noise_figures(allan, recordings.sizes["sample"] / rate_hz, rate_hz)
    names = {
        "white": "white_dps_rts",
        "instability": "instability_dps",
        "random_walk": "random_walk_dps_per_rts",
    }
    figures = fitted.rename(names).to_dataframe(dim_order=["imu", "axis"])
    squares = bias.assign(square=bias.sample_sigma_dps**2).groupby(["imu", "axis"])["square"]
    figures.insert(0, "sample_sigma_dps", np.sqrt(squares.mean()))
    figures = figures.reset_index()
    figures.insert(0, "sensor", recordings.attrs["sensor"])
    return figures


def _noise_figures(allan: xr.Dataset, duration_s: float, rate_hz: float) -> xr.Dataset:
    """N, B and K by imu and axis, fitted to the mean variance of the recordings."""
    times_s = allan.time_s.to_numpy()

    def fit(variance: np.ndarray) -> tuple[float, float, float]:
        figures = fit_noise(times_s, variance, duration_s, SHORTEST_FIT_SAMPLES / rate_hz)
        return figures.white, figures.instability, figures.random_walk

    fitted = xr.apply_ufunc(
        fit,
        allan.allan_variance.mean("recording"),
        input_core_dims=[["time_s"]],
        output_core_dims=[[], [], []],
        vectorize=True,
    )
    return xr.Dataset(dict(zip(["white", "instability", "random_walk"], fitted, strict=True)))


def _per_recording(
    function: Callable[[np.ndarray], np.ndarray], samples: xr.DataArray
) -> xr.DataArray:
    """Apply a function of (..., samples) to one recording at a time, to bound memory."""
    return xr.concat(
        [
            xr.apply_ufunc(function, one.load(), input_core_dims=[["sample"]])
            for _, one in samples.groupby("recording", squeeze=False)
        ],
        "recording",
    ).transpose(*_KEYS)
