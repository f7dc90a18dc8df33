"""Pareto front by continuation: gains tuned for one limit after the other."""

from collections.abc import Callable, Sequence

import numpy as np

from ..analysis.constraints import CONSTRAINTS, worst_by_plant
from ..core.arrays import as_array
from ..core.progress import Progress
from ..solve.multi_start import Strategy, minimise
from ..solve.problem import TOLERANCE
from ..solve.search_state import SearchState
from ..study import Case
from .evaluator import Evaluator
from .objective import Objective
from .result import ConstraintOutcome, FrontPoint, number

Place = tuple[np.ndarray, FrontPoint]
"""Gains as a point of the unit box, and the point of the front with those gains."""


def trace_front(
    objective: Objective,
    case: Case,
    search: SearchState,
    strategy: Strategy,
    evaluator: Evaluator,
    progress: Progress,
) -> list[FrontPoint]:
    """Return the best gains found for each limit of the study's front.

    ``strategy`` tunes for the limits from the loosest to the tightest. The first search
    starts from the result of ``search``, each later one from the gains of the previous
    limit. If a tighter limit gives a lower loss than a looser one, the gains for the
    looser one are tuned again, from those for the tighter one, which keep both limits.
    """
    table = case.study.pareto
    assert table is not None
    limits = case.study.limits

    loosest_first = sorted(
        table.limits, reverse=CONSTRAINTS[table.constraint].sense == "at most"
    )

    def solve(limit: float, unit: np.ndarray) -> Place:
        limited = objective.with_limits(limits | {table.constraint: limit})
        state = SearchState(unit, starts=unit[None])
        minimise(strategy, limited, unit[None], state, table.steps, progress)
        unit = state.unit
        loop = case.space.put(case.loop, as_array(unit))
        figures = evaluator.limited(
            loop, objective.signals, objective.stages, evaluator.margin_stages
        )
        rms = np.sqrt(np.mean(figures.tracking.rms_error[0] ** 2, axis=1))
        values = worst_by_plant([table.constraint], figures)[table.constraint]
        reached = ConstraintOutcome.of_values(
            table.constraint, limit, np.asarray(values)
        )
        return unit, FrontPoint(
            limit=limit,
            value=reached.value,
            loss=state.loss,
            kept=state.violation <= TOLERANCE,
            geomean_rms_um=number(np.exp(np.mean(np.log(rms)))),
            gains={
                path: float(value)
                for path, value in case.space.named(as_array(unit)).items()
            },
        )

    found, unit = [], search.unit
    for limit in loosest_first:
        unit, point = solve(limit, unit)
        found.append((unit, point))
    return [point for _, point in non_dominated(found, solve)]


def non_dominated(
    found: Sequence[Place], solve: Callable[[float, np.ndarray], Place]
) -> list[Place]:
    """Return the points ``found`` on the front, without dominated ones.

    ``found`` is sorted from the loosest limit to the tightest. Each point that is worse
    than the next tighter one is replaced by ``solve(limit, unit)``, which starts from
    the gains ``unit`` of that next one.
    """
    found = list(found)
    for i in reversed(range(len(found) - 1)):
        (_, looser), (unit, tighter) = found[i : i + 2]
        if tighter.kept and not (looser.kept and looser.loss <= tighter.loss):
            found[i] = solve(looser.limit, unit)
    return found
