import numpy as np
import pytest

from gyro_pipeline.conventions import AXES
from gyro_pipeline.parameters import GroundTruth
from gyro_pipeline.pipelines.ground_truth import nodes

NOISE = 0.005
RATE_HZ, SAMPLES = 20.0, 1200
TOLERANCE = GroundTruth(tolerance_mdps=2.0)


def test_settling_and_noise_are_those_of_samples_and_what_is_missing_has_no_row(make_recordings):
    """About large biases: sums in float32 would be off by more than the tolerances."""
    drawn = 300 + np.random.default_rng(1).uniform(-3, 3, (2, 12, 3))
    recordings = make_recordings(drawn, SAMPLES, RATE_HZ, NOISE)
    recordings.angular_rate[1, 4], recordings["samples"][1, 4] = np.nan, 0
    allan = nodes.measure_allan_variance(recordings)
    bias = nodes.measure_bias(recordings, allan, TOLERANCE)
    samples = recordings.angular_rate.to_numpy().astype(np.float64)
    for row in bias.itertuples():
        rates = samples[row.imu - 1, row.recording - 1, AXES.index(row.axis)]
        off = np.abs(np.cumsum(rates) / np.arange(1, 1 + SAMPLES) - rates.mean()) > 0.002
        assert row.settling_time_s == pytest.approx((np.flatnonzero(off)[-1] + 2) / RATE_HZ)
    assert len(bias) == (2 * 12 - 1) * 3
    assert not bias.isna().any(axis=None)
    assert bias[(bias.imu == 2) & (bias.recording == 5)].empty
    noise = nodes.measure_noise(recordings, allan, bias)
    assert noise[["imu", "axis"]].to_numpy().tolist() == [[i, a] for i in (1, 2) for a in AXES]
    np.testing.assert_allclose(noise.white_dps_rts, NOISE, rtol=0.08)
    np.testing.assert_allclose(noise.sample_sigma_dps, NOISE * np.sqrt(RATE_HZ), rtol=0.02)
    # what is left for flicker hardly matters over a whole recording
    assert (noise.instability_dps < 0.2 * NOISE).all()


def test_each_recording_counts_with_its_own_length_and_unmasked_samples_in_float64(make_recordings):
    """IMUs 2 and 3 with recordings of 60, 40 and 50 s; ten samples of one are masked."""
    uneven = make_recordings(np.full((2, 3, 3), 300.0), SAMPLES, RATE_HZ, NOISE, seed=3)
    uneven = uneven.assign_coords(imu=[2, 3])
    uneven["samples"][:, 1], uneven["samples"][:, 2] = 800, 1000
    uneven.angular_rate[:, 1, :, 800:], uneven.angular_rate[:, 2, :, 1000:] = np.nan, np.nan
    uneven.angular_rate[0, 0, :, 400:410] = np.nan
    allan = nodes.measure_allan_variance(uneven)
    bias = nodes.measure_bias(uneven, allan, TOLERANCE)
    noise = nodes.measure_noise(uneven, allan, bias).set_index(["imu", "axis"])
    for row in bias.itertuples():
        one = uneven.angular_rate.sel(imu=row.imu, recording=row.recording, axis=row.axis)
        measured = one.to_numpy().astype(np.float64)
        measured = measured[~np.isnan(measured)]
        assert row.bias_dps == pytest.approx(measured.mean(), rel=1e-13)
        assert row.sample_sigma_dps == pytest.approx(measured.std(ddof=1), rel=1e-9)
        white = noise.white_dps_rts[row.imu, row.axis]
        expected = white / np.sqrt(len(measured) / RATE_HZ)
        assert row.standard_error_dps == pytest.approx(expected, rel=1e-12)
    np.testing.assert_allclose(noise.white_dps_rts, NOISE, rtol=0.25)
    assert allan.time_s.max() == 60 / 5
    longest = allan.differences.sel(imu=2).isel(time_s=-1)
    assert longest.to_numpy().tolist() == [1190 - 480 + 1, 800 - 480 + 1, 1000 - 480 + 1]


def test_what_is_too_short_for_a_fit_has_a_bias_and_one_warning(make_recordings, caplog):
    short = make_recordings(np.ones((2, 3, 3)), 30, RATE_HZ, NOISE).assign_coords(imu=[2, 3])
    allan = nodes.measure_allan_variance(short)
    bias = nodes.measure_bias(short, allan, TOLERANCE)
    np.testing.assert_allclose(bias.bias_dps, 1, atol=0.1)
    assert bias.standard_error_dps.isna().all()
    noise = nodes.measure_noise(short, allan, bias)
    figures = noise[["white_dps_rts", "instability_dps", "random_walk_dps_per_rts"]]
    assert figures.isna().all(axis=None) and len(noise) == 3 * 2
    (message,) = caplog.messages
    assert message.startswith("sparkfun: N, B and K of IMU 2, 3 are left empty, and with them")
