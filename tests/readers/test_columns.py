"""A column is a rate only if it says so; what contradicts each other is refused, naming both."""

import numpy as np
import pytest
from device_tables import BIAS, read, said, still
from pydantic import ValidationError

from gyro_pipeline.conventions import InputError
from gyro_pipeline.parameters import ReaderOptions

X = still()
N = len(X)
S = np.arange(N) / 100
RAD = np.pi / 180
T = "time (s),"
IN_READER = "in `reader:` of the catalog entry in catalog.yml$"


def with_unit(unit):
    return f"{T}gx ({unit}),gy ({unit}),gz ({unit})"


@pytest.mark.parametrize(
    ("header", "columns", "options"),
    [
        (with_unit("deg/s"), X, {}),
        (with_unit("°/sec"), X, {}),
        (with_unit("deg_per_s"), X, {}),
        (with_unit("DPS"), X, {}),
        (with_unit("deg·s⁻¹"), X, {}),
        (with_unit("rad_per_s"), X * RAD, {}),
        (with_unit("rads/s"), X * RAD, {}),
        (with_unit("Rad. per second"), X * RAD, {}),
        (with_unit("millidegrees/s"), X * 1000, {}),
        (with_unit("mdps"), X * 1000, {}),
        (with_unit("deg/hr"), X * 3600, {}),
        (with_unit("rpm"), X / 6, {}),
        (with_unit("rev/s"), X / 360, {}),
        (f"{T}gx,gy,gz", X, {"units": "°/s"}),
        (f"{T}GyroX_dps,GyroY_dps,GyroZ_dps", X, {}),
        (f"{T}x-axis (deg/s),y-axis (deg/s),z-axis (deg/s)", X, {}),
        (f"{T}gyro.x [rad/s],gyro.y [rad/s],gyro.z [rad/s]", X * RAD, {}),
        (f"{T}Gyro (rad/s).x,Gyro (rad/s).y,Gyro (rad/s).z", X * RAD, {}),
        (f"{T}gyro[0],gyro[1],gyro[2]", X, {"units": "deg/s"}),
        (f"{T}gz (deg/s),gx (deg/s),gy (deg/s)", X[:, [2, 0, 1]], {}),
        (f"{T}gz,gy,gx", X[:, ::-1], {"units": "deg/s"}),
        (f"{T}z,y,x", X[:, ::-1], {"units": "deg/s"}),
        (f"{T}z,y,x", X[:, ::-1], {"units": "deg/s", "columns": ("x", "y", "z")}),
        (f"{T}z,y,x", X, {"units": "deg/s", "columns": (1, 2, 3), "trust": "options"}),
        (
            f"{T}rotationRate.alpha,rotationRate.beta,rotationRate.gamma",
            X[:, [2, 0, 1]],
            {"units": "deg/s"},
        ),
        ("time (s),,,", X, {"units": "deg/s", "columns": (1, 2, 3)}),
        (f"{T}roll (deg/s),pitch (deg/s),yaw (deg/s)", X, {"columns": (1, 2, 3)}),
        (with_unit("rad/s"), X, {"units": "deg/s", "trust": "options"}),
        (f"{T}yaw_rate (deg/s),pitch_rate (deg/s),roll_rate (deg/s)", X[:, ::-1], {}),
        (f"{T}p,q,r", X, {"units": "deg/s", "columns": ("p", "q", "r")}),
    ],
)
def test_rates_are_told_by_name_and_unit_or_by_the_users_word(header, columns, options, request):
    log = read(header, S, columns, rate_hz=100, **options)
    np.testing.assert_allclose(log.samples, X, rtol=1e-12)
    assert log.rate_hz == pytest.approx(100)
    assert {finding.outcome for finding in log.findings} <= {"kept"}
    assert bool(said(log, "trust: options")) == ("trust" in options)


@pytest.mark.parametrize(
    ("header", "options", "words"),
    [
        (f"{T}gx,gy,gz", {}, "expected a unit of the rates.*give units: deg/s, rad/s"),
        (f"{T}z,y,x", {}, "'x', 'y', 'z' do not say what they measure.*if.*give units"),
        (
            f"{T}ax,ay,az",
            {"units": "deg/s"},
            "expected three columns of angular rate.*give columns",
        ),
        (f"{T}a,b,c", {"units": "deg/s"}, "expected three columns of angular rate"),
        (f"{T}roll,pitch,yaw", {"units": "deg/s"}, "expected three columns of angular rate"),
        (f"{T}roll (deg/s),pitch (deg/s),yaw (deg/s)", {}, "expected three columns"),
        (f"{T}gyro_bias_x,gyro_bias_y,gyro_bias_z", {"units": "deg/s"}, "expected three columns"),
        (f"{T}mag.x,mag.y,mag.z", {"units": "deg/s"}, "expected three columns"),
        (f"{T}gx (LSB),gy (LSB),gz (LSB)", {}, "raw counts: give units: raw and scale_dps"),
        (f"{T}gx,gy,gz", {"columns": ("gx", "gy", "wz")}, "expected a column 'wz', got 4 columns"),
        (f"{T}gx,gy,gz", {"columns": (1, 2, 9)}, r"expected a column 9 \(from 0\), got 4"),
        (f"{T}gx,gx,gy", {"columns": ("gx", "gy", "gz")}, r"one column 'gx', got 2.*\[1, 2\]"),
        (f"{T}gx,gy,gz", {"columns": {1: (1, 2, 3)}, "imu": 2}, "of IMUs 1, not of IMU 2"),
    ],
)
def test_what_is_not_said_is_asked_for(header, options, words):
    with pytest.raises(InputError, match=f"^log.csv: .*{words}.*{IN_READER}"):
        read(header, S, X, **options)


NUMBERS = {"columns": (1, 2, 3), "units": "deg/s"}


@pytest.mark.parametrize(
    ("header", "options", "words"),
    [
        (f"{T}z,y,x", NUMBERS, "are 'z', 'y', 'x', but by their names 'x', 'y', 'z' belong"),
        (
            f"{T}rotationRate.alpha,rotationRate.beta,rotationRate.gamma",
            NUMBERS,
            "but by their names 'rotationRate.beta', 'rotationRate.gamma', 'rotationRate.alpha'",
        ),
        (f"{T}ax,ay,az", NUMBERS, "name 'ax', 'ay', 'az', by name no angular rate"),
        (f"{T}roll,pitch,yaw", NUMBERS, "name 'roll', 'pitch', 'yaw', by name no angular rate"),
        (f"{T}yaw (dps),pitch (dps),roll (dps)", NUMBERS, "but by their names 'roll .dps.', 'pi"),
        (f"{T}ax,ay,az", NUMBERS | {"increments": True, "units": "deg"}, "by name no angular rate"),
        (f"{T}qx,qy,qz", NUMBERS, "by name no angular rate"),
        (f"{T}Mag_X,Mag_Y,Mag_Z", NUMBERS, "by name no angular rate"),
        (with_unit("rad/s"), NUMBERS, "the file says rad/s.*units of the options are deg/s"),
        (with_unit("rad/s"), {"units": "deg/s"}, "the file says rad/s.*units of the options"),
        (with_unit("LSB"), {"units": "deg/s"}, "the file says LSB.*units of the options"),
        (
            with_unit("deg/s"),
            {"units": "raw", "scale_dps": 0.1},
            "the file says deg/s.*raw, of 0.1",
        ),
        *[
            (with_unit(unit), {"units": "deg/s"}, "but that is no angular rate")
            for unit in ("m/s^2", "g", "uT", "1/s", "Hz", "deg/√h", "0.1*(deg/s)", "LSB/(deg/s)")
        ],
        *[(with_unit(unit), {"units": "deg/s"}, "increments: true") for unit in ("rad", "deg")],
        (f"{T}gx (deg/s)*100,gy (deg/s)*100,gz (deg/s)*100", NUMBERS, "no angular rate"),
        (f"{T}gx (deg/s),gy (rad/s),gz (deg/s)", NUMBERS, "expected one unit of all rates"),
        (f"{T}gx_dps (rad/s),gy_dps (rad/s),gz_dps (rad/s)", NUMBERS, "expected one unit"),
    ],
)
def test_contradictions_are_refused_unless_the_options_are_trusted(header, options, words):
    with pytest.raises(InputError, match=f"{words}.*trust: options {IN_READER}"):
        read(header, S, X / 100, **options)
    log = read(header, S, X / 100, trust="options", **options)
    assert "overruled: " in said(log, "trust: options")[0]
    factor = 100 if options.get("increments") else options.get("scale_dps", 1)
    np.testing.assert_allclose(log.samples, X / 100 * factor)


@pytest.mark.parametrize(
    ("preamble", "options", "words"),
    [
        ("angular rate in rad/s", {}, "header says deg/s, but lines above the header rad/s"),
        ("my log\ngscale,0.00106423", {}, "says gscale 0.00106423, but the scale is 1 deg/s"),
        ("Gyro sensitivity: 131", {"units": "deg/s"}, "Gyro sensitivity 131"),
    ],
)
def test_lines_above_the_header_count(preamble, options, words):
    with pytest.raises(InputError, match=f"{words}.*{IN_READER}"):
        read(with_unit("deg/s"), S, X, preamble=preamble, **options)


def test_a_unit_above_the_header_is_taken_but_a_range_is_none():
    log = read(f"{T}gx,gy,gz", S, X * RAD, preamble="# gyroscope in rad/s, range 250 dps")
    np.testing.assert_allclose(log.samples, X)
    scaled = {"units": "raw", "scale_dps": 1 / 131}
    log = read(f"{T}gx,gy,gz", S, X * 131, preamble="Sensitivity: 131", **scaled)
    np.testing.assert_allclose(log.samples, X)
    with pytest.raises(InputError, match="expected a unit of the rates"):
        read(f"{T}gx,gy,gz", S, X, preamble="# gyro_range = 250.0 dps")


def test_two_sensors_side_by_side_are_refused_and_read_as_imus():
    header = f"{T}icm_gx,icm_gy,icm_gz,asm_gx,asm_gy,asm_gz"
    with pytest.raises(InputError, match="'icm_gx'.*and 'asm_gx'.*{1: .1, 2, 3., 2: .4, 5, 6.}"):
        read(header, S, X, X + 1, units="deg/s")
    both = {1: ("icm_gx", "icm_gy", "icm_gz"), 2: (4, 5, 6)}
    for imu in (1, 2):
        log = read(header, S, X, X + 1, units="deg/s", columns=both, imu=imu)
        np.testing.assert_allclose(log.samples, X + imu - 1)
    with pytest.raises(InputError, match="columns of the options.*'icm_gx', 'icm_gy', 'icm_gz'"):
        read(header, S, X, X + 1, units="deg/s", columns=("icm_gx", "icm_gy", "asm_gz"))
    with pytest.raises(InputError, match="such as 'gx', 'gy', 'gz' and 'gx', 'gy', 'gz'"):
        read("gx,gy,gz,gx,gy,gz", X, X + 1, units="deg/s")


@pytest.mark.parametrize("columns", [None, ("x[0]", "y[0]", "z[0]")])
def test_several_samples_a_row_are_refused(columns):
    names = ",".join(f"{axis}[{k}]" for axis in "xyz" for k in range(8))
    with pytest.raises(InputError, match=r"each row holds 8 samples, 'x\[0\]', 'y\[0\]'"):
        read(f"dt,samples,{names}", S, S, np.repeat(X, 8, 1), columns=columns, units="deg/s")


def test_increments_are_divided_by_their_step():
    for header, options in (
        (f"{T}dx (rad),dy (rad),dz (rad)", {}),
        (
            f"{T}delta_angle[0],delta_angle[1],delta_angle[2]",
            {"units": "rad", "columns": (1, 2, 3)},
        ),
    ):
        log = read(header, S, X * RAD / 100, increments=True, **options)
        np.testing.assert_allclose(log.samples, X)
    with pytest.raises(InputError, match="the step between samples is not known; give time_column"):
        read("dx (rad),dy (rad),dz (rad)", X, increments=True)
    with pytest.raises(InputError, match="but that is no angle turned"):
        read(with_unit("deg/s"), S, X, increments=True, units="deg")


@pytest.mark.parametrize(
    "name",
    ["motionRotationRate{}(rad/s)", "gyroADC[{}] (rad/s)", "calibrated_gyro_{} (rad/s)"],
)
def test_rates_that_are_free_of_their_bias_are_said(name):
    axes = "012" if "[" in name else "XYZ"
    log = read(T + ",".join(name.format(axis) for axis in axes), S, X * RAD)
    assert "is what is left of a bias" in said(log, "bias taken off")[0]
    clean = read(
        f"{T}uncalibrated_gyro_x (dps),uncalibrated_gyro_y (dps),uncalibrated_gyro_z (dps)", S, X
    )
    assert not clean.findings


@pytest.mark.parametrize(
    ("header", "first_c"),
    [
        ("temperature (°F)", -3.8888889),
        ("T_temp [K]", -248.15),
        ("imu_degC", 25),
        ("temp_c", 25),
        ("T(℃)", 25),
        ("gyro temp (˚C)", 25),
        *[(name, None) for name in ("temp_valid", "temp_raw", "attempt", "temp_f", "x_tempcomp")],
    ],
)
def test_temperatures_are_kept_in_degrees_celsius(header, first_c):
    log = read(f"{with_unit('deg/s')},{header}", S, X, 25 + S)
    assert (log.temperature_c is None) == (first_c is None)
    if first_c:
        assert log.temperature_c[0] == pytest.approx(first_c)
    assert not log.findings


def test_of_temperatures_that_do_not_tell_none_is_taken_silently():
    (text,) = said(read(f"{with_unit('dps')},Temperature", S, X, 25 + S), "temperature")
    assert text == "'Temperature' has no unit and is taken for degrees Celsius"
    two = read(f"{with_unit('dps')},temp_a,temp_gyro", S, X, S, S)
    assert two.temperature_c is not None  # temp_a says nothing of degrees
    log = read(
        f"{with_unit('dps')},temp_board,temp_gyro", S, X, S, S, temperature_column="temp_gyro"
    )
    np.testing.assert_array_equal(log.temperature_c, S)
    log = read(f"{with_unit('dps')},temp_board,temp_gyro", S, X, S, S)
    assert log.temperature_c is None
    assert "none of 'temp_board', 'temp_gyro' is kept" in said(log, "temperature")[0]


@pytest.mark.parametrize(
    ("unit", "factor"), [("g", 1), ("m/s²", 9.80665), ("mg", 1000), ("G", 1), ("", 0), ("V", 0)]
)
def test_accelerations_are_kept_in_g(unit, factor):
    header = ",".join(f"Acc {axis} ({unit})" if unit else f"acc_{axis}" for axis in "xyz")
    log = read(f"{with_unit('dps')},{header}", S, X, (X + 1) * (factor or 1))
    if factor:
        np.testing.assert_allclose(log.acceleration_g, X + 1)
    else:
        assert log.acceleration_g is None
        assert "give acceleration_units" in said(log, "acceleration")[0]
        log = read(f"{with_unit('dps')},{header}", S, X, X + 1, acceleration_units="g")
        np.testing.assert_allclose(log.acceleration_g, X + 1)


def test_a_list_of_names_ends_after_thirty():
    header = ",".join(f"column_{k}" for k in range(60))
    with pytest.raises(InputError) as error:
        read(header, *[S] * 60)
    assert str(error.value).count("column_") == 30


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"units": "rad"}, "expected a unit of angle per time"),
        ({"units": "Hz"}, "expected a unit of angle per time"),
        ({"units": "1/s"}, "expected a unit of angle per time"),
        ({"units": "deg/s", "increments": True}, "expected a unit of an angle"),
        ({"units": "raw"}, "units: raw and scale_dps go together"),
        ({"scale_dps": 0.1}, "units: raw and scale_dps go together"),
        ({"offset": 3}, "offset: is of raw counts"),
        ({"time_units": "deg"}, "expected a unit of time"),
        ({"time_units": -1}, "greater than 0"),
        ({"acceleration_units": "s"}, "expected a unit of acceleration"),
        ({"trust": "header"}, "options"),
    ],
)
def test_options_that_make_no_sense_are_refused_before_anything_is_read(options, words):
    with pytest.raises(ValidationError, match=words):
        ReaderOptions(**options)


def test_the_bias_in_these_tables_is_what_they_say():
    np.testing.assert_allclose(X.mean(axis=0), BIAS, atol=0.003)
