"""Windows: what an estimator sees of a recording.

This is where masked samples, those that hold no measurement, are dealt with: a window that lost
more than a share of its samples is dropped; in the others they become the window's own mean. So
nothing that sees windows meets NaN.
"""

from collections.abc import Sequence

import numpy as np
import pandas as pd

from gyro_pipeline.conventions import InputError
from gyro_pipeline.physics.bias import windows_at

LARGEST_MASKED_SHARE = 0.1
"""Of a window's samples: where more are masked, the window is left out."""


def window_size(window_s: float, rate_hz: float, recording_samples: int, where: str) -> int:
    """Samples of a window.

    Args:
        window_s: Calibration time T0, seconds.
        rate_hz: Sample rate, Hz.
        recording_samples: Samples of a whole recording.
        where: What an error message calls the recordings, e.g. the sensor.

    Raises:
        InputError: If the window is longer than the recording.
    """
    size = round(window_s * rate_hz)
    if not 1 <= size <= recording_samples:
        raise InputError(
            f"{where}: a window of {window_s:g} s is {size} samples at {rate_hz:.5g} Hz, but a "
            f"recording has {recording_samples} ({recording_samples / rate_hz:.4g} s); "
            "choose windows_s within it"
        )
    return size


def usable_starts(
    masked: np.ndarray,
    size: int,
    starts: np.ndarray | None = None,
    largest_masked_share: float = LARGEST_MASKED_SHARE,
) -> np.ndarray:
    """First samples of the windows that are not dropped.

    Args:
        masked: Whether a sample of the recording holds no measurement, shape (n,).
        size: Samples per window.
        starts: First samples of the windows; None for all non-overlapping ones from the start on.
        largest_masked_share: Of a window's samples that may be masked.
    """
    if starts is None:
        starts = np.arange(0, len(masked) - size + 1, size)
    if not masked.any():
        return starts
    before = np.concatenate([[0], np.cumsum(masked)])
    return starts[before[starts + size] - before[starts] <= largest_masked_share * size]


def cut_windows(samples: np.ndarray, size: int, starts: np.ndarray | None = None) -> np.ndarray:
    """Windows of a recording; all non-overlapping ones from its start unless others are named.

    Args:
        samples: Shape (..., n); NaN where masked.
        size: Samples per window.
        starts: First samples of the windows, which may overlap.

    Returns:
        Shape (..., windows, size), without the windows that :func:`usable_starts` drops, and
        without NaN. Where none is masked and ``starts`` are None a view, n // size windows, where
        the last n % size samples are in none; else a copy.
    """
    masked = np.isnan(samples).reshape(-1, samples.shape[-1]).any(axis=0)
    if masked.any():
        starts = usable_starts(masked, size, starts)
    if starts is not None:
        return windows_at(samples, size, starts)
    count = samples.shape[-1] // size
    return samples[..., : count * size].reshape(*samples.shape[:-1], count, size)


def usable_windows(contents: pd.DataFrame, samples: int, size: int, stride: int) -> pd.DataFrame:
    """Windows of all recordings that are not dropped.

    Args:
        contents: A row per recording: ``imu, recording``, and ``masked``, the numbers of its
            masked samples.
        samples: Of every recording.
        size: Samples per window.
        stride: Samples from the start of one window to that of the next.

    Returns:
        A row per window: ``imu, recording`` and ``start``, its first sample.
    """
    starts = np.arange(0, samples - size + 1, stride)
    own = []
    for masked in contents.masked:
        lost = np.zeros(samples, bool)
        lost[masked] = True
        own.append(usable_starts(lost, size, starts))
    counts = [len(part) for part in own]
    places = {name: np.repeat(contents[name].to_numpy(), counts) for name in ("imu", "recording")}
    return pd.DataFrame(places | {"start": np.concatenate([[], *own]).astype(np.int64)})


def describe_losses(contents: pd.DataFrame, samples: int, size: int) -> str:
    """Which non-overlapping windows are dropped, in words; empty where none is.

    Args:
        contents: A row per recording, as :func:`usable_windows` takes it.
        samples: Of every recording.
        size: Samples per window.
    """
    windows = usable_windows(contents, samples, size, size)
    total = len(contents) * (samples // size)
    if len(windows) == total:
        return ""
    firsts = windows.groupby(["imu", "recording"]).start.min()
    late, lost = (
        firsts[firsts > 0],
        [
            place
            for place in zip(contents.imu, contents.recording, strict=True)
            if place not in firsts.index
        ],
    )
    parts = [
        f"{total - len(windows)} of {total} lost more than {LARGEST_MASKED_SHARE:.0%} of their "
        "samples and are left out"
    ]
    if len(late):
        first = late.iloc[0] // size + 1
        parts.append(f"the first one used of {_named([*late.index])} is window {first}")
    if lost:
        parts.append(f"none is left of {_named(lost)}, so it trains no network and tests none")
    return "; ".join(parts)


def _named(places: Sequence[tuple[int, int]]) -> str:
    """The first place, and how many more there are."""
    imu, number = places[0]
    more = f" (and of {len(places) - 1} more)" if len(places) > 1 else ""
    return f"IMU {imu} recording {number}{more}"
