"""Tables 5-3 and 5-5: three PID-based sliding mode controllers, ten references."""

import csv
from dataclasses import dataclass
from importlib.resources import files

import equinox as eqx
import jax
import numpy as np

from .. import signals
from ..catalog import p753
from ..metrics import Tracking
from ..rollout import simulate
from ..system import System, loop_inputs

COLUMNS = {
    "pid_smc": p753.sliding_mode,
    "inversion": p753.inversion,
    "dob": p753.disturbance_observer,
}
"""Columns of the tables by the name ``cells.csv`` uses."""

TABLES = {"5-3": "5-2", "5-5": "5-4"}
"""Result table: the table that prints its gains."""

SHORTEST = 1.0
"""Least length of the window in which errors count, s."""

PERIODS = {"SIN": 1.0, "PWSW": 4.0, "SW": 20.0}
"""Periods of the named frequency after which a signal repeats itself."""


@dataclass(frozen=True)
class Cell:
    """One printed number, its simulation beside it, both in ``unit``."""

    table: str
    row: str
    column: str
    unit: str
    paper: float
    sim: float

    @property
    def ratio(self) -> float:
        """Simulation over print."""
        return self.sim / self.paper


def window(name: str) -> float:
    """Return the shortest whole number of repeats of a signal that lasts 1 s, in s."""
    kind, frequency = signals.parse(name)
    assert frequency is not None
    repeat = PERIODS[kind] / frequency
    return repeat * np.ceil(SHORTEST / repeat - 1e-9)


@eqx.filter_jit
def _rms_error(controller: System, reference: jax.Array) -> jax.Array:
    loop = p753.loop(controller, noise_rms=0.0)
    metric = Tracking(start=reference.size // 2)
    inputs = loop_inputs(reference)
    return simulate(loop, inputs, loop.init(0.0), metric=metric)[1].rms_error


def cells(table: str) -> list[Cell]:
    """Return the 30 cells of ``table`` ("5-3" or "5-5"), simulated.

    One reading for all of them, nothing tuned: the gains as printed, the stage with
    unit DC gain behind its hysteresis, no sensor noise, a start from rest at zero, and
    the RMS of the true displacement against the reference over the second half of a run
    of two windows (see ``window``).
    """
    printed = {
        (row["row"], row["column"]): row for row in _printed() if row["table"] == table
    }
    found = []
    for name in signals.THESIS:
        reference = signals.signal(
            name, signals.time_grid(2.0 * window(name), p753.RATE)
        )
        for column, make in COLUMNS.items():
            error = float(_rms_error(make(TABLES[table]), reference))
            row = printed[name, column]
            found.append(
                Cell(table, name, column, row["unit"], float(row["paper"]), error)
            )
    return found


def _printed() -> list[dict[str, str]]:
    source = files("piezojax.reproduce").joinpath("data/ch5.csv")
    return list(csv.DictReader(source.read_text(encoding="utf-8").splitlines()))
