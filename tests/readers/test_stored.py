"""Stored arrays and columns, and files that are none."""

import bz2
import gzip
import io
import sys
import types
import zipfile

import h5py
import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import scipy.io

from gyro_pipeline.conventions import InputError

T = np.arange(60) / 100


def save_v73(path, arrays):
    """As MATLAB does: 512 bytes of its own before HDF5, arrays transposed, what cells refer to."""
    with h5py.File(path, "w", userblock_size=512) as file:
        for name, array in (arrays | {"#refs#/a": np.ones((60, 3))}).items():
            file[name] = np.atleast_2d(array).T if array.ndim == 2 else array[None]
            file[name].attrs["MATLAB_class"] = np.bytes_("double")
    with path.open("r+b") as file:
        file.write(b"MATLAB 7.3 MAT-file".ljust(512))


def save_hdf5(path, arrays):
    with h5py.File(path, "w") as file:
        file.update(arrays)


def save_fields(path, arrays):
    """An array of a field of times, of three rates, and of text."""
    table = np.zeros(60, [("t", "f8"), ("gyro", "f8", 3), ("note", "U3")])
    table["t"], table["gyro"] = arrays["t"], arrays["gyro"]
    with path.open("wb") as file:
        np.save(file, table)


def save_mat5(path, arrays):
    scipy.io.savemat(path, arrays)


def nested(save):
    """In a structure, or a group, of the name log."""
    if save is save_mat5:
        return lambda path, arrays: save(path, {"log": arrays | {"name": "A"}})
    return lambda path, arrays: save(path, {f"log/{name}": array for name, array in arrays.items()})


@pytest.mark.parametrize(
    ("place", "save"),
    [
        ("", lambda path, arrays: np.savez(path, **arrays)),
        ("", save_mat5),
        ("log.", nested(save_mat5)),
        ("", save_v73),
        ("log.", nested(save_v73)),
        ("", save_hdf5),
        ("log.", nested(save_hdf5)),
        ("", save_fields),
    ],
)
def test_named_arrays_fields_and_structures_are_columns(place, save, rates, table):
    log = table(lambda path: save(path, {"t": T, "gyro": rates}), name="log.npz")
    named = {name: values for name, values in zip(log.names, log.columns, strict=True)}
    assert named.keys() - {"note"} == {f"{place}{n}" for n in ("t", "gyro.x", "gyro.y", "gyro.z")}
    np.testing.assert_array_equal(named[f"{place}t"], T)
    np.testing.assert_array_equal(named[f"{place}gyro.y"], rates[:, 1])


@pytest.mark.parametrize("dtype", [np.float64, np.float32, np.int16])
@pytest.mark.parametrize("turn", [np.asarray, np.transpose])
def test_three_columns_or_three_rows_of_npy_are_columns(dtype, turn, rates, table):
    values = (rates * 100).astype(dtype)
    log = table(lambda path: np.save(path, turn(values)), name="log.npy")
    assert log.names == ("x", "y", "z")
    np.testing.assert_array_equal(np.transpose(log.columns), values.astype(float))


def test_objects_are_never_unpickled_and_arrays_keep_their_lengths(rates, table):
    arrays = {"g": rates, "temperature": np.full(3, 25.0), "info": np.array([{}], object)}
    log = table(lambda path: np.savez(path, **arrays), name="log.npz")
    assert [len(values) for values in log.columns] == [60, 60, 60, 3]
    with pytest.raises(InputError, match="a row a sample.*got objects info, which are not read"):
        table(lambda path: np.savez(path, info=arrays["info"]), name="log.npz")


def test_parquet_columns_are_numbers_texts_times_and_units_of_attributes(table):
    dates = pd.Timestamp("2024-03-01") + pd.to_timedelta(np.arange(60) * 5, unit="ms")
    columns = {
        "date": pa.array(dates),
        "zone": pa.array(dates).cast(pa.timestamp("us", "UTC")),
        "clock": pa.array(dates.time),
        "since": pa.array(pd.to_timedelta(np.arange(60) * 5, unit="ms")),
        "count": pa.array([None, *range(1, 60)], pa.int32()),
        "kind": pa.array(["acc", None] * 30).dictionary_encode(),
        "text": pa.array([str(k) for k in range(60)]),
        "list": pa.array([[1.0, 2.0]] * 60),
    }
    fields = [pa.field(name, values.type, metadata={"unit": "rad/s"} if name == "count" else None)
              for name, values in columns.items()]  # fmt: skip
    content = pa.table(list(columns.values()), schema=pa.schema(fields))
    log = table(lambda path: pq.write_table(content, path), name="log.parquet")
    assert log.names == (*list(columns)[:4], "count [rad/s]", "kind", "text", "list")
    for values, dtype in zip(log.columns, ["M8[ns]", "M8[ns]", "m8[ns]", "m8[ns]"], strict=False):
        assert values.dtype == dtype
        assert np.ptp(values) == np.timedelta64(295, "ms")
    assert log.columns[4][1:].tolist() == list(range(1, 60))
    assert np.isnan(log.columns[4][0])
    assert log.columns[5][:2].tolist() == ["acc", None]
    assert log.columns[6].tolist() == list(range(60))
    with pytest.raises(
        InputError, match=r"expected numbers in 'list', got '\[1.0, 2.0\]' in row 0,"
    ):
        log.numbers(7)


@pytest.mark.parametrize("value", [np.array([b"rad/s"]), "rad/s", b"rad/s"])
def test_units_in_attributes_of_hdf5_are_in_the_name(value, rates, table):
    def save(path):
        with h5py.File(path, "w") as file:
            file["gyro"] = rates
            file["gyro"].attrs["Units"] = value

    assert table(save, name="log.h5").names[0] == "gyro.x [rad/s]"


def zipped(*names):
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        for name in names:
            archive.writestr(name, "text" * 500)
    return buffer.getvalue()


def npy(array):
    buffer = io.BytesIO()
    np.save(buffer, array, allow_pickle=True)
    return buffer.getvalue()


def parquet():
    buffer = io.BytesIO()
    pd.DataFrame({"x": T}).to_parquet(buffer)
    return buffer.getvalue()


def mat5(at, old, new):
    """A structure of an array, and an array, with other bytes in the former."""
    buffer = io.BytesIO()
    scipy.io.savemat(buffer, {"log": {"gyro_dps": np.ones((60, 3))}, "t": np.ones(60)})
    data = buffer.getvalue()
    place = data.index(b"gyro_dps") + at
    assert data[place : place + len(old)] == old
    return data[:place] + new + data[place + len(new) :]


REFUSED = [
    (gzip.compress(b"text"), "a gzip archive; unpack it with gunzip"),
    (bz2.compress(b"text"), "a bzip2 archive; unpack it"),
    (b"7z\xbc\xaf\x27\x1c", "a 7z archive; unpack it"),
    (zipped("log.csv"), r"a zip archive \(log.csv\); unpack it"),
    (zipped("[Content_Types].xml", "xl/workbook.xml"), "an Excel workbook"),
    (b"\xd0\xcf\x11\xe0" + bytes(600), "an Excel workbook"),
    (b"%PDF-1.7", "a PDF document"),
    (b"RDX3\nX\n", r"data of R; save its table in R by `write.csv\("),
    (b"version https://git-lfs.github.com/spec/v1\noid sha256:0\n", "by `git lfs pull`"),
    (b"<!DOCTYPE html>\n<html>", "a web page; download the file itself"),
    (zipped("log.csv")[:700], "damaged, copy it anew"),
    (parquet()[:700], "copy it anew"),
    (npy(np.ones((50, 3)))[:400], "copy it anew"),
    (npy(np.array([{}], object)), "got Python objects, which are never unpickled"),
    (npy(np.ones(50)), r"shape \(n, 3\)"),
    (npy(np.ones((6, 50))), "with a row a sample"),
    # SciPy would end the process, or fill the memory
    (mat5(64, b"\x09\0\0\0\xa0\x05\0\0", b"\x09\x38"), "data of type 14345"),
    (mat5(48, b"\x3c\0\0\0\x03\0\0\0", b"\x3c\0\0\x40"), r"an array of \(1073741884, 3\) in"),
    (mat5(40, b"\5\0\0\0\x08\0\0\0\x3c\0\0\0", b"\6\0\0\0\x08\0\0\0\x3c\0\0\x40"),
     r"an array of \(1073741884, 3\) in"),
    (mat5(28, b"\x08\0\0\0", b"\x18"), "an array without a class"),
    (mat5(32, b"\6\0", b"\6\x08"), r"an array of class 6 of data of types \[6, 5, 1, 9\]"),
    (mat5(32, b"\6\0", b"\5"), r"an array of class 5 of data of types \[6, 5, 1, 9\]"),
    (mat5(56, b"\1\0\0\0\0\0\0\0", b"\1\0\0\0\xa8\5"), r"class 6 of data of types \[6, 5, 1\]"),
]  # fmt: skip


@pytest.mark.parametrize(("content", "message"), REFUSED)
def test_what_is_not_read_comes_with_advice(content, message, table):
    with pytest.raises(InputError, match=f"log.csv: expected .*{message}"):
        table(content)


def test_compressed_data_of_r_are_told_by_their_name(table):
    with pytest.raises(InputError, match="data of R"):
        table(gzip.compress(b"RDX3\n"), name="log.rda")


def test_a_workspace_of_matlab_is_not_shown(monkeypatch, table):
    loaded = {"__header__": b"", "__function_workspace__": np.ones((9, 3)), "a": np.ones((6, 50))}
    monkeypatch.setattr(scipy.io, "loadmat", lambda *args, **options: loaded)
    with pytest.raises(InputError, match=r"got float64 \(6, 50\) a$"):
        table(lambda path: save_mat5(path, {"a": np.ones((6, 50))}))


@pytest.mark.parametrize(
    "content",
    [
        b"ULog\x01\x12\x35",
        b"#ROSBAG V2.0\n",
        b"\x89MCAP0\r\n",
        b"SQLite format 3\0",
        b"\xa3\x95\x80",
    ],
)
def test_logs_of_vehicles_are_read_elsewhere(content, monkeypatch, table):
    vehicles = types.ModuleType("vehicles")
    vehicles.read = lambda path, options: (path.name, options.row)
    monkeypatch.setitem(sys.modules, "gyro_pipeline.readers.vehicles", vehicles)
    monkeypatch.setattr("gyro_pipeline.readers.vehicles", vehicles, raising=False)
    assert table(content + bytes(100), row="x") == ("log.csv", "x")
    folder = lambda path: (path.mkdir(), (path / "metadata.yaml").touch())  # noqa: E731
    assert table(folder, name="bag") == ("bag", None)


def test_a_missing_file_and_a_folder_are_refused(table):
    with pytest.raises(InputError, match="cannot be read: No such file"):
        table(lambda path: None)
    with pytest.raises(InputError, match="cannot be read: Is a directory"):
        table(lambda path: path.mkdir())
