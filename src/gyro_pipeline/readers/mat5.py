"""A look through a MATLAB file of version 5 before SciPy reads it.

SciPy does not check the numbers of types in a file, nor the sizes of its arrays: one damaged byte
can end the process, or fill the memory (scipy 1.17).

Source: MathWorks, MAT-File Format, chapter 1: a header of 128 bytes, then elements of a tag, which
has the type and the number of bytes, and of data in whole eights. An array is an element of
elements, the first of which are its class and its size. A compressed element holds another one.
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
    """See that a file is made of whole elements of known types, and arrays of no more than it has.

    Args:
        data: Of the file.
        check_claim: Raises an error where so many bytes are too many to unpack.

    Raises:
        ValueError: It is not.
        zlib.error: What is compressed in it is damaged.
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
    """See that an array has a class, a size that its data can fill, and all of its elements."""
    parts = list(_elements(data, order))
    types = [kind for kind, _ in parts]
    flags = struct.unpack(f"{order}II", parts[0][1])[0] if types[:1] == [_UINT32] else 0
    kind, is_complex = flags & 0xFF, flags >> 11 & 1
    needed = 4 + 2 * (kind == _SPARSE) + is_complex  # flags, size, name; two of places; values
    whole = kind not in _VALUES or (len(parts) >= needed and not {_ARRAY, _COMPRESSED} & {*types})
    size = parts[1][1] if types[1:2] in ([_INT32], [_UINT32]) and kind != _SPARSE else b""
    lengths = struct.unpack(f"{order}{len(size) // 4}i", size) or (1,)
    fits = math.prod(lengths) <= len(data) and min(lengths) >= 0
    if not (0 < kind < 19 and whole and fits and depth <= _DEEPEST):  # noqa: PLR2004
        raise ValueError(f"an array of class {kind}, {lengths}, in {len(data)} bytes")
    for kind, inner in parts:
        if kind == _ARRAY and len(inner):
            _check_array(inner, order, depth + 1)


def _elements(data: memoryview, order: str) -> Iterator[tuple[int, memoryview]]:
    """Types and contents."""
    at = 0
    while at < len(data):
        kind, size = struct.unpack_from(f"{order}II", data, at)
        start, length = at + 8, 8 + size
        if kind >> 16:  # a short one, of four bytes at most, in the tag itself
            kind, size, start, length = kind & 0xFFFF, kind >> 16, at + 4, 8
        if kind not in _TYPES or start + size > min(at + length, len(data)):
            raise ValueError(f"data of type {kind} and {size} bytes")
        yield kind, data[start : start + size]
        at += length if kind == _COMPRESSED else -(-length // 8) * 8
