"""Values that no gyroscope at rest gives are told from the file's own numbers."""

import numpy as np
import pytest

from gyro_pipeline.conventions import InputError
from gyro_pipeline.readers.counts import implausible_level, wrapped

RAW = {"units": "raw", "scale_dps": 0.00875}
BIAS, LOW = np.array([[0.7, -0.4, 0.15], [-0.5, -0.9, -0.7]])


def still(bias=BIAS):
    return np.random.default_rng(0).normal(bias, 0.05, (6000, 3))


@pytest.mark.parametrize("bits", [12, 13, 14, 24])
@pytest.mark.parametrize("bias", [LOW, BIAS, 0 * BIAS, LOW + [0.5, 0, 0]])
def test_signed_counts_that_were_written_as_unsigned_ones(bits, bias, read):
    counts = np.round(still(bias=bias) / RAW["scale_dps"])
    assert not wrapped(counts)
    with pytest.raises(InputError, match=f"if they are signed counts.*signed_bits: {bits};.*trust"):
        read("gx,gy,gz", counts % 2**bits, **RAW)
    damaged = counts % 2**bits
    damaged[[10, 20, 30]] = [[-1, 5, 5], [1e12, 5, 5], [0.5, 0.5, 0.5]]
    assert f"signed_bits: {bits}" in wrapped(damaged)
    log = read("gx,gy,gz", counts % 2**bits, signed_bits=bits, **RAW)
    np.testing.assert_allclose(log.samples, counts * RAW["scale_dps"])
    with pytest.raises(InputError, match=f"signed_bits: {bits}: expected whole numbers from 0"):
        read("gx,gy,gz", counts - 3000, signed_bits=bits, **RAW)


@pytest.mark.parametrize("level", [0, 0.5, 100, 2500, 20000, np.nan])
def test_other_counts_are_not_wrapped(level):
    assert not wrapped(level + np.round(still() / 0.01))


def test_a_level_is_one_of_most_samples():
    rates = still()
    rates[::20] = 1e6
    assert not implausible_level(rates)
    rates[::2] = 573.4  # a wrapped count, scaled by the logger
    assert "no MEMS gyroscope at rest has more than 100" in implausible_level(rates)


def test_counts_of_many_digits_have_lost_no_decimal_points(read):
    counts = np.round(still() * 1e6)
    with pytest.raises(InputError, match="whole numbers of 6 to 9 digits.*decimal points are lost"):
        read("gx (deg/s),gy (deg/s),gz (deg/s)", counts)
    assert len(read("gx,gy,gz", counts, units="raw", scale_dps=1e-6).samples) == len(counts)
