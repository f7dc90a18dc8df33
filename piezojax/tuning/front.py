"""A Pareto front by continuation: the study solved for one limit after the other."""

from collections.abc import Callable, Sequence

import jax
import numpy as np
from jax import Array

from ..analysis.constraints import CONSTRAINTS, worst_by_plant
from ..core.arrays import as_array
from ..core.progress import Progress
from ..solve.clock import Clock
from ..solve.multi_start import Strategy, minimise
from ..solve.problem import TOLERANCE
from ..solve.search_state import SearchState
from ..study import Case
from .objective import Objective
from .result import ConstraintOutcome, FrontPoint

Place = tuple[np.ndarray, FrontPoint]
"""A point of the unit box, and the same point on the front."""


def trace_front(
    objective: Objective,
    case: Case,
    search: SearchState,
    strategy: Strategy,
    clock: Clock,
    progress: Progress,
) -> list[FrontPoint]:
    """Return the best gains found for each limit of the study's front.

    Each limit starts from the gains of the one before, the limits from the loosest to
    the tightest, and the first from the result of ``search`` by ``strategy``. Where a
    tighter limit came out better than a looser one, the looser one is solved again from
    its gains, which keep both.
    """
    table = case.study.pareto
    assert table is not None
    limits = case.study.constraints

    def look(objective: Objective, unit: Array) -> tuple[dict[str, Array], Array]:
        loop = objective.figures(unit)
        return worst_by_plant(objective.limits, loop), loop.tracking.rms_error[0]

    program = clock.compiled(look, objective, as_array(search.unit))
    loosest_first = sorted(
        table.limits, reverse=CONSTRAINTS[table.constraint].sense == "at most"
    )

    def solved(limit: float, unit: np.ndarray) -> Place:
        asked = objective.with_limits(limits | {table.constraint: limit})
        here = SearchState(unit, starts=unit[None])
        minimise(strategy, asked, unit[None], here, table.steps, progress)
        unit = here.unit
        values, rms = jax.tree.map(np.asarray, program(asked, as_array(unit)))
        rms = np.sqrt(np.mean(rms**2, axis=1))
        reached = ConstraintOutcome.of_values(
            table.constraint, limit, values[table.constraint]
        )
        return unit, FrontPoint(
            limit=limit,
            value=reached.value,
            loss=here.loss,
            kept=here.violation <= TOLERANCE,
            geomean_rms_um=float(np.exp(np.mean(np.log(rms)))),
            gains={
                path: float(value)
                for path, value in case.space.named(as_array(unit)).items()
            },
        )

    found, unit = [], search.unit
    for limit in loosest_first:
        unit, point = solved(limit, unit)
        found.append((unit, point))
    return [point for _, point in undominated(found, solved)]


def undominated(
    found: Sequence[Place], solved: Callable[[float, np.ndarray], Place]
) -> list[Place]:
    """Return the front, from its tightest limit back to the loosest.

    A looser limit that came out worse than a tighter one is ``solved`` from it again.
    """
    found = list(found)
    for i in reversed(range(len(found) - 1)):
        (_, looser), (unit, tighter) = found[i : i + 2]
        if tighter.kept and not (looser.kept and looser.loss <= tighter.loss):
            found[i] = solved(looser.limit, unit)
    return found
