"""Which windows train, in which order, and how they are centred and scaled."""

import numpy as np
import pytest
import xarray as xr

from gyro_pipeline.learning.examples import (
    NetworkInput,
    device_centres,
    scaled_examples,
    training_examples,
    with_shuffled_labels,
)
from gyro_pipeline.learning.network import Architecture
from gyro_pipeline.learning.packing import Layout

WINDOW, STRIDE = 20, 5


def packed(gyroscopes, window, *sizes):
    return Layout(gyroscopes, window, Architecture(gyroscopes, window, *sizes))


ONE_IMU = packed(3, WINDOW, 2, 5, STRIDE, 2, 4)


def labelled(array, dims=("imu", "recording", "axis", "sample")):
    """Labels as everywhere: IMUs and recordings from 1, axes by name."""
    numbers = [np.arange(1, size + 1) for size in array.shape[:2]]
    coords = {"imu": numbers[0], "recording": numbers[1], "axis": ["x", "y", "z"]}
    return xr.DataArray(array, dims=dims[: array.ndim], coords=coords)


def noise_on(bias, samples, seed=0):
    noise = np.random.default_rng(seed).normal(scale=0.5, size=(*bias.shape, samples))
    return (bias[..., None] + noise).astype(np.float32)


def drawn(imus=2, recordings=6, samples=50, seed=3):
    """Recordings whose IMUs lie far apart, and their biases."""
    generator = np.random.default_rng(seed)
    unit = generator.normal(scale=10, size=(imus, 1, 3))
    bias = unit + generator.normal(scale=0.1, size=(imus, recordings, 3))
    return noise_on(bias, samples, seed), bias


def device(rates, bias, imus=(1,), numbers=(1, 2, 3), starts=None, size=WINDOW):
    """All non-overlapping windows of each recording, unless some are named."""
    labels = labelled(bias).sel(imu=list(imus), recording=list(numbers))
    biases = labels.transpose("recording", "imu", "axis").to_numpy().reshape(len(numbers), -1)
    starts = starts or (np.arange(0, rates.shape[-1] - size + 1, size),) * len(numbers)
    return NetworkInput(labelled(rates), imus, numbers, biases, starts)


def unpacked(examples, gyroscopes):
    """Windows (n, gyroscopes, samples) back from packed ones, by the layout's definition."""
    n, blocks, _ = examples.inputs.shape
    used = examples.inputs[:, :, : gyroscopes * STRIDE]
    cells = used.reshape(n, blocks, gyroscopes, STRIDE).transpose(0, 2, 1, 3)
    return cells.reshape(n, gyroscopes, blocks * STRIDE)


def test_imus_side_by_side_are_in_order_of_imu_then_axis():
    imu, recording, axis = np.ogrid[1:4, 1:5, 1:4]
    bias = 100.0 * imu + 10 * recording + axis  # 213 is IMU 2, recording 1, z
    rates = np.repeat(bias[..., None], 7, axis=-1).astype(np.float32)
    both = device(rates, bias, imus=(1, 3), numbers=(4, 2))
    expected = [[141, 142, 143, 341, 342, 343], [121, 122, 123, 321, 322, 323]]
    np.testing.assert_array_equal(both.biases, expected)
    for samples, wanted in zip(both.samples(), expected, strict=True):
        assert samples.shape == (6, 7)
        np.testing.assert_array_equal(samples, np.repeat(np.array(wanted)[:, None], 7, axis=1))


def test_centring_per_device_and_with_one_mean_for_all_by_hand():
    bias = np.array([[[1.0, 2, 3], [3, 4, 5]], [[10, 20, 30], [50, 60, 70]]])
    rates = noise_on(bias, 40)
    first = device(rates, bias, (1,), (1, 2))
    second = device(rates, bias, (2,), (2,))  # one recording: it counts half as much
    own = device_centres([first, second], "per_device")
    np.testing.assert_array_equal(own, [[2, 3, 4], [50, 60, 70]])
    overall = (1 + 2 + 3 + 3 + 4 + 5 + 50 + 60 + 70) / 9
    shared = device_centres([first, second], "global")
    np.testing.assert_allclose(shared, np.full((2, 3), overall), rtol=1e-15)


@pytest.mark.parametrize("centring", ["per_device", "global"])
def test_examples_are_the_windows_of_each_recording_in_turn_scaled_by_hand(centring):
    rates, bias = drawn(samples=50)
    devices = [device(rates, bias, (1,), (1, 2, 3)), device(rates, bias, (2,), (4, 2))]
    examples, scaling = training_examples(devices, ONE_IMU, centring)
    assert examples.inputs.dtype == examples.targets.dtype == np.float32
    assert len(examples.inputs) == len(examples.targets) == 2 * (3 + 2)
    used = [(0, 0), (0, 1), (0, 2), (1, 3), (1, 1)]  # imu and recording, from 0
    if centring == "per_device":
        centres = [bias[0, :3].mean(axis=0)] * 3 + [bias[1, [3, 1]].mean(axis=0)] * 2
    else:
        centres = [np.full(3, np.mean([bias[place] for place in used]))] * 5
    windows, targets = [], []
    for place, centre in zip(used, centres, strict=True):
        centred = rates[place] - centre[:, None]
        windows += [centred[:, :20], centred[:, 20:40]]
        targets += [bias[place] - centre] * 2
    input_scale, target_scale = (np.sqrt(np.mean(np.square(x))) for x in (windows, targets))
    assert scaling.input_scale == pytest.approx(input_scale, rel=1e-5)
    assert scaling.target_scale == pytest.approx(target_scale, rel=1e-5)
    np.testing.assert_allclose(scaling.centres[0], centres[0], rtol=1e-12)
    got = unpacked(examples, 3) * scaling.input_scale
    np.testing.assert_allclose(got, windows, atol=2e-6 * np.abs(rates).max())
    np.testing.assert_allclose(examples.targets * target_scale, targets, atol=2e-6)


@pytest.mark.parametrize("centring", ["per_device", "global"])
def test_scaling_comes_from_training_recordings_of_training_devices_only(centring):
    rates, bias = drawn(imus=3)
    changed_rates, changed_bias = rates.copy(), bias.copy()
    changed_rates[:, 3:] *= 1000  # recordings that validate or test
    changed_bias[:, 3:] += 1000
    changed_rates[2], changed_bias[2] = np.nan, np.nan  # a device that does not train
    before, scaling = training_examples(
        [device(rates, bias, (1,)), device(rates, bias, (2,))], ONE_IMU, centring
    )
    after, same = training_examples(
        [device(changed_rates, changed_bias, (imu,)) for imu in (1, 2)], ONE_IMU, centring
    )
    np.testing.assert_array_equal(before.inputs, after.inputs)
    np.testing.assert_array_equal(before.targets, after.targets)
    np.testing.assert_array_equal(scaling.centres, same.centres)
    assert (scaling.input_scale, scaling.target_scale) == (same.input_scale, same.target_scale)


@pytest.mark.parametrize("centring", ["per_device", "global"])
def test_other_recordings_are_scaled_as_the_test_device_in_training(centring):
    rates, bias = drawn()
    devices = [device(rates, bias, (1,)), device(rates, bias, (2,))]
    examples, scaling = training_examples(devices, ONE_IMU, centring)
    again = scaled_examples(devices[0], ONE_IMU, scaling)
    np.testing.assert_array_equal(again.inputs, examples.inputs[:6])
    np.testing.assert_array_equal(again.targets, examples.targets[:6])
    other = scaled_examples(device(rates, bias, (1,), (5,)), ONE_IMU, scaling)
    wanted = (rates[0, 4] - scaling.centres[0][:, None]) / scaling.input_scale
    np.testing.assert_allclose(unpacked(other, 3), [wanted[:, :20], wanted[:, 20:40]], atol=1e-4)
    wanted = (bias[0, 4] - scaling.centres[0]) / scaling.target_scale
    np.testing.assert_allclose(other.targets, [wanted] * 2, rtol=1e-5)


def test_windows_may_be_named_by_their_starts_and_masked_samples_are_the_mean_of_theirs():
    rates, bias = drawn(samples=50)
    rates[0, 1, :, 8] = np.nan  # in the only window of recording 2
    starts = (np.array([0, 3, 30]), np.array([7]), np.array([5, 5]))
    chosen = device(rates, bias, starts=starts)
    assert (device(rates, bias).windows, chosen.windows) == (6, 6)
    examples, scaling = training_examples([chosen], ONE_IMU, "per_device")
    places = [(number, start) for number in range(3) for start in starts[number]]
    windows = np.array([rates[0, number, :, start : start + WINDOW] for number, start in places])
    windows[3, :, 1] = np.nanmean(windows[3], axis=1)
    got = unpacked(examples, 3) * scaling.input_scale + scaling.centres[0][:, None]
    np.testing.assert_allclose(got, windows, atol=2e-6 * np.nanmax(np.abs(rates)))
    targets = examples.targets * scaling.target_scale + scaling.centres[0]
    np.testing.assert_allclose(targets, [bias[0, number] for number, _ in places], atol=2e-6 * 10)


def test_shuffled_labels_are_permuted_for_each_gyroscope_on_its_own():
    rates, bias = drawn(imus=2, recordings=9)
    numbers = (1, 2, 3, 5, 6, 7, 8, 9)
    both = device(rates, bias, (2, 1), numbers)
    shuffled = with_shuffled_labels(both, np.random.default_rng(0))
    before, after = both.biases, shuffled.biases
    np.testing.assert_array_equal(np.sort(before, axis=0), np.sort(after, axis=0))
    orders = [tuple(np.argsort(np.argsort(column))) for column in after.T]
    assert len(set(orders)) == 6
    assert both.biases is before  # what was given is not changed
