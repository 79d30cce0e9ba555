"""Vendors' headers: a format is claimed only by one that no other vendor writes."""

import numpy as np
import pytest
from device_tables import read, said, still

from gyro_pipeline.conventions import InputError
from gyro_pipeline.readers import FORMATS
from gyro_pipeline.units import read_unit

X = still(600)
N = len(X)
K = np.arange(N)
S = K / 100
RAD = np.pi / 180
ACC = (X + 9.8) * 1.0
BLANK = S * np.nan
CLOCK = [f"12:00:{k // 100:02d}.{k % 100:02d}" for k in range(N)]
XSENS = "PacketCounter,SampleTimeFine,Acc_X,Acc_Y,Acc_Z,Gyr_X,Gyr_Y,Gyr_Z"
GCSV = "GYROFLOW IMU LOG\nversion,1.3\norientation,YxZ\ntscale,0.001\ngscale,0.00106423\nascale,0.5"
MT = "// General information:\n//  MT Manager version: 2022.2.0\n// Update Rate: 100.0Hz"

# name of the format (None: its header says all), header, columns, lines above, m/s^2 or g of a unit
LOGGERS = [
    ("movella_dot", f"{XSENS},Euler_X", [K, S * 1e6, ACC, X, S], "", 1 / 9.80665),
    ("movella_dot", f"{XSENS},dq_W", [K, S * 1e6, ACC, X, S], "", 1 / 9.80665),
    ("movella_dot", XSENS, [K, S * 1e6, ACC, X], "DeviceTag:,1\nOutputRate:,100Hz", 1 / 9.80665),
    ("xsens_mt_manager", f"{XSENS},Quat_q0", [K, S * 1e4, ACC, X * RAD, S], MT, 1 / 9.80665),
    ("movella_dot_angles", "Time,phi,theta,psi,f_x,f_y,f_z,w_x,w_y,w_z,", [S, ACC, ACC, X, BLANK],
     "", 1 / 9.80665),
    ("openlog_artemis", "rtcDate,rtcTime,aX,aY,aZ,gX,gY,gZ,mX,mY,mZ,imu_degC,output_Hz,",
     [["07/31/2022"] * N, CLOCK, ACC, X, ACC, 25 + S, S * 0 + 90, BLANK], "", 1e-3),
    ("gyroflow", "t,gx,gy,gz,ax,ay,az", [S * 1e3, X * RAD / 0.00106423, ACC], GCSV, 0.5),
    ("ros_imu", "%time,field.header.seq,field.angular_velocity.x,field.angular_velocity.y,"
     "field.angular_velocity.z,field.linear_acceleration.x,field.linear_acceleration.y,"
     "field.linear_acceleration.z", [1.7e18 + S * 1e9, K, X * RAD, ACC], "", 1 / 9.80665),
    ("ros_imu", "Time,angular_velocity.x,angular_velocity.y,angular_velocity.z",
     [S, X * RAD], "", None),
    ("px4_sensor_combined", "timestamp,gyro_rad[0],gyro_rad[1],gyro_rad[2],gyro_integral_dt,"
     "accelerometer_m_s2[0],accelerometer_m_s2[1],accelerometer_m_s2[2]",
     [S * 1e6, X * RAD, S * 0 + 1e4, ACC], "", 1 / 9.80665),
    (None, "Time (s),Gyroscope X (deg/s),Gyroscope Y (deg/s),Gyroscope Z (deg/s),Accelerometer X "
     "(g),Accelerometer Y (g),Accelerometer Z (g),Barometer (hPa)", [S, X, ACC, S], "", 1),  # NGIMU
    (None, "Timestamp (us),Gyroscope X (deg/s),Gyroscope Y (deg/s),Gyroscope Z (deg/s),"
     "Accelerometer X (g),Accelerometer Y (g),Accelerometer Z (g)", [S * 1e6, X, ACC], "", 1),
    (None, "Time (s),Gyroscope x (rad/s),Gyroscope y (rad/s),Gyroscope z (rad/s),Absolute (rad/s)",
     [S, X * RAD, S], "", None),  # phyphox
    (None, "Shimmer_EE5D_Timestamp_Unix_CAL [ms],Shimmer_EE5D_Accel_LN_X_CAL [m/(s^2)],"
     "Shimmer_EE5D_Accel_LN_Y_CAL [m/(s^2)],Shimmer_EE5D_Accel_LN_Z_CAL [m/(s^2)],"
     "Shimmer_EE5D_Gyro_X_CAL [deg/s],Shimmer_EE5D_Gyro_Y_CAL [deg/s],"
     "Shimmer_EE5D_Gyro_Z_CAL [deg/s]", [1.6e12 + S * 1e3, ACC, X], "", 1 / 9.80665),
]  # fmt: skip


@pytest.mark.parametrize(("name", "header", "columns", "preamble", "g"), LOGGERS)
def test_each_logger_is_told_by_its_header_and_read_in_deg_per_s(
    name, header, columns, preamble, g
):
    log = read(header, *columns, preamble=preamble, rate_hz=100)
    np.testing.assert_allclose(log.samples, X, rtol=1e-9)
    assert log.rate_hz == pytest.approx(100)
    assert (log.acceleration_g is None) == (g is None)
    if g:
        np.testing.assert_allclose(log.acceleration_g, ACC * g)
    assert len(said(log, "unit")) == bool(name)
    assert {finding.outcome for finding in log.findings} <= {"kept"}
    if name:
        assert FORMATS[name].source
        forced = read(header, *columns, preamble=preamble, format=name)
        np.testing.assert_array_equal(forced.samples, log.samples)


def test_units_of_deg_per_s_are_taken_as_they_are():
    assert read_unit("deg/s").factor == 1
    log = read(LOGGERS[4][1], *LOGGERS[4][2])
    np.testing.assert_array_equal(log.samples, X)


@pytest.mark.parametrize("more", ["", ",Quat_q0", ",Mag_X"])
def test_the_names_that_xsens_has_twice_ask_for_the_unit(more):
    columns = [K, BLANK, ACC, X * RAD, *([S] if more else [])]
    with pytest.raises(InputError, match="expected a unit of the rates, got 'Gyr_X'"):
        read(XSENS + more, *columns)
    np.testing.assert_allclose(read(XSENS + more, *columns, units="rad/s").samples, X)


def test_sensor_logger_asks_for_the_unit_alone():
    columns = [1.7e18 + S * 1e9, S, X[:, ::-1] * RAD]
    with pytest.raises(InputError, match="if they are angular rates, give units"):
        read("time,seconds_elapsed,z,y,x", *columns)
    log = read("time,seconds_elapsed,z,y,x", *columns, units="rad/s", rate_hz=100)
    np.testing.assert_allclose(log.samples, X)
    assert log.rate_hz == pytest.approx(100)
    assert not log.findings


@pytest.mark.parametrize(
    ("options", "preamble", "words"),
    [
        ({"units": "rad/s"}, "", "the file says deg/s.*units of the options are rad/s"),
        ({}, "# units: rad/s", "the format has deg/s, but lines above the header rad/s"),
        (
            {"format": "openlog_artemis"},
            "",
            "openlog_artemis has a column 'gX', got 'PacketCounter'",
        ),
        ({"format": "general"}, "", "expected a unit of the rates"),
        ({"format": "dot"}, "", "expected format auto, general, movella_dot, .*got 'dot'"),
    ],
)
def test_a_format_that_is_contradicted_or_wrong_is_refused(options, preamble, words):
    with pytest.raises(InputError, match=words):
        read(LOGGERS[0][1], *LOGGERS[0][2], preamble=preamble, **options)


def test_a_header_with_a_unit_needs_no_word_of_the_format():
    header = LOGGERS[0][1].replace("Gyr_X", "Gyr_X (rad/s)")
    header = header.replace("Gyr_Y", "Gyr_Y (rad/s)").replace("Gyr_Z", "Gyr_Z (rad/s)")
    log = read(header, K, S * 1e6, ACC, X * RAD, S)
    np.testing.assert_allclose(log.samples, X)


def test_scales_above_the_header_are_those_of_the_format_or_of_the_options():
    columns = [S * 1e3, X * RAD / 0.00106423, ACC]
    with pytest.raises(InputError, match="the file says counts of 0.00106423 rad/s.*are deg/s"):
        read("t,gx,gy,gz,ax,ay,az", *columns, preamble=GCSV, units="deg/s")
    scale = {"units": "raw", "scale_dps": 0.00106423 / RAD}
    log = read("t,gx,gy,gz,ax,ay,az", *columns, preamble=GCSV, **scale)
    np.testing.assert_allclose(log.samples, X)


def test_a_packet_counter_that_counts_rows_of_others_is_not_used():
    header = LOGGERS[0][1].replace("Euler_X", "Euler_X,sensor")
    numbers = K % 2
    rows = {"rows": {"sensor": 0}}
    log = read(header, K, S * 1e6, ACC, X, S, numbers, **rows)
    assert not len(log.gap_rows)
    assert said(log, "packet counter")
    lost = np.where(K < 300, K, K + 5)
    gaps = read(LOGGERS[0][1], lost, S * 1e6, ACC, X, S).gap_rows
    assert gaps.tolist() == [300]
