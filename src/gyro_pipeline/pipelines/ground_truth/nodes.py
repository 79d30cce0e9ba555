"""Nodes of the ground-truth stage. Recordings may differ in length; samples may be masked."""

import logging

import numpy as np
import pandas as pd
import xarray as xr
from numpy.typing import NDArray

from gyro_pipeline.conventions import AXES, MDPS, NOISE_COLUMNS, InputError
from gyro_pipeline.parameters import GroundTruth
from gyro_pipeline.physics.allan import (
    allan_variance,
    averaging_times_s,
    fit_axes,
)
from gyro_pipeline.physics.bias import settling_time_s
from gyro_pipeline.recordings import bias_rows, iterate_recordings

logger = logging.getLogger(__name__)


def measure_allan_variance(recordings: xr.Dataset) -> xr.Dataset:
    """Overlapping Allan variance of every recording and axis.

    Args:
        recordings: Angular rates, deg/s.

    Returns:
        ``allan_variance`` (imu, recording, axis, time_s), (deg/s)^2, up to a fifth of the longest
        recording, and ``differences`` (imu, recording, time_s), their number; NaN and 0 for
        recordings that are missing or too short.
    """
    rate_hz = recordings.attrs["rate_hz"]
    times_s = averaging_times_s(int(recordings["samples"].max()), rate_hz)
    labels = {name: recordings[name] for name in ("imu", "recording", "axis")}
    shape = tuple(len(label) for label in labels.values())
    variance = xr.DataArray(np.full((*shape, len(times_s)), np.nan), labels | {"time_s": times_s})
    differences = xr.zeros_like(variance.isel(axis=0, drop=True), np.int64)
    for imu, number, samples in iterate_recordings(recordings):
        label = {"imu": imu, "recording": number}
        axes = [allan_variance(axis, rate_hz, times_s) for axis in samples]
        variance.loc[label] = [values for values, _ in axes]
        differences.loc[label] = axes[0][1]  # equal on all axes, which share a mask
    return xr.Dataset({"allan_variance": variance, "differences": differences})


def measure_bias(
    recordings: xr.Dataset, allan: xr.Dataset, ground_truth: GroundTruth
) -> pd.DataFrame:
    """The ground truth of the paper, the mean of each whole recording, and its accuracy.

    Args:
        recordings: Angular rates, deg/s.
        allan: Allan variances from :func:`measure_allan_variance`.
        ground_truth: The tolerance of the settling time.

    Returns:
        The rows of :func:`~gyro_pipeline.recordings.bias_rows`, with ``standard_error_dps``, the
        standard error N / sqrt(T), where T is the time of all samples that are not masked; and
        ``settling_time_s``, after which the running mean stays within the tolerance.
    """
    rate_hz, tolerance_dps = recordings.attrs["rate_hz"], ground_truth.tolerance_mdps * MDPS
    noise = _noise_figures(recordings, allan)

    def errors(imu: int, samples: NDArray[np.floating]) -> dict[str, NDArray[np.float64]]:
        measured_s = np.isfinite(samples[0]).sum() / rate_hz
        return {
            "standard_error_dps": noise[imu][0][:, 0] / np.sqrt(measured_s),
            "settling_time_s": settling_time_s(samples, rate_hz, tolerance_dps),
        }

    return bias_rows(recordings, errors)


def measure_noise(recordings: xr.Dataset, allan: xr.Dataset, bias: pd.DataFrame) -> pd.DataFrame:
    """Noise of every gyroscope, over all its recordings.

    Where Allan variances cannot be fitted, figures are NaN and a warning is logged.

    Args:
        recordings: Recordings with their lengths.
        allan: Allan variances from :func:`measure_allan_variance`.
        bias: Ground truth from :func:`measure_bias`.

    Returns:
        A row per sensor, imu and axis: ``sample_sigma_dps``, ``white_dps_rts`` (N),
        ``instability_dps`` (B) and ``random_walk_dps_per_rts`` (K), by IEEE Std 952.
    """
    sensor, fitted = recordings.attrs["sensor"], _noise_figures(recordings, allan)
    problems = {imu: problem for imu, (_, problem) in fitted.items() if problem}
    if problems:
        logger.warning(
            "%s: N, B and K of IMU %s are left empty, and with them the standard errors of the "
            "biases: %s",
            *(sensor, ", ".join(map(str, problems)), next(iter(problems.values()))),
        )
    index = pd.MultiIndex.from_product([[*fitted], AXES], names=["imu", "axis"])
    rows = np.concatenate([figures for figures, _ in fitted.values()])
    table = pd.DataFrame(rows, index, list(NOISE_COLUMNS))
    squares = bias.assign(square=bias.sample_sigma_dps**2).groupby(["imu", "axis"])["square"]
    table.insert(0, "sample_sigma_dps", np.sqrt(squares.mean()))
    table = table.reset_index()
    table.insert(0, "sensor", sensor)
    return table


def _noise_figures(
    recordings: xr.Dataset, allan: xr.Dataset
) -> dict[int, tuple[NDArray[np.float64], str]]:
    """N, B and K of each IMU, (axes, 3), from all its recordings; or NaN and the reason."""
    rate_hz, times_s = recordings.attrs["rate_hz"], allan.time_s.to_numpy()
    figures = {}
    for imu in recordings.imu.to_numpy().tolist():
        measured = allan.sel(imu=imu).transpose("recording", "axis", "time_s")
        counts = measured.differences.to_numpy()
        total_s = recordings["samples"].sel(imu=imu).to_numpy() / rate_hz @ (counts > 0)
        variances = measured.allan_variance.to_numpy()
        try:
            fits = fit_axes(times_s, variances, counts[:, None], total_s, rate_hz)
        except InputError as error:
            figures[imu] = np.full((len(AXES), len(NOISE_COLUMNS)), np.nan), str(error)
        else:
            rows = [(fit.white, fit.instability, fit.random_walk) for fit in fits]
            figures[imu] = np.array(rows), ""
    return figures
