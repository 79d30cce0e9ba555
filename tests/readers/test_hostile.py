"""Files that claim more than they have, or lie elsewhere, are refused before memory is taken."""

import os
import struct
import tracemalloc
import zlib

import h5py
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from gyro_pipeline.conventions import InputError

ROWS = 200_000_000


def hdf5(path):
    with h5py.File(path, "w") as file:
        file.create_dataset("gyro", (ROWS, 3), "f8", chunks=(1000, 3))


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
