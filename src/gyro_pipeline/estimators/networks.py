"""Small networks that know what statistics can do: one adds to it, one sees the mean alone."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gyro_pipeline.conventions import BIAS, REAL, RECORDING_MEAN
from gyro_pipeline.estimators.base import Estimator, Windows
from gyro_pipeline.estimators.linear import BestLinear
from gyro_pipeline.estimators.training import ImuRecordings, TrainingSet
from gyro_pipeline.learning.perceptrons import Perceptrons, train_perceptrons
from gyro_pipeline.physics.bias import windows_at
from gyro_pipeline.physics.recording_model import innovations
from gyro_pipeline.physics.reml import FEWEST_RECORDINGS

_FOLDS = 5
_FEWEST = 4 * _FOLDS  # recordings to train a network on and to judge it by
_BLOCKS, _STARTS = 20, 40  # at most, of a window and of a recording
_ERRORS = 2.0  # standard errors by which a correction must help


@dataclass(frozen=True)
class _Correction:
    """What is added to the best linear estimate of the recording's mean, in units of its sigma.

    Attributes:
        networks: One for each fold; their mean is used.
        scales: Root mean square of each input in training.
        share: Of the networks' output that is added, 0 to 1.
        sigma: Of the corrected estimate, relative to that of the linear one.
    """

    networks: Perceptrons
    scales: NDArray[np.float64]
    share: float
    sigma: float

    def __call__(self, inputs: NDArray[np.float64]) -> NDArray[np.float64]:
        """(n, inputs) to (n,)."""
        return self.share * self.networks(inputs / self.scales)[..., 0].mean(axis=0)


class ResidualNetwork(Estimator):
    """The best linear predictor, plus what small networks find that it leaves.

    The linear predictor is optimal if noise is Gaussian and its model holds, so a network can add
    only where they fail: a drift of another form than the warm-up's, shocks. It sees a window's
    innovations (:func:`gyro_pipeline.physics.recording_model.innovations`) and when it began, and
    learns the linear estimate's error in units of its sigma. If the model holds these are
    independent, and what a network learns is chance. So it never decides alone: recordings are
    dealt into five folds, a network is trained on each four, and the share of its output that
    helped on the fifth, less two standard errors over recordings, is the share that is added. Where
    that is not positive the estimate is the linear one, as it is with fewer than twenty recordings
    and for an unseen device.

    Its training windows begin at the multiples of the window's length and at random in between.
    Windows drawn from the fitted model without end would teach it 0: there the linear predictor is
    the conditional mean.

    Other IMUs' windows train the networks as well, moved to this one's bias; which share is used is
    decided on this one's.

    Args:
        warm_up: See :class:`BestLinear`; by default the recordings say.
    """

    uses = REAL  # virtual recordings follow the model, so they would teach it nothing
    fewest_recordings = FEWEST_RECORDINGS
    recommended = True
    uses_prior = True

    def __init__(self, warm_up: bool | None = None) -> None:
        self._linear = BestLinear(warm_up=warm_up)

    def _fit(self, training: TrainingSet) -> None:
        self._linear.fit(training)
        self._size = training.size
        self._correction: _Correction | None = None
        partial = self._size < self._linear.models[0].samples
        if training.seen and partial and len(training.known[0].numbers) >= _FEWEST:
            self._correction = self._train(list(training.imus.values()))

    def _estimate(self, windows: Windows) -> tuple[ArrayLike, ArrayLike]:
        rates, place = windows.samples, (windows.start_s, windows.recording)
        self._demand_size(windows, self._size)
        bias, sigma = self._linear.estimate(rates, windows.target, *place)
        correction = self._correction
        if correction is None:
            return bias, sigma
        _, unit = self._linear.estimate(rates, RECORDING_MEAN, *place)
        starts = np.rint(windows.start_s * self._rate_hz).astype(int)
        added = np.empty(bias.shape)
        for start in np.unique(starts):
            chosen = starts == start
            inputs = self._inputs(rates[chosen].swapaxes(0, 1), int(start))
            found = correction(inputs.reshape(-1, inputs.shape[-1]))
            added[chosen] = found.reshape(inputs.shape[:2]).T * unit[chosen]
        # the samples outside the window carry it all
        outside = 1 - rates.shape[-1] / self._linear.models[0].samples
        share = 1 / outside if windows.target == BIAS else 1.0
        return bias + share * added, sigma * correction.sigma

    def _train(self, imus: list[ImuRecordings]) -> _Correction | None:
        """Trained on the device, which is the first, and on the others; None where it is no use."""
        starts = _starts(self._linear.models[0].samples, self._size)
        levels = [one.means.mean(axis=0) for one in imus]
        shifted = zip(imus, levels, strict=True)
        examples = [self._examples(one, levels[0] - level, starts) for one, level in shifted]
        # what was recorded together is left out together
        every = np.unique(np.concatenate([one.numbers for one in imus]))
        dealt = [np.searchsorted(every, one.numbers) % _FOLDS for one in imus]
        pairs = zip(dealt, examples, strict=True)
        folds = np.concatenate([np.repeat(one, len(y) // len(one)) for one, (_, y) in pairs])
        inputs, aims = (np.concatenate(part) for part in zip(*examples, strict=True))
        scales = np.sqrt(np.mean(inputs**2, axis=0)) + np.finfo(float).tiny
        used = folds != np.arange(_FOLDS)[:, None]
        networks = train_perceptrons(inputs / scales, aims[:, None], used)
        mine = slice(len(examples[0][1]))
        left_out = folds[None, mine]
        found = np.take_along_axis(networks(inputs[mine] / scales)[..., 0], left_out, axis=0)[0]
        by_recording = (len(imus[0].numbers), -1)
        share = helpful_share(found.reshape(by_recording), aims[mine].reshape(by_recording))
        if share == 0:
            return None
        left = np.mean((aims[mine] - share * found) ** 2) / np.mean(aims[mine] ** 2)
        return _Correction(networks, scales, share, float(np.sqrt(left)))

    def _examples(
        self, imu: ImuRecordings, shift: NDArray[np.float64], starts: NDArray[np.integer]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Inputs (n, m) and aims (n,) of one IMU's windows, recording by recording.

        Args:
            imu: Whose.
            shift: What moves its bias to the device's, (axes,), deg/s.
            starts: First samples of the windows.
        """
        rates, means = imu.rates, imu.means
        inputs, aims = [], []
        for start in starts:
            windows = rates[..., start : start + self._size] + shift[:, None]
            at_s = start / self._linear.models[0].rate_hz
            linear, sigma = self._linear.estimate(windows, RECORDING_MEAN, at_s)
            inputs.append(self._inputs(windows.swapaxes(0, 1), start).swapaxes(0, 1))
            aims.append((means + shift - linear) / sigma)
        return np.stack(inputs, 1).reshape(-1, inputs[0].shape[-1]), np.stack(aims, 1).ravel()

    def _inputs(self, windows: NDArray[np.floating], start: int) -> NDArray[np.float64]:
        """Innovations, and when the windows began; (axes, n, samples) to (axes, n, inputs)."""
        models = self._linear.models
        block_s = windows.shape[-1] / models[0].rate_hz / _BLOCKS
        found = [
            innovations(model, start, one, block_s)
            for model, one in zip(models, windows, strict=True)
        ]
        began = 2 * start / models[0].samples - 1
        return np.pad(np.stack(found), ((0, 0), (0, 0), (0, 1)), constant_values=began)


class WindowMeanNetwork(Estimator):
    """A small network that is fed the mean of the window alone.

    If it equals the paper's network, that one has learned nothing from the samples but their mean.
    """

    uses_prior = True

    def _fit(self, training: TrainingSet) -> None:
        """A network with the mean of the recording, then that outside the window, as its aims."""
        rates, size = training.rates, training.size
        samples, whole = rates.shape[-1], rates.mean(axis=-1, dtype=np.float64)
        self._size, self._centre = size, whole.mean(axis=0)
        used = zip(rates, training.starts, strict=True)
        cut = [windows_at(one, size, starts).mean(-1, dtype=np.float64) for one, starts in used]
        means = np.ascontiguousarray(np.concatenate(cut, axis=1).T) - self._centre  # (n, axes)
        whole = np.repeat(whole - self._centre, list(map(len, training.starts)), axis=0)
        rest = (whole * samples - means * size) / max(samples - size, 1)
        aims = np.concatenate([whole, rest if size < samples else whole], axis=1)
        self._scale = float(np.sqrt(np.mean(means**2)))
        every = np.ones((1, len(means)), bool)
        self._networks = train_perceptrons(means / self._scale, aims / self._scale, every)

    def _estimate(self, windows: Windows) -> tuple[ArrayLike, ArrayLike]:
        self._demand_size(windows, self._size)
        means = windows.samples.mean(axis=-1, dtype=np.float64) - self._centre
        outputs = np.split(self._networks(means / self._scale)[0], 2, axis=1)
        return self._centre + self._scale * outputs[windows.target == BIAS], np.nan


def helpful_share(found: NDArray[np.float64], aims: NDArray[np.float64]) -> float:
    """How much of a correction to add, so that chance adds none.

    Args:
        found: (recordings, n), corrections by networks that have not seen the recording.
        aims: The same shape, what was to be corrected.

    Returns:
        The share that leaves the least squares, less two standard errors over recordings; 0 to 1.
    """
    along, squares = (found * aims).sum(axis=1), (found**2).sum(axis=1)
    best = along.sum() / squares.sum()
    error = np.sqrt(np.sum((along - best * squares) ** 2)) / squares.sum()
    return float(np.clip(best - _ERRORS * error, 0, 1))


def _starts(samples: int, size: int) -> NDArray[np.integer]:
    """First samples of training windows: multiples of their length, and at random in between."""
    multiples = np.arange(0, samples - size + 1, size)
    generator = np.random.default_rng(size)
    if len(multiples) > _STARTS // 2:
        multiples = generator.choice(multiples, _STARTS // 2, replace=False)
    between = generator.integers(0, samples - size + 1, _STARTS - len(multiples))
    return np.unique([*multiples, *between])
