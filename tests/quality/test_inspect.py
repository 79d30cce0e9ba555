"""What is unusual about a recording, which rows are masked, and whether it is at rest."""

from itertools import product

import numpy as np
import pytest

from gyro_pipeline.conventions import InputError
from gyro_pipeline.logs import KEPT, REJECTED, REPAIRED, Finding, Log
from gyro_pipeline.parameters import Quality
from gyro_pipeline.physics.noise import simulate_noise
from gyro_pipeline.quality import inspect

ROWS, RATE_HZ, SIGMA = 6000, 100.0, 0.05
BIAS = np.array([0.7, -0.4, 0.15])
SECONDS = np.arange(ROWS) / RATE_HZ


@pytest.fixture(scope="module")
def quality(parameters):
    return parameters("base").quality


@pytest.fixture
def still():
    """One minute at rest, about three different biases."""
    return np.random.default_rng(8).normal(BIAS, SIGMA, (ROWS, 3))


def checks(inspected):
    return {finding.check: finding.outcome for finding in inspected.findings}


def detail(inspected, check):
    return "; ".join(f.detail for f in inspected.findings if f.check == check)


def decay(size, constant_s):
    return size * np.exp(-SECONDS / constant_s)[:, None]


def add(rows, rates):
    """A disturbance of some rows."""
    return put(rows, lambda x: x[rows] + rates)


def put(place, values):
    """Other values at a place, or what a function makes of the recording."""

    def change(x):
        x[place] = values(x) if callable(values) else values
        return x

    return change


def rounded(step):
    return lambda x: step * np.round(x / step)


def touched(x):
    for start in (1000, 3000, 5000):
        x[start : start + 150, 1] += 5 * np.hanning(150)
    return x


def held_in_turn(x):
    return np.stack([x[np.maximum((ROW - 3 * i) // 10 * 10 + 3 * i, 0), i] for i in range(3)], 1)


def near_zero(change, bias=(0.04, -0.02, 0.01)):
    return lambda x: change(x - BIAS + bias)


ROW, RANDOM = np.arange(ROWS), np.random.default_rng(3)
FEW, SOME, LOST = (RANDOM.random(ROWS) < share for share in (0.02, 0.1, 0.05))
HELD = put((slice(100, 400), 1), lambda x: x[100, 1])
THRICE = put(slice(600), lambda x: np.repeat(x[:200], 3, axis=0))
LOUDER = put(slice(3000), lambda x: 2 * x[:3000] - BIAS)
BLANKED = near_zero(put(LOST, 0), (0.1, -0.1, 0.1))
TRUNCATED = near_zero(lambda x: 0.035 * np.trunc(x / 0.035))
CODED = put((SOME, 1), -0.46)


@pytest.mark.parametrize(
    ("change", "expected", "words"),
    [
        (lambda x: x, {}, []),
        (add(700, np.nan), {"non-finite values": REPAIRED}, ["axes x, y, z, row 700, "]),
        (HELD, {"stuck values": REPAIRED}, ["axis y, rows 100 to 399"]),
        (add(77, [0, 9 * SIGMA, 0]), {"spikes": REPAIRED}, ["axis y, row 77, masked"]),
        (add(FEW, [0, 20 * SIGMA, 0]), {"spikes": REPAIRED}, ["axis y"]),
        (add(slice(500, 504), [8, -5, 2]), {"shocks": REPAIRED}, ["rows 450 to 553"]),
        (lambda x: x + decay(0.5, 0.4), {"start": REPAIRED}, ["rows 0 to 99"]),
        (lambda x: x + decay(0.3, 8), {"warm-up": KEPT}, ["axis x by 2", "settled"]),
        (lambda x: x + 0.3 * (SECONDS[:, None] / 60) ** 2, {"drift": KEPT}, ["not settled"]),
        (lambda x: x + SECONDS[:, None] / 20, {"motion": REJECTED}, ["3 deg/s", "largest_drift"]),
        (add(ROW % 300 < 10, 5), {"start": REPAIRED, "shocks": REPAIRED,
         "too short": REJECTED}, ["and 14 more", "quality.least_share"]),
        (touched, {"motion": REJECTED}, ["axis y, rows 9", ", rows 29", ", rows 49"]),
        (add(slice(2500, None), [0.5, 0, 0]), {"motion": REJECTED}, ["axis x, rows 0 to 2499"]),
        (LOUDER, {"motion": REJECTED}, ["the noise rises"]),
        (lambda x: np.minimum(x, BIAS + 2 * SIGMA), {"saturation": REJECTED}, ["cut off at 0.8 "]),
        (BLANKED, {"dropouts": REPAIRED}, ["zero on all axes, row"]),
        (near_zero(put(700, 0)), {"dropouts": REPAIRED}, ["zero on all axes, row 700, masked"]),
        (TRUNCATED, {"dead band": REJECTED}, ["axis y, counts cut to zero?"]),
        (put((SOME, 1), -0.6), {"saturation": REJECTED}, ["axis y is cut off at -0.6 deg/s"]),
        (lambda x: CODED(rounded(0.01)(x)), {"frequent value": REJECTED}, ["at -0.46 deg"]),
        (lambda x: np.round(rounded(0.0091)(x), 2), {}, []),
        (rounded(1.3 * SIGMA), {"coarse quantisation": KEPT}, []),
        (rounded(3 * SIGMA), {"coarse quantisation": REJECTED}, ["quality.largest_step"]),
        (THRICE, {"repeated rows": KEPT}, ["6.7%"]),
        (held_in_turn, {"repeated values": REJECTED}, ["axis x repeats 90%", "axis z repeats 90%"]),
        (lambda x: x[:, [1, 1, 2]], {"equal axes": REJECTED}, ["axes x and y", "`columns`"]),
        (lambda x: x * 20, {"noise level": REJECTED}, ["quality.largest_noise_dps"]),
    ],
)  # fmt: skip
def test_each_oddity_has_its_finding(still, quality, change, expected, words):
    inspected = inspect(Log(change(still)), RATE_HZ, quality)
    assert checks(inspected) == expected
    worst = max(expected.values(), key=[KEPT, REPAIRED, REJECTED].index, default=KEPT)
    assert inspected.outcome == worst
    for word in words:
        assert word in "; ".join(f.detail for f in inspected.findings)


@pytest.mark.parametrize(
    ("rows", "sigmas"),
    [(ROW % 2 == 0, 1), (ROW % 13 == 0, 1.3), ((ROW + ROW // 611) % 2 == 0, 6), (SOME, 12)],
    ids=["2 in turn", "13 in turn", "slips", "few at random"],
)  # fmt: skip
def test_rows_of_two_devices_are_rejected_in_any_order(still, quality, rows, sigmas):
    still[rows] += [0, sigmas * SIGMA, 0]
    inspected = inspect(Log(still), RATE_HZ, quality)
    assert checks(inspected) == {"mixed rows": REJECTED}
    assert "axis y jumps by" in detail(inspected, "mixed rows")
    assert "Split it by device" in detail(inspected, "mixed rows")


def test_neither_a_vibration_nor_a_coarse_step_is_of_several_devices_or_a_frequent_value(quality):
    """A few of each here; a thousand were tried at steps of 0.05 to 1.95 sigma."""
    for seed, (step, hz) in enumerate(product((0.05, 1, 1.9), (0, 11, 15, 24))):
        rng = np.random.default_rng(seed)
        bias = BIAS if hz else step * SIGMA * rng.choice([0, 0.5, 0.3, -20], 3)
        wave = 5 * SIGMA * np.sin(2 * np.pi * hz * SECONDS + 1)[:, None] * (hz > 0)
        rates = rounded(step * SIGMA)(rng.normal(bias, SIGMA, (ROWS, 3)) + wave)
        inspected = inspect(Log(rates), RATE_HZ, quality)
        assert inspected.outcome in ([KEPT] if hz else [KEPT, REPAIRED]), (step, hz)
        if not hz:
            allowed = {"zero rows", "stuck values", "coarse quantisation"}
            assert checks(inspected).keys() <= allowed, step


def test_rows_are_named_as_the_file_has_them_and_the_longest_stretch_is_kept(still, quality):
    still[10] += 9
    rows, clock = 2 * np.arange(ROWS) + 1, Finding("sample rate", KEPT, "something about it")
    inspected = inspect(Log(still, rows=rows), RATE_HZ, quality)
    assert "row 21, masked" in detail(inspected, "spikes")
    assert np.flatnonzero(inspected.masked).tolist() == [10]
    log = Log(still, rows=rows, gap_rows=np.array([500, 5700]), findings=(clock,))
    inspected = inspect(log, RATE_HZ, quality)
    assert (inspected.outcome, inspected.start, inspected.stop) == (REPAIRED, 500, 5700)
    assert [f.check for f in inspected.findings] == ["sample rate", "gaps"]
    words = "kept are rows 1001 to 11399 (5 to 56.99 s), the longest of 3 stretches without a gap"
    assert detail(inspected, "gaps") == words


def test_a_wrong_rate_does_not_hide_two_devices(still, quality):
    still[1::2] += 1
    rate = Finding("sample rate", REJECTED, "expected 200 Hz, got 100 Hz")
    inspected = inspect(Log(still, findings=(rate,)), RATE_HZ, quality)
    assert [finding.check for finding in inspected.findings] == ["sample rate", "mixed rows"]


def test_what_is_masked_at_the_ends_is_cut(still, quality):
    still[:3] = still[-1] = 0
    still[3] = np.nan
    inspected = inspect(Log(still), RATE_HZ, quality)
    assert (inspected.outcome, inspected.start, inspected.stop) == (REPAIRED, 4, ROWS - 1)
    assert not inspected.masked.any()
    assert detail(inspected, "zero rows") == "rows 0 to 2, row 5999, cut"


def test_too_few_rows_or_too_small_a_share_reject(still, quality):
    cases = [(0, 0, REJECTED), (999, 0, REJECTED), (1000, 0, KEPT)]
    for rows, lost, outcome in [*cases, (ROWS, 1150, REPAIRED), (ROWS, 1250, REJECTED)]:
        samples = still[:rows].copy()
        samples[300 : 300 + lost] = np.nan
        inspected = inspect(Log(samples), RATE_HZ, quality)
        assert inspected.outcome == outcome
        rejected = outcome == REJECTED
        assert ("quality.least_share" in detail(inspected, "too short")) == rejected
    for value in (np.nan, 1.5):
        inspected = inspect(Log(np.full((ROWS, 3), value)), RATE_HZ, quality)
        assert (inspected.outcome, inspected.start) == (REJECTED, inspected.stop)
        assert "0 of 6000 rows" in detail(inspected, "too short")


def test_what_cannot_be_judged_is_refused(quality):
    with pytest.raises(InputError, match=r"expected samples of 3 axes, \(n, 3\), got shape \(3, 9"):
        inspect(Log(np.zeros((3, 900))), RATE_HZ, quality)
    with pytest.raises(ValueError, match="expected at least 10 blocks of block_s, 2 s"):
        Quality(**quality.model_dump() | {"block_s": 2.0})


@pytest.mark.parametrize(("rate_hz", "minutes"), [(5, 1 / 6), (5, 120), (1000, 0.5)])
def test_at_rest_is_kept_at_any_rate_and_length(quality, rate_hz, minutes):
    """A few of each here; a thousand in benchmarks/quality.py."""
    kinds = {"lag1_correlation": -0.15}, {"flicker_dps": 3e-3}, {"random_walk_dps_rts": 1e-4}
    for seed, noise in product(range(3), kinds):
        generator = np.random.default_rng(seed)
        rates = simulate_noise(generator, (3, int(60 * minutes * rate_hz)), rate_hz, 5e-3, **noise)
        inspected = inspect(Log(rates.T + BIAS), rate_hz, quality)
        assert inspected.outcome == KEPT
        assert checks(inspected).keys() <= {"warm-up", "drift"}


def test_all_real_recordings_of_memsense_are_kept_whole(quality, real_file):
    for rates in np.load(real_file("memsense_test_real.npy")):
        inspected = inspect(Log(rates.T), 250.0, quality)
        assert (inspected.outcome, inspected.start, inspected.stop) == (KEPT, 0, 13_000)
