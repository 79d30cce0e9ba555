"""What ``ground_truth`` prints: nothing here is a mean; the table is shown as it is."""

import logging

import numpy as np
import pandas as pd
import pytest

from gyro_pipeline.conventions import AXES
from gyro_pipeline.pipelines.ground_truth.nodes import report_biases

SAMPLES, RATE_HZ = 200, 20.0


@pytest.fixture
def report(make_recordings, caplog):
    """Lines that are printed of so many recordings of two IMUs, with these standard errors."""

    def printed(recordings, error, masked=0, rejected=0):
        rates = make_recordings(np.zeros((2, recordings, 3)), SAMPLES, RATE_HZ, 0.01)
        rates.angular_rate[0, 0, :, 10 : 10 + masked] = np.nan
        rates.angular_rate[0, 0, :, 150:] = np.nan  # a shorter one
        keys = [(imu, n) for imu in (1, 2) for n in range(1, 1 + recordings)]
        bias = pd.DataFrame(
            [
                {"imu": imu, "recording": n, "axis": axis, "bias_dps": -1.23456789,
                 "standard_error_dps": error}
                for imu, n in keys
                for axis in AXES
            ]
        )  # fmt: skip
        outcomes = ["repaired"] + ["kept"] * (len(keys) - 1) + ["rejected"] * rejected
        more = [(3, n) for n in range(rejected)]
        quality = pd.DataFrame(keys + more, columns=["imu", "recording"]).assign(outcome=outcomes)
        with caplog.at_level(logging.INFO):
            report_biases(rates, bias, quality)
        return caplog.text.splitlines()[1:]

    return printed


@pytest.mark.parametrize(
    ("error", "shown"),
    [
        (0.000651, "-1.23457 ± 0.00065"),
        (0.0123, "-1.235 ± 0.012"),
        (0.5, "-1.23 ± 0.50"),
        (23.4, "-1 ± 23"),
        (np.nan, "-1.23457 ± –"),
    ],
)
def test_a_standard_error_has_two_digits_and_its_bias_as_many(report, error, shown):
    header, row, *_ = report(1, error)
    assert header.split() == "IMU recording x y z seconds masked outcome".split()
    assert row.count(shown) == 3


def test_lengths_and_masked_rows_are_those_of_each_recording(report):
    _, first, second, *_ = report(1, 0.1, masked=3)
    assert first.split()[-4:] == ["7.50", "3", "rows", "repaired"]
    assert second.split()[-4:] == ["10.00", "0", "rows", "kept"]


def test_what_is_not_shown_is_counted(report):
    lines = report(15, np.nan, rejected=4)
    assert len(lines) == 1 + 20 + 3
    assert lines[-3] == "10 more recordings are in the table of biases"
    assert lines[-2] == "4 recordings were rejected; why is in the table of quality"
    assert lines[-1].startswith("± –: no standard error")
