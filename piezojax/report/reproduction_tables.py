"""Tables of the results of papers, beside simulated ones."""

from collections.abc import Sequence

from rich.table import Table

from ..reproduction.cell import Cell, title_of
from ..reproduction.summary import GroupedAgreement, TableAgreement

WIDE = 3
"""Largest number of columns of one table, so that it fits into 80 characters."""


def reproduction_table(
    name: str, cells: Sequence[Cell], agreement: TableAgreement
) -> Table:
    """Return printed and simulated errors, a row for each reference."""
    columns = list(agreement.columns)
    units = ", ".join(dict.fromkeys(cell.unit for cell in cells))
    title = (
        f"{title_of(name)}: paper / simulation in {units}\n"
        f"geometric-mean ratio {agreement.geomean_ratio:.3f}, "
        f"worst {agreement.worst_ratio:.2f}"
    )
    if isinstance(agreement, GroupedAgreement):
        title += "\n" + ", ".join(
            f"{group} {part.geomean_ratio:.3f}"
            for group, part in agreement.groups.items()
        )
    if len(columns) <= WIDE:
        return _part_table(columns, cells, agreement, title)
    stack = Table.grid()
    for start in range(0, len(columns), WIDE):
        part = columns[start : start + WIDE]
        stack.add_row(_part_table(part, cells, agreement, "" if start else title))
    return stack


def _part_table(
    columns: Sequence[str],
    cells: Sequence[Cell],
    agreement: TableAgreement,
    title: str,
) -> Table:
    table = Table(title=title)
    table.add_column("reference")
    for column in columns:
        table.add_column(column, justify="right")
    by_place = {(cell.row, cell.column): cell for cell in cells}
    for row in dict.fromkeys(cell.row for cell in cells):
        row_cells = [by_place[row, column] for column in columns]
        table.add_row(row, *(f"{c.paper:.4f} / {c.sim:.4f}" for c in row_cells))
    table.add_section()
    ratios = (f"{agreement.columns[c].geomean_ratio:.3f}" for c in columns)
    table.add_row("geometric-mean ratio", *ratios, style="bold")
    return table
