"""Loops in C over equal operations on consecutive elements."""

import re
import textwrap
from collections.abc import Iterator, Sequence
from typing import NamedTuple

ROLLED = 8
"""Smallest number of equal operations, or repetitions of a scan, in a loop of C."""

_ELEMENT = re.compile(r"(.+)\[(\d+)\]")


class Piece(NamedTuple):
    """Elements from ``first`` up to ``end`` of an array, with their operands.

    For a single element, ``operands`` are its expressions; for several they depend on
    the index ``i`` of the element.
    """

    first: int
    end: int
    operands: tuple[str, ...]


def pieces(rows: Sequence[Sequence[str]]) -> Iterator[Piece]:
    """Divide an array of operations, with the operands ``rows``, into loops.

    Within a loop each operand is constant or an element of an array, with an index that
    is linear in that of the result.
    """
    first = 0
    while first < len(rows):
        end, steps = _piece(rows, first)
        operands = tuple(rows[first])
        if end - first < ROLLED:
            end = first + 1
        else:
            each = zip(operands, steps, strict=True)
            operands = tuple(_linear(text, step, first) for text, step in each)
        yield Piece(first, end, operands)
        first = end


def _piece(rows: Sequence[Sequence[str]], first: int) -> tuple[int, list[int | None]]:
    """Return the end of the piece from ``first`` on, and the steps of its indices."""
    end, steps = first + 1, []
    while end < len(rows):
        pairs = zip(rows[end - 1], rows[end], strict=True)
        found = [_step(one, other) for one, other in pairs]
        if None in found or (steps and found != steps):
            break
        end, steps = end + 1, found
    return end, steps


def _step(text: str, following: str) -> int | None:
    """Return the difference of the indices of two elements, or None."""
    if text == following:
        return 0
    one, other = _ELEMENT.fullmatch(text), _ELEMENT.fullmatch(following)
    if one is None or other is None or one[1] != other[1]:
        return None
    return int(other[2]) - int(one[2])


def _linear(text: str, step: int | None, first: int) -> str:
    """Return the operand whose element for index ``first`` is ``text``."""
    element = _ELEMENT.fullmatch(text)
    if not step or element is None:
        return text
    product = "i" if step == 1 else f"{step} * i"
    offset = int(element[2]) - step * first
    sign = "-" if offset < 0 else "+"
    return f"{element[1]}[{product}{f' {sign} {abs(offset)}' if offset else ''}]"


def constant_array(
    declaration: str, numbers: Sequence[str], indent: str
) -> Iterator[str]:
    """Yield the lines of an array of constants; ``declaration`` is type and name."""
    yield f"{indent}static const {declaration}[{len(numbers)}] = {{"
    for row in textwrap.wrap(", ".join(numbers), 80, break_on_hyphens=False):
        yield f"{indent}    {row}"
    yield f"{indent}}};"
