"""Every format, every way of storing it: the same samples in deg/s."""

import os
from pathlib import Path

import h5py
import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import scipy.io
from pydantic import ValidationError

from gyro_pipeline.conventions import InputError
from gyro_pipeline.parameters import ReaderOptions
from gyro_pipeline.readers import READERS, Reader, read_log
from gyro_pipeline.readers.formats import reader_of
from gyro_pipeline.readers.tables import open_table

RATES_HZ = {
    "movella_dot": 1e6 / 8333,
    "movella_dot_angles": 120,
    "openlog_artemis": 100,
    "ngimu": 400,
    "general": 100,
}


UNIT = ("unit", "kept")


def checks(log):
    return [(finding.check, finding.outcome) for finding in log.findings]


@pytest.mark.parametrize("name", READERS)
def test_each_logger_is_told_by_its_header_and_read_in_deg_per_s(name, good, rates, read, tmp_path):
    log = read(good[name], RATES_HZ[name])
    assert reader_of(open_table(tmp_path / "log.csv"), ReaderOptions(), Path()) is READERS[name]
    np.testing.assert_allclose(log.samples, rates, rtol=0, atol=1e-7)
    assert log.samples.dtype == np.float64
    assert log.rate_hz == pytest.approx(RATES_HZ[name], rel=1e-9)
    assert not len(log.gap_rows)
    assert checks(log) == ([UNIT] if READERS[name].units else [])


def test_the_unit_of_a_format_is_said_unless_file_or_options_say_it(good, read):
    (finding,) = read(good["movella_dot"]).findings
    assert finding.detail == "deg/s, by the format; the file does not say"
    assert not read(good["movella_dot"], units="deg/s").findings


def test_a_temperature_column_is_kept(good, read):
    np.testing.assert_array_equal(read(good["openlog_artemis"]).temperature_c, 25.0 + np.arange(60))
    np.testing.assert_array_equal(read(good["general"]).temperature_c, 25 + np.arange(60) / 8)
    assert read(good["ngimu"]).temperature_c is None
    with pytest.raises(InputError, match="expected a temperature in degC.*'Barometer .hPa.'"):
        read(good["ngimu"], temperature_column="Barometer")


@pytest.mark.parametrize(
    ("header", "first_c"),
    [
        ("temperature (°F)", -3.8888889),
        ("T_temp [K]", -248.15),
        ("imu_degC", 25),
        ("temp_c", 25),
        ("T(℃)", 25),
        ("gyro temp (˚C)", 25),
    ],
)
def test_temperatures_become_degrees_celsius(header, first_c, good, read):
    text = good["general"].replace("temperature (°C)", header)
    for options in ({}, {"temperature_column": 1}):
        log = read(text, **options)
        assert log.temperature_c[0] == pytest.approx(first_c)
        assert not log.findings


def test_a_temperature_without_unit_is_kept_and_that_is_said(good, read):
    log = read(good["general"].replace("temperature (°C)", "Temperature"))
    np.testing.assert_array_equal(log.temperature_c, 25 + np.arange(60) / 8)
    (said,) = log.findings
    assert said.detail == "'Temperature' has no unit and is taken for degrees Celsius"


@pytest.mark.parametrize("kind", [float, str])
def test_of_two_temperatures_none_is_kept_and_text_is_none(kind, rates, read):
    table = pd.DataFrame({f"g{axis}_dps": rates[:, n] for n, axis in enumerate("xyz")})
    table["temp_board"] = pd.Series(np.arange(60.0)).astype(kind)
    log = read(table.to_parquet, name="log.parquet")
    assert (log.temperature_c is None) == (kind is str)
    table["temp_gyro"] = 30.0
    log = read(table.to_parquet, name="log.parquet")
    assert log.temperature_c is None
    assert "none of 'temp_board', 'temp_gyro' is kept" in log.findings[-1].detail
    log = read(table.to_parquet, name="log.parquet", temperature_column="temp_gyro")
    assert (log.temperature_c == 30).all()


@pytest.mark.parametrize("header", ["sep=,\n", "", "DeviceTag:,1\nSyncStatus:,0\n\n"])
def test_a_dot_export_needs_no_first_lines(header, good, rates, read):
    table = good["movella_dot"][good["movella_dot"].index("PacketCounter") :]
    np.testing.assert_array_equal(read(header + table).samples, rates)


@pytest.mark.parametrize("columns", [10, 13])
@pytest.mark.parametrize("separator", ["", "sep=,\n"])
@pytest.mark.parametrize("end", ["", ",", ", "])
def test_dot_exports_of_ten_and_thirteen_columns(columns, separator, end, rates, read):
    """Sample time, orientation and acceleration; the longer one has the magnetic field as well."""
    names = ["PacketCounter", "SampleTimeFine", "Euler_Y", "Euler_Z"]
    measured = ("Acc", "Gyr", "Mag") if columns == 13 else ("Acc", "Gyr")
    names += [f"{quantity}_{axis}" for quantity in measured for axis in "XYZ"]
    lines = [",".join(names)]
    for k, row in enumerate(rates.tolist()):
        values = dict.fromkeys(names, "0.5") | {"PacketCounter": k, "SampleTimeFine": 8333 * k}
        values |= dict(zip(["Gyr_X", "Gyr_Y", "Gyr_Z"], row, strict=True))
        lines.append(",".join(map(str, values.values())))
    log = read(separator + f"{end}\n".join(lines) + f"{end}\n", 120)
    np.testing.assert_array_equal(log.samples, rates)
    assert log.rate_hz == pytest.approx(1e6 / 8333)
    assert checks(log) == [UNIT]


def test_the_names_of_mt_manager_which_writes_rad_per_s_are_not_taken_for_a_dot(good, read):
    table = good["movella_dot"][good["movella_dot"].index("PacketCounter") :]
    with pytest.raises(InputError, match="expected three columns of angular rate"):
        read(f"// General information:\n//  MT Manager version: 2022.2.0\n{table}")


def save_v73(path, arrays):
    """As MATLAB does: 512 bytes of its own before HDF5, arrays transposed."""
    with h5py.File(path, "w", userblock_size=512) as file:
        for name, array in arrays.items():
            file[name] = np.atleast_2d(array).T if array.ndim == 2 else array[None]
            file[name].attrs["MATLAB_class"] = np.bytes_("double")
    with path.open("r+b") as file:
        file.write(b"MATLAB 7.3 MAT-file".ljust(512))


@pytest.mark.parametrize("suffix", [".npz", ".mat", ".v73.mat", ".h5"])
def test_named_arrays_are_columns(suffix, rates, read):
    arrays = {"t": np.arange(60) / 100, "gyro_dps": rates, "acc": rates + 1, "degC": rates[:, 0]}

    def save(path):
        if suffix == ".npz":
            np.savez(path, **arrays)
        elif suffix == ".mat":
            scipy.io.savemat(path, arrays)
        elif suffix == ".v73.mat":
            save_v73(path, arrays)
        else:
            with h5py.File(path, "w") as file:
                file.update(arrays)

    log = read(save, name=f"log{suffix}", time_units="s", temperature_column="degC")
    np.testing.assert_array_equal(log.samples, rates)
    np.testing.assert_array_equal(log.temperature_c, rates[:, 0])
    assert log.rate_hz == pytest.approx(100)
    named = ("acc.z", "acc.y", "acc.x")
    other = read(save, name=f"log{suffix}", columns=named, units="mdps")
    np.testing.assert_allclose(other.samples, (rates + 1)[:, ::-1] * 1e-3)


def with_fields(rates):
    """An array of a field of times, of three rates, and of text."""
    table = np.zeros(60, [("t", "f8"), ("gyro_dps", "f4", 3), ("note", "U3")])
    table["t"], table["gyro_dps"] = np.arange(60) / 100, rates
    return table


def save_v73_struct(path, log):
    """A structure is a group; what cells refer to is beside it."""
    arrays = {f"log/{name}": array for name, array in log.items()}
    save_v73(path, arrays | {"#refs#/a": np.ones((60, 3))})


@pytest.mark.parametrize(
    ("place", "save"),
    [
        ("", lambda path, log: np.save(path, with_fields(log["gyro_dps"]))),
        ("log.", lambda path, log: np.savez(path, log=with_fields(log["gyro_dps"]))),
        ("log.", lambda path, log: scipy.io.savemat(path, {"log": log | {"name": "A"}})),
        ("a.log.", lambda path, log: scipy.io.savemat(path, {"a": {"log": log}, "b": 5.0})),
        ("log.", save_v73_struct),
    ],
)
def test_fields_and_structures_are_columns(place, save, rates, tmp_path):
    log = {"t": np.arange(60) / 100, "gyro_dps": rates}
    path = tmp_path / ("log.npz" if "savez" in save.__code__.co_names else "log.npy")
    with path.open("wb") as file:
        save(path if save is save_v73_struct else file, log)
    options = ReaderOptions(time_column=f"{place}t", time_units="s")
    read = read_log(path, options, 100)
    np.testing.assert_allclose(read.samples, rates, rtol=1e-6)
    assert read.rate_hz == pytest.approx(100)
    (said,) = read_log(path, ReaderOptions()).findings
    assert said.detail.startswith(f"'{place}t' has no unit")
    named = tuple(f"{place}gyro_dps.{axis}" for axis in "zyx")
    turned = read_log(path, ReaderOptions(columns=named), 100)
    np.testing.assert_allclose(turned.samples, rates[:, ::-1], rtol=1e-6)


def test_objects_in_an_archive_are_left_alone_and_never_unpickled(rates, read):
    save = lambda path: np.savez(path, gyro_dps=rates, info=np.array([{}], object))  # noqa: E731
    np.testing.assert_array_equal(read(save, name="log.npz").samples, rates)
    alone = lambda path: np.savez(path, info=np.array([{}], object))  # noqa: E731
    with pytest.raises(InputError, match="a row a sample.*got objects info, which are not read"):
        read(alone, name="log.npz")


@pytest.mark.parametrize("save", [np.save, lambda path, rates: np.savez(path, g=rates, t=rates[0])])
def test_three_rows_of_rates_are_three_columns(save, rates, tmp_path):
    path = tmp_path / ("log.npy" if save is np.save else "log.npz")
    save(path, rates.T)
    columns = None if save is np.save else ("g.x", "g.y", "g.z")
    log = read_log(path, ReaderOptions(columns=columns, units="deg/s"))
    np.testing.assert_array_equal(log.samples, rates)


@pytest.mark.parametrize("dtype", [np.float64, np.float32, np.int16])
def test_an_npy_file_of_three_columns_needs_a_unit(dtype, rates, read):
    counts = (rates * 100).astype(dtype)
    save = lambda path: np.save(path, counts)  # noqa: E731
    log = read(save, name="log.npy", units="raw", scale_dps=0.01)
    np.testing.assert_allclose(log.samples, counts.astype(float) * 0.01)
    assert log.rate_hz is None
    assert checks(log) == [("timestamps", "kept")]
    with pytest.raises(InputError, match="expected a unit of the rates"):
        read(save, name="log.npy")


def test_a_parquet_copy_is_read_as_the_text_is(frame, rates, read):
    log = read(frame.to_parquet, 120, name="log.parquet")
    np.testing.assert_array_equal(log.samples, rates)
    assert log.rate_hz == pytest.approx(120)
    assert checks(log) == [UNIT]


def test_parquet_timestamps_and_integers_with_missing_values(rates, read):
    times = pd.Timestamp("2024-03-01") + pd.to_timedelta(np.arange(60) * 5, unit="ms")
    counts = pd.array([None, *range(1, 60)], dtype="Int32")
    table = pd.DataFrame({"time": times, "wx (mdps)": counts, "wy (mdps)": 5, "wz (mdps)": 7.0})
    log = read(table.to_parquet, 200, name="log.parquet")
    np.testing.assert_allclose(log.samples[1:, 0], np.arange(1, 60) * 1e-3)
    assert np.isnan(log.samples[0, 0])
    assert log.rate_hz == pytest.approx(200)


@pytest.mark.parametrize(
    "times",
    [
        pd.Timestamp("2024-03-01") + pd.to_timedelta(np.arange(60) * 5, unit="ms"),
        pd.to_timedelta(np.arange(60) * 5, unit="ms"),
        (pd.Timestamp("2024-03-01") + pd.to_timedelta(np.arange(60) * 5, unit="ms")).time,
    ],
)
def test_the_first_of_parquets_times_may_be_missing(times, rates, read):
    table = pd.DataFrame({"time": times, **{f"w{n} (dps)": rates[:, n] for n in range(3)}})
    table.loc[[0, 30], "time"] = None
    log = read(table.to_parquet, 200, name="log.parquet", columns=(1, 2, 3))
    assert log.rate_hz == pytest.approx(200)
    assert not len(log.gap_rows)
    np.testing.assert_array_equal(log.samples, rates)


@pytest.mark.parametrize(
    "header",
    ["X (deg/s),Y (deg/s),Z (deg/s)", "gx_dps,gy_dps,gz_dps", "w x [°/s],w y [°/s],w z [°/s]",
     "X (DPS),Y (DPS),Z (DPS)", "a.x (deg s^-1),a.y (deg s^-1),a.z (deg s^-1)",
     "gx deg per s,gy deg per s,gz deg per s", "gx_degps,gy_degps,gz_degps"],
)  # fmt: skip
def test_units_of_a_header_in_the_spellings_that_are_met(header, rates, read):
    rows = "\n".join(f"{k},{x},{y},{z}" for k, (x, y, z) in enumerate(rates.tolist()))
    spelled = header.replace("deg s", "deg·s")
    for encoding in ("utf-8", "cp1252"):
        log = read(f"k,{spelled}\n{rows}\n".encode(encoding))
        np.testing.assert_array_equal(log.samples, rates)


def test_columns_in_another_order_than_x_y_z_are_put_in_order(rates, read):
    rows = "\n".join(f"{z},{x},{y}" for x, y, z in rates.tolist())
    log = read(f"gz_dps,gx_dps,gy_dps\n{rows}\n")
    np.testing.assert_array_equal(log.samples, rates)


def test_a_file_without_header_is_read_by_numbers_of_columns(rates, read):
    rows = "\n".join(f"{k},{z},{y},{x}" for k, (x, y, z) in enumerate(rates.tolist())) + "\n"
    options = {"units": "deg/s", "time_column": 0, "time_units": "ms"}
    log = read(rows, columns=(3, 2, 1), **options)
    np.testing.assert_array_equal(log.samples, rates)
    assert log.rate_hz == pytest.approx(1000)
    with pytest.raises(InputError, match=r"expected a column 7 \(from 0\), got 4 columns"):
        read(rows, columns=(3, 2, 7), **options)


def test_units_of_the_options_win_over_the_format_but_not_over_the_header(good, rates, read):
    log = read(good["movella_dot"], units="rad/s")
    np.testing.assert_allclose(log.samples, np.degrees(rates), rtol=1e-14)
    with pytest.raises(InputError, match="the header says deg/s.*and units of the options rad/s"):
        read(good["ngimu"], units="rad/s")
    with pytest.raises(InputError, match="the header says ms.*and time_units of the options s"):
        read(good["general"], time_units="s")


def below_the_header(text, *lines):
    """With lines between header and rows."""
    header, rows = text.split("\n", 1)
    return "\n".join([header, *lines, rows])


@pytest.mark.parametrize("lines", [["# start"], ["", "started; at noon", "# 1"]])
def test_lines_between_header_and_rows_hide_neither_names_nor_units(lines, good, rates, read):
    text = below_the_header(good["general"], *lines)
    log = read(text, 100)
    np.testing.assert_allclose(log.samples, rates, rtol=0, atol=1e-7)
    assert log.rate_hz == pytest.approx(100)
    assert not log.findings
    with pytest.raises(InputError, match="the header says rad/s.*and units of the options deg/s"):
        read(text, columns=(2, 3, 4), units="deg/s")


def test_a_row_of_units_is_not_overruled(good, rates, read):
    rows = "\n".join(f"{k};{x};{y};{z}" for k, (x, y, z) in enumerate(rates.tolist()))
    text = f"t;wx;wy;wz\nms;rad/s;rad/s;rad/s\n{rows}\n"
    log = read(text, columns=(1, 2, 3), time_column=0)
    np.testing.assert_allclose(log.samples, np.degrees(rates))
    assert log.rate_hz == pytest.approx(1000)
    with pytest.raises(InputError, match="the header says rad/s.*and units of the options deg/s"):
        read(text, columns=(1, 2, 3), units="deg/s")
    by_name = read(text.replace("t;wx", "t;gyro_x"), columns=("gyro_x", "wy", "wz"))
    np.testing.assert_allclose(by_name.samples, np.degrees(rates))
    told = read(text)
    np.testing.assert_allclose(told.samples, np.degrees(rates))
    assert told.rate_hz == pytest.approx(1000)


@pytest.mark.parametrize(
    "line", ["# units: rad/s", "# angular rate in rad/s, time in us", "[rad s-1]"]
)
def test_a_format_whose_first_lines_say_another_unit_is_refused(line, good, rates, read):
    table = good["movella_dot"][good["movella_dot"].index("PacketCounter") :]
    with pytest.raises(InputError, match="of this format is deg/s, but lines above.*say rad/s"):
        read(f"{line}\n{table}")
    log = read(f"{line}\n{table}", units="rad/s")
    np.testing.assert_allclose(log.samples, np.degrees(rates), rtol=1e-14)
    assert not log.findings
    (said,) = read(f"{line}\n{table}", units="deg/s").findings
    assert said.detail == "deg/s, but lines above the header say rad/s"
    assert not read(f"{line.replace('rad', 'deg')}\n{table}").findings


@pytest.mark.parametrize("name", ["gx [frob]", "gx (1/s)"])
def test_options_overrule_an_unknown_unit_of_the_header_and_say_so(name, rates, read):
    names = [name.replace("x", axis) for axis in "xyz"]
    rows = "\n".join(f"{x},{y},{z}" for x, y, z in rates.tolist())
    log = read(f"{','.join(names)}\n{rows}\n", units="deg/s")
    assert "which is not known" in log.findings[0].detail
    axes = read(f"gyro[x],gyro[y],gyro[z]\n{rows}\n", units="deg/s")
    assert checks(axes) == [("timestamps", "kept")]


@pytest.mark.parametrize(
    ("unit", "deg_per_s"),
    [("rad s^-1", 180 / np.pi), ("rad·s⁻¹", 180 / np.pi), ("rad*s^-1", 180 / np.pi),
     ("Rad. per second", 180 / np.pi), ("mrad/s", 0.18 / np.pi), ("deg/h", 1 / 3600),
     ("°/h", 1 / 3600), ("m°/s", 1e-3)],
)  # fmt: skip
def test_units_of_a_header_scale_the_rates(unit, deg_per_s, rates, read):
    rows = "\n".join(f"{x},{y},{z}" for x, y, z in rates.tolist())
    log = read(f"gx [{unit}],gy [{unit}],gz [{unit}]\n{rows}\n")
    np.testing.assert_allclose(log.samples, rates * deg_per_s)
    with pytest.raises(InputError, match="the header says .* and units of the options deg/s"):
        read(f"gx [{unit}],gy [{unit}],gz [{unit}]\n{rows}\n", units="deg/s")


@pytest.mark.parametrize("suffix", [".parquet", ".h5"])
def test_units_in_attributes_of_columns_count(suffix, rates, read):
    def save(path):
        if suffix == ".h5":
            with h5py.File(path, "w") as file:
                file["gyro"] = rates
                file["gyro"].attrs["Units"] = np.array([b"rad/s"])
            return
        fields = [pa.field(f"gyro.{n}", pa.float64(), metadata={"unit": "rad/s"}) for n in "xyz"]
        pq.write_table(pa.table(list(rates.T), schema=pa.schema(fields)), path)

    for options in ({}, {"columns": ("gyro.x", "gyro.y", "gyro.z")}):
        log = read(save, name=f"log{suffix}", **options)
        np.testing.assert_allclose(log.samples, np.degrees(rates))
    with pytest.raises(InputError, match="the header says rad/s"):
        read(save, name=f"log{suffix}", units="deg/s")


@pytest.mark.parametrize(
    "text",
    [
        "time,gx_dps,gy_dps,gz_dps\ns,rad/s,rad/s,rad/s\n",
        "gx_dps (rad/s),gy_dps (rad/s),gz_dps (rad/s),t\n",
    ],
)
def test_two_units_in_a_header_are_refused(text, read):
    with pytest.raises(InputError, match="expected one unit of all rates"):
        read(text + "".join(f"{k},1.5,2.{k},3.5\n" for k in range(60)))


@pytest.mark.parametrize(
    ("header", "options", "words"),
    [
        ("gx (rad/s) low,gy (rad/s) low,gz (rad/s) low", {"units": "deg/s"}, "header says rad/s"),
        ("gx (0.01 dps/LSB),gy (0.01 dps/LSB),gz (0.01 dps/LSB)", {"units": "deg/s"}, "says raw"),
        ("gx (0.01 dps/LSB),gy (0.01 dps/LSB),gz (0.01 dps/LSB)", {}, "raw counts: give units"),
    ],
)
def test_units_within_a_header_count(header, options, words, read):
    with pytest.raises(InputError, match=words):
        read(header + "\n" + "1,2,3\n" * 60, **{"columns": (0, 1, 2)} | options)


@pytest.mark.parametrize(
    "name",
    ["gx [LSB/(deg/s)]", "gx [0.1*(deg/s)]", "gx (1/131 (deg/s))", "gx [deg/s]/32.8",
     "gx (deg/s)*100", "gx (deg/s) x100", "gx (deg/s) per sqrt Hz",
     "gx [(rad/s)/s]", "gx [(rad/s)^2]"],
)  # fmt: skip
def test_what_only_contains_a_unit_has_none(name, read):
    names = [name.replace("x", axis, 1) for axis in "xyz"]
    with pytest.raises(InputError, match="give columns|expected a unit of the rates"):
        read(",".join(["k", *names]) + "\n" + "0,1,2,3\n" * 60)


@pytest.mark.parametrize(
    "others", ["p (deg/s),bias_x,bias_y", "gyro_x,gyro_y,gyro_z", "rate (deg/s),a,b"]
)
def test_the_only_triple_is_not_taken_beside_other_rates(others, read):
    names = f"cov_x (deg/s),cov_y (deg/s),cov_z (deg/s),{others}"
    with pytest.raises(InputError, match="give columns"):
        read(names + "\n" + "1,2,3,4,5,6\n" * 60)


def test_a_triple_is_found_among_many_columns(rates, read):
    table = pd.DataFrame({f"c{n} (norm dps)": 0.5 for n in range(300)}, index=range(60))
    table[[f"g{axis} norm (dps)" for axis in "xyz"]] = rates
    log = read(lambda path: table.to_csv(path, index=False))
    np.testing.assert_array_equal(log.samples, rates)


def test_a_logger_of_counts_is_not_read_by_the_unit_of_its_format(good, read):
    table = good["movella_dot"][good["movella_dot"].index("PacketCounter") :]
    with pytest.raises(InputError, match="lines above the header say raw; give units"):
        read(f"Gyroscope: LSB\n{table}")


def test_another_column_with_a_unit_says_nothing_of_the_rates(good, rates, read):
    text = good["movella_dot"].replace("Acc_X", "omega_norm (rad/s)")
    np.testing.assert_array_equal(read(text).samples, rates)


def test_a_header_may_overrule_the_lines_above_it_which_is_said(good, read):
    (said,) = read("Gyroscope unit: rad/s\n" + good["ngimu"]).findings
    assert said.detail == "deg/s, but lines above the header say rad/s"


def test_the_rates_of_an_axis_each_are_told_from_their_norm(rates, read):
    names = [f"Gyroscope {axis} (rad/s)" for axis in "xyz"]
    table = pd.DataFrame(np.radians(rates), columns=names)
    table["Absolute (rad/s)"] = 5.0
    log = read(lambda path: table.to_csv(path, index_label="Time (s)"), time_units="s")
    np.testing.assert_allclose(log.samples, rates)
    table[[name.replace("Gyro", "Other gyro") for name in names]] = 1.0
    with pytest.raises(InputError, match="give columns"):
        read(lambda path: table.to_csv(path, index_label="Time (s)"))


@pytest.mark.parametrize(
    "name",
    [
        "Elapsed (s)",
        "Timestamps (s)",
        "time_stamp (s)",
        "Time/s",
        "t/s",
        "ts_s",
        "t [s]",
    ],
)
@pytest.mark.parametrize("before", ["T", "T_1", "T (degC)", "Time", "", "time (UTC)"])
def test_a_column_of_times_is_found_and_no_temperature_is_one(name, before, rates, read):
    names = f"{before},{name},gx (dps),gy (dps),gz (dps)"
    rows = "".join(
        f"25.{k % 7},{k / 50},{x},{y},{z}\n" for k, (x, y, z) in enumerate(rates.tolist())
    )
    log = read(f"{names}\n{rows}", 50)
    assert log.rate_hz == pytest.approx(50)
    assert not [one for one in log.findings if one.check != "temperature"]


@pytest.mark.parametrize(
    "name", ["time_boot_s", "time since boot (s)", "seconds", "Unix time CAL [s]", "sysTime_s"]
)
def test_a_column_with_a_unit_of_time_is_a_time(name, rates, read):
    rows = "".join(f"{k / 50},{x},{y},{z}\n" for k, (x, y, z) in enumerate(rates.tolist()))
    assert read(f"{name},gx (dps),gy (dps),gz (dps)\n{rows}").rate_hz == pytest.approx(50)


@pytest.mark.parametrize(
    "name", ["temp_valid", "temp_raw", "temp_lsb", "temp_mC", "attempt", "x_tempcomp", "temp_f"]
)
def test_what_only_sounds_like_a_temperature_is_none(name, good, read):
    log = read(good["general"].replace("temperature (°C)", name))
    assert (log.temperature_c, log.findings) == (None, ())


@pytest.mark.parametrize("time", ["07/31/2022 12:00:00.1{}", "12:00:00,1{}", "no {}"])
def test_times_that_are_not_read_cost_the_rate_and_not_the_file(time, rates, read):
    rows = "".join(f"{time.format(k)};{x};{y};{z}\n" for k, (x, y, z) in enumerate(rates.tolist()))
    text = f"Time;gx (dps);gy (dps);gz (dps)\n{rows}"
    log = read(text)
    np.testing.assert_array_equal(log.samples, rates)
    assert log.rate_hz is None
    assert log.findings[0].detail.startswith("'Time' left out: ")
    with pytest.raises(InputError, match="Time: expected a number"):
        read(text, time_column="Time", time_units="s")


def test_a_temperature_of_its_own_rate_is_left_out(rates, read):
    arrays = {"gyro_dps": rates, "t": np.arange(60) / 50, "temperature": np.full(3, 25.0)}
    log = read(lambda path: np.savez(path, **arrays), 50, name="log.npz", time_units="s")
    assert (log.temperature_c, log.rate_hz) == (None, pytest.approx(50))
    assert "'temperature' left out: " in log.findings[0].detail


def test_comments_among_the_rows_are_no_rows(good, rates, read):
    lines = good["ngimu"].splitlines()
    with_commas = "# so,1,2,3,4,5,6,7,8,9,10"
    for head in ([], [f"# {'setting ' * 10}"] * 60):
        marked = [*lines[:20], "# a marker", *lines[20:40], "// and another", with_commas]
        log = read("\n".join([*head, *marked, *lines[40:]]) + "\n", 400)
        np.testing.assert_array_equal(log.samples, rates)
        assert checks(log) == [("comments", "kept")]


def test_comments_end_with_any_line_end(good, rates, read):
    lines = good["ngimu"].splitlines()
    marked = "\r".join([*lines[:20], "# a,b,c,1", *lines[20:]]) + "\r"
    np.testing.assert_array_equal(read(marked).samples, rates)


def test_a_named_temperature_may_be_in_fahrenheit(good, read):
    text = good["general"].replace("temperature (°C)", "temp_f")
    assert read(text, temperature_column="temp_f").temperature_c[0] == pytest.approx(-3.8888889)


@pytest.mark.parametrize("name", ["loop time (us)", "delta_time [ms]", "exposure time (ms)"])
def test_a_duration_is_no_timestamp(name, good, rates, read):
    text = good["general"].replace("t_ms", name)
    assert read(text).rate_hz is None


@pytest.mark.parametrize("note", ["ok, fine", "Sun, 31 Jul", "[1,2]"])
def test_commas_in_texts_say_nothing_of_decimals(note, good, rates, read):
    lines = good["general"].splitlines()
    text = "\n".join([f"{lines[0]};note", *(f"{line};{note}" for line in lines[1:])])
    np.testing.assert_allclose(read(text + "\n").samples, rates, atol=1e-7)


def test_the_header_wins_over_the_format(good, rates, read):
    text = good["movella_dot"]
    for axis in "XYZ":
        text = text.replace(f"Gyr_{axis}", f"Gyr_{axis} (rad/s)")
    np.testing.assert_allclose(read(text).samples, np.degrees(rates), rtol=1e-14)


@pytest.mark.parametrize("unit", ["rpm", "rev/s", "LSB"])
def test_an_unknown_unit_in_the_header_is_refused_even_of_a_known_format(unit, good, read):
    text = good["movella_dot"]
    for axis in "XYZ":
        text = text.replace(f"Gyr_{axis}", f"Gyr_{axis} ({unit})")
    with pytest.raises(InputError, match="expected a unit of the rates|raw counts"):
        read(text)


def test_raw_counts_and_their_scale_go_together():
    for options in ({"units": "raw"}, {"scale_dps": 0.01}, {"units": "mdps", "scale_dps": 0.01}):
        with pytest.raises(ValidationError, match="units: raw and scale_dps go together"):
            ReaderOptions(**options)


def test_counts_that_the_header_names_are_scaled(rates, read):
    rows = "\n".join(f"{k},{k + 1},{-k}" for k in range(60)) + "\n"
    log = read("x (LSB),y (LSB),z (LSB)\n" + rows, units="raw", scale_dps=1 / 131)
    np.testing.assert_allclose(log.samples[:, 1], np.arange(1, 61) / 131)
    with pytest.raises(InputError, match="raw counts: give units: raw and scale_dps"):
        read("x (LSB),y (LSB),z (LSB)\n" + rows)


def test_a_format_can_be_forced_and_a_wrong_one_is_refused(good, read):
    options = {"columns": ("Acc_X", "Acc_Y", "Acc_Z"), "units": "mdps"}
    forced = read(good["movella_dot"], format="general", **options)
    np.testing.assert_allclose(forced.samples, [[0.1e-3, 0.2e-3, 9.8e-3]] * 60)
    with pytest.raises(InputError, match="expected a column 'gX', got 'PacketCounter'"):
        read(good["movella_dot"], format="openlog_artemis")
    with pytest.raises(InputError, match="expected format auto, movella_dot, .*got 'dot'"):
        read(good["movella_dot"], format="dot")


def test_a_new_format_is_a_class_and_an_entry(monkeypatch, rates, read):
    class Shimmer(Reader):
        rates = ("Gyro_X", "Gyro_Y", "Gyro_Z")
        units = "deg/s"

    monkeypatch.setattr("gyro_pipeline.readers.formats.READERS", {"shimmer": Shimmer(), **READERS})
    rows = "\n".join(f"{x}\t{y}\t{z}" for x, y, z in rates.tolist())
    np.testing.assert_array_equal(read(f"Gyro_X\tGyro_Y\tGyro_Z\n{rows}\n").samples, rates)


REAL = os.environ.get("GYRO_PIPELINE_REAL_DATA")


needs_real = pytest.mark.skipif(
    not REAL, reason="GYRO_PIPELINE_REAL_DATA names no folder of real recordings"
)


@needs_real
@pytest.mark.parametrize(
    ("unit", "rows"), [(1, 14461), (2, 14469), (3, 14464), (4, 14460), (5, 14468)]
)
def test_real_dot_files_are_read_as_numpy_reads_them(unit, rows):
    path = Path(REAL) / f"dot_x_stat_{unit}.csv"
    log = read_log(path, ReaderOptions(), 120)
    text = [line.split(",")[7:10] for line in path.read_text().splitlines()[1:]]
    np.testing.assert_array_equal(log.samples, np.array(text, np.float64))
    assert log.samples.shape == (rows, 3)
    assert not log.samples[0].any()
    assert log.rate_hz == pytest.approx(120, rel=1e-9)
    assert checks(log) == [UNIT]
    assert not len(log.gap_rows)
    assert np.isinf(log.samples).any(axis=1).nonzero()[0].tolist() == ([13001] if unit == 1 else [])
