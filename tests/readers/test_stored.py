"""Stored arrays and columns, files that are none, and those that claim more than they have."""

import io
import os
import struct
import tracemalloc
import zipfile
import zlib

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
    with path.open("r+b") as file:
        file.write(b"MATLAB 7.3 MAT-file".ljust(512))


def save_hdf5(path, arrays):
    with h5py.File(path, "w") as file:
        file.update({f"log/{name}": array for name, array in arrays.items()})


def save_fields(path, arrays):
    """An array of a field of times, of three rates, and of text."""
    table = np.zeros(60, [("t", "f8"), ("gyro", "f8", 3), ("note", "U3")])
    table["t"], table["gyro"] = arrays["t"], arrays["gyro"]
    with path.open("wb") as file:
        np.save(file, table)


STORED = [
    ("", lambda path, arrays: np.savez(path, **arrays)),
    ("log.", lambda path, arrays: scipy.io.savemat(path, {"log": arrays | {"name": "A"}})),
    ("", save_v73),
    ("log.", save_hdf5),
    ("", save_fields),
]


@pytest.mark.parametrize(("structure", "save"), STORED)
def test_named_arrays_fields_and_structures_are_columns(structure, save, rates, table):
    log = table(lambda path: save(path, {"t": T, "gyro": rates}), name="log.npz")
    named = dict(zip(log.names, log.columns, strict=True))
    names = [f"{structure}{name}" for name in ("t", "gyro.x", "gyro.y", "gyro.z")]
    assert named.keys() - {"note"} == {*names}
    values = np.stack([named[name] for name in names], axis=1)
    np.testing.assert_array_equal(values, np.column_stack([T, rates]))


def test_the_longer_side_of_an_array_is_that_of_the_rows(rates, table):
    values = (rates * 100).astype(np.int16)
    for turned in (values, values.T):
        log = table(lambda path, turned=turned: np.save(path, turned), name="log.npy")
        assert log.names == ("x", "y", "z")
        np.testing.assert_array_equal(np.transpose(log.columns), values.astype(float))


def test_objects_are_never_unpickled_and_arrays_keep_their_lengths(rates, table):
    arrays = {"g": rates, "temperature": np.full(3, 25.0), "info": np.array([{}], object)}
    log = table(lambda path: np.savez(path, **arrays), name="log.npz")
    assert [len(values) for values in log.columns] == [60, 60, 60, 3]
    with pytest.raises(InputError, match="got none; arrays of objects are not read"):
        table(lambda path: np.savez(path, info=arrays["info"]), name="log.npz")


def test_parquet_columns_are_numbers_texts_and_times(table):
    dates = pd.Timestamp("2024-03-01") + pd.to_timedelta(np.arange(60) * 5, unit="ms")
    columns = {
        "zone": pa.array(dates).cast(pa.timestamp("us", "UTC")),
        "since": pa.array(pd.to_timedelta(np.arange(60) * 5, unit="ms")),
        "clock": pa.array(dates.time),
        "count": pa.array([None, *range(1, 60)], pa.int32()),
        "kind": pa.array(["acc", None] * 30).dictionary_encode(),
        "list": pa.array([[1.0, 2.0]] * 60),
    }
    log = table(lambda path: pq.write_table(pa.table(columns), path), name="log.parquet")
    assert log.names == tuple(columns)
    assert [values.dtype for values in log.columns[:2]] == ["M8[ns]", "m8[ns]"]
    assert {np.ptp(values) for values in log.columns[:2]} == {np.timedelta64(295, "ms")}
    assert log.columns[2][1] == "00:00:00.005000"
    np.testing.assert_array_equal(log.columns[3], [np.nan, *range(1, 60)])
    assert log.columns[4][:2].tolist() == ["acc", None]
    with pytest.raises(InputError, match=r"expected numbers in 'list'.*got '\[1. 2.\]' in row 0,"):
        log.numbers(5)


def written(save, *content, **options):
    save(buffer := io.BytesIO(), *content, **options)
    return buffer.getvalue()


def zipped(*names):
    with zipfile.ZipFile(buffer := io.BytesIO(), "w") as archive:
        for name in names:
            archive.writestr(name, "text" * 500)
    return buffer.getvalue()


REFUSED = [
    (lambda path: None, "cannot be read: No such file"),
    (zipped("log.csv"), r"a zip archive \(log.csv\); unpack it"),
    (zipped("[Content_Types].xml", "xl/workbook.xml"), "an Excel workbook"),
    (b"RDX3\nX\n\x00\x00", "write.csv"),
    (b"version https://git-lfs.github.com/spec/v1\noid sha256:0\n", "git lfs pull"),
    (b"<!DOCTYPE html>\n<html>", "a web page; download the file itself"),
    (written(lambda b: pd.DataFrame({"x": T}).to_parquet(b))[:700], "copy the file again"),
    (written(scipy.io.savemat, {"x": np.ones((50, 3))})[:700], "copy the file again"),
    (written(np.save, np.array([{}], object), allow_pickle=True), "Python objects"),
    (written(np.save, np.ones((6, 5, 3))), r"such as \(n, 3\), got float64 \(6, 5, 3\)"),
]


@pytest.mark.parametrize(("content", "message"), REFUSED, ids=[text for _, text in REFUSED])
def test_what_is_not_read_comes_with_advice(content, message, table):
    with pytest.raises(InputError, match=f"log.csv: (expected )?.*{message}"):
        table(content)


def hdf5(path):
    with h5py.File(path, "w") as file:
        file.create_dataset("gyro", (200_000_000, 3), "f8", chunks=(1000, 3))


def npz(path):
    """A member whose size in the archive's directory is another one."""
    np.savez(path.open("wb"), gyro=np.zeros((100, 3)))
    content = bytearray(path.read_bytes())
    struct.pack_into("<I", content, content.index(b"PK\x01\x02") + 24, 3 * 10**9)
    path.write_bytes(content)


def mat(path):
    """A compressed element whose tag alone is there."""
    packed = zlib.compress(struct.pack("<II", 14, 3 * 10**9))
    head = b"MATLAB 5.0 MAT-file".ljust(124) + struct.pack("<H", 0x0100) + b"IM"
    path.write_bytes(head + struct.pack("<II", 15, len(packed)) + packed)


def parquet(path):
    pq.write_table(pa.table({"gyro": np.zeros(2 * 10**6, np.int8)}), path)


@pytest.mark.parametrize("write", [hdf5, npz, mat, parquet])
def test_a_file_that_claims_too_much_is_refused_before_memory_is_taken(write, table):
    tracemalloc.start()
    try:
        with pytest.raises(InputError, match="at most 10 MB of values, the file claims .* MB; if"):
            table(write, largest_mb=10)
    finally:
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
    assert peak < 10e6


def test_values_in_another_file_are_not_read(table, tmp_path):
    secret = tmp_path / "secret"
    secret.write_bytes(os.urandom(2400))

    def external(path):
        with h5py.File(path, "w") as file:
            file.create_dataset("gyro", (100, 3), "f8", external=[(secret, 0, 2400)])

    def virtual(path):
        layout = h5py.VirtualLayout((100, 3), "f8")
        layout[:] = h5py.VirtualSource(secret, "gyro", (100, 3))
        with h5py.File(path, "w") as file:
            file.create_virtual_dataset("gyro", layout)

    for save in (external, virtual):
        with pytest.raises(InputError, match="/gyro, whose values are in another file"):
            table(save)


def test_what_is_no_file_is_not_opened(table):
    for name, make in (("a", os.mkfifo), ("b", lambda path: path.symlink_to("/dev/zero"))):
        with pytest.raises(InputError, match="expected a file, got a pipe, a socket or a device"):
            table(make, name)
