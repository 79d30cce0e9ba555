"""Estimators without a network, fitted in every fold."""

from collections.abc import Mapping

import numpy as np
import pandas as pd
import xarray as xr
from numpy.typing import ArrayLike

from gyro_pipeline.conventions import BIAS, TEST, TEST_IMU, InputError
from gyro_pipeline.estimators import (
    ESTIMATORS,
    Estimates,
    Estimator,
    FittedEstimator,
    TrainingRecordings,
)
from gyro_pipeline.studies import RESIDUAL_NETWORK


class Fitted:
    """Estimators without a network, fitted in each fold to all recordings that do not test there.

    Args:
        recordings: Of all IMUs; estimators get the samples alone, without drawn values.
        roles: Which recordings test, in each fold.
        virtual: Virtual recordings, where a cell asks for some.
    """

    def __init__(
        self, recordings: xr.Dataset, roles: pd.DataFrame, virtual: xr.Dataset | None = None
    ) -> None:
        self._recordings, self._roles, self._virtual = recordings[["angular_rate"]], roles, virtual
        self._training: dict[tuple[int, int, int], TrainingRecordings] = {}
        self._folds: dict[tuple[str, int, int, int], FittedEstimator] = {}

    def estimator(self, name: str, real_imus: int, virtual_imus: int) -> "OfFolds":
        """An estimator; fitted once, whatever the window.

        Args:
            name: As in ``ESTIMATORS``.
            real_imus: IMUs that a residual network learns from; others take what they use of all.
            virtual_imus: The same, of virtual ones.
        """
        tested = self._roles[self._roles.role == TEST]
        places = zip(tested.recording.tolist(), tested.fold.tolist(), strict=True)
        imus = (real_imus, virtual_imus) if name == RESIDUAL_NETWORK else (0, 0)
        return OfFolds({number: self._fit(name, fold, *imus) for number, fold in places})

    def _fit(self, name: str, fold: int, real_imus: int, virtual_imus: int) -> FittedEstimator:
        key = name, fold, real_imus, virtual_imus
        if key not in self._folds:
            roles = self._roles[self._roles.fold == fold]
            numbers = sorted(roles.recording[roles.role != TEST].tolist())
            try:
                self._folds[key] = ESTIMATORS[name]().fit(self._samples(key[1:], numbers))
            except InputError as error:
                sensor = self._recordings.attrs["sensor"]
                raise InputError(
                    f"{sensor} fold {fold}: {name} cannot be fitted to {len(numbers)} recordings: "
                    f"{error}; bring more recordings or leave it out of the study"
                ) from error
        return self._folds[key]

    def _samples(self, key: tuple[int, int, int], numbers: list[int]) -> TrainingRecordings:
        """Recordings of a fold with so many real and virtual IMUs; 0 real ones are all of them."""
        fold, real_imus, virtual_imus = key
        if key not in self._training:
            self._training = {k: known for k, known in self._training.items() if k[0] == fold}
            samples = self._recordings.sel(recording=numbers)
            if real_imus:
                samples = samples.sel(imu=slice(TEST_IMU, TEST_IMU + real_imus - 1))
            if virtual_imus:
                samples = self._with_virtual(samples, virtual_imus)
            self._training[key] = TrainingRecordings(samples.load())
        return self._training[key]

    def _with_virtual(self, samples: xr.Dataset, imus: int) -> xr.Dataset:
        """Real recordings, and those of virtual IMUs that train, numbered after all real IMUs."""
        if self._virtual is None:
            raise InputError("virtual gyroscopes asked of a pipeline that makes none")
        last = self._virtual.attrs["train_recordings"]
        drawn = self._virtual[["angular_rate"]].sel(imu=slice(1, imus), recording=slice(1, last))
        drawn = drawn.assign_coords(imu=drawn.imu + int(self._recordings.imu.max()))
        return xr.concat([samples, drawn], "imu", join="outer").assign_attrs(samples.attrs)


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
