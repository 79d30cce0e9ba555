"""The one interface of all estimators, and what they share."""

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
from gyro_pipeline.estimators.training import TrainingSet

Estimates = tuple[NDArray[np.float64], NDArray[np.float64]]
"""Biases (n, gyroscopes) and their standard deviations, deg/s; NaN where a method has none."""

_FILE = "estimator.pkl"


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


class Estimator:
    """Base of all estimators: it is fitted to a training set and estimates biases from windows.

    A subclass gives ``_estimate``, ``_fit`` if it learns more than the rate and the length of
    recordings, and those of the attributes that differ. It must be picklable, and should keep none
    of the training data: what it holds is stored with the run.

    A stored prior contains the Earth's rate, 4.2 mdps, as the sensing axes saw it. So an estimator
    with ``uses_prior`` holds only at the latitude and in the orientation of its training
    recordings. Whoever shows one of its estimates says so: ``ORIENTATION_NOTE``.

    Attributes:
        uses: The part of a training set that it is fitted to: NOTHING, OWN, REAL or ALL.
        seeded: Whether it is made with ``training`` (sizes and schedule) and ``seed``.
        side_by_side: Whether it sees the windows of all IMUs of method 1; others see the device's.
        fewest_recordings: How many training recordings it needs: of the device, or of all real
            IMUs together where the device is unseen.
        recommended: Whether it is one to use; the others are there to be compared with.
        uses_prior: Whether what it learned about the bias enters its estimates.
        engine: What fitted it.
        history: Losses by epoch, of a network.
        settings: Of a seeded one, what it was made with, but the seed; runs carry it.
    """

    uses: ClassVar[str] = OWN
    seeded: ClassVar[bool] = False
    side_by_side: ClassVar[bool] = False
    fewest_recordings: ClassVar[int] = 1
    recommended: bool = False
    uses_prior: bool = False
    engine: str = "cpu"
    history: pd.DataFrame | None = None
    settings: Mapping[str, Any] = MappingProxyType({})
    _rate_hz: float = np.nan
    _recording_s: float = np.nan

    def fit(self, training: TrainingSet) -> Self:
        """Learn from a training set, and from nothing else.

        Args:
            training: Of which only the part is looked at that the estimator uses.

        Returns:
            Itself.

        Raises:
            InputError: It cannot be fitted to this training set.
        """
        training = training.part(self.uses)
        self.check(training)
        self._rate_hz, self._recording_s = training.rate_hz, training.recording_s
        self._fit(training)
        return self

    def check(self, training: TrainingSet) -> None:
        """Refuse a training set that is too small, before anything is fitted.

        Raises:
            InputError: It has too few recordings.
        """
        self._demand(training.recordings())

    @property
    def source(self) -> type:
        """The class whose file is stored with the estimator where it is not of this package."""
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
                to estimators that know a warm-up or a random walk.
            recording: Number of the recording that the windows are from; None for one after all
                training recordings. Matters to estimators that use past calibrations in order.

        Returns:
            Two arrays (n, gyroscopes), deg/s: estimates, and the standard deviation of each
            about the target; NaN where the method has none.

        Raises:
            InputError: An unknown target, or windows of another length than it was fitted for.
        """
        if target not in (RECORDING_MEAN, BIAS):
            raise InputError(f"target: expected {RECORDING_MEAN!r} or {BIAS!r}, got {target!r}")
        starts = np.broadcast_to(np.asarray(start_s, np.float64), len(windows))
        biases, sigma = self._estimate(Windows(windows, target, starts, recording))
        shape = windows.shape[:2]
        return np.broadcast_to(biases, shape), np.broadcast_to(sigma, shape)

    def with_calibrations(
        self, numbers: NDArray[np.integer], labels: NDArray[np.float64]
    ) -> "Estimator":
        """The estimator, told of calibrations of the device made since it was fitted.

        For a recording only those before it count; so it may be told of all that are judged.

        Args:
            numbers: Of the recordings, (n,), increasing.
            labels: Their means, (n, axes), deg/s.

        Returns:
            Itself, if it does not use past calibrations in their order; else a copy.
        """
        return self

    def variants(self) -> Mapping[str, "Estimator"]:
        """What is judged: itself, and of a validated network the weights of the best epoch too."""
        return {LAST: self}

    def save(self, folder: Path) -> None:
        """Write what is needed to load it; the losses by epoch are not among it."""
        kept = copy.copy(self)
        kept.history = None
        folder.mkdir(parents=True, exist_ok=True)
        (folder / _FILE).write_bytes(pickle.dumps(kept))

    @staticmethod
    def load(folder: Path) -> "Estimator":
        """An estimator of any class as it was saved; only from a folder that one trusts."""
        loaded = pickle.loads((folder / _FILE).read_bytes())
        assert isinstance(loaded, Estimator)
        return loaded

    def _fit(self, training: TrainingSet) -> None:
        """Nothing to learn."""

    def _estimate(self, windows: Windows) -> tuple[ArrayLike, ArrayLike]:
        """Biases and their sigma, of any shapes that broadcast to (n, gyroscopes)."""
        raise NotImplementedError

    def _demand(self, recordings: int) -> None:
        if recordings < self.fewest_recordings:
            raise InputError(
                f"expected at least {self.fewest_recordings} training recordings, got {recordings}"
            )

    @staticmethod
    def _demand_size(windows: Windows, size: int) -> None:
        """Refuse windows of another length than those that were learned from."""
        if windows.samples.shape[-1] != size:
            raise InputError(
                f"windows: expected {size} samples, as it was fitted to, "
                f"got {windows.samples.shape[-1]}"
            )
