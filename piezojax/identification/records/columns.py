"""Parser of text tables: rows of cells in any dialect to columns of numbers."""

import codecs
import csv
from collections import Counter
from collections.abc import Sequence
from itertools import product
from typing import NamedTuple

import numpy as np

from ...core.plain import shown
from .preamble import split

SEPARATORS = (";", "\t", ",", None)
"""Separators of cells, None for blanks. Of separators that fit equally well the first
is taken."""

DECIMALS = (".", ",")

COMMENT = ("#", "%")
"""First characters of comment lines."""


class ContentError(Exception):
    """Error in the content of a file; the caller adds the name of the file."""


class Column(NamedTuple):
    """A column of a file.

    ``values`` [samples]; ``unit`` and ``dt`` (s) if the file holds them. ``fault``
    describes the first cell that is not a number; it matters only if the column is
    used.
    """

    values: np.ndarray
    unit: str | None = None
    dt: float | None = None
    fault: str | None = None


Columns = dict[str, Column]


def decoded(content: bytes) -> str:
    """Decode text in UTF-8, UTF-16 with a byte order mark, or Windows code page 1252.

    Raises ValueError for content that is not text.
    """
    marked = content.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE))
    try:
        text = content.decode("utf-16" if marked else "utf-8-sig")
    except UnicodeDecodeError:
        text = content.decode("cp1252")  # "µ" is one byte there
    if "\0" in text:
        raise ValueError("a zero byte is not text")
    return text


def parsed(text: str) -> Columns:
    """Return the columns of a text table; infer its dialect from its lines.

    Cells are separated by ``;``, tabs, commas or blanks. The decimal sign is a point or
    a comma. A header and a row of units below it are optional; without one, a comment
    line above the numbers with a name for each column is the header. Raises
    ContentError for an empty file, rows of different length, or two columns with the
    same name.
    """
    every = [line for line in text.splitlines() if line.strip()]
    lines = [line for line in every if not line.lstrip().startswith(COMMENT)]
    if not lines:
        raise ContentError("the file is empty")
    separator, decimal = _dialect(lines[:: max(1, len(lines) // 100)])
    rows = _cells(lines, separator)
    above = every[: every.index(lines[0])]
    if above and all(_numeric(cell, decimal) for cell in rows[0] if cell):
        names = _cells([above[-1].strip().lstrip("".join(COMMENT))], separator)[0]
        names = [name.strip() for name in names]
        text_only = all(name and not _numeric(name, decimal) for name in names)
        if len(set(names)) == len(names) == len(rows[0]) > 1 and text_only:
            rows = [names, *rows]
    return table(rows, decimal)


def table(rows: Sequence[Sequence[str]], decimal: str = ".") -> Columns:
    """Return the columns of ``rows`` of cells; errors as for ``parsed``."""
    rows = [row for row in rows if any(row)]
    if not rows:
        raise ContentError("the file is empty")
    head, rows = split(
        [[cell.strip() for cell in row] for row in rows],
        lambda cell: _numeric(cell, decimal),
        lambda row: _mostly_text(row, decimal),
    )
    header = head.names or [""] * (len(rows[0]) if rows else 0)
    names = [cell or str(i) for i, cell in enumerate(header)]
    units, width = head.units or [""] * len(names), len(names)
    for name in names:
        if names.count(name) > 1:
            raise ContentError(f"two columns are called {name!r}")
    for i, row in enumerate(rows):
        if len(row) < width or any(row[width:]):
            raise ContentError(
                f"sample {i} has {len(row)} columns; the first line has {width} "
                f"(lines that are not data begin with {' or '.join(COMMENT)})"
            )
    columns = {
        name: _column([row[j] for row in rows], units[j] or None, decimal)
        for j, name in enumerate(names)
    }
    return {
        name: _checked_scale(column, head.scaled)._replace(dt=head.dt)
        for name, column in columns.items()
    }


def _checked_scale(column: Column, scaled: bool) -> Column:
    """Return ``column``, with a fault if it seems to hold codes of a converter."""
    values = column.values
    if scaled and np.any(values) and np.all(values == np.round(values)):
        return column._replace(
            fault="its header gives a scale, and all its samples are whole numbers: "
            "export volts instead of the codes of the converter"
        )
    return column


def _dialect(lines: Sequence[str]) -> tuple[str | None, str]:
    """Return the separator and decimal sign that make most lines all numbers."""

    def score(dialect):
        separator, decimal = dialect
        rows = [
            [_numeric(cell, decimal) if cell else None for cell in row]
            for row in _cells(lines, separator)
        ]
        # An empty cell is a missing number, no evidence for or against a dialect.
        full = sum(False not in row for row in rows)
        numbers = sum(row.count(True) for row in rows)
        # Blanks in a header of names separate no columns.
        alike = max(Counter(map(len, rows)).values())
        return full, numbers, alike, sum(map(len, rows))

    return max(product(SEPARATORS, DECIMALS), key=score)


def _cells(lines: Sequence[str], separator: str | None) -> list[list[str]]:
    if separator is None:
        return [line.split() for line in lines]
    return list(csv.reader(lines, delimiter=separator, skipinitialspace=True))


# Swap comma and point, so that 1.234,5 is not a number.
_SWAP = str.maketrans(",.", ".,")


def _pointed(cell: str, decimal: str) -> str:
    return cell if decimal == "." else cell.translate(_SWAP)


def _numeric(cell: str, decimal: str) -> bool:
    try:
        float(_pointed(cell, decimal))
    except ValueError:
        return False
    return True


def _mostly_text(row: Sequence[str], decimal: str) -> bool:
    # A single text among numbers is a broken sample, not a header or a unit.
    filled = [cell for cell in row if cell]
    return 2 * sum(_numeric(cell, decimal) for cell in filled) < len(filled)


def _column(cells: Sequence[str], unit: str | None, decimal: str) -> Column:
    pointed = (_pointed(cell, decimal) or "nan" for cell in cells)
    try:
        return Column(np.array([float(cell) for cell in pointed]), unit)
    except ValueError:
        sample, cell = next(
            (i, cell)
            for i, cell in enumerate(cells)
            if cell and not _numeric(cell, decimal)
        )
        fault = f"sample {sample}: {shown(cell)} is not a number"
        return Column(np.full(len(cells), np.nan), unit, fault=fault)
