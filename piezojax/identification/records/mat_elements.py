"""Check of the elements of a MATLAB 5 file, whose reader crashes on unknown types.

Layout: MathWorks, MAT-File Format, chapter 1. A header of 128 bytes is followed by
elements: a type, a size and the data, padded to 8 bytes. SciPy takes the type as an
index into a table without a check, so that a damaged file may end the process.
"""

import struct
import zlib

from .columns import ContentError

_HEADER = 128
_MATRIX, _COMPRESSED = 14, 15
_PLAIN = frozenset({1, 2, 3, 4, 5, 6, 7, 9, 12, 13, 16, 17, 18})
_DEEPEST = 32


def check_elements(content: bytes) -> None:
    """Raise ContentError if an element is of an unknown type or cut short."""
    order = ">" if content[126:128] == b"MI" else "<"
    _check(memoryview(content)[_HEADER:], order, 0)


def _check(data: memoryview, order: str, depth: int) -> None:
    place = 0
    while place + 8 <= len(data):
        kind, size = struct.unpack_from(f"{order}II", data, place)
        start, step = place + 8, 8 + size + (-size % 8 if kind != _COMPRESSED else 0)
        if kind >> 16:  # up to 4 bytes of data in the tag itself
            kind, size, start, step = kind & 0xFFFF, kind >> 16, place + 4, 8
            if size > 4 or kind not in _PLAIN:
                raise ContentError("the file is damaged")
        inner = data[start : start + size]
        known = kind in _PLAIN if depth else kind in (_MATRIX, _COMPRESSED)
        if len(inner) < size or not (known or kind == _MATRIX) or depth > _DEEPEST:
            raise ContentError("the file is damaged")
        if kind == _MATRIX:
            _check(inner, order, depth + 1)
        elif kind == _COMPRESSED:
            try:
                unpacked = zlib.decompress(inner)
            except zlib.error:
                raise ContentError("the file is damaged") from None
            _check(memoryview(unpacked), order, depth)
        place += step
