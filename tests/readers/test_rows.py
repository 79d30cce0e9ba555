"""A recording is of one device: rows of others are refused or picked, and rows that are no samples
are left out."""

import numpy as np
import pytest

from gyro_pipeline.conventions import InputError

N = 6000
ROWS = np.arange(N)
RNG = np.random.default_rng(3)
BIAS = np.array([0.7, -0.4, 0.15])
WHITE = np.random.default_rng(0).normal(BIAS, 0.05, (N, 3))
EVEN = (ROWS % 2 == 0)[:, None]


@pytest.fixture(scope="module")
def read_beside(read):
    """Read a recording beside another column."""
    header = "time (s),{},gx (dps),gy (dps),gz (dps)"
    return lambda name, column, rates, **options: read(
        header.format(name), ROWS / 300, column, rates, **options
    )


@pytest.mark.parametrize("numbers", [ROWS % 4, RNG.integers(0, 3, N)], ids=["turns", "random"])
def test_devices_that_take_turns_are_refused_and_picked(numbers, details, read_beside):
    with pytest.raises(InputError, match="device_id' has the values .*by its name.*rows: {dev"):
        read_beside("device_id", numbers, WHITE)
    log = read_beside("device_id", numbers, WHITE, rows={"device_id": 1})
    np.testing.assert_array_equal(log.samples, WHITE[numbers == 1])
    np.testing.assert_array_equal(log.rows, np.flatnonzero(numbers == 1))
    trusted = read_beside("device_id", numbers, WHITE, trust="options")
    assert details(trusted, "trust: options")


def test_findings_of_the_clock_count_the_rows_of_the_file(read, details):
    header, seconds = "time (s),sensor,gx (dps),gy (dps),gz (dps)", ROWS / 300 + (ROWS >= 3000)
    log = read(header, seconds, ROWS % 2, WHITE, rows={"sensor": 1})
    assert log.gap_rows.tolist() == [1500]
    (detail,) = details(log, "gaps")
    assert detail == "samples are missing, about 150: once, before row 3001"


def test_texts_say_what_a_row_is(read_beside):
    for column, words in (
        ((["acc"] * 300 + ["ω"] * 300) * 10, "say what a row is.*rows: {k: ω}"),
        (["LINEAR_ACCELERATION", "GYROSCOPE"] * 3000, "rows: {k: GYROSCOPE}"),
        (["acc", "mag"] * 3000, "rows: {k: …}"),
    ):
        with pytest.raises(InputError, match=words):
            read_beside("k", column, WHITE)
    with pytest.raises(InputError, match="some with 7 in 'k', got .*; correct rows"):
        read_beside("k", column, WHITE, rows={"k": 7})
    with pytest.raises(InputError, match="pick, by its name no angular rate, acc in 'k'"):
        read_beside("k", column, WHITE, rows={"k": "acc"})


def test_numbers_with_which_the_rate_changes_say_what_a_row_is(read_beside):
    with pytest.raises(InputError, match="rate about x changes by 0.03.*rows: {k: 0}"):
        read_beside("k", ROWS % 2, WHITE + 0.03 * EVEN)
    walk = WHITE + np.cumsum(RNG.normal(0, 0.003, (N, 3)), axis=0)
    for flag in (ROWS % 2, np.repeat(RNG.integers(0, 2, N // 50), 50), ROWS > 2000):
        assert len(read_beside("k", flag, walk).samples) == N


def test_other_columns_of_few_values_say_nothing_of_the_rows(read_beside):
    for name, column in (
        *(("k", ROWS % few) for few in (2, 8, 256)),
        *(("sensor", numbers) for numbers in (ROWS * 0 + 1, np.isin(ROWS, [9, 99]), ROWS // 90)),
        *((name, ROWS % 10) for name in ("sensor time", "device (degC)", "sensor_temp")),
        *(("k", texts) for texts in (["A"] * N, [None] * N, ["start", *[None] * (N - 1)])),
        ("k", np.where(ROWS % 10 == 0, "True", "False").tolist()),
    ):
        assert len(read_beside(name, column, WHITE).samples) == N


def test_rows_that_are_lost_are_not_taken_for_no_samples(read_beside):
    for lost in (RNG.random(N) < 0.2, ROWS // 100 == 20, np.isin(ROWS, [5, 90])):
        log = read_beside("k", ROWS, np.where(lost[:, None], np.nan, WHITE))
        assert np.isnan(log.samples).all(axis=1).sum() == lost.sum()
    blank = ROWS // 16 % 3 != 0  # at a regular share there is nothing to lose
    log = read_beside("k", ROWS, np.where(blank[:, None], np.nan, WHITE))
    np.testing.assert_array_equal(log.rows, np.flatnonzero(~blank))
