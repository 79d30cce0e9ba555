"""Estimators without a network, fitted in every fold."""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager

import numpy as np
import pandas as pd
import xarray as xr
from numpy.typing import ArrayLike

from gyro_pipeline.conventions import BIAS, TEST, TRAIN, InputError
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
        self._recordings, self._roles, self._virtual = (
            recordings[["angular_rate", "samples"]],
            roles,
            virtual,
        )
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
            place = f"{self._recordings.attrs['sensor']} fold {fold}, {len(numbers)} recordings"
            with _explained(name, place):
                self._folds[key] = ESTIMATORS[name]().fit(self._samples(key[1:], numbers))
        return self._folds[key]

    def _samples(self, key: tuple[int, int, int], numbers: list[int]) -> TrainingRecordings:
        """Recordings of a fold with so many real and virtual IMUs; 0 real ones are all of them."""
        fold, real_imus, virtual_imus = key
        if key not in self._training:
            self._training = {k: known for k, known in self._training.items() if k[0] == fold}
            samples = self._recordings.sel(recording=numbers)
            if real_imus:
                samples = samples.isel(imu=slice(real_imus))
            if virtual_imus:
                samples = self._with_virtual(samples, virtual_imus)
            self._training[key] = TrainingRecordings(samples.load())
        return self._training[key]

    def _with_virtual(self, samples: xr.Dataset, imus: int) -> xr.Dataset:
        """Real recordings, and those of virtual IMUs that train, numbered after all real IMUs."""
        if self._virtual is None:
            raise InputError("virtual gyroscopes asked of a pipeline that makes none")
        last = self._virtual.attrs["train_recordings"]
        drawn = self._virtual[["angular_rate", "samples"]].sel(
            imu=slice(1, imus), recording=slice(1, last)
        )
        drawn = drawn.assign_coords(imu=drawn.imu + int(self._recordings.imu.max()))
        both = xr.concat([samples, drawn], "imu", join="outer")
        return both.assign(samples=both["samples"].fillna(0)).assign_attrs(samples.attrs)


class FittedToOthers:
    """Estimators without a network, fitted for each IMU to the recordings of all others.

    Args:
        recordings: Of all IMUs; estimators get the samples alone, without drawn values.
        roles: From :func:`gyro_pipeline.protocol.splits.leave_one_device_out`.
    """

    def __init__(self, recordings: xr.Dataset, roles: pd.DataFrame) -> None:
        train = roles[roles.role == TRAIN]
        numbers = sorted(train.recording.unique().tolist())
        known = TrainingRecordings(
            recordings[["angular_rate", "samples"]].sel(recording=numbers).load()
        )
        self._sensor = recordings.attrs["sensor"]
        self._training = {imu: known.unseen(imu) for imu in sorted(roles.fold.unique().tolist())}
        self._fitted: dict[str, dict[int, Estimator]] = {}

    def estimator(self, name: str, real_imus: int, virtual_imus: int) -> Mapping[int, Estimator]:
        """An estimator for each IMU; whatever the cell names, all other real IMUs train."""
        if name not in self._fitted:
            self._fitted[name] = {}
            for imu, training in self._training.items():
                with _explained(name, f"{self._sensor} without IMU {imu}"):
                    self._fitted[name][imu] = ESTIMATORS[name]().fit(training)
        return self._fitted[name]


@contextmanager
def _explained(name: str, where: str) -> Iterator[None]:
    """Say which estimator cannot be fitted, to what, and what to do."""
    try:
        yield
    except InputError as error:
        raise InputError(
            f"{where}: {name} cannot be fitted: {error}; bring more recordings or leave it out of "
            "the study"
        ) from error


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
