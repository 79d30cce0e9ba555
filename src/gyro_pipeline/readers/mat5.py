"""Arrays of MATLAB files of version 5 to 7, read with a look at every size and type.

SciPy trusts these (scipy 1.17): one damaged byte can end the process, or fill the memory.

Source: MathWorks, MAT-File Format, chapter 1: a header of 128 bytes, then elements of a tag, which
has the type and the number of bytes, and of data in whole eights. An array is an element of
elements, the first of which are its class, its size and its name. A compressed element holds
another one.
"""

import struct
import zlib
from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

_HEADER, _ORDERS = 128, {b"IM": "<", b"MI": ">"}
_TAG, _SHORT = 8, 4  # bytes of a tag, and of one that holds its data itself
_ARRAY, _COMPRESSED = 14, 15
_TYPES = {
    1: "i1",
    2: "u1",
    3: "i2",
    4: "u2",
    5: "i4",
    6: "u4",
    7: "f4",
    9: "f8",
    12: "i8",
    13: "u8",
}
_TYPES |= {16: "u1", 17: "u2", 18: "u4"}  # of characters
_STRUCTURE, _CHARACTERS, _NUMBERS, _COMPLEX = 2, 4, range(6, 16), 1 << 11

Named = Iterator[tuple[str, NDArray[Any]]]


def arrays(data: bytes) -> Named:
    """Names and arrays of numbers and texts in a file; ``log.gyro`` is field gyro of a structure.

    Cells, objects, sparse and complex arrays are left out.

    Raises:
        ValueError, KeyError, struct.error, zlib.error: The file is damaged.
    """
    order = _ORDERS[data[_HEADER - 2 : _HEADER]]
    for kind, content in _elements(memoryview(data)[_HEADER:], order):
        if kind == _COMPRESSED:
            ((kind, content),) = _elements(memoryview(zlib.decompress(content)), order)  # noqa: PLW2901
        if kind == _ARRAY:
            yield from _named(content, order, "")


def _named(content: memoryview, order: str, name: str) -> Named:
    """An array, or those of a structure; an array in a structure has no name of its own."""
    if not content:
        return
    (_, flags), (_, size), (_, label), *parts = _elements(content, order)
    kind, name = (
        int.from_bytes(flags[:4], "little" if order == "<" else "big"),
        name or str(label, "utf-8"),
    )
    if kind & 0xFF == _STRUCTURE and not np.any(np.frombuffer(size, f"{order}i4") - 1):
        (_, width), (_, labels), *fields = parts
        names = np.frombuffer(labels, f"S{int(np.frombuffer(width, f'{order}i4')[0])}").tolist()
        for field, (_, inner) in zip(names, fields, strict=True):
            yield from _named(inner, order, f"{name}.{field.decode()}")
    elif name and kind & 0xFF in (*_NUMBERS, _CHARACTERS) and not kind & _COMPLEX:
        number, values = parts[0]
        shape = np.frombuffer(size, f"{order}i4")
        array = np.frombuffer(values, order + _TYPES[number]).reshape(shape, order="F")
        if kind & 0xFF == _CHARACTERS and array.size:
            array = array.astype("<u4", "C").view(f"<U{shape[-1]}")
        yield name, array


def _elements(data: memoryview, order: str) -> Iterator[tuple[int, memoryview]]:
    """Types and contents."""
    at = 0
    while at < len(data):
        kind, size = struct.unpack_from(f"{order}II", data, at)
        start, length = at + _TAG, _TAG + size
        if kind >> 16:  # a short one, in the tag itself
            kind, size, start, length = kind & 0xFFFF, kind >> 16, at + _SHORT, _TAG
        if start + size > min(at + length, len(data)):
            raise ValueError(f"data of type {kind} and {size} bytes")
        yield kind, data[start : start + size]
        at += length if kind == _COMPRESSED else -(-length // _TAG) * _TAG
