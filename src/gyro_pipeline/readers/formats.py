"""Vendors' formats, a row of data each.

A format is claimed only by a header that no other vendor writes, and says only what the file leaves
open. Loggers whose headers name all units need no row: NGIMU, x-IMU3, phyphox, Shimmer.
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass

from gyro_pipeline.conventions import InputError
from gyro_pipeline.readers.table import IN_READER, Table

GENERAL = "general"


@dataclass(frozen=True)
class Format:
    """What a vendor's files leave open.

    Attributes:
        source: Where it is documented.
        rates: Names of the columns of the rates about x, y, z.
        units: Of the rates.
        marks: Names that only this vendor writes, in any one of these sets; nothing: the rates do.
        above: The same of the lines above the header, a regular expression.
        times: Names of columns of time and their units, in seconds, the best first.
        counter: Name and bits of a packet counter.
        acceleration: Names of columns along x, y, z, and their unit.
        scale: Name of the factor on rates that a line above the header gives.
        time_scale, acceleration_scale: The same, on times and accelerations.
        remark: What to know about the rates.
    """

    source: str
    rates: tuple[str, str, str]
    units: str
    marks: tuple[str, ...] = ()
    above: str = ""
    times: tuple[tuple[str, float | None], ...] = ()
    counter: tuple[str, int] | None = None
    acceleration: tuple[tuple[str, str, str], str] | None = None
    scale: str = ""
    time_scale: str = ""
    acceleration_scale: str = ""
    remark: str = ""

    def claims(self, table: Table) -> bool:
        """Whether a table has all of the rates, and a mark where those are not one."""
        marked = any(all(find_all(table, m) for m in marks.split()) for marks in self.marks)
        marked |= bool(self.above and re.search(self.above, table.preamble))
        unmarked = not (self.marks or self.above)
        return (marked or unmarked) and all(len(find_all(table, n)) == 1 for n in self.rates)


def find_all(table: Table, name: str) -> list[int]:
    """Columns of a name, also within a message: ``field.angular_velocity.x``."""
    return [k for k, n in enumerate(table.names) if n == name or n.endswith(f".{name}")]


def above_header(preamble: str, key: str) -> float:
    """The number that a line above the header gives to a key; 1 without."""
    match = re.search(rf"(?mi)^\W*{key}\W+([-+.\deE]+)", preamble) if key else None
    return float(match[1]) if match else 1.0


_DOT_ACCELERATION = (("Acc_X", "Acc_Y", "Acc_Z"), "m/s^2")

FORMATS: dict[str, Format] = {
    "movella_dot": Format(
        source="Xsens DOT User Manual XD0502P, section 4.2: deg/s, m/s^2, SampleTimeFine in us, it "
        "and PacketCounter wrap at 2^32; MT Manager's Euler angles are Roll, Pitch, Yaw",
        rates=("Gyr_X", "Gyr_Y", "Gyr_Z"),
        units="deg/s",
        marks=("Euler_X", "Euler_Y", "Euler_Z", "dq_W", "dv[1]"),
        above=r"(?m)^\W*DeviceTag\b",
        times=(("SampleTimeFine", 1e-6),),
        counter=("PacketCounter", 32),
        acceleration=_DOT_ACCELERATION,
    ),
    "movella_dot_angles": Format(
        source="DOT recordings published with Multiple-MEMS-IMUs-Estimation: deg/s, m/s^2, s",
        rates=("w_x", "w_y", "w_z"),
        units="deg/s",
        marks=("phi theta psi f_x f_y f_z",),
        times=(("Time", 1.0),),
        acceleration=(("f_x", "f_y", "f_z"), "m/s^2"),
    ),
    "xsens_mt_manager": Format(
        source="Xsens Awinda User Manual MW0502P, table of exported data: rad/s, m/s^2; counter of "
        "16 bits. MT Low Level Communication Protocol: SampleTimeFine counts at 10 kHz",
        rates=("Gyr_X", "Gyr_Y", "Gyr_Z"),
        units="rad/s",
        above=r"(?m)^\W*//",
        times=(("SampleTimeFine", 1e-4),),
        counter=("PacketCounter", 16),
        acceleration=_DOT_ACCELERATION,
    ),
    "openlog_artemis": Format(
        source="SparkFun OpenLog_Artemis, SENSOR_UNITS.md: gX in degrees per second, aX in milli g",
        rates=("gX", "gY", "gZ"),
        units="deg/s",
        marks=("rtcTime", "output_Hz"),
        times=(("rtcTime", None),),
        acceleration=(("aX", "aY", "aZ"), "mg"),
    ),
    "gyroflow": Format(
        source="docs.gyroflow.xyz, GCSV format: rates times gscale are in rad/s, t times tscale in "
        "s, accelerations times ascale in g",
        rates=("gx", "gy", "gz"),
        units="rad/s",
        above="GYROFLOW IMU LOG",
        times=(("t", 1.0),),
        acceleration=(("ax", "ay", "az"), "g"),
        scale="gscale",
        time_scale="tscale",
        acceleration_scale="ascale",
        remark="axes are those of the columns' names; the log's orientation is not applied",
    ),
    "ros_imu": Format(
        source="sensor_msgs/Imu: rad/s, m/s^2; %time of `rostopic echo -p` is in ns, bagpy's Time "
        "in s",
        rates=("angular_velocity.x", "angular_velocity.y", "angular_velocity.z"),
        units="rad/s",
        times=(("%time", 1e-9), ("header.stamp", 1e-9), ("Time", 1.0)),
        acceleration=(
            ("linear_acceleration.x", "linear_acceleration.y", "linear_acceleration.z"),
            "m/s^2",
        ),
    ),
    "px4_sensor_combined": Format(
        source="PX4 message sensor_combined: gyro_rad in rad/s, timestamp in us",
        rates=("gyro_rad[0]", "gyro_rad[1]", "gyro_rad[2]"),
        units="rad/s",
        times=(("timestamp", 1e-6),),
        acceleration=(
            ("accelerometer_m_s2[0]", "accelerometer_m_s2[1]", "accelerometer_m_s2[2]"),
            "m/s^2",
        ),
    ),
}
"""By the name that ``format`` of the options has."""

BIAS_TAKEN_OFF = {
    "motionRotationRate": "Core Motion removes the bias (Apple, CMDeviceMotion.rotationRate); "
    "gyroRotation columns are free of that",
    "gyroADC": "Betaflight takes off the mean at power-on",
    "unbiased|debias|bias_?(?:free|corrected|removed)|(?<!un)calibrated(?=[_ ]|$)": (
        "the name says that the bias is taken off"
    ),
}
"""Why rates whose names match hold what is left of a bias."""


def check_format(name: str, where: str) -> None:
    """Refuse a name that no format has.

    Raises:
        InputError: So it is.
    """
    known = ("auto", GENERAL, *FORMATS)
    if name not in known:
        raise InputError(f"{where}: expected format {', '.join(known)}, got {name!r}")


def format_of(table: Table, name: str) -> Format | None:
    """The format that the options name, or the first that claims the table; None of others.

    Raises:
        InputError: There is no format of that name, or the table lacks its columns.
    """
    check_format(name, f"{table.where}: format {IN_READER}")
    if name == "auto":
        return next((form for form in FORMATS.values() if form.claims(table)), None)
    if name == GENERAL:
        return None
    _refuse_without(table, FORMATS[name].rates, name)
    return FORMATS[name]


def _refuse_without(table: Table, columns: Sequence[str], name: str) -> None:
    for column in columns:
        if len(find_all(table, column)) != 1:
            raise InputError(
                f"{table.where}: format {name} has a column {column!r}, got {table.listed()}; "
                f"correct format {IN_READER}"
            )
