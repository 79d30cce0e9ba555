"""Values that no gyroscope at rest gives are told from the file's own numbers."""

import numpy as np
import pytest
from device_tables import BIAS, read, still

from gyro_pipeline.conventions import InputError
from gyro_pipeline.readers.counts import implausible_level, wrapped

RAW = {"units": "raw", "scale_dps": 0.00875}
LOW = np.array([-0.5, -0.9, -0.7])


@pytest.mark.parametrize("bits", [12, 14, 16, 24])
@pytest.mark.parametrize("bias", [LOW, BIAS, 0 * BIAS, LOW + [0.5, 0, 0]])
def test_signed_counts_that_were_written_as_unsigned_ones(bits, bias):
    counts = np.round(still(bias=bias) / RAW["scale_dps"])
    with pytest.raises(InputError, match=f"if they are signed counts.*signed_bits: {bits};.*trust"):
        read("gx,gy,gz", counts % 2**bits, **RAW)
    damaged = counts % 2**bits
    damaged[[10, 20, 30]] = [[-1, 5, 5], [1e12, 5, 5], [0.5, 0.5, 0.5]]
    assert f"signed_bits: {bits}" in wrapped(damaged)
    log = read("gx,gy,gz", counts % 2**bits, signed_bits=bits, **RAW)
    np.testing.assert_allclose(log.samples, counts * RAW["scale_dps"])
    assert read("gx,gy,gz", counts, **RAW).samples.shape == (6000, 3)
    with pytest.raises(InputError, match=f"signed_bits: {bits}: expected whole numbers from 0"):
        read("gx,gy,gz", counts - 3000, signed_bits=bits, **RAW)


@pytest.mark.parametrize("level", [0, 100, 2500, 20000])
def test_other_counts_are_not_wrapped(level):
    counts = level + np.round(still() / 0.01)
    assert not wrapped(counts)
    assert not wrapped(counts + 0.5)
    assert not wrapped(np.full((9, 3), np.nan))


def test_counts_about_an_offset_are_refused_without_it():
    counts = 32768 + np.round(still() / 0.01)
    scaled = {"units": "raw", "scale_dps": 0.01}
    with pytest.raises(
        InputError, match="a mean of 328.4 deg/s about x.*give offset.*trust: options"
    ):
        read("gx,gy,gz", counts, **scaled)
    log = read("gx,gy,gz", counts, offset=32768, **scaled)
    np.testing.assert_allclose(log.samples.mean(axis=0), BIAS, atol=0.003)
    log = read("gx,gy,gz", counts, trust="options", **scaled)
    assert log.samples.mean() > 300


def test_a_level_is_one_of_most_samples():
    rates = still()
    rates[::20] = 1e6
    assert not implausible_level(rates)
    assert not implausible_level(rates + [30, 0, 0])
    rates[::2] = 573.4  # a wrapped count, scaled by the logger
    assert "no MEMS gyroscope at rest has more than 100" in implausible_level(rates)


def test_lost_decimal_points_are_refused():
    places = 10.0 ** np.random.default_rng(0).integers(6, 9, (6000, 1))
    shown = np.round(still(bias=[-1.145, 0.8855, -0.98]) * places)
    with pytest.raises(InputError, match="whole numbers of 6 to 9 digits.*decimal points are lost"):
        read("gx (deg/s),gy (deg/s),gz (deg/s)", shown)
