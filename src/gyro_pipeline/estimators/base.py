"""The interface of all estimators."""

import copy
import pickle
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any, ClassVar, Self

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike, NDArray

from gyro_pipeline.conventions import BIAS, LAST, OWN, RECORDING_MEAN, InputError
from gyro_pipeline.estimators.training_set import TrainingSet

Estimates = tuple[NDArray[np.float64], NDArray[np.float64]]
"""Biases (n, gyroscopes) and their standard deviations, deg/s; NaN where a method has none."""

_FILE = "estimator.pkl"


@dataclass(frozen=True)
class Windows:
    """The arguments of :meth:`Estimator.estimate`, with a start for every window.

    Attributes:
        samples: (n, gyroscopes, samples), deg/s.
        target: BIAS or RECORDING_MEAN.
        start_s: (n,), seconds after power-on.
        recording: Number of the recording; None if it is later than all training recordings.
    """

    samples: NDArray[np.floating]
    target: str
    start_s: NDArray[np.float64]
    recording: int | None


class Estimator:
    """Base of all estimators: it is fitted to a training set and estimates biases from windows.

    A subclass defines ``_estimate``, ``_fit`` if it learns more than the rate and the length of
    recordings, and the attributes that differ. It must be picklable, and should keep none of the
    training data: its attributes are stored with the run.

    A stored prior contains the Earth's rate, 4.2 mdps, as the sensing axes saw it. So an estimator
    with ``uses_prior`` holds only at the latitude and in the orientation of its training
    recordings. ``ORIENTATION_NOTE`` says so wherever its estimates are shown.

    Attributes:
        uses: The part of a training set that it is fitted to: NOTHING, OWN, REAL or ALL.
        seeded: Whether its arguments are ``training`` (sizes and schedule) and ``seed``.
        side_by_side: Whether it sees the windows of all IMUs of method 1, not of the device alone.
        fewest_recordings: Minimum number of training recordings: of the device, or of all real
            IMUs together if the device is unseen.
        recommended: Whether it is recommended for use; others serve for comparison.
        uses_prior: Whether its estimates depend on biases that it has learned.
        own_ceiling: The ceiling of what it uses: ``joint`` (the windows of all axes), ``history``
            (earlier calibrations), or empty (the window of one axis).
        engine: Where it was fitted: ``cpu``, ``fused`` or ``batched``.
        losses: Losses of a network by epoch.
        settings: Arguments of a seeded estimator except the seed; stored with runs.
    """

    uses: ClassVar[str] = OWN
    seeded: ClassVar[bool] = False
    side_by_side: ClassVar[bool] = False
    fewest_recordings: ClassVar[int] = 1
    recommended: bool = False
    uses_prior: bool = False
    own_ceiling: str = ""
    engine: str = "cpu"
    losses: pd.DataFrame | None = None
    settings: Mapping[str, Any] = MappingProxyType({})
    _size: Any = None  # samples of a window, if they must be as many as in training
    _rate_hz: float = np.nan
    _recording_s: float = np.nan

    def fit(self, training: TrainingSet) -> Self:
        """Learn from a training set, and from nothing else.

        Args:
            training: The training set, of which only the part in ``uses`` is read.

        Returns:
            Itself.

        Raises:
            InputError: It cannot be fitted to this training set.
        """
        self.check(training)
        training = training.part(self.uses)
        self._rate_hz, self._recording_s = training.rate_hz, training.recording_s
        self._fit(training)
        return self

    def check(self, training: TrainingSet) -> None:
        """Refuse a training set that is too small, before anything is fitted.

        Raises:
            InputError: The part in ``uses`` has too few recordings.
        """
        recordings = training.part(self.uses).recordings()
        if recordings < self.fewest_recordings:
            raise InputError(
                f"expected at least {self.fewest_recordings} training recordings, got {recordings}"
            )

    @property
    def source(self) -> type:
        """The class whose source file is stored with the estimator if it is a user's."""
        return type(self)

    def work(self, training: TrainingSet) -> float:
        """Estimated cost of fitting, in training samples of three gyroscopes of a network."""
        return 1e6 + 10.0 * training.part(self.uses).samples

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
                to estimators that model a warm-up or a random walk.
            recording: Number of the recording that the windows are from; None for one after all
                training recordings. Matters to estimators that use past calibrations in order.

        Returns:
            Two arrays (n, gyroscopes), deg/s: estimates, and the standard deviation of each
            about the target; NaN if the method has none.

        Raises:
            InputError: The target is unknown, or the windows have another length than in training.
        """
        if target not in (RECORDING_MEAN, BIAS):
            raise InputError(f"target: expected {RECORDING_MEAN!r} or {BIAS!r}, got {target!r}")
        if self._size not in (None, windows.shape[-1]):
            raise InputError(
                f"windows: expected {self._size} samples, as it was fitted to, "
                f"got {windows.shape[-1]}"
            )
        starts = np.broadcast_to(np.asarray(start_s, np.float64), len(windows))
        biases, sigma = self._estimate(Windows(windows, target, starts, recording))
        shape = windows.shape[:2]
        return np.broadcast_to(biases, shape), np.broadcast_to(sigma, shape)

    def with_calibrations(
        self, numbers: NDArray[np.integer], labels: NDArray[np.float64]
    ) -> "Estimator":
        """The estimator, updated with calibrations of the device made since it was fitted.

        An estimate for a recording uses only the calibrations before it, so all recordings that
        are judged may be given at once.

        Args:
            numbers: Numbers of the recordings, (n,), increasing.
            labels: Means of the recordings, (n, axes), deg/s.

        Returns:
            A copy; the estimator itself if it does not use past calibrations in order.
        """
        return self

    def variants(self) -> Mapping[str, "Estimator"]:
        """The estimators to judge: itself, and a validated network also at its best epoch."""
        return {LAST: self}

    def save(self, folder: Path) -> None:
        """Write the estimator to a folder, without the losses by epoch."""
        stored = copy.copy(self)
        stored.losses = None
        folder.mkdir(parents=True, exist_ok=True)
        (folder / _FILE).write_bytes(pickle.dumps(stored))

    @staticmethod
    def load(folder: Path) -> "Estimator":
        """Load an estimator of any class from a folder, which must be trusted: it is a pickle."""
        loaded = pickle.loads((folder / _FILE).read_bytes())
        assert isinstance(loaded, Estimator)
        return loaded

    def _fit(self, training: TrainingSet) -> None:
        """Learn from the part of a training set that the estimator uses."""

    def _estimate(self, windows: Windows) -> tuple[ArrayLike, ArrayLike]:
        """Biases and their sigma, in shapes that broadcast to (n, gyroscopes)."""
        raise NotImplementedError
