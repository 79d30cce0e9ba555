"""A network, any PyTorch ``nn.Module``, as an estimator."""

import copy
from collections.abc import Hashable, Mapping
from typing import Any, Self

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike

from gyro_pipeline.conventions import ALL, BEST, LAST, ORIGIN_REAL, TRAIN, VALIDATION, InputError
from gyro_pipeline.estimators.base import Estimator, Windows
from gyro_pipeline.estimators.training_set import TrainingSet
from gyro_pipeline.learning.design import Design, network_class, options_of
from gyro_pipeline.learning.examples import NetworkInput, with_shuffled_labels
from gyro_pipeline.learning.jobs import StoredNetwork, TrainedNetwork, TrainingJob, run_training
from gyro_pipeline.parameters import Training


class ModuleEstimator(Estimator):
    """A network trained in the way of the paper (section III-D); it has no sigma.

    The estimate is the same for every target. If the training set has IMUs side by side (method 1)
    they are one input, and a window is used if all of them have it; else every IMU is a device.
    Only the windows of the estimated device validate.

    Args:
        network: ``package.module:Class``, see :class:`gyro_pipeline.learning.design.Design`.
        training: Schedule, and sizes of the network for options without a default.
        seed: Seed of the initial weights and of the order of examples.
        shuffled: Whether biases are permuted between training recordings, by the same seed: a leak
            detector, see :func:`gyro_pipeline.learning.examples.with_shuffled_labels`.
        **options: Options of the network.

    Raises:
        InputError: The network has no such option.
    """

    uses = ALL
    seeded = True
    side_by_side = True
    uses_prior = True  # the centres, and the learned spread of biases

    def __init__(
        self, network: str, training: Training, seed: int, shuffled: bool = False, **options: Any
    ) -> None:
        self._path, self._settings, self._seed, self._shuffled = network, training, seed, shuffled
        self._options = options_of(network, training, options)
        self.settings = training.schedule | self._options
        self._weights = LAST
        self._artifact: Mapping[str, Any] = {}
        self._network: StoredNetwork | None = None

    def __getstate__(self) -> dict[str, Any]:
        """The state without the built network."""
        return vars(self) | {"_network": None}

    @property
    def source(self) -> type:
        """The class of the network, whose source file is stored if it is a user's."""
        return network_class(self._path)

    def check(self, training: TrainingSet) -> None:
        """See :meth:`Estimator.check`; validation recordings do not count.

        Raises:
            InputError: The device has no or too few training recordings.
        """
        devices = _devices(training, TRAIN)
        if not devices or training.device not in devices[0].imus:
            raise InputError("expected windows of the device to train on, got none")
        most = max(len(device.numbers) for device in devices)
        if self._settings.centring == "per_device" and most < 2:  # noqa: PLR2004
            raise InputError(
                "with centring per_device a device needs at least two training recordings, got one"
            )
        self._design(devices[0], training).check()

    def work(self, training: TrainingSet) -> float:
        """See :meth:`Estimator.work`."""
        return self.job(training).work

    def job(self, training: TrainingSet) -> TrainingJob:
        """The training job; jobs that differ only in their seeds share examples."""
        devices = _devices(training, TRAIN)
        validation = _devices(training, VALIDATION, only_device=True)
        cell: Hashable = training.key
        if self._shuffled:
            generator = np.random.default_rng(self._seed)
            devices = [with_shuffled_labels(device, generator) for device in devices]
            cell = training.key, self._seed  # labels depend on the seed
        return TrainingJob(
            design=self._design(devices[0], training),
            devices=devices,
            validation=validation[0] if validation else None,
            settings=self._settings,
            seed=self._seed,
            cell=cell,
        )

    def _design(self, device: NetworkInput, training: TrainingSet) -> Design:
        options = options_of(self._path, self._settings, self._options, training.rate_hz)
        return Design(self._path, device.biases.shape[1], training.size, options)

    def trained(self, network: TrainedNetwork) -> Self:
        """Take over the result of a training."""
        self._artifact, self.losses = network.artifact, network.losses
        self._size, self.engine = network.artifact["network"]["window"], network.engine
        return self

    def variants(self) -> Mapping[str, Estimator]:
        """See :meth:`Estimator.variants`."""
        if self._artifact["best"] is None:
            return {LAST: self}
        best = copy.copy(self)
        best._weights, best._network = BEST, None
        return {LAST: self, BEST: best}

    def _fit(self, training: TrainingSet) -> None:
        self.trained(run_training(self.job(training)))

    def _estimate(self, windows: Windows) -> tuple[ArrayLike, ArrayLike]:
        if self._network is None:
            self._network = StoredNetwork(self._artifact, self._weights)
        return self._network.biases(windows.samples), np.nan


def _devices(training: TrainingSet, role: str, only_device: bool = False) -> list[NetworkInput]:
    """All inputs with windows of a role: the device, other real IMUs, virtual IMUs."""
    windows = training.windows[(training.windows.role == role).to_numpy()]
    inputs = windows[["origin", "imu"]].drop_duplicates().to_numpy().tolist()
    together = training.side_by_side or (training.device,)
    shared = _windows_of_all(windows, together)
    devices = [_device(training.real, together, shared)] if len(shared) else []
    if only_device or training.side_by_side:
        return devices
    for origin, imu in inputs:
        recordings = training.real if origin == ORIGIN_REAL else training.virtual
        if (origin, imu) != (ORIGIN_REAL, training.device):
            rows = windows[((windows.origin == origin) & (windows.imu == imu)).to_numpy()]
            devices.append(_device(recordings, (imu,), rows))
    return devices


def _windows_of_all(windows: pd.DataFrame, imus: tuple[int, ...]) -> pd.DataFrame:
    """The windows that all of the given real IMUs have."""
    real = (windows.origin == ORIGIN_REAL) & windows.imu.isin(imus)
    rows = windows.loc[real.to_numpy(), ["recording", "start"]]
    shared = rows.groupby(["recording", "start"]).size()
    return shared[(shared == len(imus)).to_numpy()].index.to_frame(index=False)


def _device(recordings: Any, imus: tuple[int, ...], windows: pd.DataFrame) -> NetworkInput:
    """IMUs side by side with their windows, sorted by recording and start."""
    numbers, firsts = np.unique(windows.recording.to_numpy(), return_index=True)
    starts = np.split(windows.start.to_numpy(), firsts[1:])
    chosen = recordings.recording_mean.sel(imu=list(imus), recording=numbers)
    biases = chosen.transpose("recording", "imu", "axis").to_numpy().reshape(len(numbers), -1)
    return NetworkInput(
        recordings.angular_rate, imus, tuple(numbers.tolist()), biases, tuple(starts)
    )
