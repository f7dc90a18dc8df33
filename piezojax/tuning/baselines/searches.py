"""Searches without gradients over the same box and objective as the tuner."""

import warnings
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from scipy import optimize

from ...core.arrays import as_array
from ...core.progress import Progress
from ...solve.history import History, batch_loss

SPREAD = 0.2
"""Initial standard deviation of CMA-ES, as a share of the box."""

SIMPLEX = 0.1
"""Side of the initial simplex of Nelder and Mead, as a share of the box."""


class Budget(NamedTuple):
    """Stopping criteria of a search: ``tolerance`` and number of ``evaluations``.

    A search stops by its own criteria at ``tolerance``, or after ``evaluations``. The
    tolerance is on the loss, and for Nelder and Mead's simplex also on the unit box.
    """

    evaluations: int = 10_000
    tolerance: float = 1e-4


class SearchResult(NamedTuple):
    """Result of a search: best point in [0, 1]^n, history, and reason to stop."""

    unit: np.ndarray
    history: History
    stop: str


Method = Callable[[Any, np.ndarray, Budget, Progress], SearchResult]
"""Function ``method(objective, starts, budget, progress)`` that returns a SearchResult.

``starts`` [starts, n] are points of the unit box, the best one first. ``objective`` has
a method ``loss(unit)``."""


class _SpentError(Exception):
    """Error that ends a search once its evaluations are spent."""


def nelder_mead(
    objective: Any, starts: np.ndarray, budget: Budget, progress: Progress
) -> SearchResult:
    """Search with Nelder and Mead's simplex (SciPy, adaptive, bounded).

    The search runs from each start in turn; each later start has the rest of the
    budget. Points are simulated one at a time, because the method is sequential.
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
    return SearchResult(best[1], history, stop)


def cma_es(population: int | None = None, seed: int = 1) -> Method:
    """Return CMA-ES (the library ``cma``) with a population, None for its default.

    It runs from the first start only, because it explores the box from there. Each
    population is simulated in one batch. ``seed`` must not be 0: the library would then
    seed itself from the clock.
    """

    def search(
        objective: Any, starts: np.ndarray, budget: Budget, progress: Progress
    ) -> SearchResult:
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
        return SearchResult(np.asarray(strategy.result.xbest), history, stop)

    return search


def _strategy(start: np.ndarray, population: int | None, seed: int, budget: Budget):
    with warnings.catch_warnings():
        # The import warns about missing optional packages.
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
