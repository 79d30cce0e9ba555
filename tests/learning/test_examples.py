"""Which windows train, in which order, and how they are centred and scaled."""

import numpy as np
import pytest

from gyro_pipeline.learning import examples as module
from gyro_pipeline.learning.examples import scaled_examples, training_examples
from gyro_pipeline.learning.network import Architecture
from gyro_pipeline.learning.packing import Layout

WINDOW, STRIDE = 20, 5
ONE_IMU = Layout(3, WINDOW, Architecture(3, WINDOW, 2, 5, STRIDE, 2, 4))
CENTRINGS = pytest.mark.parametrize("centring", ["per_device", "global"])


@pytest.fixture
def drawn(recorded):
    """Rates of recordings whose IMUs lie far apart, and their biases."""

    def made(imus=2):
        return recorded(imus, recordings=6, samples=50, spread=0.1, noise=0.5, seed=3)

    return made


def unpacked(examples):
    """Windows (n, axes, samples) back from packed ones, by the layout's definition."""
    n, blocks, _ = examples.inputs.shape
    cells = examples.inputs[:, :, : 3 * STRIDE].reshape(n, blocks, 3, STRIDE)
    return cells.transpose(0, 2, 1, 3).reshape(n, 3, blocks * STRIDE)


def test_imus_side_by_side_are_in_order_of_imu_then_axis(recorded, device):
    rates, labels = recorded(imus=3)
    both = device(rates, labels, (1, 3), (4, 2), WINDOW)
    for samples, number in zip(both.samples(), (4, 2), strict=True):
        expected = rates.sel(imu=[1, 3], recording=number).to_numpy().reshape(6, -1)
        np.testing.assert_array_equal(samples, expected)


@CENTRINGS
def test_examples_are_the_windows_of_each_recording_in_turn_scaled_by_hand(drawn, device, centring):
    """The second device has fewer recordings, and counts less where all have one centre."""
    recordings = drawn()
    places = ((1,), (1, 2, 3)), ((2,), (4, 2))
    devices = [device(*recordings, *place, WINDOW) for place in places]
    examples, scaling = training_examples(devices, ONE_IMU, centring)
    assert examples.inputs.dtype == examples.targets.dtype == np.float32
    rates, bias = (one.to_numpy() for one in recordings)
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
    got = unpacked(examples) * scaling.input_scale
    np.testing.assert_allclose(got, windows, atol=2e-6 * np.abs(rates).max())
    np.testing.assert_allclose(examples.targets * target_scale, targets, atol=2e-6)


@CENTRINGS
def test_scaling_comes_from_training_recordings_of_training_devices_only(drawn, device, centring):
    rates, bias = drawn(imus=3)
    changed_rates, changed_bias = rates.copy(deep=True), bias.copy(deep=True)
    changed_rates[:, 3:] *= 1000  # recordings that validate or test
    changed_bias[:, 3:] += 1000
    changed_rates[2], changed_bias[2] = np.nan, np.nan  # a device that does not train
    (before, scaling), (after, same) = (
        training_examples(
            [device(*data, (imu,), (1, 2, 3), WINDOW) for imu in (1, 2)], ONE_IMU, centring
        )
        for data in ((rates, bias), (changed_rates, changed_bias))
    )
    np.testing.assert_array_equal(before.inputs, after.inputs)
    np.testing.assert_array_equal(before.targets, after.targets)
    np.testing.assert_array_equal(scaling.centres, same.centres)
    assert (scaling.input_scale, scaling.target_scale) == (same.input_scale, same.target_scale)


@CENTRINGS
def test_other_recordings_are_scaled_as_the_test_device_in_training(drawn, device, centring):
    rates, bias = drawn()
    devices = [device(rates, bias, (imu,), (1, 2, 3), WINDOW) for imu in (1, 2)]
    examples, scaling = training_examples(devices, ONE_IMU, centring)
    again = scaled_examples(devices[0], ONE_IMU, scaling)
    np.testing.assert_array_equal(again.inputs, examples.inputs[:6])
    np.testing.assert_array_equal(again.targets, examples.targets[:6])
    other = scaled_examples(device(rates, bias, (1,), (5,), WINDOW), ONE_IMU, scaling)
    wanted = (rates.to_numpy()[0, 4] - scaling.centres[0][:, None]) / scaling.input_scale
    np.testing.assert_allclose(unpacked(other), [wanted[:, :20], wanted[:, 20:40]], atol=1e-4)
    wanted = (bias.to_numpy()[0, 4] - scaling.centres[0]) / scaling.target_scale
    np.testing.assert_allclose(other.targets, [wanted] * 2, rtol=1e-5)


def test_windows_may_be_named_by_starts_and_masked_samples_are_the_mean_of_theirs(drawn, device):
    rates, bias = drawn()
    rates[0, 1, :, 8] = np.nan  # in the only window of recording 2
    starts = (np.array([0, 3, 30]), np.array([7]), np.array([5, 5]))
    chosen = device(rates, bias, (1,), (1, 2, 3), WINDOW, starts)
    assert chosen.windows == 6
    examples, scaling = training_examples([chosen], ONE_IMU, "per_device")
    places = [(number, start) for number in range(3) for start in starts[number]]
    samples = rates.to_numpy()[0]
    windows = np.array([samples[number, :, start : start + WINDOW] for number, start in places])
    windows[3, :, 1] = np.nanmean(windows[3], axis=1)
    got = unpacked(examples) * scaling.input_scale + scaling.centres[0][:, None]
    np.testing.assert_allclose(got, windows, atol=2e-6 * np.nanmax(np.abs(samples)))
    targets = examples.targets * scaling.target_scale + scaling.centres[0]
    expected = [bias.to_numpy()[0, number] for number, _ in places]
    np.testing.assert_allclose(targets, expected, atol=2e-5)


def test_shuffled_labels_are_permuted_for_each_gyroscope_on_its_own(recorded, device):
    both = device(*recorded(), (2, 1), (1, 2, 3, 5, 6, 7, 8, 9), WINDOW)
    before = both.biases.copy()
    after = module.with_shuffled_labels(both, np.random.default_rng(0)).biases
    np.testing.assert_array_equal(np.sort(before, axis=0), np.sort(after, axis=0))
    orders = [tuple(np.argsort(np.argsort(column))) for column in after.T]
    assert len(set(orders)) == 6
    np.testing.assert_array_equal(both.biases, before)  # what was given is not changed
