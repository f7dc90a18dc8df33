"""Pictures of simulated against printed tables, and of errors by sampling rate."""

from collections.abc import Sequence
from pathlib import Path

from matplotlib.figure import Figure

from ..reproduction.cell import Cell, title_of
from ..reproduction.rates import FIGURE, RateError
from .figures import AFTER, BEFORE, MEASURED, REFERENCE, figure, plot_style, write

ACROSS = 4
"""Largest number of panels in a row."""

_MARKS = (("o", BEFORE), ("s", AFTER), ("^", MEASURED), ("x", REFERENCE))


def write_picture(cells: Sequence[Cell], folder: Path) -> None:
    """Write cells.png into ``folder``."""
    with plot_style():
        write(cells_figure(cells), folder / "cells.png")


def cells_figure(cells: Sequence[Cell]) -> Figure:
    """Draw simulated against printed values, a panel for each table.

    Values on the diagonal agree.
    """
    tables = list(dict.fromkeys(cell.table for cell in cells))
    across = min(len(tables), ACROSS)
    down = -(-len(tables) // across)
    picture = figure(4.2 * across, 4.2 * down)
    panels = picture.subplots(down, across, squeeze=False).ravel()
    for ax in panels[len(tables) :]:
        ax.set_axis_off()
    for ax, table in zip(panels, tables, strict=False):
        inside = [cell for cell in cells if cell.table == table]
        units = dict.fromkeys(_unit(cell) for cell in inside)
        unit = ", ".join(units)
        series = dict.fromkeys(_series(cell) for cell in inside)
        for name, (marker, colour) in zip(series, _MARKS, strict=False):
            points = [c for c in inside if _series(c) == name]
            ax.loglog(
                [c.paper for c in points],
                [c.sim for c in points],
                marker,
                ms=4,
                color=colour,
                label=name,
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
            title=title_of(table),
            xlabel=f"printed ({unit})",
            ylabel=f"simulated ({unit})",
        )
        ax.legend(loc="upper left")
    return picture


def _unit(cell: Cell) -> str:
    return {"um": "µm", "urad": "µrad"}.get(cell.unit, cell.unit)


def _series(cell: Cell) -> str:
    """Return the series in which a cell is drawn: its group if any, else its column."""
    return cell.group or cell.column


def write_rates(errors: Sequence[RateError], folder: Path) -> None:
    """Write figure-4-10.png into ``folder``."""
    with plot_style():
        write(rates_figure(errors), folder / f"{FIGURE}.png")


def rates_figure(errors: Sequence[RateError]) -> Figure:
    """Draw rms error against sampling rate.

    A panel for each signal, a line for each controller.
    """
    rows = list(dict.fromkeys(e.row for e in errors))
    columns = list(dict.fromkeys(e.column for e in errors))
    picture = figure(3.2 * len(rows), 3.4)
    panels = picture.subplots(1, len(rows), squeeze=False, sharey=True)[0]
    for ax, row in zip(panels, rows, strict=True):
        for column, (marker, colour) in zip(columns, _MARKS, strict=False):
            points = [e for e in errors if (e.row, e.column) == (row, column)]
            ax.loglog(
                [1e-3 * e.rate for e in points],
                [e.error for e in points],
                f"{marker}-",
                color=colour,
                label=column.replace("_", " "),
            )
        rates = sorted({e.rate for e in errors})
        ax.set_xticks([1e-3 * r for r in rates], [f"{1e-3 * r:g}" for r in rates])
        ax.minorticks_off()
        ax.set(title=row, xlabel="sampling rate (kHz)")
    panels[0].set_ylabel("simulated rms error (µm)")
    panels[0].legend(loc="upper right")
    return picture
