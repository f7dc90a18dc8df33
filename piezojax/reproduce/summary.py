"""How close a table is to print, cell by cell and as a whole."""

import csv
import io
from collections.abc import Sequence

import numpy as np
from pydantic import BaseModel

from .cell import Cell


class Agreement(BaseModel):
    """Geometric-mean and worst ratio of simulation and print, both at least 1."""

    geomean_ratio: float
    worst_ratio: float
    cells: int


class TableAgreement(Agreement):
    """The same for a whole table and for each of its columns."""

    columns: dict[str, Agreement]


def _agreement(cells: Sequence[Cell]) -> Agreement:
    distance = np.abs(np.log([cell.ratio for cell in cells]))
    return Agreement(
        geomean_ratio=float(np.exp(distance.mean())),
        worst_ratio=float(np.exp(distance.max())),
        cells=len(cells),
    )


def summarise(cells: Sequence[Cell]) -> dict[str, TableAgreement]:
    """Return the agreement of each table in ``cells``."""
    summary = {}
    for table in dict.fromkeys(cell.table for cell in cells):
        inside = [cell for cell in cells if cell.table == table]
        columns = {
            column: _agreement([c for c in inside if c.column == column])
            for column in dict.fromkeys(cell.column for cell in inside)
        }
        summary[table] = TableAgreement(
            **_agreement(inside).model_dump(), columns=columns
        )
    return summary


def as_csv(cells: Sequence[Cell]) -> str:
    """Return ``cells`` as comma-separated text with a header."""
    buffer = io.StringIO()
    writer = csv.writer(buffer, lineterminator="\n")
    writer.writerow(["table", "row", "column", "unit", "paper", "sim"])
    for cell in cells:
        writer.writerow(
            [
                cell.table,
                cell.row,
                cell.column,
                cell.unit,
                cell.paper,
                f"{cell.sim:.6g}",
            ]
        )
    return buffer.getvalue()
