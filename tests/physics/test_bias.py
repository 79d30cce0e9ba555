import numpy as np
import pytest

from gyro_pipeline.physics.bias import (
    fill_masked,
    recording_mean,
    sample_sigma,
    settling_time_s,
)


def test_the_mean_is_summed_in_float64():
    # 2^24 + 1 is no float32: a float32 sum loses the small samples
    samples = np.full(20_001, 1e-3, dtype=np.float32)
    samples[0] = 2.0**24
    exact = (2.0**24 + 20_000 * float(np.float32(1e-3))) / 20_001
    assert float(recording_mean(samples)) == pytest.approx(exact, rel=1e-14)


def test_masked_samples_are_in_no_sum():
    samples = np.random.default_rng(0).normal(3, 1, (2, 3, 50))
    samples[0, :, [7, 8, 30]] = np.nan
    for place in np.ndindex(2, 3):
        measured = samples[place][~np.isnan(samples[place])]
        assert recording_mean(samples)[place] == pytest.approx(measured.mean(), rel=1e-14)
        assert sample_sigma(samples)[place] == pytest.approx(measured.std(ddof=1), rel=1e-13)
        assert fill_masked(samples)[place].mean() == pytest.approx(measured.mean(), rel=1e-14)
    assert not np.isnan(fill_masked(samples)).any()


def test_masked_samples_do_not_settle():
    samples = np.array([2, 0, np.nan, np.nan, 1, 1])  # running means 2 1 - - 1 1
    assert settling_time_s(samples, rate_hz=2, tolerance_dps=0.5) == 1.0
    samples = np.array([1, np.nan, 4, np.nan, -2])
    assert settling_time_s(samples, rate_hz=2, tolerance_dps=0.5) == 2.5


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
