"""What the recommended estimators reach; ``benchmarks/estimators.py`` has it at full size."""

import numpy as np
import pytest

from gyro_pipeline.conventions import MDPS, PAPER, RECORDING_MEAN
from gyro_pipeline.estimators import make_estimator
from gyro_pipeline.physics.allan import NoiseFigures
from gyro_pipeline.physics.recording_model import RecordingModel, best_linear, constant_bias

pytestmark = pytest.mark.slow

SAMPLES, RECORDING_S = 650, 87.0  # a twentieth of SparkFun's rate: what matters is N, not sigma
RATE = SAMPLES / RECORDING_S
N, TAU = 3.3 * MDPS, 0.31 * MDPS
WHITE = constant_bias(SAMPLES, RATE, NoiseFigures(N, 0, 0), 0.0, TAU)
COLOURED = constant_bias(SAMPLES, RATE, NoiseFigures(N, 3 * MDPS, 0), 0.0, TAU)
WARMING = RecordingModel(
    SAMPLES,
    RATE,
    NoiseFigures(N, 3 * MDPS, 0.1 * MDPS),
    np.array([0.0, 20 * MDPS]),
    np.diag([TAU**2, (5 * MDPS) ** 2]),
    time_constant_s=30.0,
)
TESTED = 60


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


def ratios_to_the_oracle(simulate, judged, training_set, model, names, training, seeds):
    """One row per seed."""
    rows = []
    for seed in range(seeds):
        made = simulate(model, training + TESTED, seed=[training, seed])
        tested = made.isel(recording=slice(training, None))
        oracle = rms(judged(Oracle(model, made), tested, 10)[0])
        fitted = [
            make_estimator(n, None, 0).fit(training_set(made.isel(recording=slice(training))))
            for n in names
        ]
        rows.append([rms(judged(estimator, tested, 10)[0]) / oracle for estimator in fitted])
    return np.array(rows)


def test_they_are_nearly_as_good_as_the_oracle_with_ten_recordings_of_white_noise(
    simulate, judged, training_set
):
    names = ["empirical_bayes", "best_linear"]
    ratios = ratios_to_the_oracle(simulate, judged, training_set, WHITE, names, 10, seeds=4)
    assert (ratios.mean(axis=0) <= 1.08).all(), ratios
    assert (ratios.mean(axis=0) > 0.99).all(), ratios


def test_the_default_is_with_flicker_random_walk_and_warm_up_as_well(
    simulate, judged, training_set
):
    names = ["best_linear", "empirical_bayes"]
    ((aware, stationary),) = ratios_to_the_oracle(
        simulate, judged, training_set, WARMING, names, 60, seeds=1
    )
    assert 0.98 < aware <= 1.08
    assert stationary >= 2


@pytest.fixture(scope="module")
def leave_one_out(memsense, judged, training_set):
    """Errors and sigmas on the real recordings, by estimator and window length."""
    found = {}
    for i in range(memsense.sizes["recording"]):
        others = memsense.isel(recording=np.delete(np.arange(memsense.sizes["recording"]), i))
        for name in ("mean", "empirical_bayes", "best_linear"):
            estimator = make_estimator(name, None, 0).fit(training_set(others))
            for window_s in (1, 10, 30):
                one = judged(estimator, memsense.isel(recording=[i]), window_s)
                found.setdefault((name, window_s), []).append(one)
    return {
        key: [np.concatenate(part) for part in zip(*v, strict=True)] for key, v in found.items()
    }


RECOMMENDED = ["empirical_bayes", "best_linear"]


@pytest.mark.parametrize("name", RECOMMENDED)
@pytest.mark.parametrize(("window_s", "bar"), [(1, 0.30), (10, 0.72), (30, 1.05)])
def test_memsense_against_the_running_mean_and_coverage(leave_one_out, name, window_s, bar):
    errors, sigma = leave_one_out[name, window_s]
    ratio = rms(errors) / rms(leave_one_out["mean", window_s][0])
    assert ratio <= bar
    assert window_s != 10 or ratio >= 0.53, "less than chance allows: look for a leak"
    assert 0.60 <= np.mean(np.abs(errors) < sigma) <= 0.78
    assert 0.90 <= np.mean(np.abs(errors) < 2 * sigma) <= 0.98


@pytest.mark.parametrize(
    ("model", "name"), [(COLOURED, "best_linear"), (WARMING, "best_linear_warm_up")]
)
def test_coverage_on_many_simulated_recordings(simulate, judged, model, name, training_set):
    """Of two devices: 80 recordings fix the spread of one, and so its sigma, to a tenth or so."""
    ratios = []
    for device in range(2):
        made = simulate(model, 160, seed=device)
        estimator = make_estimator(name, None, 0).fit(training_set(made.isel(recording=slice(80))))
        errors, sigma = judged(estimator, made.isel(recording=slice(80, None)), 10)
        ratios.append(np.abs(errors) / sigma)
    assert 0.65 <= np.mean(np.array(ratios) < 1) <= 0.72
    assert 0.93 <= np.mean(np.array(ratios) < 2) <= 0.97


@pytest.mark.parametrize("model", [WHITE, COLOURED], ids=["white", "coloured"])
def test_five_training_recordings_suffice_not_to_be_worse_than_the_mean(
    simulate, judged, model, training_set
):
    """The mean of two draws, at 1, 10 and 30 s."""
    recordings, rows = simulate(model, 100), []
    for draw in range(2):
        order = np.random.default_rng(draw).permutation(100)
        training, tested = (
            recordings.isel(recording=np.sort(order[part])) for part in np.s_[:5, 5:45]
        )
        fitted = [
            make_estimator(name, None, 0).fit(training_set(training))
            for name in ("mean", *RECOMMENDED)
        ]
        errors = [[rms(judged(one, tested, w)[0]) for w in (1, 10, 30)] for one in fitted]
        rows.append(np.array(errors[1:]) / errors[0])
    assert (np.mean(rows, axis=0) <= 1.05).all()
