"""From a file to a recording, through all of the readers."""

import os
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from gyro_pipeline.parameters import ReaderOptions
from gyro_pipeline.readers import read_log

REAL = os.environ.get("GYRO_PIPELINE_REAL_DATA")


def test_stored_columns_have_names_and_units_as_well(tmp_path, rates):
    seconds = np.arange(len(rates)) / 100
    columns = dict(zip(("gx (deg/s)", "gy (deg/s)", "gz (deg/s)"), rates.T, strict=True))
    pd.DataFrame({"time (s)": seconds} | columns).to_parquet(tmp_path / "log.parquet")
    np.savez(tmp_path / "log.npz", t_s=seconds, gyro_dps=rates)
    np.save(tmp_path / "log.npy", rates)
    for name, options in (("log.parquet", {}), ("log.npz", {}), ("log.npy", {"units": "deg/s"})):
        log = read_log(tmp_path / name, ReaderOptions(**options))
        np.testing.assert_array_equal(log.samples, rates)
        assert log.rate_hz == (None if name == "log.npy" else pytest.approx(100))


@pytest.mark.skipif(not REAL, reason="GYRO_PIPELINE_REAL_DATA names no folder of real recordings")
@pytest.mark.parametrize(
    ("unit", "rows"), [(1, 14461), (2, 14469), (3, 14464), (4, 14460), (5, 14468)]
)
def test_real_dot_files_are_read_as_numpy_reads_them(unit, rows):
    path = Path(REAL) / f"dot_x_stat_{unit}.csv"
    log = read_log(path, ReaderOptions(), 120)
    values = np.genfromtxt(path, delimiter=",", skip_header=1, usecols=range(4, 10))
    np.testing.assert_array_equal(log.samples, values[:, 3:])
    np.testing.assert_allclose(log.acceleration_g, values[:, :3] / 9.80665, rtol=1e-12)
    assert log.samples.shape == (rows, 3)
    assert log.rate_hz == pytest.approx(120, rel=1e-9)
    assert [(finding.check, finding.outcome) for finding in log.findings] == [("unit", "kept")]
    assert not len(log.gap_rows)
    assert np.isinf(log.samples).any(axis=1).nonzero()[0].tolist() == ([13001] if unit == 1 else [])
