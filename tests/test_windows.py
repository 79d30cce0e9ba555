import numpy as np
import pandas as pd
import pytest

from gyro_pipeline.conventions import InputError
from gyro_pipeline.windows import (
    cut_windows,
    describe_losses,
    usable_starts,
    usable_windows,
    window_size,
)


@pytest.mark.parametrize(
    ("sensor", "window_s", "size", "count"),
    [
        ("sparkfun", 10, 1494, 8),
        ("dot", 10, 1083, 12),
        ("memsense", 10, 2500, 5),
    ],
)
def test_the_papers_windows(parameters, sensor, window_s, size, count):
    entry = parameters("base").sensors[sensor]
    assert window_size(window_s, entry.rate_hz, entry.samples, sensor) == size
    assert cut_windows(np.zeros((3, entry.samples), np.float32), size).shape == (3, count, size)


def test_windows_are_non_overlapping_slices_from_the_start_without_a_copy():
    samples = np.arange(2 * 3 * 23).reshape(2, 3, 23)
    windows = cut_windows(samples, 5)
    assert windows.shape == (2, 3, 4, 5)
    for k in range(4):
        np.testing.assert_array_equal(windows[:, :, k], samples[:, :, 5 * k : 5 * k + 5])
    assert np.shares_memory(windows, samples)
    assert cut_windows(samples, 23).shape == (2, 3, 1, 23)


def test_masked_samples_are_the_mean_of_their_window_which_is_dropped_if_it_lost_too_many():
    samples = np.random.default_rng(0).normal(3, 1, (2, 40)).astype(np.float32)
    samples[:, [5, 20, 21]] = np.nan
    masked = np.isnan(samples[0])
    assert usable_starts(masked, 10).tolist() == [0, 10, 30]
    assert usable_starts(masked, 10, largest_masked_share=0.2).tolist() == [0, 10, 20, 30]
    windows = cut_windows(samples, 10)
    assert windows.shape == (2, 3, 10)
    whole = [samples[:, 10:20], samples[:, 30:40]]
    np.testing.assert_array_equal(windows[:, 1:], np.stack(whole, axis=1))
    means = np.nanmean(samples[:, :10], axis=1)
    np.testing.assert_allclose(windows[:, 0, 5], means, rtol=1e-6)
    named = cut_windows(samples, 10, np.array([12, 6, 25]))  # the first lost two
    np.testing.assert_array_equal(named, np.stack([samples[:, 6:16], samples[:, 25:35]], axis=1))


def contents(*masked):
    """Of two recordings of each IMU; the masked samples of each."""
    rows = pd.DataFrame({"imu": [1, 1, 2, 2], "recording": [1, 5, 1, 5]})
    return rows.assign(masked=[np.array(numbers, int) for numbers in masked])


def test_a_table_has_the_windows_that_are_usable_at_any_stride():
    lost = contents([], [5, 6], [], range(0, 40, 5))
    found = usable_windows(lost, 40, 10, 15)
    expected = [(1, 1, s) for s in (0, 15, 30)] + [(1, 5, s) for s in (15, 30)]
    expected += [(2, 1, s) for s in (0, 15, 30)]
    assert list(found.itertuples(index=False, name=None)) == expected
    assert usable_windows(lost.iloc[3:], 40, 10, 10).empty


def test_windows_that_are_left_out_are_said():
    assert not describe_losses(contents([], [5], [], []), 40, 10)
    assert describe_losses(contents([], [5, 6, 25, 26], [30, 31], range(0, 40, 5)), 45, 10) == (
        "7 of 16 lost more than 10% of their samples and are left out; the first one used of IMU 1 "
        "recording 5 is window 2; none is left of IMU 2 recording 5, so it trains no network and "
        "tests none"
    )


@pytest.mark.parametrize(
    ("window_s", "message"),
    [
        (52.01, r"memsense: a window of 52.01 s is 13002 samples at 250 Hz, .* 13000 \(52 s\)"),
        (0.001, "memsense: a window of 0.001 s is 0 samples"),
    ],
)
def test_a_window_that_no_recording_holds_is_refused(window_s, message):
    with pytest.raises(InputError, match=message):
        window_size(window_s, 250.0, 13000, "memsense")
