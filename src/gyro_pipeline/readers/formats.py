"""Vendors' formats, an entry of data each.

A format is recognised only by a header that no other vendor writes, and adds only what the file
does not say. Loggers whose headers name all units need no entry: NGIMU, x-IMU3, phyphox, Shimmer.
"""

import re
from dataclasses import dataclass
from functools import lru_cache

from gyro_pipeline.conventions import IN_READER, InputError
from gyro_pipeline.readers.table import Table


@dataclass(frozen=True)
class Format:
    """Properties of a vendor's files that the files do not state.

    Attributes:
        source: The documentation.
        rates: Names of the columns of the rates about x, y, z.
        units: Unit of the rates.
        acceleration: Names of the columns of the acceleration along x, y, z.
        acceleration_units: Unit of the acceleration.
        mark: Regular expression for text that only this vendor writes in the header or above it;
            empty if the names of the rates are unique.
        times: Names of columns of times with seconds per unit, the best first.
        counter: Name and width in bits of a packet counter.
    """

    source: str
    rates: str
    units: str
    acceleration: str
    acceleration_units: str = "m/s^2"
    mark: str = ""
    times: tuple[tuple[str, float], ...] = ()
    counter: tuple[str, int] = ("", 16)


FORMATS: dict[str, Format] = {
    "movella_dot": Format(
        source="Xsens DOT User Manual XD0502P, section 4.2: deg/s, m/s^2; SampleTimeFine in us",
        rates="Gyr_X Gyr_Y Gyr_Z",
        units="deg/s",
        acceleration="Acc_X Acc_Y Acc_Z",
        mark=r"^\W*DeviceTag\b|\bEuler_[XYZ]\b|\bdq_W\b|\bdv\[1\]",
        times=(("SampleTimeFine", 1e-6),),
        counter=("PacketCounter", 32),
    ),
    "movella_dot_angles": Format(
        source="DOT files of github.com/ansfl/Multiple-MEMS-IMUs-Estimation: deg/s, m/s^2, s",
        rates="w_x w_y w_z",
        units="deg/s",
        acceleration="f_x f_y f_z",
        mark="phi,theta,psi,f_x,f_y,f_z",
        times=(("Time", 1.0),),
    ),
    "xsens_mt_manager": Format(
        source="MTw Awinda User Manual, table of exported data: rad/s, m/s^2, counter wraps at "
        "65535; Xsens device API, XDI_SampleTimeFine: ticks of 10 kHz",
        rates="Gyr_X Gyr_Y Gyr_Z",
        units="rad/s",
        acceleration="Acc_X Acc_Y Acc_Z",
        mark=r"^\W*//",
        times=(("SampleTimeFine", 1e-4),),
        counter=("PacketCounter", 16),
    ),
    "openlog_artemis": Format(
        source="github.com/sparkfun/OpenLog_Artemis, SENSOR_UNITS.md: degrees per second, milli g",
        rates="gX gY gZ",
        units="deg/s",
        acceleration="aX aY aZ",
        acceleration_units="mg",
        mark=r"\b(rtcTime|output_Hz)\b",
    ),
    "ros_imu": Format(
        source="ROS sensor_msgs/Imu: rad/s, m/s^2; github.com/ros/ros_comm, rostopic: %time and "
        "stamp in ns; github.com/jmscslgroup/bagpy, bagreader.py: Time in s",
        rates="angular_velocity.x angular_velocity.y angular_velocity.z",
        units="rad/s",
        acceleration="linear_acceleration.x linear_acceleration.y linear_acceleration.z",
        times=(("%time", 1e-9), ("header.stamp", 1e-9), ("Time", 1.0)),
    ),
    "px4_sensor_combined": Format(
        source="docs.px4.io, SensorCombined: rad/s, m/s^2, timestamp in us",
        rates="gyro_rad[0] gyro_rad[1] gyro_rad[2]",
        units="rad/s",
        acceleration="accelerometer_m_s2[0] accelerometer_m_s2[1] accelerometer_m_s2[2]",
        times=(("timestamp", 1e-6),),
    ),
}
"""Formats by the value of the option ``format``."""


def find_all(table: Table, *names: str) -> list[int]:
    """Numbers of the columns with these names, also inside a message: ``field.accel.x``."""
    return [number for name in names for number in _find_name(table.names, name)]


@lru_cache(1 << 10)  # a folder's files have the same headers
def _find_name(headers: tuple[str, ...], name: str) -> list[int]:
    return [n for n, header in enumerate(headers) if f".{header}".endswith(f".{name}")]


def format_of(table: Table, name: str) -> Format | None:
    """The format of a name; for ``auto`` the first format that fits the table, or None.

    Raises:
        InputError: The table lacks columns of the named format.
    """
    text = f"{table.preamble}\n{','.join(table.names)}"
    for key, form in FORMATS.items():
        missing = [rate for rate in form.rates.split() if len(find_all(table, rate)) != 1]
        if key == name and missing:
            raise InputError(
                f"{table.where}: format {name} has a column {missing[0]!r}, got {table.listed()}; "
                f"correct format {IN_READER}"
            )
        fits = not missing and re.search(form.mark, text, re.MULTILINE)
        if key == name or (name == "auto" and fits):
            return form
    return None
