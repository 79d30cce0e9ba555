"""Windows, the stretches of a recording that an estimator sees.

A window with too many masked samples, which hold no measurement, is dropped. In the others they are
replaced by the mean of the window (:func:`gyro_pipeline.physics.bias.windows_at`).
"""

from collections.abc import Sequence

import numpy as np
import pandas as pd

from gyro_pipeline.conventions import InputError

LARGEST_MASKED_SHARE = 0.1
"""Largest share of masked samples in a window; windows with more are left out."""


def window_size(window_s: float, rate_hz: float, recording_samples: int, where: str) -> int:
    """Number of samples of a window.

    Args:
        window_s: Calibration time T0, seconds.
        rate_hz: Sample rate, Hz.
        recording_samples: Samples of a whole recording.
        where: Name of the recordings for the error message, e.g. the sensor.

    Raises:
        InputError: The window is longer than the recording, or shorter than a sample.
    """
    size = round(window_s * rate_hz)
    if not 1 <= size <= recording_samples:
        raise InputError(
            f"{where}: a window of {window_s:g} s is {size} samples at {rate_hz:.5g} Hz, but a "
            f"recording has {recording_samples} ({recording_samples / rate_hz:.4g} s); "
            "choose windows_s within it"
        )
    return size


def usable_starts(masked: np.ndarray, size: int, starts: np.ndarray | None = None) -> np.ndarray:
    """First samples of the windows that have enough measurements.

    Args:
        masked: Whether each sample of the recording is masked, shape (n,).
        size: Samples per window.
        starts: First samples of all windows; None for all non-overlapping ones from the start on.
    """
    if starts is None:
        starts = np.arange(0, len(masked) - size + 1, size)
    if not masked.any():
        return starts
    before = np.concatenate([[0], np.cumsum(masked)])
    return starts[before[starts + size] - before[starts] <= LARGEST_MASKED_SHARE * size]


def usable_windows(contents: pd.DataFrame, samples: int, size: int, stride: int) -> pd.DataFrame:
    """Usable windows of all recordings.

    Args:
        contents: A row per recording: ``imu, recording``, and ``masked``, the indices of its
            masked samples.
        samples: Samples of every recording.
        size: Samples per window.
        stride: Samples from the start of a window to the start of the next.

    Returns:
        A row per window: ``imu, recording`` and ``start``, its first sample.
    """
    all_starts = np.arange(0, samples - size + 1, stride)
    starts = []
    for indices in contents.masked:
        masked = np.zeros(samples, bool)
        masked[indices] = True
        starts.append(usable_starts(masked, size, all_starts))
    counts = [len(part) for part in starts]
    columns = {name: np.repeat(contents[name].to_numpy(), counts) for name in ("imu", "recording")}
    return pd.DataFrame(columns | {"start": np.concatenate([[], *starts]).astype(np.int64)})


def describe_losses(contents: pd.DataFrame, samples: int, size: int) -> str:
    """Describe the non-overlapping windows that are dropped; empty if none is.

    Args:
        contents: A row per recording, as for :func:`usable_windows`.
        samples: Samples of every recording.
        size: Samples per window.
    """
    windows = usable_windows(contents, samples, size, size)
    total = len(contents) * (samples // size)
    if len(windows) == total:
        return ""
    firsts = windows.groupby(["imu", "recording"]).start.min()
    late = firsts[firsts > 0]
    recordings = zip(contents.imu, contents.recording, strict=True)
    lost = [recording for recording in recordings if recording not in firsts.index]
    parts = [
        f"{total - len(windows)} of {total} lost more than {LARGEST_MASKED_SHARE:.0%} of their "
        "samples and are left out"
    ]
    if len(late):
        first = late.iloc[0] // size + 1
        parts.append(f"the first one used of {_in_words([*late.index])} is window {first}")
    if lost:
        parts.append(
            f"{_in_words(lost)} has no usable window, so it trains no network and does not test"
        )
    return "; ".join(parts)


def _in_words(recordings: Sequence[tuple[int, int]]) -> str:
    """The first of some recordings, and the number of the others."""
    imu, number = recordings[0]
    others = f" (and of {len(recordings) - 1} more)" if len(recordings) > 1 else ""
    return f"IMU {imu} recording {number}{others}"
