"""Selection of the suspect numbers and of the penalty weight, on the fitted cells only.

No held-out cell is used. All thresholds were fixed before the first run on the printed
data.
"""

from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from ..core.progress import Progress, Silent
from .stage_fit import STEPS, Point, Problem, costs, fit, log_ratios
from .summary import geomean

PENALTY_WEIGHTS = (0.3, 3.0)
"""Candidate weights of the penalty on the stage's distance from the printed values.

A weight is the residual for a deviation by the whole range of a quantity.
"""

FOLDS = 5
"""Parts of the fitting half; each has one cell of each column of each table."""

SHIFTS = ({}, {"slow_pole": 0.2})
"""Starts of a fit of the stage alone: shifts from the printed point in the unit box."""

MAX_SUSPECTS = 3
"""Largest number of selected suspect numbers."""

MIN_IMPROVEMENT = 1.02
"""Smallest factor by which a suspect number must lower the cross-validated ratio."""

GRID = 5
"""Number of grid values of a candidate around the printed one, the stage fixed."""

SCREENING = 3
"""Number of optimiser steps from the best grid value, with the stage free."""

FINALISTS = 3
"""Number of candidates with the least cost after screening that are cross-validated."""


class Round(NamedTuple):
    """One round: cross-validated ratios before it and with each finalist.

    ``taken`` is the selected finalist, None if none improves the ratio enough.
    """

    before: float
    after: dict[str, float]
    taken: str | None


class Choice(NamedTuple):
    """Selected suspect numbers, and the fits to the half without and with them."""

    suspects: tuple[str, ...]
    rounds: tuple[Round, ...]
    penalty_weight: float
    stage_only: Point
    point: Point


def starts(problem: Problem) -> list[Point]:
    """Return the starts, in the unit box, of a fit of the stage alone."""
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
    """Return the ratio of the cells, each predicted by a fit to the other folds."""
    fold = np.arange(problem.paper.size) % FOLDS
    logs = []
    for left_out in range(FOLDS):
        counts = problem.counts * jnp.asarray(fold != left_out, float)
        part = eqx.tree_at(lambda p: p.counts, problem, counts)
        point, _ = fit(part, free, begin, steps, progress)
        logs.append(np.asarray(log_ratios(problem, point))[fold == left_out])
    ratio = geomean(np.concatenate(logs))
    return ratio if np.isfinite(ratio) else np.inf


def with_best_penalty(
    problem: Problem,
    free: Sequence[int],
    begin: Sequence[Point],
    steps: int = STEPS,
    progress: Progress | None = None,
) -> tuple[Problem, float]:
    """Return the problem with the best of ``PENALTY_WEIGHTS``, and its ratio."""
    problems = [
        eqx.tree_at(lambda p: p.penalty_weight, problem, jnp.asarray(weight))
        for weight in PENALTY_WEIGHTS
    ]
    ratios = [cross_validated(p, free, begin, steps, progress) for p in problems]
    best = int(np.argmin(ratios))
    return problems[best], ratios[best]


def screen(
    problem: Problem,
    free: Sequence[int],
    point: Point,
    progress: Progress | None = None,
) -> list[tuple[int, Point]]:
    """Return the ``FINALISTS`` candidates with the least cost, each with its point.

    A grid search of the candidate comes first: its best value may be decades from the
    printed one, and the slope at the printed value does not lead there. A few steps of
    the optimiser follow, in which the quantities ``free`` vary too. Both run twice,
    from ``point`` and from the printed stage, because a stage that was fitted with a
    misprint may compensate for it and hide it.
    """
    progress = Silent() if progress is None else progress
    grid = (jnp.arange(GRID) + 0.5) / GRID
    bases = point, point.at[: problem.stage].set(problem.start[: problem.stage])
    screened = []
    for place in range(problem.stage, point.size):
        if place in free:
            continue
        fits = []
        for base in bases:
            points = jnp.tile(base, (GRID, 1)).at[:, place].set(grid)
            begin = points[int(np.argmin(np.asarray(costs(problem, points))))]
            fits.append(fit(problem, [*free, place], [begin], SCREENING, progress))
        best, least = min(fits, key=lambda entry: entry[1])
        screened.append((least, place, best))
    screened.sort(key=lambda entry: entry[:2])
    return [(place, best) for _, place, best in screened[:FINALISTS]]


def select(
    problem: Problem,
    name: str = "",
    steps: int = STEPS,
    progress: Progress | None = None,
) -> Choice:
    """Select the suspect numbers of ``problem`` by forward selection, and fit them.

    Each round takes the finalist of the screening with the best cross-validated ratio.
    The selection ends when this ratio is not better by ``MIN_IMPROVEMENT``, or after
    ``MAX_SUSPECTS`` numbers.
    """
    progress = Silent() if progress is None else progress
    names, begin = problem.space.paths, starts(problem)
    free = list(range(problem.stage))
    progress.stage(
        f"{name}: the stage alone",
        (len(PENALTY_WEIGHTS) * FOLDS + 1) * len(begin) * steps,
    )
    problem, ratio = with_best_penalty(problem, free, begin, steps, progress)
    stage_only, _ = fit(problem, free, begin, steps, progress)
    point, rounds = stage_only, []
    while len(rounds) < MAX_SUSPECTS and len(free) < point.size:
        progress.stage(
            f"{name}: cross-validated {ratio:.3f}; screening candidates",
            2 * SCREENING * (point.size - len(free)),
        )
        finalists = screen(problem, free, point, progress)
        progress.stage(f"{name}: finalists", len(finalists) * FOLDS * steps)
        after = {
            place: cross_validated(problem, [*free, place], [moved], steps, progress)
            for place, moved in finalists
        }
        best = min(after, key=lambda place: after[place])
        improves = after[best] * MIN_IMPROVEMENT <= ratio
        ratios = {names[place]: value for place, value in after.items()}
        rounds.append(Round(ratio, ratios, names[best] if improves else None))
        if not improves:
            break
        free, ratio = [*free, best], after[best]
        point, _ = fit(problem, free, [dict(finalists)[best]], steps, progress)
    suspects = tuple(names[place] for place in free[problem.stage :])
    if suspects:
        progress.stage(
            f"{name}: {', '.join(suspects)}", (len(PENALTY_WEIGHTS) * FOLDS + 1) * steps
        )
        problem, _ = with_best_penalty(problem, free, [point], steps, progress)
        point, _ = fit(problem, free, [point], steps, progress)
    return Choice(
        suspects, tuple(rounds), float(problem.penalty_weight), stage_only, point
    )
