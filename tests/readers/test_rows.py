"""A recording is of one device: rows of others are refused or picked, and rows that are no samples
are left out."""

import numpy as np
import pytest
from device_tables import BIAS, read, said, still
from scipy.ndimage import uniform_filter1d

from gyro_pipeline.conventions import InputError

N = 6000
ROWS = np.arange(N)
BIASES = np.array([(1, -0.5, 0.25), (-0.3, 0.7, 0.1), (0.2, 0.1, -0.6), (0.25, 0.1, -0.6)])
RNG = np.random.default_rng(3)
SLIPPING = (ROWS + np.cumsum(RNG.random(N) < 0.01)) % 2


def read_beside(name, column, rates, **options):
    return read(f"time (s),{name},gx (dps),gy (dps),gz (dps)", ROWS / 300, column, rates, **options)


def devices(numbers):
    """Rates of several devices, by the number of each row's."""
    return np.random.default_rng(0).normal(BIASES[numbers], 0.05)


@pytest.mark.parametrize("name", ["sensor", "k", "gyro", ""])
@pytest.mark.parametrize(
    "numbers",
    [
        *[ROWS % count for count in (2, 3, 4)],
        *[ROWS // burst % 2 for burst in (5, 50, 400)],
        SLIPPING,
        RNG.integers(0, 3, N),
        np.repeat(RNG.integers(0, 3, N // 20), 20),
    ],
)
def test_devices_that_take_turns_are_refused_and_picked(name, numbers):
    rates = devices(numbers)
    words = f"{name or 'column 1'}' takes turns among 0 .* rows.*rows: {{{name or 1}: "
    with pytest.raises(InputError, match=words):
        read_beside(name, numbers, rates)
    log = read_beside(name, numbers, rates, rows={name or 1: 1})
    np.testing.assert_array_equal(log.samples, rates[numbers == 1])
    np.testing.assert_array_equal(log.rows, np.flatnonzero(numbers == 1))
    np.testing.assert_allclose(log.samples.mean(axis=0), BIASES[1], atol=0.01)
    assert said(read_beside(name, numbers, rates, trust="options"), "trust: options")


@pytest.mark.parametrize("order", [["acc", "gyr"] * 3000, (["acc"] * 300 + ["gyr"] * 300) * 10])
def test_texts_that_take_turns_say_what_a_row_is(order):
    rates = still(N)
    with pytest.raises(InputError, match=r"'kind' takes turns among acc \(3000 rows\), gyr"):
        read_beside("kind", order, rates)
    log = read_beside("kind", order, rates, rows={"kind": "gyr"})
    np.testing.assert_array_equal(log.samples, rates[np.array(order) == "gyr"])
    with pytest.raises(InputError, match="some with mag in 'kind', got acc .3000 rows., gyr"):
        read_beside("kind", order, rates, rows={"kind": "mag"})


def test_devices_tell_by_their_name_by_small_biases_and_by_their_noise():
    rates = still(N)
    with pytest.raises(InputError, match="'device_id'.*by its name devices"):
        read_beside("device_id", ROWS // 3000, rates)
    even = (ROWS % 2 == 0)[:, None]
    with pytest.raises(InputError, match="with 0 the rate about x differs by 0.03"):
        read_beside("k", ROWS % 2, rates + 0.03 * even)
    with pytest.raises(InputError, match="with 0 the noise about . differs by a factor of"):
        read_beside("k", ROWS % 2, np.where(even, BIAS + 2 * (rates - BIAS), rates))
    spiked = devices(ROWS % 2)
    spiked[100] = 1e6
    with pytest.raises(InputError, match="the rate about x differs by 1.3"):
        read_beside("k", ROWS % 2, spiked)


WHITE = still(N)
FILTERED = BIAS + uniform_filter1d(RNG.normal(0, 0.2, (N, 3)), 15, axis=0)
WALK = WHITE + np.cumsum(RNG.normal(0, 0.003, (N, 3)), axis=0)
COARSE = np.round(WHITE / 0.06) * 0.06
EACH_TENTH = ROWS % 10 == 0


@pytest.mark.parametrize("rates", [WHITE, FILTERED, WALK, COARSE])
@pytest.mark.parametrize(
    ("name", "column"),
    [
        ("temperature", 25 + 0.0625 * (np.sin(ROWS / 500) + RNG.normal(0, 0.3, N) > 0)),
        ("k", 25 + 0.0625 * (np.sin(ROWS / 500) + RNG.normal(0, 0.3, N) > 0)),
        ("status", ROWS > 2000),
        ("sync", EACH_TENTH),
        ("sync", ["True" if tenth else "False" for tenth in EACH_TENTH]),
        ("button", np.isin(ROWS, [100, 101, 3000, 5000])),
        ("k", ROWS % 8),
        ("k", ROWS % 256),
        ("ax", np.round(RNG.normal(0, 0.7, N))),
        ("k", np.round(RNG.normal(0, 0.7, N))),
        ("minute", ROWS // 6000),
        ("k", ROWS // 300 % 60),
        ("k", ROWS * 0),
        ("k", ["A"] * N),
        ("lat", np.where(ROWS % 100 == 0, 47.1, np.nan)),
        ("k", np.repeat(RNG.integers(0, 2, N // 50), 50)),
        ("k", np.repeat(RNG.integers(0, 2, N // 250), 250)),
        ("note", ["start", *[None] * (N - 1)]),
    ],
)
def test_other_columns_of_few_values_say_nothing_of_the_rows(name, column, rates):
    log = read_beside(name, column, rates)
    assert len(log.samples) == N
    assert log.rows is None


@pytest.mark.parametrize("blank", [ROWS % 2 == 1, ROWS % 3 != 0, ROWS // 16 % 3 != 0])
def test_rows_without_rates_at_a_regular_share_are_no_samples(blank):
    rates = np.where(blank[:, None], np.nan, WHITE)
    log = read_beside("k", ROWS, rates)
    np.testing.assert_array_equal(log.samples, WHITE[~blank])
    np.testing.assert_array_equal(log.rows, np.flatnonzero(~blank))
    assert said(log, "blank rows") == [
        f"{blank.sum()} of {N} rows are blank, at a regular share: no samples, left out"
    ]
    if blank[1] and not blank[2]:
        assert log.rate_hz == pytest.approx(150)


@pytest.mark.parametrize("lost", [RNG.random(N) < 0.2, ROWS // 100 == 20, np.isin(ROWS, [5, 90])])
def test_rows_that_are_lost_are_not_taken_for_no_samples(lost):
    log = read_beside("k", ROWS, np.where(lost[:, None], np.nan, WHITE))
    assert len(log.samples) == N
    assert np.isnan(log.samples).all(axis=1).sum() == lost.sum()


def test_repeated_rows_are_left_out_where_the_options_say_so():
    rates = np.repeat(WHITE[: N // 10], 10, axis=0)
    assert len(read_beside("k", ROWS, rates).samples) == N
    log = read_beside("k", ROWS, rates, repeats="drop")
    np.testing.assert_array_equal(log.samples, WHITE[: N // 10])
    assert log.rate_hz == pytest.approx(30)
    assert "5400 of 6000 rows repeat the one before" in said(log, "repeated rows")[0]
