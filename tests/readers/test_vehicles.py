"""Logs of vehicles, written by the libraries that read them where these can write."""

import struct
import sys

import numpy as np
import pytest

from gyro_pipeline.conventions import InputError
from gyro_pipeline.parameters import ReaderOptions
from gyro_pipeline.readers.table import read_table

N = 50
RATES = np.random.default_rng(3).normal([0.01, -0.02, 0.03], 1e-3, (N, 3)).astype(np.float32)
STAMPS_US = 5_000_000 + 10_000 * np.arange(N)
NAMES = ("gyro.x [rad/s]", "gyro.y [rad/s]", "gyro.z [rad/s]")
GYRO = "uint64_t timestamp;uint64_t timestamp_sample;float x;float y;float z;float temperature;"
COMBINED = "uint64_t timestamp;float[3] gyro_rad;float[3] accelerometer_m_s2;"


def ulog(path, *topics):
    """A ULog of (name, instance) with the offset of its rates, written anew by pyulog."""
    pyulog = pytest.importorskip("pyulog")
    message = lambda kind, data: struct.pack("<HB", len(data), ord(kind)) + data  # noqa: E731
    data = b"ULog\x01\x12\x35\x01" + struct.pack("<Q", 0) + message("B", bytes(40))
    for name in dict.fromkeys(name for name, *_ in topics):
        form = COMBINED if name == "sensor_combined" else GYRO
        data += message("F", f"{name}:{form}".encode())
    for number, (name, instance, _) in enumerate(topics):
        data += message("A", struct.pack("<BH", instance, number) + name.encode())
    for n in range(N):
        for number, (name, _, offset) in enumerate(topics):
            stamps = (STAMPS_US[n],) if name == "sensor_combined" else (STAMPS_US[n] + 300,) * 2
            more = (0, 0, -9.8) if name == "sensor_combined" else (31.5,)
            values = struct.pack(f"<{len(stamps)}Q", *stamps)
            values += struct.pack(f"<{3 + len(more)}f", *(RATES[n] + offset), *more)
            data += message("D", struct.pack("<H", number) + values)
    path.write_bytes(data)
    pyulog.ULog(str(path)).write_ulog(str(path))
    return path


def dataflash(path, instances=1):
    """A DataFlash log with messages IMU of devices."""
    pytest.importorskip("pymavlink")
    columns = "TimeUS,I,GyrX,GyrY,GyrZ,AccX,AccY,AccZ,EG,EA,T"
    table = {128: ("FMT", "BBnNZ", "Type,Length,Name,Format,Columns")}
    head, data = b"\xa3\x95", b""
    for number, (name, form, names) in (table | {130: ("IMU", "QBffffffIIf", columns)}).items():
        size = 89 if name == "FMT" else 3 + struct.calcsize("<" + form)
        texts = struct.pack("<4s16s64s", name.encode(), form.encode(), names.encode())
        data += head + struct.pack("<BBB", 128, number, size) + texts
    for n in range(N):
        for i in range(instances):
            values = (STAMPS_US[n], i, *(RATES[n] + i), 0, 0, -9.8, 0, 0, 40.0)
            data += head + struct.pack("<BQBffffffIIf", 130, *values)
    path.write_bytes(data)
    return path


def bag(path, topics, version):
    """A bag with sensor_msgs/Imu in topics, and something else."""
    rosbag1, rosbag2 = map(pytest.importorskip, ("rosbags.rosbag1", "rosbags.rosbag2"))
    typesys = pytest.importorskip("rosbags.typesys")
    stores, storage = typesys.Stores, rosbag2.StoragePlugin
    if version == 1:
        store = typesys.get_typestore(stores.ROS1_NOETIC)
        out, to_bytes = rosbag1.Writer(path), store.serialize_ros1
    else:
        store = typesys.get_typestore(stores.ROS2_HUMBLE)
        plugin = storage.MCAP if version == "mcap" else storage.SQLITE3
        out, to_bytes = rosbag2.Writer(path, version=9, storage_plugin=plugin), store.serialize_cdr
    types, zeros = store.types, np.zeros(9)
    vector = types["geometry_msgs/msg/Vector3"]
    turn = types["geometry_msgs/msg/Quaternion"](0, 0, 0, 1)
    with out:
        imus = [out.add_connection(t, "sensor_msgs/msg/Imu", typestore=store) for t in topics]
        text = out.add_connection("/chatter", "std_msgs/msg/String", typestore=store)
        for n in range(N):
            stamp_ns = 1_700_000_000_000_000_000 + 1000 * int(STAMPS_US[n])
            stamp = types["builtin_interfaces/msg/Time"](*divmod(stamp_ns, 10**9))
            number = {"seq": n} if version == 1 else {}
            header = types["std_msgs/msg/Header"](stamp=stamp, frame_id="imu", **number)
            for offset, imu in enumerate(imus):
                rest = (vector(*(RATES[n] + offset)), zeros, vector(0, 0, 9.8), zeros)
                message = types[imu.msgtype](header, turn, zeros, *rest)
                out.write(imu, stamp_ns + 10**6 * (n % 3), to_bytes(message, imu.msgtype))
        out.write(text, stamp_ns, to_bytes(types[text.msgtype]("hello"), text.msgtype))
    return path


def read(path, **options):
    table = read_table(path, ReaderOptions(**options))
    columns = dict(zip(table.names, table.columns, strict=True))
    return table, columns, np.stack([columns[name] for name in NAMES]).T


WRITERS = {
    "ulg": lambda path: ulog(path / "log.ulg", ("sensor_gyro", 0, 0)),
    "bin": lambda path: dataflash(path / "log.bin"),
    "ros1": lambda path: bag(path / "log.bag", ["/imu"], 1),
    "ros2": lambda path: bag(path / "log", ["/imu"], 2),
    "db3": lambda path: next(bag(path / "log", ["/imu"], 2).glob("*.db3")),
    "mcap": lambda path: next(bag(path / "log", ["/imu"], "mcap").glob("*.mcap")),
}


@pytest.mark.parametrize("kind", WRITERS)
def test_the_only_gyroscope_of_a_log_is_read(tmp_path, kind):
    table, columns, rates = read(WRITERS[kind](tmp_path))
    np.testing.assert_allclose(rates, RATES, rtol=1e-6)
    stamps = columns["time [us]"] * 1e-6 if "time [us]" in columns else columns["time [s]"]
    np.testing.assert_allclose(np.diff(stamps), 0.01, rtol=1e-9)
    assert all(column.dtype == np.float64 for column in table.columns)
    if kind == "ulg":
        assert columns["temperature [degC]"][0] == pytest.approx(31.5)
    else:
        assert abs(columns["accel.z [m/s^2]"][0]) == pytest.approx(9.8)


def test_px4_s_own_gyroscope_is_preferred_to_corrected_rates(tmp_path):
    path = ulog(tmp_path / "log.ulg", ("sensor_combined", 0, 1), ("sensor_gyro", 0, 0))
    table, _, rates = read(path)
    np.testing.assert_allclose(rates, RATES, rtol=1e-6)
    assert not table.findings
    table, columns, rates = read(path, topic="sensor_combined")
    np.testing.assert_allclose(rates, RATES + 1, rtol=1e-6)
    assert "minus the autopilot's bias" in table.findings[0].detail
    assert columns["accel.z [m/s^2]"][0] == pytest.approx(-9.8)


SEVERAL = {
    "ulg": (lambda path: ulog(path / "log.ulg", ("sensor_gyro", 0, 0), ("sensor_gyro", 1, 1)),
            "sensor_gyro with instance: 1", {"instance": 1}),
    "bin": (lambda path: dataflash(path / "log.bin", 2), "IMU with instance: 1", {"instance": 1}),
    "bag": (lambda path: bag(path / "log.bag", ["/a/imu", "/b/imu"], 1),
            "topic: /a/imu, topic: /b/imu", {"topic": "/b/imu"}),
}  # fmt: skip


@pytest.mark.parametrize("kind", SEVERAL)
def test_of_several_gyroscopes_the_options_pick_one(tmp_path, kind):
    write, named, options = SEVERAL[kind]
    path = write(tmp_path)
    with pytest.raises(InputError, match=f"{named}.*`reader:`.*catalog.yml"):
        read(path)
    np.testing.assert_allclose(read(path, **options)[2], RATES + 1, rtol=1e-6)
    with pytest.raises(InputError, match="got topic: lost"):
        read(path, topic="lost")


@pytest.mark.parametrize("kind", ["ulg", "bin", "ros1", "db3", "mcap"])
def test_damaged_logs_end_in_a_refusal_or_a_table(tmp_path, kind, capfd):
    path, draws = WRITERS[kind](tmp_path), np.random.default_rng(0)
    whole = path.read_bytes()
    for flipped in (0, 10):
        data = bytearray(whole[: draws.integers(20, len(whole))])
        for at in draws.integers(8, len(data), flipped):
            data[at] = draws.integers(256)
        path.write_bytes(data)
        try:
            read_table(path, ReaderOptions())
        except InputError as error:
            assert str(path) in str(error)
        assert capfd.readouterr() == ("", "")


def test_logs_without_a_gyroscope_or_the_library_say_so(tmp_path, monkeypatch):
    with pytest.raises(InputError, match="expected messages with angular rates, got none"):
        read(ulog(tmp_path / "log.ulg", ("sensor_accel", 0, 0)))
    monkeypatch.setitem(sys.modules, "pyulog", None)
    with pytest.raises(InputError, match=r"pip install -e '\.\[logs\]'"):
        read(tmp_path / "log.ulg")
