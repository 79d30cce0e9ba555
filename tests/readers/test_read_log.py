"""From a file to a recording: a few of each kind, through all of the readers."""

import os
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from device_tables import said, still

from gyro_pipeline.conventions import InputError
from gyro_pipeline.parameters import ReaderOptions
from gyro_pipeline.readers import read_log

X = still(1200)
N = len(X)
S = np.arange(N) / 100
RATES = ["gx (deg/s)", "gy (deg/s)", "gz (deg/s)"]
REAL = os.environ.get("GYRO_PIPELINE_REAL_DATA")


def written(path, header, *columns, above="", delimiter=","):
    frame = pd.concat([pd.DataFrame(column) for column in columns], axis=1)
    frame.columns = header
    path.write_text(above + frame.to_csv(index=False, sep=delimiter))
    return path


@pytest.mark.parametrize("delimiter", [",", ";", "\t"])
def test_a_text_is_read_in_deg_per_s_with_its_rate(delimiter, tmp_path):
    path = written(tmp_path / "log.csv", ["time (s)", *RATES], S, X, delimiter=delimiter)
    log = read_log(path, ReaderOptions(), 100)
    np.testing.assert_allclose(log.samples, X, rtol=1e-12)
    assert log.rate_hz == pytest.approx(100)
    assert not log.findings


def test_units_in_a_row_of_their_own_or_above_the_header(tmp_path):
    path = written(tmp_path / "row.csv", ["t", "gx", "gy", "gz"], S, np.radians(X))
    header, rows = path.read_text().split("\n", 1)
    path.write_text(f"{header}\ns,rad/s,rad/s,rad/s\n{rows}")
    above = written(
        tmp_path / "above.csv", ["t (s)", "gx", "gy", "gz"], S, np.radians(X), above="# in rad/s\n"
    )
    for log in (read_log(path, ReaderOptions(), 100), read_log(above, ReaderOptions(), 100)):
        np.testing.assert_allclose(log.samples, X)
        assert log.rate_hz == pytest.approx(100)


def test_devices_that_take_turns_in_a_file(tmp_path):
    numbers = np.arange(N) % 3
    path = written(tmp_path / "log.csv", ["time (s)", "sensor", *RATES], S, numbers, X)
    with pytest.raises(
        InputError, match=f"{path}: 'sensor' takes turns among 0 .* rows: .sensor: 0"
    ):
        read_log(path, ReaderOptions())
    log = read_log(path, ReaderOptions(rows={"sensor": 1}))
    np.testing.assert_allclose(log.samples, X[1::3], rtol=1e-12)


def test_blank_cells_of_a_faster_accelerometer(tmp_path):
    rates = np.where(np.arange(N)[:, None] % 2, np.nan, X)
    names = ["time (s)", *RATES, "ax (g)", "ay (g)", "az (g)"]
    log = read_log(written(tmp_path / "log.csv", names, S, rates, X), ReaderOptions(), 50)
    np.testing.assert_allclose(log.samples, X[::2], rtol=1e-12)
    np.testing.assert_allclose(log.acceleration_g, X[::2], rtol=1e-12)
    assert log.rate_hz == pytest.approx(50)
    assert said(log, "blank rows")


def test_a_gyroflow_log(tmp_path):
    above = "GYROFLOW IMU LOG\nversion,1.1\norientation,YxZ\ntscale,0.001\ngscale,0.0001\n"
    counts = np.round(np.radians(X) / 0.0001).astype(int)
    path = written(
        tmp_path / "log.gcsv", list("t") + ["gx", "gy", "gz"], S * 1e3, counts, above=above
    )
    log = read_log(path, ReaderOptions(), 100)
    np.testing.assert_allclose(log.samples, np.degrees(counts * 0.0001))
    assert log.rate_hz == pytest.approx(100)


def test_stored_columns_have_names_and_units_as_well(tmp_path):
    frame = pd.DataFrame(np.column_stack([S, X]), columns=["time (s)", *RATES])
    frame.to_parquet(tmp_path / "log.parquet")
    np.savez(tmp_path / "log.npz", t_s=S, gyro_dps=X)
    np.save(tmp_path / "log.npy", X)
    for name, options in (("log.parquet", {}), ("log.npz", {}), ("log.npy", {"units": "deg/s"})):
        log = read_log(tmp_path / name, ReaderOptions(**options))
        np.testing.assert_array_equal(log.samples, X)
        assert log.rate_hz == (None if name == "log.npy" else pytest.approx(100))


@pytest.mark.skipif(not REAL, reason="GYRO_PIPELINE_REAL_DATA names no folder of real recordings")
@pytest.mark.parametrize(
    ("unit", "rows"), [(1, 14461), (2, 14469), (3, 14464), (4, 14460), (5, 14468)]
)
def test_real_dot_files_are_read_as_numpy_reads_them(unit, rows):
    path = Path(REAL) / f"dot_x_stat_{unit}.csv"
    log = read_log(path, ReaderOptions(), 120)
    text = [line.split(",")[4:10] for line in path.read_text().splitlines()[1:]]
    values = np.array(text, np.float64)
    np.testing.assert_array_equal(log.samples, values[:, 3:])
    np.testing.assert_allclose(log.acceleration_g, values[:, :3] / 9.80665, rtol=1e-12)
    assert log.samples.shape == (rows, 3)
    assert log.rate_hz == pytest.approx(120, rel=1e-9)
    assert [(finding.check, finding.outcome) for finding in log.findings] == [("unit", "kept")]
    assert not len(log.gap_rows)
    assert np.isinf(log.samples).any(axis=1).nonzero()[0].tolist() == ([13001] if unit == 1 else [])
