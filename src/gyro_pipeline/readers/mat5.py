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
_TYPES = "- i1 u1 i2 u2 i4 u4 f4 - f8 - - i8 u8".split()  # NumPy's, by their numbers in a file
_STRUCTURE, _NUMBERS, _COMPLEX = 2, range(6, 16), 1 << 11

Named = Iterator[tuple[str, NDArray[Any]]]


def arrays(data: bytes) -> Named:
    """Names and arrays of numbers in a file; ``log.gyro`` is field gyro of a structure log.

    Texts, cells, objects, sparse and complex arrays are left out.

    Raises:
        Exception: The file is damaged; NumPy, struct and zlib say so in many ways.
    """
    order = _ORDERS[data[_HEADER - 2 : _HEADER]]
    for kind, content in _elements(memoryview(data)[_HEADER:], order):
        if kind == _ARRAY:
            yield from _named(content, order, "")


def _named(content: memoryview, order: str, name: str) -> Named:
    """An array, or those of a structure; an array in a structure has no name of its own."""
    if not content:
        return
    (_, flags), (_, size), (_, label), *parts = _elements(content, order)
    flag, name = np.frombuffer(flags, f"{order}u4")[0], name or str(label, "utf-8")
    if flag & 0xFF == _STRUCTURE and np.prod(np.frombuffer(size, f"{order}i4")) == 1:
        (_, width), (_, labels), *fields = parts
        names = np.frombuffer(labels, f"S{np.frombuffer(width, f'{order}i4')[0]}").tolist()
        for field, (_, inner) in zip(names, fields, strict=True):
            yield from _named(inner, order, f"{name}.{field.decode()}")
    elif flag & 0xFF in _NUMBERS and not flag & _COMPLEX and name:
        kind, values = parts[0]
        array = np.frombuffer(values, order + _TYPES[kind])
        yield name, array.reshape(np.frombuffer(size, f"{order}i4"), order="F")


def _elements(data: memoryview, order: str) -> Iterator[tuple[int, memoryview]]:
    """Types and contents, also of what is compressed."""
    at = 0
    while at < len(data):
        kind, size = struct.unpack_from(f"{order}II", data, at)
        start, length = at + _TAG, _TAG + size
        if kind >> 16:  # a short one, in the tag itself
            kind, size, start, length = kind & 0xFFFF, kind >> 16, at + _SHORT, _TAG
        if start + size > min(at + length, len(data)):
            raise ValueError(f"data of type {kind} and {size} bytes")
        content = data[start : start + size]
        if kind == _COMPRESSED:
            yield from _elements(memoryview(zlib.decompress(content)), order)
        else:
            yield kind, content
        at += length if kind == _COMPRESSED else -(-length // _TAG) * _TAG
