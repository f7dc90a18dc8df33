"""A Pareto front by continuation: the study solved for one limit after the other."""

import jax
import numpy as np

from .._types import as_array
from ..progress import Progress
from ..study import Case
from .clock import Clock
from .constraints import CONSTRAINTS, TOLERANCE, by_stage
from .found import Search
from .objective import Objective
from .result import FrontPoint
from .search import way_of


def trace_front(
    objective: Objective, case: Case, search: Search, clock: Clock, progress: Progress
) -> list[FrontPoint]:
    """Return the best gains found for each limit of the study's front.

    Each limit starts from the gains of the one before, the limits from the loosest to
    the tightest; what ``search`` found is where the first starts.
    """
    table = case.study.pareto
    assert table is not None
    limits = case.study.constraints.limits
    look = clock.compiled(
        lambda objective, unit: (
            by_stage(objective.limits, objective.seen(unit))
            | {"rms_um": objective.seen(unit).figures.rms_error[0]}
        ),
        objective,
        as_array(search.unit),
    )
    loosest_first = sorted(
        table.limits, reverse=CONSTRAINTS[table.constraint].sense == "at most"
    )
    way = way_of(objective, case, clock)
    way.wait()
    found, unit = [], search.unit
    for limit in loosest_first:
        asked = objective.with_limits(limits | {table.constraint: limit})
        here = Search(unit, starts=unit[None])
        way.descend(asked, unit[None], here, table.steps, progress)
        unit = here.unit
        seen = jax.tree.map(np.asarray, look(asked, as_array(unit)))
        rms = np.sqrt(np.mean(seen["rms_um"] ** 2, axis=1))
        kind = CONSTRAINTS[table.constraint].sense
        values = seen[table.constraint]
        found.append(
            FrontPoint(
                limit=limit,
                value=float(values.max() if kind == "at most" else values.min()),
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
