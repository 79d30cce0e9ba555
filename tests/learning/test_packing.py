import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from gyro_pipeline.learning.network import Architecture
from gyro_pipeline.learning.packing import pack, packed_shape


@st.composite
def architectures(draw):
    kernel = draw(st.integers(1, 12))
    window = draw(st.integers(kernel, 60))
    gyroscopes = draw(st.sampled_from([1, 3, 6, 12]))
    return Architecture(gyroscopes, window, 4, kernel, draw(st.integers(1, 13)), 1, 8)


def numbered(a, n):
    """Windows (gyroscopes, n, window) in which every number is another one, and none is zero."""
    count = a.gyroscopes * n * a.window
    return np.arange(1, count + 1, dtype=np.float32).reshape(a.gyroscopes, n, a.window)


@settings(max_examples=150, deadline=None)
@given(architectures(), st.integers(1, 4))
def test_every_number_is_in_its_place_and_zeros_are_elsewhere(a, n):
    windows = numbered(a, n)
    packed = pack(windows, a)
    blocks, width = packed_shape(a)
    assert packed.shape == (n, blocks, width)
    assert packed.dtype == np.float32
    expected = np.zeros_like(packed)
    for sample in range(min(a.window, blocks * a.stride)):
        block, within = divmod(sample, a.stride)
        for gyroscope in range(a.gyroscopes):
            expected[:, block, gyroscope * a.stride + within] = windows[gyroscope, :, sample]
    np.testing.assert_array_equal(packed, expected)


@settings(max_examples=150, deadline=None)
@given(architectures())
def test_nothing_the_network_sees_is_left_out_and_no_block_is_to_spare(a):
    blocks, width = packed_shape(a)
    last_seen = (a.convolved - 1) * a.stride + a.kernel
    assert (blocks - 1) * a.stride < last_seen <= blocks * a.stride
    assert a.gyroscopes * a.stride <= width < a.gyroscopes * a.stride + 16
    assert width % 16 == 0


def test_packing_writes_into_a_part_of_a_larger_array_and_nowhere_else():
    a = Architecture(3, 23, 4, 8, 5, 1, 8)
    whole = np.zeros((6, *packed_shape(a)), np.float32)
    part = whole[2:4]
    assert pack(numbered(a, 2), a, out=part) is part
    np.testing.assert_array_equal(whole[2:4], pack(numbered(a, 2), a))
    assert not whole[:2].any()
    assert not whole[4:].any()


def test_windows_may_be_views_of_any_layout():
    a = Architecture(3, 23, 4, 8, 5, 1, 8)
    windows = numbered(a, 4)
    as_the_estimator_has_them = np.ascontiguousarray(windows.transpose(1, 0, 2)).transpose(1, 0, 2)
    np.testing.assert_array_equal(pack(as_the_estimator_has_them, a), pack(windows, a))
    np.testing.assert_array_equal(pack(windows[:, ::2], a), pack(windows, a)[::2])


def test_rows_start_with_a_cache_line():
    a = Architecture(3, 23, 4, 8, 5, 1, 8)
    assert all(pack(numbered(a, n), a).ctypes.data % 64 == 0 for n in (1, 4, 300))
