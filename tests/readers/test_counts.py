"""Values that no gyroscope at rest gives are told from the file's own numbers."""

import numpy as np
import pytest

from gyro_pipeline.conventions import InputError
from gyro_pipeline.readers.counts import implausible_level, lost_decimal_points, wrapped

RAW = {"units": "raw", "scale_dps": 0.00875}
X = np.random.default_rng(0).normal([0.7, -0.4, 0.15], 0.05, (6000, 3))


@pytest.mark.parametrize("bits", [12, 24])
@pytest.mark.parametrize("shift", [[0, 0, 0], [-0.7, 0.4, -0.15]])
def test_signed_counts_that_were_written_as_unsigned_ones(bits, shift, read):
    counts = np.round((X + shift) / RAW["scale_dps"])
    damaged = counts % 2**bits
    damaged[[10, 20, 30]] = [[-1, 5, 5], [1e12, 5, 5], [0.5, 0.5, 0.5]]
    assert f"signed_bits: {bits}" in wrapped(damaged) and not wrapped(counts)
    log = read("gx,gy,gz", counts % 2**bits, signed_bits=bits, **RAW)
    np.testing.assert_allclose(log.samples, counts * RAW["scale_dps"])
    with pytest.raises(InputError, match=f"signed_bits: {bits}: expected whole numbers from 0"):
        read("gx,gy,gz", counts - 3000, signed_bits=bits, **RAW)


@pytest.mark.parametrize("level", [0, 2500, np.nan])
def test_other_counts_are_not_wrapped(level):
    assert not wrapped(level + np.round(X / 0.01))


def test_levels_and_lost_points_are_those_of_most_samples_and_not_of_counts(read):
    rates = X.copy()
    rates[::20] = 1e6
    assert not implausible_level(rates)
    rates[::2] = 573.4  # a wrapped count, scaled by the logger
    assert "no MEMS gyroscope at rest has more than 100" in implausible_level(rates)
    counts = np.round(X * 1e6)
    assert lost_decimal_points(counts)
    assert len(read("gx,gy,gz", counts, units="raw", scale_dps=1e-6).samples) == len(counts)
