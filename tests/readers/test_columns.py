"""A column is a rate only if it says so; what contradicts each other is refused, naming both."""

import numpy as np
import pytest
from pydantic import ValidationError

from gyro_pipeline.conventions import InputError
from gyro_pipeline.parameters import ReaderOptions
from gyro_pipeline.readers.counts import wrapped

X = np.random.default_rng(0).normal((0.7, -0.4, 0.15), 0.05, (6000, 3))
S = np.arange(len(X)) / 100
RAD = np.pi / 180
T = "time (s),"
IN_READER = "in `reader:` of the catalog entry in catalog.yml$"
DEG = {"units": "deg/s"}
RAW = {"units": "raw", "scale_dps": 0.00875}
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


ASKED = [
    (axes("#"), {}, "'x', 'y', 'z' do not say what they measure.*if.*give units"),
    (axes("gyro_bias_#"), DEG, "expected three columns"),
    (axes("g# (LSB)"), {}, "raw counts: give units: raw and scale_dps"),
    (axes("g#"), {"columns": ("gx", "gy", "wz")}, "one column 'wz', got 0.* in 4 columns"),
    (axes("g#"), {"columns": {1: (1, 2, 3)}, "imu": 2}, "expected IMU 2, got those of IMUs 1"),
    (axes("g# (rad/s)"), {"preamble": "in deg/s"}, "header says rad/s, but lines above.*deg/s"),
    ("k,dx (rad),dy (rad),dz (rad)", {"increments": True}, "the step .* is not known; give ti"),
    (axes("g# (deg/s)"), {"increments": True, "units": "deg"}, "but that is no angle turned"),
]
CONTRADICTED = [
    (f"{T}gyro 3,gyro 2,gyro 1", BY_NUMBER, "belong together in this order"),
    (axes("a#"), BY_NUMBER | {"increments": True, "units": "deg"}, "by name no angular rate"),
    (axes("g# (deg/s)"), {"units": "raw", "scale_dps": 0.1}, "raw, of 0.1 deg/s, but the head"),
    (axes("g# (LSB/(deg/s))"), DEG, "but that is no angular rate"),
    (f"{T}gx (deg/s),gy (rad/s),gz (deg/s)", BY_NUMBER, "are deg/s, but the header says rad/s"),
    (axes("g#"), DEG | {"preamble": "Sensitivity: 131"}, "says 'Sensitivity: 131', but"),
    (axes("10*g# (deg/s)"), {}, "name a factor"),
]


@pytest.mark.parametrize(("header", "options", "words"), ASKED)
def test_what_is_not_said_is_asked_for(header, options, words, read):
    with pytest.raises(InputError, match=f"^log.csv: .*{words}.*{IN_READER}"):
        read(header, S, X, **options)


@pytest.mark.parametrize(("header", "options", "words"), CONTRADICTED)
def test_contradictions_are_refused_unless_one_is_trusted(header, options, words, read, details):
    with pytest.raises(InputError, match=f"{words}.*trust: options {IN_READER}"):
        read(header, S, X / 100, **options)
    log = read(header, S, X / 100, trust="options", **options)
    assert "overruled: " in details(log, "trust: options")[0]
    factor = 100 if options.get("increments") else options.get("scale_dps", 1)
    np.testing.assert_allclose(log.samples, X / 100 * factor)


def test_a_scale_that_the_file_states_is_named_for_typing_and_others_are_not(read):
    raw = {"units": "raw", "scale_dps": 0.07}
    for line in (
        "LSB/dps = 14.2857",
        "Gyroscope scale (deg/s per LSB): 0.07",
        "gyr_scale 0.07",
        "gain: 0.07",
        "gyro sensitivity 70 mdps/LSB",
        "range 250 dps, 14.2857 LSB/dps",
        "acc: 16384 LSB/g, gyro: 14.2857 LSB/dps",
    ):
        with pytest.raises(InputError, match=r"give units: raw, scale_dps: 0\.07\d* if it is"):
            read(axes("g#"), S, X, preamble=line, **DEG)
        assert not read(axes("g#"), S, X, preamble=line, **raw).findings
    with pytest.raises(InputError, match="column 'multiplier' is 0.07, but.*scale_dps: 0.07"):
        read(f"{axes('g#')},multiplier", S, X, 0 * S + 0.07, **DEG)
    for line in (
        "Gyro full scale: 250 dps",
        "acc sensitivity: 0.061",
        "ascale,0.0004",
        "gyro scale: 1.0",
        "Resolution: 16 bit",
        "sensitivity of 2021-05-04",
    ):
        assert not read(axes("g#"), S, X, preamble=line, **DEG).findings


def test_names_of_two_sensors_are_not_mixed_and_each_imu_has_its_own(read):
    header = f"{T}icm_gx,icm_gy,icm_gz,asm_gx,asm_gy,asm_gz"
    with pytest.raises(InputError, match="columns of the options.*'icm_gx', 'icm_gy', 'icm_gz'"):
        read(header, S, X, X + 1, columns=("icm_gx", "icm_gy", "asm_gz"), **DEG)
    log = read(header, S, X, X + 1, columns={1: (1, 2, 3), 2: (4, 5, 6)}, imu=2, **DEG)
    np.testing.assert_array_equal(log.samples, X + 1)


def test_rates_by_units_alone_are_said_and_never_a_quaternion(read, details):
    assert "only the option units says" in details(read(axes("#"), S, X, **DEG), "rates")[0]
    assert not read(axes("#"), S, X, **BY_NUMBER).findings
    header = axes("tilt_#", "xyzw")
    with pytest.raises(InputError, match="are by name of a quaternion; give columns"):
        read(header, S, X, S, **DEG)
    with pytest.raises(InputError, match="by name of a quaternion; give columns.*trust: options"):
        read(header, S, X, S, **BY_NUMBER)
    assert not read(f"{axes('# (dps)')},w", S, X, S).findings


def test_a_temperature_is_kept_in_degrees_celsius(read, details):
    two = "temp_gyro,temp_board"
    for header, options, first_c, words in (
        ("temperature (F)", {}, -3.8888889, ""),
        ("T(℃)", {}, 25, ""),
        ("temp_c", {}, 25, "'temp_c' has no unit; degrees Celsius are assumed"),
        (two, {}, None, "none of 'temp_gyro', 'temp_board' is kept"),
        (two, {"temperature_column": "temp_gyro"}, 25, ""),
        ("temp_valid", {}, None, ""),
        ("gain [K]", {}, None, ""),
    ):
        columns = [25 + S] * len(header.split(","))
        log = read(f"{axes('g# (dps)')},{header}", S, X, *columns, **options)
        kept = None if log.temperature_c is None else log.temperature_c[0]
        assert kept == pytest.approx(first_c)
        assert words in str(details(log, "temperature")) and bool(words) == bool(log.findings)


def test_accelerations_are_kept_in_g(read, details):
    for unit, factor in (("m/s²", 9.80665), ("mg", 1000), ("", 0)):
        header = f"{axes('g# (dps)')},{axes(f'Acc # ({unit})').removeprefix(T)}".replace(" ()", "")
        log = read(header, S, X, (X + 1) * (factor or 1))
        assert bool(details(log, "acceleration")) == (not factor)
        if not factor:
            assert log.acceleration_g is None
            log = read(header, S, X, X + 1, acceleration_units="g")
        np.testing.assert_allclose(log.acceleration_g, X + 1)


def test_options_that_make_no_sense_are_refused_before_anything_is_read():
    for options, words in (
        ({"units": "1/s"}, "expected a unit of angle per time"),
        ({"scale_dps": 0.1}, "units: raw and scale_dps go together"),
        ({"offset": 3}, "offset: applies to raw counts"),
        ({"time_units": "deg"}, "expected a unit of time"),
        ({"format": "dot"}, "'auto', 'general', 'movella_dot',"),
    ):
        with pytest.raises(ValidationError, match=words):
            ReaderOptions(**options)


@pytest.mark.parametrize("bits", [12, 24])
def test_signed_counts_that_were_written_as_unsigned_ones(bits, read):
    for level in (0, 2500, np.nan):
        assert not wrapped(level + np.round(X / 0.01))
    counts = np.round(X / RAW["scale_dps"])
    damaged = counts % 2**bits
    damaged[[10, 20, 30]] = [[-1, 5, 5], [1e12, 5, 5], [0.5, 0.5, 0.5]]
    assert f"signed_bits: {bits}" in wrapped(damaged) and not wrapped(counts)
    log = read("gx,gy,gz", counts % 2**bits, signed_bits=bits, **RAW)
    np.testing.assert_allclose(log.samples, counts * RAW["scale_dps"])
    with pytest.raises(InputError, match=f"signed_bits: {bits}: expected whole numbers from 0"):
        read("gx,gy,gz", counts - 3000, signed_bits=bits, **RAW)
