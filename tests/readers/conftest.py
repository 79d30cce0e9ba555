"""Files of three loggers, and readers of files and tables that tests write."""

import numpy as np
import pytest

from gyro_pipeline.parameters import ReaderOptions
from gyro_pipeline.readers import log_of
from gyro_pipeline.readers.table import Table, read_table


@pytest.fixture(scope="session")
def rates():
    """(60, 3), deg/s, five decimals, all different and none zero."""
    noise = np.random.default_rng(5).normal(0, 0.06, (60, 3))
    return np.round([3.0, -0.9, 0.4] + noise, 5)


@pytest.fixture(scope="session")
def good(rates):
    """Text of a good file of each logger, by name."""
    rows = [(k, ",".join(np.char.mod("%.5f", row))) for k, row in enumerate(rates)]
    dot = [f"{k + 1},{4_000_000_000 + 8333 * k},0.1,0.2,9.8,{xyz}," for k, xyz in rows]
    angles = [f"{k / 120:.15g},-0.93,2.46,13.57,-0.41,-0.14,9.95,{xyz}, " for k, xyz in rows]
    general = [f"{10 * k};{25 + k / 8:.3f};{xyz.replace(',', ';')}" for k, xyz in rows]
    above = ["sep=,", "DeviceTag:,DOT 1", "OutputRate:,120Hz", ""]
    texts = {
        "dot": [*above, "PacketCounter,SampleTimeFine,Acc_X,Acc_Y,Acc_Z,x,y,z,", *dot],
        "angles": ["Time,phi,theta,psi,f_x,f_y,f_z,x,y,z,", *angles],
        "general": ["t_ms;temperature (°C);x;y;z", *general],
    }
    return {name: "\n".join(text) + "\n" for name, text in texts.items()}


@pytest.fixture
def table(tmp_path):
    """Read a table of bytes, text or whatever a function writes to a file."""

    def table(content, name="log.csv", **options):
        path = tmp_path / name
        if callable(content):
            content(path)
        else:
            path.write_bytes(content.encode() if isinstance(content, str) else content)
        return read_table(path, ReaderOptions(**options))

    return table


@pytest.fixture(scope="session")
def read():
    """Read a recording from a header between commas and columns: vectors, matrices, lists."""

    def read(header, *columns, preamble="", rate_hz=None, imu=None, **options):
        arrays = [np.array(c, object) if isinstance(c, list) else np.asarray(c) for c in columns]
        split = [vector for array in arrays for vector in (array.T if array.ndim > 1 else [array])]
        typed = tuple(c if c.dtype.kind in "OmM" else c.astype(float) for c in split)
        table = Table("log.csv", tuple(header.split(",")), typed, preamble)
        assert len(table.names) == len(typed)
        return log_of(table, ReaderOptions(**options), rate_hz, imu)

    return read


@pytest.fixture(scope="session")
def details():
    """Details of the findings of a check."""
    return lambda log, check: [f.detail for f in log.findings if f.check == check]
