"""Calibration: the stage fitted to half of the cells and tested on the other half.

The stage is fitted through the closed loops to one half of the cells of Tables 5-3 and
5-5, and predicts the other half; then the halves are exchanged. Suspect numbers are
fitted too. They are selected on the fitting half (``selection``) from all candidates
(``suspect_numbers``). Chapter 4 (Table 4-5) is another experiment with another printed
model of the stage, and is fitted separately in the same way.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from ..catalog import p753
from ..core.progress import Progress, Silent
from ..core.space import Range, space_of
from ..dynamics import ARMA
from . import chapter5
from .cell import Cell, printed
from .lanes import by_column, lanes_of
from .selection import Round, select
from .stage_fit import STEPS, Point, Problem, log_ratios
from .stage_parameters import quantities, within
from .suspect_numbers import candidates_of

HALVES = ("even", "odd")
"""Halves of the cells, by position in the printed order: table by table, row by row."""


@dataclass(frozen=True)
class Experiment:
    """Tables of one stage, their fitted ``columns``, and its printed dynamics."""

    chapter: str
    tables: tuple[str, ...]
    columns: tuple[str, ...]
    dynamics: ARMA

    def cells(self) -> dict[str, list[Cell]]:
        """Return the cells of each half: every other cell in the printed order.

        Cells of other columns than ``columns`` count in this order but are left out.
        """
        every = [
            cell
            for table in self.tables
            for cell in printed(self.chapter, table).values()
        ]
        return {
            half: [cell for cell in every[i::2] if cell.column in self.columns]
            for i, half in enumerate(HALVES)
        }

    def quantities(self) -> dict[str, Range]:
        """Return the fitted quantities: those of the stage, then all candidates."""
        every = [cell for half in self.cells().values() for cell in half]
        return quantities(self.dynamics) | {
            name: within(1.0, suspect.span, "of the printed value")
            for name, suspect in candidates_of(every).items()
        }

    def problem(self, cells: Sequence[Cell], *, short: bool) -> Problem:
        """Return the Problem of ``cells``, in the order of ``by_column``."""
        ranges = self.quantities()
        space = space_of(ranges)
        order = [cell for group in by_column(cells) for cell in group]
        return Problem(
            space=space,
            stage=len(quantities(self.dynamics)),
            numerator=tuple(float(b) for b in self.dynamics.moving),
            lanes=lanes_of(cells, short=short),
            paper=jnp.asarray([cell.paper for cell in order]),
            counts=jnp.ones(len(order)),
            start=space.to_unit(jnp.asarray([q.start for q in ranges.values()])),
            penalty_weight=jnp.asarray(1.0),
        )


def _chapter5() -> Experiment:
    return Experiment(
        "ch5",
        tuple(chapter5.TABLES),
        tuple(chapter5.COLUMNS),
        ARMA(**p753.DYNAMICS_BEHIND_HYSTERESIS),
    )


def _chapter4() -> Experiment:
    row = p753.ARMA_HYSTERESIS["3-2"]
    dynamics = ARMA(row["autoregressive"], row["moving_2"])
    return Experiment("ch4", ("4-5",), ("model_reference", "continuous"), dynamics)


EXPERIMENTS = {"chapter 5": _chapter5(), "chapter 4": _chapter4()}
"""Experiments by name. None contains the traditional column of Table 4-5, because the
gains behind it are not printed."""


class HalfFit(NamedTuple):
    """A fit to one half, and all cells simulated with it.

    ``values`` holds the quantities of the stage and the factors on the printed values
    of ``suspects``, which were selected in ``rounds``. ``penalty_weight`` is the weight
    of the penalty on the distance from the printed stage. ``train`` and ``held_out``
    are the cells simulated with the fit; ``stage_only`` are the held-out cells
    simulated with a fit without suspect numbers.
    """

    half: str
    penalty_weight: float
    values: dict[str, float]
    suspects: tuple[str, ...]
    rounds: tuple[Round, ...]
    train: list[Cell]
    held_out: list[Cell]
    stage_only: list[Cell]


def calibrate(
    name: str, steps: int = STEPS, progress: Progress | None = None
) -> list[HalfFit]:
    """Return both fits of ``EXPERIMENTS[name]``, each tested on the other half.

    The fits use shortened runs (``lanes.WARM_UP``, ``lanes.SHORT``); the tests use runs
    as long as those of the tables. The held-out cells are simulated after both fits
    are final. ``steps`` is the largest number of optimiser steps from each start.
    """
    progress = Silent() if progress is None else progress
    experiment = EXPERIMENTS[name]
    halves = experiment.cells()
    choices = {
        half: select(
            experiment.problem(cells, short=True), f"{name}, {half}", steps, progress
        )
        for half, cells in halves.items()
    }
    everything = [cell for half in halves.values() for cell in half]
    full_runs = experiment.problem(everything, short=False)
    order = [cell for group in by_column(everything) for cell in group]

    def cells_at(point: Point) -> list[Cell]:
        ratios = np.exp(np.asarray(log_ratios(full_runs, point)))
        return [
            cell.simulated(float(cell.paper * ratio))
            for cell, ratio in zip(order, ratios, strict=True)
        ]

    fits = []
    for half, choice in choices.items():
        fitted_keys = {(cell.table, cell.row, cell.column) for cell in halves[half]}
        inside = [(c.table, c.row, c.column) in fitted_keys for c in order]
        both, stage_only = cells_at(choice.point), cells_at(choice.stage_only)
        values = full_runs.space.named(choice.point)
        names = (*full_runs.space.paths[: full_runs.stage], *choice.suspects)
        fits.append(
            HalfFit(
                half,
                choice.penalty_weight,
                {n: float(values[n]) for n in names},
                choice.suspects,
                choice.rounds,
                [c for c, used in zip(both, inside, strict=True) if used],
                [c for c, used in zip(both, inside, strict=True) if not used],
                [c for c, used in zip(stage_only, inside, strict=True) if not used],
            )
        )
    return fits
