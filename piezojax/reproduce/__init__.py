"""The thesis' result tables, simulated with its printed gains."""

from collections.abc import Callable

from .chapter5 import Cell as Cell
from .chapter5 import cells as _chapter5
from .summary import summarise as summarise

TABLES: dict[str, Callable[[str], list[Cell]]] = {"5-3": _chapter5, "5-5": _chapter5}
"""Tables that can be reproduced, by their number."""


def reproduce(table: str) -> list[Cell]:
    """Return the cells of ``table``, paper beside simulation.

    Raises ValueError, listing the tables, for one that is unknown.
    """
    if table not in TABLES:
        raise ValueError(f"table {table!r} is unknown; there are {', '.join(TABLES)}")
    return TABLES[table](table)
