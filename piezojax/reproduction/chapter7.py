"""Table 7-4 and Figure 7.4: multi-axis sliding mode control against a PID."""

from functools import partial

from ..catalog import p558_control
from .cell import Cell
from .three_dof import Column, experiment_cells, table_cells

DELAY = 1
"""Samples of delay of the stage beyond (7.53)."""

COLUMNS = {
    "pid_smc": Column(partial(p558_control.multi_axis, "dynamic", False), DELAY),
    "pid": Column(p558_control.pid, DELAY),
}
"""Controllers by the name ``cells.csv`` uses."""

FIGURE = "figure-7-4"
"""The second combined experiment; nothing is printed on the first (Figure 7.3)."""

TABLES = ("7-4", FIGURE)
"""The table and figure of this chapter."""


def cells(table: str) -> list[Cell]:
    """Return the 54 cells of Table 7-4 or the 6 of Figure 7.4, simulated.

    One reading for all of them, nothing tuned per cell: the gains as printed for
    dynamic tracking; (7.53) behind a hysteresis of about 1 % and one further sample of
    delay; sensor noise of 0.8 nm and 13 nrad rms, which is the floor of the table; no
    alpha-beta filter in front of the sliding mode controller; the measured output
    less r over the second half of 4 s. With the filter, as the text has it, or
    without the further delay the driven axes agree less (docs/reproduction.md).

    Off its diagonal Table 7-4 is printed transposed: the row of a driven Rx under Z has
    the error of Rx when Z is driven. (``unit`` is that of the printed column all the
    same; such a cell holds the unit of its row's axis.) What the text says
    of Rx in the second experiment names no axis; it is the one with no reference.
    """
    if table == FIGURE:
        return experiment_cells("ch7", table, COLUMNS, "experiment_2")
    return table_cells("ch7", table, COLUMNS, transposed=True)
