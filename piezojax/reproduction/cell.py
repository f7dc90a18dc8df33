"""What all chapters share: a printed cell, and the window in which errors count."""

import csv
from dataclasses import dataclass, replace
from importlib.resources import files

import numpy as np

from ..signals import waveforms as signals

SHORTEST = 1.0
"""Least length of the window in which errors count, s."""

PERIODS = {"SIN": 1.0, "PWSW": 4.0, "SW": 20.0}
"""Periods of the named frequency after which a signal repeats itself."""


@dataclass(frozen=True)
class Cell:
    """One printed number, its simulation beside it, both in ``unit``.

    ``sim`` is NaN until it has been simulated. ``group``, if not empty, is what the
    cell counts to in the summary besides its column.
    """

    table: str
    row: str
    column: str
    unit: str
    paper: float
    sim: float = float("nan")
    group: str = ""

    def simulated(self, value: float, group: str = "") -> "Cell":
        """Return the same cell with ``value`` beside the print."""
        return replace(self, sim=value, group=group)

    @property
    def ratio(self) -> float:
        """Simulation over print."""
        return self.sim / self.paper


def title_of(table: str) -> str:
    """Return the title of a table, or of a figure whose numbers are redone."""
    number = table.removeprefix("figure-")
    return f"Table {table}" if number == table else f"Figure {number}"


def window(name: str) -> float:
    """Return the shortest whole number of repeats of a signal that lasts 1 s, in s."""
    kind, frequency = signals.parse(name)
    assert frequency is not None
    repeat = PERIODS[kind] / frequency
    return repeat * np.ceil(SHORTEST / repeat - 1e-9)


def printed(chapter: str, table: str) -> dict[tuple[str, str], Cell]:
    """Return the cells of ``table`` in ``data/{chapter}.csv`` by row and column."""
    source = files("piezojax.reproduction").joinpath(f"data/{chapter}.csv")
    lines = csv.DictReader(source.read_text(encoding="utf-8").splitlines())
    return {
        (line["row"], line["column"]): Cell(
            table, line["row"], line["column"], line["unit"], float(line["paper"])
        )
        for line in lines
        if line["table"] == table
    }
