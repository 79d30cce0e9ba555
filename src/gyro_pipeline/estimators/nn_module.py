"""A network, any ``nn.Module`` of PyTorch, as an estimator."""

import copy
from collections.abc import Hashable, Mapping
from typing import Any, Self

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike

from gyro_pipeline.conventions import ALL, BEST, LAST, ORIGIN_REAL, TRAIN, VALIDATION, InputError
from gyro_pipeline.estimators.base import Estimator, Windows
from gyro_pipeline.estimators.training import TrainingSet
from gyro_pipeline.learning.design import Design, network_class, options_of
from gyro_pipeline.learning.examples import Device, with_shuffled_labels
from gyro_pipeline.learning.jobs import StoredNetwork, TrainedNetwork, TrainingJob, run_training
from gyro_pipeline.parameters import Training


class ModuleEstimator(Estimator):
    """A network trained as the paper's is (section III-D); it has no sigma.

    It gives the same estimate for every target. Where the training set names IMUs side by side
    (method 1) they are one input, and a window is used if all of them have it; else every IMU is a
    device of its own. The device validates, with its windows of that role, and the others do not.

    Args:
        network: ``package.module:Class``, see :class:`gyro_pipeline.learning.design.Design`.
        training: Schedule, and the sizes of a network whose options have no defaults.
        seed: Of the initial weights and the order of the examples.
        shuffled: Whether biases are permuted between training recordings, by the same seed: a leak
            detector, see :func:`gyro_pipeline.learning.examples.with_shuffled_labels`.
        **options: Of the network.

    Raises:
        InputError: The network has no such option.
    """

    uses = ALL
    seeded = True
    side_by_side = True
    uses_prior = True  # the centres, and what it learned of the biases' spread

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
        """Without the network that the weights were put into."""
        return vars(self) | {"_network": None}

    @property
    def source(self) -> type:
        """The network's class, whose file is stored with it where it is not of this package."""
        return network_class(self._path)

    @property
    def best_epoch(self) -> int | None:
        """Epoch of the lowest validation loss, counted from 1; None without validation."""
        epoch: int | None = self._artifact["best_epoch"]
        return epoch

    def check(self, training: TrainingSet) -> None:
        """See :meth:`Estimator.check`; recordings that validate do not train it.

        Raises:
            InputError: No training recording of the device, or too few to learn from.
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
        """The training itself; seeds of one training set share their examples."""
        devices = _devices(training, TRAIN)
        watched = _devices(training, VALIDATION, only_device=True)
        cell: Hashable = training.key
        if self._shuffled:
            generator = np.random.default_rng(self._seed)
            devices = [with_shuffled_labels(device, generator) for device in devices]
            cell = training.key, self._seed  # a seed has labels of its own
        return TrainingJob(
            design=self._design(devices[0], training),
            devices=devices,
            validation=watched[0] if watched else None,
            settings=self._settings,
            seed=self._seed,
            cell=cell,
        )

    def _design(self, device: Device, training: TrainingSet) -> Design:
        options = options_of(self._path, self._settings, self._options, training.rate_hz)
        return Design(self._path, device.biases.shape[1], training.size, options)

    def trained(self, network: TrainedNetwork) -> Self:
        """Take over what a training left."""
        self._artifact, self.history, self.engine = (
            network.artifact,
            network.history,
            network.engine,
        )
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
        self._demand_size(windows, self._artifact["network"]["window"])
        if self._network is None:
            self._network = StoredNetwork(self._artifact, self._weights)
        return self._network.biases(windows.samples), np.nan


def _devices(training: TrainingSet, role: str, only_device: bool = False) -> list[Device]:
    """Each input with windows of a role: real IMUs before virtual ones, the device first of all."""
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
    """The windows that all of these real IMUs have, once."""
    real = (windows.origin == ORIGIN_REAL) & windows.imu.isin(imus)
    places = windows.loc[real.to_numpy(), ["recording", "start"]]
    shared = places.groupby(["recording", "start"]).size()
    return shared[(shared == len(imus)).to_numpy()].index.to_frame(index=False)


def _device(recordings: Any, imus: tuple[int, ...], windows: pd.DataFrame) -> Device:
    """IMUs side by side with their windows, sorted by recording and start."""
    numbers, firsts = np.unique(windows.recording.to_numpy(), return_index=True)
    starts = np.split(windows.start.to_numpy(), firsts[1:])
    chosen = recordings.recording_mean.sel(imu=list(imus), recording=numbers)
    biases = chosen.transpose("recording", "imu", "axis").to_numpy().reshape(len(numbers), -1)
    return Device(recordings.angular_rate, imus, tuple(numbers.tolist()), biases, tuple(starts))
