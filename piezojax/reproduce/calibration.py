"""The stage fitted through the closed loops to half of the cells, judged on the rest.

Fitted on one half of the cells of Tables 5-3 and 5-5, the stage predicts the other
half; then the halves change places. Chapter 4 (Table 4-5) is another experiment, with
another printed model of the stage, and is fitted on its own in the same way.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..catalog import p753
from ..dynamics import ARMA
from ..optimisers import Optimiser, View, levenberg_marquardt
from ..progress import Progress, Silent
from ..space import Space, space_of
from . import chapter5
from .cell import Cell, printed
from .lanes import Lanes, by_column, lanes_of, mean_squares
from .stage import DOUBTS, Quantity, quantities, sensor_of, stage_of
from .summary import geomean

HALVES = ("even", "odd")
"""The cells' place in the printed order, row by row, table after table."""

STRENGTHS = (0.3, 3.0)
"""Pulls towards print tried: cost of a step from end to end of a quantity's range."""

FOLDS = 2
"""Parts of the fitting half between which the pull is chosen."""

STEPS = 20
"""Most steps of the optimiser from each start."""

SHIFTS = ({}, {"slow_pole": 0.2}, {"observer_proportional": -0.5})
"""Starts of a fit, as shifts from print of what is fitted, in its unit box."""

CORNER = 0.1
"""|ln(sim/print)| at which the cost turns from square into linear."""


class Problem(eqx.Module):
    """Cells to be explained by one stage.

    ``paper`` in um and ``counts`` (1 or 0) follow the lanes one after the other;
    ``strength`` is the pull towards ``start``, the point of print in the unit box;
    what is in doubt is not pulled.
    """

    space: Space
    numerator: tuple[float, ...] = eqx.field(static=True)
    lanes: list[Lanes]
    paper: Float[Array, " cells"]
    counts: Float[Array, " cells"]
    start: Float[Array, " n"]
    strength: Array

    def errors(self, values: Mapping[str, Any]) -> Float[Array, " cells"]:
        """Return the RMS error (um) of every cell for a stage of ``values``."""
        stage, sensor = stage_of(values, self.numerator), sensor_of(values)
        squares = [
            mean_squares(stage, sensor, lanes.with_doubts(values))
            for lanes in self.lanes
        ]
        return jnp.sqrt(jnp.concatenate(squares))

    def log_ratios(self, unit: Float[Array, " n"]) -> Float[Array, " cells"]:
        """Return ln(sim/print) of every cell at a point of the unit box."""
        return jnp.log(self.errors(self.space.named(unit)) / self.paper)

    def residuals(self, unit: Float[Array, " n"]) -> Array:
        """Return what is squared and summed: nearly |ln(sim/print)|, and the pull."""
        log = self.log_ratios(unit)
        misfit = self.counts * log / (log**2 + CORNER**2) ** 0.25
        pulled = jnp.asarray([name not in DOUBTS for name in self.space.paths])
        return jnp.concatenate([misfit, self.strength * pulled * (unit - self.start)])

    def jacobian(self, unit: Float[Array, " n"]) -> tuple[Array, Array]:
        """Return the residuals' forward-mode Jacobian [residual, n], and themselves."""

        def twice(point):
            found = self.residuals(point)
            return found, found

        return jax.jacfwd(twice, has_aux=True)(unit)

    def tangent(self, unit: Float[Array, " n"]) -> Array:
        """Return the residuals in a form that is cheap to linearise.

        The optimiser linearises what it is given, which through a loop over time would
        store every sample; here it finds the finished Jacobian.
        """
        here = jax.lax.stop_gradient(unit)
        slope, value = self.jacobian(here)
        return value + slope @ (unit - here)

    def optimiser(self) -> Optimiser:
        """Return Levenberg-Marquardt on the residuals."""
        return levenberg_marquardt(lambda unit: jnp.zeros(()), self.tangent, 1e-4)


@eqx.filter_jit
def _start(problem: Problem, unit: Array) -> Any:
    return problem.optimiser().start(unit)


@eqx.filter_jit
def _step(problem: Problem, carry: Any) -> tuple[Any, View]:
    optimiser = problem.optimiser()
    carry = optimiser.step(carry)
    return carry, optimiser.view(carry)


@eqx.filter_jit
def _log_ratios(problem: Problem, unit: Array) -> Array:
    return problem.log_ratios(unit)


def starts(problem: Problem) -> list[Array]:
    """Return the points of the unit box from which ``problem`` is fitted."""
    names = problem.space.paths
    shifts = [shift for shift in SHIFTS if shift.keys() <= set(names)]
    return [problem.start + jnp.asarray([s.get(n, 0.0) for n in names]) for s in shifts]


def fit(
    problem: Problem, steps: int = STEPS, progress: Progress | None = None
) -> Float[Array, " n"]:
    """Return the point of the unit box where the cost is least, of all starts.

    A trial step into instability costs more and is not taken: the damping grows.
    """
    progress = Silent() if progress is None else progress
    best, least = problem.start, np.inf
    for start in starts(problem):
        carry = _start(problem, start)
        for _ in range(steps):
            carry, view = _step(problem, carry)
            if float(view.loss) < least:
                best, least = view.unit, float(view.loss)
            progress.advance(least)
            if bool(view.done):
                break
    return best


@dataclass(frozen=True)
class Experiment:
    """Tables that one stage is to explain, and the print its fit starts from."""

    chapter: str
    tables: tuple[str, ...]
    columns: tuple[str, ...]
    dynamics: ARMA
    doubts: tuple[str, ...] = ()

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

    def quantities(self) -> dict[str, Quantity]:
        """Return what is fitted."""
        return quantities(self.dynamics) | {name: DOUBTS[name] for name in self.doubts}

    def problem(self, cells: Sequence[Cell], *, short: bool) -> Problem:
        """Return the Problem of ``cells``, in the order of ``by_column``."""
        found = self.quantities()
        space = space_of({n: (q.lower, q.upper, q.scale) for n, q in found.items()})
        order = [cell for group in by_column(cells) for cell in group]
        return Problem(
            space=space,
            numerator=tuple(float(b) for b in self.dynamics.moving),
            lanes=lanes_of(cells, short=short),
            paper=jnp.asarray([cell.paper for cell in order]),
            counts=jnp.ones(len(order)),
            start=space.to_unit(jnp.asarray([q.start for q in found.values()])),
            strength=jnp.asarray(1.0),
        )


def _chapter5(*doubts: str) -> Experiment:
    return Experiment(
        "ch5",
        tuple(chapter5.TABLES),
        tuple(chapter5.COLUMNS),
        ARMA(**p753.DYNAMICS_BEHIND_HYSTERESIS),
        doubts,
    )


def _chapter4(*doubts: str) -> Experiment:
    row = p753.ARMA_HYSTERESIS["3-2"]
    dynamics = ARMA(row["autoregressive"], row["moving_2"])
    columns = ("model_reference", "continuous")
    return Experiment("ch4", ("4-5",), columns, dynamics, doubts)


EXPERIMENTS = {
    "chapter 5": _chapter5(),
    "chapter 5, P of the observer in doubt": _chapter5("observer_proportional"),
    "chapter 5, that P and the size of SW in doubt": _chapter5(*DOUBTS),
    "chapter 4": _chapter4(),
    "chapter 4, the size of SW in doubt": _chapter4("superposed_amplitude"),
}
"""What is fitted. With doubts it is no test of the stage alone: what is printed is
fitted too, one value for all cells, to show what hangs on it. The traditional column of
Table 4-5 is in none, because its gains are not printed."""


class Swap(NamedTuple):
    """A fit to one half: its values, its pull, and all cells simulated with them."""

    half: str
    strength: float
    values: dict[str, float]
    train: list[Cell]
    held_out: list[Cell]


def choose_strength(
    problem: Problem, steps: int = STEPS, progress: Progress | None = None
) -> float:
    """Return the pull whose fits to one fold best predict the other.

    The folds are every ``FOLDS``-th cell of ``problem``: no cell outside it is seen.
    """
    fold = np.arange(problem.paper.size) % FOLDS
    scores = {}
    for strength in STRENGTHS:
        logs = []
        for left_out in range(FOLDS):
            part = eqx.tree_at(
                lambda p: (p.counts, p.strength),
                problem,
                (jnp.asarray(fold != left_out, float), jnp.asarray(strength)),
            )
            unit = fit(part, steps, progress)
            logs.append(np.asarray(_log_ratios(problem, unit))[fold == left_out])
        scores[strength] = geomean(np.concatenate(logs))
    return min(scores, key=lambda strength: scores[strength])


def calibrate(
    name: str, steps: int = STEPS, progress: Progress | None = None
) -> list[Swap]:
    """Return both fits of ``EXPERIMENTS[name]``, each judged on the other half.

    Fitted on shortened runs (``lanes.WARM_UP``, ``lanes.SHORT``), judged on the runs
    that the tables of this package use.
    """
    progress = Silent() if progress is None else progress
    experiment = EXPERIMENTS[name]
    halves = experiment.cells()
    everything = [cell for half in halves.values() for cell in half]
    judge = experiment.problem(everything, short=False)
    order = [cell for group in by_column(everything) for cell in group]
    swaps = []
    for half, cells in halves.items():
        problem = experiment.problem(cells, short=True)
        fits = (len(STRENGTHS) * FOLDS + 1) * len(starts(problem))
        progress.stage(f"{name}: fitting the {half} cells", fits * steps)
        strength = choose_strength(problem, steps, progress)
        pulled = eqx.tree_at(lambda p: p.strength, problem, jnp.asarray(strength))
        unit = fit(pulled, steps, progress)
        ratios = np.exp(np.asarray(_log_ratios(judge, unit)))
        found = [
            cell.simulated(float(cell.paper * ratio))
            for cell, ratio in zip(order, ratios, strict=True)
        ]
        mine = {(cell.table, cell.row, cell.column) for cell in cells}
        inside = [(c.table, c.row, c.column) in mine for c in found]
        swaps.append(
            Swap(
                half,
                strength,
                {n: float(v) for n, v in judge.space.named(unit).items()},
                [c for c, ours in zip(found, inside, strict=True) if ours],
                [c for c, ours in zip(found, inside, strict=True) if not ours],
            )
        )
    return swaps
