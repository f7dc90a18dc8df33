"""Reproduction of the result tables of the thesis with its printed numbers."""

from collections.abc import Callable

from . import chapter3, chapter4, chapter5, chapter6, chapter7, chapter8
from .cell import Cell as Cell
from .summary import summarise as summarise

CHAPTERS = (chapter3, chapter4, chapter5, chapter6, chapter7, chapter8)
"""One module for each chapter, with ``TABLES`` and a function ``cells(table)``."""

TABLES: dict[str, Callable[[str], list[Cell]]] = {
    table: chapter.cells for chapter in CHAPTERS for table in chapter.TABLES
}
"""Function that simulates a table, by the number of the table."""


def reproduce(table: str) -> list[Cell]:
    """Return the simulated cells of ``table``.

    Raises ValueError, listing the tables, for an unknown table.
    """
    if table not in TABLES:
        raise ValueError(f"table {table!r} is unknown; there are {', '.join(TABLES)}")
    return TABLES[table](table)
