"""The stage fitted through the closed loops to half of the cells, judged on the rest.

Fitted on one half of the cells of Tables 5-3 and 5-5, the stage predicts the other
half; then the halves change places. Which prints are doubted, and fitted too, is
decided on the fitting half (``selection``), of all that could be (``doubts``). Chapter
4 (Table 4-5) is another experiment, with another printed model of the stage, and is
fitted on its own in the same way.
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
from .doubts import candidates
from .lanes import by_column, lanes_of
from .selection import Round, select
from .stage_fit import STEPS, Point, Problem, log_ratios
from .stage_parameters import quantities, within

HALVES = ("even", "odd")
"""The cells' place in the printed order, row by row, table after table."""


@dataclass(frozen=True)
class Experiment:
    """Tables that one stage is to explain, and the print its fit starts from."""

    chapter: str
    tables: tuple[str, ...]
    columns: tuple[str, ...]
    dynamics: ARMA

    def cells(self) -> dict[str, list[Cell]]:
        """Return the cells of each half: every other one in the printed order.

        Columns that are left out are counted all the same.
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
        """Return what may be fitted: the stage's, then every candidate for a doubt."""
        every = [cell for half in self.cells().values() for cell in half]
        return quantities(self.dynamics) | {
            name: within(1.0, doubt.span, "of print")
            for name, doubt in candidates(every).items()
        }

    def problem(self, cells: Sequence[Cell], *, short: bool) -> Problem:
        """Return the Problem of ``cells``, in the order of ``by_column``."""
        found = self.quantities()
        space = space_of(found)
        order = [cell for group in by_column(cells) for cell in group]
        return Problem(
            space=space,
            stage=len(quantities(self.dynamics)),
            numerator=tuple(float(b) for b in self.dynamics.moving),
            lanes=lanes_of(cells, short=short),
            paper=jnp.asarray([cell.paper for cell in order]),
            counts=jnp.ones(len(order)),
            start=space.to_unit(jnp.asarray([q.start for q in found.values()])),
            strength=jnp.asarray(1.0),
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
"""What is fitted. The traditional column of Table 4-5 is in none, because its gains are
not printed."""


class Swap(NamedTuple):
    """A fit to one half: its values, its pull, and all cells simulated with them.

    ``values`` of the stage and of the ``doubts``, as factors on print; ``rounds`` say
    how these were chosen; ``alone`` are the held-out cells of the stage without them.
    """

    half: str
    strength: float
    values: dict[str, float]
    doubts: tuple[str, ...]
    rounds: tuple[Round, ...]
    train: list[Cell]
    held_out: list[Cell]
    alone: list[Cell]


def calibrate(
    name: str, steps: int = STEPS, progress: Progress | None = None
) -> list[Swap]:
    """Return both fits of ``EXPERIMENTS[name]``, each judged on the other half.

    Fitted on shortened runs (``lanes.WARM_UP``, ``lanes.SHORT``), judged on the runs
    that the tables of this package use. The held-out cells are simulated once both fits
    are final.
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
    judge = experiment.problem(everything, short=False)
    order = [cell for group in by_column(everything) for cell in group]

    def judged(point: Point) -> list[Cell]:
        ratios = np.exp(np.asarray(log_ratios(judge, point)))
        return [
            cell.simulated(float(cell.paper * ratio))
            for cell, ratio in zip(order, ratios, strict=True)
        ]

    swaps = []
    for half, choice in choices.items():
        mine = {(cell.table, cell.row, cell.column) for cell in halves[half]}
        inside = [(c.table, c.row, c.column) in mine for c in order]
        found, alone = judged(choice.point), judged(choice.alone)
        values = judge.space.named(choice.point)
        fitted = (*judge.space.paths[: judge.stage], *choice.doubts)
        swaps.append(
            Swap(
                half,
                choice.strength,
                {n: float(values[n]) for n in fitted},
                choice.doubts,
                choice.rounds,
                [c for c, ours in zip(found, inside, strict=True) if ours],
                [c for c, ours in zip(found, inside, strict=True) if not ours],
                [c for c, ours in zip(alone, inside, strict=True) if not ours],
            )
        )
    return swaps
