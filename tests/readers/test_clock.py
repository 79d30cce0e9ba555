"""Rates and gaps of stamps and counters whose truth is known."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from gyro_pipeline.logs import REJECTED, REPAIRED
from gyro_pipeline.readers.clock import from_counter, from_stamps

N = 6000
EVEN = np.arange(N) / 120
PLAIN = [5, 99.9, 104, 250, 2000]
TICKS = [0, 1e-3, 1e-2, 0.1]


def checks(timing):
    return [finding.check for finding in timing.findings]


def late(rate, draws):
    return np.maximum.accumulate(np.arange(N) + draws.exponential(0.2, N)) / rate


def stalls(rate, draws):
    stamps = np.arange(N) / rate
    for at in draws.integers(0, N - 500, 3):
        stamps[at : at + draws.integers(5, 400)] = stamps[at + 400]
    return np.maximum.accumulate(stamps)


def bursts(rate, draws):
    size = draws.choice([4, 10, 25])
    stamps = np.ceil((np.arange(N) + 1) / size) * size + 1e-4 * draws.random(N)
    return np.sort(stamps) / rate


WHOLE = {
    "even": lambda rate, draws: draws.random() + np.arange(N) / rate,
    "jitter": lambda rate, draws: (np.arange(N) + draws.uniform(-0.25, 0.25, N)) / rate,
    "late": late,
    "one or two steps": lambda rate, draws: np.cumsum(draws.choice([2 / 3, 4 / 3], N)) / rate,
    "stalls": stalls,
    "the last one late": lambda rate, draws: (np.arange(N) + 0.9 * (np.arange(N) == N - 1)) / rate,
}


@pytest.mark.parametrize("tick", TICKS)
@pytest.mark.parametrize("kind", WHOLE)
def test_clocks_that_lose_nothing_have_their_rate_and_no_gap_and_are_kept(kind, tick):
    for seed, rate in enumerate(PLAIN):
        stamps = WHOLE[kind](rate, np.random.default_rng(seed))
        written = np.floor(stamps / tick + 1e-6) * tick if tick else stamps
        timing = from_stamps(written, 1.0)
        span_hz = (N - 1) / (stamps[-1] - stamps[0])
        assert timing.rate_hz == pytest.approx(span_hz, rel=5e-3 + tick * rate / N), rate
        assert not len(timing.gap_rows), rate
        assert {finding.check for finding in timing.findings} <= {"timestamps"}
        assert {finding.outcome for finding in timing.findings} <= {"kept"}


LOST, AGAIN = (np.random.default_rng(0).choice(N, count, replace=False) for count in (12, N // 20))
DOUBLED = np.sort(np.r_[EVEN, EVEN[AGAIN]]) + 0.1234


@pytest.mark.parametrize(
    ("rate", "stamps", "rel", "said"),
    [
        # ticks at another rate than that of the samples
        *[(hz, np.floor(np.arange(2 * N) / hz / tick) * tick, 1e-3, "")
          for hz, tick in ((100, 1 / 64), (50, 1 / 64), (48, 0.01))],
        # a longer step, which rounding explains as well as a loss
        *[(hz, np.delete(np.arange(N), LOST) / hz, 4e-3, "") for hz in (100, 1000)],
        *[(120, DOUBLED if digits is None else DOUBLED.round(digits), rel, f"{N // 20} times")
          for digits, rel in ((None, 1e-4), (6, 1e-4), (3, 1e-3))],
    ],
)  # fmt: skip
def test_coarse_clocks_and_doubled_rows_make_no_gaps(rate, stamps, rel, said):
    timing = from_stamps(stamps, 1.0)
    assert not len(timing.gap_rows)
    assert timing.rate_hz == pytest.approx(rate, rel=rel)
    assert said in str(timing.findings[-1:])


@pytest.mark.parametrize(
    "lost",
    [
        [100, 101, 500],
        np.flatnonzero(np.random.default_rng(0).random(N - 20) < 0.1),
        np.arange(3000, 3200, 2),
        np.arange(1000, 1400),
    ],
    ids=["some", "a tenth", "every other", "a block"],
)
@pytest.mark.parametrize("clock", ["unix time", "ms"])
def test_lost_samples_are_gaps_and_do_not_change_the_rate(lost, clock):
    stamps = np.arange(N) / 120 + (1.7e9 if clock == "unix time" else 3.3)
    jitter = np.random.default_rng(1).uniform(-5e-4, 5e-4, N)
    stamps = stamps + jitter if clock == "unix time" else np.round(stamps, 3)
    kept = np.setdiff1d(np.arange(N), lost)
    timing = from_stamps(stamps[kept], 1.0)
    np.testing.assert_array_equal(timing.gap_rows, np.flatnonzero(np.diff(kept) > 1) + 1)
    assert timing.rate_hz == pytest.approx(120, rel=1e-4)
    gaps = next(finding for finding in timing.findings if finding.check == "gaps")
    assert gaps.outcome == REPAIRED
    assert f"samples are missing, about {len(lost)}: " in gaps.detail


BURSTS = np.ceil((np.arange(N) + 1) / 10) * 10 / 250 + 2.0 * (np.arange(N) >= 500)
SWAPPED = np.r_[EVEN[:400], EVEN[401], EVEN[400], EVEN[402:]]
BACK, STILL = "time order", "timestamps"
ODD = {  # stamps, their unit, the rate, gaps, findings
    "a hole in bursts": (BURSTS, 1.0, 250, [500], ["gaps", STILL]),
    "time that goes back": (np.r_[EVEN, EVEN], 1.0, 120, [N], [BACK]),
    "two rows swapped": (SWAPPED, 1.0, 120, [400, 401, 402], [BACK, "gaps"]),
    "no unit": (np.delete(np.r_[EVEN, EVEN], 100) * 7.3, None, None, [100, N - 1], [BACK, "gaps"]),
    "missing": (np.full(9, np.nan), 1.0, None, [], [STILL]),
}


@pytest.mark.parametrize(("stamps", "unit_s", "rate", "gaps", "findings"), ODD.values(), ids=ODD)
def test_gaps_and_findings_of_odd_stamps(stamps, unit_s, rate, gaps, findings):
    timing = from_stamps(stamps, unit_s)
    assert timing.rate_hz == (rate and pytest.approx(rate, rel=1e-3))
    assert timing.gap_rows.tolist() == gaps
    assert checks(timing) == findings


@pytest.mark.parametrize(("unit_s", "scale"), [(1.0, 1.0), (1e-9, 1e9)])
@pytest.mark.parametrize(("rate", "tick"), [(120, 1e-2), (250, 1e-6)])
def test_jumps_and_strays_do_not_spoil_the_rate_in_any_unit(rate, tick, unit_s, scale):
    clock = np.floor((1000 + np.arange(N) / rate) / tick + 1e-6) * tick
    for jump, gap in (((0, 1), 1), ((3000, N), 3000), ((700, 701), None)):
        stamps = clock.copy()
        stamps[slice(*jump)] += 3600 if gap != 1 else -900
        timing = from_stamps(stamps * scale, unit_s)
        assert timing.rate_hz == pytest.approx(rate, rel=5e-3)
        assert timing.gap_rows.tolist() == [gap] * bool(gap)
        if not gap:
            assert timing.findings[0].detail.endswith("and ignored: once, at row 700")
    stamps[[0, 30, 31]] = np.nan
    assert not len(from_stamps(stamps * scale, unit_s).gap_rows)


@pytest.mark.parametrize(
    ("period", "step", "unit_s", "burst"),
    [
        (2**32, 8333, 1e-6, 1),
        (2**16, 10, 1e-3, 5),
        (86_400, 0.02, 1, 1),
    ],
)
def test_counters_of_time_and_midnight_are_unwrapped(period, step, unit_s, burst):
    samples = (np.arange(1000) // burst + 1) * burst
    timing = from_stamps(np.mod(period - 501 * step + step * samples, period), unit_s)
    assert timing.rate_hz == pytest.approx(1 / (step * unit_s), rel=1e-3)
    assert not len(timing.gap_rows)
    assert timing.findings[0].check == "wrap-around"
    assert timing.findings[0].detail.endswith("once, at row 500")


@pytest.mark.parametrize(
    "steps",
    [
        np.where(np.arange(10_000) < 8000, 1 / 100, 1 / 92),
        1 / np.linspace(120, 110, 10_000),
    ],
)
def test_a_rate_that_changes_is_rejected(steps):
    for tick in TICKS[1:4]:
        finding = from_stamps(np.floor(np.cumsum(steps) / tick) * tick, 1.0).findings[-1]
        assert (finding.check, finding.outcome) == ("sample rate", REJECTED)
        assert "along the recording: split the file" in finding.detail


def test_a_packet_counter_may_wrap_but_not_repeat_go_back_or_skip(bits=16):
    counts = np.mod(np.arange(1000) + 2**bits - 100, 2**bits).astype(float)
    assert from_counter(counts, bits).gap_rows.tolist() == []
    skipped = from_counter(np.delete(counts, [300, 301]), bits)
    assert skipped.gap_rows.tolist() == [300] and checks(skipped) == ["packet counter"]
    for short in ([5, 6, 6, 7], [5, 6, 3, 4], [5, 6, 8, 9]):
        timing = from_counter(np.array(short, float), bits)
        assert (timing.gap_rows.tolist(), timing.rate_hz) == ([2], None)
    for stray in (np.nan, 60_000):
        counts[300] = stray
        assert not len(from_counter(counts, bits).gap_rows)


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
