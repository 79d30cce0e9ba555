import numpy as np
import pandas as pd
import pytest

from gyro_pipeline import windows
from gyro_pipeline.conventions import InputError
from gyro_pipeline.physics.bias import windows_at


def test_masked_samples_are_the_mean_of_their_window_which_is_dropped_if_it_lost_too_many():
    samples = np.random.default_rng(0).normal(3, 1, (2, 40)).astype(np.float32)
    samples[:, [5, 20, 21]] = np.nan
    masked = np.isnan(samples[0])
    assert windows.usable_starts(masked, 10).tolist() == [0, 10, 30]
    named = windows.usable_starts(masked, 10, np.array([12, 6, 25]))  # the first lost two
    assert named.tolist() == [6, 25]
    cut = windows_at(samples, 10, np.array([0, 10, 30]))
    assert cut.shape == (2, 3, 10)
    whole = [samples[:, 10:20], samples[:, 30:40]]
    np.testing.assert_array_equal(cut[:, 1:], np.stack(whole, axis=1))
    means = np.nanmean(samples[:, :10], axis=1)
    np.testing.assert_allclose(cut[:, 0, 5], means, rtol=1e-6)


def test_the_papers_windows_are_non_overlapping_slices_from_the_start(parameters):
    for sensor, size, count in (("sparkfun", 1494, 8), ("dot", 1083, 12), ("memsense", 2500, 5)):
        entry = parameters("base").sensors[sensor]
        assert windows.window_size(10, entry.rate_hz, entry.samples, sensor) == size
        starts = windows.usable_starts(np.zeros(entry.samples, bool), size)
        assert starts.tolist() == [size * number for number in range(count)]
    message = r"memsense: a window of 52.01 s is 13002 samples at 250 Hz, .* 13000 \(52 s\)"
    with pytest.raises(InputError, match=message):
        windows.window_size(52.01, 250.0, 13000, "memsense")
    with pytest.raises(InputError, match="memsense: a window of 0.001 s is 0 samples"):
        windows.window_size(0.001, 250.0, 13000, "memsense")


def test_a_table_has_the_windows_that_are_usable_at_any_stride_and_others_are_said():
    def contents(*masked):
        """Of two recordings of each IMU; the masked samples of each."""
        rows = pd.DataFrame({"imu": [1, 1, 2, 2], "recording": [1, 5, 1, 5]})
        return rows.assign(masked=[np.array(numbers, int) for numbers in masked])

    lost = contents([], [5, 6], [], range(0, 40, 5))
    found = windows.usable_windows(lost, 40, 10, 15)
    expected = [(1, 1, s) for s in (0, 15, 30)] + [(1, 5, s) for s in (15, 30)]
    expected += [(2, 1, s) for s in (0, 15, 30)]
    assert list(found.itertuples(index=False, name=None)) == expected
    assert not windows.describe_losses(contents([], [5], [], []), 40, 10)
    said = windows.describe_losses(contents([], [5, 6, 25, 26], [30, 31], range(0, 40, 5)), 45, 10)
    assert said.startswith("7 of 16 lost more than 10% of their samples and are left out")
    assert "the first one used of IMU 1 recording 5 is window 2" in said
    assert "IMU 2 recording 5 has no usable window, so it trains no network" in said
