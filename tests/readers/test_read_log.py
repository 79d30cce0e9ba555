"""From a file to a recording: a few of each kind, through all of the readers."""

import os
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from device_tables import still

from gyro_pipeline.parameters import ReaderOptions
from gyro_pipeline.readers import read_log

X = still(1200)
S = np.arange(len(X)) / 100
REAL = os.environ.get("GYRO_PIPELINE_REAL_DATA")


@pytest.mark.parametrize("delimiter", [",", ";", "\t"])
@pytest.mark.parametrize(
    "header",
    [
        "time (s),gx (rad/s),gy (rad/s),gz (rad/s)",
        "t,gx,gy,gz\ns,rad/s,rad/s,rad/s",
        "# in rad/s\nt (s),gx,gy,gz",
    ],
)
def test_a_text_is_read_in_deg_per_s_with_its_rate(delimiter, header, tmp_path):
    rows = pd.DataFrame(np.column_stack([S, np.radians(X)]))
    text = rows.to_csv(index=False, header=False, sep=delimiter)
    path = tmp_path / "log.csv"
    path.write_text(f"{header.replace(',', delimiter)}\n{text}")
    log = read_log(path, ReaderOptions(), 100)
    np.testing.assert_allclose(log.samples, X, rtol=1e-12)
    assert log.rate_hz == pytest.approx(100)
    assert not log.findings


def test_stored_columns_have_names_and_units_as_well(tmp_path):
    names = ["time (s)", "gx (deg/s)", "gy (deg/s)", "gz (deg/s)"]
    pd.DataFrame(np.column_stack([S, X]), columns=names).to_parquet(tmp_path / "log.parquet")
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
