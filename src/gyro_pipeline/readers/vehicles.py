"""Logs of vehicles as tables: PX4's ULog, ArduPilot's DataFlash, bags of ROS 1 and 2.

These hold many topics, each perhaps of several devices, and a table is of one. Which one is never
guessed: where several have angular rates, options pick. The libraries are an extra of the package.
"""

import io
import re
import struct
from collections.abc import Sequence
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gyro_pipeline.conventions import AXES, InputError
from gyro_pipeline.logs import KEPT, Finding
from gyro_pipeline.parameters import ReaderOptions
from gyro_pipeline.readers.table import Table

Columns = dict[str, NDArray[np.float64]]
Stream = tuple[str, int | None]
"""A topic, and the instance of it in formats that number devices."""

ULOG, DATAFLASH = b"ULog\x01\x12\x35", b"\xa3\x95"
PX4 = {  # https://docs.px4.io/main/en/msg_docs: the first one that is there is read
    "sensor_gyro": ("x", "y", "z"),
    "sensor_combined": ("gyro_rad[0]", "gyro_rad[1]", "gyro_rad[2]"),
    "vehicle_angular_velocity": ("xyz[0]", "xyz[1]", "xyz[2]"),
}
_RATES, _ACCELERATIONS = "gyro.{} [rad/s]", "accel.{} [m/s^2]"


def read(path: Path, options: ReaderOptions) -> Table:
    """Read the angular rates of one device from a log of a vehicle.

    Args:
        path: A file, or the folder of a bag of ROS 2.
        options: ``topic`` and ``instance`` pick among several.

    Raises:
        InputError: The file is damaged, its library is not installed, it has no angular rates, or
            those of several devices and the options do not say which.
    """
    reader = _ros
    if path.is_file():
        with path.open("rb") as file:
            head = file.read(len(ULOG))
        reader = _px4 if head == ULOG else _ardupilot if head.startswith(DATAFLASH) else _ros
    try:
        # the libraries print what they skip
        with redirect_stdout(io.StringIO()), redirect_stderr(io.StringIO()):
            columns, findings = reader(path, options)
    except ImportError as error:
        raise InputError(
            f"{path}: expected the library {error.name}, which is not installed; type "
            "pip install 'gyro-pipeline[logs]'"
        ) from error
    except InputError:
        raise
    except Exception as error:  # each library has its own ways to fail at damaged bytes
        raise InputError(
            f"{path}: is damaged, cut or of an unknown version ({type(error).__name__}: {error}); "
            "copy it anew, of a bag with its metadata.yaml"
        ) from error
    return Table(str(path), tuple(columns), tuple(columns.values()), findings=tuple(findings))


def _px4(path: Path, options: ReaderOptions) -> tuple[Columns, list[Finding]]:
    from pyulog import ULog  # noqa: PLC0415 - an extra

    log = ULog(str(path), list(PX4))
    data = {(topic.name, topic.multi_id): topic.data for topic in log.data_list}
    present = [name for name in PX4 if any(name == topic for topic, _ in data)]
    preferred = {key: rows for key, rows in data.items() if key[0] in present[:1]}
    topic, instance = _pick(path, options, list(data if options.topic else preferred))
    rows = data[topic, instance]
    stamps = rows.get("timestamp_sample", rows["timestamp"])
    columns = {
        "time [us]": stamps,
        **{_RATES.format(axis): rows[name] for axis, name in zip(AXES, PX4[topic], strict=True)},
    }
    for n, axis in enumerate(AXES):
        if f"accelerometer_m_s2[{n}]" in rows:
            columns[_ACCELERATIONS.format(axis)] = rows[f"accelerometer_m_s2[{n}]"]
    if "temperature" in rows:
        columns["temperature [degC]"] = rows["temperature"]
    text = f"{topic} holds rates freed of the autopilot's bias; sensor_gyro is the sensor's own"
    findings = [Finding("corrected rates", KEPT, text)] if topic != "sensor_gyro" else []
    if log.file_corruption:
        findings.append(Finding("damaged file", KEPT, "parts of the log cannot be read"))
    return {name: values.astype(np.float64) for name, values in columns.items()}, findings


def _ardupilot(path: Path, options: ReaderOptions) -> tuple[Columns, list[Finding]]:
    """Messages IMU and GYR (https://ardupilot.org/copter/docs/logmessages.html)."""
    from pymavlink.DFReader import DFReader_binary  # noqa: PLC0415 - an extra

    class Log(DFReader_binary):
        init_arrays_fast = DFReader_binary.init_arrays  # whose words can be caught

    log = Log(str(path))
    streams: dict[Stream, Columns] = {}
    for name, number in log.name_to_id.items():
        if re.fullmatch(r"(IMU|GYR)\d?", name) and len(log.offsets[number]):
            rows = _fields(log, number)
            instances = rows.get("I", np.zeros(len(rows["GyrX"])))
            for instance in np.unique(instances):
                here = instances == instance
                streams[name, int(instance)] = {key: rows[key][here] for key in rows}
    rows = streams[_pick(path, options, list(streams))]
    names = {"SampleUS" if "SampleUS" in rows else "TimeUS": "time [us]", "T": "temperature [degC]"}
    for axis in AXES:
        names[f"Gyr{axis.upper()}"] = _RATES.format(axis)
        names[f"Acc{axis.upper()}"] = _ACCELERATIONS.format(axis)
    text = "the autopilot has taken off the bias that it measured at its start (INS_GYR…OFFS)"
    columns = {column: rows[name] for name, column in names.items() if name in rows}
    return columns, [Finding("corrected rates", KEPT, text)]


def _fields(log: Any, number: int) -> Columns:
    """The numeric fields of all whole messages of a type, (n,) each, by their names."""
    message = log.formats[number]
    starts = np.asarray(log.offsets[number], np.intp) + 3  # behind two bytes and the type's number
    starts = starts[starts + message.len - 3 <= log.data_len]
    data, codes = np.frombuffer(log.data_map, np.uint8), re.findall(r"\d*\w", message.msg_struct)
    columns, at = {}, 0
    for name, code, factor in zip(message.columns, codes, message.msg_mults, strict=True):
        size = struct.calcsize(f"<{code}")
        if code.isalpha():
            values = data[starts[:, None] + np.arange(at, at + size)].view(f"<{code}")[:, 0]
            columns[name] = values.astype(np.float64) * (factor or 1)
        at += size
    return columns


def _ros(path: Path, options: ReaderOptions) -> tuple[Columns, list[Finding]]:
    """Messages sensor_msgs/Imu (https://docs.ros.org/en/api/sensor_msgs/html/msg/Imu.html)."""
    from rosbags.highlevel import AnyReader  # noqa: PLC0415 - an extra
    from rosbags.typesys import Stores, get_typestore  # noqa: PLC0415

    bag_path = path if path.is_dir() or path.suffix == ".bag" else path.parent
    with AnyReader([bag_path], default_typestore=get_typestore(Stores.LATEST)) as bag:
        imus = [link for link in bag.connections if link.msgtype == "sensor_msgs/msg/Imu"]
        topics = list(dict.fromkeys(imu.topic for imu in imus))
        topic, _ = _pick(path, options, [(topic, None) for topic in topics])
        rows = []
        for imu, received_ns, raw in bag.messages([imu for imu in imus if imu.topic == topic]):
            message: Any = bag.deserialize(raw, imu.msgtype)
            stamp = message.header.stamp
            stamp_ns = stamp.sec * 10**9 + stamp.nanosec
            vectors = message.angular_velocity, message.linear_acceleration
            numbers = (getattr(vector, axis) for vector in vectors for axis in AXES)
            rows.append((stamp_ns or received_ns, *numbers))
    times = np.array([row[0] for row in rows], np.int64)
    names = [name.format(axis) for name in (_RATES, _ACCELERATIONS) for axis in AXES]
    values = np.array([row[1:] for row in rows], np.float64).reshape(len(rows), len(names))
    since_s = (times - times[:1]) / 1e9  # from the first: float64 would round nanoseconds of today
    return {"time [s]": since_s, **dict(zip(names, values.T, strict=True))}, []


def _pick(path: Path, options: ReaderOptions, streams: Sequence[Stream]) -> Stream:
    """The only topic and instance with angular rates that the options allow.

    Raises:
        InputError: There is none, or more than one; names them all.
    """
    allowed = [
        (topic, instance)
        for topic, instance in streams
        if options.topic in (None, topic) and options.instance in (None, instance)
    ]
    if len(allowed) == 1:
        return allowed[0]
    if not streams:
        raise InputError(f"{path}: expected messages with angular rates, got none")
    listed = ", ".join(
        f"topic: {topic}" + ("" if instance is None else f" with instance: {instance}")
        for topic, instance in streams
    )
    asked = f", got topic: {options.topic}, instance: {options.instance}" if not allowed else ""
    raise InputError(
        f"{path}: expected one device's angular rates{asked}; the log has {listed}; give these in "
        "`reader:` of the catalog entry in catalog.yml"
    )
