"""Rates and gaps of stamps and counters whose truth is known."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from gyro_pipeline.logs import REJECTED, REPAIRED
from gyro_pipeline.readers.clock import check_rate, from_counter, from_stamps

N = 1000


def rng():
    return np.random.default_rng(11)


def checks(timing):
    return [finding.check for finding in timing.findings]


def test_even_stamps_give_their_rate_exactly():
    timing = from_stamps(np.arange(N) / 120, 1.0)
    assert timing.rate_hz == pytest.approx(120, rel=1e-12)
    assert not timing.findings
    assert not len(timing.gap_rows)


@pytest.mark.parametrize(("unit_s", "scale"), [(1.0, 1), (1e-3, 1e3), (1e-6, 1e6), (1e-9, 1e9)])
def test_units_of_time_give_the_same_rate(unit_s, scale):
    assert from_stamps(np.arange(N) / 50 * scale, unit_s).rate_hz == pytest.approx(50)


@pytest.mark.parametrize("rate", [98.0, 120.0, 70.3])
def test_stamps_rounded_to_hundredths_give_the_true_rate_and_no_gaps(rate):
    timing = from_stamps(np.round(np.arange(N) / rate, 2), 1.0)
    assert timing.rate_hz == pytest.approx(rate, rel=2e-3)
    assert "gaps" not in checks(timing)


def test_stamps_of_whole_milliseconds_do_not_round_the_rate():
    timing = from_stamps(np.floor(np.arange(N) * 1000 / 120), 1e-3)
    assert timing.rate_hz == pytest.approx(120, rel=1e-3)
    assert not timing.findings


@pytest.mark.parametrize("burst", [4, 10, 25])
def test_stamps_in_bursts_give_the_count_over_the_duration(burst):
    written = np.ceil((np.arange(N) + 1) / burst) * burst / 250 + 1e-4 * rng().random(N)
    timing = from_stamps(np.sort(written), 1.0)
    assert timing.rate_hz == pytest.approx(250, rel=burst / N)
    assert checks(timing) == ["timestamps"]
    assert not len(timing.gap_rows)


def test_a_hole_in_bursts_is_a_gap_and_does_not_change_the_rate():
    written = np.ceil((np.arange(N) + 1) / 10) * 10 / 250
    written[500:] += 2
    timing = from_stamps(written, 1.0)
    assert timing.gap_rows.tolist() == [500]
    assert timing.rate_hz == pytest.approx(250, rel=0.02)


def test_lost_samples_are_gaps_and_do_not_change_the_rate():
    kept = np.delete(np.arange(N), [100, 101, 500])
    timing = from_stamps(kept / 200, 1.0)
    assert timing.gap_rows.tolist() == [100, 498]
    assert timing.rate_hz == pytest.approx(200, rel=1e-12)
    assert checks(timing) == ["gaps"]
    assert timing.findings[0].outcome == REPAIRED
    assert timing.findings[0].detail == (
        "samples are missing, about 3: 2 times, at rows 100, 498, cut there"
    )


def test_many_lost_samples_are_no_bursts():
    kept = np.flatnonzero(rng().random(N) > 0.1)
    timing = from_stamps(kept / 200, 1.0)
    assert timing.rate_hz == pytest.approx(200, rel=1e-12)
    np.testing.assert_array_equal(timing.gap_rows, np.flatnonzero(np.diff(kept) > 1) + 1)


def test_rows_without_a_stamp_are_no_gaps():
    stamps = np.arange(N) / 100
    stamps[[0, 30, 31, 700]] = np.nan
    timing = from_stamps(stamps, 1.0)
    assert timing.rate_hz == pytest.approx(100, rel=1e-12)
    assert not len(timing.gap_rows)


def test_jitter_is_said_and_averages_out():
    timing = from_stamps((np.arange(N) + rng().uniform(-0.2, 0.2, N)) / 100, 1.0)
    assert timing.rate_hz == pytest.approx(100, rel=1e-3)
    assert checks(timing) == ["jitter"]


def test_time_that_goes_back_is_a_gap():
    timing = from_stamps(np.r_[np.arange(600), np.arange(400)] / 100, 1.0)
    assert timing.gap_rows.tolist() == [600]
    assert timing.rate_hz == pytest.approx(100)
    assert checks(timing) == ["time order"]


def test_repeated_stamps_are_said():
    stamps = np.arange(N) / 120
    stamps[500] = stamps[499]
    timing = from_stamps(stamps, 1.0)
    assert checks(timing) == ["duplicated timestamps"]


@pytest.mark.parametrize(
    ("period", "step", "unit_s"),
    [(2**32, 8333, 1e-6), (2**16, 10, 1e-3), (2**24, 100, 1e-6), (86_400, 0.02, 1.0)],
)
def test_counters_of_time_and_midnight_are_unwrapped(period, step, unit_s):
    timing = from_stamps(np.mod(period - 500 * step + step * np.arange(N), period), unit_s)
    assert timing.rate_hz == pytest.approx(1 / (step * unit_s), rel=1e-9)
    assert not len(timing.gap_rows)
    assert checks(timing) == ["wrap-around"]
    assert timing.findings[0].detail.endswith("once, at row 500")


def test_bursts_of_a_counter_that_starts_anew_are_unwrapped():
    stamps = np.mod(2**16 - 300 + 50 * (np.arange(N) // 5 + 1), 2**16)
    timing = from_stamps(stamps, 1e-3)
    assert timing.rate_hz == pytest.approx(100, rel=1e-3)
    assert not len(timing.gap_rows)


@pytest.mark.parametrize("stamps", [np.zeros(9), np.full(9, np.nan)])
def test_stamps_that_do_not_advance_give_no_rate(stamps):
    timing = from_stamps(stamps, 1.0)
    assert timing.rate_hz is None
    assert checks(timing) == ["timestamps"]
    assert not len(timing.gap_rows)


def test_decreasing_stamps_are_a_gap_each_and_give_no_rate():
    timing = from_stamps(np.arange(9.0)[::-1], 1.0)
    assert timing.rate_hz is None
    assert checks(timing) == ["time order", "timestamps"]
    assert timing.gap_rows.tolist() == list(range(1, 9))


def test_stamps_of_an_unknown_unit_give_gaps_and_order_but_no_rate():
    timing = from_stamps(np.delete(np.r_[np.arange(600), np.arange(400)], 100) * 7.0, None)
    assert timing.rate_hz is None
    assert timing.gap_rows.tolist() == [100, 599]
    even = from_stamps(np.arange(N) * 7.0, None)
    assert (even.rate_hz, even.findings, len(even.gap_rows)) == (None, (), 0)


@pytest.mark.parametrize(("rate", "digits"), [(100, 2), (1000, 3), (50, 2), (50, 3), (10, 1)])
def test_samples_lost_at_random_are_seen_where_the_step_is_the_resolution(rate, digits):
    rows = np.sort(rng().choice(np.arange(1, 12 * N - 1), 12, replace=False))
    timing = from_stamps(np.round(np.delete(np.arange(12 * N), rows) / rate, digits), 1.0)
    np.testing.assert_array_equal(timing.gap_rows, rows - np.arange(12))
    assert timing.rate_hz == pytest.approx(rate, rel=1e-9)


@pytest.mark.parametrize(
    "stamps",
    [
        np.round(np.delete(np.arange(N), 500) / 100, 2),
        np.floor((np.arange(N) + 0.005) / 99.9 * 100) / 100,
    ],
)
def test_a_long_step_that_rounding_explains_as_well_as_a_loss_is_no_gap(stamps):
    assert not len(from_stamps(stamps, 1.0).gap_rows)


@pytest.mark.parametrize("seed", range(30))
def test_steps_at_random_are_no_change_of_the_rate(seed):
    draws = np.random.default_rng(seed)
    steps = draws.choice([0.01, 0.02], 1800) + 3e-4
    timing = from_stamps(np.cumsum(steps), 1.0)
    assert checks(timing) == ["jitter"]
    assert timing.rate_hz == pytest.approx(1 / steps.mean(), rel=0.01)
    assert not len(timing.gap_rows)


@pytest.mark.parametrize(("rate", "tick"), [(100, 1 / 64), (50, 1 / 64), (98, 0.01), (48, 0.01)])
def test_regularly_longer_steps_are_the_ticks_of_a_clock(rate, tick):
    timing = from_stamps(np.floor(np.arange(12 * N) / rate / tick) * tick, 1.0)
    assert not len(timing.gap_rows)
    assert timing.rate_hz == pytest.approx(rate, rel=1e-3)


@pytest.mark.parametrize(("rate", "unit"), [(100, 0.1), (97, 0.1), (100, 1.0), (250, 1.0)])
def test_several_rows_a_stamp_in_floats_give_the_rate_and_no_gaps(rate, unit):
    stamps = 1e4 + np.floor(np.arange(6000) / rate / unit + 1e-9) * unit
    timing = from_stamps(stamps, 1.0)
    assert timing.rate_hz == pytest.approx(rate, rel=1e-3)
    assert not len(timing.gap_rows)
    assert checks(timing) == ["timestamps"]


@pytest.mark.parametrize("scatter", [0.1, 0.15])
def test_late_stamps_are_no_gaps_and_lost_samples_among_them_are(scatter):
    stamps = np.arange(12 * N) + np.clip(rng().normal(0, scatter, 12 * N), -0.45, 0.45)
    timing = from_stamps(stamps / 100, 1.0)
    assert not len(timing.gap_rows)
    assert timing.rate_hz == pytest.approx(100, rel=1e-3)
    cut = from_stamps(np.delete(stamps, [4000, 4001, 9000, 9001]) / 100, 1.0)
    assert cut.gap_rows.tolist() == [4000, 8998]


def test_a_writer_that_stalls_and_catches_up_loses_nothing():
    stamps = np.arange(N) / 120.0
    for at in (200, 600):
        stamps[at : at + 40] = stamps[at + 40]
    timing = from_stamps(stamps, 1.0)
    assert not len(timing.gap_rows)
    assert timing.rate_hz == pytest.approx(120, rel=1e-9)


UNITS = [(1.0, 1.0), (1e-3, 1e3), (1e-6, 1e6)]


def ticks(rate, tick, rows):
    """Stamps of a clock that knows whole ticks, from 1,000 s on."""
    return np.floor((1000 + np.arange(rows) / rate) / tick + 1e-6) * tick


@pytest.mark.parametrize(("unit_s", "scale"), UNITS)
@pytest.mark.parametrize(
    ("rate", "tick", "rows", "stall_s"),
    [
        (1000, 1e-3, 12_000, 0.5),
        (100, 1e-3, 12_000, 2.0),
        (120, 1e-2, 1500, 0.5),
        (400, 1e-3, 1500, 0.5),
        (1600, 1e-3, 1500, 0.1),
        (833, 1e-3, 12_000, 2.0),
        (104, 1e-2, 12_000, 1.0),
    ],
)
def test_a_stall_is_none_whatever_the_rate_the_ticks_and_the_unit(
    rate, tick, rows, stall_s, unit_s, scale
):
    stamps = ticks(rate, tick, rows)
    late = slice(rows // 2, rows // 2 + round(stall_s * rate))
    stamps[late] = stamps[late.stop]
    timing = from_stamps(stamps * scale, unit_s)
    assert timing.rate_hz == pytest.approx(rate, rel=1e-3)
    assert not len(timing.gap_rows)


@pytest.mark.parametrize(("unit_s", "scale"), UNITS)
@pytest.mark.parametrize(
    ("rate", "tick"), [(1000, 1e-3), (120, 1e-2), (833, 1e-3), (100, 0.1), (97, 0.1), (250, 1e-6)]
)
def test_a_jump_of_the_clock_is_a_gap_and_does_not_spoil_the_rate(rate, tick, unit_s, scale):
    first, middle = ticks(rate, tick, 6000), ticks(rate, tick, 6000)
    first[0] = 0
    middle[3000:] += 3600
    for stamps, row in ((first, 1), (middle, 3000)):
        timing = from_stamps(stamps * scale, unit_s)
        assert timing.rate_hz == pytest.approx(rate, rel=5e-3)
        assert timing.gap_rows.tolist() == [row]


@pytest.mark.parametrize("stray", [0.0, 4e9, 1e150, np.nan])
@pytest.mark.parametrize(("rate", "tick"), [(1000, 1e-3), (120, 1e-2), (100, 0.1), (250, 1e-6)])
def test_a_stray_stamp_is_ignored(rate, tick, stray):
    stamps = ticks(rate, tick, 6000)
    stamps[[700, 3000]] = stray
    timing = from_stamps(stamps, 1.0)
    assert timing.rate_hz == pytest.approx(rate, rel=2e-3)
    assert not len(timing.gap_rows)
    if stray < 1e100:
        assert "ignored: 2 times, at rows 700, 3000" in timing.findings[0].detail


def test_swapped_rows_are_out_of_order_and_no_strays():
    stamps = np.arange(N) / 100
    stamps[[400, 401]] = stamps[[401, 400]]
    assert 401 in from_stamps(stamps, 1.0).gap_rows


@pytest.mark.parametrize("seed", range(5))
def test_the_last_stamp_may_be_late(seed):
    late = np.random.default_rng(seed).exponential(0.2, N)
    late[-1] = 0.9
    written = np.maximum.accumulate((np.arange(N) + late) / 100)
    timing = from_stamps(np.round(written, 4), 1.0)
    assert not len(timing.gap_rows)


@pytest.mark.parametrize(
    ("rate", "unit_s", "scale"), [(100, 1.0, 0.01), (100, 1e-6, 1e4), (40, 1e-3, 25)]
)
@pytest.mark.parametrize("doubled", [1, 100])
def test_doubled_rows_of_a_round_clock_are_said_and_do_not_change_the_rate(
    rate, unit_s, scale, doubled
):
    again = rng().choice(10 * N, doubled, replace=False)
    timing = from_stamps(np.sort(np.r_[np.arange(10 * N), again]) * scale, unit_s)
    assert timing.rate_hz == pytest.approx(rate, rel=1e-9 if doubled > 1 else 2e-4)
    assert not len(timing.gap_rows)
    assert "a timestamp repeats" in timing.findings[-1].detail


@pytest.mark.parametrize("rate", [100, 119])
def test_many_doubled_rows_are_no_change_of_the_rate(rate):
    stamps = np.repeat(np.arange(6 * N) / rate, 1 + (rng().random(6 * N) < 0.05))
    timing = from_stamps(stamps, 1.0)
    assert timing.rate_hz == pytest.approx(rate, rel=1e-9)
    assert checks(timing) == ["duplicated timestamps"]


@pytest.mark.parametrize(
    "lost",
    [np.arange(511, 10 * N, 512), np.arange(99, 9900, 100), np.arange(5000, 5200, 2)],
)
def test_samples_lost_at_regular_intervals_of_a_fine_clock_are_gaps(lost):
    micros = np.round(np.arange(10 * N) * 1e4 + rng().normal(0, 20, 10 * N))
    timing = from_stamps(np.delete(micros, lost), 1e-6)
    np.testing.assert_array_equal(timing.gap_rows, lost - np.arange(len(lost)))
    assert timing.rate_hz == pytest.approx(100, rel=1e-4)


@pytest.mark.parametrize(
    "stamps",
    [
        np.r_[np.arange(8000) / 100, 80 + np.arange(2000) / 92],
        np.r_[np.arange(3000) / 100, 30 + np.arange(7000) / 50],
        np.cumsum(1 / np.linspace(100, 95, 10_000)),
        np.floor(np.cumsum(1 / np.linspace(120, 110, 10_000)) * 1000) / 1000,
    ],
)
def test_a_rate_that_changes_is_rejected(stamps):
    finding = from_stamps(stamps, 1.0).findings[-1]
    assert (finding.check, finding.outcome) == ("sample rate", REJECTED)
    assert "along the recording: split the file" in finding.detail


def test_what_rounding_of_floats_takes_back_is_no_step_back():
    stamps = 1.7e9 + np.repeat(np.arange(N), 2) / 100 + np.tile([0, -2e-7], N)
    assert "time order" not in checks(from_stamps(stamps, 1.0))


def test_a_stray_packet_number_is_ignored():
    counts = np.arange(N, dtype=float)
    counts[300] = 60_000
    timing = from_counter(counts, 16)
    assert not len(timing.gap_rows)
    assert timing.findings[0].detail.endswith("and ignored: once, at row 300")


@pytest.mark.parametrize("bits", [8, 16])
def test_a_packet_counter_may_wrap_but_not_skip(bits):
    counts = np.mod(np.arange(N) + 2**bits - 100, 2**bits).astype(float)
    whole = from_counter(counts, bits)
    assert not len(whole.gap_rows)
    assert checks(whole) == ["wrap-around"]
    skipped = from_counter(np.delete(counts, [300, 301]), bits)
    assert skipped.gap_rows.tolist() == [300]
    assert checks(skipped) == ["wrap-around", "packet counter"]
    counts[300] = np.nan
    assert not len(from_counter(counts, bits).gap_rows)


@pytest.mark.parametrize("counts", [[5, 6, 6, 7], [5, 6, 3, 4], [5, 6, 8, 9]])
def test_a_packet_that_repeats_or_goes_back_or_skips_is_a_gap(counts):
    timing = from_counter(np.array(counts, float), 16)
    assert timing.gap_rows.tolist() == [2]
    assert checks(timing) == ["packet counter"]
    assert timing.rate_hz is None


def test_a_rate_within_the_tolerance_is_no_finding():
    assert check_rate(121.9, 120, 2.0) == ()


@pytest.mark.parametrize(
    ("rate", "advice"),
    [
        (60, "got 60 Hz; check the file's time"),
        (0.12, "it is off by 10^-3: check time_units"),
        (120e6, "it is off by 10^6: check time_units"),
    ],
)
def test_another_rate_is_rejected_with_advice(rate, advice):
    (finding,) = check_rate(rate, 120, 2.0)
    assert finding.outcome == REJECTED
    assert advice in finding.detail


STAMPS = st.one_of(
    arrays(float, st.integers(2, 40), elements=st.sampled_from([0.0, 0.01, 0.02, 0.1, 1.0, 500])),
    arrays(float, st.integers(2, 40), elements=st.one_of(st.integers(0, 60), st.just(np.nan))),
    arrays(float, st.integers(2, 40), elements=st.sampled_from([0.0, 1e-322, 1e-150, 1.0, 1e306])),
)


@pytest.mark.filterwarnings("error")
@given(steps=STAMPS, in_order=st.booleans())
def test_any_stamps_give_gaps_among_the_rows_and_a_rate_or_none(steps, in_order):
    timing = from_stamps(np.cumsum(np.nan_to_num(steps)) + 0 * steps if in_order else steps, 1.0)
    assert (np.diff(timing.gap_rows) > 0).all()
    assert set(timing.gap_rows.tolist()) <= set(range(1, len(steps)))
    assert timing.rate_hz is None or 0 < timing.rate_hz < np.inf
