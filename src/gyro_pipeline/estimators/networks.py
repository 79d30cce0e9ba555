"""Small networks: a correction of the best linear predictor, and a network of the window mean."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gyro_pipeline.conventions import BIAS, REAL, RECORDING_MEAN
from gyro_pipeline.estimators.base import Estimator, Windows
from gyro_pipeline.estimators.linear import BestLinear
from gyro_pipeline.estimators.training_set import ImuRecordings, TrainingSet
from gyro_pipeline.learning.perceptrons import Perceptrons, train_perceptrons
from gyro_pipeline.physics.bias import windows_at
from gyro_pipeline.physics.recording_model import innovations
from gyro_pipeline.physics.reml import FEWEST_RECORDINGS

_FOLDS = 5
_MIN_RECORDINGS = 4 * _FOLDS  # to train networks and to judge them
_BLOCKS, _STARTS = 20, 40  # maximum numbers, per window and per recording
_MIN_STANDARD_ERRORS = 2.0  # by which a correction must help


@dataclass(frozen=True)
class _Correction:
    """A correction of the best linear estimate of the recording's mean, in units of its sigma.

    Attributes:
        networks: A network for each fold; their mean is used.
        scales: Root mean square of each input in training.
        share: Share of the output of the networks that is added, 0 to 1.
        sigma: Sigma of the corrected estimate relative to that of the linear one.
    """

    networks: Perceptrons
    scales: NDArray[np.float64]
    share: float
    sigma: float

    def __call__(self, inputs: NDArray[np.float64]) -> NDArray[np.float64]:
        """Corrections (n,) from inputs (n, inputs)."""
        return self.share * self.networks(inputs / self.scales)[..., 0].mean(axis=0)


class ResidualNetwork(Estimator):
    """The best linear predictor, plus a correction of its errors by small networks.

    The linear predictor is optimal if noise is Gaussian and its model holds, so a network can help
    only where they fail: a drift of another form than the warm-up, or shocks. The inputs are the
    innovations of a window (:func:`gyro_pipeline.physics.recording_model.innovations`) and its
    start, the target is the error of the linear estimate in units of its sigma. If the model holds
    these are independent, and a network can learn only chance. Therefore recordings are split into
    five folds, each network is trained on four of them, and the share of its output that helps on
    the fifth, less two standard errors over recordings, is added. If this share is not positive,
    with fewer than twenty recordings, and for an unseen device, the estimate is the linear one.

    Training windows start at the multiples of the length of a window and at random in between.
    Windows simulated with the fitted model would only teach it 0, since the linear predictor is
    their conditional mean.

    The windows of other IMUs, moved to the bias of this device, train the networks as well; the
    share is decided on the device alone.

    Args:
        warm_up: See :class:`BestLinear`; by default it is decided by the recordings.
    """

    uses = REAL  # virtual recordings follow the model, so they would teach it nothing
    fewest_recordings = FEWEST_RECORDINGS
    recommended = True
    uses_prior = True

    def __init__(self, warm_up: bool | None = None) -> None:
        self._linear = BestLinear(warm_up=warm_up)

    def _fit(self, training: TrainingSet) -> None:
        self._linear.fit(training)
        self.own_ceiling = self._linear.own_ceiling
        self._size = training.size
        self._correction: _Correction | None = None
        partial = self._size < self._linear.models[0].samples
        if training.seen and partial and len(training.known_imus[0].numbers) >= _MIN_RECORDINGS:
            self._correction = self._train(list(training.imus.values()))

    def _estimate(self, windows: Windows) -> tuple[ArrayLike, ArrayLike]:
        rates, position = windows.samples, (windows.start_s, windows.recording)
        bias, sigma = self._linear.estimate(rates, windows.target, *position)
        correction = self._correction
        if correction is None:
            return bias, sigma
        _, unit = self._linear.estimate(rates, RECORDING_MEAN, *position)
        starts = np.rint(windows.start_s * self._rate_hz).astype(int)
        added = np.empty(bias.shape)
        for start in np.unique(starts):
            chosen = starts == start
            inputs = self._inputs(rates[chosen].swapaxes(0, 1), int(start))
            corrections = correction(inputs.reshape(-1, inputs.shape[-1]))
            added[chosen] = corrections.reshape(inputs.shape[:2]).T * unit[chosen]
        # the whole error is in the samples outside the window
        outside = 1 - rates.shape[-1] / self._linear.models[0].samples
        share = 1 / outside if windows.target == BIAS else 1.0
        return bias + share * added, sigma * correction.sigma

    def _train(self, imus: list[ImuRecordings]) -> _Correction | None:
        """Train on the device, which is the first IMU, and the others; None if it does not help."""
        starts = _starts(self._linear.models[0].samples, self._size)
        levels = [imu.means.mean(axis=0) for imu in imus]
        examples = [
            self._examples(imu, levels[0] - level, starts)
            for imu, level in zip(imus, levels, strict=True)
        ]
        # recordings that were made together are left out together
        numbers = np.unique(np.concatenate([imu.numbers for imu in imus]))
        fold_of = [np.searchsorted(numbers, imu.numbers) % _FOLDS for imu in imus]
        pairs = zip(fold_of, examples, strict=True)
        folds = np.concatenate([np.repeat(f, len(y) // len(f)) for f, (_, y) in pairs])
        inputs, targets = (np.concatenate(part) for part in zip(*examples, strict=True))
        scales = np.sqrt(np.mean(inputs**2, axis=0)) + np.finfo(float).tiny
        used = folds != np.arange(_FOLDS)[:, None]
        networks = train_perceptrons(inputs / scales, targets[:, None], used)
        device = slice(len(examples[0][1]))
        inputs, targets, left_out = inputs[device], targets[device], folds[None, device]
        outputs = np.take_along_axis(networks(inputs / scales)[..., 0], left_out, axis=0)[0]
        by_recording = (len(imus[0].numbers), -1)
        share = helpful_share(outputs.reshape(by_recording), targets.reshape(by_recording))
        if share == 0:
            return None
        remaining = np.mean((targets - share * outputs) ** 2) / np.mean(targets**2)
        return _Correction(networks, scales, share, float(np.sqrt(remaining)))

    def _examples(
        self, imu: ImuRecordings, shift: NDArray[np.float64], starts: NDArray[np.integer]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Inputs (n, m) and targets (n,) of the windows of an IMU, recording by recording.

        Args:
            imu: The IMU.
            shift: Mean bias of the device less that of the IMU, (axes,), deg/s.
            starts: First samples of the windows.
        """
        rates, means = imu.rates, imu.means
        inputs, targets = [], []
        for start in starts:
            windows = rates[..., start : start + self._size] + shift[:, None]
            start_s = start / self._linear.models[0].rate_hz
            linear, sigma = self._linear.estimate(windows, RECORDING_MEAN, start_s)
            inputs.append(self._inputs(windows.swapaxes(0, 1), start).swapaxes(0, 1))
            targets.append((means + shift - linear) / sigma)
        return np.stack(inputs, 1).reshape(-1, inputs[0].shape[-1]), np.stack(targets, 1).ravel()

    def _inputs(self, windows: NDArray[np.floating], start: int) -> NDArray[np.float64]:
        """Innovations and the start of windows; (axes, n, samples) to (axes, n, inputs)."""
        models = self._linear.models
        block_s = windows.shape[-1] / models[0].rate_hz / _BLOCKS
        whitened = [
            innovations(model, start, rates, block_s)
            for model, rates in zip(models, windows, strict=True)
        ]
        position = 2 * start / models[0].samples - 1
        return np.pad(np.stack(whitened), ((0, 0), (0, 0), (0, 1)), constant_values=position)


class WindowMeanNetwork(Estimator):
    """A small network whose only input is the mean of the window.

    If it is as accurate as the paper's network, that uses nothing but the mean of the samples.
    """

    uses_prior = True

    def _fit(self, training: TrainingSet) -> None:
        """Train a network; its targets are the means of the recording and outside the window."""
        rates, size = training.rates, training.size
        samples, whole = rates.shape[-1], rates.mean(axis=-1, dtype=np.float64)
        self._size, self._centre = size, whole.mean(axis=0)
        means = [
            windows_at(recording, size, starts).mean(-1, dtype=np.float64)
            for recording, starts in zip(rates, training.starts, strict=True)
        ]
        inputs = np.ascontiguousarray(np.concatenate(means, axis=1).T) - self._centre  # (n, axes)
        whole = np.repeat(whole - self._centre, list(map(len, training.starts)), axis=0)
        rest = (whole * samples - inputs * size) / max(samples - size, 1)
        targets = np.concatenate([whole, rest if size < samples else whole], axis=1)
        self._scale = float(np.sqrt(np.mean(inputs**2)))
        used = np.ones((1, len(inputs)), bool)
        self._networks = train_perceptrons(inputs / self._scale, targets / self._scale, used)

    def _estimate(self, windows: Windows) -> tuple[ArrayLike, ArrayLike]:
        means = windows.samples.mean(axis=-1, dtype=np.float64) - self._centre
        outputs = np.split(self._networks(means / self._scale)[0], 2, axis=1)
        return self._centre + self._scale * outputs[windows.target == BIAS], np.nan


def helpful_share(outputs: NDArray[np.float64], errors: NDArray[np.float64]) -> float:
    """The share of a correction to add, such that a correction by chance adds nothing.

    Args:
        outputs: Corrections by networks that have not seen the recording, (recordings, n).
        errors: Errors to correct, (recordings, n).

    Returns:
        The least-squares share, less two standard errors over recordings; 0 to 1.
    """
    along, squares = (outputs * errors).sum(axis=1), (outputs**2).sum(axis=1)
    best = along.sum() / squares.sum()
    error = np.sqrt(np.sum((along - best * squares) ** 2)) / squares.sum()
    return float(np.clip(best - _MIN_STANDARD_ERRORS * error, 0, 1))


def _starts(samples: int, size: int) -> NDArray[np.integer]:
    """First samples of training windows: multiples of their length, and random ones between."""
    multiples = np.arange(0, samples - size + 1, size)
    generator = np.random.default_rng(size)
    if len(multiples) > _STARTS // 2:
        multiples = generator.choice(multiples, _STARTS // 2, replace=False)
    between = generator.integers(0, samples - size + 1, _STARTS - len(multiples))
    return np.unique([*multiples, *between])
