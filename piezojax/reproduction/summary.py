"""Agreement of simulated with printed tables, and their comma-separated text."""

import csv
import io
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import numpy as np
from pydantic import BaseModel

from .cell import Cell


class Agreement(BaseModel):
    """Geometric-mean and worst ratio of simulated to printed values.

    A ratio below 1 counts as its inverse, so both are at least 1.
    """

    geomean_ratio: float
    worst_ratio: float
    cells: int


class TableAgreement(Agreement):
    """Agreement of a table and of each of its columns."""

    columns: dict[str, Agreement]


class GroupedAgreement(TableAgreement):
    """Agreement of a table, of its columns, and of groups of cells across columns."""

    groups: dict[str, Agreement]


def geomean(logs: Any) -> float:
    """Return exp(mean |ln(sim/print)|) of ``logs``, the values of ln(sim/print)."""
    return float(np.exp(np.mean(np.abs(logs))))


def ratio_of(cells: Sequence[Cell]) -> float:
    """Return the geometric-mean ratio of ``cells``."""
    return geomean(np.log([cell.ratio for cell in cells]))


def _agreement(cells: Sequence[Cell]) -> Agreement:
    distance = np.abs(np.log([cell.ratio for cell in cells]))
    return Agreement(
        geomean_ratio=ratio_of(cells),
        worst_ratio=float(np.exp(distance.max())),
        cells=len(cells),
    )


def _by(key: Callable[[Cell], str], cells: Sequence[Cell]) -> dict[str, Agreement]:
    return {
        name: _agreement([cell for cell in cells if key(cell) == name])
        for name in dict.fromkeys(key(cell) for cell in cells)
    }


def summarise(cells: Sequence[Cell]) -> dict[str, TableAgreement]:
    """Return the agreement of each table in ``cells``."""
    summary = {}
    for table in dict.fromkeys(cell.table for cell in cells):
        inside = [cell for cell in cells if cell.table == table]
        table_agreement = _agreement(inside).model_dump()
        columns = _by(lambda cell: cell.column, inside)
        grouped = [cell for cell in inside if cell.group]
        if grouped:
            groups = _by(lambda cell: cell.group, grouped)
            summary[table] = GroupedAgreement(
                **table_agreement, columns=columns, groups=groups
            )
        else:
            summary[table] = TableAgreement(**table_agreement, columns=columns)
    return summary


def comma_separated(header: Sequence[str], rows: Iterable[Sequence[Any]]) -> str:
    """Return ``rows`` under ``header`` as comma-separated text."""
    buffer = io.StringIO()
    writer = csv.writer(buffer, lineterminator="\n")
    writer.writerow(header)
    writer.writerows(rows)
    return buffer.getvalue()


def as_csv(cells: Sequence[Cell]) -> str:
    """Return ``cells`` as comma-separated text with a header."""
    return comma_separated(
        ["table", "row", "column", "unit", "paper", "sim"],
        [(c.table, c.row, c.column, c.unit, c.paper, f"{c.sim:.6g}") for c in cells],
    )
