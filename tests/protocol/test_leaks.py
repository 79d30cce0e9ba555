from collections import Counter

import numpy as np
import pandas as pd
import pytest

from gyro_pipeline.conventions import (
    ALL,
    BEST_EPOCH_ON_TEST,
    HOLD_OUT,
    NO_LEAK,
    PAPER,
    TEST_IN_TRAINING,
    WINDOW_SPLIT,
    InputError,
)
from gyro_pipeline.protocol import leaks
from gyro_pipeline.protocol.leaks import divide, divide_windows, strided_errors, strided_scores
from gyro_pipeline.protocol.scores import resampled_weights

NUMBERS, FOLDS, SEED = [3, 5, 6, 8, 9, 12, 20], 5, 7
STARTS = np.arange(0, 50, 10)


def places(windows):
    return [(number, int(start)) for number, starts in windows.items() for start in starts]


def divisions(leak):
    return [divide(leak, NUMBERS, STARTS, FOLDS, fold, SEED) for fold in range(FOLDS)]


EVERYTHING = places(dict.fromkeys(NUMBERS, STARTS))


@pytest.mark.parametrize("leak", [NO_LEAK, BEST_EPOCH_ON_TEST, WINDOW_SPLIT])
def test_every_window_trains_or_tests_and_over_all_folds_tests_once(leak):
    tested = Counter()
    for division in divisions(leak):
        train, test = places(division.training), places(division.test)
        assert sorted(train + test) == EVERYTHING
        assert 0.6 < len(train) / len(EVERYTHING) < 0.9
        tested.update(test)
    assert tested == Counter(EVERYTHING)


@pytest.mark.parametrize("leak", [NO_LEAK, BEST_EPOCH_ON_TEST])
def test_an_honest_division_shares_no_recording(leak):
    for division in divisions(leak):
        assert not division.training.keys() & division.test.keys()
        assert all(np.array_equal(starts, STARTS) for starts in division.test.values())


def test_choosing_the_epoch_on_test_divides_like_the_honest_split():
    for honest, leaky in zip(divisions(NO_LEAK), divisions(BEST_EPOCH_ON_TEST), strict=True):
        assert places(honest.training) == places(leaky.training)


def test_a_window_split_trains_on_the_recordings_it_tests():
    for division in divisions(WINDOW_SPLIT):
        assert not set(places(division.training)) & set(places(division.test))
        assert len(division.training.keys() & division.test.keys()) > len(division.test) / 2
    again, other = (divide(WINDOW_SPLIT, NUMBERS, STARTS, FOLDS, 0, seed) for seed in (SEED, 1))
    assert places(again.test) == places(divisions(WINDOW_SPLIT)[0].test) != places(other.test)


def test_a_recording_without_test_windows_is_not_among_them():
    division = divide(WINDOW_SPLIT, NUMBERS, STARTS[:1], FOLDS, 0, SEED)
    assert len(division.test) == 2
    assert all(len(starts) for starts in [*division.training.values(), *division.test.values()])


def test_with_test_windows_in_training_all_windows_do_both():
    division = divide(TEST_IN_TRAINING, NUMBERS, STARTS, FOLDS, HOLD_OUT, SEED)
    assert places(division.training) == places(division.test) == EVERYTHING


def test_an_honest_division_that_leaks_is_refused(monkeypatch):
    monkeypatch.setattr(leaks, "deal", lambda count, folds, seed: [(0, 1), (3,)])
    with pytest.raises(InputError, match=r"leak 'none', fold 1: recording 5 .* train .* test"):
        divide(NO_LEAK, [3, 5, 6, 5], STARTS, 2, 1, SEED)


@pytest.fixture(scope="module")
def recordings(make_recordings):
    return make_recordings(np.zeros((2, 14, 3)), samples=1300, rate_hz=25.0, noise_dps_rts=1.0)


def test_the_first_recordings_are_divided_at_the_stride(recordings, parameters):
    leakage = parameters().leakage
    division = divide_windows(TEST_IN_TRAINING, HOLD_OUT, 0.4, recordings, leakage, SEED)
    assert list(division.test) == list(range(1, 12))
    for starts in division.test.values():
        np.testing.assert_array_equal(starts, np.arange(0, 1300 - 250 + 1, 10))


@pytest.mark.parametrize(
    ("changes", "stride_s", "message"),
    [
        ({}, 0.01, "sparkfun: a window stride of 0.01 s is less than half a sample at 25 Hz"),
        ({"recordings": 20, "folds": 15}, 1, "at least 15 recordings .* got 14; lower"),
        ({"window_s": 52.1}, 1, "a window of 52.1 s is 1302 samples"),
    ],
)
def test_what_recordings_cannot_give_is_refused(recordings, parameters, changes, stride_s, message):
    leakage = parameters().leakage.model_copy(update=changes)
    with pytest.raises(InputError, match=message):
        divide_windows(NO_LEAK, 0, stride_s, recordings, leakage, SEED)


def test_scores_are_of_the_windows_tested_and_of_their_recordings_alone():
    errors = pd.DataFrame(
        {
            "recording": [4, 4, 2],
            "error_dps": [0.3, -0.1, 0.2],
            "mean_error_dps": [0.6, -0.2, 0.4],
        }
    )
    squares = strided_errors(errors)
    np.testing.assert_allclose(squares.sums, [0.04, 0.10])
    np.testing.assert_array_equal(squares.counts, [1, 2])
    # Of recording 9, which is not tested, the curve is far off.
    curve = pd.DataFrame(
        [
            (number, PAPER, ALL, time_s, 3 * level * (9 if number == 9 else 1), 3)
            for number in (2, 4, 9)
            for time_s, level in ((1.0, 0.19), (10.0, 0.06), (20.0, 0.04))
        ],
        columns=["recording", "truth", "windows", "time_s", "sum_sq", "count"],
    )
    scores = strided_scores(errors, curve, 10.0, resampled_weights(2, 100, 0))
    assert scores["accuracy_gain_pct"].value == pytest.approx(50)
    rmse = np.sqrt(0.14 / 3)
    between = 10 + 10 * (np.sqrt(0.06) - rmse) / (np.sqrt(0.06) - np.sqrt(0.04))
    assert scores["time_saving_pct"].value == pytest.approx(100 * (1 - 10 / between))
