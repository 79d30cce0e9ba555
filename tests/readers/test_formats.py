"""Vendors' headers: a format is claimed only by one that no other vendor writes."""

import numpy as np
import pytest

from gyro_pipeline.conventions import InputError
from gyro_pipeline.readers import FORMATS

X = np.random.default_rng(0).normal((0.7, -0.4, 0.15), 0.05, (600, 3))
N = len(X)
K = np.arange(N)
S = K / 100
RAD = np.pi / 180
ACC = X + 9.8
MS2 = 1 / 9.80665
CLOCK = [f"12:00:{k // 100:02d}.{k % 100:02d}" for k in range(N)]
XSENS = "PacketCounter,SampleTimeFine,Acc_X,Acc_Y,Acc_Z,Gyr_X,Gyr_Y,Gyr_Z"
MT = "// General information:\n//  MT Manager version: 2022.2.0\n// Update Rate: 100.0Hz"
ROS = "field.angular_velocity.{0},field.linear_acceleration.{0}"
PX4 = "gyro_rad[{0}],accelerometer_m_s2[{0}]"


def axes(name, names="xyz"):
    """A column about each axis; of several names, one after the other."""
    return ",".join(text.format(axis) for text in name.split(",") for axis in names)


# name of the format (None: its header says all), header, columns, lines above, g in an acceleration
LOGGERS = [
    ("movella_dot", f"{XSENS},Euler_X", [K, S * 1e6, ACC, X, S], "", MS2),
    ("movella_dot", XSENS, [K, S * 1e6, ACC, X], "DeviceTag:,1\nOutputRate:,100Hz", MS2),
    ("xsens_mt_manager", f"{XSENS},Quat_q0", [K, S * 1e4, ACC, X * RAD, S], MT, MS2),
    ("movella_dot_angles", f"Time,phi,theta,psi,{axes('f_{},w_{}')},", [S, ACC, ACC, X, S],
     "", MS2),
    ("openlog_artemis", f"rtcDate,rtcTime,{axes('a{},g{},m{}', 'XYZ')},output_Hz",
     [["07/31/2022"] * N, CLOCK, ACC, X, ACC, S * 0 + 90], "", 1e-3),
    ("ros_imu", f"%time,{axes(ROS)}", [1.7e18 + S * 1e9, X * RAD, ACC], "", MS2),
    ("px4_sensor_combined", f"timestamp,{axes(PX4, '012')}", [S * 1e6, X * RAD, ACC], "", MS2),
    (None, f"Time (s),{axes('Gyroscope {} (deg/s),Accelerometer {} (g)', 'XYZ')},Barometer (hPa)",
     [S, X, ACC, S], "", 1),  # NGIMU; x-IMU3 has Timestamp (us)
    (None, f"Time (s),{axes('Gyroscope {} (rad/s)')},Absolute (rad/s)", [S, X * RAD, S], "", None),
    (None, "Shimmer_EE5D_Timestamp_Unix_CAL [ms]," + axes(
        "Shimmer_EE5D_Accel_LN_{}_CAL [m/(s^2)],Shimmer_EE5D_Gyro_{}_CAL [deg/s]", "XYZ"),
     [1.6e12 + S * 1e3, ACC, X], "", MS2),
]  # fmt: skip


@pytest.mark.parametrize(("name", "header", "columns", "preamble", "g"), LOGGERS)
def test_loggers_are_told_by_header_and_read_in_deg_per_s(name, header, columns, preamble, g, read):
    log = read(header, *columns, preamble=preamble, rate_hz=100)
    np.testing.assert_allclose(log.samples, X, rtol=1e-9)
    assert log.rate_hz == pytest.approx(100)
    if g:
        np.testing.assert_allclose(log.acceleration_g, ACC * g)
    assert [finding.check for finding in log.findings] == ["unit"] * bool(name)
    if name:
        assert FORMATS[name].source
        forced = read(header, *columns, preamble=preamble, format=name)
        np.testing.assert_array_equal(forced.samples, log.samples)


def test_a_format_that_is_contradicted_or_wrong_is_refused(read):
    for options, words in (
        ({"units": "rad/s"}, "units of the options are rad/s, but the format has deg/s.*trust"),
        ({"preamble": "# rad/s"}, "lines above the header say rad/s, but the format has deg/s"),
        ({"format": "openlog_artemis"}, "artemis has a column 'gX', got 'PacketCounter'"),
        ({"format": "general"}, "expected a unit of the rates"),
    ):
        with pytest.raises(InputError, match=words):
            read(LOGGERS[0][1], *LOGGERS[0][2], **options)
