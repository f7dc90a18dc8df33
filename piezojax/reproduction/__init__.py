"""The thesis' result tables, simulated with its printed numbers."""

from collections.abc import Callable

from . import chapter3, chapter4, chapter5, chapter6, chapter7, chapter8
from .cell import Cell as Cell
from .summary import summarise as summarise

CHAPTERS = (chapter3, chapter4, chapter5, chapter6, chapter7, chapter8)
"""One module a chapter: its ``TABLES``, and ``cells`` that simulates one of them."""

TABLES: dict[str, Callable[[str], list[Cell]]] = {
    table: chapter.cells for chapter in CHAPTERS for table in chapter.TABLES
}
"""Tables that can be reproduced, by their number."""


def reproduce(table: str) -> list[Cell]:
    """Return the cells of ``table``, paper beside simulation.

    Raises ValueError, listing the tables, for one that is unknown.
    """
    if table not in TABLES:
        raise ValueError(f"table {table!r} is unknown; there are {', '.join(TABLES)}")
    return TABLES[table](table)
