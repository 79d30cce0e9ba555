"""Allan variances against published figures, and noise figures fitted to them."""

import json
from pathlib import Path

import numpy as np
import pytest

from gyro_pipeline.conventions import MDPS, InputError
from gyro_pipeline.physics import allan

GOLDEN = json.loads((Path(__file__).parent / "golden" / "overlapping_allan.json").read_text())
RATE = 100.0
SAMPLES = 10_000


def variance_of(samples, rate, times):
    return allan.allan_variance(samples, rate, times)[0]


def mean_of(recordings, rate, times):
    each = [allan.allan_variance(samples, rate, times) for samples in recordings]
    return allan.mean_variance(*map(np.stack, zip(*each, strict=True)))


def fit_mean(recordings, rate):
    length = recordings.shape[-1]
    times = allan.averaging_times_s(length, rate)
    variance = mean_of(recordings, rate, times)
    return allan.fit_noise(times, variance, length / rate, allan.SHORTEST_FIT_SAMPLES / rate)


def test_nist_sp1065_thousand_points():
    golden = GOLDEN["thousand_points"]
    numbers = [golden["seed"]]
    for _ in range(999):
        numbers.append(golden["multiplier"] * numbers[-1] % golden["modulus"])
    samples = np.array(numbers) / golden["modulus"]
    deviation = np.sqrt(variance_of(samples, 1.0, np.array(golden["averaging_factors"])))
    np.testing.assert_allclose(deviation, golden["deviation"], rtol=2e-7)


def test_averaging_times_are_whole_samples_up_to_a_fifth_and_all_usable(rate=13000 / 87):
    for n_samples in (60, 130, 13_000):
        times = allan.averaging_times_s(n_samples, rate)
        factors = np.rint(times * rate)
        np.testing.assert_allclose(times * rate, factors, rtol=1e-12)
        assert np.all(np.diff(factors) >= 1)
        assert (factors[0], factors[-1]) == (1, n_samples // 5)
        assert (18 if n_samples == 13_000 else 0) <= times.size <= 20
        noise = np.random.default_rng(3).normal(size=n_samples)
        assert np.all(variance_of(noise, rate, times) > 0)
    for time in (0.0, 0.004, 0.015):
        with pytest.raises(InputError, match="multiples of the sample period"):
            allan.allan_variance(np.zeros(1000), RATE, np.array([0.02, time]))


def test_masked_samples_part_stretches_that_are_pooled_by_their_counts():
    samples = np.random.default_rng(6).normal(size=400)
    samples[150:170] = np.nan
    factors = np.array([1, 8, 90, 200])
    variance, counts = allan.allan_variance(samples, 1.0, factors)
    parts = samples[:150], samples[170:]
    first, second = (allan.allan_variance(part, 1.0, factors) for part in parts)
    expected = allan.mean_variance(np.stack([first[0], second[0]]), np.stack([first[1], second[1]]))
    np.testing.assert_allclose(variance[:3], expected[:3], rtol=1e-13)
    assert np.isnan(first[0][2])  # too short
    assert counts.tolist() == [150 - 1 + 230 - 1, 150 - 15 + 230 - 15, 230 - 179, 0]


def test_white_noise_falls_with_slope_minus_one_half_and_gives_its_n():
    sigma = 0.05
    recordings = np.random.default_rng(8).normal(0, sigma, (40, SAMPLES))
    times = allan.averaging_times_s(SAMPLES, RATE)
    deviation = np.sqrt(mean_of(recordings, RATE, times))
    assert np.polyfit(np.log(times), np.log(deviation), 1)[0] == pytest.approx(-0.5, abs=0.02)
    fitted = fit_mean(recordings, RATE)
    assert fitted.white == pytest.approx(sigma / np.sqrt(RATE), rel=0.02)
    # what is left for B and K lies below the white noise of the longest averages
    longest = sigma / np.sqrt(RATE * times[-1])
    assert fitted.instability < 0.5 * longest
    assert fitted.random_walk * np.sqrt(times[-1] / 3) < 0.5 * longest


def test_an_exact_curve_gives_its_three_terms_back():
    times = np.geomspace(0.1, 20, 15)
    n, b, k = 5 * MDPS, 3 * MDPS, 1 * MDPS
    curve = n**2 / times + allan.FLICKER_FLOOR * b**2 + k**2 * times / 3
    fitted = allan.fit_noise(times, curve, 100.0, shortest_s=0.1)
    assert np.sqrt(allan.FLICKER_FLOOR) == pytest.approx(0.664, abs=5e-4)  # IEEE Std 952
    assert (fitted.white, fitted.instability, fitted.random_walk) == pytest.approx((n, b, k))


def test_times_before_the_shortest_have_no_influence_and_variances_are_positive():
    times = allan.averaging_times_s(SAMPLES, RATE)
    curve = 1e-4 / times
    curve[times < 0.08] *= 3
    assert allan.fit_noise(times, curve, 100.0, shortest_s=0.08).white == pytest.approx(0.01)
    assert allan.fit_noise(times, curve, 100.0, shortest_s=0.0).white > 0.011
    for value in (0.0, np.nan):
        curve[2:] = value
        with pytest.raises(InputError, match="positive Allan variance"):
            allan.fit_noise(times, curve, 100.0, shortest_s=0.0)


def test_real_memsense_white_noise(real_file):
    recordings = np.load(real_file("memsense_test_real.npy"))  # (recording, axis, sample), 250 Hz
    white = [fit_mean(recordings[:, axis], 250.0).white for axis in range(3)]
    np.testing.assert_allclose(white, np.array([5.3, 4.7, 6.0]) * MDPS, rtol=0.05)
