"""What the recommended estimators reach; ``benchmarks/estimators.py`` has it at full size."""

import numpy as np
import pytest

from gyro_pipeline.conventions import MDPS, PAPER, RECORDING_MEAN
from gyro_pipeline.estimators import make_estimator
from gyro_pipeline.physics.allan import NoiseFigures
from gyro_pipeline.physics.recording_model import RecordingModel, best_linear

pytestmark = pytest.mark.slow
SAMPLES, RECORDING_S = 650, 87.0  # a twentieth of SparkFun's rate: what matters is N, not sigma
RATE = SAMPLES / RECORDING_S
N, TAU = 3.3 * MDPS, 0.31 * MDPS
NOISE = NoiseFigures(N, 3 * MDPS, 0.1 * MDPS)
PRIOR = np.array([0.0, 20 * MDPS]), np.diag([TAU**2, (5 * MDPS) ** 2])
WARMING = RecordingModel(SAMPLES, RATE, NOISE, *PRIOR, time_constant_s=30.0)


class Oracle:
    """The best estimate of the recording's mean by one who knows the model and the device."""

    def __init__(self, model, recordings):
        self._model = model
        self._unit = recordings.true_unit_bias.to_numpy()[0]

    def estimate(self, windows, target, start_s, recording):
        assert target == RECORDING_MEAN
        starts = np.rint(start_s * self._model.rate_hz).astype(int)
        size = windows.shape[-1]
        lines = [best_linear(self._model, int(start), size, PAPER) for start in starts]
        relative = windows - self._unit[:, None]
        bias = np.stack([line(one) for line, one in zip(lines, relative, strict=True)])
        return bias + self._unit, np.full(bias.shape, np.nan)


def rms(errors):
    return np.sqrt(np.mean(errors**2))


def halves(recordings, count):
    """The first recordings, which train, and the others, which test."""
    parts = slice(count), slice(count, None)
    return tuple(recordings.isel(recording=part) for part in parts)


def test_the_default_is_nearly_as_good_as_the_oracle_with_flicker_random_walk_and_warm_up(
    simulate, judged, training_set
):
    made = simulate(WARMING, 120, seed=[60, 0])
    known, tested = halves(made, 60)
    names = ("best_linear", "empirical_bayes")
    fitted = [make_estimator(name, None, 0).fit(training_set(known)) for name in names]
    oracle, aware, stationary = (
        rms(judged(one, tested, 10)[0]) for one in (Oracle(WARMING, made), *fitted)
    )
    assert 0.98 < aware / oracle <= 1.08
    assert stationary / oracle >= 2


@pytest.fixture(scope="module")
def leave_one_out(memsense, judged, training_set):
    """Errors and sigmas on the real recordings, by estimator and window length."""
    found, numbers = {}, np.arange(memsense.sizes["recording"])
    for number in numbers:
        others = memsense.isel(recording=np.delete(numbers, number))
        for name in ("mean", "empirical_bayes", "best_linear"):
            estimator = make_estimator(name, None, 0).fit(training_set(others))
            for window_s in (1, 10, 30):
                one = judged(estimator, memsense.isel(recording=[number]), window_s)
                found.setdefault((name, window_s), []).append(one)
    return {key: [*map(np.concatenate, zip(*v, strict=True))] for key, v in found.items()}


@pytest.mark.parametrize("name", ["empirical_bayes", "best_linear"])
@pytest.mark.parametrize(("window_s", "bar"), [(1, 0.30), (10, 0.72), (30, 1.05)])
def test_memsense_against_the_running_mean_and_coverage(leave_one_out, name, window_s, bar):
    errors, sigma = leave_one_out[name, window_s]
    ratio = rms(errors) / rms(leave_one_out["mean", window_s][0])
    assert ratio <= bar
    assert window_s != 10 or ratio >= 0.53, "less than chance allows: look for a leak"
    assert 0.60 <= np.mean(np.abs(errors) < sigma) <= 0.78
    assert 0.90 <= np.mean(np.abs(errors) < 2 * sigma) <= 0.98


def test_coverage_on_many_simulated_recordings_that_warm_up(simulate, judged, training_set):
    """Of two devices: 80 recordings fix the spread of one, and so its sigma, to a tenth or so."""
    ratios = []
    for device in range(2):
        training, tested = halves(simulate(WARMING, 160, seed=device), 80)
        estimator = make_estimator("best_linear_warm_up", None, 0).fit(training_set(training))
        errors, sigma = judged(estimator, tested, 10)
        ratios.append(np.abs(errors) / sigma)
    assert 0.65 <= np.mean(np.array(ratios) < 1) <= 0.72
    assert 0.93 <= np.mean(np.array(ratios) < 2) <= 0.97
