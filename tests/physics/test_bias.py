import numpy as np
import pytest

from gyro_pipeline.physics.bias import recording_mean, settling_time_s


def test_the_mean_is_summed_in_float64():
    # 2^24 + 1 is no float32: a float32 sum loses the small samples
    samples = np.full(20_001, 1e-3, dtype=np.float32)
    samples[0] = 2.0**24
    exact = (2.0**24 + 20_000 * float(np.float32(1e-3))) / 20_001
    assert float(recording_mean(samples)) == pytest.approx(exact, rel=1e-14)


def test_each_recording_has_its_mean_and_a_lacking_one_none():
    samples = np.arange(24.0).reshape(2, 3, 4)
    samples[1, 2] = np.nan
    np.testing.assert_array_equal(recording_mean(samples), [[1.5, 5.5, 9.5], [13.5, 17.5, np.nan]])


@pytest.mark.parametrize(
    ("samples", "seconds"),
    [
        ([2, 0, 1, 1], 1.0),  # running means 2 1 1 1
        ([1, 1, 4, -2], 2.0),  # running means 1 1 2 1: leaves the band once more
        ([3, 3, 3, 3], 0.5),  # never outside: one sample period
    ],
)
def test_settling_time_of_recordings_worked_by_hand(samples, seconds):
    got = settling_time_s(np.array(samples, dtype=np.float32), rate_hz=2, tolerance_dps=0.5)
    assert got == seconds


def test_settling_time_does_not_depend_on_the_bias_itself():
    samples = np.random.default_rng(1).normal(0, 0.04, (2, 3, 2000))
    shifted = samples + 2.5
    times = settling_time_s(samples, 100, 1e-3)
    assert times.shape == (2, 3)
    assert np.ptp(times) > 0
    np.testing.assert_allclose(settling_time_s(shifted, 100, 1e-3), times, atol=0.011)


def test_the_running_mean_is_summed_in_float64():
    # float32 sums of 100 deg/s are off by more than the band
    samples = np.random.default_rng(3).normal(100, 0.01, (5, 50_000)).astype(np.float32)
    expected = settling_time_s(samples.astype(np.float64), 100, 1e-4)
    np.testing.assert_array_equal(settling_time_s(samples, 100, 1e-4), expected)


def test_a_wider_band_is_reached_no_later():
    samples = np.random.default_rng(2).normal(0, 0.04, (20, 2000))
    narrow, wide = settling_time_s(samples, 100, 1e-3), settling_time_s(samples, 100, 5e-3)
    assert np.all(wide <= narrow)
    assert np.any(wide < narrow)


def test_a_lacking_recording_has_no_settling_time():
    samples = np.ones((2, 5))
    samples[0] = np.nan
    np.testing.assert_array_equal(settling_time_s(samples, 1, 0.1), [np.nan, 1.0])
