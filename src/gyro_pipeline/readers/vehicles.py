"""Reads logs of vehicles as tables: PX4's ULog, ArduPilot's DataFlash, bags of ROS 1 and 2.

These logs have many topics, possibly of several devices. If several have angular rates, the options
must pick one. The libraries are an extra of the package.
"""

import re
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from gyro_pipeline.conventions import AXES, IN_READER, InputError
from gyro_pipeline.logs import KEPT, Finding
from gyro_pipeline.parameters import ReaderOptions
from gyro_pipeline.readers.table import Reader, Table

Stream = tuple[str, int | None]
"""A topic, and the number of the device in formats that have one."""

PX4 = ("sensor_gyro", "sensor_combined", "vehicle_angular_velocity")
"""Topics with rates (https://docs.px4.io/main/en/msg_docs); the first in a log is read."""
NAMES = {
    "time [us]": "timestamp timestamp_sample TimeUS SampleUS",
    "gyro.x [rad/s]": "x gyro_rad[0] xyz[0] GyrX",
    "gyro.y [rad/s]": "y gyro_rad[1] xyz[1] GyrY",
    "gyro.z [rad/s]": "z gyro_rad[2] xyz[2] GyrZ",
    "accel.x [m/s^2]": "accelerometer_m_s2[0] AccX",
    "accel.y [m/s^2]": "accelerometer_m_s2[1] AccY",
    "accel.z [m/s^2]": "accelerometer_m_s2[2] AccZ",
    "temperature [degC]": "temperature T",
}
"""Columns of a table, and their fields in logs; the last existing field counts."""


def read_px4(path: Path, options: ReaderOptions) -> Table:
    """Read a ULog of PX4."""
    from pyulog import ULog  # noqa: PLC0415 - an extra

    log = ULog(str(path), list(PX4))
    data = {(topic.name, topic.multi_id): topic.data for topic in log.data_list}
    first = next((name for name in PX4 if any(name == topic for topic, _ in data)), None)
    stream = _pick(path, options, [key for key in data if options.topic or key[0] == first])
    findings = []
    if stream[0] != PX4[0]:
        text = (
            f"{stream[0]} holds rates minus the autopilot's bias; {PX4[0]} has the sensor's rates"
        )
        findings.append(Finding("corrected rates", KEPT, text))
    if log.file_corruption:
        findings.append(Finding("damaged file", KEPT, "parts of the log cannot be read"))
    return _table(path, data[stream], findings)


def read_ardupilot(path: Path, options: ReaderOptions) -> Table:
    """Read messages IMU and GYR (https://ardupilot.org/copter/docs/logmessages.html)."""
    from pymavlink.DFReader import DFReader_binary  # noqa: PLC0415 - an extra

    class Log(DFReader_binary):
        init_arrays_fast = DFReader_binary.init_arrays  # the fast one prints from C

    log = Log(str(path))
    streams: dict[Stream, list[dict[str, Any]]] = {}
    names = [name for name in log.name_to_id if re.fullmatch(r"(IMU|GYR)\d?", name)]
    while names and (message := log.recv_match(type=names)):
        fields = message.to_dict()
        streams.setdefault((message.get_type(), fields.get("I", 0)), []).append(fields)
    text = "the autopilot has subtracted the bias measured at its start (INS_GYR…OFFS)"
    messages = streams[_pick(path, options, streams)]
    rows = {field: [message[field] for message in messages] for field in messages[0]}
    return _table(path, rows, [Finding("corrected rates", KEPT, text)])


def read_ros(path: Path, options: ReaderOptions) -> Table:
    """Read sensor_msgs/Imu (https://docs.ros.org/en/api/sensor_msgs/html/msg/Imu.html)."""
    from rosbags.highlevel import AnyReader  # noqa: PLC0415 - an extra
    from rosbags.typesys import Stores, get_typestore  # noqa: PLC0415

    bag_path = path if path.is_dir() or path.suffix == ".bag" else path.parent
    with AnyReader([bag_path], default_typestore=get_typestore(Stores.LATEST)) as bag:
        imus = [link for link in bag.connections if link.msgtype == "sensor_msgs/msg/Imu"]
        topics = dict.fromkeys(imu.topic for imu in imus)
        topic, _ = _pick(path, options, [(topic, None) for topic in topics])
        stamps_ns, rows = [], []
        for imu, received_ns, raw in bag.messages([imu for imu in imus if imu.topic == topic]):
            message: Any = bag.deserialize(raw, imu.msgtype)
            stamp = message.header.stamp
            stamps_ns.append(stamp.sec * 10**9 + stamp.nanosec or received_ns)
            vectors = message.angular_velocity, message.linear_acceleration
            rows.append([getattr(vector, axis) for vector in vectors for axis in AXES])
    names, times = list(NAMES)[1:7], np.array(stamps_ns, np.int64)
    values = np.array(rows, float).reshape(len(rows), len(names))
    since_s = (times - times[:1]) / 1e9  # relative, as float64 cannot hold today's nanoseconds
    return Table(str(path), ("time [s]", *names), (since_s, *values.T))


READERS: dict[bytes, Reader] = {
    b"ULog\x01\x12\x35": read_px4,
    b"\xa3\x95": read_ardupilot,
    b"#ROSBAG": read_ros,
    b"\x89MCAP": read_ros,
    b"SQLite format 3": read_ros,
}
"""Readers by the first bytes of a file."""


def _table(path: Path, rows: Any, findings: list[Finding]) -> Table:
    """The table of all known fields of a mapping, each (n,)."""
    columns = {
        name: np.asarray(rows[field], np.float64)
        for name, fields in NAMES.items()
        for field in fields.split()
        if field in rows
    }
    return Table(str(path), tuple(columns), tuple(columns.values()), findings=tuple(findings))


def _pick(path: Path, options: ReaderOptions, streams: Iterable[Stream]) -> Stream:
    """The only topic and instance with angular rates that the options allow.

    Raises:
        InputError: No topic, or more than one, is allowed; the message lists them all.
    """
    topic, instance, allowed, listed = options.topic, options.instance, [], []
    for name, number in streams:
        listed.append(
            f"topic: {name}" + (f" with instance: {number}" if number is not None else "")
        )
        if topic in (None, name) and instance in (None, number):
            allowed.append((name, number))
    if len(allowed) == 1:
        return allowed[0]
    if not listed:
        raise InputError(f"{path}: expected messages with angular rates, got none")
    got = "" if allowed else f", got topic: {topic}, instance: {instance}"
    raise InputError(
        f"{path}: expected one device's angular rates{got}; the log has {', '.join(listed)}; give "
        f"these {IN_READER}"
    )
