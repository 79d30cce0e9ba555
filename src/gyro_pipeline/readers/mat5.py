"""Checks a MATLAB file of version 5 before SciPy reads it.

SciPy checks neither the type numbers in a file nor the sizes of its arrays, so that a damaged byte
can crash the process or fill the memory (scipy 1.17).

Source: MathWorks, MAT-File Format, chapter 1. A header of 128 bytes is followed by elements. Each
has a tag, with the type and the number of bytes, and data, padded to a multiple of eight bytes. An
array is an element that contains elements, first its class and its size. A compressed element
contains another element.
"""

import math
import struct
import zlib
from collections.abc import Callable, Iterator

_TYPES = {*range(1, 8), 9, *range(12, 19)}
_INT32, _UINT32, _ARRAY, _COMPRESSED = 5, 6, 14, 15
_VALUES, _SPARSE = range(4, 16), 5  # classes of arrays
_DEEPEST = 32


def check(data: bytes, check_claim: Callable[[int], None]) -> None:
    """Check that elements are complete, types are valid, and arrays fit into the file.

    Args:
        data: Content of the file.
        check_claim: Raises an error if a number of unpacked bytes is too large.

    Raises:
        ValueError: A check fails.
        zlib.error: Compressed data is damaged.
    """
    order = {b"IM": "<", b"MI": ">"}[data[126:128]]
    size = 0
    for kind, inner in _elements(memoryview(data)[128:], order):
        elements = [(kind, inner)]
        if kind == _COMPRESSED:
            tag = zlib.decompressobj().decompress(inner, 8)
            size += 8 + sum(struct.unpack(f"{order}II", tag)[1:])
            check_claim(size)
            unpacked = zlib.decompressobj().decompress(inner, size)
            elements = list(_elements(memoryview(unpacked), order))
        for element_type, array in elements:
            if element_type == _ARRAY:
                _check_array(array, order, 1)


def _check_array(data: memoryview, order: str, depth: int) -> None:
    """Check that an array has a class, a size that its data can fill, and all of its elements."""
    parts = list(_elements(data, order))
    types = [kind for kind, _ in parts]
    flags = struct.unpack(f"{order}II", parts[0][1])[0] if types[:1] == [_UINT32] else 0
    kind, is_complex = flags & 0xFF, flags >> 11 & 1
    needed = 4 + 2 * (kind == _SPARSE) + is_complex  # flags, size, name; two of indices; values
    complete = kind not in _VALUES or (
        len(parts) >= needed and not {_ARRAY, _COMPRESSED} & {*types}
    )
    size = parts[1][1] if types[1:2] in ([_INT32], [_UINT32]) and kind != _SPARSE else b""
    lengths = struct.unpack(f"{order}{len(size) // 4}i", size) or (1,)
    fits = math.prod(lengths) <= len(data) and min(lengths) >= 0
    if not (0 < kind < 19 and complete and fits and depth <= _DEEPEST):  # noqa: PLR2004
        raise ValueError(f"an array of class {kind}, {lengths}, in {len(data)} bytes")
    for kind, inner in parts:
        if kind == _ARRAY and len(inner):
            _check_array(inner, order, depth + 1)


def _elements(data: memoryview, order: str) -> Iterator[tuple[int, memoryview]]:
    """The type and the content of each element."""
    offset = 0
    while offset < len(data):
        kind, size = struct.unpack_from(f"{order}II", data, offset)
        start, length = offset + 8, 8 + size
        if kind >> 16:  # at most four bytes are stored in the tag itself
            kind, size, start, length = kind & 0xFFFF, kind >> 16, offset + 4, 8
        if kind not in _TYPES or start + size > min(offset + length, len(data)):
            raise ValueError(f"data of type {kind} and {size} bytes")
        yield kind, data[start : start + size]
        offset += length if kind == _COMPRESSED else -(-length // 8) * 8
