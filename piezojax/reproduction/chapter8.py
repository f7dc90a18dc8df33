"""Tables 8-2, 8-3 and Figures 8.4, 8.5: nominal control with and without observer."""

from ..catalog import p558_control
from .cell import Cell
from .three_dof import EXPERIMENTS, Column, experiment_cells, table_cells

DELAY = 0
"""Samples of delay of the stage beyond (7.53)."""

COLUMNS = {
    "dob_smc": Column(p558_control.disturbance_observer, DELAY),
    "nominal_smc": Column(p558_control.nominal, DELAY),
}
"""Controllers by the name ``cells.csv`` uses."""

FIGURES = dict(zip(("figure-8-4", "figure-8-5"), EXPERIMENTS, strict=True))
"""Figures of the combined experiments."""

TABLES = ("8-2", "8-3", *FIGURES)
"""The tables and figures of this chapter."""


def cells(table: str) -> list[Cell]:
    """Return the 27 cells of a table, or what is printed on a figure, simulated.

    One reading for all of them, nothing tuned per cell: the gains of Table 8-1; the
    equivalent control on the nominal model's own state, because it is unstable on the
    measured one; the numerators of (8.40)-(8.42) scaled to the DC gains of (7.53);
    the alpha-beta filter as printed. Stage, noise and errors as in chapter 7, but
    without its further sample of delay, with which the driven axes agree less
    (docs/reproduction.md). What agrees is the order, not the levels, which are too low.
    The figure that 8.5.4.2 gives for the first experiment names no axis; it is Ry, the
    one with no reference.
    """
    if table in FIGURES:
        return experiment_cells("ch8", table, COLUMNS, FIGURES[table])
    return table_cells("ch8", table, COLUMNS)
