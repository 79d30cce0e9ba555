"""Rates and gaps of stamps and counters whose truth is known."""

from itertools import product

import numpy as np
import pytest

from gyro_pipeline.logs import REJECTED, REPAIRED
from gyro_pipeline.readers.clock import from_counter, from_stamps

N = 6000
EVEN = np.arange(N) / 120
PLAIN = [5, 99.9, 104, 250, 2000]
TICKS = [0, 1e-3, 1e-2, 0.1]


def steps_of(rate, draws):
    """Stamps of clocks that lose nothing, by how they jitter."""
    even, last = np.arange(N), np.arange(N) == N - 1
    stalled = np.arange(N) / rate
    for at in draws.integers(0, N - 500, 3):
        stalled[at : at + draws.integers(5, 400)] = stalled[at + 400]
    return {
        "even": draws.random() + even / rate,
        "jitter": (even + draws.uniform(-0.25, 0.25, N)) / rate,
        "late": np.maximum.accumulate(even + draws.exponential(0.2, N)) / rate,
        "one or two steps": np.cumsum(draws.choice([2 / 3, 4 / 3], N)) / rate,
        "stalls": np.maximum.accumulate(stalled),
        "the last one late": (even + 0.9 * last) / rate,
    }


@pytest.mark.parametrize("tick", TICKS)
def test_clocks_that_lose_nothing_have_their_rate_and_no_gap_and_are_kept(tick):
    for seed, rate in enumerate(PLAIN):
        for kind, stamps in steps_of(rate, np.random.default_rng(seed)).items():
            written = np.floor(stamps / tick + 1e-6) * tick if tick else stamps
            timing = from_stamps(written, 1.0)
            span_hz = (N - 1) / (stamps[-1] - stamps[0])
            expected = pytest.approx(span_hz, rel=5e-3 + tick * rate / N)
            assert timing.rate_hz == expected, (kind, rate)
            assert not len(timing.gap_rows), (kind, rate)
            found = {(finding.check, finding.outcome) for finding in timing.findings}
            assert found <= {("timestamps", "kept")}, (kind, rate)


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
    [[100, 101, 500], np.flatnonzero(np.random.default_rng(0).random(N - 20) < 0.1),
     np.arange(3000, 3200, 2), np.arange(1000, 1400)],
    ids=["some", "a tenth", "every other", "a block"],
)  # fmt: skip
def test_lost_samples_are_gaps_and_do_not_change_the_rate(lost):
    jitter = np.random.default_rng(1).uniform(-5e-4, 5e-4, N)
    kept = np.setdiff1d(np.arange(N), lost)
    for stamps in (EVEN + 1.7e9 + jitter, np.round(EVEN + 3.3, 3)):  # Unix time, and milliseconds
        timing = from_stamps(stamps[kept], 1.0)
        np.testing.assert_array_equal(timing.gap_rows, np.flatnonzero(np.diff(kept) > 1) + 1)
        assert timing.rate_hz == pytest.approx(120, rel=1e-4)
        np.testing.assert_allclose(timing.lost, np.diff(kept, prepend=-1) - 1, atol=0.2)
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
    back = [] if timing.lost is None else np.flatnonzero(np.isnan(timing.lost)).tolist()
    assert bool(back) == (BACK in findings)
    assert [finding.check for finding in timing.findings] == findings


@pytest.mark.parametrize(("rate", "tick"), [(120, 1e-2), (250, 1e-6)])
def test_jumps_and_strays_do_not_spoil_the_rate_in_any_unit(rate, tick):
    clock = np.floor((1000 + np.arange(N) / rate) / tick + 1e-6) * tick
    jumps = ((0, 1), 1), ((3000, N), 3000), ((700, 701), None)
    for (jump, gap), unit_s in product(jumps, (1.0, 1e-9)):
        stamps = clock.copy()
        stamps[slice(*jump)] += 3600 if gap != 1 else -900
        timing = from_stamps(stamps / unit_s, unit_s)
        assert timing.rate_hz == pytest.approx(rate, rel=5e-3)
        assert timing.gap_rows.tolist() == [gap] * bool(gap)
        if not gap:
            assert timing.findings[0].detail.endswith("and ignored: once, at row 700")
    stamps[[0, 30, 31]] = np.nan
    assert not len(from_stamps(stamps / unit_s, unit_s).gap_rows)


def test_counters_of_time_and_midnight_are_unwrapped():
    counters = (2**32, 8333, 1e-6, 1), (2**16, 10, 1e-3, 5), (86_400, 0.02, 1, 1)
    for period, step, unit_s, burst in counters:
        samples = (np.arange(1000) // burst + 1) * burst
        timing = from_stamps(np.mod(period - 501 * step + step * samples, period), unit_s)
        assert timing.rate_hz == pytest.approx(1 / (step * unit_s), rel=1e-3)
        assert not len(timing.gap_rows)
        assert timing.findings[0].check == "wrap-around"
        assert timing.findings[0].detail.endswith("once, at row 500")


def test_a_rate_that_changes_is_rejected():
    jump = np.where(np.arange(10_000) < 8000, 1 / 100, 1 / 92)
    for steps, tick in product((jump, 1 / np.linspace(120, 110, 10_000)), TICKS[1:]):
        finding = from_stamps(np.floor(np.cumsum(steps) / tick) * tick, 1.0).findings[-1]
        assert (finding.check, finding.outcome) == ("sample rate", REJECTED)
        assert "along the recording: split the file" in finding.detail


def test_a_packet_counter_may_wrap_but_not_repeat_go_back_or_skip(bits=16):
    counts = np.mod(np.arange(1000) + 2**bits - 100, 2**bits).astype(float)
    assert from_counter(counts, bits).gap_rows.tolist() == []
    skipped = from_counter(np.delete(counts, [300, 301]), bits)
    assert skipped.gap_rows.tolist() == [300]
    assert [finding.check for finding in skipped.findings] == ["packet counter"]
    for short in ([5, 6, 6, 7], [5, 6, 3, 4], [5, 6, 8, 9]):
        timing = from_counter(np.array(short, float), bits)
        assert (timing.gap_rows.tolist(), timing.rate_hz) == ([2], None)
    for stray in (np.nan, 60_000):
        counts[300] = stray
        assert not len(from_counter(counts, bits).gap_rows)
