"""The leak study: which windows train and which test, honestly and with each leak on purpose.

Nothing else uses this. The honest protocol splits by recording (:mod:`.splits`).
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd
import xarray as xr

from gyro_pipeline.conventions import (
    ALL,
    PAPER,
    TEST,
    TEST_IMU,
    TEST_IN_TRAINING,
    TRAIN,
    WINDOW_SPLIT,
    InputError,
)
from gyro_pipeline.parameters import Leakage
from gyro_pipeline.protocol.recordings import recordings_of_test_imu
from gyro_pipeline.protocol.scores import Estimate, SquaredErrors, curve_errors, score
from gyro_pipeline.protocol.splits import deal, refuse_two_roles
from gyro_pipeline.protocol.windows import UsableWindows, window_size, window_starts


@dataclass(frozen=True)
class Division:
    """First samples of the windows that train and that test, by recording number."""

    training: dict[int, np.ndarray]
    test: dict[int, np.ndarray]


def divide_windows(  # noqa: PLR0917 - what a division depends on
    leak: str, fold: int, stride_s: float, recordings: xr.Dataset, leakage: Leakage, seed: int
) -> Division:
    """Divide the windows of a sensor's first recordings.

    Args:
        leak: One of the leaks; see :func:`divide`.
        fold: Which part tests.
        stride_s: From the start of one window to that of the next, seconds.
        recordings: Real recordings.
        leakage: How many of them to use, and the window.
        seed: Of the deal.

    Raises:
        InputError: If the stride is no sample, or there are fewer recordings or windows than parts.
    """
    sensor, rate_hz = recordings.attrs["sensor"], recordings.attrs["rate_hz"]
    samples = recordings.sizes["sample"]
    size, stride = (
        window_size(leakage.window_s, rate_hz, samples, sensor),
        round(stride_s * rate_hz),
    )
    if stride < 1:
        raise InputError(
            f"{sensor}: a window stride of {stride_s:g} s is less than half a sample at "
            f"{rate_hz:.5g} Hz; choose leakage.strides_s above {0.5 / rate_hz:.2g}"
        )
    numbers = used_recordings(recordings, leakage)
    if len(numbers) < leakage.folds:
        raise InputError(
            f"{sensor}: expected at least {leakage.folds} recordings with a window of "
            f"{leakage.window_s:g} s that can be used, one for each of leakage.folds, got "
            f"{len(numbers)}; lower leakage.window_s or leakage.folds, or bring recordings"
        )
    starts = window_starts(samples, size, stride)
    return divide(leak, numbers, starts, leakage.folds, fold, seed)


def with_windows(recordings: xr.Dataset, leakage: Leakage) -> xr.Dataset:
    """The recordings of which the tested IMU has a window that can be used."""
    windows, size = UsableWindows(recordings), round(leakage.window_s * recordings.attrs["rate_hz"])
    numbers = recordings.recording.to_numpy().tolist()
    chosen = [number for number in numbers if windows.count([TEST_IMU], number, size)]
    return recordings if len(chosen) == len(numbers) else recordings.sel(recording=chosen)


def used_recordings(recordings: xr.Dataset, leakage: Leakage) -> list[int]:
    """Numbers of the first recordings of the tested IMU, as many as the study uses."""
    numbers = recordings.recording.to_numpy()[recordings_of_test_imu(recordings)]
    return numbers[: leakage.recordings].tolist()


def divide(
    leak: str, numbers: Sequence[int], starts: np.ndarray, folds: int, fold: int, seed: int
) -> Division:
    """Divide the windows of some recordings.

    Recordings and windows are dealt by the same hand. Over all folds each window is tested once.
    The test windows of ``WINDOW_SPLIT`` are held out at random, as one who splits by window would
    do: they share recordings with training windows, and overlap some if a stride is short.

    Args:
        leak: One of the leaks. ``WINDOW_SPLIT`` deals windows; with ``TEST_IN_TRAINING`` all
            windows train and test, in one fold; all others deal recordings.
        numbers: Recording numbers.
        starts: First samples of the windows, the same for all recordings.
        folds: Parts that are dealt.
        fold: Which of them tests.
        seed: Of the deal.

    Raises:
        InputError: If an honest division gave a recording two roles.
    """
    everything = np.ones((len(numbers), len(starts)), bool)
    if leak == TEST_IN_TRAINING:
        return Division(*2 * [_chosen(numbers, starts, everything)])
    tested = ~everything
    dealt = tested.reshape(-1) if leak == WINDOW_SPLIT else tested  # views
    dealt[deal(len(dealt), folds, seed)[fold]] = True
    division = Division(_chosen(numbers, starts, ~tested), _chosen(numbers, starts, tested))
    if leak != WINDOW_SPLIT:
        used = {TRAIN: division.training, TEST: division.test}
        in_roles = {role: [(TEST_IMU, number) for number in of] for role, of in used.items()}
        refuse_two_roles(in_roles, f"leak study, leak {leak!r}, fold {fold}")
    return division


def strided_errors(errors: pd.DataFrame, estimator: str = "") -> SquaredErrors:
    """Squares of the leak study's errors, by recording in order of number.

    Args:
        errors: Columns ``recording`` and ``[<estimator>_]error_dps``, deg/s.
        estimator: Whose; the network's if empty, else ``mean``, ``constant`` or ``oracle``.
    """
    squares = errors[f"{estimator}_error_dps" if estimator else "error_dps"] ** 2
    sums = squares.groupby(errors.recording).agg(["sum", "count"])
    return SquaredErrors(sums["sum"].to_numpy(), sums["count"].to_numpy())


def strided_scores(
    errors: pd.DataFrame, curve: pd.DataFrame, window_s: float, weights: np.ndarray
) -> dict[str, Estimate]:
    """The figures of merit of :func:`~gyro_pipeline.protocol.scores.score`, on the test windows.

    Args:
        errors: See :func:`strided_errors`; of one fold or of several.
        curve: From :func:`~gyro_pipeline.protocol.truths.running_mean_curve`, of at least the
            recordings tested.
        window_s: T0, seconds.
        weights: From :func:`~gyro_pipeline.protocol.scores.resampled_weights`.
    """
    tested = curve[curve.recording.isin(errors.recording)]
    squares = strided_errors(errors), strided_errors(errors, "mean")
    return score(*squares, curve_errors(tested, PAPER, ALL).of(weights), window_s, weights)


def _chosen(numbers: Sequence[int], starts: np.ndarray, mask: np.ndarray) -> dict[int, np.ndarray]:
    """The windows in a mask (recordings, windows), without recordings that have none."""
    rows = zip(numbers, mask, strict=True)
    return {number: starts[row] for number, row in rows if row.any()}
