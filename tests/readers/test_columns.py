"""A column is a rate only if it says so; what contradicts each other is refused, naming both."""

import numpy as np
import pytest
from pydantic import ValidationError

from gyro_pipeline.conventions import InputError
from gyro_pipeline.parameters import ReaderOptions

X = np.random.default_rng(0).normal((0.7, -0.4, 0.15), 0.05, (6000, 3))
S = np.arange(len(X)) / 100
RAD = np.pi / 180
T = "time (s),"
IN_READER = "in `reader:` of the catalog entry in catalog.yml$"
DEG = {"units": "deg/s"}
BY_NUMBER = DEG | {"columns": (1, 2, 3)}


def axes(name, order="xyz"):
    """A time and three columns."""
    return T + ",".join(name.replace("#", axis) for axis in order)


@pytest.mark.parametrize(
    ("header", "columns", "options"),
    [
        (axes("g# (DPS)"), X, {}),
        (axes("g#_dph"), X * 3600, {}),
        (axes("Gyro#_dps"), X, {}),
        (f"{T}gyro[0],gyro[1],gyro[2]", X, DEG),
        (axes(""), X, BY_NUMBER),
        (f"{T}roll (deg/s),pitch (deg/s),yaw (deg/s)", X, {"columns": (1, 2, 3)}),
        (f"{T}yaw_rate (deg/s),pitch_rate (deg/s),roll_rate (deg/s)", X[:, ::-1], {}),
        (f"{T}r (dps),q (dps),p (dps)", X[:, ::-1], {}),
        (f"{T}delta_angle[0],delta_angle[1],delta_angle[2]", X * RAD / 100,
         {"units": "rad", "columns": (1, 2, 3), "increments": True}),
        (axes("g#"), X * RAD, {"preamble": "# gyroscope in rad/s, range 250 dps"}),
    ],
)  # fmt: skip
def test_rates_are_told_by_name_and_unit_or_by_the_users_word(header, columns, options, read):
    log = read(header, S, columns, rate_hz=100, **options)
    np.testing.assert_allclose(log.samples, X, rtol=1e-12)
    assert [finding.check for finding in log.findings] == ["increments"] * ("increments" in options)


@pytest.mark.parametrize(
    ("header", "options", "words"),
    [
        (axes("g#"), {}, "expected a unit of the rates.*give units: deg/s, rad/s"),
        (axes("#"), {}, "'x', 'y', 'z' do not say what they measure.*if.*give units"),
        (f"{T}roll (deg/s),pitch (deg/s),yaw (deg/s)", {}, "expected three columns"),
        (axes("gyro_bias_#"), DEG, "expected three columns"),
        (axes("g# (LSB)"), {}, "raw counts: give units: raw and scale_dps"),
        (axes("g#"), {"columns": ("gx", "gy", "wz")}, "one column 'wz', got 0.* in 4 columns"),
        (axes("g#"), {"columns": (1, 2, 9)}, "expected one column 9, got 0"),
        (axes("g#"), {"columns": {1: (1, 2, 3)}, "imu": 2}, "expected IMU 2, got those of IMUs 1"),
        (axes("g# (rad/s)"), {"preamble": "in deg/s"}, "header says rad/s, but lines above.*deg/s"),
        ("k,dx (rad),dy (rad),dz (rad)", {"increments": True}, "the step .* is not known; give ti"),
        (axes("g# (deg/s)"), {"increments": True, "units": "deg"}, "but that is no angle turned"),
    ],
)
def test_what_is_not_said_is_asked_for(header, options, words, read):
    with pytest.raises(InputError, match=f"^log.csv: .*{words}.*{IN_READER}"):
        read(header, S, X, **options)


@pytest.mark.parametrize(
    ("header", "options", "words"),
    [
        (f"{T}yaw (dps),pitch (dps),roll (dps)", BY_NUMBER, "but by their names 'roll .dps.', 'pi"),
        (f"{T}gyro 3,gyro 2,gyro 1", BY_NUMBER, "belong together in this order"),
        (axes("a#"), BY_NUMBER | {"increments": True, "units": "deg"}, "by name no angular rate"),
        (axes("g# (deg/s)"), {"units": "raw", "scale_dps": 0.1}, "raw, of 0.1 deg/s, but the head"),
        *[
            (axes(f"g# ({unit})"), DEG, "but that is no angular rate")
            for unit in ("grad/s", "deg/√h", "LSB/(deg/s)")
        ],
        (f"{T}gx (deg/s),gy (rad/s),gz (deg/s)", BY_NUMBER, "are deg/s, but the header says rad/s"),
        (axes("g#"), DEG | {"preamble": "Sensitivity: 131"}, "says 'Sensitivity: 131', but"),
        (axes("10*g# (deg/s)"), {}, "name a factor"),
    ],
)
def test_contradictions_are_refused_unless_the_options_are_trusted(
    header, options, words, read, details
):
    with pytest.raises(InputError, match=f"{words}.*trust: options {IN_READER}"):
        read(header, S, X / 100, **options)
    log = read(header, S, X / 100, trust="options", **options)
    assert "overruled: " in details(log, "trust: options")[0]
    factor = 100 if options.get("increments") else options.get("scale_dps", 1)
    np.testing.assert_allclose(log.samples, X / 100 * factor)


@pytest.mark.parametrize(
    "line",
    [
        "LSB/dps = 14.2857",  "Gyroscope scale (deg/s per LSB): 0.07",
        "gyr_scale 0.07", "Sensitivity: 0.07",  "gain: 0.07",
         "multiplier,0.07", "gyro sensitivity 70 mdps/LSB",
        "range 250 dps, 14.2857 LSB/dps", "acc: 16384 LSB/g, gyro: 14.2857 LSB/dps",
    ],
)  # fmt: skip
def test_a_scale_that_the_file_states_is_named_for_typing(line, read):
    raw = {"units": "raw", "scale_dps": 0.07}
    with pytest.raises(InputError, match=r"give units: raw, scale_dps: 0\.07\d* if it is"):
        read(axes("g#"), S, X, preamble=line, **DEG)
    assert not read(axes("g#"), S, X, preamble=line, **raw).findings
    name, _, number = line.rpartition(",")
    if name and number == "0.07":
        with pytest.raises(InputError, match=f"column '{name}' is 0.07, but.*scale_dps: 0.07"):
            read(f"{axes('g#')},{name}", S, X, 0 * S + 0.07, **DEG)


@pytest.mark.parametrize(
    "line",
    [
        "Gyro full scale: 250 dps", "acc sensitivity: 0.061", "ascale,0.0004", "gyro scale: 1.0",
         "gyro range: ±250", "Resolution: 16 bit",
         "Factory: 7", "sensitivity of 2021-05-04",
    ],
)  # fmt: skip
def test_ranges_and_scales_of_other_sensors_are_none_of_the_rates(line, read):
    assert not read(axes("g#"), S, X, preamble=line, **DEG).findings


@pytest.mark.parametrize(
    ("dps", "taken"), [(0.00106423, "deg/s per count"), (0.0609759, "rad/s per count")]
)
def test_of_a_scale_with_two_readings_the_one_taken_is_said(dps, taken, read, details):
    above = {"preamble": "tscale,0.001\ngscale,0.00106423", "time_units": 1e-3}
    with pytest.raises(InputError, match="0.00106423 if it is deg/s.*0.0609759 if it is rad/s per"):
        read("t,gx,gy,gz", S * 1e3, X, **above, **DEG)
    log = read("t,gx,gy,gz", S * 1e3, X, units="raw", scale_dps=dps, **above)
    assert taken in details(log, "scale")[0]


def test_names_of_two_sensors_are_not_mixed_and_each_imu_has_its_own(read):
    header = f"{T}icm_gx,icm_gy,icm_gz,asm_gx,asm_gy,asm_gz"
    with pytest.raises(InputError, match="columns of the options.*'icm_gx', 'icm_gy', 'icm_gz'"):
        read(header, S, X, X + 1, columns=("icm_gx", "icm_gy", "asm_gz"), **DEG)
    log = read(header, S, X, X + 1, columns={1: (1, 2, 3), 2: (4, 5, 6)}, imu=2, **DEG)
    np.testing.assert_array_equal(log.samples, X + 1)


@pytest.mark.parametrize("name", ["calibrated_gyro_# (dps)", "uncalibrated_gyro_# (dps)"])
def test_rates_that_are_free_of_their_bias_are_said(name, read):
    assert ("a bias was subtracted" in str(read(axes(name), S, X).findings)) == name.startswith(
        "cal"
    )


@pytest.mark.parametrize("name", ["tilt_#", "#"])
def test_rates_by_units_alone_are_said_and_never_a_quaternion(name, read, details):
    assert "only the option units says" in details(read(axes(name), S, X, **DEG), "rates")[0]
    assert not read(axes(name), S, X, **BY_NUMBER).findings
    header = axes(name, "xyzw")
    with pytest.raises(InputError, match="are by name of a quaternion; give columns"):
        read(header, S, X, S, **DEG)
    with pytest.raises(InputError, match="by name of a quaternion; give columns.*trust: options"):
        read(header, S, X, S, **BY_NUMBER)
    assert not read(f"{axes(f'{name} (dps)')},{name.replace('#', 'w')}", S, X, S).findings


@pytest.mark.parametrize(
    ("header", "options", "first_c", "words"),
    [
        ("temperature (F)", {}, -3.8888889, ""),
        ("T(℃)", {}, 25, ""),
        ("temp_c", {}, 25, "'temp_c' has no unit; degrees Celsius are assumed"),
        ("temp_gyro,temp_board", {}, None, "none of 'temp_gyro', 'temp_board' is kept"),
        ("temp_gyro,temp_board", {"temperature_column": "temp_gyro"}, 25, ""),
        *[(name, {}, None, "") for name in ("temp_valid", "gain [K]")],
    ],
)
def test_a_temperature_is_kept_in_degrees_celsius(header, options, first_c, words, read, details):
    columns = [25 + S] * len(header.split(","))
    log = read(f"{axes('g# (dps)')},{header}", S, X, *columns, **options)
    assert (None if log.temperature_c is None else log.temperature_c[0]) == pytest.approx(first_c)
    assert words in str(details(log, "temperature")) and bool(words) == bool(log.findings)


@pytest.mark.parametrize(("unit", "factor"), [("m/s²", 9.80665), ("mg", 1000), ("", 0)])
def test_accelerations_are_kept_in_g(unit, factor, read, details):
    header = f"{axes('g# (dps)')},{axes(f'Acc # ({unit})').removeprefix(T)}".replace(" ()", "")
    log = read(header, S, X, (X + 1) * (factor or 1))
    assert bool(details(log, "acceleration")) == (not factor)
    if not factor:
        assert log.acceleration_g is None
        log = read(header, S, X, X + 1, acceleration_units="g")
    np.testing.assert_allclose(log.acceleration_g, X + 1)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"units": "1/s"}, "expected a unit of angle per time"),
        ({"units": "raw"}, "units: raw and scale_dps go together"),
        ({"scale_dps": 0.1}, "units: raw and scale_dps go together"),
        ({"offset": 3}, "offset: applies to raw counts"),
        ({"time_units": "deg"}, "expected a unit of time"),
        ({"format": "dot"}, "'auto', 'general', 'movella_dot',"),
    ],
)
def test_options_that_make_no_sense_are_refused_before_anything_is_read(options, words):
    with pytest.raises(ValidationError, match=words):
        ReaderOptions(**options)
