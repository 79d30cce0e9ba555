"""Estimators without a network, fitted in every fold."""

from collections.abc import Mapping

import numpy as np
import pandas as pd
import xarray as xr
from numpy.typing import ArrayLike

from gyro_pipeline.conventions import BIAS, TEST, InputError
from gyro_pipeline.estimators import (
    ESTIMATORS,
    Estimates,
    Estimator,
    FittedEstimator,
    TrainingRecordings,
)


class Fitted:
    """Estimators without a network, fitted in each fold to all recordings that do not test there.

    Args:
        recordings: Of all IMUs; estimators get the samples alone, without drawn values.
        roles: Which recordings test, in each fold.
    """

    def __init__(self, recordings: xr.Dataset, roles: pd.DataFrame) -> None:
        self._recordings, self._roles = recordings[["angular_rate"]], roles
        self._training: dict[int, TrainingRecordings] = {}
        self._folds: dict[tuple[str, int], FittedEstimator] = {}

    def estimator(self, name: str) -> "OfFolds":
        """By its name; fitted once, whatever the window."""
        tested = self._roles[self._roles.role == TEST]
        places = zip(tested.recording.tolist(), tested.fold.tolist(), strict=True)
        return OfFolds({number: self._fit(name, fold) for number, fold in places})

    def _fit(self, name: str, fold: int) -> FittedEstimator:
        if (name, fold) not in self._folds:
            roles = self._roles[self._roles.fold == fold]
            numbers = sorted(roles.recording[roles.role != TEST].tolist())
            if fold not in self._training:
                chosen = self._recordings.sel(recording=numbers).load()
                self._training = {fold: TrainingRecordings(chosen)}
            try:
                self._folds[name, fold] = ESTIMATORS[name]().fit(self._training[fold])
            except InputError as error:
                sensor = self._recordings.attrs["sensor"]
                raise InputError(
                    f"{sensor} fold {fold}: {name} cannot be fitted to {len(numbers)} recordings: "
                    f"{error}; bring more recordings or leave it out of the study"
                ) from error
        return self._folds[name, fold]


class OfFolds:
    """Estimates each test recording as fitted in the fold where it tests."""

    def __init__(self, fitted: Mapping[int, Estimator]) -> None:
        self._fitted = fitted
        self.recommended, self.uses_prior = (
            getattr(next(iter(fitted.values())), name) for name in ("recommended", "uses_prior")
        )

    def estimate(
        self,
        windows: np.ndarray,
        target: str = BIAS,
        start_s: ArrayLike = 0.0,
        recording: int | None = None,
    ) -> Estimates:
        """See :class:`~gyro_pipeline.estimators.Estimator`; ``recording`` must be given."""
        if recording is None:
            raise InputError("recording: expected a test recording, got none")
        return self._fitted[recording].estimate(windows, target, start_s, recording)
