"""Columns of times, told by content."""

import numpy as np
import pandas as pd
import pytest

from gyro_pipeline.readers.times import seconds


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize(
    ("texts", "expected"),
    [
        (["59:59.9", "00:00.0"], 0.1),
        (["10:00:00:5", "10:00:00:15"], 0.01),
        (["2019-09-27T01:59:59.5+02:00", "2019-09-27T01:00:00.5+01:00"], 1.0),
        (["2019-09-27 23:59:59.99 -0330", "2019-09-28 00:59:59.99 -02:30"], 0),
        (["Sep 27, 2019, 10:12:33.02 a.m.", "Sep 27, 2019, 10:12:33.03 a.m."], 0.01),
        (["11:59:59.99 pm", "12:00:00.00 am"], 0.01),
        (["23:59:59.99", "00:00:00.00"], 0.01),
        (["04.05.2023 23:59:59.99", "05.05.2023 00:00:00.00"], 0.01),
        (["05/04/2023 23:59:59.99", "05/05/2023 00:00:00.00"], 0.01),
    ],
)
def test_texts_of_times_are_told_by_content(texts, expected):
    times = seconds(np.array([texts[0], None, texts[1]], object), None)
    assert times[2] - times[0] == pytest.approx(expected, abs=1e-6)
    assert np.isnan(times[1])


def test_texts_that_are_no_times_or_may_be_two_are_none():
    for texts in (["acc", "gyr"], ["09:50", "09:51"], ["2023-05-04", "2023-05-05"], ["1.5", "1.6"]):
        assert seconds(np.array([*texts, None], object), 1.0) is None


def test_numbers_need_a_unit_of_any_size_and_datetimes_none():
    numbers = np.array([0.0, 400.0, np.nan])
    np.testing.assert_allclose(seconds(numbers, 25e-6), [0, 0.01, np.nan])
    assert seconds(numbers, None) is None
    dates = pd.to_datetime(["2023-05-04 10:00:00.00", None, "2023-05-04 10:00:00.01"]).to_numpy()
    for column in (dates, dates - dates[0]):
        np.testing.assert_allclose(seconds(column, None), [0, np.nan, 0.01])
