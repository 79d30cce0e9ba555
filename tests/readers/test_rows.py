"""A recording is of one device: rows of others are refused or picked, and rows that are no samples
are left out."""

import numpy as np
import pytest
from scipy.ndimage import uniform_filter1d

from gyro_pipeline.conventions import InputError

N = 6000
ROWS = np.arange(N)
BIASES = np.array([(1, -0.5, 0.25), (-0.3, 0.7, 0.1), (0.2, 0.1, -0.6), (0.25, 0.1, -0.6)])
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


@pytest.mark.parametrize("name", ["gyro", ""])
@pytest.mark.parametrize("numbers", [ROWS % 4, np.repeat(RNG.integers(0, 3, N // 20), 20)])
def test_devices_that_take_turns_are_refused_and_picked(name, numbers, details, read_beside):
    rates = np.random.default_rng(0).normal(BIASES[numbers], 0.05)
    rates[100] = 1e6
    words = f"{name or 'column 1'}' takes turns among . .* rows.*rows: {{{name or 1}: "
    with pytest.raises(InputError, match=words):
        read_beside(name, numbers, rates)
    log = read_beside(name, numbers, rates, rows={name or 1: 1})
    np.testing.assert_array_equal(log.samples, rates[numbers == 1])
    np.testing.assert_array_equal(log.rows, np.flatnonzero(numbers == 1))
    assert details(read_beside(name, numbers, rates, trust="options"), "trust: options")


def test_findings_of_the_clock_count_the_rows_of_the_file(read, details):
    header, seconds = "time (s),sensor,gx (dps),gy (dps),gz (dps)", ROWS / 300 + (ROWS >= 3000)
    log = read(header, seconds, ROWS % 2, WHITE, rows={"sensor": 1})
    assert log.gap_rows.tolist() == [1500]
    (detail,) = details(log, "gaps")
    assert detail == "samples are missing, about 150: once, before row 3001"


@pytest.mark.parametrize(
    ("name", "column", "rates", "words"),
    [
        ("device_id", ROWS // 3000, WHITE, "0 .3000 rows., 1 .3000 rows., by its name devices"),
        ("k", ROWS % 2, WHITE + 0.03 * EVEN, "rate about x changes by 0.03"),
        ("k", ROWS % 2, BIAS + (WHITE - BIAS) * (1 + EVEN), "noise about . changes by 0.03"),
        ("k", (["acc"] * 300 + ["ω"] * 300) * 10, WHITE, "say what a row is.*rows: {k: ω}"),
        ("k", ["LINEAR_ACCELERATION", "GYROSCOPE"] * 3000, WHITE, "rows: {k: GYROSCOPE}"),
        ("k", ["acc", "mag"] * 3000, WHITE, "rows: {k: …}"),
        ("k", ["acc", "B"] * 3000, WHITE, "rows: {k: B}"),
    ],
)
def test_devices_tell_by_their_name_by_small_biases_by_their_noise_and_by_texts(
    name, column, rates, words, read_beside
):
    with pytest.raises(InputError, match=words):
        read_beside(name, column, rates)
    with pytest.raises(InputError, match=f"some with 7 in '{name}', got .*; correct rows"):
        read_beside(name, column, rates, rows={name: 7})
    if "acc" in column:
        with pytest.raises(InputError, match="pick, by its name no angular rate, acc in 'k'"):
            read_beside(name, column, rates, rows={name: "acc"})


@pytest.mark.parametrize(
    "rates",
    [
        WHITE,
        BIAS + uniform_filter1d(RNG.normal(0, 0.2, (N, 3)), 15, axis=0),
        WHITE + np.cumsum(RNG.normal(0, 0.003, (N, 3)), axis=0),
        np.round(WHITE / 0.06) * 0.06,
        np.full((N, 3), np.nan),
    ],
    ids=["white", "filtered", "walk", "coarse", "nothing"],
)
def test_other_columns_of_few_values_say_nothing_of_the_rows(rates, read_beside):
    tenth = ROWS % 10 == 0
    for column in (
        25 + 0.0625 * (np.sin(ROWS / 500) + RNG.normal(0, 0.3, N) > 0),
        *(ROWS > 2000, tenth, np.isin(ROWS, [100, 101, 3000, 5000]), ROWS % 8, ROWS % 256),
        *(np.where(tenth, "True", "False").tolist(), ["A"] * N, [None] * N),
        *(np.round(RNG.normal(0, 0.7, N)), ROWS // 300 % 60),
        np.where(ROWS % 100 == 0, 47.1, np.nan),
        np.repeat(RNG.integers(0, 2, N // 50), 50),
        np.repeat(RNG.integers(0, 2, N // 250), 250),
        ["start", *[None] * (N - 1)],
    ):
        assert len(read_beside("k", column, rates).samples) == N


@pytest.mark.parametrize("blank", [ROWS % 3 != 0, ROWS // 16 % 3 != 0])
def test_rows_without_rates_at_a_regular_share_are_no_samples(blank, details, read_beside):
    log = read_beside("k", ROWS, np.where(blank[:, None], np.nan, WHITE))
    np.testing.assert_array_equal(log.samples, WHITE[~blank])
    np.testing.assert_array_equal(log.rows, np.flatnonzero(~blank))
    assert f"{blank.sum()} of {N} rows are blank, at a regular" in details(log, "rows")[0]


def test_of_increments_the_step_between_rows_that_are_left_is_said(details, read):
    header, rates = "time (s),dx (deg),dy (deg),dz (deg)", np.where(EVEN, WHITE / 100, np.nan)
    log = read(header, ROWS / 200, rates, increments=True)
    np.testing.assert_allclose(log.samples, WHITE[::2])
    assert "divided by 0.01 s, the step between samples" in details(log, "increments")[0]


@pytest.mark.parametrize("lost", [RNG.random(N) < 0.2, ROWS // 100 == 20, np.isin(ROWS, [5, 90])])
def test_rows_that_are_lost_are_not_taken_for_no_samples(lost, read_beside):
    log = read_beside("k", ROWS, np.where(lost[:, None], np.nan, WHITE))
    assert np.isnan(log.samples).all(axis=1).sum() == lost.sum()


def test_repeated_rows_are_left_out_where_the_options_say_so(details, read_beside):
    rates = np.repeat(WHITE[: N // 10], 10, axis=0)
    assert len(read_beside("k", ROWS, rates).samples) == N
    log = read_beside("k", ROWS, rates, repeats="drop")
    np.testing.assert_array_equal(log.samples, WHITE[: N // 10])
    assert "5400 of 6000 rows repeat the one before" in details(log, "rows")[0]
