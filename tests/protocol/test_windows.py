import numpy as np
import pytest

from gyro_pipeline.conventions import InputError
from gyro_pipeline.protocol.windows import (
    UsableWindows,
    cut_windows,
    usable_starts,
    window_size,
    window_starts,
)


@pytest.mark.parametrize(
    ("sensor", "window_s", "size", "count"),
    [
        ("sparkfun", 10, 1494, 8),
        ("sparkfun", 30, 4483, 2),
        ("dot", 10, 1083, 12),
        ("dot", 30, 3250, 4),
        ("ng", 10, 2000, 6),
        ("ng", 30, 6000, 2),
        ("memsense", 10, 2500, 5),
        ("memsense", 30, 7500, 1),
    ],
)
def test_the_papers_windows(parameters, sensor, window_s, size, count):
    entry = parameters("base").sensors[sensor]
    assert window_size(window_s, entry.rate_hz, entry.samples, sensor) == size
    assert cut_windows(np.zeros((3, entry.samples), np.float32), size).shape == (3, count, size)


def test_windows_are_non_overlapping_slices_from_the_start():
    samples = np.arange(2 * 3 * 23).reshape(2, 3, 23)
    windows = cut_windows(samples, 5)
    assert windows.shape == (2, 3, 4, 5)
    for k in range(4):
        np.testing.assert_array_equal(windows[:, :, k], samples[:, :, 5 * k : 5 * k + 5])


def test_windows_are_views():
    recordings = np.zeros((2, 4, 3, 23), np.float32)
    one = recordings[1, 2]
    windows = cut_windows(one, 5)
    assert np.shares_memory(windows, recordings)
    windows[0, 1, 2] = 7.0
    assert recordings[1, 2, 0, 7] == 7.0
    # Also where an axis before the samples is strided, as three IMUs' windows side by side are.
    assert np.shares_memory(cut_windows(recordings[:, 0], 5), recordings)


def test_windows_that_overlap_are_named_by_their_starts():
    samples = np.arange(2 * 23).reshape(2, 23)
    starts = window_starts(23, size=5, stride=3)
    assert starts.tolist() == [0, 3, 6, 9, 12, 15, 18]
    windows = cut_windows(samples, 5, starts)
    assert windows.shape == (2, 7, 5)
    for k, start in enumerate(starts):
        np.testing.assert_array_equal(windows[:, k], samples[:, start : start + 5])
    assert cut_windows(samples, 5, starts[:0]).shape == (2, 0, 5)


def test_starts_a_window_apart_are_the_non_overlapping_windows():
    samples = np.random.default_rng(0).normal(size=(3, 23))
    starts = window_starts(23, size=5, stride=5)
    np.testing.assert_array_equal(cut_windows(samples, 5, starts), cut_windows(samples, 5))


def test_masked_samples_are_the_mean_of_their_window_which_is_dropped_if_it_lost_too_many():
    samples = np.random.default_rng(0).normal(3, 1, (2, 40)).astype(np.float32)
    samples[:, [5, 20, 21]] = np.nan
    assert usable_starts(np.isnan(samples[0]), 10).tolist() == [0, 10, 30]
    assert usable_starts(np.isnan(samples[0]), 10, largest_masked_share=0.2).tolist() == [
        *(0, 10, 20, 30)
    ]
    windows = cut_windows(samples, 10)
    assert windows.shape == (2, 3, 10)
    whole = [samples[:, 10:20], samples[:, 30:40]]
    np.testing.assert_array_equal(windows[:, 1:], np.stack(whole, axis=1))
    means = np.nanmean(samples[:, :10], axis=1)
    np.testing.assert_allclose(windows[:, 0, 5], means, rtol=1e-6)
    np.testing.assert_allclose(windows[:, 0].mean(axis=1), means, rtol=1e-6)
    named = cut_windows(samples, 10, np.array([12, 6, 25]))  # the first lost two
    np.testing.assert_array_equal(named, np.stack([samples[:, 6:16], samples[:, 25:35]], axis=1))


def test_windows_that_are_left_out_are_said(make_recordings):
    recordings = make_recordings(np.zeros((2, 3, 3)), 40, 10.0, 1.0)
    assert not UsableWindows(recordings).losses(10)
    recordings.angular_rate[0, 1, :, [5, 6, 25, 26]] = np.nan
    recordings.angular_rate[1, 1, :, 30:] = np.nan
    windows = UsableWindows(recordings)
    assert windows.losses(10) == (
        "3 of 24 lost more than 10% of their samples and are left out; the first one used of IMU 1 "
        "recording 2 is window 2"
    )
    counts = [windows.count(imus, 2, 10) for imus in ([1], [2], [1, 2], [3])]
    assert counts == [2, 3, 1, 0]


def test_a_window_may_be_the_whole_recording():
    assert window_size(10, 10.0, 100, "dot") == 100
    assert cut_windows(np.zeros((3, 100)), 100).shape == (3, 1, 100)


@pytest.mark.parametrize(
    ("window_s", "message"),
    [
        (52.01, r"memsense: a window of 52.01 s is 13002 samples at 250 Hz, .* 13000 \(52 s\)"),
        (0.001, "memsense: a window of 0.001 s is 0 samples"),
        (-1.0, "memsense: a window of -1 s"),
    ],
)
def test_a_window_that_no_recording_holds_is_refused(window_s, message):
    with pytest.raises(InputError, match=message):
        window_size(window_s, 250.0, 13000, "memsense")
