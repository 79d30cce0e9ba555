"""The biases that ``ground_truth`` prints at its end."""

import logging

import numpy as np
import pandas as pd
import pytest

from gyro_pipeline.conventions import AXES
from gyro_pipeline.pipelines.ground_truth.report import report_biases

RATE_HZ, KEYS = 20.0, ["imu", "recording", "axis"]


@pytest.fixture
def report(make_recordings, caplog):
    """Lines that are printed of so many recordings of two IMUs, with these standard errors."""

    def printed(recordings, error, rejected=0):
        rates = make_recordings(np.zeros((2, 1, 3)), 200, RATE_HZ, 0.01)
        keys = [(imu, n) for imu in (1, 2) for n in range(1, 1 + recordings)]
        bias = pd.DataFrame([(*key, axis) for key in keys for axis in AXES], columns=KEYS)
        bias = bias.assign(bias_dps=-1.23456789, standard_error_dps=error)
        quality = pd.DataFrame(keys + [(3, n) for n in range(rejected)], columns=KEYS[:2])
        outcomes = ["repaired"] + ["kept"] * (len(keys) - 1) + ["rejected"] * rejected
        quality = quality.assign(outcome=outcomes, start=1, stop=201, masked=0, file="1.csv")
        quality["findings"] = "motion: it moved"
        quality = quality.astype({"masked": float})
        quality.loc[0, ["stop", "masked"]] = 151, 3
        with caplog.at_level(logging.INFO):
            report_biases(rates, bias, quality)
        return caplog.text.splitlines()[1:]

    return printed


@pytest.mark.parametrize(
    ("error", "shown"),
    [
        (0.000651, "-1.23457 ± 0.00065"),
        (0.5, "-1.23 ± 0.50"),
        (np.nan, "-1.23457 ± –"),
    ],
)
def test_a_standard_error_has_two_digits_and_its_bias_as_many(report, error, shown):
    header, row, *_ = report(1, error)
    assert header.split() == "imu recording x y z seconds outcome masked".split()
    assert row.count(shown) == 3


def test_lengths_and_masked_rows_are_those_of_each_recording(report):
    _, first, second, *_ = report(1, 0.1)
    assert first.split()[-3:] == ["7.50", "repaired", "3"]
    assert second.split()[-3:] == ["10.00", "kept", "0"]


def test_what_is_not_shown_is_counted(report):
    lines = report(15, np.nan, rejected=24)
    assert len(lines) == 1 + 20 + 1 + 2
    assert lines[21].startswith("± –: no standard error")
    assert lines[-2:] == [
        "10 more are in the table of biases",
        "rejected: IMU 3 recording 0, 1.csv, and 23 more: motion: it moved",
    ]
