"""The one interface of all estimators, and what they share."""

from dataclasses import dataclass
from typing import Protocol, Self

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike, NDArray

from gyro_pipeline.conventions import BIAS, RECORDING_MEAN, TEST_IMU, InputError
from gyro_pipeline.estimators.training import TrainingRecordings

Estimates = tuple[NDArray[np.float64], NDArray[np.float64]]
"""Biases (n, 3) and their standard deviations (n, 3), deg/s; NaN where a method has none."""


class Estimator(Protocol):
    """Anything that estimates biases from windows.

    A stored prior contains the Earth's rate, 4.2 mdps, as the sensing axes saw it. So an estimator
    with ``uses_prior`` holds only at the latitude and in the orientation of its training
    recordings. Whoever shows one of its estimates says so: ``ORIENTATION_NOTE``.
    """

    @property
    def recommended(self) -> bool:
        """Whether it is one to use; the others are there to be compared with."""

    @property
    def uses_prior(self) -> bool:
        """Whether what it learned about the bias enters its estimates."""

    def estimate(
        self,
        windows: NDArray[np.floating],
        target: str = BIAS,
        start_s: ArrayLike = 0.0,
        recording: int | None = None,
    ) -> Estimates:
        """Biases of the gyroscopes seen side by side.

        Args:
            windows: (n, gyroscopes, samples), deg/s.
            target: BIAS, or RECORDING_MEAN: the mean of the whole recording that the window is
                part of, whose length is that of the training recordings.
            start_s: (n,) or one for all: when each window begins, seconds after power-on. Matters
                to estimators that know a warm-up or a random walk.
            recording: Number of the recording that the windows are from; None for one after all
                training recordings. Matters to estimators that use past calibrations in order.

        Returns:
            Two arrays (n, gyroscopes), deg/s: estimates, and the standard deviation of each
            about the target; NaN where the method has none.
        """


@dataclass(frozen=True)
class Windows:
    """What :meth:`Estimator.estimate` is asked, with a start for every window.

    Attributes:
        samples: (n, gyroscopes, samples), deg/s.
        target: BIAS or RECORDING_MEAN.
        start_s: (n,), seconds after power-on.
        recording: Number of the recording, or None.
    """

    samples: NDArray[np.floating]
    target: str
    start_s: NDArray[np.float64]
    recording: int | None


class FittedEstimator:
    """Base of the estimators that learn from training recordings.

    A subclass gives ``_estimate``, ``_fit`` if it learns more than the rate and the length of
    recordings, and the two marks of :class:`Estimator`.
    """

    recommended = False
    uses_prior = False
    _rate_hz = np.nan
    _recording_s = np.nan

    def fit(self, recordings: xr.Dataset | TrainingRecordings, imu: int = TEST_IMU) -> Self:
        """Learn from training recordings, and from nothing else.

        Args:
            recordings: As in :mod:`gyro_pipeline.conventions`; or with the device, to share what
                is learned with other estimators.
            imu: Whose windows will be seen. A device that is not among the recordings is an unseen
                one: its prior is the spread from unit to unit.

        Returns:
            Itself.
        """
        if isinstance(recordings, xr.Dataset):
            recordings = TrainingRecordings(recordings, imu)
        self._rate_hz, self._recording_s = recordings.rate_hz, recordings.recording_s
        self._fit(recordings)
        return self

    def estimate(
        self,
        windows: NDArray[np.floating],
        target: str = BIAS,
        start_s: ArrayLike = 0.0,
        recording: int | None = None,
    ) -> Estimates:
        """See :class:`Estimator`.

        Raises:
            InputError: An unknown target.
        """
        if target not in (RECORDING_MEAN, BIAS):
            raise InputError(f"target: expected {RECORDING_MEAN!r} or {BIAS!r}, got {target!r}")
        starts = np.broadcast_to(np.asarray(start_s, np.float64), len(windows))
        biases, sigma = self._estimate(Windows(windows, target, starts, recording))
        shape = windows.shape[:2]
        return np.broadcast_to(biases, shape), np.broadcast_to(sigma, shape)

    def _fit(self, training: TrainingRecordings) -> None:
        """Nothing to learn."""

    def _estimate(self, windows: Windows) -> tuple[ArrayLike, ArrayLike]:
        """Biases and their sigma, of any shapes that broadcast to (n, gyroscopes)."""
        raise NotImplementedError


ORIENTATION_NOTE = (
    "uses a stored prior, which holds only in the orientation and at the latitude it was learned in"
)
