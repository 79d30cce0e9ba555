"""Small good files as the loggers write them, and a reader of bytes."""

import io

import numpy as np
import pandas as pd
import pytest

from gyro_pipeline.parameters import ReaderOptions
from gyro_pipeline.readers.table import read_table

ROWS = 60


def clock(seconds):
    """Time of day with hundredths."""
    minutes, s = divmod(round(seconds, 2), 60)
    return f"{int(minutes) // 60:02d}:{int(minutes) % 60:02d}:{s:05.2f}"


@pytest.fixture(scope="session")
def rates():
    """(60, 3), deg/s, five decimals, all different and none zero."""
    noise = np.random.default_rng(5).normal(0, 0.06, (ROWS, 3))
    return np.round([3.0, -0.9, 0.4] + noise, 5)


@pytest.fixture(scope="session")
def good(rates):
    """Text of a good file of each logger, by name."""
    lines = list(enumerate(rates.tolist()))
    dot = [
        f"{k + 1},{4_000_000_000 + 8333 * k},{0.1:.4f},{0.2},{9.8},{x:.5f},{y:.5f},{z:.5f},"
        for k, (x, y, z) in lines
    ]
    angles = [
        f"{k / 120:.15g},-0.93,2.46,13.57,-0.41,-0.14,9.95,{x:.5f},{y:.5f},{z:.5f}, "
        for k, (x, y, z) in lines
    ]
    artemis = [
        f"07/31/2022,{clock(43_199.7 + k / 100)},1,2,998,{x:.5f},{y:.5f},{z:.5f},0,0,0,{25 + k},"
        "90.1,"
        for k, (x, y, z) in lines
    ]
    ngimu = [f"{k / 400:.4f},{x:.5f},{y:.5f},{z:.5f},0,0,1,30,20,10,1013" for k, (x, y, z) in lines]
    texts = {
        "movella_dot": [
            "sep=,",
            "DeviceTag:,DOT 1",
            "OutputRate:,120Hz",
            "",
            "PacketCounter,SampleTimeFine,Acc_X,Acc_Y,Acc_Z,Gyr_X,Gyr_Y,Gyr_Z,",
            *dot,
        ],
        "movella_dot_angles": ["Time,phi,theta,psi,f_x,f_y,f_z,w_x,w_y,w_z,", *angles],
        "openlog_artemis": [
            "rtcDate,rtcTime,aX,aY,aZ,gX,gY,gZ,mX,mY,mZ,imu_degC,output_Hz,",
            *artemis,
        ],
        "ngimu": [
            "Time (s),Gyroscope X (deg/s),Gyroscope Y (deg/s),Gyroscope Z (deg/s),"
            "Accelerometer X (g),Accelerometer Y (g),Accelerometer Z (g),Magnetometer X (uT),"
            "Magnetometer Y (uT),Magnetometer Z (uT),Barometer (hPa)",
            *ngimu,
        ],
        "general": [
            "t_ms;temperature (°C);gx [rad/s];gy [rad/s];gz [rad/s]",
            *[
                f"{10 * k};{25 + k / 8:.3f};" + ";".join(f"{v:.9f}" for v in np.radians(row))
                for k, row in lines
            ],
        ],
    }
    return {name: "\n".join(text) + "\n" for name, text in texts.items()}


def written(path, content):
    """A file of bytes or text, or of what a function writes to it."""
    if callable(content):
        content(path)
    else:
        path.write_bytes(content.encode() if isinstance(content, str) else content)
    return path


@pytest.fixture
def table(tmp_path):
    """Read a table of bytes, text or whatever else can be written to a file."""

    def table(content, name="log.csv", **options):
        return read_table(written(tmp_path / name, content), ReaderOptions(**options))

    return table


@pytest.fixture
def read(tmp_path):
    """Read bytes, text or whatever else can be written to a file, with options by name."""

    from gyro_pipeline.readers import read_log  # noqa: PLC0415

    def read(content, rate_hz=None, name="log.csv", **options):
        return read_log(written(tmp_path / name, content), ReaderOptions(**options), rate_hz)

    return read


@pytest.fixture
def frame(good):
    """The DOT file with angles, as a data frame without its empty last column."""
    table = pd.read_csv(io.StringIO(good["movella_dot_angles"]), skipinitialspace=True)
    return table[[name for name in table if not name.startswith("Unnamed")]]
