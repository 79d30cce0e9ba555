"""The five public DOT files, and copies of them in other formats, through the raw-logs stage."""

import numpy as np
import pandas as pd
import pytest

from gyro_pipeline.datasets.recordings import open_recordings
from gyro_pipeline.physics.bias import recording_mean
from gyro_pipeline.recordings import cut_to_length, iterate_recordings

IMUS, RATE_HZ = (1, 2, 3, 4, 5), 120.0
START, STOP = 1, 13_000
"""From behind the row of zeros that each file begins with, to the dropout of file 1 in rows 13000
and 13001."""


@pytest.fixture(scope="module")
def files(real_file):
    return {imu: real_file(f"dot_x_stat_{imu}.csv") for imu in IMUS}


@pytest.fixture(scope="module")
def ran(new_project, files):
    """``kedro run --pipeline=ground_truth --env=dot_real``: the project, and what it said."""
    project = new_project()
    place = project.folder / "data/01_raw/dot_real"
    place.mkdir(parents=True)
    for file in files.values():
        (place / file.name).symlink_to(file)
    return project, project.run_here("ground_truth", "dot_real")


def test_each_row_of_zeros_and_the_dropout_are_found_and_cut(ran):
    project, done = ran
    assert done.code == 0, done.output
    assert "dot: 5 recordings, 4 kept, 1 repaired, 0 rejected" in done.output
    table = pd.read_csv(project.folder / "data/02_intermediate/dot_real/dot/quality.csv")
    assert table.outcome.tolist() == ["repaired", "kept", "kept", "kept", "kept"]
    assert table.rows.tolist() == [14461, 14469, 14464, 14460, 14468]
    assert (table.start == START).all()
    assert table.stop[1:].tolist() == [14469, 14464, 14460, 14468]
    assert table.findings.str.contains("zero rows: row 0, cut").all()
    assert "non-finite values: axes x, y, z, row 13001" in table.findings[0]
    assert "row 13000" in table.findings[0]
    assert table.rate_hz.tolist() == [RATE_HZ] * 5


def test_biases_and_noise_are_those_of_numpy_over_unmasked_rows_to_ten_digits(ran, files):
    rows = {}  # angular rates of each IMU as its file has them, (rows, 3), parsed here
    for imu, file in files.items():
        lines = file.read_text().splitlines()[1:]
        rows[imu] = np.array([[float(cell) for cell in line.split(",")[7:10]] for line in lines])
    data = ran[0].folder / "data"
    bias = pd.read_csv(data / "03_primary/dot_real/dot/bias.csv").set_index(["imu", "axis"])
    recordings = open_recordings(data / "02_intermediate/dot_real/dot/recordings.nc")
    assert recordings.attrs["rate_hz"] == RATE_HZ
    for imu, number, samples in iterate_recordings(recordings):
        measured = ~np.isnan(samples).any(axis=0)
        used = rows[imu][START : START + len(measured)][measured]
        assert number == 1
        assert len(used) >= STOP - START
        found = bias.loc[imu]
        np.testing.assert_allclose(found.bias_dps, used.mean(axis=0), rtol=5e-11)
        np.testing.assert_allclose(found.sample_sigma_dps, used.std(axis=0, ddof=1), rtol=5e-11)
    for imu, _, samples in iterate_recordings(cut_to_length(recordings, STOP - START)):
        means = rows[imu][START:STOP].mean(axis=0)
        np.testing.assert_allclose(recording_mean(samples), means, rtol=5e-11)
