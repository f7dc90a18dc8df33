"""A Pareto front by continuation: the study solved for one limit after the other."""

import jax
import numpy as np
from jax import Array

from .._types import as_array
from ..progress import Progress
from ..study import Case
from .clock import Clock
from .constraints import CONSTRAINTS, TOLERANCE, by_stage
from .found import Search
from .objective import Objective
from .result import FrontPoint, Kept
from .search import Way


def trace_front(
    objective: Objective,
    case: Case,
    search: Search,
    way: Way,
    clock: Clock,
    progress: Progress,
) -> list[FrontPoint]:
    """Return the best gains found for each limit of the study's front.

    Each limit starts from the gains of the one before, the limits from the loosest to
    the tightest; what ``search`` found by ``way`` is where the first starts.
    """
    table = case.study.pareto
    assert table is not None
    limits = case.study.constraints.limits

    def look(objective: Objective, unit: Array) -> tuple[dict[str, Array], Array]:
        seen = objective.seen(unit)
        return by_stage(objective.limits, seen), seen.figures.rms_error[0]

    program = clock.compiled(look, objective, as_array(search.unit))
    loosest_first = sorted(
        table.limits, reverse=CONSTRAINTS[table.constraint].sense == "at most"
    )
    found, unit = [], search.unit
    for limit in loosest_first:
        asked = objective.with_limits(limits | {table.constraint: limit})
        here = Search(unit, starts=unit[None])
        way.descend(asked, unit[None], here, table.steps, progress)
        unit = here.unit
        values, rms = jax.tree.map(np.asarray, program(asked, as_array(unit)))
        rms = np.sqrt(np.mean(rms**2, axis=1))
        reached = Kept.of_values(table.constraint, limit, values[table.constraint])
        found.append(
            FrontPoint(
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
        )
    return found
