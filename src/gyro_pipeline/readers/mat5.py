"""A look through a MATLAB file of version 5 before SciPy reads it.

SciPy finds the kind of data by a number in the file, which it does not check: one damaged byte can
end the process (scipy 1.17).

Source: MathWorks, MAT-File Format, chapter 1: a header of 128 bytes, then elements of a tag, which
has the type and the number of bytes, and of data in whole eights. An array is an element of
elements, and a compressed element holds another one.
"""

import zlib

_HEADER, _ENDIAN = 128, {b"IM": "<", b"MI": ">"}
_TYPES = {*range(1, 8), 9, *range(12, 19)}
_FLAGS, _ARRAY, _COMPRESSED = 6, 14, 15
_CLASSES = range(1, 19)
_TAG, _IN_TAG, _DEEPEST = 8, 4, 64


def check(data: bytes) -> None:
    """See that a file is made of whole elements of known types.

    Raises:
        ValueError: It is not.
    """
    order = _ENDIAN.get(data[_HEADER - 2 : _HEADER])
    if order is None:
        raise ValueError("no mark of MATLAB's byte order")
    _check_elements(data[_HEADER:], order, 0)
