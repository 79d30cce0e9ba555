"""Logs of vehicles as tables: PX4's ULog, ArduPilot's DataFlash, bags of ROS 1 and 2.

These hold many topics, each perhaps of several devices, and a table is of one. Which one is never
guessed: where several have angular rates, options pick. The libraries are an extra of the package.
"""

import io
import re
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

Columns = dict[str, NDArray]
Stream = tuple[str, int | None]
"""A topic, and the instance of it in formats that number devices."""

ULOG, DATAFLASH = b"ULog\x01\x12\x35", b"\xa3\x95"
PX4 = {  # https://docs.px4.io/main/en/msg_docs: the first one that is there is read
    "sensor_gyro": ("x", "y", "z"),
    "sensor_combined": ("gyro_rad[0]", "gyro_rad[1]", "gyro_rad[2]"),
    "vehicle_angular_velocity": ("xyz[0]", "xyz[1]", "xyz[2]"),
}
RATES = tuple(f"gyro.{axis} [rad/s]" for axis in AXES)
ACCELERATIONS = tuple(f"accel.{axis} [m/s^2]" for axis in AXES)


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
            "pip install -e '.[logs]'"
        ) from error
    except InputError:
        raise
    except Exception as error:  # each library has its own ways to fail at damaged bytes
        raise InputError(
            f"{path}: is damaged, cut or of an unknown version ({type(error).__name__}: {error}); "
            "copy it anew, of a bag with its metadata.yaml"
        ) from error
    values = tuple(column.astype(np.float64) for column in columns.values())
    return Table(str(path), tuple(columns), values, findings=tuple(findings))


def _px4(path: Path, options: ReaderOptions) -> tuple[Columns, list[Finding]]:
    from pyulog import ULog  # noqa: PLC0415 - an extra

    log = ULog(str(path), list(PX4))
    data = {(topic.name, topic.multi_id): topic.data for topic in log.data_list}
    first = next((name for name in PX4 if any(name == topic for topic, _ in data)), None)
    streams = [key for key in data if options.topic or key[0] == first]
    topic, instance = _pick(path, options, streams)
    rows = data[topic, instance]
    stamps = "timestamp_sample" if "timestamp_sample" in rows else "timestamp"
    names = {stamps: "time [us]", **dict(zip(PX4[topic], RATES, strict=True))}
    names |= {f"accelerometer_m_s2[{n}]": name for n, name in enumerate(ACCELERATIONS)}
    names |= {"temperature": "temperature [degC]"}
    text = f"{topic} holds rates freed of the autopilot's bias; sensor_gyro is the sensor's own"
    findings = [Finding("corrected rates", KEPT, text)] if topic != "sensor_gyro" else []
    if log.file_corruption:
        findings.append(Finding("damaged file", KEPT, "parts of the log cannot be read"))
    return {name: rows[key] for key, name in names.items() if key in rows}, findings


def _ardupilot(path: Path, options: ReaderOptions) -> tuple[Columns, list[Finding]]:
    """Messages IMU and GYR (https://ardupilot.org/copter/docs/logmessages.html)."""
    from pymavlink.DFReader import DFReader_binary  # noqa: PLC0415 - an extra

    class Log(DFReader_binary):
        init_arrays_fast = DFReader_binary.init_arrays  # what the fast one prints cannot be caught

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
    names |= dict(zip(("GyrX", "GyrY", "GyrZ"), RATES, strict=True))
    names |= dict(zip(("AccX", "AccY", "AccZ"), ACCELERATIONS, strict=True))
    text = "the autopilot has taken off the bias that it measured at its start (INS_GYR…OFFS)"
    columns = {column: rows[name] for name, column in names.items() if name in rows}
    return columns, [Finding("corrected rates", KEPT, text)]


def _fields(log: Any, number: int) -> Columns:
    """The numeric fields of all whole messages of a type, (n,) each, by their names."""
    message = log.formats[number]
    codes = re.findall(r"\d*\w", message.msg_struct)
    kinds = [f"<{code}" if code.isalpha() else f"S{code[:-1]}" for code in codes]
    row = np.dtype(list(zip(message.columns, kinds, strict=True)))
    starts = np.asarray(log.offsets[number], np.intp) + 3  # behind two bytes and the type's number
    starts = starts[starts + row.itemsize <= log.data_len]
    data = np.frombuffer(log.data_map, np.uint8)[starts[:, None] + np.arange(row.itemsize)]
    scales = dict(zip(message.columns, message.msg_mults, strict=True))
    rows = data.view(row)[:, 0]
    return {key: rows[key] * (scales[key] or 1) for key in scales if row[key].kind != "S"}


def _ros(path: Path, options: ReaderOptions) -> tuple[Columns, list[Finding]]:
    """Messages sensor_msgs/Imu (https://docs.ros.org/en/api/sensor_msgs/html/msg/Imu.html)."""
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
    names = (*RATES, *ACCELERATIONS)
    values = np.array(rows, float).reshape(len(rows), len(names))
    times = np.array(stamps_ns, np.int64)
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
    got = "" if allowed else f", got topic: {options.topic}, instance: {options.instance}"
    raise InputError(
        f"{path}: expected one device's angular rates{got}; the log has {listed}; give these in "
        "`reader:` of the catalog entry in catalog.yml"
    )
