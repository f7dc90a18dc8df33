"""Which prints to doubt, and how hard to pull: decided on the cells that are fitted.

Nothing here sees any other cell. All thresholds were fixed before the procedure was
first run on print.
"""

from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from ..core.progress import Progress, Silent
from .stage_fit import STEPS, Point, Problem, costs, fit, log_ratios
from .summary import geomean

STRENGTHS = (0.3, 3.0)
"""Pulls towards print tried: cost of a step from end to end of a quantity's range."""

FOLDS = 5
"""Parts of the fitting half; each holds one cell of each column of each table."""

SHIFTS = ({}, {"slow_pole": 0.2})
"""Starts of a fit without doubts, as shifts from print in the unit box."""

MOST = 3
"""Doubts that are taken at most."""

WORTH = 1.02
"""Least factor by which a doubt must lower the cross-validated ratio."""

GRID = 5
"""Values of a candidate tried with the stage held; the middle one is print."""

SCREENING = 3
"""Steps of the optimiser from the best of them, with the stage free."""

FINALISTS = 3
"""Candidates, the cheapest after that, that are cross-validated."""


class Round(NamedTuple):
    """One round: cross-validated ratio without a further doubt, and with each."""

    before: float
    after: dict[str, float]
    taken: str | None


class Choice(NamedTuple):
    """What was decided, and the fits to the whole half without and with the doubts."""

    doubts: tuple[str, ...]
    rounds: tuple[Round, ...]
    strength: float
    alone: Point
    point: Point


def starts(problem: Problem) -> list[Point]:
    """Return the points of the unit box from which the stage alone is fitted."""
    names = problem.space.paths
    return [
        problem.start + jnp.asarray([shift.get(n, 0.0) for n in names])
        for shift in SHIFTS
    ]


def cross_validated(
    problem: Problem,
    free: Sequence[int],
    begin: Sequence[Point],
    steps: int = STEPS,
    progress: Progress | None = None,
) -> float:
    """Return the ratio of the cells, each predicted from the other folds."""
    fold = np.arange(problem.paper.size) % FOLDS
    logs = []
    for left_out in range(FOLDS):
        counts = problem.counts * jnp.asarray(fold != left_out, float)
        part = eqx.tree_at(lambda p: p.counts, problem, counts)
        point, _ = fit(part, free, begin, steps, progress)
        logs.append(np.asarray(log_ratios(problem, point))[fold == left_out])
    ratio = geomean(np.concatenate(logs))
    return ratio if np.isfinite(ratio) else np.inf


def pulled(
    problem: Problem,
    free: Sequence[int],
    begin: Sequence[Point],
    steps: int = STEPS,
    progress: Progress | None = None,
) -> tuple[Problem, float]:
    """Return the problem with the best pull of ``STRENGTHS``, and its ratio."""
    tried = [
        eqx.tree_at(lambda p: p.strength, problem, jnp.asarray(strength))
        for strength in STRENGTHS
    ]
    ratios = [cross_validated(p, free, begin, steps, progress) for p in tried]
    best = int(np.argmin(ratios))
    return tried[best], ratios[best]


def screen(
    problem: Problem,
    free: Sequence[int],
    point: Point,
    progress: Progress | None = None,
) -> list[tuple[int, Point]]:
    """Return the ``FINALISTS`` that lower the cost most, each with its point.

    A wide step first, because what fits may be decades from print and the slope there
    says little of it; then a few steps together with what is ``free`` already. All of
    it twice: from ``point``, and from the printed stage, because a stage that was bent
    to make up for a wrong print hides it.
    """
    progress = Silent() if progress is None else progress
    grid = (jnp.arange(GRID) + 0.5) / GRID
    bases = point, point.at[: problem.stage].set(problem.start[: problem.stage])
    found = []
    for place in range(problem.stage, point.size):
        if place in free:
            continue
        tried = []
        for base in bases:
            points = jnp.tile(base, (GRID, 1)).at[:, place].set(grid)
            begin = points[int(np.argmin(np.asarray(costs(problem, points))))]
            tried.append(fit(problem, [*free, place], [begin], SCREENING, progress))
        moved, least = min(tried, key=lambda entry: entry[1])
        found.append((least, place, moved))
    found.sort(key=lambda entry: entry[:2])
    return [(place, moved) for _, place, moved in found[:FINALISTS]]


def select(
    problem: Problem,
    name: str = "",
    steps: int = STEPS,
    progress: Progress | None = None,
) -> Choice:
    """Return the doubts that the cells of ``problem`` ask for, and the fits.

    Forward, one doubt at a time: of the finalists of the screening the one with the
    best cross-validated ratio, if that is better by ``WORTH`` than without.
    """
    progress = Silent() if progress is None else progress
    names, begin = problem.space.paths, starts(problem)
    free = list(range(problem.stage))
    progress.stage(
        f"{name}: the stage alone", (len(STRENGTHS) * FOLDS + 1) * len(begin) * steps
    )
    problem, ratio = pulled(problem, free, begin, steps, progress)
    alone, _ = fit(problem, free, begin, steps, progress)
    point, rounds = alone, []
    while len(rounds) < MOST and len(free) < point.size:
        progress.stage(
            f"{name}: cross-validated {ratio:.3f}; screening for a doubt",
            2 * SCREENING * (point.size - len(free)),
        )
        finalists = screen(problem, free, point, progress)
        progress.stage(f"{name}: finalists", len(finalists) * FOLDS * steps)
        after = {
            place: cross_validated(problem, [*free, place], [moved], steps, progress)
            for place, moved in finalists
        }
        best = min(after, key=lambda place: after[place])
        worth = after[best] * WORTH <= ratio
        told = {names[place]: value for place, value in after.items()}
        rounds.append(Round(ratio, told, names[best] if worth else None))
        if not worth:
            break
        free, ratio = [*free, best], after[best]
        point, _ = fit(problem, free, [dict(finalists)[best]], steps, progress)
    doubts = tuple(names[place] for place in free[problem.stage :])
    if doubts:
        progress.stage(
            f"{name}: {', '.join(doubts)}", (len(STRENGTHS) * FOLDS + 1) * steps
        )
        problem, _ = pulled(problem, free, [point], steps, progress)
        point, _ = fit(problem, free, [point], steps, progress)
    return Choice(doubts, tuple(rounds), float(problem.strength), alone, point)
