"""A look through a MATLAB file of version 5 before SciPy reads it.

SciPy finds the kind of data by a number in the file, which it does not check, looks for as many
elements as the class of an array has, whether they are there or not, and makes room for as many
values as it is said to have: one damaged byte can end the process, or fill the memory (scipy 1.17).

Source: MathWorks, MAT-File Format, chapter 1: a header of 128 bytes, then elements of a tag, which
has the type and the number of bytes, and of data in whole eights. An array is an element of
elements, the first of which are its class and its size. A compressed element holds another one.
"""

import math
import struct
import zlib
from collections.abc import Callable, Iterator

_HEADER, _ORDERS = 128, {b"IM": "<", b"MI": ">"}
_TAG, _EIGHT, _SHORT = 8, 8, 4  # bytes of a tag; of which data fill up whole ones; that a tag holds
_FLAGS = 8  # bytes with the class of an array, which SciPy takes for granted
_TYPES = {*range(1, 8), 9, *range(12, 19)}
_INT32, _UINT32, _ARRAY, _COMPRESSED = 5, 6, 14, 15
_CLASSES, _VALUES, _SPARSE = range(1, 19), range(4, 16), 5
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
    order = _ORDERS.get(data[_HEADER - 2 : _HEADER])
    if order is None:
        raise ValueError("its header says no byte order")
    size = 0
    for kind, inner in _elements(memoryview(data)[_HEADER:], order):
        elements = [(kind, inner)]
        if kind == _COMPRESSED:
            unpacking = zlib.decompressobj()
            size += sum(struct.unpack(f"{order}II", unpacking.decompress(inner, _TAG))[1:]) + _TAG
            check_claim(size)
            unpacked = zlib.decompressobj().decompress(inner, size)
            elements = list(_elements(memoryview(unpacked), order))
        for element_type, array in elements:
            if element_type == _ARRAY:
                _check_array(array, order, 1)


def _check_array(data: memoryview, order: str, depth: int) -> None:
    parts = list(_elements(data, order))
    kinds = [kind for kind, _ in parts]
    if kinds[:1] != [_UINT32] or len(parts[0][1]) != _FLAGS or depth > _DEEPEST:
        raise ValueError(f"an array without a class, or {depth} deep in others")
    (flags,) = struct.unpack_from(f"{order}I", parts[0][1])
    kind, is_complex = flags & 0xFF, flags >> 11 & 1
    if kind not in _CLASSES:
        raise ValueError(f"an array of class {kind}")
    needed = 4 + 2 * (kind == _SPARSE) + is_complex  # flags, size, name; two of places; values
    if kind in _VALUES and (len(parts) < needed or {_ARRAY, _COMPRESSED} & {*kinds}):
        raise ValueError(f"an array of class {kind} of data of types {kinds}")
    if kinds[1:2] in ([_INT32], [_UINT32]) and kind != _SPARSE:  # SciPy takes either
        lengths = struct.unpack(f"{order}{len(parts[1][1]) // 4}i", parts[1][1])
        if math.prod(lengths) > len(data) or min(lengths) < 0:
            raise ValueError(f"an array of {lengths} in {len(data)} bytes")
    for kind, inner in parts:
        if kind == _ARRAY and len(inner):
            _check_array(inner, order, depth + 1)


def _elements(data: memoryview, order: str) -> Iterator[tuple[int, memoryview]]:
    """Types and contents."""
    at = 0
    while at < len(data):
        kind, size = struct.unpack_from(f"{order}II", data, at)
        start, length = at + _TAG, _TAG + size
        if kind >> 16:  # a short one, in the tag itself
            kind, size, start, length = kind & 0xFFFF, kind >> 16, at + _TAG - _SHORT, _TAG
        if kind not in _TYPES or start + size > min(at + length, len(data)):
            raise ValueError(f"data of type {kind} and {size} bytes")
        yield kind, data[start : start + size]
        at += length if kind == _COMPRESSED else -(-length // _EIGHT) * _EIGHT
