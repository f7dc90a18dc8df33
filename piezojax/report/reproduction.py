"""Picture of simulated tables against print."""

from collections.abc import Sequence
from pathlib import Path

from matplotlib.figure import Figure

from ..reproduce.cell import Cell
from .figures import AFTER, BEFORE, MEASURED, REFERENCE, figure, styled, write

_MARKS = (("o", BEFORE), ("s", AFTER), ("^", MEASURED))


def write_picture(cells: Sequence[Cell], folder: Path) -> None:
    """Write cells.png into ``folder``."""
    with styled():
        write(cells_figure(cells), folder / "cells.png")


def cells_figure(cells: Sequence[Cell]) -> Figure:
    """Simulation against print, a panel a table; the diagonal is agreement."""
    tables = list(dict.fromkeys(cell.table for cell in cells))
    picture = figure(4.2 * len(tables), 4.2)
    for ax, table in zip(
        picture.subplots(1, len(tables), squeeze=False)[0], tables, strict=True
    ):
        inside = [cell for cell in cells if cell.table == table]
        unit = inside[0].unit.replace("um", "µm")
        columns = dict.fromkeys(cell.column for cell in inside)
        for column, (marker, colour) in zip(columns, _MARKS, strict=False):
            points = [c for c in inside if c.column == column]
            ax.loglog(
                [c.paper for c in points],
                [c.sim for c in points],
                marker,
                ms=4,
                color=colour,
                label=column,
            )
        low = 0.8 * min(min(c.paper, c.sim) for c in inside)
        high = 1.25 * max(max(c.paper, c.sim) for c in inside)
        ax.plot([low, high], [low, high], color=REFERENCE, lw=0.8)
        ax.fill_between(
            [low, high],
            [low / 1.25, high / 1.25],
            [low * 1.25, high * 1.25],
            color="#eef4f6",
            zorder=0,
            label="within 25 %",
        )
        ax.set(
            xlim=(low, high),
            ylim=(low, high),
            title=f"Table {table}",
            xlabel=f"printed rms error ({unit})",
            ylabel=f"simulated rms error ({unit})",
        )
        ax.legend(loc="upper left")
    return picture
