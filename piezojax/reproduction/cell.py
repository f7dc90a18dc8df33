"""Printed cells of all chapters, and the error window of chapters 3 to 5."""

import csv
from dataclasses import dataclass, replace
from importlib.resources import files

import numpy as np

from ..signals import waveforms as signals

SHORTEST = 1.0
"""Shortest length of the window in which errors count, s."""

PERIODS = {"SIN": 1.0, "PWSW": 4.0, "SW": 20.0}
"""Number of periods, at the frequency in its name, after which a signal repeats."""


@dataclass(frozen=True)
class Cell:
    """A printed number ``paper`` and its simulated value ``sim``, both in ``unit``.

    ``sim`` is NaN before the simulation. ``group`` is an additional group of the
    summary, besides the column, that includes the cell; "" means none.
    """

    table: str
    row: str
    column: str
    unit: str
    paper: float
    sim: float = float("nan")
    group: str = ""

    def simulated(self, value: float, group: str = "") -> "Cell":
        """Return the cell with ``value`` as its simulated value."""
        return replace(self, sim=value, group=group)

    @property
    def ratio(self) -> float:
        """Ratio of the simulated to the printed value."""
        return self.sim / self.paper


def title_of(table: str) -> str:
    """Return the title of a table or figure."""
    number = table.removeprefix("figure-")
    return f"Table {table}" if number == table else f"Figure {number}"


def window(name: str) -> float:
    """Return the shortest time (s), at least 1 s, after which a signal repeats."""
    kind, frequency = signals.parse(name)
    assert frequency is not None
    repeat = PERIODS[kind] / frequency
    return repeat * np.ceil(SHORTEST / repeat - 1e-9)


def printed(chapter: str, table: str) -> dict[tuple[str, str], Cell]:
    """Return the printed cells of ``table`` by row and column.

    The source is ``data/{chapter}.csv``.
    """
    source = files("piezojax.reproduction").joinpath(f"data/{chapter}.csv")
    lines = csv.DictReader(source.read_text(encoding="utf-8").splitlines())
    return {
        (line["row"], line["column"]): Cell(
            table, line["row"], line["column"], line["unit"], float(line["paper"])
        )
        for line in lines
        if line["table"] == table
    }
