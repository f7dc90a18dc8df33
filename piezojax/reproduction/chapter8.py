"""Tables 8-2, 8-3 and Figures 8.4, 8.5: nominal control with and without observer."""

from ..catalog import p558_control
from .cell import Cell
from .three_dof import EXPERIMENTS, Column, experiment_cells, table_cells

DELAY = 0
"""Additional delay of the stage beyond (7.53), samples."""

COLUMNS = {
    "dob_smc": Column(p558_control.disturbance_observer, DELAY),
    "nominal_smc": Column(p558_control.nominal, DELAY),
}
"""Controllers by their names in ``data/ch8.csv``."""

FIGURES = dict(zip(("figure-8-4", "figure-8-5"), EXPERIMENTS, strict=True))
"""Combined experiment of each figure."""

TABLES = ("8-2", "8-3", *FIGURES)
"""Tables and figures of this chapter."""


def cells(table: str) -> list[Cell]:
    """Return the cells of a table or figure, simulated.

    One reading of the thesis applies to all cells; nothing is tuned for single cells:

    - The gains are those of Table 8-1, the alpha-beta filter is as printed.
    - The equivalent control uses the state of the nominal model, because it is unstable
      with the measured state.
    - The numerators of (8.40)-(8.42) are scaled to the DC gains of (7.53).
    - Stage, noise and errors are those of chapter 7, but without its additional sample
      of delay, with which the driven axes agree less (docs/reproduction.md).

    The order of the controllers agrees; the simulated errors are too low. Section
    8.5.4.2 does not name the axis of its number for the first experiment; it is Ry, the
    axis without a reference.
    """
    if table in FIGURES:
        return experiment_cells("ch8", table, COLUMNS, FIGURES[table])
    return table_cells("ch8", table, COLUMNS)
