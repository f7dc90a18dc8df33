"""Searches without gradients, over the same box and objective."""

import warnings
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from scipy import optimize

from ...core.arrays import as_array
from ...core.progress import Progress
from ...solve.history import History, batch_loss

SPREAD = 0.2
"""First standard deviation of CMA-ES, as a share of the box."""

SIMPLEX = 0.1
"""Side of the first simplex of Nelder and Mead, as a share of the box."""


class Budget(NamedTuple):
    """When a search ends: its own criteria at ``tolerance``, or ``evaluations``.

    The tolerance is on the loss, and for Nelder and Mead's simplex on the unit box too.
    """

    evaluations: int = 10_000
    tolerance: float = 1e-4


class Found(NamedTuple):
    """The best point in [0, 1]^n, how the search went, and why it ended."""

    unit: np.ndarray
    history: History
    stop: str


Method = Callable[[Any, np.ndarray, Budget, Progress], Found]
"""``method(objective, starts, budget, progress)``; ``starts`` are points of the unit
box, the best first guess in front. ``objective`` has a ``loss(unit)``."""


class _SpentError(Exception):
    """The budget is spent."""


def nelder_mead(
    objective: Any, starts: np.ndarray, budget: Budget, progress: Progress
) -> Found:
    """Nelder and Mead's simplex (SciPy, adaptive, bounded) from each start in turn.

    A start after the first takes what is left of the budget. One point at a time: the
    method gives no two that could be simulated at once.
    """
    history = History()
    size = starts.shape[1]
    program = batch_loss(objective, as_array(starts[:1]), history.clock)
    best = [np.inf, starts[0]]

    def loss(unit):
        if history.evaluations and history.evaluations[-1] >= budget.evaluations:
            raise _SpentError
        value = float(program(as_array(unit)[None])[0])
        if value < best[0]:
            best[:] = value, np.array(unit)
        history.add(1, value)
        progress.advance(best[0])
        return value

    stop = "tolerance at every start"
    for start in starts:
        corner = np.where(start > 0.5, -SIMPLEX, SIMPLEX)
        try:
            optimize.minimize(
                loss,
                start,
                method="Nelder-Mead",
                bounds=[(0.0, 1.0)] * size,
                options={
                    "initial_simplex": start
                    + np.vstack([0.0 * corner, np.diag(corner)]),
                    "xatol": budget.tolerance,
                    "fatol": budget.tolerance,
                    "maxiter": budget.evaluations,
                    "maxfev": budget.evaluations,
                    "adaptive": True,
                },
            )
        except _SpentError:
            stop = "evaluations"
            break
    return Found(best[1], history, stop)


def cma_es(population: int | None = None, seed: int = 1) -> Method:
    """Return CMA-ES (the library ``cma``) with a population, None for its default.

    From the first start alone: it spreads by itself. Each population is simulated in
    one batch. ``seed`` must not be 0, which the library takes for none.
    """

    def search(
        objective: Any, starts: np.ndarray, budget: Budget, progress: Progress
    ) -> Found:
        history = History()
        strategy = _strategy(starts[0], population, seed, budget)
        some = as_array(np.zeros((strategy.popsize, starts.shape[1])))
        program = batch_loss(objective, some, history.clock)
        while not strategy.stop():
            units = strategy.ask()
            losses = np.asarray(program(as_array(np.array(units))))
            strategy.tell(units, [float(loss) for loss in losses])
            history.add(len(units), float(losses.min()))
            progress.advance(history.loss)
        stop = ", ".join(strategy.stop() or ())
        return Found(np.asarray(strategy.result.xbest), history, stop)

    return search


def _strategy(start: np.ndarray, population: int | None, seed: int, budget: Budget):
    with warnings.catch_warnings():
        # On import it says which optional packages it does not find.
        warnings.simplefilter("ignore")
        import cma

    options = {
        "bounds": [0.0, 1.0],
        "seed": seed,
        "tolfun": budget.tolerance,
        "maxfevals": budget.evaluations,
        "verbose": -9,
    }
    if population is not None:
        options["popsize"] = population
    return cma.CMAEvolutionStrategy(start, SPREAD, options)
