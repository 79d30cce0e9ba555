"""Means without masked samples, and how long the running mean takes to settle."""

import numpy as np
import pytest

from gyro_pipeline.physics.bias import fill_masked, recording_mean, sample_sigma, settling_time_s


def test_masked_samples_are_in_no_sum():
    samples = np.random.default_rng(0).normal(3, 1, (2, 3, 50))
    samples[0, :, [7, 8, 30]] = np.nan
    for place in np.ndindex(2, 3):
        measured = samples[place][~np.isnan(samples[place])]
        assert recording_mean(samples)[place] == pytest.approx(measured.mean(), rel=1e-14)
        assert sample_sigma(samples)[place] == pytest.approx(measured.std(ddof=1), rel=1e-13)
        assert fill_masked(samples)[place].mean() == pytest.approx(measured.mean(), rel=1e-14)
    assert not np.isnan(fill_masked(samples)).any()


def test_settling_time_of_recordings_worked_by_hand():
    for samples, seconds in (
        ([2, 0, 1, 1], 1.0),  # running means 2 1 1 1
        ([1, 1, 4, -2], 2.0),  # running means 1 1 2 1: leaves the band once more
        ([3, 3, 3, 3], 0.5),  # never outside: one sample period
        ([2, 0, np.nan, np.nan, 1, 1], 1.0),  # running means 2 1 - - 1 1
        ([1, np.nan, 4, np.nan, -2], 2.5),
    ):
        got = settling_time_s(np.array(samples, dtype=np.float32), rate_hz=2, tolerance_dps=0.5)
        assert got == seconds, samples
